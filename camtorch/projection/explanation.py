"""Why a point has no pixel, in words."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from camtorch._arguments import as_values, columns, working_dtype
from camtorch.optics.charts import floor_of
from camtorch.projection.rays import angles_from_axis

if TYPE_CHECKING:
    from collections.abc import Callable

    from camtorch.camera import Camera

_STEPS = 257


@torch.no_grad()
def explain(camera: Camera, points: Tensor) -> list[str]:
    """See `Camera.explain`."""
    valid = camera.project(points)[1]
    parameters = camera.intrinsics, camera.distortion
    points = as_values(points, "points", type(camera).__name__, camera.intrinsics.device)
    points = points.to(working_dtype(points, *parameters)).expand(*valid.shape, 3).reshape(-1, 3)
    lead = valid.shape[: len(camera.batch_shape)]
    intrinsics, distortion = (
        t.detach().to(points.dtype).expand(*lead, -1).reshape(math.prod(lead), t.shape[-1]) for t in parameters
    )
    each = max(len(points) // len(intrinsics), 1) if len(intrinsics) else 1
    lines = []
    for i, good in enumerate(valid.flatten().tolist()):
        if good:
            lines.append("valid")
        else:
            single = camera.with_tensors(intrinsics=intrinsics[i // each], distortion=distortion[i // each])
            lines.append(_unusable(single) or _reason(single, points[i]))
    return lines


def _unusable(camera: Camera) -> str:
    """Why a single camera has no pixels at all, or nothing."""
    names = ("fx", "fy", "cx", "cy", *camera.distortion_names)
    for name, value in zip(names, [*camera.intrinsics.tolist(), *camera.distortion.tolist()], strict=True):
        if not math.isfinite(value):
            return f"the camera itself is unusable: {name} = {value}"
        if name in ("fx", "fy") and value <= 0:
            return f"the camera itself is unusable: {name} = {value:.6g} is not positive"
    defined = camera.defined(camera.distortion.unbind(-1))
    if defined is not None and not bool((defined > 0).all()):
        return f"the camera itself is unusable: the formula needs {camera.defined_text}"
    return ""


def _reason(camera: Camera, point: Tensor) -> str:
    """Why a single usable camera has no pixel for a point (3,)."""
    shown = ", ".join(f"{value:.6g}" for value in point.tolist())
    if not bool(torch.isfinite(point).all()):
        return f"not finite: ({shown})"
    size = point.abs().amax()
    if not bool(size > floor_of(point.dtype)):
        return f"no direction: ({shown}) is the origin"
    ray = point / size
    theta = float(angles_from_axis(ray))
    angle = f"{math.degrees(theta):.2f} degrees from the optical axis"
    chart, _ = camera.optics(columns(camera.distortion[None]))

    def covered(rays: Tensor) -> Tensor:
        return (chart.margin(*rays.unbind(-1)) > 0).view(-1)

    if not bool(covered(ray[None])):
        end = _last(covered, ray, theta)
        what = "the backward direction" if theta == math.pi else angle
        return f"the chart does not cover it: {what}; on this side it ends at {math.degrees(end):.2f} degrees"
    fold = _last(lambda rays: camera.project(rays)[1], ray, theta)
    return f"beyond the fold at {math.degrees(fold):.2f} degrees: {angle}"


def _last(holds: Callable[[Tensor], Tensor], ray: Tensor, theta: float) -> float:
    """The angle up to which something holds from the axis on towards a ray at the angle theta."""
    across = ray[:2].double() / torch.linalg.vector_norm(ray[:2].double()).clamp(min=1e-300)
    low, high = 0.0, theta
    for _ in range(3):
        angles = torch.linspace(low, high, _STEPS, dtype=torch.float64, device=ray.device)
        rays = torch.cat((angles.sin()[:, None] * across, angles.cos()[:, None]), -1).to(ray.dtype)
        count = int(holds(rays).long().cumprod(0).sum())
        low, high = float(angles[max(count - 1, 0)]), float(angles[min(count, _STEPS - 1)])
    return low
