"""Calls of the compiled geometry: rows to pointers and strides, and tiles to threads."""

from __future__ import annotations

import functools
import operator
import struct
import threading
from collections.abc import Callable
from ctypes import Array, addressof, c_int64
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.native import memory
from camtorch.native.sampler import CLASSIFICATION, PADDINGS, SCRATCH
from camtorch.projection.native_cameras import Native, address, entry
from camtorch.values.threads import spread, thread_count

PROJECT, UNPROJECT, PROJECT_VJP, UNPROJECT_VJP = range(4)
_TILE = 1 << 14  # points of a tile, some 30 us
_SHARED = 1 << 15  # points that threads are woken for
_Rows = struct.Struct("20q").pack  # `Rows` of geometry.h
packed_move: Callable[..., bytes] = struct.Struct("8q2d12q").pack  # `Move` of geometry.h
_LATTICES = struct.Struct(f"8q2d12q{CLASSIFICATION}6q")  # `Lattices`
LATTICE_WORDS = _LATTICES.size // 8
POSITIONS, PIXELS, ON_IMAGE, BOXES = range(4)
LEFT_FROM, LEFT_TO, LEFT_MOST, LEFT_LABELS = 1, 2, 4, 4
_NO_ROWS = (0, 0, 0, 0)


def project(native: Native, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return pixels (2, C, N) of points (C, N, 3) of any strides, and whether they are valid (C, N)."""
    cameras, count, _ = points.shape
    pixels = _empty((2, cameras, count), native.dtype)
    valid = torch.empty(cameras, count, dtype=torch.bool, device="cpu")
    places = points.data_ptr(), *points.stride(), pixels.data_ptr(), count, 1, cameras * count, valid.data_ptr()
    _call_and_follow(native, cameras, count, PROJECT, (*places, 0, *_NO_ROWS, 0))
    return pixels, valid


class Unprojected(NamedTuple):
    """Unit rays (3, C, N), whether they exist (C, N), and points on the chart's plane (2, C, N), if needed."""

    rays: Tensor
    valid: Tensor
    solution: Tensor | None


def unproject(native: Native, pixels: Tensor, keeps: bool = False) -> Unprojected:
    """Return rays of pixels (C, N, 2), and if `keeps`, also the results that `unproject_vjp` needs."""
    cameras, count, _ = pixels.shape
    rays = _empty((3, cameras, count), native.dtype)
    valid = torch.empty(cameras, count, dtype=torch.bool, device="cpu")
    solution = _empty((2, cameras, count), native.dtype) if keeps else None
    native.add_table()
    rows = pixels.data_ptr(), *pixels.stride(), rays.data_ptr(), count, 1, cameras * count, valid.data_ptr()
    _call_and_follow(native, cameras, count, UNPROJECT, (*rows, address(solution), *_NO_ROWS, 0))
    return Unprojected(rays, valid, solution)


def project_vjp(
    native: Native, points: Tensor, cotangents: Tensor, want_points: bool, want_parameters: bool
) -> tuple[Tensor | None, Tensor | None]:
    """Return the cotangents of points (C, N, 3), and of the cameras (C, 4 + n): intrinsics, `parameters` of the optics.

    `cotangents` are those of pixels, (2, C, N), of any strides.
    """
    assert cotangents.shape[1:] == points.shape[:2]  # C would read elsewhere otherwise
    given = points.data_ptr(), *points.stride(), 0, 0
    return _vjp(native, PROJECT_VJP, given, cotangents, 3 * want_points, want_parameters)


def project_jacobians(native: Native, points: Tensor, by_camera: bool) -> tuple[Tensor, Tensor]:
    """Return the derivatives of pixels by points, and, if `by_camera`, by the cameras' numbers: see `project_vjp`.

    They are (C, N, 2, 3) and (C, N, 2, 4 + n or 0), zero if there is no pixel.
    """
    cameras, count, _ = points.shape
    by_points = torch.empty(2, cameras, count, 3, dtype=native.dtype, device="cpu")
    sums = torch.zeros(2, cameras, count, (4 + native.parameters) * by_camera, dtype=torch.float64, device="cpu")
    tile = 1 if by_camera else _TILE
    for one, by, to in zip(torch.eye(2, dtype=native.dtype, device="cpu"), by_points, sums, strict=True):
        given = points.data_ptr(), *points.stride(), by.data_ptr(), *by.stride(), 0, 0, one.data_ptr(), 0, 0, 1
        _call(native, cameras, count, PROJECT_VJP, (*given, to.data_ptr() if by_camera else 0), tile)
    return by_points.movedim(0, 2), sums.movedim(0, 2)


def unproject_vjp(
    native: Native, valid: Tensor, solution: Tensor, cotangents: Tensor, want_pixels: bool, want_parameters: bool
) -> tuple[Tensor | None, Tensor | None]:
    """Return the cotangents of pixels (C, N, 2), and of the cameras, for results of `unproject`; see `project_vjp`."""
    assert cotangents.shape[1:] == valid.shape  # C would read elsewhere otherwise
    given = *_NO_ROWS, valid.data_ptr(), solution.data_ptr()
    return _vjp(native, UNPROJECT_VJP, given, cotangents, 2 * want_pixels, want_parameters)


def _vjp(
    native: Native, direction: int, given: tuple[int, ...], cotangents: Tensor, size: int, want_parameters: bool
) -> tuple[Tensor | None, Tensor | None]:
    """Return the cotangents of rows (C, N, size), None if the size is 0, and of the cameras, None if not wanted."""
    _, cameras, count = cotangents.shape
    results = _empty((cameras, count, size), native.dtype) if size else None
    tiles, sums = -(-count // _TILE), None
    if want_parameters:
        sums = torch.zeros(cameras, tiles, 4 + native.parameters, dtype=torch.float64, device="cpu")
    places = _NO_ROWS if results is None else (results.data_ptr(), *results.stride())
    component, camera, point = cotangents.stride()
    by = cotangents.data_ptr(), camera, point, component, address(sums)
    _call(native, cameras, count, direction, (*given[:4], *places, *given[4:], *by))
    return results, None if sums is None else sums.sum(1).to(native.dtype)


class Lattices:
    """Lattices of cameras (C,), from probes (1, N, 2) at their nodes and at the rim: `Lattices` of geometry.h.

    See `warp.grid.on_lattice`. size: (h, w) of the target. tolerance: in pixels of the source, which has images of
    `source_size`. given: both cameras and the turns, as in `Move`. room: returns memory of so many bytes. Images
    sampled in the same call find the lattices at `places`, the fields of `Job` of sampler.h.
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
        given: tuple[int, ...] = (0, 0, 0, 0, 1, 3),
        room: Callable[[int], Tensor] = lambda count: torch.empty(count, dtype=torch.uint8, device="cpu"),
    ):
        dtype, count, is_double = probes.dtype, probes.shape[1], probes.dtype == torch.float64
        n, m = (-(-side // 8) for side in size)
        nodes, self._most = (n + 5) * (m + 5), cameras * n * m
        # the first (n + 5) (m + 5) nodes are those of the lattice, the others are on the rim
        self.nodes = torch.empty(cameras, 2, count, dtype=dtype, device="cpu")
        self.cells = torch.empty(cameras, n, m, dtype=torch.int32, device="cpu")
        # exact positions, of which parts are written; nodes in float32; scratch; valid flags of the probes
        sizes = 128 * self._most * dtype.itemsize, 8 * cameras * nodes * is_double, 4 * SCRATCH * cameras * (m + 8)
        self._room, self._probes, self.counters = room(sum(sizes) + cameras * count), probes, (c_int64 * 2)()
        exact, narrow, scratch, valid = accumulate(sizes, initial=self._room.data_ptr())
        at, cells, used = self.nodes.data_ptr(), self.cells.data_ptr(), addressof(self.counters)
        rows = *rows_of(probes), at, 2 * count, 1, count, valid, count, count, used
        asked = at, 2 * count, count, valid, count, valid + nodes, count, cameras, n, m, *size
        how = *source_size, tolerance, PADDINGS[padding], cells, scratch
        more = first_row, narrow if is_double else 0, exact, used + 8, 0, 0
        move = *given, cameras, POSITIONS, *source_size, *rows
        self.words: bytes = _LATTICES.pack(*move, *asked, *how, *more)
        in_float = (narrow, 2 * nodes, nodes) if is_double else (at, 2 * count, count)
        self.places = *in_float, cells, n * m, n, m, exact, 64 * self._most * (1 + is_double)

    def results(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return `nodes` (C, 2, n + 5, m + 5), `cells`, and `exact` (2, K, 8, 8), NaN if there is no position."""
        (cameras, n, m), dtype, most = self.cells.shape, self.nodes.dtype, self._most
        nodes = self.nodes.as_strided((cameras, 2, n + 5, m + 5), (*self.nodes.stride()[:2], m + 5, 1))
        exact = self._room[: 128 * most * dtype.itemsize].view(dtype).view(2, most, 8, 8)
        return nodes, self.cells, exact[:, : self.counters[1]].clone()


class Between:
    """Cameras, and others that see their rays after a turn: maps pixels of the first to pixels of the others."""

    def __init__(self, start: Native, end: Native, turns: Tensor | None, size: tuple[int, int], is_batch: bool):
        """Prepare turns (3, 3) or (C, 3, 3), of the cameras' dtype, and the (height, width) of the others' image."""
        self._start, self._end, self._turns, self.dtype = start, end, turns, start.dtype
        self.is_batch = is_batch  # whether pixels have a batch dim
        count, strides = (1, (0, 0)) if turns is None else (turns.numel() // 9, turns.stride())
        self.cameras = max(start.cameras, end.cameras, count)
        start.add_table()
        self._size = size
        by_camera = strides[0] if count > 1 else 0
        self._given = start.pointer, end.pointer, address(turns), by_camera, *strides[-2:], self.cameras

    def rows(self, pixels: Tensor, form: int) -> tuple[Tensor, Tensor]:
        """Return pixels (C, N, 2) of the others for pixels (C or 1, N, 2), and valid (C, N).

        form: `POSITIONS` as in `grid_sample`, -9 if there is none; `PIXELS`, -1 if there is none; or `ON_IMAGE`, the
            same, of which only those on the image are valid.
        """
        count = pixels.shape[1]
        result = torch.empty(self.cameras, count, 2, dtype=self._start.dtype, device="cpu")
        valid = torch.empty(self.cameras, count, dtype=torch.bool, device="cpu")
        rows = *rows_of(pixels), result.data_ptr(), 2 * count, 2, 1, valid.data_ptr(), count, _TILE
        call = packed_move(*self._given, form, *self._size, *rows, addressof(_kept.counters))
        tiles = -(-count // _TILE) * self.cameras
        self._run("camtorch_moves", call, tiles if self.cameras * count >= _SHARED else 1, _kept.counters)
        return result, valid

    def lattices(
        self, probes: Tensor, size: tuple[int, int], first_row: int, tolerance: float, padding: str
    ) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return the results of `Lattices`, or None if most cells would have positions of their own."""
        given = self._given[:-1]
        made = Lattices(probes, size, self._size, tolerance, padding, self.cameras, first_row, given, _kept_memory)
        return None if self._run("camtorch_lattices", made.words, self.cameras, made.counters) else made.results()

    def _run(self, name: str, call: object, tiles: int, counters: Array[c_int64]) -> int:
        """Return flags of parts that are not made. `counters` are the call's next tile and the number of places."""
        threads = min(thread_count(), tiles) if tiles > 1 else 1
        return run_and_follow(entry(name, c_int64), call, threads, counters, self._start, self._end)


def run_and_follow(
    run: Callable[[object], int], call: object, threads: int, counters: Array[c_int64], start: Native, end: Native
) -> int:
    """Return flags of the parts that a call leaves undone; if azimuths must be followed first, it is repeated."""
    while True:
        left: list[int] = []
        counters[:] = [0, 0]
        spread(lambda: left.append(run(call)), threads)  # noqa: B023 (called at once)
        flags = functools.reduce(operator.or_, left)
        if not flags & (LEFT_FROM | LEFT_TO):
            return flags
        for flag, native in ((LEFT_FROM, start), (LEFT_TO, end)):
            if flags & flag:
                native.follow()


class _Kept(threading.local):
    def __init__(self) -> None:
        self.memory: Tensor | None = None
        self.counters = (c_int64 * 2)()


_kept = _Kept()
_MOST_KEPT = 1 << 22  # bytes


def _kept_memory(count: int) -> Tensor:
    """Return at least `count` bytes: memory that calls of this thread reuse, or new memory if `count` is large."""
    if count > _MOST_KEPT:
        return torch.empty(count, dtype=torch.uint8, device="cpu")
    if _kept.memory is None or _kept.memory.shape[0] < count:
        with torch.inference_mode(False):
            _kept.memory = torch.empty(count, dtype=torch.uint8, device="cpu")
    return _kept.memory


def rows_of(pixels: Tensor) -> tuple[int, int, int, int]:
    """Return the address of pixels (C or 1, N, 2), and their strides."""
    camera, point, component = pixels.stride()
    return pixels.data_ptr(), camera if pixels.shape[0] > 1 else 0, point, component


def _empty(size: tuple[int, int, int], dtype: torch.dtype) -> Tensor:
    # the first write to each page of a large result would take longer than the geometry
    if size[0] * size[1] * size[2] * dtype.itemsize >= memory.LEAST:
        return memory.empty(size, dtype, torch.contiguous_format)
    return torch.empty(size, dtype=dtype, device="cpu")


def _call(native: Native, cameras: int, count: int, direction: int, rows: tuple[int, ...], tile: int = _TILE) -> int:
    """Call the compiled geometry with `rows`, the fields of `Rows` between its cameras and its count."""
    assert cameras == native.cameras
    run, points = entry("camtorch_geometry", c_int64), cameras * count
    if points < _SHARED:
        return run(_Rows(native.pointer, *rows, count, tile, direction, 0)) if points else 0
    following = c_int64(0)
    call = _Rows(native.pointer, *rows, count, tile, direction, addressof(following))
    left: list[int] = []
    spread(lambda: left.append(run(call)), min(thread_count(), -(-count // _TILE) * cameras))
    return sum(left)


def _call_and_follow(native: Native, cameras: int, count: int, direction: int, rows: tuple[int, ...]) -> None:
    """Call the geometry, and again with the limits of each azimuth if a point lies so far out that they decide."""
    if _call(native, cameras, count, direction, rows):
        native.follow()
        _call(native, cameras, count, direction, rows)
