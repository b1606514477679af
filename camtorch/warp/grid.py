"""Where a warp samples: for every pixel of the target, a position on the source's image, exact or from a lattice."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial, reduce
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch._tracing import in_transform, is_concrete, may_look
from camtorch.camera import Camera
from camtorch.rotations import turn

OUTSIDE = -9.0  # a sampling position that no image reaches, not even with its interpolation margin
_FAR = 100.0  # positions beyond are drawn in: grid_sample casts them to integers
_STRIP = 1 << 19  # pixels
_FEWEST = 8  # cells along a side from which on a lattice pays
_STEP = 8  # pixels between the nodes of a lattice
_BLOCK = 128  # pixels that one product interpolates: wider ones multiply with more zeros
_MARGIN = 0.05  # of half an image: what lies beyond is not sampled
_OVERSHOOT = 0.5  # of the range of its nodes by which a cubic may leave it: 0.27 along each axis
_CUBIC = 3 / 128  # a cubic through four even nodes misses its middle by this part of their fourth difference
_SAFETY = 3.0  # times that is assumed: at a step of the curvature, fourth differences tell less; 0.6 of it is then used

Exact = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Pixels (h, w, 2) for every camera, or (B, h, w, 2) for each its own, to positions (B or 1, h, w, 2) as of
`grid_sample`, `OUTSIDE` where no ray is mapped, and bool (B or 1, h, w): whether one is."""


class Sampling(NamedTuple):
    """Where some rows of a target, or all of them, sample the source's image."""

    grid: Tensor
    """(B or 1, h, W', 2): positions as of `grid_sample`, `OUTSIDE` where there is none."""
    mapped: Tensor
    """(B or 1, h, W') bool: the pixel has a ray, and the source maps it."""
    scale: Tensor | None
    """(B or 1, h, W'): see `local_scale`; None where nobody asks for it."""

    def cameras(self, rows: slice) -> Sampling:
        """Of these cameras of the batch."""
        return Sampling(self.grid[rows], self.mapped[rows], None if self.scale is None else self.scale[rows])

    def part(self, down: slice, across: slice = slice(None)) -> Sampling:
        """Of these rows and columns of the target."""
        scale = None if self.scale is None else self.scale[:, down, across]
        return Sampling(self.grid[:, down, across], self.mapped[:, down, across], scale)


def tabulate(
    source: Camera, target: Camera, rotation: Tensor | None, tolerance: float = 0.0, rows: range | None = None
) -> tuple[Tensor, Tensor]:
    """The sampling positions of a target's pixels, and which of them are mapped: see `Exact`.

    Args:
        source: the camera of the images.
        target: the camera of the images to make.
        rotation: (3, 3) or (B, 3, 3), `ray_target = R ray_source`, or None.
        tolerance: see `Warp`; above zero the CPU may take `on_lattice`.
        rows: of the target; all by default.
    """
    height, width = target._size("Warp")
    rows = range(height) if rows is None else rows
    like = target.intrinsics.new_empty(0, dtype=torch.promote_types(target.intrinsics.dtype, torch.float32))
    exact = partial(_positions, source, target, rotation)
    if in_transform() or not is_concrete(target.intrinsics):
        return exact(_pixels(rows, width, like))
    if tolerance and like.is_cpu:
        found = on_lattice(exact, rows, width, source._size("Warp"), tolerance, like)
        if found is not None:
            return found
    # by strips: memory for what is in between is used again
    count = max(math.prod(c.batch_shape) for c in (source, target))
    count = count if rotation is None else max(count, math.prod(rotation.shape[:-2]))
    step = max(_STRIP // max(count * width, 1), 1)
    part, seen = exact(_pixels(rows[:step], width, like))
    if len(rows) <= step:
        return part, seen
    grid, mapped = (t.new_empty(len(t), len(rows), *t.shape[2:]) for t in (part, seen))
    grid[:, :step], mapped[:, :step] = part, seen
    for i in range(step, len(rows), step):
        here = slice(i, i + step)
        grid[:, here], mapped[:, here] = exact(_pixels(rows[here], width, like))
    return grid, mapped


def _pixels(rows: range, width: int, like: Tensor) -> Tensor:
    """(len(rows), width, 2): the centres of the pixels."""
    v = torch.arange(rows.start, rows.stop, dtype=like.dtype, device=like.device)
    u = torch.arange(width, dtype=like.dtype, device=like.device)
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)


