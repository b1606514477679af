"""Calls of the native geometry for rows of points or pixels: rows to pointers and strides, and tiles to threads."""

import functools
import operator
from collections.abc import Callable
from ctypes import addressof, c_int64
from typing import TypeVar

import torch
from torch import Tensor

from camtorch.native import memory, structs
from camtorch.native.library import loaded
from camtorch.projection.native_cameras import Native
from camtorch.values.threads import spread, thread_count

CallT = TypeVar("CallT")
TILE_POINTS = 1 << 14  # some 30 us
SHARED_POINTS = 1 << 15  # with fewer, to wake threads would take longer


def project(native: Native, points: Tensor, learns: bool = False) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """Return pixels (2, C, N) of points (C, N, 3), whether they are valid (C, N), and what `project_vjp` needs.

    That is the points, whether anything `learns` or not: a `Direction` passes this to both of its calls.
    """
    pixels, valid = _evaluate(native, structs.PROJECT, points, 2, None)
    return pixels, valid, (points,)


def unproject(native: Native, pixels: Tensor, learns: bool = False) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """Return unit rays (3, C, N) of pixels (C, N, 2), whether they exist (C, N), and what `unproject_vjp` needs.

    That is nothing unless it `learns`; else a copy of the mask, as the returned one belongs to the caller, and the
    points on the chart's plane (2, C, N).
    """
    native.add_table()
    solution = _empty((2, *pixels.shape[:2]), native.dtype) if learns else None
    rays, valid = _evaluate(native, structs.UNPROJECT, pixels, 3, solution)
    return rays, valid, () if solution is None else (valid.clone(), solution)


