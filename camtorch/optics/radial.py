"""Radial factors of lenses, which map a point m to m R(|m|^2): polynomials, ratios of them, and tables."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from camtorch.evaluate.export import pick, piece_of, plus, solve_tridiagonal, unbound
from camtorch.evaluate.recorded import register
from camtorch.native.structs import ANGLE_PER_RADIUS, POLYNOMIAL, RADIUS_POLYNOMIAL, RADIUS_TABLE, RATIONAL
from camtorch.optics.derivatives import derivatives_of
from camtorch.optics.special import angle_per_radius, first_root, root


class RadialFactor:
    """A factor R(t) of t = radius^2, 1 or near it at the centre; radius R(t) is the distorted radius.

    It is made of its coefficients, columns that broadcast against planes.
    """

    code: ClassVar[int | None] = None
    """The code in native/structs.py, which a class states for itself, not for subclasses. None: only Python has it."""
    name: str
    """The name of the class in the registry."""
    parameters: tuple[Tensor, ...]
    """The learnable parts of the formula."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.name = register(cls)

    def __init__(self, coefficients: Sequence[Tensor]):
        self.parameters: tuple[Tensor, ...] = tuple(coefficients)

    def __call__(self, t: Tensor) -> Tensor:
        """Return the factor: all that a new one must state."""
        raise NotImplementedError

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """Return R and its first `order` derivatives by t, up to two."""
        # each camera has its own derivatives, also at points that all share
        return derivatives_of(self, torch.broadcast_tensors(t, *self.parameters)[0], order)

    def margin(self, t: Tensor) -> Tensor | None:
        """Return a margin, positive where the factor is defined; None if it is defined everywhere."""
        return None

    @property
    def fold(self) -> Tensor | None:
        """The radius at which the orientation is lost, in the shape of a parameter; None if it must be searched for."""
        return None

    def closed_fold(self) -> Tensor | None:
        """Return the fold of coefficients in float64 whose values are known, infinite if there is none.

        None if it has no closed form.
        """
        return None

    def orientation(self, radius: Tensor) -> Tensor:
        """Return a margin, positive where the factor is defined, not turned over, and the distorted radius ascends."""
        t = radius * radius
        factor, slope = self.derivatives(t, 1)
        least = torch.minimum(factor, factor + 2 * t * slope)
        margin = self.margin(t)
        return least if margin is None else torch.minimum(least, margin)


class Polynomial(RadialFactor):
    """The radial factor R(t) = 1 + c0 t + c1 t^2 + ... of t = radius^2; radius R(t) is the distorted radius."""

    code: ClassVar[int | None] = POLYNOMIAL

    def __call__(self, t: Tensor) -> Tensor:
        return self.derivatives(t, 0)[0]

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """Return R and its first `order` derivatives by t by Horner's scheme, extended to Taylor coefficients at t."""
        # a derivative that is 0 stays a float: the highest powers have no terms of it, and cost nothing
        taylor: list[Any] = [self.parameters[-1]] + [0.0] * order
        lower: tuple[Any, ...] = (*reversed(self.parameters[:-1]), 1.0)
        for c in lower:
            for i in range(order, 0, -1):
                if isinstance(taylor[i], float):
                    taylor[i] = taylor[i - 1]
                else:
                    taylor[i] = torch.addcmul(taylor[i - 1], taylor[i], t)
            # two columns in one operation would leave the vectorised loop
            is_plane = isinstance(c, Tensor) and taylor[0] is not self.parameters[-1]
            taylor[0] = torch.addcmul(c, taylor[0], t) if is_plane else taylor[0] * t + c
        for i, x in enumerate(taylor):
            if isinstance(x, float):
                taylor[i] = torch.zeros_like(t)
            elif i > 1:
                taylor[i] = math.factorial(i) * x
        return tuple(taylor)

    def closed_fold(self) -> Tensor:
        """Return the first root of d(radius R)/d(radius)."""
        return first_root(*((2 * i + 3) * c for i, c in enumerate(self.parameters))).sqrt()


