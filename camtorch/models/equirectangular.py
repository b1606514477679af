"""The equirectangular panorama: longitude across, latitude down."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Lens, SphereChart


class Equirectangular(Camera):
    """An equirectangular panorama: longitude across, latitude down.

    u = fx atan2(x, z) + cx, v = fy atan2(y, hypot(x, z)) + cy: fx and fy in pixels per radian, (cx, cy) the pixel of
    the forward direction. Valid within half a turn to either side, except straight up and down.

    Distortion: none. COLMAP EQUIRECTANGULAR. See `Camera` for shapes, conventions and errors.
    """

    key = "equirectangular"
    quarter_turn = None
    turn_axis = 0
    has_poles = True

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return SphereChart(), Lens()
