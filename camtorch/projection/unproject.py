"""Pixels to rays: the inverse of the lens and what makes a pixel invalid, block by block or recorded in a graph."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from camtorch._arguments import columns
from camtorch._portable import is_portable_export, times
from camtorch._threads import on_one_thread
from camtorch.optics.lens import newton_step
from camtorch.optics.radial_inverse import MOST_STEPS, SmallTable, short, solve
from camtorch.projection.ops import order_of, positive, search_in_place, search_open, to_planes, without_keeping
from camtorch.projection.rows import (
    FEW,
    Block,
    Cameras,
    Sums,
    Traced,
    both,
    by_formulas,
    over_blocks,
    planes_of,
    replace,
    to_mask,
)
from camtorch.projection.solve import search

if TYPE_CHECKING:
    from camtorch.camera import Camera
    from camtorch.optics.lens import Lens
    from camtorch.projection.domain import Domain

Planes2 = tuple[Tensor, Tensor]
Planes3 = tuple[Tensor, Tensor, Tensor]

# Steps of Newton's method that most points need, by whether they can be counted while they are made
_STEPS = {torch.float32: 2, torch.float64: 3}


class Found(NamedTuple):
    """Planes (C, N): a point of the chart's plane, positive where it is the solution, positive where one may exist."""

    a: Tensor
    b: Tensor
    solved: Tensor
    possible: Tensor


def invert(domain: Domain, u: Tensor, v: Tensor, adaptive: bool) -> Found:
    """The point that the lens sends to (u, v), from a table and a few steps of Newton's method.

    What is solved is the solution in the domain, to rounding: the last step was so short that the next one would be
    nothing. What is not, and yet possible, is left to `search`.
    """
    if domain.lens.is_radial:
        return _invert_radial(domain, u, v, adaptive)
    if domain.all_stagewise:
        return _invert_stagewise(domain, u, v, adaptive)
    found = _invert_planar(domain, u, v, adaptive)
    if domain.stagewise is None:
        return found
    # each camera alike, whatever else is in its batch
    pairs = zip(_invert_stagewise(domain, u, v, adaptive), found, strict=True)
    return Found(*(torch.where(domain.stagewise, stagewise, planar) for stagewise, planar in pairs))


def _invert_planar(domain: Domain, u: Tensor, v: Tensor, adaptive: bool) -> Found:
    # in the plane, from the inverse of the radial factor
    a, b = domain.lens.start(u, v)
    if domain.inverse is not None:
        # a stage may have sent a pixel far off the image out of the floating-point range
        scale = domain.inverse(torch.addcmul(a * a, b, b).nan_to_num(0.0, 0.0))
        a, b = a * scale, b * scale
    found = _newton(domain.lens, u, v, a, b, adaptive)
    # further out than images reach a determinant may overflow, and a step seem short
    inside = domain.usual2 - torch.addcmul(found.a * found.a, found.b, found.b)
    return found._replace(solved=torch.minimum(found.solved, inside))


def _invert_stagewise(domain: Domain, u: Tensor, v: Tensor, adaptive: bool) -> Found:
    """The stages after the radial one first: only that one has a limit, and what it would have to reach tells at once.

    Pixels beyond the image of every ray are never solved for.
    """
    first, within = _first_image(domain, u, v, adaptive)
    found = _invert_radial(domain, first.a, first.b, adaptive)
    known = first.solved > 0
    possible = torch.minimum(torch.where(known, found.possible, 1.0), within)
    solved = torch.where(known, torch.minimum(found.solved, within), -1.0)
    return found._replace(solved=solved, possible=possible)


def _first_image(domain: Domain, u: Tensor, v: Tensor, adaptive: bool) -> tuple[Found, Tensor]:
    """Where the first stage has to send what later ones send to (u, v); and positive within the circle of the image."""
    rest = domain.lens.rest
    assert rest is not None
    within = domain.circle2 - torch.addcmul(u * u, v, v)
    mask = to_mask(within, adaptive)
    u, v = replace(mask, u, 0.0, adaptive), replace(mask, v, 0.0, adaptive)
    return _newton(rest, u, v, *rest.start(u, v), adaptive, near=True), within


