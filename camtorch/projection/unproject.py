"""Pixels to rays: the inverse of the lens and why a pixel is invalid, as torch records it, and in native code.

As torch records it, a pixel becomes a target on the sensor. `invert` finds the point (a, b) of the chart's plane that
the lens sends there, and `search` those that it leaves open. `attach` gives them derivatives, and the chart makes rays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from camtorch.evaluate.export import times
from camtorch.evaluate.recorded import order_of, positive, to_planes, without_keeping
from camtorch.evaluate.tensors import may_branch_on
from camtorch.optics.charts import Planes2
from camtorch.optics.lens import newton_step
from camtorch.optics.radial_inverse import MOST_STEPS, short, solve
from camtorch.projection import native_calls
from camtorch.projection.camera_like import CameraLike
from camtorch.projection.ops import search_in_place, search_open
from camtorch.projection.rows import CameraRows, Direction, Traced, both, replace, to_mask
from camtorch.projection.solve import search
from camtorch.values.arguments import columns, present

if TYPE_CHECKING:
    from camtorch.optics.lens import Lens
    from camtorch.projection.domain import Domain


class Found(NamedTuple):
    """Planes (C, N): a point of the chart's plane, positive if it is the solution, positive if one may exist."""

    a: Tensor
    b: Tensor
    solved: Tensor
    possible: Tensor


def invert(domain: Domain, u: Tensor, v: Tensor) -> Found:
    """Return the points that the lens sends to (u, v), by a table and Newton's method; `search` finds the others."""
    by = domain.inverse_by
    if by == "radius":
        return _invert_radial(domain, u, v)
    if by == "stages":
        return _invert_stagewise(domain, u, v)
    found = _invert_in_plane(domain, u, v)
    if by == "plane":
        return found
    # choose for each camera, so that a result is the same in any batch
    pairs = zip(_invert_stagewise(domain, u, v), found, strict=True)
    return Found(*(torch.where(domain.stagewise, stagewise, planar) for stagewise, planar in pairs))


def _invert_in_plane(domain: Domain, u: Tensor, v: Tensor) -> Found:
    """Invert the whole lens by Newton's method, starting from the inverse of the radial factor."""
    a, b = domain.lens.start(u, v)
    if domain.inverse is not None:
        # a stage may have sent a pixel far off the image out of the floating-point range
        scale = domain.inverse(torch.addcmul(a * a, b, b).nan_to_num(0.0, 0.0))
        a, b = a * scale, b * scale
    inner = _newton(domain.lens, u, v, a, b)
    # further out than images reach a determinant may overflow, and a step seem short;
    # and a ray's rounding must not carry it across the fold
    image_radius_sq = times(domain.image_radius_sq, 1 - 32 * torch.finfo(u.dtype).eps)
    inside = image_radius_sq - torch.addcmul(inner.a * inner.a, inner.b, inner.b)
    return inner._replace(solved=torch.minimum(inner.solved, inside))


def _invert_stagewise(domain: Domain, u: Tensor, v: Tensor) -> Found:
    """Invert the later stages first, as only the radial one has a limit. Pixels beyond every ray are not solved for."""
    rest = present(domain.lens.rest, "a later stage")
    within = domain.image_circle_sq - torch.addcmul(u * u, v, v)
    mask = to_mask(within, may_branch_on(u))
    u, v = replace(mask, u, 0.0), replace(mask, v, 0.0)
    first = _newton(rest, u, v, *rest.start(u, v))
    found = _invert_radial(domain, first.a, first.b)
    known = first.solved > 0
    possible = torch.minimum(torch.where(known, found.possible, 1.0), within)
    solved = torch.where(known, torch.minimum(found.solved, within), -1.0)
    return found._replace(solved=solved, possible=possible)


def _invert_radial(domain: Domain, u: Tensor, v: Tensor) -> Found:
    r2 = torch.addcmul(u * u, v, v)
    eps = torch.finfo(u.dtype).eps
    radial, table = present(domain.lens.radial, "a radial factor"), present(domain.inverse, "a table")
    possible = times(table.most2, 1 + 8 * eps) - r2
    # points beyond the fold would never converge
    r2 = torch.minimum(replace(to_mask(possible, may_branch_on(r2)), r2, 0.0), table.most2)
    scale, converged = solve(radial, table, r2)
    # a ray's rounding must not carry it across the fold
    inside = times(domain.safe_radius_sq, 1 - 32 * eps) - r2 * scale * scale
    return Found(u * scale, v * scale, torch.minimum(torch.minimum(converged, inside), possible), possible)


def _newton(lens: Lens, u: Tensor, v: Tensor, a: Tensor, b: Tensor) -> Found:
    """Return the solutions of lens(a, b) = (u, v) that Newton's method reaches from (a, b)."""
    short2, looks = short(u.dtype) ** 2, may_branch_on(u)
    converged: Tensor | None = None
    for _ in range(MOST_STEPS):
        at = lens.at(a, b)
        x, y = at.value
        da, db, reciprocal = newton_step(at.jacobian, u - x, v - y)
        if converged is not None:  # stop converged points, so that a result is the same in any batch
            da, db = torch.where(converged > 0, 0.0, da), torch.where(converged > 0, 0.0, db)
        a, b = a + da, b + db
        t = torch.addcmul(a * a, b, b)
        converged = short2 * (t + 0.01) - torch.addcmul(da * da, db, db)
        if looks and bool(converged.amin() > 0):
            break
    converged = present(converged, "a step")
    return Found(a, b, torch.minimum(converged, reciprocal.abs()), torch.ones_like(a))


