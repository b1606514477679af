"""Where a warp samples: exact positions on the source's image, or a lattice of them where that serves.

A lattice may be of a part of the target: `first` is the row at which that begins, and `size` its height and width.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.cameras.mixed import Mixed
from camtorch.evaluate.door import is_cheap_to_read, is_eager, keeps_graph
from camtorch.evaluate.tensors import are_plain, is_unknown
from camtorch.native import sampler
from camtorch.native.library import native_available
from camtorch.native.structs import CELL_QUINTIC, CELL_TODO, FAR, OUTSIDE, POSITIONS, RADIUS_TABLE, STEP, SURFACE
from camtorch.poses.rotations import turn
from camtorch.projection.evaluation import native_forms
from camtorch.projection.native_calls import NativeMove
from camtorch.values.arguments import columns
from camtorch.values.threads import on_one_thread
from camtorch.warp.cells import are_smooth, classify, lay_quintics, places, prefer_quintics, put, settle
from camtorch.warp.lattice import Lattice, PixelPositions, Positions
from camtorch.warp.panorama import goes_round, lengths, off_poles, seam_of, within_turn

_STRIP_PIXELS = 1 << 19
FEWEST_CELLS = 8  # along a side: with fewer, exact positions take less time than a lattice
MOST_KEPT_NODES = 1 << 16  # of a lattice whose pixels are kept for the next one


class Between(NamedTuple):
    """Two cameras and the rotation between them, which tell where the source sees pixels of the target."""

    source: Camera
    target: Camera
    rotation: Tensor | None

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors that positions depend on."""
        return [*self.source.tensors, *self.target.tensors, *(() if self.rotation is None else (self.rotation,))]

    def native(self) -> NativeMove | None:
        """Return the native geometry from target to source; None in a graph, and for images of a whole turn."""
        source, target, rotation = self
        if goes_round(source) is not None or goes_round(target) is not None:
            return None
        return native_move(target, source, None if rotation is None else rotation.mT, _like(target))

    def exact(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return where the source sees target pixels (h, w, 2) or (B, h, w, 2), by torch; see `cells.Exact`."""
        source, target, rotation = self
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


@on_one_thread
def locate(
    source: Camera,
    target: Camera,
    rotation: Tensor | None,
    tolerance: float,
    antialias: bool,
    rows: range,
    padding: str,
) -> Positions:
    """Return where rows of a target sample the source's image: a lattice if that serves, else all positions.

    Antialiased images need all, of a lattice or not.
    """
    cameras = Between(source, target, rotation)

    def found(part: range) -> Positions:
        lattice = on_lattice(cameras, part, tolerance, padding) if tolerance else None
        return lattice or PixelPositions(*_row_by_row(cameras, part), None)

    if not antialias:
        return found(rows)
    return scaled_rows(source, rows, target.size_for("Warp")[0], lambda part: found(part).pixels[:2])


def scaled_rows(
    source: Camera, rows: range, height: int, positions: Callable[[range], tuple[Tensor, Tensor]]
) -> PixelPositions:
    """Return the `positions` of rows of a target with the scale between neighbouring pixels."""
    around = range(max(rows.start - 1, 0), min(rows.stop + 1, height))
    grid, mapped = positions(around)
    where = PixelPositions(grid, mapped, local_scale(grid.detach(), mapped, source))
    return where if around == rows else where.part(slice(rows.start - around.start, rows.stop - around.start))


def _row_by_row(cameras: Between, rows: range) -> tuple[Tensor, Tensor]:
    """Return the exact sampling positions of rows of a target, and which are mapped, see `Exact`."""
    target = cameras.target
    if is_unknown(target.intrinsics):
        return cameras.exact(pixels_of_rows(target, rows))
    native = cameras.native()

    def exact(part: range) -> tuple[Tensor, Tensor]:
        pixels = pixels_of_rows(target, part)
        if native is None:
            return cameras.exact(pixels)
        found, mapped = native.rows(pixels.flatten(0, 1)[None], POSITIONS)
        return found.unflatten(1, pixels.shape[:2]), mapped.unflatten(1, pixels.shape[:2])

    # by strips, which reuse the memory of intermediate results: of fewer rows if there are many cameras
    count = max(math.prod(camera.batch_shape) for camera in (cameras.source, target))
    count = count if cameras.rotation is None else max(count, math.prod(cameras.rotation.shape[:-2]))
    step = max(_STRIP_PIXELS // max(count * target.size_for("Warp")[1], 1), 1)
    first, seen = exact(rows[:step])
    if len(rows) <= step:
        return first, seen
    grid, mapped = (t.new_empty(len(t), len(rows), *t.shape[2:]) for t in (first, seen))
    grid[:, :step], mapped[:, :step] = first, seen
    for i in range(step, len(rows), step):
        grid[:, i : i + step], mapped[:, i : i + step] = exact(rows[i : i + step])
    return grid, mapped


def native_move(start: Camera, end: Camera, rotation: Tensor | None, like: Tensor) -> NativeMove | None:
    """Return the native geometry from camera to camera for pixels of the dtype of `like`; None in a graph."""
    made = native_forms((start, end), like, *(() if rotation is None else (rotation,)))
    if made is None:
        return None
    (one, other), is_batch = made
    if rotation is not None:
        is_batch, rotation = is_batch or rotation.ndim == 3, rotation.to(like.dtype)
    return NativeMove(one, other, rotation, end.size_for("Warp"), is_batch)


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
        for start in (0, 1):  # a step counts at both of its ends
            part = scale.narrow(dim, start, n)
            part.copy_(torch.maximum(part, step))
    return scale


def on_lattice(cameras: Between, rows: range, tolerance: float, padding: str) -> Lattice | None:
    """Return a lattice with positions of a target's rows within `tolerance` pixels of the exact ones.

    1. Cubics between its nodes, every eighth pixel, serve at first.
    2. Where fourth differences of nodes show that cubics may miss, exact positions in the middle of a cell and of its
       sides decide. An edge between four nodes alone is not seen.
    3. In cells that cubics miss, pixels come one by one: from quintics if these do not miss, else from the cameras, as
       they do at the limit of what is mapped.

    Positions outside of the image that the padding does not need keep no tolerance; for "reflection" all do. None if
    most of the image would come from the cameras, if it is small, and if torch records or transforms the cameras, or
    has them on another device; for cameras that learn see `_learning`.
    """
    target = cameras.target
    size = len(rows), target.size_for("Warp")[1]
    if not is_eager(target.intrinsics) or math.ceil(min(size) / STEP) < FEWEST_CELLS:
        return None
    find = _learning if keeps_graph(*cameras.tensors) else _found
    return find(cameras, rows.start, size, tolerance, padding)


def _learning(cameras: Between, first: int, size: tuple[int, int], tolerance: float, padding: str) -> Lattice | None:
    """Return a lattice that is found without a graph, and of which nodes and exact cells are computed again with one.

    Cells that quintics do are `CELL_QUINTIC`, and more than a fifth exact ones are too many. None if derivatives may
    bend where positions do not: by coefficients that shape a part of the image each, and by the focal length of a
    target that begins again after a whole turn.
    """
    source, target, _ = cameras
    turns = seam_of(target) is not None and target.intrinsics.requires_grad
    if not is_eager(*cameras.tensors) or turns or any(map(_learns_by_parts, (source, target))):
        return None
    with torch.no_grad():  # a quarter: errors of positions are larger in derivatives than in images
        found = _found(cameras, first, size, tolerance / 4, padding, learns=True)
    if found is None:
        return None
    cells, shape = found.cells, found.nodes.shape[2:]
    pixels = probes(first, size, _like(target).dtype)[:, : shape.numel()]
    nodes = cameras.exact(pixels)[0][:, 0].movedim(-1, 1).unflatten(2, shape)
    if not nodes.requires_grad:
        cells.masked_fill_(cells == CELL_QUINTIC, CELL_TODO)
    exact = _of_cells(cameras, first, cells, cells >= 0)
    if nodes.requires_grad:
        prefer_quintics(nodes.detach(), cells, source.size_for("Warp"), tolerance)
    return Lattice(nodes, cells, exact, size)


def _learns_by_parts(camera: Camera) -> bool:
    """Whether coefficients learn that may shape parts of the image, narrower than cells."""
    camera = getattr(camera, "camera", camera)  # behind a rolling shutter
    members = cast("Iterable[Camera]", camera.cameras) if isinstance(camera, Mixed) else (camera,)
    models: list[Any] = [(type(member), member.distortion) for member in members]
    return any(k.requires_grad and _has_parts(model, k.shape[-1]) for model, k in models)


@lru_cache(maxsize=64)
def _has_parts(model: type[Camera], count: int) -> bool:
    """Whether that many coefficients are those of a table or of a surface, or of a formula that is not ours."""
    _, lens = model.optics(columns(torch.tensor([model.ideal(count)], dtype=torch.float64, device="cpu")))
    parts = [*lens.stages, *(stage.radial for stage in lens.stages if stage.radial)]
    return any(vars(type(part)).get("code") in (None, RADIUS_TABLE, SURFACE) for part in parts)


def _found(
    cameras: Between, first: int, size: tuple[int, int], tolerance: float, padding: str, learns: bool = False
) -> Lattice | None:
    """Return the lattice of `on_lattice` without a graph; if it `learns`, the one that `_learning` begins with."""
    native = cameras.native()
    if native is None:
        return _found_by_torch(cameras, first, size, tolerance, padding, learns)
    made = native.lattices(probes(first, size, native.dtype), size, first, tolerance, padding, learns)
    return None if made is None else Lattice(*made, size)


def _found_by_torch(
    cameras: Between, first: int, size: tuple[int, int], tolerance: float, padding: str, learns: bool
) -> Lattice | None:
    """Return the same of exact positions by torch, as of several models in a batch, or without the library."""
    n, m = (math.ceil(side / STEP) for side in size)
    source_size = cameras.source.size_for("Warp")
    # the library finds cubics for each cell; torch alone first looks one node further, whether quintics do everywhere
    looks_further = not (learns or native_available())
    shape = (n + 7, m + 7) if looks_further else (n + 5, m + 5)
    pixels = probes(first, size, _like(cameras.target).dtype, shape[0] - n)
    positions, mapped = (t[:, 0] for t in cameras.exact(pixels))
    count = math.prod(shape)  # after so many nodes the rim follows
    nodes = positions[:, :count].movedim(-1, 1).contiguous().unflatten(2, shape)
    if looks_further:
        is_smooth = bool(mapped.all()) and are_smooth(nodes, source_size, tolerance)
        nodes = nodes[:, :, 1:-1, 1:-1].contiguous()
        if is_smooth:
            cells = torch.full((len(nodes), n, m), CELL_QUINTIC, dtype=torch.int32, device=nodes.device)
            return Lattice(nodes, cells, nodes.new_empty(2, 0, STEP, STEP), size)
    # cells of cubics: where the nodes show that these serve, or, in doubt, exact positions do
    narrow, rim = nodes.float(), mapped[:, count:]
    mapped = mapped[:, :count].unflatten(1, shape)
    mapped = mapped[:, 1:-1, 1:-1].contiguous() if looks_further else mapped
    find = sampler.classify if native_available() else classify
    cells = find(narrow, mapped, rim, size, source_size, tolerance, padding)
    settle(cameras.exact, first, cells, narrow, mapped, source_size, tolerance, padding)
    todo = cells == CELL_TODO
    if not len(cells) or int(todo.sum((1, 2)).max()) > n * m * (1 / 5 if learns else 7 / 8):
        return None
    exact = _of_cells(cameras, first, cells, todo)
    if not learns:
        exact = torch.cat((exact, lay_quintics(nodes, cells, exact.shape[1])), 1)
    return Lattice(nodes, cells, exact, size)


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


def _of_cells(cameras: Between, first: int, cells: Tensor, todo: Tensor) -> Tensor:
    """Return exact positions (2, K, 8, 8) of the cells to do (B, n, m), and write their places into `cells`.

    Where what is mapped ends in one, its neighbours follow.
    """
    like = _like(cameras.target)
    parts = [like.new_empty(2, 0, STEP, STEP)]
    count = 0  # of the cells laid so far, whose numbers are their places
    done = torch.zeros_like(todo)
    offset = torch.arange(STEP, dtype=like.dtype, device=like.device)
    while bool(todo.any()):
        chosen, wanted = places(todo)
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
