"""Lenses: planar maps close to the identity, as a chain of stages with exact derivatives.

A stage is built from coefficient columns that broadcast against planes of points. `Planar` holds everything that is
polynomial or rational in the plane; `Tilt` is the homography of a tilted sensor. Both know their Jacobian, how a
cotangent passes back through them, and how far out they are certainly regular.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

Planes2 = tuple[Tensor, Tensor]
Jacobian = tuple[Tensor, Tensor, Tensor, Tensor]  # du/da, du/db, dv/da, dv/db


def _total(plane: Tensor) -> Tensor:
    return plane.sum(-1, keepdim=True)


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
            taylor[0] = taylor[0] * t + c
        return tuple(
            torch.zeros_like(t) if isinstance(x, float) else x if i < 2 else math.factorial(i) * x
            for i, x in enumerate(taylor)
        )

    def pull(self, t: Tensor, weight: Tensor) -> list[Tensor]:
        """The sums over the points of dR/dc weight, for each coefficient."""
        sums = []
        for _ in self.parameters:
            weight = weight * t
            sums.append(_total(weight))
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

    def pull(self, t: Tensor, weight: Tensor) -> list[Tensor]:
        """The sums over the points of dR/dc weight, for each coefficient."""
        weight = weight / self.denominator(t)
        above = self.numerator.pull(t, weight)
        return above + self.denominator.pull(t, -weight * self(t))


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
        """All coefficients, in the order in which `pull` gives their cotangents."""
        return *(self.radial.parameters if self.radial else ()), *self.tangential, *self.prism

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        t = a * a + b * b
        return self._value(a, b, t, self.radial(t) if self.radial else None)

    def _value(self, a: Tensor, b: Tensor, t: Tensor, factor: Tensor | None) -> Planes2:
        u, v = (a, b) if factor is None else (a * factor, b * factor)
        if self.tangential:
            px, py = self.tangential
            twice_dot = torch.addcmul(a * (2 * px), b, 2 * py)
            u, v = torch.addcmul(u, a, twice_dot), torch.addcmul(v, b, twice_dot)
        for i, w in enumerate((u, v)):
            even = [self.tangential[i]] if self.tangential else []
            if self.prism:
                even = [self.prism[2 * i] + sum(even), self.prism[2 * i + 1]]
            if even:
                w = torch.addcmul(w, t, even[0] if len(even) == 1 else even[1] * t + even[0])
            u, v = (w, v) if i == 0 else (u, w)
        return u, v

    def linearise(self, a: Tensor, b: Tensor) -> tuple[Planes2, Jacobian]:
        """The value and its derivatives."""
        t = a * a + b * b
        if self.radial:
            factor, slope = self.radial.derivatives(t, 1)
            twice = 2 * slope
            along_a, along_b = twice * a, twice * b
            ua, ub, vb = torch.addcmul(factor, along_a, a), along_a * b, torch.addcmul(factor, along_b, b)
        else:
            factor, ub = None, torch.zeros_like(t)
            ua = vb = torch.ones_like(t)
        va = ub
        if self.tangential:
            px, py = (2 * p for p in self.tangential)
            along_x, along_y = px * a, py * b
            both = along_x + along_y
            ua, vb = torch.add(ua + both, along_x, alpha=2), torch.add(vb + both, along_y, alpha=2)
            ub = va = torch.addcmul(torch.addcmul(ub, b, px), a, py)
        if self.prism:
            s0, s1, s2, s3 = self.prism
            gx, gy = (4 * s1) * t + 2 * s0, (4 * s3) * t + 2 * s2
            ua, ub = torch.addcmul(ua, gx, a), torch.addcmul(ub, gx, b)
            va, vb = torch.addcmul(va, gy, a), torch.addcmul(vb, gy, b)
        return self._value(a, b, t, factor), (ua, ub, va, vb)

    def sense(self, a: Tensor, b: Tensor, jacobian: Jacobian) -> Tensor:
        """Positive where the map is defined, regular and not turned over, given its Jacobian there."""
        sense = _sense(*jacobian)
        if isinstance(self.radial, Rational):
            sense = torch.minimum(sense, self.radial.denominator(a * a + b * b))
        return sense

    def pull(self, a: Tensor, b: Tensor, gu: Tensor, gv: Tensor) -> list[Tensor]:
        """The cotangents of the parameters, summed over the points, of the cotangents gu, gv of the value."""
        t = a * a + b * b
        along = torch.addcmul(gu * a, gv, b)
        sums = self.radial.pull(t, along) if self.radial else []
        if self.tangential or self.prism:
            gu, gv = gu * t, gv * t
            even = _total(gu), _total(gv)
        if self.tangential:
            sums += [even[0] + 2 * _total(along * a), even[1] + 2 * _total(along * b)]
        if self.prism:
            sums += [even[0], _total(gu * t), even[1], _total(gv * t)]
        return sums

    def certify(self, radius: Tensor) -> Planes2:
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
        x, y = self(u, v)
        return 2 * u - x, 2 * v - y


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
        self.parameters = (cy, sy * sx, -sy * cx, torch.zeros_like(cx), cx, sx, sy, -cy * sx, cy * cx)

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        _, _, r02, _, _, r12, _, _, _ = self.parameters
        u, v, _ = self._seen(a, b)
        return u - r02, v - r12

    def _seen(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = self.parameters
        reciprocal = 1 / (r20 * a + r21 * b + r22)
        scale = r22 * reciprocal
        return scale * (r00 * a + r01 * b + r02), scale * (r10 * a + r11 * b + r12), reciprocal

    def linearise(self, a: Tensor, b: Tensor) -> tuple[Planes2, Jacobian]:
        """The value and its derivatives."""
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = self.parameters
        u, v, reciprocal = self._seen(a, b)
        ua, ub = (r22 * r00 - u * r20) * reciprocal, (r22 * r01 - u * r21) * reciprocal
        va, vb = (r22 * r10 - v * r20) * reciprocal, (r22 * r11 - v * r21) * reciprocal
        return (u - r02, v - r12), (ua, ub, va, vb)

    def sense(self, a: Tensor, b: Tensor, jacobian: Jacobian) -> Tensor:
        """Positive where the map is defined, regular and not turned over, given its Jacobian there."""
        *_, r20, r21, r22 = self.parameters
        return torch.minimum(_sense(*jacobian), r20 * a + r21 * b + r22)

    def pull(self, a: Tensor, b: Tensor, gu: Tensor, gv: Tensor) -> list[Tensor]:
        """The cotangents of the nine entries of R, summed over the points."""
        *_, r22 = self.parameters
        u, v, reciprocal = self._seen(a, b)
        gx, gy = gu * reciprocal, gv * reciprocal
        depth = -(gx * u + gy * v)
        sums = [_total(w * c) for w in (r22 * gx, r22 * gy, depth) for c in (a, b, torch.ones_like(a))]
        sums[2], sums[5] = sums[2] - _total(gu), sums[5] - _total(gv)
        sums[8] = sums[8] + _total(gu * u + gv * v) / r22
        return sums

    def certify(self, radius: Tensor) -> Planes2:
        """See `Planar.certify`; here the bound is one of the sense itself."""
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
        """Those of all stages, in the order in which `pull` gives their cotangents."""
        return tuple(p for stage in self.stages for p in stage.parameters)

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        for stage in self.stages:
            a, b = stage(a, b)
        return a, b

    def trace(self, a: Tensor, b: Tensor) -> Trace:
        """The lens at one point, with all its stages' derivatives."""
        return Trace(self.stages, a, b)

    def linearise(self, a: Tensor, b: Tensor) -> tuple[Planes2, Jacobian]:
        """The value and the derivatives of the chain."""
        trace = self.trace(a, b)
        return trace.value, trace.jacobian

    def sense(self, a: Tensor, b: Tensor) -> Tensor:
        """The smallest sense of the stages: positive where the lens is defined, regular and not turned over."""
        senses = [stage.sense(*point, jacobian) for stage, point, jacobian in self.trace(a, b).steps]
        return torch.stack(senses).amin(0) if len(senses) > 1 else senses[0]

    def certify(self, radius: Tensor) -> Tensor:
        """(*B, S) ascending radii: positive where the sense is positive on the whole circle."""
        bounds = []
        for stage in self.stages:
            least, radius = stage.certify(radius)
            bounds.append(least)
            # the next stage sees what any smaller circle becomes as well
            radius = torch.cummax(radius, -1).values
        return torch.stack(torch.broadcast_tensors(*bounds)).amin(0)

    def start(self, u: Tensor, v: Tensor) -> Planes2:
        """Back from (u, v), nearly, to the stage that has the radial factor."""
        for stage in reversed(self.stages[1:]):
            u, v = stage.start(u, v)
        return u, v


