"""Calls of compiled code for poses and views, in threads; `rays.py` and `pnp.py` have the same formulas."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from ctypes import addressof, c_int64, c_void_p
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.native.library import library
from camtorch.poses.rotations import small_turn
from camtorch.projection.native_cameras import Native
from camtorch.values.threads import spread, thread_count

_FROM_RAYS, _REFINED, _SOLVED, _AGREED = range(4)
_LOSSES = (None, "huber", "cauchy")
_SHARED = 1 << 9  # points of poses for each further thread
_Poses = struct.Struct("11q5d10q").pack  # the struct `Poses` of native/poses.h
_Views = struct.Struct("16qd5q").pack  # the struct `Views` there


class Search(NamedTuple):
    """Settings of a pose search: the most Levenberg-Marquardt steps, the gain at which it ends, and the loss."""

    steps: int
    settled: float
    nothing: float
    damping: float
    loss: str | None = None
    loss_scale: float = 1.0


class Solved(NamedTuple):
    """B poses, with the fields of `pnp.Pose`; rms is infinite if a pose is not valid."""

    vectors: Tensor
    translations: Tensor
    rms: Tensor
    valid: Tensor
    inliers: Tensor
    covariance: Tensor


def can_search(*tensors: Tensor) -> bool:
    """Whether compiled code can search for poses of these tensors."""
    return library() is not None and all(t.is_cpu for t in tensors)


def from_rays(points: Tensor, rays: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return rotations (B, 2, 3, 3), translations and valid as `poses_from_rays` does; row b sees points[b % P]."""
    count = len(rays)
    rotations, translations = rays.new_empty(count, 2, 3, 3), rays.new_empty(count, 2, 3)
    results = rotations, translations, torch.empty(count, 2, dtype=torch.bool, device="cpu")
    _run(None, points, rays, None, weights, _FROM_RAYS, Search(0, 0.0, 0.0, 0.0), 0.0, results)
    return results


def refine_poses(
    native: Native, points: Tensor, pixels: Tensor, weights: Tensor, start: tuple[Tensor, Tensor], search: Search
) -> tuple[Tensor, Tensor, Tensor]:
    """Return rotations, translations and costs (B,) of the minima near `start`; row b sees points[b % P]."""
    converged, costs = torch.empty(len(pixels), dtype=torch.bool, device="cpu"), pixels.new_empty(len(pixels))
    rotations, translations = (torch.empty_like(t, memory_format=torch.contiguous_format) for t in start)
    results = rotations, translations, converged, costs
    _run(native, points, None, pixels, weights, _REFINED, search, 0.0, results, start)
    return rotations, translations, costs


def solve_poses(
    native: Native,
    points: Tensor,
    pixels: Tensor,
    weights: Tensor | None,
    search: Search,
    start: tuple[Tensor, Tensor] | None = None,
    threshold: float = 0.0,
) -> Solved:
    """Return the poses of points (P, N, 3) at pixels (B, N, 2); a `start` is for points about their seen middle."""
    batch, count, _ = pixels.shape
    native.add_table()
    sizes = (3, 3), (3,), (3,), (), (6, 6)
    rotations, translations, vectors, rms, covariance = (pixels.new_empty(batch, *size) for size in sizes)
    valid, inliers = (torch.empty(size, dtype=torch.bool, device="cpu") for size in (batch, (batch, count)))
    results = rotations, translations, valid, None, vectors, rms, inliers, covariance
    task = _SOLVED if start is None else _AGREED
    _run(native, points, None, pixels, weights, task, search, threshold, results, start or ())
    return Solved(vectors, translations, rms, valid, inliers, covariance)


class Errors(NamedTuple):
    """Residuals, costs and weights of a camera's observations at a state; see `Bundle.errors_of`."""

    residuals: Tensor  # (B, V, N, 2)
    valid: Tensor  # (B, V, N)
    weights: Tensor  # (B, V, N), of the squares
    cost: Tensor  # (B, V)
    triangles: tuple[Tensor, Tensor] | None = None  # of `Equations`, without priors, if compiled code made them


