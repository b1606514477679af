"""Lenses: planar maps close to the identity, as chains of stages, with their values and derivatives at points.

A stage is built from coefficient columns that broadcast against planes of points. `Planar` holds everything that is
polynomial or rational in the plane; `Tilt` is the homography of a tilted sensor. `stage.at(points)` has the value, the
Jacobian and the orientation, and computes once what they share.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from camtorch.native.structs import HOMOGRAPHY, PLANAR, SHEAR
from camtorch.optics.charts import Planes2, Planes3
from camtorch.optics.derivatives import jacobian_of
from camtorch.optics.radial import RadialFactor

Jacobian = tuple[Tensor, Tensor, Tensor, Tensor]  # du/da, du/db, dv/da, dv/db

_DIRECTIONS = 64  # in which stages without bounds of their own are sampled


def newton_step(jacobian: Jacobian, du: Tensor, dv: Tensor) -> Planes3:
    """Return the step (da, db) that a regular Jacobian maps to (du, dv), and 1 / its determinant.

    If it is singular, the step is some finite one; the reciprocal is 0 then, and outside of the floating-point range.
    """
    ua, ub, va, vb = jacobian
    determinant = torch.addcmul(ua * vb, ub, va, value=-1)
    reciprocal = (determinant + torch.finfo(du.dtype).tiny ** 0.5 / determinant).reciprocal()
    da, db = torch.addcmul(vb * du, ub, dv, value=-1), torch.addcmul(ua * dv, va, du, value=-1)
    return da * reciprocal, db * reciprocal, reciprocal


class StageAt:
    """A stage at points (a, b)."""

    stage: Stage
    a: Tensor
    b: Tensor

    def __init__(self, stage: Stage, a: Tensor, b: Tensor):
        self.stage, self.a, self.b = stage, a, b

    @property
    def value(self) -> Planes2:
        """The images of the points."""
        return self.stage(self.a, self.b)

    @property
    def jacobian(self) -> Jacobian:
        """The derivatives du/da, du/db, dv/da, dv/db, graph-free."""
        # each camera has its own derivatives, also at points that all share
        a, b, *_ = torch.broadcast_tensors(self.a, self.b, *self.stage.parameters)
        return jacobian_of(self.stage, a, b)

    @property
    def margin(self) -> Tensor | None:
        """A margin, positive where the map is defined; None if it is defined everywhere."""
        return None

    @property
    def edge(self) -> Tensor | None:
        """A margin, positive up to where the map ends although its formula goes on; None if it does not end."""
        return None

    @property
    def orientation(self) -> Tensor:
        """A margin, positive where the map is defined, regular and not turned over, whatever `edge` is."""
        (ua, ub, va, vb), margin = self.jacobian, self.margin
        # a turn by half a circle has a positive determinant, too, but a negative trace
        orientation = torch.minimum(torch.addcmul(ua * vb, ub, va, value=-1), ua + vb)
        return orientation if margin is None else torch.minimum(orientation, margin)


class Stage:
    """A planar map (a, b) -> (u, v) that is regular at the centre. A new one states its formula, `__call__`.

    Everything else has defaults, by autograd or from samples, which a fast stage overrides.
    """

    parameters: tuple[Tensor, ...] = ()
    """The learnable parts of the formula: columns that broadcast against planes.

    The formula reads them here, and nothing else depends on the coefficients.
    """
    code: ClassVar[int | None] = None
    """The code in native/structs.py, which a class states for itself, not for subclasses. None: only Python has it."""
    _at: ClassVar[type[StageAt]] = StageAt
    radial: RadialFactor | None = None
    """The factor of a first stage that is tabulated, to start the inverse from."""
    is_radial = False
    """Whether the factor is the whole stage."""
    is_affine = False
    """Whether lines stay lines, and parallels parallel: then Newton's method always finds its inverse."""

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        """Return the images of points."""
        raise NotImplementedError

    def at(self, a: Tensor, b: Tensor, order: int = 1, t: Tensor | None = None) -> StageAt:
        """Return the stage at points; order 0 leaves out parts for derivatives; t = a^2 + b^2 if it is known."""
        return self._at(self, a, b)

    def lower_bound(self, radius: Tensor) -> Planes2:
        """Return bounds on circles of ascending radii (*C, S): of the orientation, and of the distance.

        The first is positive if the orientation is certainly positive on the whole circle; the second is how far from
        the centre its points go at most. By default both are read off points of the circle, with what they may miss.
        """
        turn = torch.arange(_DIRECTIONS, dtype=radius.dtype, device=radius.device) * (2 * math.pi / _DIRECTIONS)
        a, b = ((radius.unsqueeze(-1) * c).flatten(-2) for c in (torch.cos(turn), torch.sin(turn)))
        at = self.at(a, b)
        shape = (radius.shape[-1], _DIRECTIONS)
        orientation, distance = at.orientation.unflatten(-1, shape), torch.hypot(*at.value).unflatten(-1, shape)
        least, furthest = orientation.amin(-1), distance.amax(-1)
        missed = (orientation - orientation.roll(1, -1)).abs().amax(-1)
        return least - missed / 2, furthest + (distance - distance.roll(1, -1)).abs().amax(-1) / 2

    def start(self, u: Tensor, v: Tensor) -> Planes2:
        """Return a point near the one whose image is (u, v), to start the search for it."""
        a, b = u, v
        for _ in range(2):
            at = self.at(a, b)
            x, y = at.value
            da, db, _ = newton_step(at.jacobian, u - x, v - y)
            a, b = a + da, b + db
        return a, b


