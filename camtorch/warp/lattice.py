"""Positions at which a target samples an image: one for each pixel, or a lattice of every eighth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce
from typing import Any, ClassVar, NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.autograd import Function

from camtorch.evaluate.devices import sent
from camtorch.evaluate.door import is_cheap_to_read, is_eager
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import are_plain, known_true
from camtorch.native import sampler
from camtorch.native.library import native_available
from camtorch.native.structs import CELL_CUBIC, CELL_EMPTY, CELL_QUINTIC, FAR, OUTSIDE, STEP

FEWEST_CELLS = 8  # along a side: with fewer, exact positions take less time than a lattice
MOST_KEPT_NODES = 1 << 16  # of a lattice whose pixels are kept for the next one
_BLOCK_PIXELS = 128  # that one product interpolates: wider ones multiply with more zeros
_kept_weights = Kept(4)  # those of `_weights`


class PixelPositions(NamedTuple):
    """Where each pixel of some rows of a target, or of all, samples the source's image."""

    grid: Tensor  # (B or 1, h, W', 2): positions as of `grid_sample`, `OUTSIDE` where there is none
    mapped: Tensor  # (B or 1, h, W') bool: the pixel has a ray, and the source maps it
    scale: Tensor | None  # (B or 1, h, W'): see `local_scale`; None if images are not antialiased

    @property
    def pixels(self) -> PixelPositions:
        """These positions: a `Lattice` has those of all its pixels under this name."""
        return self

    def like(self) -> Tensor:
        """Return a tensor with the dtype, device, graph and number of cameras of the positions."""
        return self.grid

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of what is sampled."""
        return self.grid.shape[1], self.grid.shape[2]

    def cameras(self, rows: slice | Tensor) -> PixelPositions:
        """Return the positions of these cameras of the batch."""
        scale = None if self.scale is None else self.scale[rows]
        return PixelPositions(self.grid[rows], self.mapped[rows], scale)

    def on(self, device: torch.device) -> PixelPositions:
        """Send positions from the CPU to another device."""
        grid, mapped, *scale = sent([t for t in self if t is not None], device)
        return PixelPositions(grid, mapped, scale[0] if scale else None)

    def part(self, down: slice, across: slice = slice(None)) -> PixelPositions:
        """Return the positions of these rows and columns of the target."""
        scale = None if self.scale is None else self.scale[:, down, across]
        return PixelPositions(self.grid[:, down, across], self.mapped[:, down, across], scale)

    def every(self, first: int, step: int) -> Tensor:
        """Return positions (B, 2, h', w') of each `step`-th pixel, down and across, from `first` on."""
        return self.grid.detach().movedim(-1, 1)[..., first::step, first::step]

    def for_native(self, padding: str) -> dict[str, Any]:
        """Return the positions as `native.sampler.NativeJob` takes them."""
        # in "zeros" positions far outside say that there is none
        return {"grid": self.grid.detach(), "mapped": None if padding == "zeros" else self.mapped}


@dataclass(eq=False)
class Lattice:
    """Where every pixel of a target (h, w) samples the source's image, by `nodes` (B, 2, n + 5, m + 5) of every eighth.

    Nodes begin at pixel (-16, first row - 16); a cubic goes through four along each axis. `cells` (B, n, m) int32 are
    `CELL_EMPTY`, `CELL_CUBIC`, or a place in `exact` (2, K, 8, 8), positions for each pixel, NaN where none is mapped;
    with a graph and without the compiled library also `CELL_QUINTIC`, for quintics through six nodes, whose derivatives
    are as good as exact ones.
    """

    nodes: Tensor
    cells: Tensor
    exact: Tensor
    size: tuple[int, int]
    scale: ClassVar[None] = None  # images are not antialiased

    def like(self) -> Tensor:
        """Return a tensor with the dtype, device, graph and number of cameras of the positions."""
        return self.nodes

    def cameras(self, rows: slice | Tensor) -> Lattice:
        """Return the lattice of these cameras of the batch."""
        return Lattice(self.nodes[rows], self.cells[rows], self.exact, self.size)

    def on(self, device: torch.device) -> PixelPositions:
        """Send a lattice from the CPU to another device, and return the positions of all pixels there."""
        places, exact = _by_place(self.cells, self.exact)
        nodes, cells, exact, places = sent([self.nodes, self.cells, exact, places], device)
        return PixelPositions(*_pixel_by_pixel(nodes, cells, places, exact, self.size), None)

    def every(self, first: int, step: int) -> Tensor:
        """Return positions (B, 2, h', w') of each `step`-th pixel, down and across, from `first` on."""
        if first % STEP or step % STEP:
            return self.pixels.every(first, step)
        # the third node is the first that lies on the target, at its first pixel
        return self.nodes[..., 2 + first // STEP : -3 : step // STEP, 2 + first // STEP : -3 : step // STEP]

    def for_native(self, _: str) -> dict[str, Any]:
        """Return the lattice as `native.sampler.NativeJob` takes it, in float32."""
        # not cached in float32: only the garbage collector frees an object that holds itself
        found = self if self.nodes.dtype == torch.float32 else self._narrowed
        return {"nodes": found.nodes, "cells": found.cells, "exact": found.exact}

    @cached_property
    def _narrowed(self) -> Lattice:
        return Lattice(self.nodes.float(), self.cells, self.exact.float(), self.size)

    @cached_property
    def pixels(self) -> PixelPositions:
        """The positions of all pixels."""
        nodes, cells, exact = self.nodes, self.cells, self.exact
        if nodes.dtype == torch.float32 and native_available() and is_eager(nodes, exact, cells):
            grid, seen = _Pixels.apply(nodes, cells, exact, self.size)  # type: ignore[no-untyped-call]
        else:
            grid, seen = _pixel_by_pixel(nodes, cells, *_by_place(cells, exact), self.size)
        return PixelPositions(grid, seen, None)


Positions: TypeAlias = PixelPositions | Lattice


class _Pixels(Function):
    """Positions of a lattice's pixels, and whether there are any, by native code; second derivatives by torch."""

    @staticmethod
    def forward(ctx: Any, nodes: Tensor, cells: Tensor, exact: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        grid, seen = sampler.lay(nodes, cells, exact, size)
        ctx.save_for_backward(nodes, cells, exact)
        ctx.size = size
        ctx.mark_non_differentiable(seen)
        return grid, seen

    @staticmethod
    def backward(ctx: Any, by_grid: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        nodes, cells, exact = ctx.saved_tensors
        if not torch.is_grad_enabled() and is_eager(by_grid):
            by_nodes, by_exact = sampler.lay_vjp(by_grid, cells, exact.shape[1])
            return by_nodes, None, by_exact, None
        leaves = nodes.detach().requires_grad_(), exact.detach().requires_grad_()
        with torch.enable_grad():  # positions are linear in both leaves
            grid, _ = _pixel_by_pixel(leaves[0], cells, *_by_place(cells, leaves[1]), ctx.size)
        by_nodes, by_exact = torch.autograd.grad(grid, leaves, by_grid, create_graph=True, materialize_grads=True)
        return by_nodes, None, by_exact, None


def _by_place(cells: Tensor, exact: Tensor) -> tuple[Tensor, Tensor]:
    """Return the places (3, K) of the cells with exact positions, and these (2, K, 8, 8), in this order."""
    places = (cells >= 0).nonzero(as_tuple=True)
    return torch.stack(places), exact[:, cells[places].long()]


def _pixel_by_pixel(
    nodes: Tensor, cells: Tensor, places: Tensor, exact: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Return positions (B, h, w, 2) of a lattice's pixels, and whether there are any, bool (B, h, w); by torch.

    `places` and `exact` are those of `_by_place`.
    """
    (height, width), (_, n, m) = size, cells.shape
    quintic = cells == CELL_QUINTIC
    if known_true(quintic):
        planes = interpolated(nodes, n, m)[:, :, :height, :width]
        return planes.movedim(1, -1), torch.ones_like(planes[:, 0], dtype=torch.bool)
    planes = interpolated(nodes[:, :, 1:-1, 1:-1], n, m)  # (B, 2, 8 n, 8 m)
    if is_cheap_to_read(quintic) and bool(quintic.any()):
        wide = quintic.repeat_interleave(STEP, 1).repeat_interleave(STEP, 2).unsqueeze(1)
        planes = torch.where(wide, interpolated(nodes, n, m), planes)
    blocks = planes.unflatten(2, (n, STEP)).unflatten(4, (m, STEP))
    some = cells != CELL_EMPTY
    if not known_true(some):
        blocks.masked_fill_(~some[:, None, :, None, :, None], OUTSIDE)
    seen = some[:, :, None, :, None].expand(-1, -1, STEP, -1, STEP).flatten(3, 4).flatten(1, 2)
    camera, i, j = places
    if len(camera):
        exact = exact.transpose(0, 1)  # (K, 2, 8, 8)
        known = ~exact[:, 0].isnan()
        blocks[camera, :, i, :, j] = torch.where(known[:, None], exact, OUTSIDE)
        seen.unflatten(1, (n, STEP)).unflatten(3, (m, STEP))[camera, i, :, j] = known
    return planes[:, :, :height, :width].movedim(1, -1), seen[:, :height, :width]


def to_positions(seen: Tensor, mapped: Tensor, size: tuple[int, int]) -> Tensor:
    """Return pixels (..., 2) of an image as positions for `grid_sample`; without a graph, `seen` is overwritten."""
    if is_cheap_to_read(seen) and are_plain(seen):
        for plane, side in zip(seen.unbind(-1), size[::-1], strict=True):
            plane.mul_(2 / side).add_(1 / side - 1)
        seen.clamp_(-FAR, FAR)
        if not bool(mapped.all()):
            seen.masked_fill_(~mapped.unsqueeze(-1), OUTSIDE)
        return seen
    planes = [
        (plane * (2 / side) + (1 / side - 1)).clamp(-FAR, FAR)
        for plane, side in zip(seen.unbind(-1), size[::-1], strict=True)
    ]
    return torch.where(mapped, torch.stack(planes), OUTSIDE).movedim(0, -1)


def coarse(size: tuple[int, ...]) -> tuple[int, int]:
    """Return the first pixel and the step, in both directions, at which a target (h, w) shows how far images shrink."""
    if min(size) >= 64:
        return 16, 32
    return 0, STEP if min(size) > STEP else 1


def probes(first: int, size: tuple[int, int], dtype: torch.dtype, more: int = 5) -> Tensor:
    """Return the nodes of a lattice, and then the pixels at the rim of the target, (1, N, 2) on the CPU.

    Along an axis there are as many nodes as cells, and `more`. Of small lattices they are kept for the next one.
    """
    nodes = (math.ceil(size[0] / STEP) + more) * (math.ceil(size[1] / STEP) + more)
    return (_kept_probes if nodes <= MOST_KEPT_NODES else _new_probes)(first, size, dtype, more)


def _new_probes(first: int, size: tuple[int, int], dtype: torch.dtype, more: int) -> Tensor:
    with torch.inference_mode(False):
        down, across = (torch.arange(length, dtype=dtype, device="cpu") for length in size)
        # two more nodes on each side of the cells: one for the cubics, and both for fourth differences
        counts = [math.ceil(side / STEP) + more for side in size]
        v, u = ((torch.arange(count, dtype=dtype, device="cpu") - more // 2) * STEP for count in counts)
        nodes = torch.stack(torch.meshgrid(u, v + first, indexing="xy"))
        # (2 (w + h), 2): the pixels of the first and the last row, and of the first and the last column
        down += first
        sides = [(across, torch.full_like(across, end)) for end in (first, first + size[0] - 1)]
        sides += [(torch.full_like(down, end), down) for end in (0, size[1] - 1)]
        return torch.cat((nodes.flatten(1), torch.cat([torch.stack(pair, -1) for pair in sides]).mT), 1).mT[None]


_kept_probes = lru_cache(maxsize=8)(_new_probes)


def straight_lattice(matrix: Tensor, rows: range, width: int, dtype: torch.dtype) -> Lattice:
    """Return the lattice of positions that are an affine function (B, 2, 3) of the target's pixels."""
    count, n, m = len(matrix), math.ceil(len(rows) / STEP), math.ceil(width / STEP)
    v, u = ((torch.arange(k + 5, dtype=matrix.dtype, device=matrix.device) - 2) * STEP for k in (n, m))
    across, down, shift = (column[..., None, None] for column in matrix.unbind(-1))
    nodes = (across * u + (down * (v + rows.start)[:, None] + shift)).to(dtype)
    cells = torch.full((count, n, m), CELL_CUBIC, dtype=torch.int32, device=matrix.device)
    return Lattice(nodes, cells, nodes.new_empty(2, 0, STEP, STEP), (len(rows), width))


def interpolated(nodes: Tensor, rows: int, columns: int) -> Tensor:
    """Interpolate nodes (B, 2, rows + 3, columns + 3), or + 5 for quintics, to pixels (B, 2, 8 rows, 8 columns)."""
    # torch may be told to multiply matrices in less than float32
    wide = nodes.dtype if torch.get_float32_matmul_precision() == "highest" else torch.float64
    taps = nodes.shape[2] - rows + 1
    form = taps, nodes.dtype, wide, nodes.device
    is_kept = not nodes.is_cpu or is_eager(nodes)
    weights, spread = _kept_weights((), form, lambda: _weights(*form)) if is_kept else _weights(*form)
    terms = (nodes[:, :, i : i + rows, None] * weights[:, i, None] for i in range(taps))
    lines = reduce(torch.add, terms).flatten(0, 3).to(wide)
    result = lines.new_empty(len(lines), columns * STEP)
    cells = _BLOCK_PIXELS // STEP
    with torch.autocast(nodes.device.type, enabled=False):
        for first in range(0, columns, cells):
            n = min(cells, columns - first)
            reach = n + taps - 1
            factors = lines[:, first : first + reach], spread[:reach, :n].flatten(1)
            block = result[:, first * STEP : (first + n) * STEP]
            if lines.requires_grad:
                block.copy_(torch.mm(*factors))
            else:
                torch.mm(*factors, out=block)
    return result.to(nodes.dtype).view(len(nodes), 2, rows * STEP, columns * STEP)


def lagrange(taps: int, device: torch.device) -> Tensor:
    """Return Lagrange's weights (8, taps) in float64 of nodes at the pixels of a cell, between the middle two nodes."""
    t = torch.arange(STEP, dtype=torch.float64, device=device) / STEP
    nodes = range(1 - taps // 2, taps // 2 + 1)
    weights = []
    for node in nodes:
        factors = [(t - other) / (node - other) for other in nodes if other != node]
        weights.append(reduce(torch.mul, factors))
    return torch.stack(weights, -1)


def _weights(taps: int, dtype: torch.dtype, wide: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return weights (8, taps) of nodes at the pixels of a cell, and the matrix that has these for a block of cells."""
    weights, cells = lagrange(taps, device).to(dtype), _BLOCK_PIXELS // STEP
    spread = weights.new_zeros(cells + taps - 1, cells, STEP, dtype=wide)
    for cell in range(cells):
        spread[cell : cell + taps, cell] = weights.T
    return weights, spread