def _search_recorded(domain: Domain, target: Planes2, found: Found) -> Found:
    """Run `search` for points that are left open, as a part of an exported program."""
    if all(stage.is_affine for stage in domain.lens.stages):  # no point is open then
        return found
    camera, point = (~(found.solved > 0) & (found.possible > 0)).nonzero(as_tuple=True)
    a, b, there = search(domain, camera, *(w[camera, point] for w in target))
    results = a, b, torch.where(there, 1.0, -1.0).to(a.dtype)
    a, b, solved = (plane.index_put((camera, point), w) for plane, w in zip(found[:3], results, strict=True))
    return Found(a, b, solved, found.possible)


def attach(lens: Lens, solution: Planes2, target: Planes2, steps: int) -> Planes2:
    """Give a graph-free solution of lens(solution) = target its derivatives, exact up to the order of `steps`.

    It steps by the chord method x <- x - J^-1 (f(x) - y) with the constant Jacobian of the solution. If parameters and
    target move by d, the solution is off by O(d^2) after one step and by O(d^3) after two: its Taylor series agrees
    with that of the implicit function up to that order. The Jacobian itself never enters the graph.
    """
    a, b = solution
    with torch.no_grad():
        ua, ub, va, vb = [w.detach() for w in lens.at(a, b).jacobian]
    for _ in range(steps):
        x, y = lens(a, b)
        da, db, _ = newton_step((ua, ub, va, vb), target[0] - x, target[1] - y)
        # the value does not change: next to a fold, a step by the remaining rounding would lead across
        a, b = a + (da - da.detach()), b + (db - db.detach())
    return a, b


def _to_target(u: Tensor, v: Tensor, intrinsics: tuple[Tensor, ...], looks: bool) -> tuple[Planes2, Tensor | None]:
    """Return targets (p, q) on the sensor, in focal lengths, and a mask: 0 for NaN and far pixels, at its centre."""
    focal_x, focal_y, centre_x, centre_y = intrinsics
    p, q = (u - centre_x) / focal_x, (v - centre_y) / focal_y
    far = torch.maximum(p.detach().abs(), q.detach().abs())
    mask = to_mask(torch.finfo(far.dtype).max ** 0.25 - far, looks)
    if mask is not None:  # pixels themselves are replaced: derivatives would keep a NaN
        u, v = replace(mask, u, centre_x), replace(mask, v, centre_y)
        p, q = (u - centre_x) / focal_x, (v - centre_y) / focal_y
    return (p, q), mask


def _solve(model: type[CameraLike], domain: Domain, p: Tensor, q: Tensor, looks: bool) -> tuple[Tensor, ...]:
    """Return points of the chart's plane that the lens sends to (p, q), and a margin, positive where they do."""
    if not domain.lens.stages:
        return p, q, domain.chart.on_plane(p, q)
    found = invert(domain, p, q)
    if domain.is_constant:
        found = _search_recorded(domain, (p, q), found)
    elif torch.compiler.is_compiling():
        search_in_place(model.operator_name, domain.k, p, q, *found)
    elif not (looks and bool(found.solved.amin() > 0)):
        a, b, solved = search_open(model.operator_name, domain.k, p, q, *found)
        return a, b, solved
    return found[:3]


def _formula(
    model: type[CameraLike],
    pixels: Tensor,
    intrinsics: Tensor,
    distortion: Tensor,
    cameras: CameraRows | None,
) -> tuple[Tensor, Tensor]:
    """Return rays (3, C, N) for pixels (C, N, 2), and valid (C, N); see `Direction.formula`."""
    traced = Traced.of(model, intrinsics, distortion, cameras)
    domain, looks = traced.domain, may_branch_on(pixels, intrinsics, distortion)
    order = order_of(pixels, intrinsics, distortion)
    u, v = to_planes(pixels)
    # the solution has no graph; `attach` gives it derivatives
    (p, q), mask = _to_target(u.detach(), v.detach(), columns(traced.intrinsics.detach()), looks)
    mask = both(mask, traced.usable)
    a, b, margin = _solve(model, domain, replace(mask, p, 0.0), replace(mask, q, 0.0), looks)
    solved = to_mask(margin, looks)
    seen = domain.chart.seen(replace(solved, a, 0.0), replace(solved, b, 0.0))
    solved = solved if seen is None else both(solved, to_mask(seen, looks))
    mask = both(mask, solved)
    a, b = replace(solved, a, 0.0), replace(solved, b, 0.0)

    def evaluate(u: Tensor, v: Tensor, intrinsics: Tensor, distortion: Tensor) -> Tensor:
        chart, lens = traced.optics(distortion)
        here = a, b
        if order:
            p, q = _to_target(u, v, columns(intrinsics), looks)[0]
            target = replace(mask, p, 0.0), replace(mask, q, 0.0)
            here = attach(lens, here, target, order) if lens.stages else target
        rays = zip(chart.to_ray(*here, order), (0.0, 0.0, 1.0), strict=True)
        return torch.stack([replace(mask, w, axis) for w, axis in rays])

    rays = without_keeping(evaluate, u, v, traced.intrinsics, traced.distortion)
    return rays, torch.ones_like(a, dtype=torch.bool) if mask is None else positive(mask.expand_as(a))


UNPROJECT = Direction("pixels", 2, 3, _formula, native_calls.unproject, native_calls.unproject_vjp)
