"""The inverse of a lens for the few points that a table and a few steps leave open: brackets and damped steps.

A lens sends (a, b), of the chart's plane, to (u, v): its first stage to (p, q), and the later stages that to (u, v).
Each point has a `camera`, an index. `search` goes one of three ways, see `domain.InverseBy`: along the radius and by
stages the domain is a circle, and the solution is bracketed; in the plane, secants find a start for damped steps. Then
`_PointSearch.checked` removes what rounding left, and asks where the solution's ray is seen.
"""

from __future__ import annotations

from collections.abc import Callable
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
"""Points (M,) in the domain, a and b, and whether the search found them."""

_LOOKS = 6  # for a start
_CLOSE_SHARE = 0.02  # of a point's distance from the centre: a start whose image is as near to it will do
_SLOWEST_TURN = 0.05  # radians that an image turns by, for each by which its point turns: the least that secants assume
_LEAST_PART = 1e-4  # of a step of Newton's method: shorter parts of it are not tried
_STAGE_STEPS = 12  # the first ones may take off no more than a third, see `domain._LEAST_SLOPE`
_FIRST_STEPS = 6  # of all points
_LATE_STEPS = 54  # of the few that are left: next to a fold, or so far out that a prism dominates


def search(domain: Domain, camera: Tensor, u: Tensor, v: Tensor) -> Searched:
    """Return points (M,) in the domain that the lens of a `camera` (M,) sends to (u, v), and whether there are any."""
    if domain.inverse_by == "radius":
        return _along_radius(domain, camera, u, v, u, v)
    if domain.inverse_by == "stages":
        return _by_stages(domain, camera, u, v)
    if domain.inverse_by == "plane":
        return _in_plane(domain, camera, u, v)
    stagewise = domain.stagewise[camera, 0]
    staged = _of_chosen(stagewise, _by_stages, domain, camera, u, v)
    planar = _of_chosen(~stagewise, _in_plane, domain, camera, u, v)
    a, b = (torch.where(stagewise, *pair) for pair in zip(staged[:2], planar[:2], strict=True))
    return a, b, staged[2] | planar[2]


def _of_chosen(
    chosen: Tensor, find: Callable[..., Searched], domain: Domain, camera: Tensor, *planes: Tensor
) -> Searched:
    """Return the results of a search for the chosen of some points; of the others none is found."""
    if domain.is_constant:  # an exported program searches for all
        a, b, found = find(domain, camera, *planes)
        return a, b, found & chosen
    a, b, found = torch.zeros_like(planes[0]), torch.zeros_like(planes[0]), torch.zeros_like(chosen)
    (some,) = chosen.nonzero(as_tuple=True)
    if len(some):
        a[some], b[some], found[some] = find(domain, camera[some], *(plane[some] for plane in planes))
    return a, b, found


def _along_radius(domain: Domain, camera: Tensor, u: Tensor, v: Tensor, p: Tensor, q: Tensor) -> Searched:
    """Search for the point that the first stage, a radial one, sends to (p, q), and the whole lens to (u, v)."""
    points = _PointSearch(domain, camera, is_circle=True)
    return points.checked(*points.bracket(p, q), u, v)


def _by_stages(domain: Domain, camera: Tensor, u: Tensor, v: Tensor) -> Searched:
    """Search if only the first stage, a radial one, has a limit: the point (p, q) that it must reach decides."""
    rest = present(domain.optics_of(camera)[1].rest, "a later stage")
    p, q = rest.start(u, v)
    for _ in range(_STAGE_STEPS):
        at = rest.at(p, q)
        x, y = at.value
        dp, dq, _ = newton_step(at.jacobian, u - x, v - y)
        p, q = p + dp, q + dq
    table = present(domain.inverse, "a table")
    most2 = times(table.most2[camera, 0], 1 + 64 * torch.finfo(u.dtype).eps)
    is_reached = (u * u + v * v <= domain.image_circle_sq[camera, 0]) & (p * p + q * q <= most2)
    return _of_chosen(is_reached, _along_radius, domain, camera, u, v, p, q)