class Rational(RadialFactor):
    """The radial factor R(t) = N(t) / D(t), both `Polynomial`, defined before the first zero of D."""

    code: ClassVar[int | None] = RATIONAL

    numerator: Polynomial
    denominator: Polynomial

    def __init__(self, numerator: Sequence[Tensor], denominator: Sequence[Tensor]):
        self.numerator, self.denominator = Polynomial(numerator), Polynomial(denominator)
        self.parameters: tuple[Tensor, ...] = *self.numerator.parameters, *self.denominator.parameters

    def __call__(self, t: Tensor) -> Tensor:
        return self.numerator(t) / self.denominator(t)

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """Return R and its first `order` derivatives by t, from N = R D differentiated by Leibniz' rule."""
        n, d = self.numerator.derivatives(t, order), self.denominator.derivatives(t, order)
        reciprocal = d[0].reciprocal()
        ratio: list[Tensor] = []
        for i in range(order + 1):
            known = sum(math.comb(i, j) * ratio[j] * d[i - j] for j in range(i))
            ratio.append((n[i] - known) * reciprocal)
        return tuple(ratio)

    def margin(self, t: Tensor) -> Tensor:
        """Return a margin, positive before the pole."""
        return self.denominator(t)

    def closed_fold(self) -> Tensor:
        """Return the first root of N D + 2 t (N' D - N D'), the numerator of d(radius R)/d(radius), or of D."""
        n: tuple[Any, ...] = (1.0, *self.numerator.parameters)
        d: tuple[Any, ...] = (1.0, *self.denominator.parameters)
        products: list[Any] = [0.0] * (len(n) + len(d) - 1)
        for i, above in enumerate(n):
            for j, below in enumerate(d):
                products[i + j] = products[i + j] + (1 + 2 * (i - j)) * above * below
        return torch.minimum(first_root(*products[1:]), first_root(*self.denominator.parameters)).sqrt()


class RadiusPolynomial(RadialFactor):
    """The radial factor R(t) = 1 + c0 s + c1 s^2 + ... of s = radius = sqrt(t).

    With odd powers of s the point m R(|m|^2) has one continuous derivative at the centre, and no second one: it depends
    on the direction from which the centre is approached. The derivative returned there is their mean, zero.
    """

    code: ClassVar[int | None] = RADIUS_POLYNOMIAL

    of_radius: Polynomial

    def __init__(self, coefficients: Sequence[Tensor]):
        self.of_radius = Polynomial(coefficients)
        self.parameters: tuple[Tensor, ...] = self.of_radius.parameters

    def __call__(self, t: Tensor) -> Tensor:
        return self.derivatives(t, 0)[0]

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """Return R and its first `order` derivatives by t, up to two, finite at the centre, as t multiplies them."""
        radius = root(t)
        factor, *by_radius = self.of_radius.derivatives(radius, order)
        if not order:
            return (factor,)
        slope = by_radius[0] / (2 * radius)
        if order == 1:
            return factor, slope
        return factor, slope, (by_radius[1] - 2 * slope) / (4 * radius * radius)

    def closed_fold(self) -> Tensor:
        """Return the first root of d(radius R)/d(radius)."""
        return first_root(*((i + 2) * c for i, c in enumerate(self.parameters)))


class AnglePerRadius(RadialFactor):
    """The radial factor theta / r of the ray (r, 0, D), D = 1 + c0 t + c1 t^2 + ... of t = r^2."""

    code: ClassVar[int | None] = ANGLE_PER_RADIUS

    def __init__(self, coefficients: Sequence[Tensor]):
        self.ahead: RadialFactor = Polynomial(coefficients)
        self.parameters: tuple[Tensor, ...] = self.ahead.parameters

    def __call__(self, t: Tensor) -> Tensor:
        return angle_per_radius(t, self.ahead(t))

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """Return the factor and its first `order` derivatives by t, finite at the centre, as t multiplies them."""
        ahead, *bends = self.ahead.derivatives(t, order)
        factor = angle_per_radius(t, ahead, 1)
        if not order:
            return (factor,)
        square, twice = torch.addcmul(t, ahead, ahead), plus(2 * t, torch.finfo(t.dtype).tiny ** 0.5)
        by_radius = torch.addcmul(ahead, t, bends[0], value=-2) / square
        slope = (by_radius - factor) / twice
        if order == 1:
            return factor, slope
        by_radius = (-bends[0] - 2 * t * bends[1] - by_radius * (1 + 2 * ahead * bends[0])) / square
        return factor, slope, (by_radius - 3 * slope) / twice

    def closed_fold(self) -> Tensor:
        """Return the first root of D - 2 t D', to which d(theta)/d(radius) is proportional."""
        return first_root(*(-(2 * i + 1) * c for i, c in enumerate(self.parameters))).sqrt()


