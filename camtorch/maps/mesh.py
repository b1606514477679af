"""Meshes: positions at the corners of blocks of the target, and tables of them for camera chips."""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from camtorch.io.record import CameraFileError
from camtorch.maps.lookup import Bools, Exact, Floats, LookupMap
from camtorch.maps.protocol import SIZES, MapFormat, checked
from camtorch.values.arguments import as_whole

_SLACK = 0.5  # pixels that a pixel of the image may lie beyond the outermost pixel centres
_OUTWARDS = 1 / 32  # of the second differences by which nodes round outwards
_MOST_STEPS = 200
_GAIN = 1e-9  # pixels
_NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
_REACH = 1  # source sizes that nodes without a shown pixel may lie outside of it


@dataclass(frozen=True)
class Mesh:
    """Positions at every `step` pixels of the target, from the first to beyond the last, bilinear between them."""

    step: int
    nodes: Floats  # (n, m, 2), x and y in pixels of the source

    @property
    def places(self) -> Floats:
        """Nodes (n, m, 2), x and y in pixels of the target."""
        n, m = self.nodes.shape[:2]
        return self.step * np.stack(np.meshgrid(np.arange(m), np.arange(n)), -1).astype(np.float64)

    def positions(self, size: tuple[int, int]) -> Floats:
        """Return the position (H', W', 2) of each pixel of a target of size (height, width)."""
        (i, down), (j, across) = (divmod(np.arange(side), self.step) for side in size)
        s, t = (down / self.step)[:, None, None], (across / self.step)[:, None]
        lines = self.nodes[i] * (1 - s) + self.nodes[i + 1] * s
        return lines[:, j] * (1 - t) + lines[:, j + 1] * t