def _in_plane(domain: Domain, camera: Tensor, u: Tensor, v: Tensor) -> Searched:
    """Search through any lens, for the points within the extent of what it shows."""
    within = (u * u + v * v).sqrt() <= domain.extent.furthest[camera, azimuth(u, v)]
    return _of_chosen(within, _by_damped_steps, domain, camera, u, v, within)


def _by_damped_steps(domain: Domain, camera: Tensor, u: Tensor, v: Tensor, within: Tensor) -> Searched:
    """Search by Newton's method; the few points that need many steps go on alone."""
    points = _PointSearch(domain, camera, is_circle=False)
    start = points.start(u, v, within)
    if domain.is_constant:
        a, b, _ = points.newton(u, v, *start, within, _FIRST_STEPS + _LATE_STEPS)
        return points.checked(a, b, u, v)
    a, b, moves = points.newton(u, v, *start, within, _FIRST_STEPS)
    (late,) = moves.nonzero(as_tuple=True)
    if len(late):
        alone = _PointSearch(domain, camera[late], is_circle=False)
        a[late], b[late], _ = alone.newton(u[late], v[late], a[late], b[late], within[late], _LATE_STEPS)
    return points.checked(a, b, u, v)


class _PointSearch:
    """The steps of the search for single points (M,), each through the lens of its camera."""

    def __init__(self, domain: Domain, camera: Tensor, *, is_circle: bool):
        """Take the domain of the cameras, which for these points `is_circle` or not."""
        self.domain, self.camera, self.is_circle = domain, camera, is_circle
        self.chart, self.lens = domain.optics_of(camera)

    def contains(self, a: Tensor, b: Tensor, to_edge: bool = True) -> Tensor:
        """Whether single points are in the domain: `Domain.margin` for them; see `regular`."""
        t = torch.addcmul(a * a, b, b)
        inside = t < self.domain.safe_radius_sq[self.camera, 0]
        if self.is_circle:
            return inside
        before = t < self.domain.limits2[self.camera, azimuth(a, b)]
        return inside | (before & (regular(self.lens, a, b, to_edge) > 0))

    def bracket(self, p: Tensor, q: Tensor) -> Planes2:
        """Return the points that the radial factor of the first stage sends to (p, q)."""
        # at the fold itself the root of a rounded fold may lie beyond the rounded limit
        fold2 = times(self.domain.safe_radius_sq[self.camera, 0], 1 - 64 * torch.finfo(p.dtype).eps)
        scale = bracketed(present(self.lens.radial, "a radial factor"), torch.addcmul(p * p, q, q), fold2)
        return p * scale, q * scale

    def start(self, u: Tensor, v: Tensor, within: Tensor) -> Planes2:
        """Return the best of some points that the lens sends as far out as (u, v); secants find their azimuths."""
        target = (u * u + v * v).sqrt()

        def look(far: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            a, b, least_error, angle, last_turn, last_off = state
            along, across = torch.cos(angle), torch.sin(angle)
            radius = self.domain.extent.start(self.camera, target, along, across)
            trial_a, trial_b = radius * along, radius * across
            x, y = self.lens(trial_a, trial_b)
            error = (u - x) ** 2 + (v - y) ** 2
            is_better = (error < least_error) & far  # stop close points, so that a result is the same in any batch
            a, b = torch.where(is_better, trial_a, a), torch.where(is_better, trial_b, b)
            least_error = torch.where(is_better, error, least_error)
            far = far & (least_error > _CLOSE_SHARE**2 * target * target)
            # turn by a secant, from how far the image turned with the last step
            off = torch.atan2(x * v - y * u, x * u + y * v)
            has_turned = last_turn != 0
            slope = torch.where(has_turned, (last_off - off) / torch.where(has_turned, last_turn, 1.0), 1.0)
            turn = (off / slope.clamp(_SLOWEST_TURN, 2.0)).clamp(-1.0, 1.0)
            return far, a, b, least_error, angle + turn, turn, off

        zero = torch.zeros_like(u)
        centre = zero, zero, target * target
        _, a, b, *_ = repeat(look, within, (*centre, torch.atan2(v, u), zero, zero), _LOOKS)
        return a, b

    def newton(self, u: Tensor, v: Tensor, a: Tensor, b: Tensor, within: Tensor, steps: int) -> Searched:
        """Return points after some of Newton's steps that come nearer and stay inside, and which would still move.

        Nearer means, as in Deuflhard's natural monotonicity test (Newton Methods for Nonlinear Problems, 2004, section
        3.3), that the next step by the same Jacobian is shorter. If a lens stretches one direction far more than the
        other, the residual itself would reject every good step.
        """
        settled = rounding(u, v) / 8

        def would_move(x: Tensor, y: Tensor, part: Tensor) -> Tensor:
            miss = torch.maximum((u - x).abs(), (v - y).abs())
            return within & (miss > settled) & (part > _LEAST_PART)

        def step(moves: Tensor, part: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            a, b, x, y, ua, ub, va, vb = state
            jacobian = ua, ub, va, vb
            da, db, _ = newton_step(jacobian, u - x, v - y)
            trial = a + part * da, b + part * db
            at = self.lens.at(*trial)
            trial_x, trial_y = at.value
            next_da, next_db, _ = newton_step(jacobian, u - trial_x, v - trial_y)
            is_nearer = next_da * next_da + next_db * next_db < da * da + db * db
            # on the way a point may be behind the edge, where the formula goes on
            is_good = moves & is_nearer & self.contains(*trial, to_edge=False)
            new = *trial, trial_x, trial_y, *at.jacobian
            state = tuple(torch.where(is_good, after, before) for after, before in zip(new, state, strict=True))
            part = torch.where(is_good, (part * 4).clamp(max=1), part / 4)
            return would_move(state[2], state[3], part), part, *state

        at, whole = self.lens.at(a, b), torch.ones_like(u)
        state = whole, *torch.broadcast_tensors(a, b, *at.value, *at.jacobian)
        moves, _, a, b, *_ = repeat(step, would_move(*at.value, whole), state, steps)
        return a, b, moves

    def checked(self, a: Tensor, b: Tensor, u: Tensor, v: Tensor) -> Searched:
        """Return solutions of lens(a, b) = (u, v) without what rounding left, and whether their rays are seen there."""
        at = self.lens.at(a, b)
        x, y = at.value
        ua, ub, va, vb = at.jacobian
        is_found = self.contains(a, b)
        # an error of one eps in the solution moves its image by an eps of this
        stretch = torch.maximum(ua.abs() + ub.abs(), va.abs() + vb.abs())
        stretch = stretch * torch.maximum(a.abs(), b.abs())
        for _ in range(2):
            da, db, _ = newton_step((ua, ub, va, vb), u - x, v - y)
            a, b = torch.where(is_found, a + da, 0.0), torch.where(is_found, b + db, 0.0)
            x, y = self.lens(a, b)
        # next to a fold the solution may now lie on its other side: the place where its ray is seen counts
        ray = self.chart.to_ray(a, b, order=1)
        is_covered = self.chart.margin(*ray) > 0
        dx, dy, dz = (torch.where(is_covered, w, axis) for w, axis in zip(ray, (0, 0, 1), strict=True))
        seen_a, seen_b = self.chart.to_plane(dx, dy, dz, order=1)
        x, y = self.lens(seen_a, seen_b)
        miss = torch.maximum((x - u).abs(), (y - v).abs())
        # stay away from the fold, where another processor's rounding would carry the ray across
        further = 1 + 32 * torch.finfo(u.dtype).eps
        is_inside = self.contains(times(seen_a, further), times(seen_b, further))
        is_found = is_found & is_covered & is_inside & (miss <= rounding(u, v, stretch))
        return torch.where(is_found, a, 0.0), torch.where(is_found, b, 0.0), is_found


def rounding(u: Tensor, v: Tensor, stretch: Tensor | float = 0.0) -> Tensor:
    """Return how far from (u, v) rounding may leave a lens that `stretch`es the rounding of its solution by so much."""
    return 32 * torch.finfo(u.dtype).eps * (1 + torch.maximum(u.abs(), v.abs()) + stretch)
