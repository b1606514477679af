"""Lenses: planar maps close to the identity, as a chain of stages with exact Jacobians.

A stage is built from coefficient planes that broadcast against the points. `Planar` holds everything
that is polynomial or rational in the plane; `Tilt` is the homography of a tilted sensor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

Planes2 = tuple[Tensor, Tensor]
Jacobian = tuple[Tensor, Tensor, Tensor, Tensor]  # du/da, du/db, dv/da, dv/db
Linear = tuple[Planes2, Jacobian, Tensor]


class Polynomial:
    """The radial factor R(t) = 1 + c0 t + c1 t^2 + ... of t = radius^2; radius R(t) is the distorted radius."""

    def __init__(self, coefficients: Sequence[Tensor]):
        self.coefficients = coefficients

    def __call__(self, t: Tensor) -> Tensor:
        return self.derivatives(t, 0)[0]

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """R and its first `order` derivatives by t: Horner's scheme, extended to the Taylor coefficients at t."""
        # a zero stays a number until it is none: no work for what the highest powers do not have
        taylor = [self.coefficients[-1]] + [0.0] * order
        for c in (*reversed(self.coefficients[:-1]), 1.0):
            for i in range(order, 0, -1):
                taylor[i] = taylor[i - 1] if isinstance(taylor[i], float) else taylor[i] * t + taylor[i - 1]
            taylor[0] = taylor[0] * t + c
        return tuple(
            torch.zeros_like(t) if isinstance(x, float) else math.factorial(i) * x for i, x in enumerate(taylor)
        )


class Rational:
    """The radial factor R(t) = N(t) / D(t), both `Polynomial`, defined before the first zero of D."""

    def __init__(self, numerator: Sequence[Tensor], denominator: Sequence[Tensor]):
        self.numerator, self.denominator = Polynomial(numerator), Polynomial(denominator)

    def __call__(self, t: Tensor) -> Tensor:
        return self.numerator(t) / self.denominator(t)

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """R and its first `order` derivatives by t, from N = R D differentiated by Leibniz' rule."""
        n, d = self.numerator.derivatives(t, order), self.denominator.derivatives(t, order)
        ratio: list[Tensor] = []
        for i in range(order + 1):
            known = sum(math.comb(i, j) * ratio[j] * d[i - j] for j in range(i))
            ratio.append((n[i] - known) / d[0])
        return tuple(ratio)


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

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        t = a * a + b * b
        factor = self.radial(t) if self.radial else 1.0
        return self._value(a, b, t, factor)

    def _value(self, a: Tensor, b: Tensor, t: Tensor, factor: Tensor | float) -> Planes2:
        u, v = a * factor, b * factor
        if self.tangential:
            px, py = self.tangential
            twice_dot = 2 * (px * a + py * b)
            u, v = u + px * t + a * twice_dot, v + py * t + b * twice_dot
        if self.prism:
            s0, s1, s2, s3 = self.prism
            u, v = u + t * (s0 + t * s1), v + t * (s2 + t * s3)
        return u, v

    def linearise(self, a: Tensor, b: Tensor) -> Linear:
        """The value, its derivatives, and the sense: positive where the map is defined, regular and not turned over."""
        t = a * a + b * b
        factor, slope = self.radial.derivatives(t, 1) if self.radial else (torch.ones_like(t), torch.zeros_like(t))
        ua, ub, vb = factor + 2 * slope * a * a, 2 * slope * a * b, factor + 2 * slope * b * b
        va = ub
        if self.tangential:
            px, py = self.tangential
            along_x, along_y = 2 * px * a, 2 * py * b
            cross = 2 * (px * b + py * a)
            ua, ub, va, vb = ua + 3 * along_x + along_y, ub + cross, va + cross, vb + along_x + 3 * along_y
        if self.prism:
            s0, s1, s2, s3 = self.prism
            gx, gy = 2 * (s0 + 2 * t * s1), 2 * (s2 + 2 * t * s3)
            ua, ub, va, vb = ua + gx * a, ub + gx * b, va + gy * a, vb + gy * b
        sense = _sense(ua, ub, va, vb)
        if isinstance(self.radial, Rational):
            sense = torch.minimum(sense, self.radial.denominator(t))
        return self._value(a, b, t, factor), (ua, ub, va, vb), sense


def _sense(ua: Tensor, ub: Tensor, va: Tensor, vb: Tensor) -> Tensor:
    # a turn by half a circle has a positive determinant too: the trace tells it from a regular map
    return torch.minimum(ua * vb - ub * va, ua + vb)


class Tilt:
    """The homography of a sensor tilted by (tau_x, tau_y) radians.

    Source: OpenCV `computeTiltProjectionMatrix`: the plane point is turned by R = R_y(tau_y) R_x(tau_x) and
    projected back along the optical axis. It fixes the origin; OpenCV's R_x, R_y turn clockwise.
    """

    is_radial = False

    def __init__(self, tau_x: Tensor, tau_y: Tensor):
        cx, sx, cy, sy = torch.cos(tau_x), torch.sin(tau_x), torch.cos(tau_y), torch.sin(tau_y)
        self.rotation = ((cy, sy * sx, -sy * cx), (torch.zeros_like(cx), cx, sx), (sy, -cy * sx, cy * cx))

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        return self.linearise(a, b)[0]

    def linearise(self, a: Tensor, b: Tensor) -> Linear:
        """The value, its derivatives, and the sense."""
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = self.rotation
        reciprocal = 1 / (r20 * a + r21 * b + r22)
        u = r22 * (r00 * a + r01 * b + r02) * reciprocal
        v = r22 * (r10 * a + r11 * b + r12) * reciprocal
        ua, ub = (r22 * r00 - u * r20) * reciprocal, (r22 * r01 - u * r21) * reciprocal
        va, vb = (r22 * r10 - v * r20) * reciprocal, (r22 * r11 - v * r21) * reciprocal
        return (u - r02, v - r12), (ua, ub, va, vb), torch.minimum(_sense(ua, ub, va, vb), reciprocal)


class Lens:
    """A chain of stages, the first of which sits on the chart's plane; no stages make the identity."""

    def __init__(self, *stages: Planar | Tilt):
        self.stages = stages

    @property
    def is_radial(self) -> bool:
        """Whether the lens is a single radial factor: then its inverse is a matter of one variable."""
        return len(self.stages) == 1 and self.stages[0].is_radial

    def radial_part(self) -> Lens | None:
        """The lens of the first stage's radial factor alone, if it has one."""
        first = self.stages[0]
        return Lens(Planar(first.radial)) if isinstance(first, Planar) and first.radial else None

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        for stage in self.stages:
            a, b = stage(a, b)
        return a, b

    def linearise(self, a: Tensor, b: Tensor) -> Linear:
        """The value and the derivatives of the chain, and the smallest sense of its stages."""
        value, jacobian, sense = self.stages[0].linearise(a, b)
        for stage in self.stages[1:]:
            value, (ua, ub, va, vb), here = stage.linearise(*value)
            pa, pb, qa, qb = jacobian
            jacobian = ua * pa + ub * qa, ua * pb + ub * qb, va * pa + vb * qa, va * pb + vb * qb
            sense = torch.minimum(sense, here)
        return value, jacobian, sense
