"""The extended unified camera (EUCM): (x, y) / (alpha sqrt(beta (x^2 + y^2) + z^2) + (1 - alpha) z)."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Lens, Unified


class EUCM(Camera):
    """The extended unified camera model.

        (a, b) = (x, y) / (alpha d + (1 - alpha) z),  d = sqrt(beta (x^2 + y^2) + z^2)
        (u, v) = f (a, b) + c

    A ray is valid before the pole or the fold of r: for z > -w d, as in `UCM`, which this is for beta = 1. beta is > 0.

    Distortion: alpha beta; by default 0, 1, a pinhole camera. Basalt `eucm`, COLMAP EUCM, Kalibr `eucm`. Source:
    Khomutenko, Garcia and Martinet, "An enhanced unified camera model", RA-L 2016. See `Camera` for errors.
    """

    key = "eucm"
    distortion_names: tuple[str, ...] = ("alpha", "beta")
    default_count = 2
    special_cases = (("ucm", ("alpha",)),)
    fit_starts = ({"alpha": 0.1}, {"alpha": 0.5}, {"alpha": 0.7})
    defined_text = "beta > 0"

    @classmethod
    def ideal(cls, count: int) -> tuple[float, ...]:
        return 0.0, 1.0

    @staticmethod
    def defined(k: Sequence[Tensor]) -> Tensor | None:
        return k[1]

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Unified(alpha=k[0], beta=k[1]), Lens()
