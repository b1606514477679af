"""Meshes: positions at the nodes of a lattice over the target, and what a runtime makes of them between the nodes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from camtorch.io._errors import CameraFileError
from camtorch.maps.exact import Bools, Exact, Floats

STEP, STEPS = 16, range(1, 257)
"""Pixels of the target between nodes: usually, and those that formats without other limits take."""
_SLACK = 0.5  # pixels: as far as a pixel that shows the image may lie beyond the outermost pixel centres
_OUTWARDS = 1 / 32  # of the second differences by which nodes round outwards
_MOST_STEPS = 200
_GAIN = 1e-9  # pixels
_NEIGHBOURS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
_REACH = 1  # sizes of the source by which nodes that no shown pixel needs may lie off it


@dataclass(frozen=True)
class Mesh:
    """Positions at the nodes of a lattice over the target.

    Args:
        columns: (m,) of the nodes in pixels of the target, ascending.
        rows: (n,) likewise.
        nodes: (n, m, 2), x and y in pixels of the source.
        needed: (n, m) bool, nodes of cells with a pixel that the warp shows; None of a mesh that was read.
        drawn: (n - 1, m - 1, 2) bool: each cell is two triangles, above and below its diagonal from the node with the
            lowest coordinates, and which of them are there. None where cells are bilinear, and all there.
    """

    columns: Floats
    rows: Floats
    nodes: Floats
    needed: Bools | None = None
    drawn: Bools | None = None

    def positions(self, size: tuple[int, int]) -> Floats:
        """(H', W', 2): of each pixel of a target of that size, NaN where no triangle is."""
        height, width = size
        i, s = _cells(self.rows, height)
        j, t = _cells(self.columns, width)
        s, t = s[:, None, None], t[:, None]
        if self.drawn is None:
            lines = self.nodes[i] * (1 - s) + self.nodes[i + 1] * s
            between: Floats = lines[:, j] * (1 - t) + lines[:, j + 1] * t
            return between
        upper, lower = self.nodes[i], self.nodes[i + 1]
        start, end = upper[:, j], lower[:, j + 1]
        above = t >= s
        corner = np.where(above, upper[:, j + 1], lower[:, j])
        along, rest = np.where(above, t, s), np.where(above, s, t)
        result: Floats = start + along * (corner - start) + rest * (end - corner)
        there = np.where(above[..., 0], self.drawn[i][:, j, 0], self.drawn[i][:, j, 1])
        result[~there] = np.nan
        return result


def _cells(nodes: Floats, count: int) -> tuple[np.ndarray, Floats]:
    """For each of `count` pixels the cell that it lies in, and where in it, from 0 to 1."""
    pixels = np.arange(count, dtype=np.float64)
    cell = np.clip(np.searchsorted(nodes, pixels, "right") - 1, 0, len(nodes) - 2)
    return cell, (pixels - nodes[cell]) / (nodes[cell + 1] - nodes[cell])


def as_step(step: int | None, owner: str, steps: Sequence[int] = STEPS, usual: int = STEP) -> int:
    """Pixels of the target between nodes; `usual` if nobody says.

    Raises:
        ValueError: none of `steps`.
    """
    if step is None:
        return usual
    if step not in steps:
        which = f"{steps[0]} to {steps[-1]}" if isinstance(steps, range) else f"one of {', '.join(map(str, steps))}"
        raise ValueError(f"{owner}: step must be {which} pixels; got {step}")
    return step


def nodes_every(step: int, size: int) -> Floats:
    """Pixels 0, step, ... to the first that is not below the size."""
    return np.arange(-(-size // step) + 1, dtype=np.float64) * step


def mesh_of(path: str, exact: Exact, columns: Floats, rows: Floats, *, triangles: bool = False) -> Mesh:
    """The mesh of a warp: exact at its nodes, and smoothly continued to those that have no position.

    Args:
        path: of the map, for errors.
        exact: of the warp.
        columns: (m,) of the nodes in pixels of the target.
        rows: (n,) likewise.
        triangles: whether cells are two triangles, of which those that show nothing are left out.

    Raises:
        CameraFileError: positions leap across the source from one pixel to the next.
    """
    shown = exact.shown
    if leaps := _leaps(exact):
        raise CameraFileError(
            path,
            "mesh",
            f"positions leap across the source beside {leaps} pixels, as at the seam of a panorama, and no mesh does. "
            "A target that does not show the seam has one; opencv, stmap and onnx hold positions pixel by pixel",
        )
    (i, s), (j, t) = _cells(rows, shown.shape[0]), _cells(columns, shown.shape[1])
    down, across = np.nonzero(shown)
    below = (t[across] < s[down]).astype(np.intp)
    drawn = np.zeros((len(rows) - 1, len(columns) - 1, 2), np.bool_)
    drawn[i[down], j[across], below] = True
    cells = drawn.any(-1)
    needed = np.zeros((len(rows), len(columns)), np.bool_)
    for a in (slice(None, -1), slice(1, None)):
        for b in (slice(None, -1), slice(1, None)):
            needed[a, b] |= cells
    nodes, mapped = exact.at(columns, rows)
    sides = np.array(exact.source_size[::-1], np.float64)
    low, high = -_REACH * sides, (1 + _REACH) * sides
    # what is far off says nothing of where to go on
    nodes = _continued(np.where(needed[..., None], nodes, nodes.clip(low, high)), mapped, low, high)
    return Mesh(columns, rows, nodes, needed, drawn if triangles else None)


def _leaps(exact: Exact) -> int:
    """How many shown pixels are half the source away from a shown neighbour."""
    half = np.array(exact.source_size[::-1], np.float64) / 2
    p, shown = exact.positions, exact.shown
    count = 0
    for one, two in (
        ((slice(1, None),), (slice(None, -1),)),
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
    ):
        far = (np.abs(p[one] - p[two]) > half).any(-1)
        count += int((far & shown[one] & shown[two]).sum())
    return count


def _continued(nodes: Floats, known: Bools, low: Floats, high: Floats) -> Floats:
    """Nodes (n, m, 2) with those that are not known laid out from their neighbours, ring by ring.

    The first ring is where parabolas through three nodes go on, as it has a part in what is shown. Those behind it go
    on along lines, each by half the step before, so that hardware is not sent across the image.
    """
    nodes, known = nodes.copy(), known.copy()
    n, m = known.shape
    first = True
    while not known.all():
        padded, there = np.pad(nodes, ((3, 3), (3, 3), (0, 0))), np.pad(known, 3)
        total, weight = np.zeros_like(nodes), np.zeros((n, m))
        for down, across in _NEIGHBOURS:
            near, middle, far = (
                (slice(3 + k * down, 3 + k * down + n), slice(3 + k * across, 3 + k * across + m)) for k in (1, 2, 3)
            )
            two = there[near] & there[middle]
            three = two & there[far] & first
            a, b, c = padded[near], padded[middle], padded[far]
            line = 2 * a - b if first else a + (a - b) / 2
            guess = np.where(three[..., None], 3 * a - 3 * b + c, np.where(two[..., None], line, a))
            trust = np.where(three, 1.0, np.where(two, 1e-3, np.where(there[near], 1e-6, 0.0)))
            total += trust[..., None] * guess
            weight += trust
        new = ~known & (weight > 0)
        nodes[new] = (total[new] / weight[new][:, None]).clip(low, high)
        if not new.any():  # not one is known
            break
        known, first = known | new, False
    return nodes


def held(path: str, format: str, mesh: Mesh, low: Floats, high: Floats, *, clip: bool) -> Mesh:
    """The mesh with its nodes drawn in to what a format holds.

    Args:
        path: of the map, for the error.
        format: likewise.
        mesh: of the warp.
        low: least x and y that the format holds at each node, (..., 2).
        high: the largest.
        clip: whether nodes of shown pixels may be drawn in; others always are, and those by half a pixel.

    Raises:
        CameraFileError: nodes of shown pixels that it does not hold.
    """
    beyond = ((mesh.nodes < low - _SLACK) | (mesh.nodes > high + _SLACK)).any(-1)
    if mesh.needed is not None and not clip and (lost := beyond & mesh.needed).any():
        worst = mesh.nodes[lost]
        (left, top), (right, bottom) = worst.min(0), worst.max(0)
        raise CameraFileError(
            path,
            f"{int(lost.sum())} of {int(mesh.needed.sum())} vertices",
            f"lie at x {left:.1f} to {right:.1f}, y {top:.1f} to {bottom:.1f} px of the source, which {format} does "
            "not hold. A target that shows less beyond the edges of the source's image does without them; clip=True "
            "(--clip) draws them in, and the report says what that costs",
        )
    return replace(mesh, nodes=mesh.nodes.clip(low, high))


def rounded(mesh: Mesh, exact: Exact, parts: int, low: Floats, high: Floats) -> np.ndarray:
    """The nodes in whole parts of a pixel, (n, m, 2) int64, so that the largest error at shown pixels is small.

    Each is one of the two next to the exact value, along each axis. Between nodes a bend is cut off, by an eighth of
    its second difference, so nodes round towards its outside; then those about the largest error round as is best
    there, until that helps no more.

    Args:
        mesh: of the warp, of bilinear cells.
        exact: what it is measured against.
        parts: of a pixel.
        low: least x and y that may be had at each node, in pixels, whole parts.
        high: the largest.
    """
    least, most = (np.broadcast_to(limit * parts, mesh.nodes.shape) for limit in (low, high))
    values = mesh.nodes * parts
    outside = (_OUTWARDS * _bend(mesh.nodes) * parts).clip(-0.5, 0.5)
    nodes = np.rint(values - outside).clip(least, most)
    either = np.floor(values).clip(least, most), np.ceil(values).clip(least, most)
    limit = np.array(exact.source_size[::-1], np.float64) - 1
    wanted, shown = exact.positions.clip(0, limit), exact.shown

    def errors(mesh: Mesh, pixels: tuple[slice, slice]) -> Floats:
        size = shown[pixels].shape
        off = mesh.positions((size[0], size[1])).clip(0, limit) - wanted[pixels]
        distance: Floats = np.hypot(off[..., 0], off[..., 1]) * shown[pixels]
        return distance

    error = errors(replace(mesh, nodes=nodes / parts), (slice(None), slice(None)))
    for _ in range(_MOST_STEPS):
        worst = divmod(int(error.argmax()), error.shape[1])
        i, j = (int(_cells(line, at + 1)[0][-1]) for line, at in zip((mesh.rows, mesh.columns), worst, strict=True))
        least_error, step = float(error[worst]) - _GAIN, None
        for node in ((i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1)):
            down, across = (slice(max(k - 1, 0), k + 2) for k in node)
            rows, columns = mesh.rows[down], mesh.columns[across]
            pixels = slice(int(rows[0]), int(rows[-1])), slice(int(columns[0]), int(columns[-1]))
            around = Mesh(columns - columns[0], rows - rows[0], nodes[down, across] / parts)
            for x, y in itertools.product((0, 1), (0, 1)):
                value = np.array([either[x][node][0], either[y][node][1]])
                around.nodes[node[0] - down.start, node[1] - across.start] = value / parts
                off = errors(around, pixels)
                if off.max() < least_error:
                    least_error, step = float(off.max()), (node, value, pixels, off)
        if step is None:
            break
        node, value, pixels, off = step
        nodes[node], error[pixels] = value, off
    whole: np.ndarray = nodes.astype(np.int64)
    return whole


def _bend(nodes: Floats) -> Floats:
    """The second differences along both axes, of (n, m, 2); at the ends those next to them."""
    total = np.zeros_like(nodes)
    for axis in (0, 1):
        if nodes.shape[axis] > 2:
            bend = np.diff(nodes, 2, axis)
            total += np.concatenate((bend.take([0], axis), bend, bend.take([-1], axis)), axis)
    return total
