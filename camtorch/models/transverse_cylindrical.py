"""The transverse cylindrical panorama: a cylinder about the x axis."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, CylinderChart, Lens, Transverse


class TransverseCylindrical(Camera):
    """A panorama on a cylinder about the x axis: each row is a plane through that axis, angles past 90 degrees show.

    u = fx x / hypot(y, z) + cx, v = fy atan2(y, z) + cy: fx in pixels per unit of length along the cylinder, fy in
    pixels per radian, (cx, cy) the pixel of the forward direction. Valid within half a turn up and down, except
    straight left and right. With the baseline along x the rows of two such images correspond.

    Distortion: none. See `Camera` for shapes, conventions and errors.
    """

    key = "transverse_cylindrical"
    quarter_turn = None
    turn_axis = 1

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Transverse(CylinderChart()), Lens()
