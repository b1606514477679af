"""Lenses: planar maps close to the identity, as a chain of stages with exact derivatives.

A stage is built from coefficient columns that broadcast against planes of points. `Planar` holds everything that is
polynomial or rational in the plane; `Tilt` is the homography of a tilted sensor. What a stage is at points is in
`local`; here is how far out it is certainly regular, and where its inverse starts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from camtorch.optics.local import LensAt, PlanarAt, Planes2, TiltAt, total


class Polynomial:
    """The radial factor R(t) = 1 + c0 t + c1 t^2 + ... of t = radius^2; radius R(t) is the distorted radius."""

    def __init__(self, coefficients: Sequence[Tensor]):
        self.parameters = tuple(coefficients)

    def __call__(self, t: Tensor) -> Tensor:
        return self.derivatives(t, 0)[0]

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """R and its first `order` derivatives by t: Horner's scheme, extended to the Taylor coefficients at t."""
        # a zero stays a number until it is none: no work for what the highest powers do not have
        taylor = [self.parameters[-1]] + [0.0] * order
        for c in (*reversed(self.parameters[:-1]), 1.0):
            for i in range(order, 0, -1):
                if isinstance(taylor[i], float):
                    taylor[i] = taylor[i - 1]
                else:
                    taylor[i] = torch.addcmul(taylor[i - 1], taylor[i], t)
            # two columns in one operation would leave the vectorised loop
            is_plane = isinstance(c, Tensor) and taylor[0] is not self.parameters[-1]
            taylor[0] = torch.addcmul(c, taylor[0], t) if is_plane else taylor[0] * t + c
        return tuple(
            torch.zeros_like(t) if isinstance(x, float) else x if i < 2 else math.factorial(i) * x
            for i, x in enumerate(taylor)
        )

    def vjp(self, t: Tensor, weight: Tensor) -> list[Tensor]:
        """The sums over the points of dR/dc weight, for each coefficient c."""
        sums = []
        for _ in self.parameters:
            weight = weight * t
            sums.append(total(weight))
        return sums


class Rational:
    """The radial factor R(t) = N(t) / D(t), both `Polynomial`, defined before the first zero of D."""

    def __init__(self, numerator: Sequence[Tensor], denominator: Sequence[Tensor]):
        self.numerator, self.denominator = Polynomial(numerator), Polynomial(denominator)

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        return *self.numerator.parameters, *self.denominator.parameters

    def __call__(self, t: Tensor) -> Tensor:
        return self.numerator(t) / self.denominator(t)

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """R and its first `order` derivatives by t, from N = R D differentiated by Leibniz' rule."""
        n, d = self.numerator.derivatives(t, order), self.denominator.derivatives(t, order)
        reciprocal = d[0].reciprocal()
        ratio: list[Tensor] = []
        for i in range(order + 1):
            known = sum(math.comb(i, j) * ratio[j] * d[i - j] for j in range(i))
            ratio.append((n[i] - known) * reciprocal)
        return tuple(ratio)

    def vjp(self, t: Tensor, weight: Tensor) -> list[Tensor]:
        """The sums over the points of dR/dc weight, for each coefficient."""
        weight = weight / self.denominator(t)
        above = self.numerator.vjp(t, weight)
        return above + self.denominator.vjp(t, -weight * self(t))


@dataclass
class Planar:
    """m -> m R(t) + (p t + 2 m (p . m)) + (s0 t + s1 t^2, s2 t + s3 t^2), with t = |m|^2.

    radial: the factor R, or None for 1.
    tangential: p = (px, py); the decentering term is the gradient of (p . m) t, so its Jacobian is symmetric.
    prism: (s0, s1, s2, s3), the thin-prism coefficients.
    """

    radial: Polynomial | Rational | None = None
    tangential: Sequence[Tensor] = ()
    prism: Sequence[Tensor] = ()

    @property
    def is_radial(self) -> bool:
        return len(self.tangential) == len(self.prism) == 0

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        """All coefficients, in the order in which `vjp` gives their cotangents."""
        return *(self.radial.parameters if self.radial else ()), *self.tangential, *self.prism

    def at(self, a: Tensor, b: Tensor, order: int = 1, t: Tensor | None = None) -> PlanarAt:
        """The stage at points; see `PlanarAt`."""
        return PlanarAt(self, a, b, order, t)

    def lower_bound(self, radius: Tensor) -> Planes2:
        """A lower bound of the eigenvalues of the Jacobian's symmetric part at that radius, and an upper bound of how
        far from the centre the points go. Where the first is positive, so are the determinant and the trace.
        """
        t = radius * radius
        least, furthest = torch.ones_like(t), radius
        if self.radial:
            factor, slope = self.radial.derivatives(t, 1)
            least, furthest = torch.minimum(factor, factor + 2 * t * slope), radius * factor.abs()
            if isinstance(self.radial, Rational):
                least = torch.minimum(least, self.radial.denominator(t))
        if self.tangential:
            p = torch.hypot(*self.tangential)
            least, furthest = least - 6 * p * radius, furthest + 3 * p * t
        if self.prism:
            s0, s1, s2, s3 = self.prism
            least = least - 2 * radius * torch.hypot(s0 + 2 * t * s1, s2 + 2 * t * s3)
            furthest = furthest + t * torch.hypot(s0 + t * s1, s2 + t * s3)
        return least, furthest

    def start(self, u: Tensor, v: Tensor) -> Planes2:
        """A point near the one that a stage without a radial factor sends to (u, v)."""
        x, y = self.at(u, v, order=0).value
        return 2 * u - x, 2 * v - y


