"""Calls of the native geometry: rows to pointers and strides, and tiles to threads."""

import functools
import operator
import threading
from collections.abc import Callable
from ctypes import Array, addressof, c_int64
from itertools import accumulate
from typing import TypeVar

import torch
from torch import Tensor

from camtorch.native import memory, structs
from camtorch.native.library import loaded
from camtorch.native.sampler import PADDING_CODES
from camtorch.projection.native_cameras import Native
from camtorch.values.threads import spread, thread_count

_Call = TypeVar("_Call")
_TILE_POINTS = 1 << 14  # some 30 us
_SHARED_POINTS = 1 << 15  # with fewer, to wake threads would take longer


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
    _call(native, cameras, count, call)
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
    sums = torch.empty(2, cameras, count, (4 + native.plan.parameters) * by_camera, dtype=torch.float64, device="cpu")
    tile = 1 if by_camera else _TILE_POINTS
    for one, by, to in zip(torch.eye(2, dtype=native.dtype, device="cpu"), by_points, sums, strict=True):
        call = structs.Rows()
        call.rows, call.row_strides[:], call.direction = points.data_ptr(), points.stride(), structs.PROJECT_VJP
        call.results, call.result_strides[:] = by.data_ptr(), by.stride()
        call.cotangents, call.cotangent_strides[:] = one.data_ptr(), (0, 0, 1)
        _call(native, cameras, count, call, to if by_camera else None, tile)
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
    tiles, sums = -(-count // _TILE_POINTS), None
    if want_parameters:
        sums = torch.empty(cameras, tiles, 4 + native.plan.parameters, dtype=torch.float64, device="cpu")
    if results is not None:
        call.results, call.result_strides[:] = results.data_ptr(), results.stride()
    component, *row = cotangents.stride()
    call.cotangents, call.cotangent_strides[:] = cotangents.data_ptr(), (*row, component)
    _call(native, cameras, count, call, sums)
    return results, None if sums is None else sums.sum(1).to(native.dtype)


class Lattices:
    """Lattices of cameras (C,), from probes (1, N, 2) at their nodes and at the rim: `Lattices` of geometry.h.

    See `warp.grid.on_lattice`. size: (h, w) of the target. tolerance: in pixels of the source, which has images of
    `source_size`. move: both cameras and the turns. room: returns memory of so many bytes. `lay` has images find the
    lattices that are sampled in the same call.
    """

    def __init__(
        self,
        probes: Tensor,
        size: tuple[int, int],
        source_size: tuple[int, int],
        tolerance: float,
        padding: str,
        cameras: int,
        first_row: int = 0,
        move: structs.Move | None = None,
        room: Callable[[int], Tensor] = lambda count: torch.empty(count, dtype=torch.uint8, device="cpu"),
    ):
        n, m = -(-size[0] // structs.STEP), -(-size[1] // structs.STEP)  # rows and columns of cells
        dtype, count = probes.dtype, probes.shape[1]
        nodes = (n + 5) * (m + 5)  # the first probes; the others are on the rim
        self._is_double, self._most = dtype == torch.float64, cameras * n * m
        self.nodes = torch.empty(cameras, 2, count, dtype=dtype, device="cpu")
        self.cells = torch.empty(cameras, n, m, dtype=torch.int32, device="cpu")
        # exact positions, of which parts are written; nodes in float32; scratch; valid flags of the probes
        sizes = (
            2 * structs.SQUARES * self._most * dtype.itemsize,
            8 * cameras * nodes * self._is_double,
            4 * structs.SCRATCH * cameras * (m + 8),
        )
        self._room = room(sum(sizes) + cameras * count)
        exact, narrow, scratch, valid = accumulate(sizes, initial=self._room.data_ptr())
        self.counters = (c_int64 * 2)()  # the next camera, and how many places of `exact` are used
        next_camera = addressof(self.counters)
        made = self.struct = structs.Lattices(first_row=first_row, exact=exact, used=next_camera + 8)
        made.hold(probes)
        if self._is_double:
            made.narrow = narrow
        # where the source sees the probes
        if move is None:
            made.move.turn_strides[:] = 0, 1, 3
        else:
            made.move = move
        move = made.move
        move.cameras, move.form, (move.height, move.width) = cameras, structs.POSITIONS, source_size
        move.rows, move.row_strides[:] = address_and_strides(probes)
        move.results, move.result_strides[:], move.valid = self.nodes.data_ptr(), (2 * count, 1, count), valid
        move.count, move.tile, move.next = count, count, next_camera
        # the kinds of the cells between them
        cells = made.cells
        cells.nodes, cells.node_strides[:] = move.results, (2 * count, count)
        cells.mapped, cells.mapped_stride, cells.rim, cells.rim_stride = valid, count, valid + nodes, count
        cells.cells, cells.count, cells.rows, cells.columns = self.cells.data_ptr(), cameras, n, m
        (cells.height, cells.width), (cells.source_height, cells.source_width) = size, source_size
        cells.tolerance, cells.padding, cells.scratch = tolerance, PADDING_CODES[padding], scratch

    def lay(self, job: structs.Job) -> None:
        """Have a job sample by these lattices, whose nodes are then in float32."""
        made, (_, n, m) = self.struct, self.cells.shape
        if self._is_double:
            plane = (n + 5) * (m + 5)
            job.nodes, job.node_strides[:] = made.narrow, (2 * plane, plane)
        else:
            job.nodes, job.node_strides[:] = made.cells.nodes, tuple(made.cells.node_strides)
        job.cells, job.cell_stride, job.rows, job.columns = made.cells.cells, n * m, n, m
        job.exact, job.exact_stride = made.exact, structs.SQUARES * self._most * (1 + self._is_double)

    def results(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return `nodes` (C, 2, n + 5, m + 5), `cells`, and `exact` (2, K, 8, 8), NaN if there is no position."""
        cameras, n, m = self.cells.shape
        nodes = self.nodes.as_strided((cameras, 2, n + 5, m + 5), (*self.nodes.stride()[:2], m + 5, 1))
        used, step = self.counters[1], structs.STEP
        if not used:
            return nodes, self.cells, nodes.new_empty(2, 0, step, step)
        exact = self._room[: 2 * step * step * self._most * nodes.dtype.itemsize].view(nodes.dtype)
        return nodes, self.cells, exact.view(2, self._most, step, step)[:, :used].clone()


class NativeMove:
    """Cameras, and others that see their rays after a turn: maps pixels of the first to pixels of the others."""

    def __init__(self, start: Native, end: Native, turns: Tensor | None, size: tuple[int, int], is_batch: bool):
        """Prepare turns (3, 3) or (C, 3, 3), of the cameras' dtype, and the (height, width) of the others' image."""
        self._start, self._end, self._turns, self.dtype = start, end, turns, start.dtype
        self.is_batch = is_batch  # whether pixels have a batch dim
        self._size, count = size, 1
        self._move = move = structs.Move()
        if turns is not None:
            count, strides = turns.numel() // 9, turns.stride()
            move.turns, move.turn_strides[:] = turns.data_ptr(), (strides[0] if count > 1 else 0, *strides[-2:])
        self.cameras = max(start.cameras, end.cameras, count)
        start.add_table()
        move.from_, move.to, move.cameras = start.pointer, end.pointer, self.cameras

    def rows(self, pixels: Tensor, form: int) -> tuple[Tensor, Tensor]:
        """Return pixels (C, N, 2) of the others for pixels (C or 1, N, 2), and valid (C, N).

        form: `POSITIONS` as in `grid_sample`, -9 if there is none; `PIXELS`, -1 if there is none; or `ON_IMAGE`, the
            same, of which only those on the image are valid.
        """
        count = pixels.shape[1]
        result = torch.empty(self.cameras, count, 2, dtype=self._start.dtype, device="cpu")
        valid = torch.empty(self.cameras, count, dtype=torch.bool, device="cpu")
        call, counters = structs.Move.from_buffer_copy(self._move), _per_thread.counters
        call.form, (call.height, call.width), call.count, call.tile = form, self._size, count, _TILE_POINTS
        call.rows, call.row_strides[:] = address_and_strides(pixels)
        call.results, call.result_strides[:], call.valid = result.data_ptr(), (2 * count, 2, 1), valid.data_ptr()
        call.next = addressof(counters)
        tiles = -(-count // _TILE_POINTS) * self.cameras if self.cameras * count >= _SHARED_POINTS else 1
        run_and_follow(loaded().camtorch_moves, call, tiles, counters, self._start, self._end)
        return result, valid

    def lattices(
        self,
        probes: Tensor,
        size: tuple[int, int],
        first_row: int,
        tolerance: float,
        padding: str,
        learns: bool = False,
    ) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return the results of `Lattices`, or None if most cells would have positions of their own."""
        made = Lattices(probes, size, self._size, tolerance, padding, self.cameras, first_row, self._move, _kept_memory)
        made.struct.learns = learns
        run, end = loaded().camtorch_lattices, self._end
        left = run_and_follow(run, made.struct, self.cameras, made.counters, self._start, end)
        return None if left else made.results()


def run_and_follow(
    run: Callable[[_Call], int], call: _Call, tiles: int, counters: Array[c_int64], start: Native, end: Native
) -> int:
    """Return flags of the parts that a call leaves undone; if azimuths must be followed first, it is repeated.

    `counters` are the call's next tile and the number of places.
    """
    threads = min(thread_count(), tiles) if tiles > 1 else 1
    while True:
        counters[:] = [0, 0]
        flags = run(call) if threads == 1 else run_in_threads(run, call, threads)
        if not flags & (structs.LEFT_FROM | structs.LEFT_TO):
            return flags
        follow(flags, start, end)


def follow(flags: int, start: Native, end: Native) -> None:
    """Compute the limits of azimuths that a call lacked."""
    if flags & structs.LEFT_FROM:
        start.follow()
    if flags & structs.LEFT_TO:
        end.follow()


class _PerThread(threading.local):
    def __init__(self) -> None:
        self.memory: Tensor | None = None
        self.counters = (c_int64 * 2)()


_per_thread = _PerThread()
_MOST_KEPT_BYTES = 1 << 22


def _kept_memory(count: int) -> Tensor:
    """Return at least `count` bytes: memory that calls of this thread reuse, or new memory if `count` is large."""
    if count > _MOST_KEPT_BYTES:
        return torch.empty(count, dtype=torch.uint8, device="cpu")
    if _per_thread.memory is None or _per_thread.memory.shape[0] < count:
        with torch.inference_mode(False):
            _per_thread.memory = torch.empty(count, dtype=torch.uint8, device="cpu")
    return _per_thread.memory


def address_and_strides(pixels: Tensor) -> tuple[int, tuple[int, int, int]]:
    """Return the address of pixels (C or 1, N, 2), and their strides."""
    camera, point, component = pixels.stride()
    return pixels.data_ptr(), (camera if pixels.shape[0] > 1 else 0, point, component)


def _empty(size: tuple[int, int, int], dtype: torch.dtype) -> Tensor:
    # the first write to each page of a large result would take longer than the geometry
    if size[0] * size[1] * size[2] * dtype.itemsize >= memory.LEAST:
        return memory.empty(size, dtype, torch.contiguous_format)
    return torch.empty(size, dtype=dtype, device="cpu")


def _call(
    native: Native, cameras: int, count: int, call: structs.Rows, sums: Tensor | None = None, tile: int = _TILE_POINTS
) -> None:
    """Call the native geometry with rows, their results and the other arguments of `Rows`.

    It adds to `sums`, which begin at zero. The call is repeated if points lie so far out that limits of azimuths
    decide, which were not followed yet.
    """
    if cameras != native.cameras:  # C would read elsewhere
        raise ValueError(f"rows must be of {native.cameras} cameras; got those of {cameras}")
    call.cameras, call.count, call.tile = native.pointer, count, tile
    call.sums = None if sums is None else sums.data_ptr()
    run, points, following = loaded().camtorch_geometry, cameras * count, c_int64(0)
    threads = 1 if points < _SHARED_POINTS else min(thread_count(), -(-count // _TILE_POINTS) * cameras)
    if threads > 1:
        call.next = addressof(following)
    while True:
        if sums is not None:
            sums.zero_()
        left = run_in_threads(run, call, threads) if threads > 1 else run(call) if points else 0
        if not left:
            return
        native.follow()
        following.value = 0


def run_in_threads(run: Callable[[_Call], int], call: _Call, threads: int) -> int:
    """Return the flags of all threads that run a call; each takes tiles until none is left."""
    left: list[int] = []
    spread(lambda: left.append(run(call)), threads)
    return functools.reduce(operator.or_, left)
