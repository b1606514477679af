"""Calls of the native geometry for two cameras: pixels of one as pixels of the other, and lattices of them."""

import threading
from collections.abc import Callable
from ctypes import Array, addressof, c_int64
from itertools import accumulate

import torch
from torch import Tensor

from camtorch.native import structs
from camtorch.native.library import loaded
from camtorch.native.sampler import PADDING_CODES
from camtorch.projection.native_calls import SHARED_POINTS, TILE_POINTS, CallT, run_in_threads
from camtorch.projection.native_cameras import Native
from camtorch.values.threads import thread_count

_Counters = c_int64 * 2  # the next tile or camera, and how many places of `exact` are used
_MOST_KEPT_BYTES = 1 << 22
_of_thread = threading.local()


def _new_memory(count: int) -> Tensor:
    return torch.empty(count, dtype=torch.uint8, device="cpu")


def _kept_memory(count: int) -> Tensor:
    """Return at least `count` bytes: memory that calls of this thread reuse, or new memory if `count` is large."""
    if count > _MOST_KEPT_BYTES:
        return _new_memory(count)
    kept: Tensor | None = getattr(_of_thread, "memory", None)
    if kept is None or kept.shape[0] < count:
        with torch.inference_mode(False):
            _of_thread.memory = kept = _new_memory(count)
    return kept


class NativeLattices:
    """Lattices of cameras (C,), from probes (1, N, 2) at their nodes and at the rim: `Lattices` of geometry.h.

    See `warp.grid.on_lattice`. move: cameras and turns, of which it takes a copy. size: (h, w) of the target.
    tolerance: in pixels of the source, which has images of `source_size`. room: returns memory of so many bytes. `lay`
    has images find the lattices that are sampled in the same call.
    """

    def __init__(
        self,
        move: structs.Move,
        probes: Tensor,
        size: tuple[int, int],
        source_size: tuple[int, int],
        tolerance: float,
        padding: str,
        cameras: int,
        first_row: int = 0,
        room: Callable[[int], Tensor] = _new_memory,
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
        self.counters = _Counters()
        next_camera = addressof(self.counters)
        made = self.struct = structs.Lattices(move=move, first_row=first_row, exact=exact, used=next_camera + 8)
        made.hold(probes)
        if self._is_double:
            made.narrow = narrow
        # where the source sees the probes
        move = made.move
        move.cameras, move.form, (move.height, move.width) = cameras, structs.POSITIONS, source_size
        move.rows, move.row_strides[:] = _address_and_strides(probes)
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
        call, counters = structs.Move.from_buffer_copy(self._move), _Counters()
        call.form, (call.height, call.width), call.count, call.tile = form, self._size, count, TILE_POINTS
        call.rows, call.row_strides[:] = _address_and_strides(pixels)
        call.results, call.result_strides[:], call.valid = result.data_ptr(), (2 * count, 2, 1), valid.data_ptr()
        call.next = addressof(counters)
        tiles = -(-count // TILE_POINTS) * self.cameras if self.cameras * count >= SHARED_POINTS else 1
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
        """Return the results of `NativeLattices`, or None if most cells would have positions of their own."""
        made = NativeLattices(
            self._move, probes, size, self._size, tolerance, padding, self.cameras, first_row, _kept_memory
        )
        made.struct.learns = learns
        run, end = loaded().camtorch_lattices, self._end
        left = run_and_follow(run, made.struct, self.cameras, made.counters, self._start, end)
        return None if left else made.results()


def run_and_follow(
    run: Callable[[CallT], int], call: CallT, tiles: int, counters: Array[c_int64], start: Native, end: Native
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


def _address_and_strides(pixels: Tensor) -> tuple[int, tuple[int, int, int]]:
    """Return the address of pixels (C or 1, N, 2), and their strides."""
    camera, point, component = pixels.stride()
    return pixels.data_ptr(), (camera if pixels.shape[0] > 1 else 0, point, component)