def _invert_radial(domain: Domain, u: Tensor, v: Tensor, adaptive: bool) -> Found:
    r2 = torch.addcmul(u * u, v, v)
    eps, radial, table = torch.finfo(u.dtype).eps, domain.lens.radial, domain.inverse
    assert radial is not None  # a radial lens has both
    assert table is not None
    possible = times(table.most2, 1 + 8 * eps) - r2
    # what is beyond the fold would never settle
    r2 = torch.minimum(replace(to_mask(possible, adaptive), r2, 0.0, adaptive), table.most2)
    scale, converged = solve(radial, table, r2, adaptive)
    # a ray's rounding must not carry it across the fold
    inside = times(domain.inner2, 1 - 32 * eps) - r2 * scale * scale
    return Found(u * scale, v * scale, torch.minimum(torch.minimum(converged, inside), possible), possible)


def invert_without_tables(domain: Domain, u: Tensor, v: Tensor) -> Found | None:
    """The same without the tables of the domain, for few points; None where it takes those to tell."""
    a, b = domain.lens.start(u, v)
    r2 = torch.addcmul(a * a, b, b)
    # further out than the last point, for a lens that compresses
    radii = domain.radii_without_fold(2 * r2.amax(-1, keepdim=True) + 1e-6)
    if radii is None or domain.lens.radial is None:
        return None
    table = SmallTable(domain.lens.radial, radii)
    if not bool((table.images[..., -1:] ** 2 - r2).amin() > 0):
        return None
    if domain.lens.is_radial:
        scale, converged = solve(domain.lens.radial, table, r2, adaptive=True)
        found = Found(u * scale, v * scale, converged, converged)
    else:
        scale = table(r2)
        found = _newton(domain.lens, u, v, a * scale, b * scale, adaptive=True)
        converged = torch.minimum(found.solved, radii[..., -1:] ** 2 - torch.addcmul(found.a**2, found.b, found.b))
    return found if bool(converged.amin() > 0) else None


def _newton(lens: Lens, u: Tensor, v: Tensor, a: Tensor, b: Tensor, adaptive: bool, near: bool = False) -> Found:
    """From (a, b) on, wherever that leads. near: whether most points begin a step nearer than from a table."""
    short2, fewest, converged = short(u.dtype) ** 2, _STEPS[u.dtype] - near, None
    for count in range(1, MOST_STEPS + 1):
        at = lens.at(a, b)
        x, y = at.value
        da, db, reciprocal = newton_step(at.jacobian, u - x, v - y)
        if converged is not None:  # what is converged stays, whatever else is in its batch
            da, db = torch.where(converged > 0, 0.0, da), torch.where(converged > 0, 0.0, db)
        a, b = a + da, b + db
        t = torch.addcmul(a * a, b, b)
        if count >= fewest:
            converged = short2 * (t + 0.01) - torch.addcmul(da * da, db, db)
            if not adaptive or bool(converged.amin() > 0):
                break
    assert converged is not None  # there are more steps than those before the first look
    return Found(a, b, torch.minimum(converged, reciprocal.abs()), torch.ones_like(a))


def has_ray(domain: Domain, p: Tensor, q: Tensor) -> Tensor:
    """Bool (C, N): whether points of the sensor in focal lengths, planes, have a ray; see `Unproject`.

    Without that ray, and where the fold alone tells without the table to find it by. It looks at values.
    """
    if not domain.lens.stages or not p.numel():
        return domain.chart.on_plane(p, q) > 0
    within, known = torch.ones_like(p), True
    if domain.all_stagewise:
        first, within = _first_image(domain, p, q, True)
        known = bool(first.solved.amin() > 0)
        p, q = (first.a, first.b) if known else (p, q)
    if domain.lens.is_radial or (domain.all_stagewise and known):
        most2 = domain.edge2 * (1 + 8 * torch.finfo(p.dtype).eps)
        possible: Tensor = (torch.addcmul(p * p, q, q) <= most2) & (within > 0)
        return possible
    found = invert(domain, p, q, True)
    found_ray = found.solved > 0
    camera, point = (~found_ray & (found.possible > 0)).nonzero(as_tuple=True)
    if len(camera):
        found_ray[camera, point] = search(domain, camera, p[camera, point], q[camera, point])[2]
    return found_ray


