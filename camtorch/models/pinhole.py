"""The pinhole camera: u = fx x/z + cx, v = fy y/z + cy."""

from collections.abc import Sequence

from torch import Tensor

from camtorch._arguments import Numbers
from camtorch.camera import Camera
from camtorch.optics import Chart, Lens, Perspective


class Pinhole(Camera):
    """A pinhole camera: u = fx x/z + cx, v = fy y/z + cy, for z > 0.

    Distortion: none. COLMAP PINHOLE, Aria LINEAR. See `Camera` for shapes, conventions and errors.
    """

    key = "pinhole"

    def __init__(self, intrinsics: Numbers, *, image_size: Sequence[int] | None = None) -> None:
        super().__init__(intrinsics, image_size=image_size)

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Perspective(), Lens()
