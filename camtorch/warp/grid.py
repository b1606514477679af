"""Where a warp samples: for every pixel of the target, a position on the source's image, exact or from a lattice."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial, reduce
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor
from torch.autograd import Function

from camtorch.cameras.camera import Camera
from camtorch.cameras.mixed import Mixed
from camtorch.evaluate.devices import sent
from camtorch.evaluate.door import is_eager, keeps_graph, may_look
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import are_plain, is_unknown, known_true
from camtorch.native import sampler
from camtorch.native.library import native_available
from camtorch.native.structs import (
    CELL_CUBIC,
    CELL_EMPTY,
    CELL_QUINTIC,
    CELL_TODO,
    FAR,
    OUTSIDE,
    POSITIONS,
    RADIUS_TABLE,
    STEP,
    SURFACE,
)
from camtorch.poses.rotations import turn
from camtorch.projection.evaluation import compiled_of
from camtorch.projection.native_calls import NativeMove
from camtorch.values.arguments import columns
from camtorch.values.threads import on_one_thread
from camtorch.warp.cells import Exact, are_smooth, classify, lay_quintics, places, prefer_quintics, put, settle
from camtorch.warp.panorama import goes_round, lengths, off_poles, seam_of, within_turn

_STRIP = 1 << 19  # pixels
FEWEST = 8  # cells along a side: with fewer, exact positions take less time than a lattice
_BLOCK = 128  # pixels that one product interpolates: wider ones multiply with more zeros
_kept_weights = Kept(4)  # those of `_weights`
MOST_KEPT = 1 << 16  # nodes of a lattice whose pixels are kept for the next one


class Sampling(NamedTuple):
    """Where some rows of a target, or all of them, sample the source's image."""

    grid: Tensor  # (B or 1, h, W', 2): positions as of `grid_sample`, `OUTSIDE` where there is none
    mapped: Tensor  # (B or 1, h, W') bool: the pixel has a ray, and the source maps it
    scale: Tensor | None  # (B or 1, h, W'): see `local_scale`; None if images are not antialiased

    @property
    def pixels(self) -> Sampling:
        """This sampling: a `Lattice` has its positions pixel by pixel under this name too."""
        return self

    def cameras(self, rows: slice | Tensor) -> Sampling:
        """Return the positions of these cameras of the batch."""
        scale = None if self.scale is None else self.scale[rows]
        return Sampling(self.grid[rows], self.mapped[rows], scale)

    def on(self, device: torch.device) -> Sampling:
        """Send positions from the CPU to another device."""
        grid, mapped, *scale = sent([t for t in self if t is not None], device)
        return Sampling(grid, mapped, scale[0] if scale else None)

    def part(self, down: slice, across: slice = slice(None)) -> Sampling:
        """Return the positions of these rows and columns of the target."""
        scale = None if self.scale is None else self.scale[:, down, across]
        return Sampling(self.grid[:, down, across], self.mapped[:, down, across], scale)