def project_views(
    native: Native,
    points: Tensor,
    poses: tuple[Tensor, Tensor],
    pixels: Tensor,
    weights: Tensor,
    loss: tuple[str | None, float],
    learnt: Sequence[int] | None = None,
) -> Errors:
    """Return residuals and weights of points (B, V, N, 3) seen by cameras (B,), or one, at pixels (B, V, N, 2).

    Triangles are made if `learnt` lists the parameters that learn. poses: (B, V, 3, 3), (B, V, 3). loss: name, scale.
    """
    compiled, plan, left = library(), native.plan, c_int64(0)
    assert compiled is not None  # a `Native` exists only with the library
    valid = torch.empty(weights.shape, dtype=torch.bool, device="cpu")
    residuals, weighed, cost = (t.new_empty(t.shape) for t in (pixels, weights, weights[..., 0]))
    wanted = learnt or ()
    if plan.places is not None and not plan.is_all:  # the place of each coefficient among the camera's parameters
        at = {4 + place: 4 + i for i, place in enumerate(plan.places.tolist())}
        wanted = [at.get(number, number) for number in wanted]
    count = 0 if learnt is None else len(points)
    size, numbers = len(wanted) + 1, (c_int64 * (len(wanted) + 1))(*wanted)
    view, shared = points.new_empty(count, points.shape[1], 6, 6 + size), points.new_empty(count, size, size)
    points = points if points.stride()[2:] == (3, 1) else points.contiguous()
    given = [t.contiguous() for t in (*poses, pixels, weights)]
    call = _Views(
        *(native.pointer, points.data_ptr(), *points.stride()[:2]),
        *(t.data_ptr() for t in (*given, residuals, weighed, valid, cost)),
        *(*points.shape[:3], _LOSSES.index(loss[0]), loss[1]),
        *(addressof(numbers), size - 1, view.data_ptr(), shared.data_ptr(), addressof(left)),
    )
    compiled.camtorch_views(call)
    while left.value:
        if left.value < 0:
            raise MemoryError(f"no memory for {points.shape[1]} views of {points.shape[2]} points. Pass fewer")
        left.value = 0
        native.follow()
        compiled.camtorch_views(call)
    return Errors(residuals, valid, weighed, cost, None if learnt is None else (view, shared))


def turn(rotations: Tensor, steps: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) after small turns by the first three numbers of steps (..., n)."""
    compiled = library() if rotations.is_cpu and rotations.dtype == torch.float64 else None
    if compiled is None:
        return small_turn(steps[..., :3]) @ rotations
    made, steps = rotations.clone(memory_format=torch.contiguous_format), steps.contiguous()
    places = c_void_p(steps.data_ptr()), c_int64(steps.shape[-1]), c_void_p(made.data_ptr())
    compiled.camtorch_turns(*places, c_int64(made.numel() // 9))
    return made


def _run(
    native: Native | None,
    points: Tensor,
    rays: Tensor | None,
    pixels: Tensor | None,
    weights: Tensor | None,
    task: int,
    search: Search,
    threshold: float,
    results: tuple[Tensor | None, ...],
    start: tuple[Tensor, ...] = (),
) -> None:
    """Run the compiled task, again if points need lens values that are not known yet. `start`: the first results."""
    compiled = library()
    assert compiled is not None  # see `can_search`
    given = [None if t is None else t.contiguous() for t in (points, rays, pixels, weights)]
    rows = next(t for t in (rays, pixels) if t is not None)
    batch, count = rows.shape[:2]
    counters, threads = (c_int64 * 2)(), min(thread_count(), batch, 1 + batch * count // _SHARED) if batch > 1 else 1
    call = _Poses(
        0 if native is None else native.pointer,
        *(0 if t is None else t.data_ptr() for t in given),
        *(len(points), batch, count, task, _LOSSES.index(search.loss), search.steps),
        *(search.loss_scale, search.settled, search.nothing, search.damping, threshold),
        *(0 if t is None else t.data_ptr() for t in results),
        *(*[0] * (8 - len(results)), addressof(counters), addressof(counters) + 8),
    )
    while True:
        for to, first in zip(results, start, strict=False):
            assert to is not None
            to.copy_(first)
        counters[:] = [0, 0]
        spread(lambda: compiled.camtorch_poses(call), threads)
        if counters[1] < 0:
            raise MemoryError(f"no memory for poses of {count} points")
        if not counters[1] or native is None:
            return
        native.follow()
