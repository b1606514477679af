"""Where a warp between two cameras at one place samples the image of the source.

It samples at exact positions on the source's image, or by a lattice of them where that serves. A lattice may be of a
part of the target: `first` is the row at which that begins, and `size` its height and width.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, cast

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.cameras.mixed import Mixed
from camtorch.evaluate.door import is_eager, keeps_graph
from camtorch.evaluate.tensors import is_unknown
from camtorch.native.structs import CELL_QUINTIC, CELL_TODO, POSITIONS, RADIUS_TABLE, STEP, SURFACE
from camtorch.values.arguments import columns
from camtorch.values.threads import on_one_thread
from camtorch.warp.camera_pair import CameraPair
from camtorch.warp.cells import found_by_torch, lay_exact, prefer_quintics
from camtorch.warp.lattice import FEWEST_CELLS, Lattice, PixelPositions, Positions, probes
from camtorch.warp.panorama import lengths, seam_of

_STRIP_PIXELS = 1 << 19


@on_one_thread
def locate(cameras: CameraPair, rows: range, tolerance: float, padding: str, antialias: bool) -> Positions:
    """Return where rows of a target sample the source's image: a lattice if that serves, else all positions.

    Antialiased images need all, of a lattice or not.
    """
    if antialias:
        height = cameras.target.size_for("Warp")[0]
        return scaled_rows(
            cameras.source, rows, height, lambda part: _located(cameras, part, tolerance, padding).pixels[:2]
        )
    return _located(cameras, rows, tolerance, padding)


def _located(cameras: CameraPair, rows: range, tolerance: float, padding: str) -> Positions:
    if tolerance:
        lattice = on_lattice(cameras, rows, tolerance, padding)
        if lattice is not None:
            return lattice
    return PixelPositions(*_row_by_row(cameras, rows), None)


def scaled_rows(
    source: Camera, rows: range, height: int, positions: Callable[[range], tuple[Tensor, Tensor]]
) -> PixelPositions:
    """Return the `positions` of rows of a target with the scale between neighbouring pixels."""
    around = range(max(rows.start - 1, 0), min(rows.stop + 1, height))
    grid, mapped = positions(around)
    where = PixelPositions(grid, mapped, local_scale(grid.detach(), mapped, source))
    return where if around == rows else where.part(slice(rows.start - around.start, rows.stop - around.start))


def _row_by_row(cameras: CameraPair, rows: range) -> tuple[Tensor, Tensor]:
    """Return the exact sampling positions of rows of a target, and which are mapped; see `CameraPair.exact`."""
    target = cameras.target
    if is_unknown(target.intrinsics):
        return cameras.exact(cameras.pixels_of(rows))
    native = cameras.native_positions()

    def exact(part: range) -> tuple[Tensor, Tensor]:
        pixels = cameras.pixels_of(part)
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


def on_lattice(cameras: CameraPair, rows: range, tolerance: float, padding: str) -> Lattice | None:
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


def _learning(cameras: CameraPair, first: int, size: tuple[int, int], tolerance: float, padding: str) -> Lattice | None:
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
    pixels = probes(first, size, cameras.like.dtype)[:, : shape.numel()]
    nodes = cameras.exact(pixels)[0][:, 0].movedim(-1, 1).unflatten(2, shape)
    if not nodes.requires_grad:
        cells.masked_fill_(cells == CELL_QUINTIC, CELL_TODO)
    exact = lay_exact(cameras, first, cells, cells >= 0)
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
    cameras: CameraPair, first: int, size: tuple[int, int], tolerance: float, padding: str, learns: bool = False
) -> Lattice | None:
    """Return the lattice of `on_lattice` without a graph; if it `learns`, the one that `_learning` begins with."""
    native = cameras.native_positions()
    if native is None:
        return found_by_torch(cameras, first, size, tolerance, padding, learns)
    made = native.lattices(probes(first, size, native.dtype), size, first, tolerance, padding, learns)
    return None if made is None else Lattice(*made, size)
