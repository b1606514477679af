"""Lenses: planar maps close to the identity, as a chain of stages with exact Jacobians.

A stage is built from coefficient planes that broadcast against the points. `Planar` holds everything
that is polynomial or rational in the plane; `Tilt` is the homography of a tilted sensor.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from camtorch.solve import invert_planar, invert_radial

Planes2 = tuple[Tensor, Tensor]
Jacobian = tuple[Tensor, Tensor, Tensor, Tensor]  # du/da, du/db, dv/da, dv/db


class Polynomial:
    """The radial factor R(t) = 1 + c0 t + c1 t^2 + ... of t = radius^2; radius R(t) is the distorted radius."""

    def __init__(self, coefficients: Sequence[Tensor]):
        self.coefficients = coefficients

    def __call__(self, t: Tensor) -> Tensor:
        value = torch.zeros_like(t)
        for c in reversed(self.coefficients):
            value = (value + c) * t
        return value + 1

    def derivatives(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """R, dR/dt and d2R/dt2."""
        value, first, half_second = torch.zeros_like(t), torch.zeros_like(t), torch.zeros_like(t)
        for c in (*reversed(self.coefficients), 1):
            half_second = half_second * t + first
            first = first * t + value
            value = value * t + c
        return value, first, 2 * half_second

    def sense(self, t: Tensor) -> Tensor:
        """Positive where the factor is defined: a polynomial is everywhere."""
        return torch.ones_like(t)


class Rational:
    """The radial factor R(t) = N(t) / D(t), both `Polynomial`, defined before the first zero of D."""

    def __init__(self, numerator: Sequence[Tensor], denominator: Sequence[Tensor]):
        self.numerator, self.denominator = Polynomial(numerator), Polynomial(denominator)

    def __call__(self, t: Tensor) -> Tensor:
        return self.numerator(t) / self.denominator(t)

    def derivatives(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """R, dR/dt and d2R/dt2, from N = R D differentiated twice."""
        n, n1, n2 = self.numerator.derivatives(t)
        d, d1, d2 = self.denominator.derivatives(t)
        value = n / d
        first = (n1 - value * d1) / d
        return value, first, (n2 - 2 * first * d1 - value * d2) / d

    def sense(self, t: Tensor) -> Tensor:
        """Positive before the pole."""
        return self.denominator(t)


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
        return not self.tangential and not self.prism

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        t = a * a + b * b
        factor = self.radial(t) if self.radial else None
        u, v = (a, b) if factor is None else (a * factor, b * factor)
        if self.tangential:
            px, py = self.tangential
            twice_dot = 2 * (px * a + py * b)
            u, v = u + px * t + a * twice_dot, v + py * t + b * twice_dot
        if self.prism:
            s0, s1, s2, s3 = self.prism
            u, v = u + t * (s0 + t * s1), v + t * (s2 + t * s3)
        return u, v

    def jacobian(self, a: Tensor, b: Tensor) -> tuple[Jacobian, Tensor]:
        """The derivatives, and the sense: positive where the map is defined, regular and keeps its orientation."""
        t = a * a + b * b
        defined = None
        if self.radial:
            factor, slope, _ = self.radial.derivatives(t)
            slope = 2 * slope
            ua, ub, vb = factor + slope * a * a, slope * a * b, factor + slope * b * b
            defined = self.radial.sense(t)
        else:
            ua, ub, vb = torch.ones_like(t), torch.zeros_like(t), torch.ones_like(t)
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
        # a turn by half a circle has a positive determinant too: the trace tells it from a regular map
        sense = torch.minimum(ua * vb - ub * va, ua + vb)
        return (ua, ub, va, vb), sense if defined is None else torch.minimum(sense, defined)

    def invert(self, u: Tensor, v: Tensor, radii: Tensor) -> Planes2:
        """Graph-free: the point before the first fold that is sent to (u, v), as near as there is one."""
        a, b = invert_radial(self.radial, radii, u, v) if self.radial else (u, v)
        return (a, b) if self.is_radial else invert_planar(self, u, v, a, b)


class Tilt:
    """The homography of a sensor tilted by (tau_x, tau_y) radians.

    Source: OpenCV `computeTiltProjectionMatrix`: the plane point is turned by R = R_y(tau_y) R_x(tau_x) and
    projected back along the optical axis. It fixes the origin; OpenCV's R_x, R_y turn clockwise.
    """

    is_radial = False

    def __init__(self, tau_x: Tensor, tau_y: Tensor):
        cx, sx, cy, sy = torch.cos(tau_x), torch.sin(tau_x), torch.cos(tau_y), torch.sin(tau_y)
        self.rotation = ((cy, sy * sx, -sy * cx), (torch.zeros_like(cx), cx, sx), (sy, -cy * sx, cy * cx))

    def _projected(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = self.rotation
        reciprocal = 1 / (r20 * a + r21 * b + r22)
        u = r22 * (r00 * a + r01 * b + r02) * reciprocal - r02
        v = r22 * (r10 * a + r11 * b + r12) * reciprocal - r12
        return u, v, reciprocal

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        return self._projected(a, b)[:2]

    def jacobian(self, a: Tensor, b: Tensor) -> tuple[Jacobian, Tensor]:
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = self.rotation
        u, v, reciprocal = self._projected(a, b)
        u, v = u + r02, v + r12
        ua, ub = (r22 * r00 - u * r20) * reciprocal, (r22 * r01 - u * r21) * reciprocal
        va, vb = (r22 * r10 - v * r20) * reciprocal, (r22 * r11 - v * r21) * reciprocal
        return (ua, ub, va, vb), torch.minimum(torch.minimum(ua * vb - ub * va, ua + vb), reciprocal)

    def invert(self, u: Tensor, v: Tensor, radii: Tensor) -> Planes2:
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = self.rotation
        x, y = (u + r02) / r22, (v + r12) / r22
        reciprocal = 1 / (r02 * x + r12 * y + r22)
        return (r00 * x + r10 * y + r20) * reciprocal, (r01 * x + r11 * y + r21) * reciprocal


class Lens:
    """A chain of stages, the first of which sits on the chart's plane; no stages make the identity.

    Only the first stage may have a radial factor: its inverse is tabulated on the chart's radii.
    """

    def __init__(self, *stages: Planar | Tilt):
        self.stages = stages

    @property
    def is_radial(self) -> bool:
        return all(stage.is_radial for stage in self.stages)

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        for stage in self.stages:
            a, b = stage(a, b)
        return a, b

    def jacobian(self, a: Tensor, b: Tensor) -> tuple[Jacobian, Tensor]:
        """Derivatives of the chain, and the smallest sense of its stages."""
        jacobian, sense = self.stages[0].jacobian(a, b)
        for before, stage in zip(self.stages, self.stages[1:], strict=False):
            a, b = before(a, b)
            (ua, ub, va, vb), here = stage.jacobian(a, b)
            pa, pb, qa, qb = jacobian
            jacobian = ua * pa + ub * qa, ua * pb + ub * qb, va * pa + vb * qa, va * pb + vb * qb
            sense = torch.minimum(sense, here)
        return jacobian, sense

    def invert(self, u: Tensor, v: Tensor, radii: Tensor) -> Planes2:
        """Graph-free: the plane point that the lens sends to (u, v), as near as there is one."""
        for stage in reversed(self.stages):
            u, v = stage.invert(u, v, radii)
        return u, v
