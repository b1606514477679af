"""The equisolid fisheye: r = 2 sin(theta / 2), and a polynomial of it."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.models._polynomial import OddPolynomial
from camtorch.optics import Chart, Lens, Planar, Polynomial
from camtorch.optics import Equisolid as EquisolidChart


class Equisolid(OddPolynomial):
    """The equisolid fisheye with a polynomial: r = q (1 + k1 q^2 + k2 q^4 + ...), q = 2 sin(theta / 2).

    theta = atan2(hypot(x, y), z), (u, v) = f r (cos phi, sin phi) + c. A ray is valid before the first root of dr/dq.

    Distortion: k1 k2 ..., any number of coefficients, at least one; 4 if left out. Source of the projection: Kannala
    and Brandt, PAMI 2006, equations (2) to (5). See `Camera` for shapes, conventions and errors.
    """

    key = "equisolid"

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return EquisolidChart(), Lens(Planar(Polynomial(k)))
