"""Calls of the compiled sampler: tensors to the pointers and sizes that it takes, and its tiles to threads."""

from __future__ import annotations

import ctypes
import functools
import math
import struct
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from camtorch.native import memory
from camtorch.native.library import library
from camtorch.values.dtypes import as_pixels
from camtorch.values.threads import spread, thread_count

DOUBT, EMPTY, CUBIC, TODO = -4, -2, -1, 0
"""Cells of a lattice: whose cubics may miss, showing nothing, between whose nodes lie cubics, wanting positions."""

_MODES = {"nearest": 0, "bilinear": 1, "bicubic": 2}
PADDINGS = {"zeros": 0, "border": 1, "reflection": 2}
_TYPES = {torch.uint8: 0, torch.bool: 1, torch.uint16: 2, torch.float32: 3}
_BYTES = {1: 4, 2: 5, 4: 6, 8: 7}
_TILE = 1 << 15  # pixels of a tile, some 0.1 ms a channel
_packed = struct.Struct("35q4iq").pack  # `Job` of sampler.h
_Job = ctypes.c_int64 * (struct.calcsize("35q4iq") // 8)
CLASSIFICATION = "12q3di2q"
"""`Classification` of sampler.h."""
_Classification = struct.Struct(CLASSIFICATION).pack
SCRATCH = 25  # numbers of float32 for each column of a lattice and eight more
_WORTH = 8  # pixels that may be copied for one that is made: interpolated one by one they would take longer


def takes(dtype: torch.dtype, mode: str) -> bool:
    """Whether the library, if it is built, samples images of a dtype so."""
    return mode == "nearest" or dtype in _TYPES


class Call:
    """A call of the sampler, ready for images of one form and positions that stay; threads may share it after one call.

    All tensors are on the CPU and without a graph. Images (B, C, H, W) and results (B, C, h, w) are of one dtype, which
    `takes` knows, and may have any strides. `fill` has C values, of pixels that show nothing, which "zeros" blends in;
    integers are those of integer images. `grid` (B or 1, h, w, 2) of float32 or float64 has positions as of
    `grid_sample`, and `mapped` (B or 1, h, w) bool marks those that exist; None: positions far outside mark that none
    exists. `nodes` (B or 1, 2, n + 5, m + 5) of a lattice, float32, the last two dims without gaps, are the positions
    at every eighth pixel, from the one at (-16, -16) on; `cells` (B or 1, n, m) int32, contiguous, are `EMPTY`, `CUBIC`
    or the cell's place in `exact`, (2, K, 8, 8) of float32, contiguous: positions, NaN where there is none.
    """

    def __init__(
        self,
        images: Tensor,
        size: tuple[int, int],
        mode: str,
        padding: str,
        fill: Sequence[float],
        *,
        grid: Tensor | None = None,
        mapped: Tensor | None = None,
        nodes: Tensor | None = None,
        cells: Tensor | None = None,
        exact: Tensor | None = None,
        out: Tensor | None = None,
    ):
        self._make = maker(images, images.shape[0], size)
        result = self._make() if out is None else out
        self._results = [] if out is not None else [result]  # of the first call
        self._layout: torch.memory_format | None = None  # of the copies of images that lie oddly in memory
        self._is_copied = False  # whether results lie so as well
        if not is_quick(images, result, mode) and math.prod(images.shape[2:]) <= _WORTH * math.prod(size):
            together = _are_together(result, mode)
            self._layout = torch.channels_last if together else torch.contiguous_format
            self._is_copied = not together and result.stride(3) != 1
            result = torch.empty(result.shape, dtype=result.dtype, device="cpu") if self._is_copied else result
            images = self._copied(images)
        on_grid, on_lattice, masks = [0] * 6, [0] * 9, [0] * 2
        if grid is not None:
            on_grid = [grid.data_ptr(), _shared(grid), *grid.stride()[1:], grid.dtype == torch.float64]
            if mapped is not None:
                mapped = mapped.contiguous()
                masks = [mapped.data_ptr(), _shared(mapped)]
        if nodes is not None and cells is not None and exact is not None:
            (_, rows, columns), at = cells.shape, (exact.data_ptr(), exact.stride(0)) if exact.shape[1] else (0, 0)
            on_lattice = [nodes.data_ptr(), _shared(nodes), nodes.stride(1), cells.data_ptr(), _shared(cells)]
            on_lattice += [rows, columns, *at]
        self._tiles = 0 if 0 in result.shape else tiles_of(result)
        if self._tiles:
            text, kept = packed(images, result, mode, padding, fill, (*on_grid, *masks, *on_lattice))
            self._words = _Job.from_buffer_copy(text)
            self._holds = grid, mapped, nodes, cells, exact, kept

    def _copied(self, images: Tensor) -> Tensor:
        source = images if images.stride(0) else images[:1]  # which all results show
        assert self._layout is not None
        return source.clone(memory_format=self._layout).expand(images.shape)

    def __call__(self, images: Tensor, out: Tensor | None = None) -> Tensor:
        """Return the samples of images, written to `out` if given; that lies in memory as it did at first."""
        result = (self._results.pop() if self._results else self._make()) if out is None else out
        if not self._tiles:
            return result
        if self._layout is not None:
            images = self._copied(images)
        made = torch.empty(result.shape, dtype=result.dtype, device="cpu") if self._is_copied else result
        job = _Job.from_buffer_copy(self._words)  # of this call alone, for several threads may be calling
        job[0], job[1] = images.data_ptr(), made.data_ptr()
        native, threads = library(), min(thread_count(), self._tiles)
        assert native is not None  # who made the call has looked
        if threads == 1:
            native.camtorch_sample(job)
        else:
            spread(lambda: native.camtorch_sample(job), threads)
        return result if made is result else result.copy_(made)


def packed(
    images: Tensor, result: Tensor, mode: str, padding: str, fill: Sequence[float], positions: Sequence[int]
) -> tuple[bytes, object]:
    """Return `Job` of sampler.h, and the objects that must live as long, of arguments of `sample` and positions."""
    fills = _fills(tuple(fill), images.dtype)
    kind = _BYTES[images.dtype.itemsize] if mode == "nearest" else _TYPES[images.dtype]
    count, channels, height, width = result.shape
    sizes = count, channels, *images.shape[-2:], height, width
    places = images.data_ptr(), result.data_ptr(), *images.stride(), *result.stride()
    how = kind, _MODES[mode], PADDINGS[padding], _tile_rows(width), 0
    return _packed(*places, *sizes, *fills[:2], *positions, *how), fills


def _tile_rows(width: int) -> int:
    return max(_TILE // width // 8, 1) * 8


def tiles_of(result: Tensor) -> int:
    """Return the number of threads that samples may be split among."""
    count, _, height, width = result.shape
    return -(-height // _tile_rows(width)) * count


def is_quick(images: Tensor, result: Tensor, mode: str) -> bool:
    """Whether samples go by vectors: pixels that lie neither in planes nor side by side would go one by one."""
    steps, made = images.stride(), result.stride()
    return (
        mode == "nearest"
        or steps[3] == made[3] == 1
        or (_are_together(result, mode) and steps[1::2] == (1, images.shape[1]))
    )


def _are_together(result: Tensor, mode: str) -> bool:
    channels = result.shape[1]
    return mode == "bilinear" and channels in (3, 4) and result.stride()[1::2] == (1, channels)


def _shared(tensor: Tensor) -> int:
    """Return the stride from one image's part to the next: 0 if one serves all."""
    return 0 if tensor.shape[0] == 1 else tensor.stride(0)


@functools.lru_cache(maxsize=64)
def _fills(fill: tuple[float, ...], dtype: torch.dtype) -> tuple[int, int, Tensor, Tensor]:
    """Return the addresses of values in float32 and as pixels (rounded, in range), and their owners."""
    values = torch.tensor(fill, dtype=torch.float32, device="cpu")
    elements = as_pixels(fill, dtype)
    return values.data_ptr(), elements.data_ptr(), values, elements


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


def classify(
    nodes: Tensor,
    mapped: Tensor,
    rim: Tensor,
    size: tuple[int, int],
    source: tuple[int, int],
    tolerance: float,
    padding: str,
) -> tuple[Tensor, int]:
    """Return which cells (B, n, m) of a lattice are `EMPTY`, `CUBIC`, `DOUBT` or `TODO`; and the most open of an image.

    Positions are `nodes` (B, 2, n + 5, m + 5) of float32 and `mapped` (B, n + 5, m + 5) bool, the last two dims without
    gaps; `rim` (B, 2 (w + h)) bool, contiguous: the target's top row, bottom row, left column and right column.
    """
    native = library()
    assert native is not None  # who calls has looked
    count, rows, columns = nodes.shape[0], nodes.shape[2] - 5, nodes.shape[3] - 5
    cells = torch.empty(count, rows, columns, dtype=torch.int32, device="cpu")
    scratch = torch.empty(SCRATCH * (columns + 8), dtype=torch.float32, device="cpu")
    places = *nodes.stride()[:2], mapped.data_ptr(), mapped.stride(0), rim.data_ptr(), rim.stride(0)
    asked = (nodes.data_ptr(), *places, count, rows, columns, *size, *source, tolerance, PADDINGS[padding])
    return cells, native.camtorch_classify(_Classification(*asked, cells.data_ptr(), scratch.data_ptr()))
