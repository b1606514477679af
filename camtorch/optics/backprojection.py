"""Charts of cameras that are given from the pixel to the angle: their inverse is looked up, and found by Newton."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from camtorch._tracing import has_tangent, may_look
from camtorch.optics.charts import Chart, Equidistant, Perspective, even_steps_and_ratios
from camtorch.optics.lens import Lens, Planar, Polynomial
from camtorch.optics.special import angle_per_radius
from camtorch.projection import ops
from camtorch.projection.domain import Domain, Optics

FURTHEST = math.tan(math.radians(87))
"""The radius, in focal lengths, up to which pixels have rays."""


class AnglePerRadius:
    """The radial factor theta / r of the ray (r, 0, D), D = 1 + c0 t + c1 t^2 + ... of t = r^2."""

    def __init__(self, coefficients: Sequence[Tensor]):
        self.ahead = Polynomial(coefficients)

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        return self.ahead.parameters

    def __call__(self, t: Tensor) -> Tensor:
        return angle_per_radius(t, self.ahead(t))

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """The factor and, for order 1, its derivative by t; at the centre finite, for what is multiplied by t."""
        ahead, *slope = self.ahead.derivatives(t, order)
        factor = angle_per_radius(t, ahead, 1)
        if not order:
            return (factor,)
        by_radius = torch.addcmul(ahead, t, slope[0], value=-2) / torch.addcmul(t, ahead, ahead)
        return factor, (by_radius - factor) / (2 * t + torch.finfo(t.dtype).tiny ** 0.5)

    def vjp(self, t: Tensor, weight: Tensor) -> list[Tensor]:
        """The sums over the points of dR/dc weight, for each coefficient c."""
        ahead = self.ahead(t)
        return self.ahead.vjp(t, -weight / torch.addcmul(t, ahead, ahead))


class Flat(Perspective):
    """The plane of the pixels: what a radial factor that leads to angles is followed on."""

    def end(self, dtype):
        return FURTHEST

    def usual_end(self, dtype):
        return FURTHEST

    def radii(self, count, like):
        return even_steps_and_ratios(count, FURTHEST, FURTHEST, like, torch.positive)


def flat(factor) -> Optics:
    """What `Inverted` takes a radial factor as."""
    return lambda k: (Flat(), Lens(Planar(factor(k))))


class Inverted(Chart):
    """The point (a, b) of radius r sees the angle theta = r R(r^2), R a radial factor; see `Equidistant`.

    Rays are covered before theta ceases to ascend, and up to `FURTHEST`.
    """

    def __init__(self, name: str, parameters: Sequence[Tensor]):
        """name: under which `ops.register_optics` knows what `flat` makes of the factor."""
        self.name, self.parameters = name, tuple(parameters)
        self._known: Domain | None = None

    @property
    def _planar(self) -> Planar:
        return ops.MODELS[self.name](self.parameters)[1].stages[0]

    @property
    def _domain(self) -> Domain:
        """Graph-free, with its tables, made when first asked for; traced code may keep nothing."""
        if torch.compiler.is_compiling():
            return self._tabulated()
        if self._known is None:
            self._known = self._tabulated()
        return self._known

    def _tabulated(self) -> Domain:
        k = torch.stack([w.detach() for w in self.parameters], -1).reshape(-1, len(self.parameters))
        return Domain(ops.MODELS[self.name], k).with_tables(*ops.tables(self.name, k))

    def margin(self, x, y, z):
        theta2 = torch.addcmul(x * x, y, y) * Equidistant().scale(x, y, z, 1) ** 2
        # away from the fold, where the ray's own rounding would carry it across
        before = self._domain.inverse.most2 * (1 - 32 * torch.finfo(z.dtype).eps) - theta2
        return torch.minimum(Equidistant().margin(x, y, z), before)

    def covers_all(self, nearest, extent, dtype):
        most2 = self._domain.inverse.most2
        return may_look(most2) and bool(most2.amin() > (math.pi / 2) ** 2)

    def scale(self, x, y, z, order=2):
        angle = Equidistant().scale(x, y, z, order)
        theta2 = torch.minimum(torch.addcmul(x * x, y, y) * angle * angle, self._domain.inverse.most2)
        rows = theta2.detach().reshape(len(self._domain.k), -1)
        found = ops.radial_scale(self.name, self._domain.k, rows).view_as(theta2)
        if torch.is_grad_enabled() or not may_look(x) or any(map(has_tangent, (x, y, z, *self.parameters))):
            found = self._attached(found, theta2, order)
        return angle * found

    def _attached(self, scale: Tensor, theta2: Tensor, order: int) -> Tensor:
        """The solution of s R(theta2 s^2) = 1 with its derivatives, as `solve.attach` does it."""
        with torch.no_grad():
            t = theta2.detach() * scale * scale
            factor, slope = self._domain.lens.radial.derivatives(t, 1)
            step = torch.addcmul(factor, t, slope, value=2).reciprocal()
        radial = self._planar.radial
        for _ in range(max(order, 1)):
            scale = scale + (1 - scale * radial(theta2 * scale * scale)) * step
        return scale

    def to_plane_vjp(self, x, y, z, ga, gb, scale, want_parameters):
        rho2 = torch.addcmul(x * x, y, y)
        t = rho2 * scale * scale
        factor, slope = self._planar.radial.derivatives(t, 1)
        by_angle = torch.addcmul(factor, t, slope, value=2).reciprocal()
        along = torch.addcmul(ga * x, gb, y)
        gz = -along * by_angle / torch.addcmul(rho2, z, z)
        # along times twice the derivative of the scale by rho2; what cancels at the axis is multiplied by rho2
        outwards = torch.addcmul(gz * z, along, scale) / -(rho2 + torch.finfo(z.dtype).tiny ** 0.5)
        ray = torch.addcmul(ga * scale, x, outwards), torch.addcmul(gb * scale, y, outwards), gz
        return ray, self._planar.radial.vjp(t, -along * scale * by_angle) if want_parameters else []

    def on_plane(self, a, b):
        t = torch.addcmul(a * a, b, b)
        inside = self._domain.inner2 * (1 - 64 * torch.finfo(a.dtype).eps) - t
        t = torch.minimum(t, self._domain.inner2)
        theta2 = t * self._domain.lens.radial(t) ** 2
        # where theta ceases to ascend its rounding is that of many radii; further from there than `margin` is
        before = self._domain.inverse.most2 * (1 - 128 * torch.finfo(a.dtype).eps)
        return torch.minimum(inside, before.clamp(max=math.pi**2) - theta2)

    def to_ray(self, a, b, order=2):
        return Equidistant().to_ray(*self._planar.at(a, b, order=0).value, order)

    def to_ray_vjp(self, a, b, gx, gy, gz, want_parameters):
        at = self._planar.at(a, b)
        (ga, gb), _ = Equidistant().to_ray_vjp(*at.value, gx, gy, gz, False)
        return at.vjp(ga, gb, want_parameters)

    def end(self, dtype):
        return FURTHEST

    def radii(self, count, like):
        return Flat().radii(count, like)
