"""Where a warp samples: for every pixel of the target, a position on the source's image, exact or from a lattice."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

OUTSIDE = -9.0  # a sampling position that no image reaches, not even with its interpolation margin
_STRIP = 1 << 19  # pixels
_FEWEST = 8  # cells along a side from which on a lattice pays
_STEP = 8  # pixels between the nodes of a lattice
_BLOCK = 128  # pixels that one product interpolates: wider ones multiply with more zeros
_MARGIN = 0.05  # of half an image: what lies beyond is not sampled
_OVERSHOOT = 0.5  # of the range of its nodes by which a cubic may leave it: 0.27 along each axis
_CUBIC = 3 / 128  # a cubic through four even nodes misses its middle by this part of their fourth difference

Exact = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Pixels (h, w, 2) for every camera, or (B, h, w, 2) for each its own, to positions (B or 1, h, w, 2) as of
`grid_sample`, `OUTSIDE` where no ray is mapped, and bool (B or 1, h, w): whether one is."""


def in_strips(exact: Exact, pixels: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """`exact` of pixels (h, w, 2) for `count` cameras, by strips: memory for what is in between is used again."""
    rows = max(_STRIP // max(count * pixels.shape[1], 1), 1)
    strips = pixels.split(rows)
    if len(strips) == 1:
        return exact(pixels)
    grid = mapped = None
    for i, strip in enumerate(strips):
        here = slice(i * rows, i * rows + len(strip))
        part, seen = exact(strip)
        if grid is None:
            grid, mapped = (t.new_empty(count, len(pixels), *t.shape[2:]) for t in (part, seen))
        grid[:, here], mapped[:, here] = part, seen
    return grid, mapped


def on_lattice(
    exact: Exact, size: tuple[int, int], source: tuple[int, int], tolerance: float, like: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Positions within `tolerance` pixels of the exact ones, from a lattice of every eighth pixel.

    Between nodes a cubic is laid through four of them along each axis. Cells where fourth differences say that this
    misses by more than the tolerance, and cells at the limit of what is mapped, are computed pixel by pixel. None if
    that would be most of the image.

    Args:
        exact: see `Exact`.
        size: (height, width) of the target.
        source: (height, width) of the source, in whose pixels the tolerance is.
        tolerance: positive, in pixels.
        like: a tensor of the dtype and on the device to compute in.
    """
    height, width = size
    rows, columns = math.ceil(height / _STEP), math.ceil(width / _STEP)
    if min(rows, columns) < _FEWEST:
        return None
    steps = [(torch.arange(n + 3, dtype=like.dtype, device=like.device) - 1) * _STEP for n in (rows, columns)]
    v, u = torch.meshgrid(*steps, indexing="ij")
    nodes, mapped = exact(torch.stack((u, v), -1))
    nodes = nodes.movedim(-1, 1)  # (B, 2, rows + 3, columns + 3)
    some, open_cells = _open_cells(nodes, mapped, source, tolerance)
    most = int(open_cells.sum((1, 2)).max()) if open_cells.numel() else 0
    if most > rows * columns / 2:
        return None
    planes = _interpolated(nodes, rows, columns)  # (B, 2, 8 rows, 8 columns)
    blocks = planes.unflatten(2, (rows, _STEP)).unflatten(4, (columns, _STEP))
    camera, i, j = (~some).nonzero(as_tuple=True)
    blocks[camera, :, i, :, j] = OUTSIDE
    seen = some[:, :, None, :, None].expand(-1, -1, _STEP, -1, _STEP).flatten(3, 4).flatten(1, 2)
    if most:
        # as many cells of every camera as the one with the most has: more of them exact does no harm
        cells = open_cells.flatten(1).to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :most]
        i, j = cells // columns, cells % columns
        offset = torch.arange(_STEP, dtype=like.dtype, device=like.device)
        down, across = (i[..., None, None] * _STEP + offset[:, None]), (j[..., None, None] * _STEP + offset)
        pixels = torch.stack(torch.broadcast_tensors(across, down), -1)  # (B, cells, 8, 8, 2)
        positions, known = exact(pixels.flatten(2, 3))
        camera = torch.arange(len(cells), device=like.device)[:, None]
        blocks[camera, :, i, :, j] = positions.unflatten(2, (_STEP, _STEP)).movedim(-1, 2)
        seen.unflatten(1, (rows, _STEP)).unflatten(3, (columns, _STEP))[camera, i, :, j] = known.unflatten(
            2, (_STEP, -1)
        )
    return planes[:, :, :height, :width].movedim(1, -1), seen[:, :height, :width]


def _open_cells(nodes: Tensor, mapped: Tensor, source: tuple[int, int], tolerance: float) -> tuple[Tensor, ...]:
    """Bool (B, rows, columns) each: some nodes of a cell are mapped; the cell wants exact positions."""
    some, every = (
        _over_windows(_over_windows(mapped, -1, 4, pick), -2, 4, pick) for pick in (torch.logical_or, torch.logical_and)
    )
    missed = _CUBIC * (_fourth_difference(nodes, -1) + _fourth_difference(nodes, -2))
    half = nodes.new_tensor([source[1] / 2, source[0] / 2])[:, None, None]
    high, low = (
        _over_windows(_over_windows(nodes, -1, 4, pick), -2, 4, pick) for pick in (torch.maximum, torch.minimum)
    )
    reach = _MARGIN + _OVERSHOOT * (high - low)
    sampled = ((high + reach > -1) & (low - reach < 1)).all(1)
    return some, some & (~every | (sampled & (missed * half > tolerance).any(1)))


def _fourth_difference(nodes: Tensor, dim: int) -> Tensor:
    """(B, 2, rows, columns): the largest absolute fourth difference along an axis, at and beside each cell."""
    d = nodes.diff(4, dim=dim).abs()
    d = F.pad(d, (1, 1, 0, 0) if dim == -1 else (0, 0, 1, 1), mode="replicate")
    d = d.narrow(-2, 1, d.shape[-2] - 2) if dim == -1 else d.narrow(-1, 1, d.shape[-1] - 2)
    return _over_windows(_over_windows(d, -1, 2, torch.maximum), -2, 2, torch.maximum)


def _over_windows(values: Tensor, dim: int, width: int, pick: Callable) -> Tensor:
    """The largest, or whatever is picked of two, in every window of 2 or 4; torch's pools take longer."""
    for step in (1, 2)[: width // 2]:
        n = values.shape[dim] - step
        values = pick(values.narrow(dim, 0, n), values.narrow(dim, step, n))
    return values


def _interpolated(nodes: Tensor, rows: int, columns: int) -> Tensor:
    """(B, 2, rows + 3, columns + 3) to (B, 2, 8 rows, 8 columns)."""
    weights = _weights(nodes)
    lines = sum(nodes[:, :, i : i + rows, None] * weights[:, i, None] for i in range(4)).flatten(2, 3)
    # torch may be told to multiply matrices in less than float32
    wide = torch.float32 if torch.get_float32_matmul_precision() == "highest" else torch.float64
    lines = lines.to(torch.promote_types(lines.dtype, wide))
    result = nodes.new_empty(*lines.shape[:-1], columns * _STEP)
    cells = _BLOCK // _STEP
    spread = lines.new_zeros(cells + 3, cells, _STEP)
    for cell in range(cells):
        spread[cell : cell + 4, cell] = weights.T
    with torch.autocast(nodes.device.type, enabled=False):
        for first in range(0, columns, cells):
            n = min(cells, columns - first)
            block = lines[..., first : first + n + 3] @ spread[: n + 3, :n].flatten(1)
            result[..., first * _STEP : (first + n) * _STEP] = block
    return result


def _weights(like: Tensor) -> Tensor:
    """(8, 4): of the nodes at -1, 0, 1, 2 in the cubic through them, at 0, 1/8, ..., 7/8."""
    t = torch.arange(_STEP, dtype=torch.float64, device=like.device) / _STEP
    before, at, after, beyond = t + 1, t, t - 1, t - 2
    terms = -at * after * beyond / 6, before * after * beyond / 2, -before * at * beyond / 2, before * at * after / 6
    return torch.stack(terms, -1).to(like.dtype)
