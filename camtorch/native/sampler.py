"""Calls of the native sampler: tensors to the pointers and sizes that it takes, and its tiles to threads."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from camtorch.native import memory, structs
from camtorch.native.library import loaded
from camtorch.values.dtypes import as_pixels
from camtorch.values.threads import spread, thread_count

Mode = Literal["nearest", "bilinear", "bicubic"]


class ModeOfSampling(NamedTuple):
    """A row of `MODES`."""

    code: int  # of the native sampler; -1 if torch alone has the mode
    code_of_torch: int  # of its `grid_sampler_2d_backward`
    reach: int  # pixels to either side of a position that have a part in a sample
    reads_interleaved: bool = False  # whether native code reads 3 or 4 channels side by side as vectors


MODES: dict[Mode, ModeOfSampling] = {
    "nearest": ModeOfSampling(structs.NEAREST, 1, 1),
    "bilinear": ModeOfSampling(structs.BILINEAR, 0, 1, True),
    "bicubic": ModeOfSampling(structs.BICUBIC, 2, 2),
}
PADDING_CODES = {"zeros": structs.ZEROS, "border": structs.BORDER, "reflection": structs.REFLECTION}
_TYPES = {
    torch.uint8: structs.UINT8,
    torch.bool: structs.BOOL,
    torch.uint16: structs.UINT16,
    torch.float32: structs.FLOAT32,
}
_BYTES = {1: structs.BYTES1, 2: structs.BYTES2, 4: structs.BYTES4, 8: structs.BYTES8}
_TILE_PIXELS = 1 << 15  # some 0.1 ms a channel
_MOST_COPIED = 8  # pixels for one that is made: interpolated one by one they would take longer


def takes(dtype: torch.dtype, mode: Mode) -> bool:
    """Whether the library, if it is built, samples images of this dtype in this mode."""
    return (mode == "nearest" or dtype in _TYPES) and MODES[mode].code >= 0


class NativeJob:
    """A job of the sampler, ready for images of one form and positions that stay; threads may share it after one call.

    All tensors are on the CPU and without a graph. Images (B, C, H, W) and results (B, C, h, w) are of one dtype, which
    `takes` knows, and may have any strides. `fill` has C values, of pixels that show nothing, which "zeros" blends in;
    integers are those of integer images. `grid` (B or 1, h, w, 2) of float32 or float64 has positions as of
    `grid_sample`, and `mapped` (B or 1, h, w) bool marks those that exist; None: positions far outside mark that none
    exists. `nodes` (B or 1, 2, n + 5, m + 5) of a lattice, float32, the last two dims without gaps, are the positions
    at every eighth pixel, from the one at (-16, -16) on; `cells` (B or 1, n, m) int32, contiguous, are `CELL_EMPTY`,
    `CELL_CUBIC` or a place in `exact`, (2, K, 8, 8) of float32, contiguous: positions, NaN where there is none.
    """

    def __init__(
        self,
        images: Tensor,
        size: tuple[int, int],
        mode: Mode,
        padding: str,
        fill: Sequence[float],
        *,
        grid: Tensor | None = None,
        mapped: Tensor | None = None,
        nodes: Tensor | None = None,
        cells: Tensor | None = None,
        exact: Tensor | None = None,
    ):
        self._make = maker(images, images.shape[0], size)
        result = self._make()
        self._results = [result]  # of the first call
        self._layout: torch.memory_format | None = None  # of the copies of images that lie oddly in memory
        self._is_copied = False  # whether results lie so as well
        if not is_quick(images, result, mode) and math.prod(images.shape[2:]) <= _MOST_COPIED * math.prod(size):
            together = _are_together(result, mode)
            self._layout = torch.channels_last if together else torch.contiguous_format
            self._is_copied = not together and result.stride(3) != 1
            result = torch.empty(result.shape, dtype=result.dtype, device="cpu") if self._is_copied else result
            images = _copied(images, self._layout)
        self._tiles = 0 if 0 in result.shape else tiles_of(size) * result.shape[0]
        if not self._tiles:
            return
        job = self._job = structs.Job()
        describe(job, images, result, mode, padding, fill)
        if grid is not None:
            job.grid, job.grid_is_double = grid.data_ptr(), grid.dtype == torch.float64
            job.grid_strides[:] = _shared(grid), *grid.stride()[1:]
            if mapped is not None:
                mapped = mapped.contiguous()
                job.mapped, job.mapped_stride = mapped.data_ptr(), _shared(mapped)
        if nodes is not None and cells is not None and exact is not None:
            job.nodes, job.node_strides[:] = nodes.data_ptr(), (_shared(nodes), nodes.stride(1))
            job.cells, job.cell_stride, (_, job.rows, job.columns) = cells.data_ptr(), _shared(cells), cells.shape
            if exact.shape[1]:
                job.exact, job.exact_stride = exact.data_ptr(), exact.stride(0)
        job.hold((grid, mapped, nodes, cells, exact))

    def __call__(self, images: Tensor) -> Tensor:
        """Return the samples of images."""
        result = self._results.pop() if self._results else self._make()
        if not self._tiles:
            return result
        if self._layout is not None:
            images = _copied(images, self._layout)
        made = torch.empty(result.shape, dtype=result.dtype, device="cpu") if self._is_copied else result
        job = structs.Job.from_buffer_copy(self._job)  # of this call alone, for several threads may be calling
        job.source, job.result = images.data_ptr(), made.data_ptr()
        native, threads = loaded(), min(thread_count(), self._tiles)
        if threads == 1:
            native.camtorch_sample(job)
        else:
            spread(lambda: native.camtorch_sample(job), threads)
        return result if made is result else result.copy_(made)


def _copied(images: Tensor, layout: torch.memory_format) -> Tensor:
    source = images if images.stride(0) else images[:1]  # one image, which all results show
    return source.clone(memory_format=layout).expand(images.shape)


def describe(job: structs.Job, images: Tensor, result: Tensor, mode: Mode, padding: str, fill: Sequence[float]) -> None:
    """Write into a job what arguments of `NativeJob` have in common: all but images and positions.

    Raises:
        ValueError: If torch alone has the mode.
    """
    job.source_strides[:], job.result_strides[:] = images.stride(), result.stride()
    job.count, job.channels, job.height, job.width = result.shape
    job.source_height, job.source_width = images.shape[-2:]
    fills, elements = owners = _fills(tuple(fill), images.dtype)
    job.hold(owners)
    job.fill, job.fill_elements = fills.data_ptr(), elements.data_ptr()
    job.type = _BYTES[images.dtype.itemsize] if mode == "nearest" else _TYPES[images.dtype]
    code = MODES[mode].code
    if code < 0:  # C would call what lies before its table of modes
        known = ", ".join(name for name, row in MODES.items() if row.code >= 0)
        raise ValueError(f"the native sampler: mode must be one of {known}; got {mode!r}")
    job.mode, job.padding, job.tile_rows = code, PADDING_CODES[padding], _tile_rows(result.shape[3])


def _tile_rows(width: int) -> int:
    return max(_TILE_PIXELS // width // 8, 1) * 8


def tiles_of(size: tuple[int, int]) -> int:
    """Return the number of threads that the samples of an image (height, width) may be split among."""
    height, width = size
    return -(-height // _tile_rows(width))


def is_quick(images: Tensor, result: Tensor, mode: Mode) -> bool:
    """Whether samples go by vectors: pixels that lie neither in planes nor side by side would go one by one."""
    steps, made = images.stride(), result.stride()
    return (
        mode == "nearest"
        or steps[3] == made[3] == 1
        or (_are_together(result, mode) and steps[1::2] == (1, images.shape[1]))
    )


def _are_together(result: Tensor, mode: Mode) -> bool:
    channels = result.shape[1]
    return MODES[mode].reads_interleaved and channels in (3, 4) and result.stride()[1::2] == (1, channels)


def _shared(tensor: Tensor) -> int:
    """Return the stride from one image's part to the next: 0 if one serves all."""
    return 0 if tensor.shape[0] == 1 else tensor.stride(0)