class Trace:
    """The stages of a lens at one point: each with the point that reaches it, and its Jacobian there."""

    def __init__(self, stages: Sequence[Planar | Tilt], a: Tensor, b: Tensor):
        self.steps: list[tuple[Planar | Tilt, Planes2, Jacobian]] = []
        self.value = a, b
        for stage in stages:
            point = self.value
            self.value, jacobian = stage.linearise(*point)
            self.steps.append((stage, point, jacobian))

    @property
    def jacobian(self) -> Jacobian:
        """Of the whole chain."""
        chained = self.steps[0][2]
        for _, _, (ua, ub, va, vb) in self.steps[1:]:
            pa, pb, qa, qb = chained
            chained = ua * pa + ub * qa, ua * pb + ub * qb, va * pa + vb * qa, va * pb + vb * qb
        return chained

    def pull(self, gu: Tensor, gv: Tensor, want_parameters: bool = True) -> tuple[Planes2, list[Tensor]]:
        """The cotangents of the point and of the parameters, these summed over the points."""
        sums: list[Tensor] = []
        for stage, point, (ua, ub, va, vb) in reversed(self.steps):
            if want_parameters:
                sums = stage.pull(*point, gu, gv) + sums
            gu, gv = torch.addcmul(ua * gu, va, gv), torch.addcmul(ub * gu, vb, gv)
        return (gu, gv), sums
