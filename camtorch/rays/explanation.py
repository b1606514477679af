"""Explanations in words why points have no pixel."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from camtorch.optics.charts import floor_of
from camtorch.projection.camera_like import CameraLike
from camtorch.projection.rows import unusable
from camtorch.rays.lattices import angles_from_axis, reach
from camtorch.values.arguments import Numbers, as_values, columns, working_dtype
from camtorch.values.module import remade


@torch.no_grad()
def explain(camera: CameraLike, points: Numbers) -> list[str]:
    """Return one line of explanation for each point; see `Camera.explain`."""
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
            row = {"intrinsics": intrinsics[i // each], "distortion": distortion[i // each]}
            found = unusable(camera, **row)
            lines.append(f"the camera itself is unusable: {found[1]}" if found else _reason(camera, row, points[i]))
    return lines


def _reason(camera: CameraLike, row: dict[str, Tensor], point: Tensor) -> str:
    camera = remade(camera, **row)
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

    def last(covers: Callable[[Tensor], Tensor]) -> float:
        """Return the angle up to which rays of the point's azimuth are covered."""
        x, y = ray[:2].double()
        azimuth = torch.atan2(y, x)[None]
        return float(reach(lambda rays: covers(rays.to(ray.dtype)), azimuth, most=theta, steps=256, rounds=3))

    def covered(rays: Tensor) -> Tensor:
        return chart.margin(*rays.unbind(-1)) > 0

    if not bool(covered(ray[None])):
        end = last(covered)
        backward = not bool(ray[:2].any())
        if backward and end > math.pi - 1e-3:
            return "the chart does not cover it: the backward direction, where all azimuths meet"
        what = "the backward direction" if backward else angle
        return f"the chart does not cover it: {what}; on this side it ends at {math.degrees(end):.2f} degrees"
    fold = last(lambda rays: camera.project(rays)[1])
    chart, lens = camera.optics(columns(camera.distortion[None].double()))
    behind = min(theta, fold + 1e-3)
    x, y = (torch.nn.functional.normalize(ray[:2].double(), dim=0) * math.sin(behind)).unsqueeze(-1)
    edge = lens.at(*chart.to_plane(x, y, x.new_tensor([math.cos(behind)]))).edge
    what = "fold" if edge is None or bool(edge > 0) else "edge of the surface"
    return f"beyond the {what} at {math.degrees(fold):.2f} degrees: {angle}"