@dataclass
class Planar(Stage):
    """m -> m R(t) + (p t + 2 m (p . m)) + (s0 t + s1 t^2, s2 t + s3 t^2), with t = |m|^2.

    radial: the factor R, or None for 1.
    tangential: p = (px, py); the decentering term is the gradient of (p . m) t, so its Jacobian is symmetric.
    prism: (s0, s1, s2, s3), the thin-prism coefficients.
    """

    code: ClassVar[int | None] = PLANAR

    radial: RadialFactor | None = None
    tangential: Sequence[Tensor] = ()
    prism: Sequence[Tensor] = ()
    is_radial: bool = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.is_radial = len(self.tangential) == len(self.prism) == 0
        of_radial = self.radial.parameters if self.radial else ()
        self.parameters: tuple[Tensor, ...] = (*of_radial, *self.tangential, *self.prism)

    def at(self, a: Tensor, b: Tensor, order: int = 1, t: Tensor | None = None) -> PlanarAt:
        return PlanarAt(self, a, b, order, t)

    def lower_bound(self, radius: Tensor) -> Planes2:
        """Return a lower bound of the eigenvalues of the Jacobian's symmetric part at a radius, and an upper bound of
        the points' distance from the centre. If the first is positive, so are the determinant and the trace.
        """
        t = radius * radius
        least, furthest = torch.ones_like(t), radius
        if self.radial:
            least, furthest = self.radial.orientation(radius), radius * self.radial(t).abs()
        if self.tangential:
            p = torch.hypot(*self.tangential)
            least, furthest = least - 6 * p * radius, furthest + 3 * p * t
        if self.prism:
            s0, s1, s2, s3 = self.prism
            least = least - 2 * radius * torch.hypot(s0 + 2 * t * s1, s2 + 2 * t * s3)
            furthest = furthest + t * torch.hypot(s0 + t * s1, s2 + t * s3)
        return least, furthest

    def start(self, u: Tensor, v: Tensor) -> Planes2:
        """Return a point near the one whose image by a stage without a radial factor is (u, v)."""
        x, y = self.at(u, v, order=0).value
        return 2 * u - x, 2 * v - y


class PlanarAt(StageAt):
    """A `Planar` stage at points m = (a, b)."""

    stage: Planar

    def __init__(self, stage: Planar, a: Tensor, b: Tensor, order: int, t: Tensor | None):
        """Prepare what the properties share: derivatives if order is 1; t is |m|^2, if it is known."""
        self.stage, self.a, self.b = stage, a, b
        self.t = torch.addcmul(a * a, b, b) if t is None else t
        if stage.radial:
            self.factor, *slope = stage.radial.derivatives(self.t, order)
            if order:
                self.slope = slope[0]
        if stage.tangential:
            px, py = stage.tangential
            self.twice_dot = torch.addcmul(a * (2 * px), b, 2 * py)

    @property
    def value(self) -> Planes2:
        stage, a, b, t = self.stage, self.a, self.b, self.t
        u, v = (a * self.factor, b * self.factor) if stage.radial else (a, b)
        even: Sequence[Any] = (0, 0)  # the factors of t
        if stage.tangential:
            u, v = torch.addcmul(u, a, self.twice_dot), torch.addcmul(v, b, self.twice_dot)
            even = stage.tangential
        if stage.prism:
            s0, s1, s2, s3 = stage.prism
            even = (even[0] + s0) + s1 * t, (even[1] + s2) + s3 * t
        if stage.tangential or stage.prism:
            u, v = torch.addcmul(u, even[0], t), torch.addcmul(v, even[1], t)
        return u, v

    @property
    def jacobian(self) -> Jacobian:
        stage, a, b, t = self.stage, self.a, self.b, self.t
        if stage.radial:
            twice = 2 * self.slope
            along_a, along_b = twice * a, twice * b
            ua, vb = torch.addcmul(self.factor, along_a, a), torch.addcmul(self.factor, along_b, b)
            ub = va = along_a * b
        else:
            ua = vb = torch.ones_like(t)
            ub = va = torch.zeros_like(t)
        if stage.tangential:
            px, py = stage.tangential
            px, py = 2 * px, 2 * py
            # the decentering term is the gradient of (p . m) t, so its Jacobian is symmetric
            ua = torch.addcmul(ua + self.twice_dot, a, 2 * px)
            vb = torch.addcmul(vb + self.twice_dot, b, 2 * py)
            ub = va = torch.addcmul(torch.addcmul(ub, b, px), a, py)
        if stage.prism:
            s0, s1, s2, s3 = stage.prism
            gx, gy = (4 * s1) * t + 2 * s0, (4 * s3) * t + 2 * s2
            ua, ub = torch.addcmul(ua, gx, a), torch.addcmul(ub, gx, b)
            va, vb = torch.addcmul(va, gy, a), torch.addcmul(vb, gy, b)
        return ua, ub, va, vb

    @property
    def margin(self) -> Tensor | None:
        return self.stage.radial.margin(self.t) if self.stage.radial else None


