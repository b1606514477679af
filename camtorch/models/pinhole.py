"""The pinhole camera: u = fx x/z + cx, v = fy y/z + cy."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Lens, Perspective


class Pinhole(Camera):
    """A pinhole camera: u = fx x/z + cx, v = fy y/z + cy, for z > 0.

    Distortion: none. COLMAP PINHOLE, Aria LINEAR. See `Camera` for shapes, conventions and errors.

    Example:
        >>> ct.Pinhole([300.0, 300.0, 319.5, 239.5]).project([0.5, 0.0, 1.0])[0].tolist()
        [469.5, 239.5]
    """

    key = "pinhole"

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Perspective(), Lens()
