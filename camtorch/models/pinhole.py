"""The pinhole camera."""

from camtorch.camera import Camera
from camtorch.optics import Lens, Perspective


class Pinhole(Camera):
    """A pinhole camera: u = fx x/z + cx, v = fy y/z + cy, for z > 0.

    Distortion: none. COLMAP PINHOLE, Aria LINEAR. See `Camera` for shapes, conventions and errors.
    """

    key = "pinhole"

    def __init__(self, intrinsics, *, image_size=None):
        super().__init__(intrinsics, image_size=image_size)

    @staticmethod
    def optics(k):
        return Perspective(), Lens()
