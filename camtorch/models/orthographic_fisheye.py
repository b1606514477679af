"""The orthographic fisheye: r = sin(theta), and a polynomial of it."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.models._polynomial import OddPolynomial
from camtorch.optics import Chart, Lens, Planar, Polynomial, Unified


class OrthographicFisheye(OddPolynomial):
    """The orthographic fisheye with a polynomial: r = q (1 + k1 q^2 + k2 q^4 + ...), q = sin(theta).

    theta = atan2(hypot(x, y), z), (u, v) = f r (cos phi, sin phi) + c. Angles go up to 90 degrees; the chart is `UCM`'s
    for alpha = 1, not that of parallel rays without a common centre. A ray is valid before the first root of dr/dq.

    Distortion: k1 k2 ..., any number of coefficients, at least one; 4 if left out. Source of the projection: Kannala
    and Brandt, PAMI 2006, equations (2) to (5). See `Camera` for shapes, conventions and errors.
    """

    key = "orthographic_fisheye"

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Unified(alpha=1.0), Lens(Planar(Polynomial(k)))
