"""Textured meshes as OBJ, for anything that draws triangles.

A vertex is a point of the target, x from its left edge and y up from its lower edge, in pixels, z = 0: the rectangle
from (0, 0) to (W, H) is the image, seen along -z. Its texture coordinates are a point of the source, from 0 to 1 from
edge to edge, v upward. Triangles that show nothing of the source are left out. Between vertices a renderer interpolates
linearly over each triangle, which is what is measured.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from camtorch.maps.exact import Bools, Exact, Floats
from camtorch.maps.lookup import LookupMap
from camtorch.maps.mesh import Mesh, as_step, mesh_of
from camtorch.maps.protocol import SIZES, MapFormat, Options, checked, named_sizes


class OBJ(MapFormat):
    """The format: see the module."""

    name = "obj"
    suffixes: tuple[str, ...] = (".obj",)
    options: tuple[str, ...] = ("step",)

    def encode(self, path: str, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        step = as_step(options.step, "Warp.save")
        height, width = exact.target_size
        mesh = mesh_of(path, exact, _edges(step, width), _edges(step, height), triangles=True)
        assert mesh.drawn is not None
        x, y = np.meshgrid(mesh.columns + 0.5, height - (mesh.rows + 0.5))
        u, v = np.moveaxis((mesh.nodes + 0.5) / exact.source_size[::-1], -1, 0)
        triangles = _triangles(mesh.drawn) + 1
        lines = [
            "# a warp: v in pixels of the target from its lower left corner, y up; vt on the source",
            *(f"# {name} {side}" for name, side in named_sizes(exact.source_size, exact.target_size).items()),
            *(f"v {x:.9g} {y:.9g} 0" for x, y in zip(x.flat, y.flat, strict=True)),
            *(f"vt {u:.9g} {1 - v:.9g}" for u, v in zip(u.flat, v.flat, strict=True)),
            *(f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in triangles.tolist()),
        ]
        facts = {"step": step, "nodes": (len(mesh.rows), len(mesh.columns)), "triangles": len(triangles)}
        return ("\n".join(lines) + "\n").encode(), facts

    def decode(self, content: bytes, given: Options) -> LookupMap:
        """See `MapFormat`. Meshes are read as they are written here: two triangles to a cell, in raster order."""
        lines: dict[str, list[list[str]]] = {"v": [], "vt": [], "f": [], "#": []}
        for kind, *words in map(str.split, filter(str.strip, content.decode("ascii").splitlines())):
            lines[kind].append(words)
        stated = {words[0]: int(words[1]) for words in lines["#"] if words and words[0] in SIZES}
        rows, columns, height, width = (stated[name] for name in SIZES)
        source, target = checked("source_size", (rows, columns)), checked("target_size", (height, width))
        places, parts = (np.array([words[:2] for words in lines[kind]], np.float64) for kind in ("v", "vt"))
        x, y = np.unique(places[:, 0]), np.unique(target[0] - places[:, 1])
        nodes = np.stack((parts[:, 0], 1 - parts[:, 1]), -1).reshape(len(y), len(x), 2) * source[::-1] - 0.5
        corners = np.array([[int(word.split("/")[0]) for word in words] for words in lines["f"]]).reshape(-1, 3) - 1
        drawn = np.zeros((len(y) - 1, len(x) - 1, 2), np.bool_)
        i, j = np.divmod(corners[:, 0], len(x))
        drawn[i, j, (corners[:, 1] == corners[:, 0] + len(x)).astype(np.intp)] = True
        positions = Mesh(x - 0.5, y - 0.5, nodes, drawn=drawn).positions(target)
        facts = {"nodes": (len(y), len(x)), "triangles": len(corners)}
        return LookupMap(torch.from_numpy(positions), source, self.name, facts)


def _edges(step: int, size: int) -> Floats:
    """Where vertices are in pixels, whose centres are integers: every `step` from edge to edge."""
    return np.append(np.arange(0, size, step, dtype=np.float64), size) - 0.5


def _triangles(drawn: Bools) -> np.ndarray:
    """(T, 3) vertices, counter-clockwise for who looks along -z, y up."""
    n, m = drawn.shape[0] + 1, drawn.shape[1] + 1
    index = np.arange(n * m).reshape(n, m)
    start, right, below, end = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    pairs = np.stack((np.stack((start, end, right), -1), np.stack((start, below, end), -1)), -2)
    return pairs[drawn]