def _positions(source: Camera, target: Camera, rotation: Tensor | None, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Where the source sees target pixels (h, w, 2) or (B, h, w, 2): see `Exact`."""
    if pixels.ndim == 3:
        pixels = pixels.expand(*target.batch_shape, *pixels.shape)
    rays, has_ray = target.unproject(pixels)
    if rays.ndim == 3:
        rays, has_ray = rays.unsqueeze(0), has_ray.unsqueeze(0)
    seen, mapped = source.project(turn(None if rotation is None else rotation.mT, rays, "rays"))
    mapped = mapped & has_ray
    position = torch.stack(
        [
            (plane * (2 / size) + (1 / size - 1)).clamp(-_FAR, _FAR)
            for plane, size in zip(seen.unbind(-1), source._size("Warp")[::-1], strict=True)
        ]
    )
    if not (may_look(mapped) and bool(mapped.all())):
        position = torch.where(mapped, position, OUTSIDE)
    return position.movedim(0, -1), mapped


def local_scale(grid: Tensor, mapped: Tensor, size: tuple[int, int]) -> Tensor:
    """(B, H', W'): how many source pixels lie between neighbours of the target, in the direction with more of them.

    Args:
        grid: (B, H', W', 2), sampling positions.
        mapped: (B, H', W') bool: there is such a position.
        size: (height, width) of the source.
    """
    half = grid.new_tensor([size[1] / 2, size[0] / 2])
    scale = grid.new_zeros(grid.shape[:-1])
    for dim in (1, 2):
        n = grid.shape[dim] - 1
        step = ((grid.narrow(dim, 1, n) - grid.narrow(dim, 0, n)) * half).norm(dim=-1)
        step = step * (mapped.narrow(dim, 1, n) & mapped.narrow(dim, 0, n))
        for start in (0, 1):
            here = scale.narrow(dim, start, n)
            here.copy_(torch.maximum(here, step))
    return scale


def on_lattice(
    exact: Exact, rows: range, width: int, source: tuple[int, int], tolerance: float, like: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Positions within `tolerance` pixels of the exact ones, from a lattice of every eighth pixel.

    Between nodes a cubic is laid through four of them along each axis. Cells where fourth differences say that this
    misses by more than the tolerance, and cells at the limit of what is mapped and beside it, are computed pixel by
    pixel. None if that would be most of the image. What is mapped, or is not, between four nodes alone and away from
    that limit is not seen.

    Args:
        exact: see `Exact`.
        rows: of the target.
        width: of the target.
        source: (height, width) of the source, in whose pixels the tolerance is.
        tolerance: positive, in pixels.
        like: a tensor of the dtype and on the device to compute in.
    """
    height, n, m = len(rows), math.ceil(len(rows) / _STEP), math.ceil(width / _STEP)  # n by m cells
    if min(n, m) < _FEWEST:
        return None
    # two more nodes on each side of the cells: one for the cubics, and both for fourth differences
    v, u = ((torch.arange(k + 5, dtype=like.dtype, device=like.device) - 2) * _STEP for k in (n, m))
    nodes, mapped = exact(torch.stack(torch.meshgrid(u, v + rows.start, indexing="xy"), -1))
    nodes = nodes.movedim(-1, 1)  # (B, 2, n + 5, m + 5)
    some, todo = _open_cells(nodes, mapped[:, 1:-1, 1:-1], source, tolerance)
    _open_rim(exact, rows, width, some, todo, like)
    if bool((todo.sum((1, 2)) > n * m / 2).any()):
        return None
    planes = _interpolated(nodes[:, :, 1:-1, 1:-1], n, m)  # (B, 2, 8 n, 8 m)
    blocks = planes.unflatten(2, (n, _STEP)).unflatten(4, (m, _STEP))
    camera, i, j = (~some).nonzero(as_tuple=True)
    blocks[camera, :, i, :, j] = OUTSIDE
    seen = some[:, :, None, :, None].expand(-1, -1, _STEP, -1, _STEP).flatten(3, 4).flatten(1, 2)
    cells = seen.unflatten(1, (n, _STEP)).unflatten(3, (m, _STEP))
    done = torch.zeros_like(todo)
    while bool(todo.any()):
        _compute(exact, rows.start, todo, blocks, cells)
        done |= todo
        # the limit goes on where it is thinner than cells
        limit = todo & cells.any(4).any(2) & ~cells.all(4).all(2)
        todo = (F.max_pool2d(limit.to(like.dtype).unsqueeze(1), 3, 1, 1)[:, 0] > 0) & ~done
    return planes[:, :, :height, :width].movedim(1, -1), seen[:, :height, :width]


def _compute(exact: Exact, first: int, todo: Tensor, blocks: Tensor, seen: Tensor) -> None:
    """Exact positions in the cells (B, n, m) of a lattice that starts at row `first`.

    Args:
        exact: see `Exact`.
        first: see above.
        todo: the cells.
        blocks: (B, 2, n, 8, m, 8), the positions.
        seen: (B, n, 8, m, 8), which are mapped.
    """
    # as many cells of every camera as the one with the most has: more of them exact does no harm
    most = int(todo.sum((1, 2)).max())
    cells = todo.flatten(1).to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :most]
    i, j = cells // todo.shape[2], cells % todo.shape[2]
    offset = torch.arange(_STEP, dtype=blocks.dtype, device=blocks.device)
    down, across = (i[..., None, None] * _STEP + offset[:, None]), (j[..., None, None] * _STEP + offset)
    pixels = torch.stack(torch.broadcast_tensors(across, down + first), -1)  # (B, cells, 8, 8, 2)
    positions, known = exact(pixels.flatten(2, 3))
    camera = torch.arange(len(cells), device=blocks.device)[:, None]
    blocks[camera, :, i, :, j] = positions.unflatten(2, (_STEP, _STEP)).movedim(-1, 2)
    seen[camera, i, :, j] = known.unflatten(2, (_STEP, _STEP))


