"""Calls of native code for poses and views, in threads; `rays.py` and `pnp.py` have the same formulas."""

from collections.abc import Sequence
from ctypes import addressof, c_int64
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.calibration.robust import LEAST_SQUARES, Loss
from camtorch.native import structs
from camtorch.native.library import library, loaded
from camtorch.poses.rotations import small_turn
from camtorch.projection.native_cameras import Native
from camtorch.values.threads import spread, thread_count

_LOSSES = {None: structs.LEAST_SQUARES, "huber": structs.HUBER, "cauchy": structs.CAUCHY}
_SHARED = 1 << 9  # points of poses for each further thread


class PoseSearch(NamedTuple):
    """Settings of a pose search: the most Levenberg-Marquardt steps, the gain at which it ends, and the loss."""

    steps: int
    settled: float
    nothing: float
    damping: float
    loss: Loss = LEAST_SQUARES


class Solved(NamedTuple):
    """B poses, with the fields of `pnp.Pose`; rms is infinite if a pose is not valid."""

    vectors: Tensor
    translations: Tensor
    rms: Tensor
    valid: Tensor
    inliers: Tensor
    covariance: Tensor


def from_rays(points: Tensor, rays: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return rotations (B, 2, 3, 3), translations and valid as `poses_from_rays` does; row b sees points[b % P]."""
    count, call = len(rays), structs.Poses(task=structs.FROM_RAYS)
    rotations, translations = rays.new_empty(count, 2, 3, 3), rays.new_empty(count, 2, 3)
    valid = torch.empty(count, 2, dtype=torch.bool, device="cpu")
    call.rays, call.valid = call.keep(rays.contiguous()), valid.data_ptr()
    _run(call, None, points, rays, weights, PoseSearch(0, 0.0, 0.0, 0.0), (rotations, translations))
    return rotations, translations, valid


def refine_poses(
    native: Native, points: Tensor, pixels: Tensor, weights: Tensor, start: tuple[Tensor, Tensor], search: PoseSearch
) -> tuple[Tensor, Tensor, Tensor]:
    """Return rotations, translations and costs (B,) of the minima near `start`; row b sees points[b % P]."""
    call, costs = structs.Poses(task=structs.REFINED), pixels.new_empty(len(pixels))
    rotations, translations = (torch.empty_like(t, memory_format=torch.contiguous_format) for t in start)
    call.pixels, call.costs = call.keep(pixels.contiguous()), costs.data_ptr()
    call.valid = call.keep(torch.empty(len(pixels), dtype=torch.bool, device="cpu"))
    _run(call, native, points, pixels, weights, search, (rotations, translations), start)
    return rotations, translations, costs


def solve_poses(
    native: Native,
    points: Tensor,
    pixels: Tensor,
    weights: Tensor | None,
    search: PoseSearch,
    start: tuple[Tensor, Tensor] | None = None,
    threshold: float = 0.0,
) -> Solved:
    """Return the poses of points (P, N, 3) at pixels (B, N, 2); a `start` is for points about their seen middle."""
    batch, count, _ = pixels.shape
    native.add_table()
    sizes = (3, 3), (3,), (3,), (), (6, 6)
    rotations, translations, vectors, rms, covariance = (pixels.new_empty(batch, *size) for size in sizes)
    valid, inliers = (torch.empty(size, dtype=torch.bool, device="cpu") for size in (batch, (batch, count)))
    call = structs.Poses(task=structs.SOLVED if start is None else structs.AGREED, threshold=threshold)
    call.pixels, call.valid, call.vectors = call.keep(pixels.contiguous()), valid.data_ptr(), vectors.data_ptr()
    call.rms, call.inliers, call.covariance = rms.data_ptr(), inliers.data_ptr(), covariance.data_ptr()
    _run(call, native, points, pixels, weights, search, (rotations, translations), start or ())
    return Solved(vectors, translations, rms, valid, inliers, covariance)


class Errors(NamedTuple):
    """Residuals, costs and weights of a camera's observations at a state; see `Bundle.errors_of`."""

    residuals: Tensor  # (B, V, N, 2)
    valid: Tensor  # (B, V, N)
    weights: Tensor  # (B, V, N), of the squares
    cost: Tensor  # (B, V)
    triangles: tuple[Tensor, Tensor] | None = None  # of `Equations`, without priors, if native code made them


def project_views(
    native: Native,
    points: Tensor,
    poses: tuple[Tensor, Tensor],
    pixels: Tensor,
    weights: Tensor,
    loss: Loss,
    learnt: Sequence[int] | None = None,
) -> Errors:
    """Return residuals and weights of points (B, V, N, 3) seen by cameras (B,), or one, at pixels (B, V, N, 2).

    Triangles are made if `learnt` lists the parameters that learn. poses: (B, V, 3, 3), (B, V, 3).
    """
    compiled, plan, left = loaded(), native.plan, c_int64(0)
    valid = torch.empty(weights.shape, dtype=torch.bool, device="cpu")
    residuals, weighed, cost = (t.new_empty(t.shape) for t in (pixels, weights, weights[..., 0]))
    wanted = learnt or ()
    if plan.places is not None:  # the place of each coefficient among the camera's parameters
        at = {4 + place: 4 + i for i, place in enumerate(plan.places.tolist())}
        wanted = [at.get(number, number) for number in wanted]
    count = 0 if learnt is None else len(points)
    size, numbers = len(wanted) + 1, (c_int64 * (len(wanted) + 1))(*wanted)
    view, shared = points.new_empty(count, points.shape[1], 6, 6 + size), points.new_empty(count, size, size)
    points = points if points.stride()[2:] == (3, 1) else points.contiguous()
    call = structs.Views()
    call.cameras, call.points, call.point_strides[:] = native.pointer, points.data_ptr(), points.stride()[:2]
    call.rotations, call.translations, call.pixels, call.given = (
        call.keep(t.contiguous()) for t in (*poses, pixels, weights)
    )
    call.residuals, call.weights, call.valid, call.costs = (t.data_ptr() for t in (residuals, weighed, valid, cost))
    call.problems, call.views, call.count = points.shape[:3]
    call.loss, call.loss_scale = _LOSSES[loss.name], loss.scale
    call.learnt, call.columns, call.left = addressof(numbers), size - 1, addressof(left)
    call.view, call.shared = view.data_ptr(), shared.data_ptr()
    compiled.camtorch_views(call)
    while left.value:
        if left.value < 0:
            raise MemoryError(f"no memory for {points.shape[1]} views of {points.shape[2]} points. Pass fewer")
        left.value = 0
        native.follow()
        compiled.camtorch_views(call)
    return Errors(residuals, valid, weighed, cost, None if learnt is None else (view, shared))


def turned_by(rotations: Tensor, steps: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) after small turns by the first three numbers of steps (..., n)."""
    compiled = library() if rotations.is_cpu and rotations.dtype == torch.float64 else None
    if compiled is None:
        return small_turn(steps[..., :3]) @ rotations
    made, steps = rotations.clone(memory_format=torch.contiguous_format), steps.contiguous()
    compiled.camtorch_turns(steps.data_ptr(), steps.shape[-1], made.data_ptr(), made.numel() // 9)
    return made


def _run(
    call: structs.Poses,
    native: Native | None,
    points: Tensor,
    rows: Tensor,
    weights: Tensor | None,
    search: PoseSearch,
    poses: tuple[Tensor, Tensor],
    start: tuple[Tensor, ...] = (),
) -> None:
    """Run a task for rows of rays or pixels, again if points need lens values that are not known yet.

    Rotations and translations, which are `poses` in the end, begin at `start`.
    """
    batch, count = rows.shape[:2]
    counters, threads = (c_int64 * 2)(), min(thread_count(), batch, 1 + batch * count // _SHARED) if batch > 1 else 1
    call.cameras, call.points = None if native is None else native.pointer, call.keep(points.contiguous())
    call.weights = None if weights is None else call.keep(weights.contiguous())
    call.point_rows, call.row_count, call.count = len(points), batch, count
    call.loss, call.loss_scale, call.steps = _LOSSES[search.loss.name], search.loss.scale, search.steps
    call.settled, call.nothing, call.damping = search.settled, search.nothing, search.damping
    call.rotations, call.translations = (t.data_ptr() for t in poses)
    call.next, call.left = addressof(counters), addressof(counters) + 8
    run = partial(loaded().camtorch_poses, call)
    while True:
        for to, first in zip(poses, start, strict=False):
            to.copy_(first)
        counters[:] = [0, 0]
        spread(run, threads)
        if counters[1] < 0:
            raise MemoryError(f"no memory for poses of {count} points")
        if not counters[1] or native is None:
            return
        native.follow()
