"""The Mei camera, OpenCV's omnidir: (x, y) / (z + xi d), then radial and tangential distortion."""

from collections.abc import Sequence
from types import MappingProxyType

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Lens, Planar, Polynomial, Unified


class Mei(Camera):
    """The unified model with a radial-tangential lens, "omni".

        (a, b) = (x, y) / (z + xi d),  d = sqrt(x^2 + y^2 + z^2),  t = a^2 + b^2
        a' = a (1 + k1 t + k2 t^2) + 2 p1 a b + p2 (t + 2 a^2)
        b' = b (1 + k1 t + k2 t^2) + p1 (t + 2 b^2) + 2 p2 a b

    (u, v) = f (a', b') + c. A ray is valid for z > -xi d (z > -d / xi if xi > 1) and before the fold of the lens.
    Needs xi > -1; on the axis the slope is f / (1 + xi).

    Distortion: xi k1 k2 p1 p2. The same as OpenCV `omnidir` (without its skew) and Kalibr `omni` with `radtan`.
    Source: Mei and Rives, "Single view point omnidirectional camera calibration from planar grids", ICRA 2007. See
    `Camera` for shapes, conventions and errors.
    """

    key = "mei"
    distortion_names: tuple[str, ...] = ("xi", "k1", "k2", "p1", "p2")
    default_count = 5
    special_cases = (("brown_conrady", ("k1", "k2", "p1", "p2")),)
    # along a valley xi and the radial coefficients have nearly the same effect
    fit_starts = tuple({"xi": xi} for xi in (0.0, 1.0, 2.0))
    odd_in_x = frozenset({"p2"})
    odd_in_y = frozenset({"p1"})
    quarter_turn = MappingProxyType({"p1": "p2", "p2": "-p1"})
    defined_text = "xi > -1"

    @staticmethod
    def defined(k: Sequence[Tensor]) -> Tensor | None:
        return k[0] + 1

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        xi, k1, k2, p1, p2 = k
        # OpenCV numbers the decentering coefficients the other way round: p2 is the one along x
        return Unified(xi=xi), Lens(Planar(Polynomial((k1, k2)), tangential=(p2, p1)))