def _evaluate(
    native: Native, direction: int, rows: Tensor, size_out: int, solution: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the results (size_out, C, N) of rows (C, N, size) of any strides, and whether they are valid (C, N)."""
    cameras, count, _ = rows.shape
    results = _empty((size_out, cameras, count), native.dtype)
    valid = torch.empty(cameras, count, dtype=torch.bool, device="cpu")
    call = structs.Rows(direction=direction)
    call.rows, call.row_strides[:], call.valid = rows.data_ptr(), rows.stride(), valid.data_ptr()
    call.results, call.result_strides[:] = results.data_ptr(), (count, 1, cameras * count)
    if solution is not None:
        call.solution = solution.data_ptr()
    while _call(native, cameras, count, call):
        native.follow()
    return results, valid


def project_vjp(
    native: Native, points: Tensor, cotangents: Tensor, want_points: bool, want_parameters: bool
) -> tuple[Tensor | None, Tensor | None]:
    """Return the cotangents of points (C, N, 3), and of the cameras (C, 4 + n): intrinsics, `parameters` of the optics.

    `cotangents` are those of pixels, (2, C, N), of any strides.
    """
    call = structs.Rows()
    call.rows, call.row_strides[:], call.direction = points.data_ptr(), points.stride(), structs.PROJECT_VJP
    return _vjp(native, call, points.shape[:2], cotangents, 3 * want_points, want_parameters)


def project_jacobians(native: Native, points: Tensor, by_camera: bool) -> tuple[Tensor, Tensor]:
    """Return the derivatives of pixels by points, and, if `by_camera`, by the cameras' numbers: see `project_vjp`.

    They are (C, N, 2, 3) and (C, N, 2, 4 + n or 0), zero if there is no pixel.
    """
    cameras, count, _ = points.shape
    by_points = torch.empty(2, cameras, count, 3, dtype=native.dtype, device="cpu")
    sums = torch.zeros(2, cameras, count, (4 + native.plan.parameters) * by_camera, dtype=torch.float64, device="cpu")
    tile = 1 if by_camera else TILE_POINTS
    for one, by, to in zip(torch.eye(2, dtype=native.dtype, device="cpu"), by_points, sums, strict=True):
        call = structs.Rows()
        call.rows, call.row_strides[:], call.direction = points.data_ptr(), points.stride(), structs.PROJECT_VJP
        call.results, call.result_strides[:] = by.data_ptr(), by.stride()
        call.cotangents, call.cotangent_strides[:] = one.data_ptr(), (0, 0, 1)
        _differentiate(native, cameras, count, call, to if by_camera else None, tile)
    return by_points.movedim(0, 2), sums.movedim(0, 2)


def unproject_vjp(
    native: Native, valid: Tensor, solution: Tensor, cotangents: Tensor, want_pixels: bool, want_parameters: bool
) -> tuple[Tensor | None, Tensor | None]:
    """Return the cotangents of pixels (C, N, 2), and of the cameras, for results of `unproject`; see `project_vjp`."""
    call = structs.Rows()
    call.valid, call.solution, call.direction = valid.data_ptr(), solution.data_ptr(), structs.UNPROJECT_VJP
    return _vjp(native, call, valid.shape, cotangents, 2 * want_pixels, want_parameters)


def _vjp(
    native: Native, call: structs.Rows, shape: torch.Size, cotangents: Tensor, size: int, want_parameters: bool
) -> tuple[Tensor | None, Tensor | None]:
    """Return the cotangents of rows (*shape, size), None if the size is 0, and of the cameras, None if not wanted."""
    if cotangents.shape[1:] != shape:  # C would read elsewhere
        raise ValueError(f"cotangents must be of {tuple(shape)} rows; got {tuple(cotangents.shape[1:])}")
    cameras, count = shape
    results = _empty((cameras, count, size), native.dtype) if size else None
    tiles, sums = -(-count // TILE_POINTS), None
    if want_parameters:
        sums = torch.zeros(cameras, tiles, 4 + native.plan.parameters, dtype=torch.float64, device="cpu")
    if results is not None:
        call.results, call.result_strides[:] = results.data_ptr(), results.stride()
    component, *row = cotangents.stride()
    call.cotangents, call.cotangent_strides[:] = cotangents.data_ptr(), (*row, component)
    _differentiate(native, cameras, count, call, sums)
    return results, None if sums is None else sums.sum(1).to(native.dtype)


def _differentiate(
    native: Native, cameras: int, count: int, call: structs.Rows, sums: Tensor | None, tile: int = TILE_POINTS
) -> None:
    """Call the native geometry, which adds a row to zeros, `sums`, for each tile of each camera."""
    call.sums = None if sums is None else sums.data_ptr()
    while _call(native, cameras, count, call, tile):
        native.follow()
        if sums is not None:
            sums.zero_()


def _empty(size: tuple[int, int, int], dtype: torch.dtype) -> Tensor:
    # the first write to each page of a large result would take longer than the geometry
    if size[0] * size[1] * size[2] * dtype.itemsize >= memory.LEAST:
        return memory.empty(size, dtype, torch.contiguous_format)
    return torch.empty(size, dtype=dtype, device="cpu")


def _call(native: Native, cameras: int, count: int, call: structs.Rows, tile: int = TILE_POINTS) -> int:
    """Call the native geometry with rows, their results and the other arguments of `Rows`.

    Returns how many points lie so far out that they wait for the limits of azimuths, which `follow` makes.
    """
    if cameras != native.cameras:  # C would read elsewhere
        raise ValueError(f"rows must be of {native.cameras} cameras; got those of {cameras}")
    call.cameras, call.count, call.tile = native.pointer, count, tile
    run, points = loaded().camtorch_geometry, cameras * count
    if points < SHARED_POINTS:
        return run(call) if points else 0
    following = c_int64(0)
    call.next = addressof(following)
    return run_in_threads(run, call, min(thread_count(), -(-count // TILE_POINTS) * cameras))


def run_in_threads(run: Callable[[CallT], int], call: CallT, threads: int) -> int:
    """Return the flags of all threads that run a call; each takes tiles until none is left."""
    left: list[int] = []
    spread(lambda: left.append(run(call)), threads)
    return functools.reduce(operator.or_, left)
