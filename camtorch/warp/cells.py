"""A lattice by torch: which of its cells polynomials through nodes may miss, and what is laid there instead.

`classify` tells a cell's kind by its nodes; cells in doubt are settled by exact positions. To lay a cell is to write
positions of its pixels: `lay_exact` does so, and `lay_quintics`.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch.native import sampler
from camtorch.native.library import native_available
from camtorch.native.structs import (
    CELL_CUBIC,
    CELL_DOUBT,
    CELL_EMPTY,
    CELL_MARGIN,
    CELL_MISSED,
    CELL_OFF,
    CELL_OVERSHOOT,
    CELL_QUINTIC,
    CELL_TODO,
    STEP,
)
from camtorch.warp.camera_pair import CameraPair
from camtorch.warp.lattice import Lattice, lagrange, probes

_MISSED_BY_QUINTICS = 5.5 * 5 / 1024
"""How far quintics miss at most, over the nodes' sixth differences: 5 / 1024 if these are even, and 5.5 times as far
where third derivatives of the positions step."""
_PROBES = ((4, 0), (0, 4), (8, 4), (4, 8), (4, 4))
"""Pixels, across and down in a cell, at which polynomials miss most: the middles of its sides, and its own."""
_MIDDLE = {4: (0.0, -1 / 16, 9 / 16, 9 / 16, -1 / 16, 0.0), 6: tuple(w / 256 for w in (3, -25, 150, 150, -25, 3))}
"""Weights of six nodes half-way between the middle two: in a cubic through 4 of them, and in a quintic through 6."""


def found_by_torch(
    cameras: CameraPair, first: int, size: tuple[int, int], tolerance: float, padding: str, learns: bool
) -> Lattice | None:
    """Return the lattice of `grid.on_lattice` by torch, as of several models in a batch, or without the library.

    learns: whether nodes and exact cells are computed again with a graph.
    """
    n, m = (math.ceil(side / STEP) for side in size)
    source = cameras.source.size_for("Warp")
    # the library finds cubics for each cell; torch alone first looks one node further, whether quintics do everywhere
    looks_further = not (learns or native_available())
    shape = (n + 7, m + 7) if looks_further else (n + 5, m + 5)
    positions, mapped = (t[:, 0] for t in cameras.exact(probes(first, size, cameras.like.dtype, shape[0] - n)))
    count = math.prod(shape)  # after so many nodes the rim follows
    nodes = positions[:, :count].movedim(-1, 1).contiguous().unflatten(2, shape)
    if looks_further:
        is_smooth = bool(mapped.all()) and are_smooth(nodes, source, tolerance)
        nodes = nodes[:, :, 1:-1, 1:-1].contiguous()
        if is_smooth:
            cells = torch.full((len(nodes), n, m), CELL_QUINTIC, dtype=torch.int32, device=nodes.device)
            return Lattice(nodes, cells, nodes.new_empty(2, 0, STEP, STEP), size)
    # cells of cubics: where the nodes show that these serve, or, in doubt, exact positions do
    narrow, rim = nodes.float(), mapped[:, count:]
    mapped = mapped[:, :count].unflatten(1, shape)
    mapped = mapped[:, 1:-1, 1:-1].contiguous() if looks_further else mapped
    find = sampler.classify if native_available() else classify
    cells = find(narrow, mapped, rim, size, source, tolerance, padding)
    settle(cameras, first, cells, narrow, mapped, source, tolerance, padding)
    todo = cells == CELL_TODO
    if not len(cells) or int(todo.sum((1, 2)).max()) > n * m * (1 / 5 if learns else 7 / 8):
        return None
    exact = lay_exact(cameras, first, cells, todo)
    if not learns:
        exact = torch.cat((exact, lay_quintics(nodes, cells, exact.shape[1])), 1)
    return Lattice(nodes, cells, exact, size)


def classify(
    nodes: Tensor,
    mapped: Tensor,
    rim: Tensor,
    size: tuple[int, int],
    source: tuple[int, int],
    tolerance: float,
    padding: str,
) -> Tensor:
    """Return the kinds (B, n, m) int32 of a lattice's cells; `native.sampler.classify` explains kinds and arguments."""
    # of a cell: the largest fourth differences at its corners and the next ones on either side; and of its 16 nodes
    # the highest position, the lowest one negated, and whether some (1) and whether all (-1) are mapped
    fourth = torch.cat((nodes[:, :, 2:-2].diff(4).abs(), nodes[..., 2:-2].diff(4, dim=2).abs()), 1)
    around = nodes[:, :, 1:-1, 1:-1]
    known = mapped[:, None, 1:-1, 1:-1].to(nodes.dtype)
    most = torch.cat((F.pad(fourth, (1, 1, 1, 1), value=-math.inf), around, -around, known, -known), 1)
    across, down, high, low, some, every = _largest(most, 4, 4).split((2, 2, 2, 2, 1, 1), 1)
    half = nodes.new_tensor(source[::-1])[:, None, None] / 2  # pixels of one unit of a position
    missed = (CELL_MISSED * half * (across + down)).square()
    reach = CELL_MARGIN + CELL_OVERSHOOT * (high + low)
    near = (high + reach > -1) & (low + reach > -1)
    # beyond the border one coordinate does not matter, but the other one does
    missed = (missed * near if padding == "border" else missed).sum(1)
    doubt = ~(missed <= tolerance * tolerance)
    doubt = doubt & near.all(1) if padding == "zeros" else doubt
    cells = torch.where(doubt, CELL_DOUBT, CELL_CUBIC).to(torch.int32)
    cells.masked_fill_(every[:, 0] == 0, CELL_TODO).masked_fill_(some[:, 0] == 0, CELL_EMPTY)
    # a pixel at the rim, unlike its cell in what is mapped, says that the nodes do not tell all
    n, m = cells.shape[1:]
    down, across = (torch.arange(length, device=nodes.device) // STEP for length in size)
    at = torch.cat((across, across + (n - 1) * m, down * m, down * m + (size[1] - 1) // STEP))
    flat = cells.flatten(1)
    camera, place = (rim != (flat[:, at] != CELL_EMPTY)).nonzero(as_tuple=True)
    flat[camera, at[place]] = CELL_TODO
    return cells


def are_smooth(nodes: Tensor, source: tuple[int, int], tolerance: float) -> bool:
    """Whether quintics keep the tolerance in every cell, of nodes (B, 2, n + 7, m + 7) which are all mapped."""
    # the largest at a cell's corners, and at the next ones on either side
    across = _largest(nodes[:, :, 2:-2].diff(6, dim=3).abs(), 4, 2)
    down = _largest(nodes[..., 2:-2].diff(6, dim=2).abs(), 2, 4)
    limit = 2 * tolerance / _MISSED_BY_QUINTICS
    missed = (across + down) * nodes.new_tensor(source[::-1])[:, None, None]
    return bool((missed.square().sum(1) <= limit * limit).all())


def _largest(values: Tensor, rows: int, columns: int) -> Tensor:
    """Return the largest of each 2 or 4 rows and columns, in much less time than by `max_pool2d`."""
    for dim, count in ((3, columns), (2, rows)):
        for step in (1, 2)[: count // 2]:
            rest = values.shape[dim] - step
            values = torch.maximum(values.narrow(dim, step, rest), values.narrow(dim, 0, rest))
    return values


def settle(
    cameras: CameraPair,
    first: int,
    cells: Tensor,
    nodes: Tensor,
    mapped: Tensor,
    source: tuple[int, int],
    tolerance: float,
    padding: str,
) -> None:
    """Decide about cells in doubt: polynomials miss most in the middle of a cell and of its sides.

    Cells become `CELL_CUBIC` if cubics keep half the tolerance there, or if an image that ends in zeros is far off;
    else `CELL_QUINTIC` if polynomials through six nodes keep it; else `CELL_TODO`. The target's first row is `first`.
    """
    doubt = cells == CELL_DOUBT
    if not bool(doubt.any()):
        return
    chosen, wanted = indices_of(doubt)
    corners = torch.stack((chosen % cells.shape[2], chosen // cells.shape[2]), -1) * STEP
    corners[..., 1] += first
    positions, known = cameras.exact(corners.unsqueeze(2) + nodes.new_tensor(_PROBES))
    positions = positions.movedim(-1, 2).to(nodes.dtype)  # (B, K, 2, 5)
    camera = torch.arange(len(cells), device=cells.device)[:, None]
    around = _around(nodes, camera, chosen)  # (B, K, 2, 6, 6)
    half = nodes.new_tensor(source[::-1]) / 2
    limit = tolerance * tolerance / 4

    def missed(count: int) -> Tensor:
        """Return squared pixels (B, K, 2, 5) between the probes and polynomials through `count` x `count` nodes."""
        # as in `_PROBES`: rows 2 and 3 are the upper and the lower side, columns 2 and 3 the left and the right one
        weights = nodes.new_tensor(_MIDDLE[count])
        lines = (around * weights).sum(-1)
        sides = (around[..., 2:4] * weights[:, None]).sum(-2)
        said = torch.cat((lines[..., 2:3], sides, lines[..., 3:4], (lines * weights).sum(-1, keepdim=True)), -1)
        return ((positions - said) * half[:, None]).square()

    by_cubics = missed(4)
    is_cubic = by_cubics.sum(2).amax(-1) <= limit
    if padding == "zeros":
        seen = torch.cat((positions, around[..., 2, 2, None]), -1)
        low, high = seen.aminmax(dim=-1)
        reach = (high - low) / 2 + CELL_OFF / half  # the range of positions, with a margin for those between the probes
        is_off = (by_cubics.amax(-1) < 1) & ((high + reach < -1) | (low - reach > 1))
        is_cubic |= is_off.any(-1)
    # a quarter of that, and of what cubics miss: where the curvature steps, quintics gain nothing, and swing
    inside = _around(mapped[:, None], camera, chosen).flatten(2).all(-1)
    is_quintic = inside & (missed(6).sum(2).amax(-1) <= limit / 16)
    kinds = torch.where(is_quintic, CELL_QUINTIC, CELL_TODO).masked_fill_(is_cubic, CELL_CUBIC)
    kinds.masked_fill_(~known.all(-1), CELL_TODO)
    put(cells, chosen, wanted, kinds)


def prefer_quintics(nodes: Tensor, cells: Tensor, source: tuple[int, int], tolerance: float) -> None:
    """Turn each `CELL_CUBIC` into a `CELL_QUINTIC` whose quintic misses the cubic by half the tolerance at most."""
    half = nodes.new_tensor(source[::-1])[:, None, None] / 2
    apart = []
    for dim, other in ((2, 3), (3, 2)):
        # in the middle of two nodes they differ by 3/256 of the fourth differences at both
        at = nodes.diff(4, dim=dim)
        most = (at.narrow(dim, 1, at.shape[dim] - 1) + at.narrow(dim, 0, at.shape[dim] - 1)).abs()
        for step in (1, 2, 2):  # the largest of the six lines around
            count = most.shape[other] - step
            most = torch.maximum(most.narrow(other, step, count), most.narrow(other, 0, count))
        apart.append(most)
    across, down = (3 / 256 * half * (apart[0] + apart[1])).square().unbind(1)
    cells.masked_fill_((cells == CELL_CUBIC) & (across + down <= tolerance * tolerance / 4), CELL_QUINTIC)


def indices_of(todo: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices (B, K) of the cells that are True in `todo` (B, n, m), and bool (B, K): which of them count.

    K is the largest number of such cells of any camera. Cameras with fewer have indices of other cells as well, which
    do not count.
    """
    flat = todo.flatten(1)
    chosen = flat.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, : int(flat.sum(1).max())]
    return chosen, flat.gather(1, chosen)


def put(cells: Tensor, chosen: Tensor, wanted: Tensor, kinds: Tensor) -> None:
    """Write kinds (B, K) into the chosen cells that are wanted."""
    flat = cells.flatten(1)
    flat.scatter_(1, chosen, torch.where(wanted, kinds.to(cells.dtype), flat.gather(1, chosen)))


def lay_exact(cameras: CameraPair, first: int, cells: Tensor, todo: Tensor) -> Tensor:
    """Return exact positions (2, K, 8, 8) of the cells to do (B, n, m), and write their places into `cells`.

    Where what is mapped ends in one, its neighbours follow.
    """
    like = cameras.like
    parts = [like.new_empty(2, 0, STEP, STEP)]
    count = 0  # of the cells laid so far, whose numbers are their places
    done = torch.zeros_like(todo)
    offset = torch.arange(STEP, dtype=like.dtype, device=like.device)
    while bool(todo.any()):
        chosen, wanted = indices_of(todo)
        i, j = chosen // todo.shape[2], chosen % todo.shape[2]
        down = i[..., None, None] * STEP + offset[:, None]
        across = j[..., None, None] * STEP + offset
        pixels = torch.stack(torch.broadcast_tensors(across, down + first), -1)  # (B, most, 8, 8, 2)
        positions, known = cameras.exact(pixels.flatten(2, 3))
        part = torch.where(known, positions.movedim(-1, 0), torch.nan)
        parts.append(part.flatten(1, 2).unflatten(-1, (STEP, STEP)))
        put(cells, chosen, wanted, torch.arange(count, count + chosen.numel(), device=cells.device).view_as(chosen))
        count += chosen.numel()
        done |= todo
        # the limit may go on in cells around, though their nodes do not show it
        limit = torch.zeros_like(todo).flatten(1).scatter_(1, chosen, wanted & known.any(-1) & ~known.all(-1))
        around = F.max_pool2d(limit.view_as(todo).to(like.dtype).unsqueeze(1), 3, 1, 1)[:, 0]
        todo = (around > 0) & ~done
    return torch.cat(parts, 1)


def lay_quintics(nodes: Tensor, cells: Tensor, count: int) -> Tensor:
    """Return positions (2, K, 8, 8) of all `CELL_QUINTIC`, and write their places, from `count` on, into `cells`."""
    some = cells == CELL_QUINTIC
    camera, index = some.flatten(1).nonzero(as_tuple=True)
    if not len(index):
        return nodes.new_empty(2, 0, STEP, STEP)
    cells[some] = torch.arange(count, count + len(index), dtype=cells.dtype, device=cells.device)
    weights = lagrange(6, nodes.device)
    # torch may be told to multiply matrices of less than float64 in fewer bits
    around = _around(nodes, camera, index).double()
    return (weights @ around @ weights.mT).to(nodes.dtype).transpose(0, 1)


def _around(nodes: Tensor, camera: Tensor, index: Tensor) -> Tensor:
    """Return the nodes (*K, c, 6, 6) around cells of a camera each, of all nodes (B, c, n + 5, m + 5)."""
    columns = nodes.shape[-1] - 5
    return nodes.unfold(2, 6, 1).unfold(3, 6, 1)[camera, :, index // columns, index % columns]