class Tilt:
    """The homography of a sensor tilted by (tau_x, tau_y) radians.

    Source: OpenCV `computeTiltProjectionMatrix`: the plane point is turned by R = R_y(tau_y) R_x(tau_x) and
    projected back along the optical axis. It fixes the origin; OpenCV's R_x, R_y turn clockwise.
    """

    is_radial = False

    def __init__(self, tau_x: Tensor, tau_y: Tensor):
        cx, sx, cy, sy = torch.cos(tau_x), torch.sin(tau_x), torch.cos(tau_y), torch.sin(tau_y)
        self.parameters = (cy, sy * sx, -sy * cx, torch.zeros_like(cx), cx, sx, sy, -cy * sx, cy * cx)

    def at(self, a: Tensor, b: Tensor, order: int = 1, t: Tensor | None = None) -> TiltAt:
        """The stage at points."""
        return TiltAt(self, a, b)

    def lower_bound(self, radius: Tensor) -> Planes2:
        """See `Planar.lower_bound`; here the bound is one of the orientation itself."""
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = self.parameters
        slope = torch.hypot(r20, r21)
        nearest = r22 - slope * radius
        size = torch.maximum(torch.hypot(r00, r10), torch.hypot(r01, r11)) * math.sqrt(2)
        shift = torch.hypot(r02, r12)
        # past the horizon nothing is certain
        seen = r22 * (size * radius + shift) / torch.where(nearest > 0, nearest, torch.nan)
        return torch.minimum(nearest, r22 * (r00 + r11) - slope * seen), seen + shift

    def start(self, u: Tensor, v: Tensor) -> Planes2:
        """The point that is sent to (u, v)."""
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = self.parameters
        x, y = (u + r02) / r22, (v + r12) / r22
        # R's transpose is its inverse
        reciprocal = 1 / (r02 * x + r12 * y + r22)
        return (r00 * x + r10 * y + r20) * reciprocal, (r01 * x + r11 * y + r21) * reciprocal


class Lens:
    """A chain of stages, the first of which sits on the chart's plane; no stages make the identity."""

    def __init__(self, *stages: Planar | Tilt):
        self.stages = stages

    @property
    def is_radial(self) -> bool:
        """Whether the lens is a single radial factor: then its inverse is a matter of one variable."""
        return len(self.stages) == 1 and self.stages[0].is_radial

    @property
    def radial(self) -> Polynomial | Rational | None:
        """The radial factor of the first stage, if it has one."""
        return getattr(self.stages[0], "radial", None)

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        """Those of all stages, in the order in which `vjp` gives their cotangents."""
        return tuple(p for stage in self.stages for p in stage.parameters)

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        return self.at(a, b, order=0).value

    def at(self, a: Tensor, b: Tensor, order: int = 1, t: Tensor | None = None) -> LensAt:
        """The lens at points; order 0 leaves out what derivatives need, t = a^2 + b^2 if it is known."""
        return LensAt(self.stages, a, b, order, t)

    def lower_bound(self, radius: Tensor) -> Tensor:
        """(*B, S) ascending radii: positive where the orientation is positive on the whole circle."""
        bounds = []
        for stage in self.stages:
            least, radius = stage.lower_bound(radius)
            bounds.append(least)
            # the next stage sees what any smaller circle becomes as well
            radius = torch.cummax(radius, -1).values
        return torch.stack(torch.broadcast_tensors(*bounds)).amin(0)

    def start(self, u: Tensor, v: Tensor) -> Planes2:
        """Back from (u, v), nearly, to the stage that has the radial factor."""
        for stage in reversed(self.stages[1:]):
            u, v = stage.start(u, v)
        return u, v