class HomographyAt(StageAt):
    """A `Homography` at points."""

    def __init__(self, stage: Homography, a: Tensor, b: Tensor):
        super().__init__(stage, a, b)
        h00, h01, h02, h10, h11, h12, h20, h21, h22 = stage.parameters
        self.depth = h20 * a + h21 * b + h22
        self.reciprocal = 1 / self.depth
        self.u, self.v = self.reciprocal * (h00 * a + h01 * b + h02), self.reciprocal * (h10 * a + h11 * b + h12)

    @property
    def value(self) -> Planes2:
        return self.u, self.v

    @property
    def jacobian(self) -> Jacobian:
        h00, h01, _, h10, h11, _, h20, h21, _ = self.stage.parameters
        u, v, one = self.u, self.v, self.reciprocal
        return (h00 - u * h20) * one, (h01 - u * h21) * one, (h10 - v * h20) * one, (h11 - v * h21) * one

    @property
    def margin(self) -> Tensor:
        # positive before the horizon
        return self.depth


class Homography(Stage):
    """The projective map of a matrix, given row by row: (a, b, 1) becomes (x, y, w), and the point x / w, y / w."""

    code: ClassVar[int | None] = HOMOGRAPHY
    _at = HomographyAt

    def __init__(self, *matrix: Tensor):
        self.parameters: tuple[Tensor, ...] = matrix

    def lower_bound(self, radius: Tensor) -> Planes2:
        """Return the bounds of `Planar.lower_bound`, but the first one of the orientation itself."""
        h00, h01, h02, h10, h11, h12, h20, h21, h22 = self.parameters
        slope = torch.hypot(h20, h21)
        nearest = h22 - slope * radius
        size = torch.maximum(torch.hypot(h00, h10), torch.hypot(h01, h11)) * math.sqrt(2)
        # nothing is certain past the horizon
        seen = (size * radius + torch.hypot(h02, h12)) / torch.where(nearest > 0, nearest, torch.nan)
        minors = self._adjugate()
        turned = h20 * minors[2] + h21 * minors[5] + h22 * minors[8]
        return torch.minimum(torch.minimum(nearest, turned), h00 + h11 - slope * seen), seen

    def start(self, u: Tensor, v: Tensor) -> Planes2:
        """Return the point whose image is (u, v)."""
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = self._adjugate()
        reciprocal = 1 / (r20 * u + r21 * v + r22)
        return (r00 * u + r01 * v + r02) * reciprocal, (r10 * u + r11 * v + r12) * reciprocal

    def _adjugate(self) -> tuple[Tensor, ...]:
        h00, h01, h02, h10, h11, h12, h20, h21, h22 = self.parameters
        return (
            *(h11 * h22 - h12 * h21, h02 * h21 - h01 * h22, h01 * h12 - h02 * h11),
            *(h12 * h20 - h10 * h22, h00 * h22 - h02 * h20, h02 * h10 - h00 * h12),
            *(h10 * h21 - h11 * h20, h01 * h20 - h00 * h21, h00 * h11 - h01 * h10),
        )


class Tilt(Homography):
    """The homography of a sensor tilted by (tau_x, tau_y) radians.

    Source: OpenCV `computeTiltProjectionMatrix`: the plane point is turned by R = R_y(tau_y) R_x(tau_x) and projected
    back along the optical axis, [[R22, 0, -R02], [0, R22, -R12], [0, 0, 1]] R; OpenCV's R_x, R_y turn clockwise.
    """

    code: ClassVar[int | None] = HOMOGRAPHY

    def __init__(self, tau_x: Tensor, tau_y: Tensor):
        cx, sx, cy, sy = torch.cos(tau_x), torch.sin(tau_x), torch.cos(tau_y), torch.sin(tau_y)
        zero = torch.zeros_like(cx)
        super().__init__(cx, zero, zero, -sx * sy, cy, zero, sy, -cy * sx, cy * cx)


