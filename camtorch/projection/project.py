"""Rays to pixels: the formula and the reasons why a point is invalid, as torch records it, and in native code."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from camtorch.evaluate.recorded import as_kept, order_of, positive, power_of_two, to_planes, without_keeping
from camtorch.evaluate.tensors import may_branch_on
from camtorch.optics.charts import Planes3, floor_of
from camtorch.projection import native_calls
from camtorch.projection.camera_like import CameraLike
from camtorch.projection.rows import CameraRows, Direction, Traced, both, replace, to_mask
from camtorch.values.arguments import columns

if TYPE_CHECKING:
    from camtorch.optics.charts import Chart

_AXIS = 0.0, 0.0, 1.0
INVALID_PIXEL = -1.0  # outside every image, so that `contains` is False for it as well


def _normalise(chart: Chart, x: Tensor, y: Tensor, z: Tensor, looks: bool) -> tuple[Planes3, Tensor | None]:
    """Return rays, their largest component near 1, the axis for invalid ones, and the mask of those covered."""
    x_0, y_0, z_0 = x.detach(), y.detach(), z.detach()
    size = torch.maximum(torch.maximum(x_0.abs(), y_0.abs()), z_0.abs())
    # NaN fails both comparisons; closer to the origin the derivative leaves the floating-point range
    least = floor_of(size.dtype)
    are_finite = False
    if looks:
        smallest, largest = size.aminmax()
        are_finite = bool(smallest > least) and bool(largest < torch.inf)
    finite = None if are_finite else ((size > least) & (size < torch.inf)).to(size.dtype)
    # the factor is a constant: the projection does not depend on the distance, which has no part in the derivative
    shrink = as_kept(power_of_two(replace(finite, size, 1.0)).reciprocal())

    def shrunk(*ray: Tensor) -> list[Tensor]:
        return [replace(finite, w, axis) * shrink for w, axis in zip(ray, _AXIS, strict=True)]

    rays = shrunk(x, y, z)
    margin = chart.margin(*([w.detach() for w in rays] if looks else shrunk(x_0, y_0, z_0)))
    mask = both(finite, to_mask(margin, looks))
    mask = None if mask is None else as_kept(mask)
    x, y, z = (replace(mask, w, axis) for w, axis in zip(rays, _AXIS, strict=True))
    return (x, y, z), mask


def _formula(
    model: type[CameraLike],
    points: Tensor,
    intrinsics: Tensor,
    distortion: Tensor,
    cameras: CameraRows | None,
) -> tuple[Tensor, Tensor]:
    """Return pixels (2, C, N) for points (C, N, 3), and valid (C, N); see `Direction.formula`."""
    traced = Traced.of(model, intrinsics, distortion, cameras)
    looks, order = may_branch_on(points, intrinsics, distortion), order_of(points, intrinsics, distortion)

    def evaluate(
        x: Tensor, y: Tensor, z: Tensor, intrinsics: Tensor, distortion: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        chart, lens = traced.optics(distortion)
        rays, mask = _normalise(chart, x, y, z, looks)
        a, b = chart.to_plane(*rays, order)
        if lens.stages:
            t = torch.addcmul(a * a, b, b)
            inside = to_mask(traced.domain.margin(a.detach(), b.detach(), t.detach()), looks)
            inside = None if inside is None else as_kept(inside)
            a, b, t = (replace(inside, w, 0.0) for w in (a, b, t))
            mask = both(mask, inside)
            a, b = lens.at(a, b, 0, t).value
        seen = both(mask, traced.usable)
        focal_x, focal_y, centre_x, centre_y = columns(intrinsics)
        planes = focal_x * a + centre_x, focal_y * b + centre_y
        pixels = torch.stack([replace(seen, w, INVALID_PIXEL) for w in planes])
        return pixels, None if seen is None else seen.expand_as(pixels[0])

    pixels, mask = without_keeping(evaluate, *to_planes(points), traced.intrinsics, traced.distortion)
    return pixels, torch.ones_like(pixels[0], dtype=torch.bool) if mask is None else positive(mask)


PROJECT = Direction("points", 3, 2, _formula, native_calls.project, native_calls.project_vjp)
