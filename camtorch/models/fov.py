"""The field-of-view camera (ATAN): r = atan(2 tan(omega / 2) rho / z) / omega."""

import math
from collections.abc import Sequence

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Fov, Lens


class FOV(Camera):
    """The field-of-view camera, "ATAN": r = atan(2 tan(omega / 2) rho / z) / omega.

    rho = hypot(x, y), and the arc tangent is that of both arguments, so that angles past 90 degrees are real;
    (u, v) = f r (cos phi, sin phi) + c. Every ray but the exact backward one is valid; for omega = 0 it is the pinhole
    camera. On the axis the slope is 2 f tan(omega / 2) / omega.

    Distortion: omega, in radians, between -pi and pi; its sign does not matter. The same as Basalt `fov` and COLMAP
    FOV, which are inexact near the axis, and return wrong rays past 90 degrees. Source: Devernay and Faugeras,
    "Straight lines have to be straight", MVA 2001, equation (13). See `Camera` for shapes, conventions and errors.
    """

    key = "fov"
    distortion_names: tuple[str, ...] = ("omega",)
    default_count = 1
    special_cases = (("pinhole", ()),)
    # the model is even in omega: its gradient is zero at zero
    fit_starts = ({"omega": 0.3}, {"omega": 0.9})
    defined_text = "-pi < omega < pi"

    @staticmethod
    def defined(k: Sequence[Tensor]) -> Tensor | None:
        return math.pi - k[0].abs()

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Fov(k[0]), Lens()
