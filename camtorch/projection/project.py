"""Rays to pixels: the formula and what makes a point invalid, block by block or recorded in a graph."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from camtorch._arguments import columns
from camtorch._threads import on_one_thread
from camtorch.optics.charts import Planes3, floor_of
from camtorch.projection.ops import as_kept, positive, power_of_two, to_planes, without_keeping
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

if TYPE_CHECKING:
    from camtorch.camera import Camera
    from camtorch.optics.charts import Chart
    from camtorch.optics.lens import Lens
    from camtorch.projection.domain import Domain

INVALID_PIXEL = -1.0  # outside every image, so that `contains` is False for it as well
# Between these sizes the formulas need no scaling
_SMALL, _LARGE = 1e-3, 1e6


class Ray(NamedTuple):
    """A ray with its largest component near 1: the point times `shrink`, or the axis where `mask` is 0.

    shrink, mask: None where they are all 1.
    """

    x: Tensor
    y: Tensor
    z: Tensor
    shrink: Tensor | None
    mask: Tensor | None


class PlanePoints(NamedTuple):
    """Points (a, b) of the sensor in focal lengths; the centre where `mask` is 0, None where it is all 1.

    scale: the chart's, for backward. is_plain: whether the rays were taken as they came.
    """

    a: Tensor
    b: Tensor
    mask: Tensor | None
    scale: Tensor | None
    is_plain: bool


def normalise(chart: Chart, x: Tensor, y: Tensor, z: Tensor, adaptive: bool) -> Ray:
    """Points as rays that the chart covers; invalid: not finite, the origin, or not covered."""
    shrink = valid = None
    if adaptive:
        bounds = [float(bound) for plane in (x, y, z) for bound in plane.aminmax()]
        near, extent = bounds[4], max(map(abs, bounds))
        # NaN fails every comparison, and max() may pass over it
        tame = near > _SMALL and extent < _LARGE and sum(bounds) < torch.inf
        if tame and chart.covers_all(near, extent, x.dtype):
            return Ray(x, y, z, None, None)
    x_0, y_0, z_0 = x.detach(), y.detach(), z.detach()
    size = torch.maximum(torch.maximum(x_0.abs(), y_0.abs()), z_0.abs())
    if not (adaptive and float(size.amin()) > _SMALL and float(size.amax()) < _LARGE):
        # NaN fails both comparisons; nearer to the origin the derivative leaves the floating-point range
        valid = ((size > floor_of(size.dtype)) & (size < torch.inf)).to(size.dtype)
        # a constant: the projection does not depend on the distance, so this has no part in its derivative
        shrink = as_kept(power_of_two(torch.where(valid > 0, size, 1.0)).reciprocal())
        x_0, y_0, z_0 = (torch.where(valid > 0, w, axis) * shrink for w, axis in ((x_0, 0.0), (y_0, 0.0), (z_0, 1.0)))
        x, y, z = (torch.where(valid > 0, w, axis) * shrink for w, axis in ((x, 0.0), (y, 0.0), (z, 1.0)))
    mask = both(valid, to_mask(chart.margin(x_0, y_0, z_0), adaptive))
    mask = None if mask is None else as_kept(mask)
    x, y, z = (replace(mask, w, axis, adaptive) for w, axis in ((x, 0.0), (y, 0.0), (z, 1.0)))
    return Ray(x, y, z, shrink, mask)


def see(
    points: Planes3,
    chart: Chart,
    lens: Lens,
    domain: Domain,
    usable: Tensor | None,
    order: int,
    adaptive: bool = False,
    without_tables: bool = False,
) -> PlanePoints:
    """Where points, planes (C, N), are seen: the formula of every camera, and all that makes a point invalid.

    Args:
        points: x, y, z.
        chart: it may carry a graph.
        lens: likewise.
        domain: that of the same lens, without a graph.
        usable: the mask of the cameras whose parameters make a camera.
        order: of the derivatives that shall be exact.
        adaptive: whether a look at the values may find a shorter way, and no graph is recorded.
        without_tables: whether the points are few, and the camera is about to change, which tables are too dear for.
    """
    x, y, z, shrink, mask = normalise(chart, *points, adaptive)
    is_plain = shrink is None and mask is None
    scale = chart.scale(x, y, z, order) if chart.has_scale else None
    a, b = chart.to_plane(x, y, z, order, scale)
    if lens.stages:
        t = torch.addcmul(a * a, b, b)
        inside = None
        if not (without_tables and domain.radii_without_fold(t.amax(-1, keepdim=True)) is not None):
            inside = domain.inner2 - t.detach()
            if adaptive and bool(inside.amin() > 0):
                inside = None
            else:
                if not lens.is_radial:
                    inside = domain.margin(a.detach(), b.detach(), t.detach(), adaptive)
                inside = to_mask(inside, adaptive)
        if inside is not None:
            inside = as_kept(inside)
            a, b, t = (replace(inside, w, 0.0, adaptive) for w in (a, b, t))
            mask = inside if mask is None else mask * inside
        a, b = lens.at(a, b, 0, t).value
    return PlanePoints(a, b, mask if usable is None else both(mask, usable), scale, is_plain)


class Project(Function):
    """Rows of points (C, N, 3), intrinsics (C, 4), distortion (C, n) -> pixels (2, C, N), valid (C, N).

    Block by block, without a graph: temporaries stay in the cache, and backward computes again what is not dear.
    """

    @staticmethod
    def traced(
        model: type[Camera],
        points: Tensor,
        intrinsics: Tensor,
        distortion: Tensor,
        cameras: Cameras | None,
        order: int = 2,
    ) -> tuple[Tensor, Tensor]:
        """The same, recorded in a graph or by a transform. cameras: if values may be looked at."""
        usual = Traced.of(model, intrinsics, distortion, cameras)

        def evaluate(x: Tensor, y: Tensor, z: Tensor, intrinsics: Tensor, distortion: Tensor) -> tuple[Tensor, Tensor]:
            chart, lens = model.optics(columns(distortion))
            a, b, mask, _, _ = see((x, y, z), chart, lens, usual.domain, usual.usable, order)
            focal_x, focal_y, centre_x, centre_y = columns(intrinsics)
            planes = focal_x * a + centre_x, focal_y * b + centre_y
            pixels = torch.stack([replace(mask, w, INVALID_PIXEL) for w in planes])
            return pixels, torch.ones_like(pixels[0]) if mask is None else mask.expand_as(pixels[0])

        pixels, mask = without_keeping(evaluate, *to_planes(points), usual.intrinsics, usual.distortion)
        return pixels, positive(mask)

    @staticmethod
    @on_one_thread
    def forward(
        ctx: Any,
        points: Tensor,
        intrinsics: Tensor,
        distortion: Tensor,
        cameras: Cameras,
        model: type[Camera],
        keeps: bool,
    ) -> tuple[Tensor, Tensor]:
        """keeps: whether there will be a backward."""
        shape = points.shape[:2]
        pixels = points.new_empty(2, *shape)
        valid = torch.ones(shape, dtype=torch.bool, device=points.device)
        scales = points.new_empty(shape if keeps and cameras.domain.chart.has_scale else (0, 0))
        adaptive = cameras.adaptive
        without_tables = adaptive and ctx.needs_input_grad[2] and shape[1] <= FEW

        def evaluate(block: Block) -> tuple[tuple[int, int], bool]:
            """Where it begins, and whether the formula took all of it as it came."""
            here, domain = block.here, block.domain
            x, y, z = planes_of(points[here])
            a, b, mask, scale, is_plain = see(
                (x, y, z), domain.chart, domain.lens, domain, block.usable, 1, adaptive, without_tables
            )
            for plane, m, focal, centre in zip(pixels, (a, b), block.intrinsics[:2], block.intrinsics[2:], strict=True):
                torch.add(focal * m, centre, out=plane[here])
                if mask is not None:
                    plane[here] = replace(mask, plane[here], INVALID_PIXEL, adaptive)
            if mask is not None:
                valid[here] = mask > 0
            if scale is not None and scales.numel():
                scales[here] = scale
            return block.first, mask is None and is_plain

        ctx.plain = dict(over_blocks(cameras, points, evaluate))
        if keeps:
            # a copy: what is handed out belongs to the caller
            ctx.save_for_backward(
                points, intrinsics, distortion, None if all(ctx.plain.values()) else valid.clone(), scales
            )
            ctx.cameras, ctx.model = cameras, model
        ctx.mark_non_differentiable(valid)
        ctx.set_materialize_grads(False)
        return pixels, valid

    @staticmethod
    @on_one_thread
    def backward(ctx: Any, by_pixels: Tensor | None, _: Tensor | None) -> tuple[Tensor | None, ...]:
        """The cotangents of points and parameters; with a graph if that is asked for."""
        if by_pixels is None:
            return (None,) * 6
        *inputs, valid, scales = ctx.saved_tensors
        wanted, cameras = ctx.needs_input_grad, ctx.cameras
        if torch.is_grad_enabled():
            again = by_formulas(lambda p, i, d: Project.traced(ctx.model, p, i, d, cameras), inputs, wanted, by_pixels)
            return *again, None, None, None
        points, adaptive = inputs[0], cameras.adaptive
        sums = Sums(cameras, wanted, points)
        by_points = torch.empty_like(points) if wanted[0] else None

        def evaluate(block: Block) -> tuple[Block, list[Tensor], list[Tensor]]:
            here, chart = block.here, block.domain.chart
            x, y, z = planes_of(points[here])
            shrink = mask = None
            # a sum is rounded by how what it adds lies in memory
            gu, gv = planes_of(by_pixels.movedim(0, -1)[here])
            if not ctx.plain[block.first]:
                x, y, z, shrink, _ = normalise(chart, x, y, z, adaptive)
                mask = valid[here].to(x.dtype)
                x, y, z = (replace(mask, w, axis, adaptive) for w, axis in ((x, 0.0), (y, 0.0), (z, 1.0)))
                # what comes back of an invalid point need not be finite
                gu, gv = (torch.where(valid[here], g, 0.0) for g in (gu, gv))
            scale = replace(mask, scales[here], 1.0, adaptive) if scales.numel() else None
            at = block.domain.lens.at(*chart.to_plane(x, y, z, 1, scale))
            of_intrinsics = sums.of_intrinsics(gu, gv, *at.value)
            wants = sums.wants_distortion
            (ga, gb), by_lens = at.vjp(gu * block.intrinsics[0], gv * block.intrinsics[1], wants)
            by_ray: tuple[Tensor, ...] = ()
            by_chart: list[Tensor] = []
            if by_points is not None or (wants and chart.parameters):
                by_ray, by_chart = chart.to_plane_vjp(x, y, z, ga, gb, scale, wants)
            if by_points is not None:
                for i, w in enumerate(by_ray):
                    by_points[here][..., i] = w if shrink is None else w * shrink
            return block, of_intrinsics, by_chart + by_lens

        for parts in over_blocks(cameras, points, evaluate):
            sums.add(*parts)
        return by_points, *sums.result(), None, None, None