@functools.lru_cache(maxsize=64)
def _fills(fill: tuple[float, ...], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return values in float32 and as pixels (rounded, in range)."""
    return torch.tensor(fill, dtype=torch.float32, device="cpu"), as_pixels(fill, dtype)


def layout(images: Tensor) -> torch.memory_format:
    """Return the layout of images (B, C, H, W) in memory: channels last, or plane by plane."""
    strides = images.stride()
    last = images.shape[1] > 1 and 0 < strides[1] < strides[3]
    return torch.channels_last if last else torch.contiguous_format


def maker(images: Tensor, count: int, size: tuple[int, int]) -> Callable[[], Tensor]:
    """Return what makes room (count, C, *size) in the dtype of images (_, C, H, W), and in their layout in memory."""
    shape, dtype = (count, images.shape[1], *size), images.dtype
    if math.prod(shape) * dtype.itemsize >= memory.LEAST:
        return functools.partial(memory.empty, shape, dtype, layout(images))
    return functools.partial(torch.empty, shape, dtype=dtype, device="cpu", memory_format=layout(images))


def lay(nodes: Tensor, cells: Tensor, exact: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return positions (B, h, w, 2) of all pixels of a lattice, -9 if there is none; and bool (B, h, w).

    It is as in `NativeJob`, and `cells` may be `CELL_QUINTIC`.
    """
    shape = cells.shape[0], *size
    grid = memory.empty((*shape, 2), torch.float32, torch.contiguous_format)
    mapped = torch.empty(shape, dtype=torch.bool, device="cpu")
    _lay(nodes.contiguous(), cells, exact, grid, mapped)
    return grid, mapped


def lay_vjp(grid: Tensor, cells: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the gradients of a lattice's nodes and `count` exact cells by those of its positions (B, h, w, 2)."""
    (cameras, n, m), step = cells.shape, structs.STEP
    nodes = torch.zeros(cameras, 2, n + 5, m + 5, dtype=torch.float32, device="cpu")
    exact = torch.zeros(2, count, step, step, dtype=torch.float32, device="cpu")
    _lay(nodes, cells, exact, grid.contiguous(), None)
    return nodes, exact


def _lay(nodes: Tensor, cells: Tensor, exact: Tensor, grid: Tensor, mapped: Tensor | None) -> None:
    cells, exact = cells.contiguous(), exact.contiguous()
    call = structs.Laying()
    (call.count, call.rows, call.columns), call.exact_count = cells.shape, exact.shape[1]
    call.height, call.width = grid.shape[1:3]
    if (-(-call.height // structs.STEP), -(-call.width // structs.STEP)) != cells.shape[1:]:  # C would read elsewhere
        raise ValueError(f"cells must be those of {tuple(grid.shape[1:3])} pixels; got {tuple(cells.shape[1:])}")
    call.nodes, call.cells, call.exact, call.grid = (t.data_ptr() for t in (nodes, cells, exact, grid))
    call.mapped, call.is_transposed = None if mapped is None else mapped.data_ptr(), mapped is None
    tasks = call.count if mapped is None else -(-grid[..., 0].numel() // _TILE_PIXELS)
    spread(functools.partial(loaded().camtorch_lay, call), min(thread_count(), tasks))


def classify(
    nodes: Tensor,
    mapped: Tensor,
    rim: Tensor,
    size: tuple[int, int],
    source: tuple[int, int],
    tolerance: float,
    padding: str,
) -> Tensor:
    """Return the kinds of cells (B, n, m) of a lattice: `CELL_EMPTY`, `CELL_CUBIC`, `CELL_DOUBT` or `CELL_TODO`.

    Positions are `nodes` (B, 2, n + 5, m + 5) of float32 and `mapped` (B, n + 5, m + 5) bool, the last two dims without
    gaps; `rim` (B, 2 (w + h)) bool, contiguous: the target's top row, bottom row, left column and right column.
    """
    count, rows, columns = nodes.shape[0], nodes.shape[2] - 5, nodes.shape[3] - 5
    cells = torch.empty(count, rows, columns, dtype=torch.int32, device="cpu")
    scratch = torch.empty(structs.SCRATCH * (columns + 8), dtype=torch.float32, device="cpu")
    asked = structs.Classification()
    asked.nodes, asked.mapped, asked.rim, asked.cells, asked.scratch = (
        tensor.data_ptr() for tensor in (nodes, mapped, rim, cells, scratch)
    )
    asked.node_strides[:], asked.mapped_stride, asked.rim_stride = nodes.stride()[:2], mapped.stride(0), rim.stride(0)
    asked.count, asked.rows, asked.columns, (asked.height, asked.width) = count, rows, columns, size
    asked.source_height, asked.source_width = source
    asked.tolerance, asked.padding = tolerance, PADDING_CODES[padding]
    loaded().camtorch_classify(asked)
    return cells
