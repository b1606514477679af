"""The inverse of a lens for the few points that a table and a few steps leave open: brackets and damped steps.

`search` chooses a way, see `domain.InverseBy`. By radius and by stages the domain is a circle, and the solution is
bracketed; in the plane, secants find a start for damped steps. `_Search` then checks where a solution's ray is seen.
Each point has a `camera`, an index. A lens sends (a, b), of the chart's plane, to (u, v): its first stage to (p, q),
and the later stages that to (u, v).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from camtorch.evaluate.export import repeat, times
from camtorch.optics.charts import Planes2
from camtorch.optics.lens import newton_step
from camtorch.optics.radial_inverse import bracketed
from camtorch.projection.domain import regular
from camtorch.projection.fold import azimuth
from camtorch.values.arguments import present

if TYPE_CHECKING:
    from camtorch.projection.domain import Domain

Searched = tuple[Tensor, Tensor, Tensor]

_CLOSE_SHARE = 0.02  # of a point's distance from the centre: a start whose image is as near to it will do
_SLOWEST_TURN = 0.05  # radians that an image turns by, for each by which its point turns: the least that secants assume
_LEAST_PART = 1e-4  # of a step of Newton's method: shorter parts of it are not tried
_STAGE_STEPS = 12  # the first ones may take off no more than a third, see `domain._LEAST_SLOPE`
_FIRST_STEPS = 6  # of all points
_LATE_STEPS = 54  # of the few that are left: next to a fold, or so far out that a prism dominates


def search(domain: Domain, camera: Tensor, u: Tensor, v: Tensor) -> Searched:
    """Return points (M,) in the domain that the lens of a `camera` (M,) sends to (u, v), and whether there are any."""
    by = domain.inverse_by
    if by == "radius":
        return _Search(domain, camera)(u, v)
    if domain.is_constant:
        return _search_exported(domain, camera, u, v)
    if by == "stages":
        return _by_stages(domain, camera, u, v)
    if by == "plane":
        return _within_extents(domain, camera, u, v)
    stagewise = domain.stagewise[camera, 0]
    found = _find_chosen(stagewise, u, lambda some: _by_stages(domain, camera[some], u[some], v[some]))
    return _find_chosen(~stagewise, u, lambda some: _within_extents(domain, camera[some], u[some], v[some]), found)


def _search_exported(domain: Domain, camera: Tensor, u: Tensor, v: Tensor) -> Searched:
    """Run `search` for all points in the ways that cameras need, as a part of an exported program."""

    def by_stages() -> Searched:
        first, reached = _invert_later_stages(domain, camera, u, v)
        a, b, found = _Search(domain, camera, is_circle=True)(u, v, first)
        return a, b, found & reached

    def in_plane() -> Searched:
        within = (u * u + v * v).sqrt() <= domain.extent.furthest[camera, azimuth(u, v)]
        a, b, found = _Search(domain, camera, within=within)(u, v)
        return a, b, found & within

    if domain.inverse_by == "stages":
        return by_stages()
    if domain.inverse_by == "plane":
        return in_plane()
    stagewise, staged, planar = domain.stagewise[camera, 0], by_stages(), in_plane()
    a, b = (torch.where(stagewise, *pair) for pair in zip(staged[:2], planar[:2], strict=True))
    return a, b, (stagewise & staged[2]) | (~stagewise & planar[2])  # ONNX Runtime cannot select bools


def _by_stages(domain: Domain, camera: Tensor, u: Tensor, v: Tensor) -> Searched:
    """Run `search` if only the first stage, a radial one, has a limit: the point that it must reach decides."""
    (p, q), reached = _invert_later_stages(domain, camera, u, v)
    alone = partial(_Search, domain, is_circle=True)
    return _find_chosen(reached, u, lambda some: alone(camera[some])(u[some], v[some], (p[some], q[some])))


def _invert_later_stages(domain: Domain, camera: Tensor, u: Tensor, v: Tensor) -> tuple[Planes2, Tensor]:
    """Return the points (p, q) that the later stages send to (u, v), and whether the first one reaches them."""
    rest, table = present(domain.optics_of(camera)[1].rest, "a later stage"), present(domain.inverse, "a table")
    p, q = rest.start(u, v)
    for _ in range(_STAGE_STEPS):
        at = rest.at(p, q)
        x, y = at.value
        dp, dq, _ = newton_step(at.jacobian, u - x, v - y)
        p, q = p + dp, q + dq
    most2 = times(table.most2[camera, 0], 1 + 64 * torch.finfo(u.dtype).eps)
    return (p, q), (u * u + v * v <= domain.image_circle_sq[camera, 0]) & (p * p + q * q <= most2)


def _within_extents(domain: Domain, camera: Tensor, u: Tensor, v: Tensor) -> Searched:
    """Run `search` for any other lens, for the points within the extent of what it shows."""
    within = torch.hypot(u, v) <= domain.extent.furthest[camera, azimuth(u, v)]
    return _find_chosen(within, u, lambda some: _Search(domain, camera[some])(u[some], v[some]))


def _find_chosen(
    chosen: Tensor, like: Tensor, find: Callable[[Tensor], Searched], into: Searched | None = None
) -> Searched:
    """Return the results of `find` for the indices of the chosen points; for others zeros, or those of `into`."""
    a, b, found = into or (torch.zeros_like(like), torch.zeros_like(like), torch.zeros_like(chosen))
    (some,) = chosen.nonzero(as_tuple=True)
    if len(some):
        a[some], b[some], found[some] = find(some)
    return a, b, found


class _Search:
    """The lenses of single points (M,), and the inverse by bracketing and damped steps."""

    def __init__(self, domain: Domain, camera: Tensor, *, is_circle: bool = False, within: Tensor | None = None):
        """Take a domain, which always `is_circle` if a lens is radial; a recorded search moves only points `within`."""
        self.domain, self.camera, self.within = domain, camera, within
        self.chart, self.lens = domain.optics_of(camera)
        self.is_circle = is_circle or self.lens.is_radial

    def __call__(self, u: Tensor, v: Tensor, first: Planes2 | None = None) -> Searched:
        """Search; if the domain is a circle, `first` is (p, q), by default (u, v)."""
        a, b = self.radial(*(first or (u, v))) if self.is_circle else self.planar(u, v)
        at = self.lens.at(a, b)
        (x, y), (ua, ub, va, vb) = at.value, at.jacobian
        valid = self.contains(a, b)
        # an error of one eps in the solution moves its image by an eps of this
        stretch = torch.maximum(ua.abs() + ub.abs(), va.abs() + vb.abs())
        stretch = stretch * torch.maximum(a.abs(), b.abs())
        for _ in range(2):  # to remove what rounding left
            da, db, _ = newton_step(at.jacobian, u - x, v - y)
            a, b = torch.where(valid, a + da, 0.0), torch.where(valid, b + db, 0.0)
            x, y = self.lens(a, b)
        # next to a fold the polished solution may lie on its other side: the place where its ray is seen counts
        ray = self.chart.to_ray(a, b, order=1)
        covered = self.chart.margin(*ray) > 0
        dx, dy, dz = (torch.where(covered, w, axis) for w, axis in zip(ray, (0, 0, 1), strict=True))
        seen = self.chart.to_plane(dx, dy, dz, order=1)
        x, y = self.lens(*seen)
        miss = torch.maximum((x - u).abs(), (y - v).abs())
        # stay away from the fold, where another processor's rounding would carry the ray across
        further = 1 + 32 * torch.finfo(u.dtype).eps
        beyond = times(seen[0], further), times(seen[1], further)
        valid = valid & covered & self.contains(*beyond) & (miss <= rounding(u, v, stretch))
        return torch.where(valid, a, 0.0), torch.where(valid, b, 0.0), valid

    def contains(self, a: Tensor, b: Tensor, to_edge: bool = True) -> Tensor:
        """Whether single points are in the domain: `Domain.margin` for them; see `regular`."""
        t = torch.addcmul(a * a, b, b)
        inside = t < self.domain.safe_radius_sq[self.camera, 0]
        if self.is_circle:
            return inside
        before = t < self.domain.limits2[self.camera, azimuth(a, b)]
        return inside | (before & (regular(self.lens, a, b, to_edge) > 0))

    def radial(self, u: Tensor, v: Tensor) -> Planes2:
        # at the fold itself the root of a rounded fold may lie beyond the rounded limit
        fold2 = times(self.domain.safe_radius_sq[self.camera, 0], 1 - 64 * torch.finfo(u.dtype).eps)
        scale = bracketed(present(self.lens.radial, "a radial factor"), torch.addcmul(u * u, v, v), fold2)
        return u * scale, v * scale

    def planar(self, u: Tensor, v: Tensor) -> Planes2:
        """Run Newton's method; the few points that need many steps go on alone."""
        if self.domain.is_constant:
            return self.newton(u, v, *self._start(u, v), _FIRST_STEPS + _LATE_STEPS)[:2]
        a, b, active = self.newton(u, v, *self._start(u, v), _FIRST_STEPS)
        (late,) = active.nonzero(as_tuple=True)
        if len(late):
            alone = _Search(self.domain, self.camera[late])
            a[late], b[late], _ = alone.newton(u[late], v[late], a[late], b[late], _LATE_STEPS)
        return a, b

    def newton(self, u: Tensor, v: Tensor, a: Tensor, b: Tensor, steps: int) -> Searched:
        """Return points, and which of them would still move, after steps that come nearer and stay inside.

        Nearer in Deuflhard's sense means that the next step by the same Jacobian is shorter. If a lens stretches one
        direction far more than the other, the residual itself would reject every good step.
        """
        enough = rounding(u, v) / 8

        def moves(x: Tensor, y: Tensor, part: Tensor) -> Tensor:
            active = (torch.maximum((u - x).abs(), (v - y).abs()) > enough) & (part > _LEAST_PART)
            return active if self.within is None else active & self.within

        def step(active: Tensor, part: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            a, b, x, y, ua, ub, va, vb = state
            jacobian = ua, ub, va, vb
            da, db, _ = newton_step(jacobian, u - x, v - y)
            trial = a + part * da, b + part * db
            at = self.lens.at(*trial)
            ahead = newton_step(jacobian, u - at.value[0], v - at.value[1])
            nearer = ahead[0] * ahead[0] + ahead[1] * ahead[1] < da * da + db * db
            # on the way a point may be behind the edge, where the formula goes on
            good = active & nearer & self.contains(*trial, to_edge=False)
            new = *trial, *at.value, *at.jacobian
            state = tuple(torch.where(good, n, o) for n, o in zip(new, state, strict=True))
            part = torch.where(good, (part * 4).clamp(max=1), part / 4)
            return moves(state[2], state[3], part), part, *state

        at, whole = self.lens.at(a, b), torch.ones_like(u)
        state = whole, *torch.broadcast_tensors(a, b, *at.value, *at.jacobian)
        active, _, a, b, *_ = repeat(step, moves(*at.value, whole), state, steps)
        return a, b, active

    def _start(self, u: Tensor, v: Tensor) -> Planes2:
        """Return the best of some points that the lens sends as far out as (u, v); secants find their azimuths."""
        target = (u * u + v * v).sqrt()

        def look(far: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            a, b, least_error, angle, step, last_off = state
            c, s = torch.cos(angle), torch.sin(angle)
            rho = self.domain.extent.start(self.camera, target, c, s)
            trial_a, trial_b = rho * c, rho * s
            x, y = self.lens(trial_a, trial_b)
            error = (u - x) ** 2 + (v - y) ** 2
            better = (error < least_error) & far  # stop close points, so that a result is the same in any batch
            a, b = torch.where(better, trial_a, a), torch.where(better, trial_b, b)
            least_error = torch.where(better, error, least_error)
            far = far & (least_error > _CLOSE_SHARE**2 * target * target)
            # turn by a secant, from how far the image turned with the last step
            off = torch.atan2(x * v - y * u, x * u + y * v)
            slope = torch.where(step != 0, (last_off - off) / torch.where(step != 0, step, 1.0), 1.0)
            step = (off / slope.clamp(_SLOWEST_TURN, 2.0)).clamp(-1.0, 1.0)
            return far, a, b, least_error, angle + step, step, off

        far = torch.ones_like(u, dtype=torch.bool) if self.within is None else self.within
        zero = torch.zeros_like(u)
        _, a, b, *_ = repeat(look, far, (zero, zero, target * target, torch.atan2(v, u), zero, zero), 6)
        return a, b


def rounding(u: Tensor, v: Tensor, stretch: Tensor | float = 0.0) -> Tensor:
    """Return how far from (u, v) rounding may leave a lens that `stretch`es the rounding of its solution by so much."""
    return 32 * torch.finfo(u.dtype).eps * (1 + torch.maximum(u.abs(), v.abs()) + stretch)
