"""The double sphere camera: (x, y) / (alpha d' + (1 - alpha) z'), z' = z + xi d."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Lens, Unified


class DoubleSphere(Camera):
    """The double sphere camera model.

        z' = z + xi d,  d = sqrt(x^2 + y^2 + z^2),  d' = sqrt(x^2 + y^2 + z'^2)
        (a, b) = (x, y) / (alpha d' + (1 - alpha) z'),  (u, v) = f (a, b) + c

    A ray is valid before the pole or the fold of r: for z' > -w d', with w as in `UCM`, which this is for xi = 0; and
    for z > -d / xi if xi > 1. Needs xi > -1; on the axis the slope is f / (1 + xi).

    Distortion: xi alpha. The same as Basalt `ds` and Kalibr `ds`. Source: Usenko, Demmel and Cremers, "The double
    sphere camera model", 3DV 2018, equation (40). See `Camera` for shapes, conventions and errors.
    """

    key = "double_sphere"
    distortion_names: tuple[str, ...] = ("xi", "alpha")
    default_count = 2
    special_cases = (("ucm", ("alpha",)),)
    fit_starts = ({"alpha": 0.1}, {"alpha": 0.5}, {"xi": -0.2, "alpha": 0.6})
    defined_text = "xi > -1"

    @staticmethod
    def defined(k: Sequence[Tensor]) -> Tensor | None:
        return k[0] + 1

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Unified(xi=k[0], alpha=k[1]), Lens()