@dataclass(eq=False)
class Lattice:
    """Where every pixel of a target (h, w) samples the source's image, by `nodes` (B, 2, n + 5, m + 5) of every eighth.

    Nodes begin at pixel (-16, first row - 16); a cubic goes through four along each axis. `cells` (B, n, m) int32 are
    `CELL_EMPTY`, `CELL_CUBIC`, or a place in `exact` (2, K, 8, 8), positions for each pixel, NaN where none is mapped;
    with a graph also `CELL_QUINTIC`, for quintics through six nodes, whose derivatives are as good as exact ones.

    done: (3, K) the cells of `exact`, in its order; None where `cells` may be looked at.
    smooth: whether all cells are `CELL_QUINTIC`, as without the compiled library, to which none may be given.
    """

    nodes: Tensor
    cells: Tensor
    exact: Tensor
    size: tuple[int, int]
    done: Tensor | None = None
    smooth: bool = False

    def on(self, device: torch.device) -> Lattice:
        """Send a lattice from the CPU to another device."""
        done = torch.stack((self.cells >= 0).nonzero(as_tuple=True))
        exact = self.exact[:, self.cells[tuple(done)].long()]
        nodes, cells, exact, done = sent([self.nodes, self.cells, exact, done], device)
        return Lattice(nodes, cells, exact, self.size, done, self.smooth)

    def cameras(self, rows: slice | Tensor) -> Lattice | Sampling:
        """Return the lattice of these cameras of the batch; on another device the positions of its pixels."""
        if self.done is not None:
            return self.pixels.cameras(rows)
        return Lattice(self.nodes[rows], self.cells[rows], self.exact, self.size)

    @property
    def single(self) -> Lattice:
        """The lattice with nodes and exact positions in float32, in which the native sampler reads them."""
        # not cached: only the garbage collector frees an object that holds itself
        return self if self.nodes.dtype == torch.float32 else self._narrowed

    @cached_property
    def _narrowed(self) -> Lattice:
        return Lattice(self.nodes.float(), self.cells, self.exact.float(), self.size)

    @cached_property
    def pixels(self) -> Sampling:
        """The positions of all pixels."""
        nodes, exact, cells = self.nodes, self.exact, self.cells
        if self.smooth:
            return Sampling(*_all_by_quintics(nodes, cells, self.size), None)
        single = nodes.dtype == torch.float32 and self.done is None
        if single and native_available() and is_eager(nodes, exact, cells):
            grid, seen = _Pixels.apply(nodes, exact, cells, self.size)  # type: ignore[no-untyped-call]
        else:
            grid, seen = _pixel_by_pixel(nodes, exact, cells, self.size, self.done)
        return Sampling(grid, seen, None)


