"""The transverse equirectangular panorama: rows are planes through the x axis."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Lens, SphereChart, Transverse


class LatLon(Camera):
    """A transverse equirectangular panorama: its poles lie left and right, and each row is a plane through the x axis.

    u = fx asin(x / r) + cx, v = fy atan2(y, z) + cy with r = |(x, y, z)|: fx and fy in pixels per radian, (cx, cy) the
    pixel of the forward direction. Valid within half a turn up and down, except straight left and right. With the
    baseline along x the rows of two such images correspond, at any angle.

    Distortion: none. mrcal LENSMODEL_LATLON. See `Camera` for shapes, conventions and errors.
    """

    key = "latlon"
    quarter_turn = None
    turn_axis = 1
    has_poles = True

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Transverse(SphereChart()), Lens()