def attach(lens: Lens, solution: Planes2, target: Planes2, steps: int) -> Planes2:
    """Give a graph-free solution of lens(solution) = target its derivatives, exact up to the order of `steps`.

    Steps of the chord method x <- x - J^-1 (f(x) - y) with the constant Jacobian of the solution. If parameters and
    target move by d, the solution is off by O(d^2) after one step and by O(d^3) after two: its Taylor series agrees
    with that of the implicit function up to that order. The Jacobian itself never enters the graph.
    """
    a, b = solution
    with torch.no_grad():
        xa, xb, ya, yb = [w.detach() for w in lens.at(a, b).jacobian]
    for _ in range(steps):
        x, y = lens(a, b)
        da, db, _ = newton_step((xa, xb, ya, yb), target[0] - x, target[1] - y)
        a, b = a + da, b + db
    return a, b


class Target(NamedTuple):
    """Pixels as points (p, q) of the sensor in focal lengths; the centre where `mask` is 0, None where it is all 1."""

    p: Tensor
    q: Tensor
    mask: Tensor | None


def to_target(u: Tensor, v: Tensor, intrinsics: tuple[Tensor, ...], adaptive: bool = False) -> Target:
    """Invalid: pixels that are no numbers, or so large that a square overflows."""
    focal_x, focal_y, centre_x, centre_y = intrinsics
    p, q = (u - centre_x) / focal_x, (v - centre_y) / focal_y
    far = torch.maximum(p.detach().abs(), q.detach().abs())
    limit = torch.finfo(far.dtype).max ** 0.25
    if adaptive and float(far.amax()) < limit:
        return Target(p, q, None)
    mask = (far < limit).to(far.dtype)
    p, q = ((torch.where(mask > 0, w, c) - c) / f for w, c, f in ((u, centre_x, focal_x), (v, centre_y, focal_y)))
    return Target(p, q, mask)


class Solution(NamedTuple):
    """The point of the chart's plane of each pixel, the centre where it is invalid; what of that was found how."""

    a: Tensor
    b: Tensor
    mask: Tensor | None
    target: Target
    open: Tensor | None  # bool: where a point may exist that only `search` finds


def solutions(
    u: Tensor,
    v: Tensor,
    intrinsics: tuple[Tensor, ...],
    domain: Domain,
    usable: Tensor | None,
    finish: Callable[[Planes2, Found], Found] | None = None,
    adaptive: bool = False,
    without_tables: bool = False,
) -> Solution:
    """Where pixels, planes (C, N), come from: graph-free, with all that makes a pixel invalid.

    Args:
        u: pixels.
        v: likewise.
        intrinsics: columns.
        domain: of the lens.
        usable: the mask of the cameras whose parameters make a camera.
        finish: adds to what was found at p, q what a search finds; by default that is left open.
        adaptive: whether a look at the values may find a shorter way.
        without_tables: whether the points are few, and the camera is about to change, which tables are too dear for.
    """
    p, q, known = to_target(u, v, intrinsics, adaptive)
    known = known if usable is None else both(known, usable)
    if known is not None:
        p, q = replace(known, p, 0.0, adaptive), replace(known, q, 0.0, adaptive)
    target, left = Target(p, q, known), None
    if domain.lens.stages:
        found = (invert_without_tables(domain, p, q) if without_tables else None) or invert(domain, p, q, adaptive)
        if finish is not None:
            found = finish((p, q), found)
        solved = to_mask(found.solved, adaptive)
        a, b = found.a, found.b
        if solved is not None:
            left = (found.possible > 0) & ~(solved > 0)
            if adaptive:  # a product has no use for what ran away
                a, b = a.nan_to_num(0.0, 0.0, 0.0), b.nan_to_num(0.0, 0.0, 0.0)
    else:
        solved, a, b = to_mask(domain.chart.on_plane(p, q), adaptive), p, q
    if solved is None:
        return Solution(a, b, known, target, left)
    a, b = replace(solved, a, 0.0, adaptive), replace(solved, b, 0.0, adaptive)
    return Solution(a, b, both(known, solved), target, left)


