"""Points of rays on a camera's sensor plane, also beyond folds, and their derivatives by ray and coefficients."""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from camtorch.optics.backprojection import Inverted
from camtorch.projection.camera_like import CameraLike
from camtorch.values.arguments import columns

FURTHEST = 20.0  # the furthest points of a fit from the centre of a chart's plane: 87 degrees in perspective


class SensorPoints(NamedTuple):
    """Coordinates a, b (C, N) of points on the sensor plane, 0 if there is none, and whether there is one."""

    a: Tensor
    b: Tensor
    covered: Tensor


class SensorJacobians(NamedTuple):
    """`SensorPoints`, and their derivatives by rays (C, 2, 3, N) and by coefficients (C, 2, n, N), 0 if not finite."""

    points: SensorPoints
    by_ray: Tensor
    by_k: Tensor


def to_sensor(camera: CameraLike | type[CameraLike], k: Tensor, rays: Tensor) -> SensorPoints:
    """Map rays (C, N, 3) through the chart and the lens of coefficients (C, n), also beyond a fold."""
    return _to_sensor(camera, columns(k), rays.unbind(-1), FURTHEST)


def _to_sensor(
    camera: CameraLike | type[CameraLike], k: Sequence[Tensor], rays: Sequence[Tensor], furthest: float
) -> SensorPoints:
    chart, lens = camera.optics(k)
    x, y, z = rays
    covered = (chart.margin(x, y, z) > 0).expand_as(x)
    x, y, z = torch.where(covered, x, 0.0), torch.where(covered, y, 0.0), torch.where(covered, z, 1.0)
    a, b = chart.to_plane(x, y, z, order=1)
    covered = covered & (torch.maximum(a.abs(), b.abs()) <= furthest)
    if lens.stages:
        at = lens.at(a, b, 0)
        covered = covered if at.edge is None else covered & (at.edge > 0)
        a, b = at.value
    covered = covered & torch.isfinite(a) & torch.isfinite(b)
    return SensorPoints(torch.where(covered, a, 0.0), torch.where(covered, b, 0.0), covered)


def sensor_jacobians(
    camera: CameraLike | type[CameraLike], k: Tensor, rays: Tensor, furthest: float = FURTHEST
) -> SensorJacobians:
    """Return `to_sensor` with exact derivatives by rays (C, N, 3) of any length, and by coefficients (C, n)."""
    chart, _ = camera.optics(columns(k))
    # an inverted chart needs a table for each row of coefficients, too many if each point is a row: forward mode then
    jacobians = (_forward if isinstance(chart, Inverted) else _backward)(camera, k, rays, furthest)
    # a derivative that is not finite, as at the end of a chart, is left out of the step
    by_ray, by_k = (slopes.nan_to_num(0.0, 0.0, 0.0) for slopes in (jacobians.by_ray, jacobians.by_k))
    return SensorJacobians(jacobians.points, by_ray, by_k)


def _backward(camera: CameraLike | type[CameraLike], k: Tensor, rays: Tensor, furthest: float) -> SensorJacobians:
    """Differentiate backward, in two passes for any number of coefficients; each point has its own copy of these."""
    with torch.inference_mode(False), torch.enable_grad():
        shape, kept = rays.shape[:-1], torch.contiguous_format
        # contiguous planes are several times as fast; copies can require grad after inference mode
        planes = [w.clone(memory_format=kept).requires_grad_() for w in rays.detach().unbind(-1)]
        own = [c.expand(shape).clone(memory_format=kept).requires_grad_() for c in columns(k.detach())]
        points = _to_sensor(camera, own, planes, furthest)
        one, leaves = torch.ones(shape, dtype=rays.dtype, device=rays.device), [*planes, *own]
        slopes = [
            torch.autograd.grad(plane, leaves, one, retain_graph=True, allow_unused=True, materialize_grads=True)
            for plane in points[:2]
        ]
    by_all = torch.stack([torch.stack(row, 1) for row in slopes], 1)
    points = SensorPoints(points.a.detach(), points.b.detach(), points.covered)
    return SensorJacobians(points, by_all[:, :, :3], by_all[:, :, 3:])


def _forward(camera: CameraLike | type[CameraLike], k: Tensor, rays: Tensor, furthest: float) -> SensorJacobians:
    """Differentiate forward in one pass with a row for each derivative; vmap is slow in Python for many operations."""
    count = k.shape[-1] + 3
    directions = torch.eye(count, dtype=k.dtype, device=k.device)
    # inference mode would drop the derivatives
    with torch.inference_mode(False), warnings.catch_warnings(), forward_ad.dual_level():
        # on its first use forward mode loads code that calls the deprecated torch.jit.script
        warnings.simplefilter("ignore", DeprecationWarning)
        along = directions[:, None, :3].expand(-1, rays.shape[1], -1).repeat(len(rays), 1, 1)
        dual_rays = forward_ad.make_dual(rays.repeat_interleave(count, 0), along)
        dual_k = forward_ad.make_dual(k.repeat_interleave(count, 0), directions[:, 3:].repeat(len(k), 1))
        seen = _to_sensor(camera, columns(dual_k), dual_rays.unbind(-1), furthest)
        parts = [forward_ad.unpack_dual(plane) for plane in seen[:2]]
    values = [part.primal[::count] for part in parts]
    tangents = [torch.zeros_like(part.primal) if part.tangent is None else part.tangent for part in parts]
    by_all = torch.stack(tangents, 1).unflatten(0, (len(k), count)).transpose(1, 2)
    points = SensorPoints(values[0], values[1], seen.covered[::count])
    return SensorJacobians(points, by_all[:, :, :3], by_all[:, :, 3:])