class RadiusTable(RadialFactor):
    """The radial factor R(t) = r(s) / s of s = radius = sqrt(t), r a monotone cubic spline through (0, 0) and a table.

    The spline has two continuous derivatives, except at nodes that Hyman's filter changes to ascend (Hyman, "Accurate
    monotonicity preserving cubic interpolation", SIAM J. Sci. Stat. Comput. 1983). Behind its last node r turns back,
    so that the lens folds there.
    """

    code: ClassVar[int | None] = RADIUS_TABLE

    nodes: tuple[Tensor, ...]
    end: Tensor
    cubics: tuple[tuple[Tensor, ...], ...]

    def __init__(self, nodes: Sequence[Tensor], values: Sequence[Tensor]):
        """Fit the spline to at least two `nodes`, ascending radii, and the `values` of r there."""
        zero = torch.zeros_like(values[0])
        self.nodes, self.end = (zero, *nodes[:-1]), nodes[-1]
        radii, heights = (torch.stack(torch.broadcast_tensors(zero, *w), -1) for w in (nodes, values))
        steps = radii.diff(dim=-1)
        secants = heights.diff(dim=-1) / steps
        self._table = radii, secants
        slopes = _slopes(steps, secants)
        before, after = slopes[..., :-1], slopes[..., 1:]
        squares = (3 * secants - 2 * before - after) / steps
        # squares are 0 in the first piece unless the filter changed it: at the axis their rounding is divided by zero
        first = (squares * steps).abs() < 64 * torch.finfo(steps.dtype).eps * secants.abs()
        squares = torch.where(first & (radii[..., :-1] == 0), 0.0, squares)
        cubes = (before + after - 2 * secants) / (steps * steps)
        # as powers of the distance from the node: powers of the radius would cancel, the more the finer the table
        self.cubics = tuple(unbound(power) for power in (heights[..., :-1], before, squares, cubes))
        self.parameters: tuple[Tensor, ...] = tuple(c for power in self.cubics for c in power)

    @property
    def fold(self) -> Tensor:
        """The first node from which r does not ascend, or the last one."""
        # because of the filter r ascends wherever the table does
        nodes, secants = self._table
        return nodes.gather(-1, (secants > 0).long().cumprod(-1).sum(-1, keepdim=True)).squeeze(-1)

    def __call__(self, t: Tensor) -> Tensor:
        return self.derivatives(t, 0)[0]

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """Return R and its first `order` derivatives by t, up to two, finite at the centre, as t multiplies them."""
        radius = root(t)
        behind = radius > self.end
        place = torch.where(behind, (2 * self.end - radius).clamp(min=0), radius)
        piece = piece_of(self.nodes[1:], place)
        offset = place - pick(self.nodes, piece)  # from the piece's node
        zeroth, first, second, third = (pick(power, piece) for power in self.cubics)
        # on the first piece the derivatives of the outer terms need neither the division nor the root
        central = (piece == 0) & ~behind
        share, square = torch.where(central, 1.0, offset / radius), torch.where(central, t, offset * offset)
        factor = zeroth / radius + share * (first + offset * second + square * third)
        if not order:
            return (factor,)
        orientation = torch.where(behind, -1.0, 1.0)
        by_radius = (orientation * (first + 2 * offset * second + 3 * square * third) - factor) / radius
        slope = by_radius / (2 * radius)
        if order == 1:
            return factor, slope
        twice = (2 * second + 6 * offset * third - 2 * by_radius) / radius
        return factor, slope, (twice - 2 * slope) / (4 * radius * radius)


def _slopes(steps: Tensor, secants: Tensor) -> Tensor:
    """Return the slopes (*B, N + 1) at the nodes of a cubic spline of pieces (*B, N), which ascends if the table does.

    At the origin its second derivative is zero, and the last two pieces are one polynomial. Hyman's filter comes last.
    """
    before, after = steps[..., :-1], steps[..., 1:]
    both = before[..., -1:] + after[..., -1:]
    one, zero = torch.ones_like(both), torch.zeros_like(both)
    main = torch.cat((2 * one, 2 * (before + after), before[..., -1:]), -1)
    above, below = torch.cat((one, before), -1), torch.cat((after, both), -1)
    last, last_but_one = after[..., -1:], before[..., -1:]
    end = (last * last * secants[..., -2:-1] + (2 * both + last) * last_but_one * secants[..., -1:]) / both
    middle = 3 * (after * secants[..., :-1] + before * secants[..., 1:])
    right = torch.cat((3 * secants[..., :1], middle, end), -1)
    slopes = solve_tridiagonal(below, main, above, right)
    # pieces of different orientation meet without a slope
    turns = torch.cat((zero > 1, secants[..., :-1] * secants[..., 1:] <= 0, zero > 1), -1)
    neighbours = torch.stack((torch.cat((secants[..., :1], secants), -1), torch.cat((secants, secants[..., -1:]), -1)))
    orientation, least = neighbours[0].sign(), neighbours.abs().amin(0)
    # a piece is monotone from 0 to 3; with a little less it is flat nowhere
    ascending = torch.minimum(torch.maximum(slopes * orientation, 0.25 * least), 2.5 * least) * orientation
    return torch.where(turns, 0.0, ascending)