class Unproject(Function):
    """Rows of pixels (C, N, 2), intrinsics (C, 4), distortion (C, n) -> rays (3, C, N), valid (C, N).

    Block by block, without a graph: temporaries stay in the cache, and backward computes again what is not dear.
    """

    @staticmethod
    def traced(
        model: type[Camera],
        pixels: Tensor,
        intrinsics: Tensor,
        distortion: Tensor,
        cameras: Cameras | None,
        order: int = 2,
    ) -> tuple[Tensor, Tensor]:
        """The same, recorded in a graph or by a transform. cameras: if values may be looked at."""
        usual = Traced.of(model, intrinsics, distortion, cameras)
        u, v = to_planes(pixels)

        def finish(target: Planes2, found: Found) -> Found:
            if is_portable_export():
                return _search_recorded(usual.domain, target, found)
            if torch.compiler.is_compiling():
                search_in_place(model._model, usual.domain.k, *target, *found)
                return found
            a, b, solved = search_open(model._model, usual.domain.k, *target, *found)
            return Found(a, b, solved, found.possible)

        columns_now = columns(usual.intrinsics.detach())
        a, b, mask, _, _ = solutions(u.detach(), v.detach(), columns_now, usual.domain, usual.usable, finish)

        def evaluate(u: Tensor, v: Tensor, intrinsics: Tensor, distortion: Tensor) -> Tensor:
            chart, lens = model.optics(columns(distortion))
            p, q, _ = to_target(u, v, columns(intrinsics))
            p, q = replace(mask, p, 0.0), replace(mask, q, 0.0)
            here = (p, q) if not lens.stages else attach(lens, (a, b), (p, q), order) if order else (a, b)
            rays = zip(chart.to_ray(*here, order), (0.0, 0.0, 1.0), strict=True)
            return torch.stack([replace(mask, w, axis) for w, axis in rays])

        order = order_of(order, pixels, intrinsics, distortion)
        rays = without_keeping(evaluate, u, v, usual.intrinsics, usual.distortion)
        return rays, positive(torch.ones_like(a) if mask is None else mask.expand_as(a))

    @staticmethod
    @on_one_thread
    def forward(
        ctx: Any,
        pixels: Tensor,
        intrinsics: Tensor,
        distortion: Tensor,
        cameras: Cameras,
        model: type[Camera],
        keeps: bool,
    ) -> tuple[Tensor, Tensor]:
        """keeps: whether there will be a backward."""
        shape, adaptive = pixels.shape[:2], cameras.adaptive
        rays, solution = pixels.new_empty(3, *shape), pixels.new_empty(2, *shape) if keeps else None
        valid = torch.ones(shape, dtype=torch.bool, device=pixels.device)
        without_tables = adaptive and ctx.needs_input_grad[2] and shape[1] <= FEW

        all_valid = True
        left_open: list[tuple[Tensor, ...]] = []

        def evaluate(block: Block) -> tuple[bool, Iterable[tuple[Tensor, ...]]]:
            """Whether all is valid, and what is left open."""
            here, domain = block.here, block.domain
            u, v = planes_of(pixels[here])
            a, b, mask, target, left = solutions(
                u, v, block.intrinsics, domain, block.usable, None, adaptive, without_tables
            )
            made = domain.chart.to_ray(a, b, 1)
            for plane, w, axis in zip(rays, made, (0.0, 0.0, 1.0), strict=True):
                plane[here] = replace(mask, w, axis, adaptive)
            if solution is not None:
                solution[0][here], solution[1][here] = a, b
            if mask is not None:
                valid[here] = mask > 0
            return mask is None, () if left is None else _places(block, target, left)

        for is_valid, places in over_blocks(cameras, pixels, evaluate):
            all_valid = all_valid and is_valid
            left_open += places
        if left_open:
            _search(cameras, left_open, rays, solution, valid)
        if keeps:
            # a copy: what is handed out belongs to the caller
            ctx.save_for_backward(pixels, intrinsics, distortion, None if all_valid else valid.clone(), solution)
            ctx.cameras, ctx.model = cameras, model
        ctx.mark_non_differentiable(valid)
        ctx.set_materialize_grads(False)
        return rays, valid

    @staticmethod
    @on_one_thread
    def backward(ctx: Any, by_rays: Tensor | None, _: Tensor | None) -> tuple[Tensor | None, ...]:
        """The cotangents of pixels and parameters; with a graph if that is asked for."""
        if by_rays is None:
            return (None,) * 6
        *inputs, valid, solution = ctx.saved_tensors
        wanted, cameras = ctx.needs_input_grad, ctx.cameras
        if torch.is_grad_enabled():
            again = by_formulas(lambda p, i, d: Unproject.traced(ctx.model, p, i, d, cameras), inputs, wanted, by_rays)
            return *again, None, None, None
        sums = Sums(cameras, wanted, inputs[0])
        by_pixels = torch.empty_like(inputs[0]) if wanted[0] else None

        def evaluate(block: Block) -> tuple[Block, list[Tensor], list[Tensor]]:
            here, chart = block.here, block.domain.chart
            a, b = solution[0][here], solution[1][here]
            gx, gy, gz = (by_rays[i][here] for i in range(3))
            if valid is not None and not bool(valid[here].all()):
                # what comes back of an invalid pixel need not be finite
                gx, gy, gz = (torch.where(valid[here], g, 0.0) for g in (gx, gy, gz))
            (ga, gb), by_optics = chart.to_ray_vjp(a, b, gx, gy, gz, sums.wants_distortion)
            at = block.domain.lens.at(a, b)
            if at.stages:
                ua, ub, va, vb = at.jacobian
                ga, gb, _ = newton_step((ua, va, ub, vb), ga, gb)
                if sums.wants_distortion:
                    by_optics = by_optics + at.vjp(-ga, -gb)[1]
            focal_x, focal_y, _, _ = block.intrinsics
            ga, gb = ga / focal_x, gb / focal_y
            if by_pixels is not None:
                by_pixels[here][..., 0], by_pixels[here][..., 1] = ga, gb
            return block, sums.of_intrinsics(-ga, -gb, *at.value), by_optics

        for parts in over_blocks(cameras, inputs[0], evaluate):
            sums.add(*parts)
        return by_pixels, *sums.result(), None, None, None


