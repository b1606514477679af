"""The cylindrical panorama: longitude across, height y / hypot(x, z) down."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, CylinderChart, Lens


class Cylindrical(Camera):
    """A cylindrical panorama around the y axis: vertical lines stay straight, and angles beyond 90 degrees are visible.

    u = fx atan2(x, z) + cx, v = fy y / hypot(x, z) + cy: fx in pixels per radian, fy in pixels per unit of height,
    (cx, cy) the pixel of the forward direction. Valid within half a turn to either side, except straight up and down.

    Distortion: none. See `Camera` for shapes, conventions and errors.
    """

    key = "cylindrical"
    quarter_turn = None
    turn_axis = 0

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return CylinderChart(), Lens()
