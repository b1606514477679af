"""Both directions block by block, without a graph: temporaries stay in the cache, and backward recomputes them.

What is kept for backward is what came in, which of it is valid, and what is dear to compute again: the scale of a
chart, the solution of an inverse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from camtorch._arguments import columns
from camtorch.optics.charts import Chart
from camtorch.optics.lens import Lens
from camtorch.projection import formulas
from camtorch.projection.domain import Domain
from camtorch.projection.solve import invert, newton_step, search

_BLOCK = 1 << 17  # points


class Cameras(NamedTuple):
    """The cameras of rows (C, N): the parameters' values (C, 4), (C, n), and what was tabulated for them."""

    intrinsics: Tensor
    domain: Domain
    usable: Tensor | None  # (C, 1) mask, None where all are


class _Block(NamedTuple):
    cameras: slice
    points: slice
    here: tuple[slice, ...]  # both, or nothing for a block that is all there is
    intrinsics: tuple[Tensor, ...]
    domain: Domain
    usable: Tensor | None


def _blocks(given: Cameras, rows: Tensor) -> Iterator[_Block]:
    """Parts of (C, N, ...) of about one size: of one camera's points, or of several cameras."""
    count, length = rows.shape[:2]
    if not rows.numel():
        return
    if rows.device.type != "cpu":  # there a kernel more costs more than memory
        spans = [(slice(0, count), slice(0, length))]
    elif length > _BLOCK // 2:
        parts = -(-length // _BLOCK)
        edges = [length * i // parts for i in range(parts + 1)]
        spans = [(slice(c, c + 1), slice(*span)) for c in range(count) for span in pairwise(edges)]
    else:
        step = _BLOCK // length
        spans = [(slice(c, min(c + step, count)), slice(0, length)) for c in range(0, count, step)]
    last = None
    for cameras, points in spans:
        if last != cameras:
            last = cameras
            shared = columns(given.intrinsics[cameras]), given.domain.part(cameras)
            usable = None if given.usable is None else given.usable[cameras]
        yield _Block(cameras, points, (cameras, points) if len(spans) > 1 else (), *shared, usable)


def _planes(rows: Tensor) -> tuple[Tensor, ...]:
    """(C, N, size) as contiguous planes (C, N)."""
    # twice as fast as a copy, and bit for bit the same
    return tuple(plane if plane.stride(-1) == 1 else plane - 0 for plane in rows.unbind(-1))


class Project(Function):
    """Rows of points (C, N, 3), intrinsics (C, 4), distortion (C, n) -> pixels (2, C, N), valid (C, N)."""

    @staticmethod
    def forward(ctx, points, intrinsics, distortion, cameras: Cameras, again: Callable, keeps: bool):
        """again: the same as formulas, for derivatives of derivatives. keeps: whether there will be a backward."""
        shape = points.shape[:2]
        pixels = points.new_empty(2, *shape)
        valid = torch.ones(shape, dtype=torch.bool, device=points.device)
        scales = points.new_empty(shape if keeps and cameras.domain.chart.has_scale else (0, 0))
        ctx.plain = []
        for block in _blocks(cameras, points):
            here, chart = block.here, block.domain.chart
            ray = formulas.normalise(chart, *_planes(points[here]))
            scale = chart.scale(ray.x, ray.y, ray.z, 1)
            a, b, mask = formulas.see(ray, chart, block.domain.lens, block.domain, 1, scale)
            mask = formulas.both(ray.mask, mask, block.usable)
            for plane, m, focal, centre in zip(pixels, (a, b), block.intrinsics[:2], block.intrinsics[2:], strict=True):
                torch.add(focal * m, centre, out=plane[here])
                if mask is not None:
                    plane[here] = formulas.replace(mask, plane[here], formulas.INVALID_PIXEL)
            if mask is not None:
                valid[here] = mask > 0
            if scales.numel():
                scales[here] = scale
            ctx.plain.append(mask is None and ray.shrink is None)
        if keeps:
            ctx.save_for_backward(points, intrinsics, distortion, valid, scales)
            ctx.cameras, ctx.again = cameras, again
        ctx.mark_non_differentiable(valid)
        ctx.set_materialize_grads(False)
        return pixels, valid

    @staticmethod
    def backward(ctx, by_pixels, _):
        if by_pixels is None:
            return (None,) * 6
        *inputs, valid, scales = ctx.saved_tensors
        if torch.is_grad_enabled():
            return _by_formulas(ctx.again, inputs, ctx.needs_input_grad, by_pixels)
        points = inputs[0]
        sums = _Sums(ctx.cameras, ctx.needs_input_grad, points)
        by_points = torch.empty_like(points) if ctx.needs_input_grad[0] else None
        for block, plain in zip(_blocks(ctx.cameras, points), ctx.plain, strict=True):
            here, chart = block.here, block.domain.chart
            x, y, z = _planes(points[here])
            shrink = mask = None
            gu, gv = by_pixels[0][here], by_pixels[1][here]
            if not plain:
                x, y, z, shrink, _ = formulas.normalise(chart, x, y, z)
                mask = valid[here].to(x.dtype)
                x, y, z = (formulas.replace(mask, w, axis) for w, axis in ((x, 0.0), (y, 0.0), (z, 1.0)))
                # what comes back of an invalid point need not be finite
                gu, gv = (torch.where(valid[here], g, 0.0) for g in (gu, gv))
            scale = formulas.replace(mask, scales[here], 1.0) if scales.numel() else None
            at = block.domain.lens.at(*chart.to_plane(x, y, z, 1, scale))
            sums.add_intrinsics(block, gu, gv, *at.value)
            wanted = sums.wants_distortion
            (ga, gb), by_lens = at.vjp(gu * block.intrinsics[0], gv * block.intrinsics[1], wanted)
            by_ray, by_chart = (), []
            if by_points is not None or (wanted and chart.parameters):
                by_ray, by_chart = chart.to_plane_vjp(x, y, z, ga, gb, scale, wanted)
            sums.add_optics(block, by_chart + by_lens)
            if by_points is not None:
                for i, w in enumerate(by_ray):
                    by_points[here][..., i] = w if shrink is None else w * shrink
        return by_points, *sums.result(), None, None, None


class Unproject(Function):
    """Rows of pixels (C, N, 2), intrinsics (C, 4), distortion (C, n) -> rays (3, C, N), valid (C, N)."""

    @staticmethod
    def forward(ctx, pixels, intrinsics, distortion, cameras: Cameras, again: Callable, keeps: bool):
        """again: the same as formulas, for derivatives of derivatives. keeps: whether there will be a backward."""
        shape = pixels.shape[:2]
        rays, solution = pixels.new_empty(3, *shape), pixels.new_empty(2, *shape) if keeps else None
        valid = torch.ones(shape, dtype=torch.bool, device=pixels.device)
        left_open: list[tuple[Tensor, ...]] = []
        for block in _blocks(cameras, pixels):
            left = _unproject_block(block, pixels, rays, solution, valid)
            if left is not None:
                left_open.append(left)
        if left_open:
            camera, point, *target = (torch.cat(parts) for parts in zip(*left_open, strict=True))
            a, b, found = search(cameras.domain, camera, *target)
            (some,) = found.nonzero(as_tuple=True)
            here, a, b = (camera[some], point[some]), a[some], b[some]
            chart, _ = cameras.domain.optics_of(camera[some])
            _write(rays, here, chart.to_ray(a, b, 1))
            _write(solution, here, (a, b))
            valid[here] = True
        if keeps:
            ctx.save_for_backward(pixels, intrinsics, distortion, valid, solution)
            ctx.cameras, ctx.again = cameras, again
        ctx.mark_non_differentiable(valid)
        ctx.set_materialize_grads(False)
        return rays, valid

    @staticmethod
    def backward(ctx, by_rays, _):
        if by_rays is None:
            return (None,) * 6
        *inputs, valid, solution = ctx.saved_tensors
        if torch.is_grad_enabled():
            return _by_formulas(ctx.again, inputs, ctx.needs_input_grad, by_rays)
        sums = _Sums(ctx.cameras, ctx.needs_input_grad, inputs[0])
        by_pixels = torch.empty_like(inputs[0]) if ctx.needs_input_grad[0] else None
        for block in _blocks(ctx.cameras, inputs[0]):
            here = block.here
            a, b = solution[0][here], solution[1][here]
            gx, gy, gz = (by_rays[i][here] for i in range(3))
            if not bool(valid[here].all()):
                # what comes back of an invalid pixel need not be finite
                gx, gy, gz = (torch.where(valid[here], g, 0.0) for g in (gx, gy, gz))
            (ga, gb), by_optics = block.domain.chart.to_ray_vjp(a, b, gx, gy, gz, sums.wants_distortion)
            at = block.domain.lens.at(a, b)
            if at.stages:
                ua, ub, va, vb = at.jacobian
                ga, gb = newton_step((ua, va, ub, vb), ga, gb)
                if sums.wants_distortion:
                    by_optics = by_optics + at.vjp(-ga, -gb)[1]
            sums.add_optics(block, by_optics)
            focal_x, focal_y, _, _ = block.intrinsics
            ga, gb = ga / focal_x, gb / focal_y
            sums.add_intrinsics(block, -ga, -gb, *at.value)
            if by_pixels is not None:
                by_pixels[here][..., 0], by_pixels[here][..., 1] = ga, gb
        return by_pixels, *sums.result(), None, None, None


def _unproject_block(block: _Block, pixels: Tensor, rays: Tensor, solution: Tensor | None, valid: Tensor):
    """Write rays, solutions and validity; returns the places and targets of the points that are left open, if any."""
    chart = block.domain.chart
    p, q, known = formulas.to_target(*_planes(pixels[block.here]), block.intrinsics)
    known = formulas.both(known, block.usable)
    p, q = formulas.replace(known, p, 0.0), formulas.replace(known, q, 0.0)
    left = None
    if block.domain.lens.stages:
        found = invert(block.domain, p, q)
        solved = formulas.to_mask(found.solved)
        a, b = formulas.clean(solved, found)
        if solved is not None:
            camera, point = ((found.possible > 0) & ~(solved > 0)).nonzero(as_tuple=True)
            if len(camera):
                left = (
                    camera + block.cameras.start,
                    point + block.points.start,
                    p[camera, point],
                    q[camera, point],
                )
    else:
        solved = formulas.to_mask(chart.on_plane(p, q))
        a, b = formulas.replace(solved, p, 0.0), formulas.replace(solved, q, 0.0)
    mask = formulas.both(known, solved)
    x, y, z = chart.to_ray(a, b, 1)
    _write(rays, block.here, (formulas.replace(mask, w, axis) for w, axis in ((x, 0.0), (y, 0.0), (z, 1.0))))
    _write(solution, block.here, (a, b))
    if mask is not None:
        valid[block.here] = mask > 0
    return left


def _write(planes: Tensor | None, here: tuple, results: Iterable[Tensor]) -> None:
    if planes is not None:
        for plane, result in zip(planes, results, strict=True):
            plane[here] = result


class _Sums:
    """The cotangents of the parameters, gathered from the blocks."""

    def __init__(self, cameras: Cameras, needs_input_grad: tuple[bool, ...], like: Tensor):
        self.cameras = cameras
        self.wants_intrinsics, self.wants_distortion = needs_input_grad[1:3]
        count = len(cameras.intrinsics)
        self.intrinsics = like.new_zeros(count, 4)
        learning = _parameters(cameras.domain.chart, cameras.domain.lens) if self.wants_distortion else ()
        self.optics = [like.new_zeros(count, 1) for _ in learning]

    def add_intrinsics(self, block: _Block, gu: Tensor, gv: Tensor, x: Tensor, y: Tensor) -> None:
        """gu, gv: the cotangents of pixels. x, y: the points on the plane of the lens."""
        if self.wants_intrinsics:
            for i, plane in enumerate((gu * x, gv * y, gu, gv)):
                self.intrinsics[block.cameras, i] += plane.sum(-1)

    def add_optics(self, block: _Block, sums: list[Tensor]) -> None:
        """sums: those of the chart's parameters, then those of the lens."""
        for total, part in zip(self.optics, sums, strict=True):
            total[block.cameras] += part

    def result(self) -> tuple[Tensor | None, Tensor | None]:
        """Those of the intrinsics and of the distortion, whose part in chart and lens is whatever the model says."""
        by_distortion = None
        if self.wants_distortion:
            with torch.enable_grad():
                k = self.cameras.domain.k.detach().requires_grad_()
                pairs = zip(_parameters(*self.cameras.domain.optics(columns(k))), self.optics, strict=True)
                outputs, sums = zip(*(pair for pair in pairs if pair[0].requires_grad), strict=True)
                (by_distortion,) = torch.autograd.grad(outputs, k, sums, materialize_grads=True)
        return self.intrinsics if self.wants_intrinsics else None, by_distortion


def _parameters(chart: Chart, lens: Lens) -> tuple[Tensor, ...]:
    return *chart.parameters, *lens.parameters


def _by_formulas(again: Callable, inputs: list[Tensor], needs_input_grad: tuple[bool, ...], cotangent: Tensor):
    """The derivatives with a graph of their own."""
    wanted = [t for t, needed in zip(inputs, needs_input_grad, strict=False) if needed]
    result, _ = again(*inputs)
    gradients = iter(torch.autograd.grad(result, wanted, cotangent, create_graph=True, materialize_grads=True))
    return *(next(gradients) if needed else None for needed in needs_input_grad[:3]), None, None, None