class Table(MapFormat):
    """A format whose file is a bare table of a mesh: sizes and step are in the description next to it."""

    described = True
    step: int  # pixels of the target between nodes, by default
    steps: Sequence[int]
    fractions: int  # of a pixel, in which positions are whole numbers

    @abstractmethod
    def limits(self, path: str, exact: Exact, places: Floats) -> tuple[Floats, Floats]:
        """Return the least and the largest positions that nodes at these places (n, m, 2) of the target may have.

        Raises:
            CameraFileError: If the format does not hold images of these sizes.
        """

    @abstractmethod
    def pack(self, path: str, mesh: Mesh, exact: Exact) -> tuple[bytes, dict[str, Any]]:
        """Return the bytes of a rounded mesh, and what its description needs beside step and number of nodes."""

    @abstractmethod
    def unpack(self, content: bytes, blank: Mesh) -> Floats:
        """Return the nodes (n, m, 2) of a file; `blank` has their step and their places."""

    def encode(self, path: str, exact: Exact, options: Mapping[str, Any]) -> tuple[bytes, dict[str, Any]]:
        # the mesh is exact at its nodes and extrapolated smoothly to nodes without a position; seams are refused
        step = self._checked(as_whole(options.get("step", self.step), "step", "save_map"), "save_map")
        half, leaps = np.array(exact.source_size[::-1], np.float64) / 2, 0
        for p, shown in ((exact.positions, exact.shown), (exact.positions.swapaxes(0, 1), exact.shown.T)):
            leaps += int(((np.abs(np.diff(p, axis=0)) > half).any(-1) & shown[1:] & shown[:-1]).sum())
        if leaps:
            reason = f"positions must not leap, as at the seam of a panorama; got leaps beside {leaps} pixels"
            raise CameraFileError(path, "mesh", reason)
        n, m = _counts(step, exact.target_size)
        down, across = np.nonzero(exact.shown)
        blocks = np.zeros((n + 1, m + 1), np.bool_)  # each node between its four blocks
        blocks[down // step + 1, across // step + 1] = True
        needed = blocks[1:, 1:] | blocks[:-1, 1:] | blocks[1:, :-1] | blocks[:-1, :-1]
        nodes, mapped = exact.at(step * np.arange(m, dtype=np.float64), step * np.arange(n, dtype=np.float64))
        sides = np.array(exact.source_size[::-1], np.float64)
        low, high = -_REACH * sides, (1 + _REACH) * sides
        # nodes far off are no basis for extrapolation
        nodes = _continued(np.where(needed[..., None], nodes, nodes.clip(low, high)), mapped, low, high)
        mesh = Mesh(step, nodes)
        low, high = self.limits(path, exact, mesh.places)
        beyond = needed & ((nodes < low - _SLACK) | (nodes > high + _SLACK)).any(-1)
        if beyond.any() and not options.get("clip"):
            (left, top), (right, bottom) = nodes[beyond].min(0), nodes[beyond].max(0)
            raise CameraFileError(
                path,
                f"{int(beyond.sum())} of {int(needed.sum())} vertices",
                f"must fit in {self.name}; got x {left:.1f} to {right:.1f}, y {top:.1f} to {bottom:.1f} px of the "
                "source. clip=True (--clip) clips them, and the report has the error",
            )
        mesh = rounded(mesh, exact, self.fractions, low, high)
        content, facts = self.pack(path, mesh, exact)
        return content, {"step": mesh.step, "nodes": mesh.nodes.shape[:2], **facts}

    def decode(self, content: bytes, described: Mapping[str, Any]) -> LookupMap:
        sides = [described[key] for key in SIZES]
        source, target = checked("source_size", sides[:2]), checked("target_size", sides[2:])
        step = self._checked(described.get("step", self.step), "load_map")
        nodes = self.unpack(content, Mesh(step, np.empty((*_counts(step, target), 2))))
        positions = torch.from_numpy(Mesh(step, nodes).positions(target))
        return LookupMap(positions, source, self.name, {"step": step, "nodes": nodes.shape[:2]})

    def _checked(self, step: Any, owner: str) -> int:
        if step not in self.steps:
            raise ValueError(f"{owner}: step must be one of {', '.join(map(str, self.steps))} pixels; got {step!r:.60}")
        return int(step)


def table(content: bytes, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return the numbers of a table of a shape; raise a ValueError if the content has another length."""
    expected = int(np.prod(shape, dtype=object)) * np.dtype(dtype).itemsize
    if len(content) != expected:
        raise ValueError(f"content must have {expected} bytes; got {len(content)}")
    return np.frombuffer(content, dtype).reshape(shape)


def _counts(step: int, size: tuple[int, int]) -> tuple[int, int]:
    """Return the number of nodes down and across; the last nodes are at or beyond the size."""
    return -(-size[0] // step) + 1, -(-size[1] // step) + 1


def _continued(nodes: Floats, known: Bools, low: Floats, high: Floats) -> Floats:
    """Return nodes (n, m, 2) with unknown nodes extrapolated from their neighbours, ring by ring.

    The first ring, which affects shown pixels, follows parabolas; later rings follow shorter lines.
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
        if not new.any():  # no node is known
            break
        known, first = known | new, False
    return nodes


def rounded(mesh: Mesh, exact: Exact, fractions: int, low: Floats, high: Floats) -> Mesh:
    """Return the mesh with nodes in whole `fractions` of a pixel, so that the largest error at shown pixels is small.

    Each is one of the two neighbours of the exact value, from low to high. Interpolation cuts off bends, so nodes are
    rounded outwards first; then those near the largest error are rounded to reduce it, as long as that helps.
    """
    held = mesh.nodes.clip(low, high)
    values, least, most = held * fractions, low * fractions, high * fractions
    total = np.zeros_like(held)  # sum of second differences along both axes; the ends copy their neighbours
    for axis in (0, 1):
        if held.shape[axis] > 2:
            bend = np.diff(held, 2, axis)
            total += np.concatenate((bend.take([0], axis), bend, bend.take([-1], axis)), axis)
    outside = (_OUTWARDS * total * fractions).clip(-0.5, 0.5)
    nodes = np.rint(values - outside).clip(least, most)
    either = np.floor(values).clip(least, most), np.ceil(values).clip(least, most)
    edge = np.array(exact.source_size[::-1], np.float64) - 1
    wanted, shown = exact.positions.clip(0, edge), exact.shown

    def errors(nodes: Floats, pixels: tuple[slice, ...]) -> Floats:
        height, width = shown[pixels].shape
        off = Mesh(mesh.step, nodes / fractions).positions((height, width)).clip(0, edge) - wanted[pixels]
        distance: Floats = np.hypot(off[..., 0], off[..., 1]) * shown[pixels]
        return distance

    error = errors(nodes, (slice(None), slice(None)))
    for _ in range(_MOST_STEPS):
        worst = divmod(int(error.argmax()), error.shape[1])
        least_error, best = float(error[worst]) - _GAIN, None
        for node in itertools.product(*((at // mesh.step, at // mesh.step + 1) for at in worst)):
            near = tuple(slice(max(k - 1, 0), k + 2) for k in node)
            patch = nodes[near].copy()
            pixels = tuple(
                slice(mesh.step * part.start, mesh.step * (part.start + count - 1))
                for part, count in zip(near, patch.shape, strict=False)
            )
            for x, y in itertools.product(either, either):
                value = np.array([x[node][0], y[node][1]])
                patch[node[0] - near[0].start, node[1] - near[1].start] = value
                off = errors(patch, pixels)
                if off.max() < least_error:
                    least_error, best = float(off.max()), (node, value, pixels, off)
        if best is None:
            break
        node, value, pixels, off = best
        nodes[node], error[pixels] = value, off
    return Mesh(mesh.step, nodes / fractions)