class _Pixels(Function):
    """Positions of a lattice's pixels, and whether there are any, by native code; second derivatives by torch."""

    @staticmethod
    def forward(ctx: Any, nodes: Tensor, exact: Tensor, cells: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        grid, seen = sampler.lay(nodes, cells, exact, size)
        ctx.save_for_backward(nodes, exact, cells)
        ctx.size = size
        ctx.mark_non_differentiable(seen)
        return grid, seen

    @staticmethod
    def backward(ctx: Any, by_grid: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        nodes, exact, cells = ctx.saved_tensors
        if not torch.is_grad_enabled() and is_eager(by_grid):
            return *sampler.lay_vjp(by_grid, cells, exact.shape[1]), None, None
        leaves = nodes.detach().requires_grad_(), exact.detach().requires_grad_()
        with torch.enable_grad():  # positions are linear in both leaves
            grid, _ = _pixel_by_pixel(leaves[0], leaves[1], cells, ctx.size)
        by_nodes, by_exact = torch.autograd.grad(grid, leaves, by_grid, create_graph=True, materialize_grads=True)
        return by_nodes, by_exact, None, None


def _all_by_quintics(nodes: Tensor, cells: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return positions (B, h, w, 2) of a lattice's pixels by quintics alone, and that there are all of them."""
    planes = interpolated(nodes, *cells.shape[1:])[:, :, : size[0], : size[1]]
    return planes.movedim(1, -1), torch.ones_like(planes[:, 0], dtype=torch.bool)


def _pixel_by_pixel(
    nodes: Tensor, exact: Tensor, cells: Tensor, size: tuple[int, int], done: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return positions (B, h, w, 2) of a lattice's pixels, and whether there are any, bool (B, h, w); by torch."""
    (height, width), (_, n, m) = size, cells.shape
    quintic = cells == CELL_QUINTIC
    all_are = known_true(quintic)
    some_are = all_are or (may_look(quintic) and bool(quintic.any()))
    planes = interpolated(nodes if all_are else nodes[:, :, 1:-1, 1:-1], n, m)  # (B, 2, 8 n, 8 m)
    if some_are and not all_are:
        wide = quintic.repeat_interleave(STEP, 1).repeat_interleave(STEP, 2).unsqueeze(1)
        planes = torch.where(wide, interpolated(nodes, n, m), planes)
    blocks = planes.unflatten(2, (n, STEP)).unflatten(4, (m, STEP))
    some = cells != CELL_EMPTY
    if not known_true(some):
        blocks.masked_fill_(~some[:, None, :, None, :, None], OUTSIDE)
    seen = some[:, :, None, :, None].expand(-1, -1, STEP, -1, STEP).flatten(3, 4).flatten(1, 2)
    camera, i, j = (cells >= 0).nonzero(as_tuple=True) if done is None else done.unbind()
    if len(camera):
        exact = exact if done is not None else exact[:, cells[camera, i, j].long()]
        exact = exact.transpose(0, 1)  # (K, 2, 8, 8)
        known = ~exact[:, 0].isnan()
        blocks[camera, :, i, :, j] = torch.where(known[:, None], exact, OUTSIDE)
        seen.unflatten(1, (n, STEP)).unflatten(3, (m, STEP))[camera, i, :, j] = known
    return planes[:, :, :height, :width].movedim(1, -1), seen[:, :height, :width]


@on_one_thread
def locate(
    source: Camera,
    target: Camera,
    rotation: Tensor | None,
    tolerance: float,
    antialias: bool,
    rows: range,
    padding: str,
) -> Sampling | Lattice:
    """Return where rows of a target sample the source's image: a lattice if that serves, else all positions.

    Antialiased images need all, of a lattice or not.
    """

    def found(part: range) -> Sampling | Lattice:
        lattice = on_lattice(source, target, rotation, tolerance, part, padding) if tolerance else None
        return lattice or Sampling(*_tabulated(source, target, rotation, part), None)

    if not antialias:
        return found(rows)
    return scaled_rows(source, rows, target.size_for("Warp")[0], lambda part: found(part).pixels[:2])


def scaled_rows(
    source: Camera, rows: range, height: int, positions: Callable[[range], tuple[Tensor, Tensor]]
) -> Sampling:
    """Return the `positions` of rows of a target with the scale between neighbouring pixels."""
    around = range(max(rows.start - 1, 0), min(rows.stop + 1, height))
    grid, mapped = positions(around)
    where = Sampling(grid, mapped, local_scale(grid.detach(), mapped, source))
    return where if around == rows else where.part(slice(rows.start - around.start, rows.stop - around.start))


def _tabulated(source: Camera, target: Camera, rotation: Tensor | None, rows: range) -> tuple[Tensor, Tensor]:
    """Return the exact sampling positions of rows of a target, and which are mapped, see `Exact`."""
    if is_unknown(target.intrinsics):
        return _positions(source, target, rotation, None, pixels_of_rows(target, rows))
    exact = partial(_positions, source, target, rotation, _move_back(source, target, rotation, _like(target)))
    # by strips, which reuse the memory of intermediate results
    count = max(math.prod(c.batch_shape) for c in (source, target))
    count = count if rotation is None else max(count, math.prod(rotation.shape[:-2]))
    step = max(_STRIP // max(count * target.size_for("Warp")[1], 1), 1)
    part, seen = exact(pixels_of_rows(target, rows[:step]))
    if len(rows) <= step:
        return part, seen
    grid, mapped = (t.new_empty(len(t), len(rows), *t.shape[2:]) for t in (part, seen))
    grid[:, :step], mapped[:, :step] = part, seen
    for i in range(step, len(rows), step):
        here = slice(i, i + step)
        grid[:, here], mapped[:, here] = exact(pixels_of_rows(target, rows[here]))
    return grid, mapped


def native_move(start: Camera, end: Camera, rotation: Tensor | None, like: Tensor) -> NativeMove | None:
    """Return the native geometry from camera to camera for pixels of the dtype of `like`; None in a graph."""
    made = compiled_of((start, end), like, *(() if rotation is None else (rotation,)))
    if made is None:
        return None
    (one, other), is_batch = made
    if rotation is not None:
        is_batch, rotation = is_batch or rotation.ndim == 3, rotation.to(like.dtype)
    return NativeMove(one, other, rotation, end.size_for("Warp"), is_batch)


def _move_back(source: Camera, target: Camera, rotation: Tensor | None, like: Tensor) -> NativeMove | None:
    if goes_round(source) is not None or goes_round(target) is not None:
        return None
    return native_move(target, source, None if rotation is None else rotation.mT, like)


def _like(target: Camera) -> Tensor:
    """Return a tensor of the dtype and on the device to compute positions in."""
    like = target.intrinsics
    return like if like.dtype.itemsize >= 4 else like.float()


def pixels_of_rows(target: Camera, rows: range) -> Tensor:
    """Return the centres of a target's pixels, (len(rows), W', 2), in the dtype to compute positions in."""
    like = _like(target)
    v = torch.arange(rows.start, rows.stop, dtype=like.dtype, device=like.device)
    u = torch.arange(target.size_for("Warp")[1], dtype=like.dtype, device=like.device)
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)


def _positions(
    source: Camera, target: Camera, rotation: Tensor | None, native: NativeMove | None, pixels: Tensor
) -> tuple[Tensor, Tensor]:
    """Return where the source sees target pixels (h, w, 2) or (B, h, w, 2), and whether it does; see `Exact`."""
    if native is not None:
        rows = (pixels if pixels.ndim == 4 else pixels[None]).flatten(1, 2)
        found, mapped = native.rows(rows, POSITIONS)
        return found.unflatten(1, pixels.shape[-3:-1]), mapped.unflatten(1, pixels.shape[-3:-1])
    if pixels.ndim == 3 and target.batch_shape:
        pixels = pixels.expand(*target.batch_shape, *pixels.shape)
    rays, has_ray = target.unproject(within_turn(target, pixels))
    if rays.ndim == 3:
        rays, has_ray = rays.unsqueeze(0), has_ray.unsqueeze(0)
    rays = turn(None if rotation is None else rotation.mT, rays, "rays")
    seen, mapped = source.project(off_poles(source, rays))
    del rays
    mapped = mapped & has_ray
    return to_positions(seen, mapped, source.size_for("Warp")), mapped


def to_positions(seen: Tensor, mapped: Tensor, size: tuple[int, int]) -> Tensor:
    """Return pixels (..., 2) of an image as positions for `grid_sample`; without a graph, `seen` is overwritten."""
    if may_look(seen) and are_plain(seen):
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


def local_scale(grid: Tensor, mapped: Tensor, source: Camera) -> Tensor:
    """Return (B, H', W'): how many source pixels lie between neighbours of the target, in the direction with more."""
    height, width = source.size_for("Warp")
    scale = grid.new_zeros(grid.shape[:-1])
    for dim in (1, 2):
        n = grid.shape[dim] - 1
        u, v = grid.narrow(dim, 0, n).unbind(-1)
        right, down = grid.narrow(dim, 1, n).unbind(-1)
        step = lengths(source, ((right - u) * (width / 2), (down - v) * (height / 2)), (u, v))
        step = step * (mapped.narrow(dim, 1, n) & mapped.narrow(dim, 0, n))
        for start in (0, 1):
            part = scale.narrow(dim, start, n)
            part.copy_(torch.maximum(part, step))
    return scale


def on_lattice(
    source: Camera,
    target: Camera,
    rotation: Tensor | None,
    tolerance: float,
    rows: range,
    padding: str,
    learns: bool = False,
) -> Lattice | None:
    """Return positions within `tolerance` pixels of the exact ones, from a lattice of every eighth pixel.

    If fourth differences show that cubics may miss, positions in the middle of a cell and of its sides decide. There
    a cell's pixels come one by one, from quintics if these do not miss, else from the cameras, as at the limit of what
    is mapped. None if that is most of the image, and if torch records or transforms the cameras, or has them on another
    device. An edge between four nodes alone is not seen. Positions outside of the image that the padding does not need
    keep no tolerance; for "reflection" all do.

    If a camera or the rotation learns, its nodes and exact cells are computed again, with a graph. For this `learns`
    leaves cells that quintics do for `CELL_QUINTIC`, and more than a fifth exact ones are too many. None if derivatives
    may bend where positions do not: by coefficients that shape a part of the image each, and by the focal length of a
    target that begins again after a whole turn.
    """
    tensors = [*source.tensors, *target.tensors, *(() if rotation is None else (rotation,))]
    if not is_eager(target.intrinsics):
        return None
    if keeps_graph(*tensors):
        turns = seam_of(target) is not None and target.intrinsics.requires_grad
        if not is_eager(*tensors) or turns or any(map(_learns_by_parts, (source, target))):
            return None
        with torch.no_grad():  # a quarter: errors of positions are larger in derivatives than in images
            found = on_lattice(source, target, rotation, tolerance / 4, rows, padding, learns=True)
        return None if found is None else _with_graph(found, source, target, rotation, tolerance, rows)
    like, (height, width) = _like(target), (len(rows), target.size_for("Warp")[1])
    n, m = math.ceil(height / STEP), math.ceil(width / STEP)  # cells
    if min(n, m) < FEWEST:
        return None
    native = _move_back(source, target, rotation, like)
    # the library finds cubics for each cell; torch alone first looks one node further, whether quintics do everywhere
    more = 5 if native is not None or learns or native_available() else 7
    nodes, size = (n + more) * (m + more), source.size_for("Warp")
    pixels = (kept_probes if nodes <= MOST_KEPT else kept_probes.__wrapped__)(rows, width, like.dtype, more)
    if native is not None:
        made = native.lattices(pixels, (height, width), rows.start, tolerance, padding, learns)
        return None if made is None else Lattice(*made, (height, width))
    exact = partial(_positions, source, target, rotation, None)
    positions, mapped = exact(pixels)  # (B, 1, N, 2)
    lattice = positions[:, 0, :nodes].movedim(-1, 1).contiguous().unflatten(2, (n + more, m + more))
    if more > 5:
        is_smooth = bool(mapped.all()) and are_smooth(lattice, size, tolerance)
        lattice = lattice[:, :, 1:-1, 1:-1].contiguous()
        if is_smooth:
            cells = torch.full((len(lattice), n, m), CELL_QUINTIC, dtype=torch.int32, device=like.device)
            return Lattice(lattice, cells, like.new_empty(2, 0, STEP, STEP), (height, width), smooth=True)
    mapped, rim = mapped[:, 0, :nodes].unflatten(1, (n + more, m + more)), mapped[:, 0, nodes:]
    mapped = mapped[:, 1:-1, 1:-1].contiguous() if more > 5 else mapped
    find = sampler.classify if native_available() else classify
    narrow, limits = lattice.float(), (size, tolerance, padding)
    cells = find(narrow, mapped, rim, (height, width), *limits)
    settle(exact, rows.start, cells, narrow, mapped, *limits)
    if not len(cells) or int((cells == CELL_TODO).sum((1, 2)).max()) > n * m * (1 / 5 if learns else 7 / 8):
        return None
    computed = _compute(exact, rows.start, cells, cells == CELL_TODO, like)
    if not learns:
        computed = torch.cat((computed, lay_quintics(lattice, cells, computed.shape[1])), 1)
    return Lattice(lattice, cells, computed, (height, width))


def _learns_by_parts(camera: Camera) -> bool:
    """Whether coefficients learn that may shape parts of the image, narrower than cells."""
    members = cast("Iterable[Camera]", camera.cameras) if isinstance(camera, Mixed) else (camera,)
    models: list[Any] = [(type(member), member.distortion) for member in members]
    return any(k.requires_grad and _has_parts(model, k.shape[-1]) for model, k in models)


@lru_cache(maxsize=64)
def _has_parts(model: type[Camera], count: int) -> bool:
    """Whether that many coefficients are those of a table or of a surface, or of a formula that is not ours."""
    _, lens = model.optics(columns(torch.tensor([model.ideal(count)], dtype=torch.float64, device="cpu")))
    parts = [*lens.stages, *(stage.radial for stage in lens.stages if stage.radial)]
    return any(vars(type(part)).get("code") in (None, RADIUS_TABLE, SURFACE) for part in parts)


def _with_graph(
    found: Lattice, source: Camera, target: Camera, rotation: Tensor | None, tolerance: float, rows: range
) -> Lattice:
    """Return a lattice that was found without a graph with one, by quintics wherever they agree with cubics."""
    exact, (height, width), cells = partial(_positions, source, target, rotation, None), found.size, found.cells
    like, (_, n, m) = _like(target), cells.shape
    count = (n + 5) * (m + 5)
    pixels = (kept_probes if count <= MOST_KEPT else kept_probes.__wrapped__)(rows, width, like.dtype)
    nodes = exact(pixels[:, :count])[0][:, 0].movedim(-1, 1).unflatten(2, (n + 5, m + 5))
    if not nodes.requires_grad:
        cells.masked_fill_(cells == CELL_QUINTIC, CELL_TODO)
    computed, todo = like.new_empty(2, 0, STEP, STEP), cells >= 0
    if bool(todo.any()):
        computed = _compute(exact, rows.start, cells, todo, like)
    if nodes.requires_grad:
        prefer_quintics(nodes.detach(), cells, source.size_for("Warp"), tolerance)
    return Lattice(nodes, cells, computed, (height, width))


def coarse(size: tuple[int, ...]) -> tuple[int, int]:
    """Return the first pixel and the step, in both directions, at which a target (h, w) shows how far images shrink."""
    return (16, 32) if min(size) >= 64 else (0, STEP) if min(size) > STEP else (0, 1)


def straight_lattice(matrix: Tensor, rows: range, width: int, dtype: torch.dtype) -> Lattice:
    """Return the lattice of positions that are an affine function (B, 2, 3) of the target's pixels."""
    count, n, m = len(matrix), math.ceil(len(rows) / STEP), math.ceil(width / STEP)
    v, u = ((torch.arange(k + 5, dtype=matrix.dtype, device=matrix.device) - 2) * STEP for k in (n, m))
    across, down, shift = (column[..., None, None] for column in matrix.unbind(-1))
    nodes = (across * u + (down * (v + rows.start)[:, None] + shift)).to(dtype)
    cells = torch.full((count, n, m), CELL_CUBIC, dtype=torch.int32, device=matrix.device)
    return Lattice(nodes, cells, nodes.new_empty(2, 0, STEP, STEP), (len(rows), width))


@lru_cache(maxsize=8)
def kept_probes(rows: range, width: int, dtype: torch.dtype, more: int = 5) -> Tensor:
    """Return the nodes of a lattice, and then the pixels at the rim of the target, (1, N, 2) on the CPU.

    more: how many more nodes than cells there are along an axis.
    """
    with torch.inference_mode(False):
        down, across = (torch.arange(length, dtype=dtype, device="cpu") for length in (len(rows), width))
        # two more nodes on each side of the cells: one for the cubics, and both for fourth differences
        v, u = (
            (torch.arange(math.ceil(side / STEP) + more, dtype=dtype, device="cpu") - more // 2) * STEP
            for side in (len(rows), width)
        )
        nodes = torch.stack(torch.meshgrid(u, v + rows.start, indexing="xy"))
        # (2 (w + h), 2): the pixels of the first and the last row, and of the first and the last column
        down += rows.start
        sides = [(across, torch.full_like(across, end)) for end in (rows[0], rows[-1])]
        sides += [(torch.full_like(down, end), down) for end in (0, width - 1)]
        return torch.cat((nodes.flatten(1), torch.cat([torch.stack(pair, -1) for pair in sides]).mT), 1).mT[None]


def _compute(exact: Exact, first: int, cells: Tensor, todo: Tensor, like: Tensor) -> Tensor:
    """Return exact positions (2, K, 8, 8) of the cells to do (B, n, m), and write their places into `cells`.

    Where what is mapped ends in one, its neighbours follow.
    """
    parts, count = [like.new_empty(2, 0, STEP, STEP)], 0
    done = torch.zeros_like(todo)
    offset = torch.arange(STEP, dtype=like.dtype, device=like.device)
    while bool(todo.any()):
        chosen, wanted = places(todo)
        i, j = chosen // todo.shape[2], chosen % todo.shape[2]
        down, across = (i[..., None, None] * STEP + offset[:, None]), (j[..., None, None] * STEP + offset)
        pixels = torch.stack(torch.broadcast_tensors(across, down + first), -1)  # (B, most, 8, 8, 2)
        positions, known = exact(pixels.flatten(2, 3))
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
    cells = _BLOCK // STEP
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


def _weights(taps: int, dtype: torch.dtype, wide: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return weights (8, taps) of nodes at the pixels of a cell, and the matrix that has these for a block of cells."""
    t, at = torch.arange(STEP, dtype=torch.float64, device=device) / STEP, range(1 - taps // 2, taps // 2 + 1)
    parts = [math.prod(((t - m) / (k - m) for m in at if m != k), start=torch.ones_like(t)) for k in at]
    weights, cells = torch.stack(parts, -1).to(dtype), _BLOCK // STEP
    spread = weights.new_zeros(cells + taps - 1, cells, STEP, dtype=wide)
    for cell in range(cells):
        spread[cell : cell + taps, cell] = weights.T
    return weights, spread
