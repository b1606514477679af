"""Both directions between rays and pixels, on planes (C, N), as formulas that a graph can be recorded of."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from camtorch._tracing import may_look
from camtorch.optics.charts import floor_of
from camtorch.projection.solve import Found, attach

if TYPE_CHECKING:
    from camtorch.optics.charts import Chart
    from camtorch.optics.lens import Lens
    from camtorch.projection.domain import Domain

Planes2 = tuple[Tensor, Tensor]
Planes3 = tuple[Tensor, Tensor, Tensor]

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
    """Points (u, v) of the plane, and the mask of those that count, or None where all do."""

    u: Tensor
    v: Tensor
    mask: Tensor | None


def indicator(margin: Tensor) -> Tensor:
    """The mask of where a margin is positive: 1 and 0 of the same dtype.

    On a CPU selecting by numbers is several times as fast as by bools, and compiled code writes bools one by one.
    """
    margin = margin.detach()
    if torch.compiler.is_compiling():
        return (margin > 0).to(margin.dtype)
    return margin.nan_to_num(-1.0).relu().sign()


def to_mask(margin: Tensor | None) -> Tensor | None:
    """The indicator of a margin; None if a look at it shows that it is positive everywhere."""
    if margin is None or (may_look(margin) and bool(margin.amin() > 0)):
        return None
    return indicator(margin)


def replace(mask: Tensor | None, plane: Tensor, value: float) -> Tensor:
    """The plane where the mask is 1, and the value where it is 0. Needs finite numbers in both places."""
    if mask is None:
        return plane
    if plane.requires_grad or not may_look(plane):  # a cotangent need not be finite
        return torch.where(mask > 0, plane, value)
    return plane * mask if value == 0 else torch.lerp(plane.new_full((1, 1), value), plane, mask)


def both(*masks: Tensor | None) -> Tensor | None:
    """Where all masks are 1."""
    product = None
    for mask in masks:
        if mask is not None:
            product = mask if product is None else product * mask
    return product


def normalise(chart: Chart, x: Tensor, y: Tensor, z: Tensor) -> Ray:
    """Points as rays that the chart covers."""
    shrink = valid = None
    if may_look(x):
        bounds = [float(bound) for plane in (x, y, z) for bound in plane.detach().aminmax()]
        near = bounds[4]
        # NaN fails every comparison, and max() may pass over it
        tame = near > _SMALL and all(abs(bound) < _LARGE for bound in bounds)
        if tame and chart.covers_all(near, max(map(abs, bounds)), x.dtype):
            return Ray(x, y, z, None, None)
    x_0, y_0, z_0 = (plane.detach() for plane in (x, y, z))
    size = torch.maximum(torch.maximum(x_0.abs(), y_0.abs()), z_0.abs())
    if not (may_look(size) and float(size.amin()) > _SMALL and float(size.amax()) < _LARGE):
        # NaN fails both comparisons; nearer to the origin the derivative leaves the floating-point range
        valid = ((size > floor_of(size.dtype)) & (size < torch.inf)).to(size.dtype)
        # a constant: the projection does not depend on the distance, so this has no part in its derivative
        shrink = as_kept(_power_of_two(torch.where(valid > 0, size, 1.0)).reciprocal())
        x_0, y_0, z_0 = (torch.where(valid > 0, w, axis) * shrink for w, axis in ((x_0, 0.0), (y_0, 0.0), (z_0, 1.0)))
        x, y, z = (torch.where(valid > 0, w, axis) * shrink for w, axis in ((x, 0.0), (y, 0.0), (z, 1.0)))
    mask = both(valid, to_mask(chart.margin(x_0, y_0, z_0)))
    mask = as_kept(mask)
    return Ray(replace(mask, x, 0.0), replace(mask, y, 0.0), replace(mask, z, 1.0), shrink, mask)


def as_kept(plane: Tensor | None) -> Tensor | None:
    """The plane, for inductor to compute once: it repeats the whole expression of what is used twice while it compiles.

    That grows exponentially with the depth. Of views by strides it knows that they need a place in memory.
    """
    if plane is None or not torch.compiler.is_compiling():
        return plane
    return torch.as_strided(plane, plane.shape, plane.stride())


def _power_of_two(size: Tensor) -> Tensor:
    """The largest one not above: to divide by it costs no bit."""
    if torch.compiler.is_compiling():  # which leaves its vectors for bits
        return size
    exponent, integer = (0x7F800000, torch.int32) if size.dtype == torch.float32 else (0x7FF << 52, torch.int64)
    return (size.view(integer) & exponent).view(size.dtype)


def see(ray: Ray, chart: Chart, lens: Lens, domain: Domain, order: int, scale: Tensor | None = None) -> PlanePoints:
    """Where the lens sends a ray on its own plane, the centre if it sends it nowhere.

    lens: it may carry a graph. domain: that of the same lens, without one. scale: the chart's, if it is known.
    """
    a, b = chart.to_plane(ray.x, ray.y, ray.z, order, scale)
    mask = ray.mask
    if lens.stages:
        t = torch.addcmul(a * a, b, b)
        inside = as_kept(to_mask(domain.margin(a.detach(), b.detach(), t.detach())))
        a, b, t = (replace(inside, w, 0.0) for w in (a, b, t))
        a, b = lens.at(a, b, 0, t).value
        mask = both(mask, inside)
    return PlanePoints(a, b, mask)


def to_target(u: Tensor, v: Tensor, intrinsics: tuple[Tensor, ...]) -> PlanePoints:
    """Pixels on the plane of the lens; the centre where they are no numbers, or so large that a square overflows."""
    focal_x, focal_y, centre_x, centre_y = intrinsics
    p, q = (u - centre_x) / focal_x, (v - centre_y) / focal_y
    far = torch.maximum(p.detach().abs(), q.detach().abs())
    limit = torch.finfo(far.dtype).max ** 0.25
    if may_look(far) and float(far.amax()) < limit:
        return PlanePoints(p, q, None)
    mask = (far < limit).to(far.dtype)
    p, q = ((torch.where(mask > 0, w, c) - c) / f for w, c, f in ((u, centre_x, focal_x), (v, centre_y, focal_y)))
    return PlanePoints(p, q, mask)


def clean(mask: Tensor | None, found: Found) -> Planes2:
    """The solved points; the centre for the others, which may have run away."""
    planes = replace(mask, found.a, 0.0), replace(mask, found.b, 0.0)
    if mask is None or torch.compiler.is_compiling():
        return planes
    return planes[0].nan_to_num(0.0, 0.0, 0.0), planes[1].nan_to_num(0.0, 0.0, 0.0)


def rays_of(solution: Planes2, target: Planes2, mask: Tensor | None, chart: Chart, lens: Lens, order: int) -> Planes3:
    """The rays of plane points, with the derivatives up to `order` of lens(point) = target; the axis where masked.

    Order 0 leaves the graph of the lens out.
    """
    a, b = solution
    if not lens.stages:
        a, b = (replace(mask, w, 0.0) for w in target)
    elif order:
        a, b = attach(lens, solution, tuple(replace(mask, w, 0.0) for w in target), order)
    x, y, z = chart.to_ray(a, b, order)
    return tuple(replace(mask, w, axis) for w, axis in ((x, 0.0), (y, 0.0), (z, 1.0)))
