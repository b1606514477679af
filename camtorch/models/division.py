"""The division camera."""

from camtorch.camera import Camera
from camtorch.fisheyes import OneDivision
from camtorch.lens import Lens


class Division(Camera):
    """The division camera: the pixel f (a, b) + c sees along (a, b, 1 + lambda1 r^2), r^2 = a^2 + b^2.

    In front of the camera that is r / (1 + lambda1 r^2) = rho / z, solved in closed form. A ray is valid before the
    fold at r^2 = 1 / lambda1 where lambda1 > 0; all but the exact backward one where lambda1 < 0.

    Distortion: lambda1. The same as COLMAP DIVISION and SIMPLE_DIVISION, there k. lambda1 = -1/4 is the stereographic
    projection. Source: Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens
    distortion", CVPR 2001. See `Camera` for shapes, conventions and errors.
    """

    key = "division"
    distortion_names = ("lambda1",)
    default_count = 1

    @staticmethod
    def optics(k):
        return OneDivision(k[0]), Lens()
