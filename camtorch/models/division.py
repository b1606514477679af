"""The division camera: the pixel (a, b) of radius r sees along (a, b, 1 + lambda1 r^2 + lambda2 r^4 + ...)."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import AnglePerRadius, Chart, Inverted, Lens, OneDivision


class Division(Camera):
    """The division camera: the pixel f (a, b) + c sees along (a, b, D), D = 1 + lambda1 r^2 + lambda2 r^4 + ...

    r^2 = a^2 + b^2. A ray is valid before the angle stops ascending with r. With one term r / (1 + lambda1 r^2) =
    rho / z is solved in closed form: the fold is at r^2 = 1 / lambda1 if lambda1 > 0; if lambda1 < 0, all rays except
    the exact backward one are valid. More terms need Newton's method, up to 19 focal lengths from the centre.

    Distortion: lambda1 lambda2 ..., any number of coefficients, at least one; 1 if left out. One is COLMAP DIVISION and
    SIMPLE_DIVISION, there k. lambda1 = -1/4 is the stereographic projection. Source: Fitzgibbon, "Simultaneous
    linear estimation of multiple view geometry and lens distortion", CVPR 2001; more terms as in Scaramuzza, Martinelli
    and Siegwart, "A flexible technique for accurate omnidirectional camera calibration", ICVS 2006, without its
    odd powers. See `Camera` for shapes, conventions and errors.
    """

    key = "division"
    distortion_names: tuple[str, ...] = ("lambda1",)
    default_count = 1
    special_cases = (("pinhole", ()),)
    fit_starts = ({"lambda1": -0.2}, {"lambda1": -0.05})
    fit_counts = (1, 2, 4)

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        return tuple(f"lambda{i}" for i in range(1, count + 1)) or None

    @classmethod
    def counts_text(cls) -> str:
        return "n >= 1 (lambda1 lambda2 ...)"

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return (OneDivision(k[0]) if len(k) == 1 else Inverted(AnglePerRadius, k)), Lens()