def _open_rim(exact: Exact, rows: range, width: int, some: Tensor, todo: Tensor, like: Tensor) -> None:
    """Have cells (B, n, m) computed where a pixel at the rim of the image says that nodes do not tell all."""
    v, u = (torch.arange(side, dtype=like.dtype, device=like.device) for side in (len(rows), width))
    sides = [(u, torch.full_like(u, end)) for end in (0, len(rows) - 1)]
    sides += [(torch.full_like(v, end), v) for end in (0, width - 1)]
    across, down = (torch.cat(parts) for parts in zip(*sides, strict=True))
    _, mapped = exact(torch.stack((across, down + rows.start), -1).unsqueeze(0))
    i, j = (down // _STEP).long(), (across // _STEP).long()
    camera, pixel = (mapped[:, 0] != some[:, i, j]).nonzero(as_tuple=True)
    todo[camera, i[pixel], j[pixel]] = True


def _open_cells(nodes: Tensor, mapped: Tensor, source: tuple[int, int], tolerance: float) -> tuple[Tensor, Tensor]:
    """Bool (B, n, m) each: some nodes of a cell are mapped; the cell wants exact positions.

    Args:
        nodes: (B, 2, n + 5, m + 5).
        mapped: (B, n + 3, m + 3): without those that only fourth differences are made of.
        source: see `on_lattice`.
        tolerance: likewise.
    """
    some, every = (
        _over_windows(_over_windows(mapped, -1, 4, pick), -2, 4, pick) for pick in (torch.logical_or, torch.logical_and)
    )
    half = nodes.new_tensor([source[1] / 2, source[0] / 2])[:, None, None]
    missed = _SAFETY * _CUBIC * half * (_fourth_difference(nodes, -1) + _fourth_difference(nodes, -2))
    near = nodes[:, :, 1:-1, 1:-1]
    high, low = (
        _over_windows(_over_windows(near, -1, 4, pick), -2, 4, pick) for pick in (torch.maximum, torch.minimum)
    )
    reach = _MARGIN + _OVERSHOOT * (high - low)
    sampled = ((high + reach > -1) & (low - reach < 1)).all(1)
    return some, some & (~every | (sampled & (torch.hypot(*missed.unbind(1)) > tolerance)))


def _fourth_difference(nodes: Tensor, dim: int) -> Tensor:
    """(B, 2, n, m): the largest absolute fourth difference along an axis at the corners of each cell."""
    other = -3 - dim
    d = nodes.narrow(other, 2, nodes.shape[other] - 4).diff(4, dim=dim).abs()
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
    terms = (nodes[:, :, i : i + rows, None] * weights[:, i, None] for i in range(4))
    lines = reduce(torch.add, terms).flatten(2, 3)
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
