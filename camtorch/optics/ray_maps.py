"""Maps of rays, and charts that come after one: a chart turned about another axis, and one behind a windshield."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from camtorch._portable import plus
from camtorch.optics.charts import Chart, Planes2, Planes3, unit
from camtorch.optics.lens import Jacobian, newton_step
from camtorch.optics.special import atan2

_STEPS = 12  # of Newton's method; each is at most _LONGEST radians long
_LONGEST = 0.5
_LEAST = 8  # times the root of the rounding: how far rays stay away from the plane of the camera


class RayMap:
    """A map from rays to rays, and back. Rays that come are of any length near 1; those that go are unit length.

    Margins are positive where something holds; the map and its inverse are finite everywhere.
    """

    code: ClassVar[int | None] = None
    """That of native/geometry.h; see `Chart.code`."""
    parameters: tuple[Tensor, ...] = ()
    """What the formulas learn; see `Chart.parameters`."""

    def __call__(self, x: Tensor, y: Tensor, z: Tensor) -> Planes3:
        """Where rays go."""
        raise NotImplementedError

    def inverse(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Planes3:
        """Where unit rays come from; the derivatives of that order shall be exact."""
        raise NotImplementedError

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor | None:
        """Positive for rays that the map is one-to-one around; None for all."""
        return None


class Rotation(RayMap):
    """The rotation of a matrix, row by row."""

    code: ClassVar[int | None] = 1

    def __init__(self, *matrix: Tensor):
        self.parameters: tuple[Tensor, ...] = matrix

    def __call__(self, x: Tensor, y: Tensor, z: Tensor) -> Planes3:
        m = self.parameters
        return _product(m[:3], x, y, z), _product(m[3:6], x, y, z), _product(m[6:], x, y, z)

    def inverse(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Planes3:
        m = self.parameters
        return _product(m[0::3], x, y, z), _product(m[1::3], x, y, z), _product(m[2::3], x, y, z)


def _product(row: Sequence[Tensor], x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    return row[0] * x + row[1] * y + row[2] * z


def order_of(count: int) -> int | None:
    """N of a polynomial of two variables with (n + 1)(n + 2) / 2 coefficients; None where there is no such n."""
    order = (math.isqrt(8 * count + 1) - 3) // 2
    return order if count >= 1 and (order + 1) * (order + 2) // 2 == count else None


def powers(order: int) -> list[tuple[int, int]]:
    """The powers of phi and of theta that the coefficients of a polynomial of that order belong to."""
    return [(i, j) for j in range(order + 1) for i in range(order + 1 - j)]


def _bivariate(c: Sequence[Tensor], phi: Tensor, theta: Tensor) -> Planes3:
    """The polynomial of coefficients as `powers` has them, and its derivatives by phi and theta."""
    order = order_of(len(c))
    assert order is not None
    zero = torch.zeros_like(phi)
    value, by_phi, by_theta, end = zero, zero, zero, len(c)
    for count in range(1, order + 2):  # the coefficients of the highest power of theta, and so on
        row, end = c[end - count : end], end - count
        inner, slope = row[-1] + zero, zero
        for k in reversed(row[:-1]):
            slope, inner = slope * phi + inner, inner * phi + k
        by_theta, by_phi, value = by_theta * theta + value, by_phi * theta + slope, value * theta + inner
    return value, by_phi, by_theta


class Bending(RayMap):
    """A windshield: phi' = P(phi, theta), theta' = Q(phi, theta) of the angles phi = asin(x), theta = asin(y) of rays.

    P and Q are polynomials, `powers` says in which order their coefficients are. Rays ahead stay ahead, and those
    behind, to which the model does not apply, behind.
    """

    code: ClassVar[int | None] = 2

    count: int

    def __init__(self, horizontal: Sequence[Tensor], vertical: Sequence[Tensor]):
        self.parameters: tuple[Tensor, ...] = (*horizontal, *vertical)
        self.count = len(horizontal)

    def __call__(self, x: Tensor, y: Tensor, z: Tensor) -> Planes3:
        phi, theta, side = _angles(x, y, z)
        return _of_angles(self._at(phi, theta)[0], side)

    def inverse(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Planes3:
        phi, theta, side = _angles(x, y, z)
        with torch.no_grad():
            angles = phi.detach(), theta.detach()
            found = angles
            for _ in range(_STEPS):
                (p, q), jacobian = self._at(*found)
                step = newton_step(jacobian, angles[0] - p, angles[1] - q)[:2]
                found = _inside(found[0] + _short(step[0])), _inside(found[1] + _short(step[1]))
            jacobian = self._at(*found)[1]
        here = found
        for _ in range(order):  # as `unproject.attach` does it
            p, q = self._at(*here)[0]
            step = newton_step(jacobian, phi - p, theta - q)[:2]
            here = here[0] + step[0], here[1] + step[1]
        return _of_angles(here, side)

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        phi, theta, _ = _angles(x, y, z)
        (p, q), (ua, ub, va, vb) = self._at(phi, theta)
        ahead, regular = _ahead(p, q), ua * vb - ub * va
        turned = (math.pi / 2 - torch.maximum(p.abs(), q.abs())).clamp(max=1.0)
        least = torch.minimum(torch.minimum(ahead, regular), torch.minimum(turned, unit(x, y, z)[2]))
        return plus(torch.nan_to_num(least, nan=-1.0), -(_LEAST * torch.finfo(x.dtype).eps ** 0.5))

    def _at(self, phi: Tensor, theta: Tensor) -> tuple[Planes2, Jacobian]:
        """Where angles go, and the Jacobian of that."""
        p, by_phi, by_theta = _bivariate(self.parameters[: self.count], phi, theta)
        q, of_phi, of_theta = _bivariate(self.parameters[self.count :], phi, theta)
        return (p, q), (by_phi, by_theta, of_phi, of_theta)


def _short(step: Tensor) -> Tensor:
    return step.nan_to_num(0.0).clamp(-_LONGEST, _LONGEST)


def _inside(angle: Tensor) -> Tensor:
    return angle.clamp(-math.pi / 2, math.pi / 2)


def _ahead(phi: Tensor, theta: Tensor) -> Tensor:
    """z^2 of the ray of angles; there is none where that is negative."""
    return torch.cos(phi) ** 2 - torch.sin(theta) ** 2


def _angles(x: Tensor, y: Tensor, z: Tensor) -> Planes3:
    """Phi and theta of rays, and 1 ahead, -1 behind."""
    floor = torch.finfo(x.dtype).tiny ** 0.5
    phi = atan2(x, plus(y * y + z * z, floor).sqrt())
    theta = atan2(y, plus(x * x + z * z, floor).sqrt())
    return phi, theta, torch.where(z < 0, -1.0, 1.0).to(z.dtype)


def _of_angles(angles: Planes2, side: Tensor) -> Planes3:
    phi, theta = angles
    ahead = _ahead(phi, theta)
    inside = ahead > torch.finfo(phi.dtype).eps ** 2
    z = torch.where(inside, torch.where(inside, ahead, 1.0).sqrt(), 0.0)
    return unit(torch.sin(phi), torch.sin(theta), side * z)


class Before(Chart):
    """A chart of rays that a map has changed."""

    has_scale = False

    change: RayMap
    chart: Chart

    def __init__(self, change: RayMap, chart: Chart):
        self.change, self.chart = change, chart
        self.parameters: tuple[Tensor, ...] = (*change.parameters, *chart.parameters)

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        covered, own = self.chart.margin(*self.change(x, y, z)), self.change.margin(x, y, z)
        return covered if own is None else torch.minimum(covered, own)

    def to_plane(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Planes2:
        return self.chart.to_plane(*self.change(x, y, z), order)

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        return self.chart.on_plane(a, b)

    def seen(self, a: Tensor, b: Tensor) -> Tensor | None:
        covered, goal = self.chart.seen(a, b), self.chart.to_ray(a, b, 0)
        ray = self.change.inverse(*goal, 0)
        own = self.change.margin(*ray)
        if own is None:
            return covered
        x, y, z = ((p - q).abs() for p, q in zip(self.change(*ray), goal, strict=True))
        enough = 256 * torch.finfo(a.dtype).eps
        own = torch.minimum(enough - (x + y + z), own - enough)
        return own if covered is None else torch.minimum(covered, own)

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        return self.change.inverse(*self.chart.to_ray(a, b, order), order)

    def end(self, dtype: torch.dtype) -> float | Tensor:
        return self.chart.end(dtype)

    def usual_end(self, dtype: torch.dtype) -> float | Tensor:
        return self.chart.usual_end(dtype)

    def radii(self, count: int, like: Tensor) -> Tensor:
        return self.chart.radii(count, like)