class ShearAt(StageAt):
    """A `Shear` at points."""

    @property
    def jacobian(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        d, e = (w + torch.zeros_like(self.a) for w in self.stage.parameters)
        return torch.ones_like(d), e, d, torch.ones_like(e)


class Shear(Stage):
    """(x + e y, d x + y): a sensor that is not aligned with the lens."""

    code: ClassVar[int | None] = SHEAR
    _at = ShearAt
    is_affine = True

    def __init__(self, d: Tensor, e: Tensor):
        self.parameters: tuple[Tensor, ...] = (d, e)

    def __call__(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        d, e = self.parameters
        return a + e * b, b + d * a

    def lower_bound(self, radius: Tensor) -> tuple[Tensor, Tensor]:
        d, e = self.parameters
        # the eigenvalues of the symmetric part are 1 + (d + e) / 2 and 1 - (d + e) / 2
        return (1 - (d + e).abs() / 2).expand_as(radius), radius * (1 + torch.maximum(d.abs(), e.abs()))

    def start(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        d, e = self.parameters
        return (u - e * v) / (1 - d * e), (v - d * u) / (1 - d * e)


class Lens:
    """A chain of stages, the first of which sits on the chart's plane; no stages make the identity."""

    is_radial: bool
    radial: RadialFactor | None
    rest: Lens | None

    def __init__(self, *stages: Stage):
        self.stages = stages
        self.is_radial = len(stages) == 1 and stages[0].is_radial
        """Whether the lens is a single radial factor, so that its inverse has one variable."""
        self.radial = stages[0].radial if stages else None
        """The radial factor of the first stage, if it has one."""
        self.rest = Lens(*stages[1:]) if self.radial and stages[0].is_radial and len(stages) > 1 else None
        """The stages after a first one that is a radial factor alone, if there are such."""

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        """The parameters of all stages."""
        return tuple(p for stage in self.stages for p in stage.parameters)

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        return self.at(a, b, order=0).value

    def at(self, a: Tensor, b: Tensor, order: int = 1, t: Tensor | None = None) -> LensAt:
        """Return the lens at points; order 0 leaves out parts for derivatives; t = a^2 + b^2 if it is known."""
        return LensAt(self.stages, a, b, order, t)

    def lower_bound(self, radius: Tensor) -> Planes2:
        """Return the bounds of `Stage.lower_bound` for ascending radii (*B, S): positive if the orientation is positive
        on the whole circle, and how far from the centre its points go at most.
        """
        bounds = []
        for stage in self.stages:
            least, radius = stage.lower_bound(radius)
            bounds.append(least)
            # the next stage also sees the images of all smaller circles
            radius = radius.cummax(-1).values
        return torch.stack(torch.broadcast_tensors(*bounds)).amin(0), radius

    def start(self, u: Tensor, v: Tensor) -> Planes2:
        """Return a point near the one whose image is (u, v), at the stage with a radial factor, or the first one."""
        for stage in reversed(self.stages if self.radial is None else self.stages[1:]):
            u, v = stage.start(u, v)
        return u, v


class LensAt:
    """A chain of stages at points."""

    def __init__(self, stages: Sequence[Stage], a: Tensor, b: Tensor, order: int, t: Tensor | None):
        self.stages: list[StageAt] = []
        self.value = a, b
        for stage in stages:
            here = stage.at(*self.value, order, None if self.stages else t)
            self.stages.append(here)
            self.value = here.value

    @property
    def jacobian(self) -> Jacobian:
        """The Jacobian of the whole chain."""
        chained = self.stages[0].jacobian
        for stage in self.stages[1:]:
            ua, ub, va, vb = stage.jacobian
            pa, pb, qa, qb = chained
            chained = ua * pa + ub * qa, ua * pb + ub * qb, va * pa + vb * qa, va * pb + vb * qb
        return chained

    @property
    def margin(self) -> Tensor | None:
        """The least margin of the stages: positive where the lens is defined; None if it is defined everywhere."""
        return _least(stage.margin for stage in self.stages)

    @property
    def edge(self) -> Tensor | None:
        """The least edge of the stages: positive up to where the lens ends; None if it does not."""
        return _least(stage.edge for stage in self.stages)

    @property
    def orientation(self) -> Tensor:
        """The least orientation of the stages: positive where the lens is defined, regular and not turned over."""
        return functools.reduce(torch.minimum, [stage.orientation for stage in self.stages])


def _least(margins: Iterable[Tensor | None]) -> Tensor | None:
    """Return the least of the margins that are not None, or None."""
    known = [margin for margin in margins if margin is not None]
    return functools.reduce(torch.minimum, known) if known else None
