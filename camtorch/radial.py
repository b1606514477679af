"""Radial factors of lenses whose radius is no odd function of the angle, and so not analytic at the centre."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from camtorch.analytic import root
from camtorch.lens import Polynomial


class RadiusPolynomial:
    """The radial factor R(t) = 1 + c0 s + c1 s^2 + ... of s = radius = sqrt(t).

    With odd powers of s the point m R(|m|^2) has one continuous derivative at the centre, and no second one: it depends
    on the direction from which the centre is approached. The one given there is zero, their mean.
    """

    def __init__(self, coefficients: Sequence[Tensor]):
        self.of_radius = Polynomial(coefficients)

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        return self.of_radius.parameters

    def __call__(self, t: Tensor) -> Tensor:
        return self.derivatives(t, 0)[0]

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """R and its first `order` derivatives by t, up to two; at the centre finite, for what is multiplied by t."""
        radius = root(t)
        factor, *by_radius = self.of_radius.derivatives(radius, order)
        if not order:
            return (factor,)
        slope = by_radius[0] / (2 * radius)
        if order == 1:
            return factor, slope
        return factor, slope, (by_radius[1] - 2 * slope) / (4 * radius * radius)

    def pull(self, t: Tensor, weight: Tensor) -> list[Tensor]:
        """The sums over the points of dR/dc weight, for each coefficient c."""
        return self.of_radius.pull(root(t), weight)