def _search_recorded(domain: Domain, target: Planes2, found: Found) -> Found:
    """`search` for what is left open, as a part of an exported program."""
    if domain.lens.radial is None:  # an affine map, of which nothing is
        return found
    camera, point = (~(found.solved > 0) & (found.possible > 0)).nonzero(as_tuple=True)
    a, b, there = search(domain, camera, *(w[camera, point] for w in target))
    places, solved = (camera, point), torch.where(there, 1.0, -1.0).to(a.dtype)
    a, b, solved = (plane.index_put(places, w) for plane, w in ((found.a, a), (found.b, b), (found.solved, solved)))
    return Found(a, b, solved, found.possible)


def _places(block: Block, target: Target, left: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """Camera, point, p and q of what is left open in a block, if anything is."""
    camera, point = left.nonzero(as_tuple=True)
    if len(camera):
        yield camera + block.cameras.start, point + block.points.start, target.p[left], target.q[left]


def _search(
    cameras: Cameras, left_open: list[tuple[Tensor, ...]], rays: Tensor, solution: Tensor | None, valid: Tensor
) -> None:
    """Write what a search finds of what the blocks left open."""
    camera, point, p, q = (torch.cat(parts) for parts in zip(*left_open, strict=True))
    a, b, found = search(cameras.domain, camera, p, q)
    camera, point, a, b = camera[found], point[found], a[found], b[found]
    chart, _ = cameras.domain.optics_of(camera)
    for plane, w in zip(rays, chart.to_ray(a, b, 1), strict=True):
        plane[camera, point] = w
    if solution is not None:
        solution[0][camera, point], solution[1][camera, point] = a, b
    valid[camera, point] = True
