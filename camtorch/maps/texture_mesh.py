"""Textured meshes, for anything that draws triangles: OBJ (.obj) and glTF (.gltf, .glb).

A vertex is a point of the target, x from its left edge and y up from its lower edge, in pixels, z = 0: the rectangle
from (0, 0) to (W, H) is the image, seen along -z. Its texture coordinates are a point of the source, from 0 to 1 from
edge to edge, v upward in OBJ and downward in glTF, as each format has it. Triangles that show nothing of the source are
left out. Between vertices a renderer interpolates linearly over each triangle, which is what is measured.

Wavefront's OBJ, as everybody reads it; glTF 2.0, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import base64
import json
import struct
from abc import abstractmethod
from typing import Any

import numpy as np
import torch

from camtorch.maps.exact import Bools, Exact, Floats
from camtorch.maps.lookup import LookupMap
from camtorch.maps.mesh import Mesh, as_step, mesh_of
from camtorch.maps.protocol import SIZES, MapFormat, Options, checked, named_sizes

Triangles = tuple[Floats, Floats, np.ndarray]
"""Vertices (N, 2), their points of the source (N, 2) from 0 to 1, v downward, and corners (T, 3)."""

_GLB = b"glTF"
_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # kinds of chunks
_URI = "data:application/octet-stream;base64,"
_KINDS = (("VEC3", 5126, 34962, "<f4"), ("VEC2", 5126, 34962, "<f4"), ("SCALAR", 5125, 34963, "<u4"))
"""Of the accessors of vertices, texture coordinates and corners: type, type of a number, target, NumPy's type."""


class TextureMesh(MapFormat):
    """A format of textured meshes: see the module."""

    options: tuple[str, ...] = ("step",)

    @abstractmethod
    def write(self, path: str, mesh: Triangles, sizes: dict[str, int]) -> bytes:
        """The file of triangles."""

    @abstractmethod
    def read(self, content: bytes) -> tuple[Triangles, dict[str, Any]]:
        """The triangles of a file, and the sizes that it states."""

    def encode(self, path: str, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        step = as_step(options.step, "Warp.save")
        height, width = exact.target_size
        mesh = mesh_of(path, exact, _edges(step, width), _edges(step, height), triangles=True)
        assert mesh.drawn is not None
        places = np.stack(np.meshgrid(mesh.columns + 0.5, height - (mesh.rows + 0.5)), -1).reshape(-1, 2)
        parts = ((mesh.nodes + 0.5) / exact.source_size[::-1]).reshape(-1, 2)
        triangles = _triangles(mesh.drawn)
        content = self.write(path, (places, parts, triangles), named_sizes(exact.source_size, exact.target_size))
        return content, {"step": step, "nodes": (len(mesh.rows), len(mesh.columns)), "triangles": len(triangles)}

    def decode(self, content: bytes, given: Options) -> LookupMap:
        """See `MapFormat`. Meshes are read as they are written here: two triangles to a cell, in raster order."""
        (places, parts, triangles), stated = self.read(content)
        says = all(name in stated for name in SIZES)
        rows, columns, height, width = (stated[name] for name in SIZES) if says else (None,) * 4
        source = checked("source_size", (rows, columns) if says else given.source_size)
        target = checked("target_size", (height, width) if says else given.target_size)
        x, y = np.unique(places[:, 0]), np.unique(target[0] - places[:, 1])
        n, m = len(y), len(x)
        there = min(n, m) > 1 and n * m == len(places) == len(parts)
        if not there or not np.array_equal(places, np.stack(np.meshgrid(x, target[0] - y), -1).reshape(-1, 2)):
            raise ValueError("vertices other than a lattice in raster order, each with its texture coordinates")
        start, steps = triangles[:, 0], triangles[:, 1:] - triangles[:, :1]
        above, below = ((steps == half).all(-1) for half in ((m + 1, 1), (m, m + 1)))
        i, j = start // m, start % m
        if not ((above | below) & (i >= 0) & (i < n - 1) & (j < m - 1)).all() or not np.isfinite(parts).all():
            raise ValueError("triangles other than halves of cells, or texture coordinates that are not finite")
        drawn = np.zeros((n - 1, m - 1, 2), np.bool_)
        drawn[i, j, below.astype(np.intp)] = True
        nodes = parts.reshape(n, m, 2) * source[::-1] - 0.5
        positions = Mesh(x - 0.5, y - 0.5, nodes, drawn=drawn).positions(target)
        facts = {"nodes": (n, m), "triangles": len(triangles)}
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


class OBJ(TextureMesh):
    """OBJ: see the module."""

    name = "obj"
    suffixes: tuple[str, ...] = (".obj",)

    def write(self, path: str, mesh: Triangles, sizes: dict[str, int]) -> bytes:
        places, parts, triangles = mesh
        lines = [
            "# a warp: v in pixels of the target from its lower left corner, y up; vt on the source",
            *(f"# {name} {value}" for name, value in sizes.items()),
            *(f"v {x:.9g} {y:.9g} 0" for x, y in places.tolist()),
            *(f"vt {u:.9g} {1 - v:.9g}" for u, v in parts.tolist()),
            *(f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in (triangles + 1).tolist()),
        ]
        return ("\n".join(lines) + "\n").encode()

    def read(self, content: bytes) -> tuple[Triangles, dict[str, Any]]:
        lines: dict[str, list[list[str]]] = {"v": [], "vt": [], "f": [], "#": []}
        for kind, *words in map(str.split, filter(str.strip, content.decode("ascii").splitlines())):
            lines.get(kind, []).append(words)
        corners = [[word.split("/")[:2] for word in words] for words in lines["f"]]
        if any(len(set(corner)) != 1 for triangle in corners for corner in triangle):
            raise ValueError("vertices without texture coordinates of their own")
        triangles = np.array([[int(corner[0]) for corner in triangle] for triangle in corners], np.int64) - 1
        places, parts = (np.array([words[:2] for words in lines[kind]], np.float64) for kind in ("v", "vt"))
        parts[:, 1] = 1 - parts[:, 1]
        sizes = {words[0]: int(words[1]) for words in lines["#"] if words and words[0] in SIZES}
        return (places, parts, triangles.reshape(-1, 3)), sizes


class GLTF(TextureMesh):
    """glTF: see the module."""

    name = "gltf"
    suffixes: tuple[str, ...] = (".glb", ".gltf")

    def write(self, path: str, mesh: Triangles, sizes: dict[str, int]) -> bytes:
        points = np.pad(mesh[0], ((0, 0), (0, 1))).astype("<f4")
        arrays = points, mesh[1].astype("<f4"), mesh[2].astype("<u4").reshape(-1)
        buffer = b"".join(array.tobytes() for array in arrays)
        views, accessors, start = [], [], 0
        for i, (array, (kind, number, target, _)) in enumerate(zip(arrays, _KINDS, strict=True)):
            views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
            accessors.append({"bufferView": i, "componentType": number, "count": len(array), "type": kind})
            start += array.nbytes
        accessors[0] |= {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
        binary = path.lower().endswith(".glb")
        document = {
            "asset": {"version": "2.0", "generator": "camtorch", "extras": sizes},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": "target"}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2}]}],
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [
                {"byteLength": len(buffer)} | ({} if binary else {"uri": _URI + base64.b64encode(buffer).decode()})
            ],
        }
        text = json.dumps(document, separators=(",", ":")).encode()
        if not binary:
            return text
        text += b" " * (-len(text) % 4)  # and the buffer is of words
        head = struct.pack("<4sIIII", _GLB, 2, 12 + 8 + len(text) + 8 + len(buffer), len(text), _JSON)
        return head + text + struct.pack("<II", len(buffer), _BINARY) + buffer

    def matches(self, path: str, content: bytes) -> bool:
        return content.startswith(_GLB) or path.lower().endswith(".gltf")

    def read(self, content: bytes) -> tuple[Triangles, dict[str, Any]]:
        if content.startswith(_GLB):
            length, kind = struct.unpack_from("<II", content, 12)
            following, second = struct.unpack_from("<II", content, 20 + length)
            if (kind, second) != (_JSON, _BINARY) or 28 + length + following > len(content):
                raise ValueError("no JSON and buffer in it")
            document, buffer = json.loads(content[20 : 20 + length]), content[28 + length : 28 + length + following]
        else:
            document = json.loads(content)
            head, _, text = document["buffers"][0]["uri"].partition(",")
            if not head.startswith("data:"):
                raise ValueError("a buffer in another file, which is not read")
            buffer = base64.b64decode(text, validate=True)
        primitive = document["meshes"][0]["primitives"][0]
        names = primitive["attributes"]["POSITION"], primitive["attributes"]["TEXCOORD_0"], primitive["indices"]
        arrays = []
        for index, (kind, number, _, dtype) in zip(names, _KINDS, strict=True):
            accessor = document["accessors"][index]
            if (accessor["type"], accessor["componentType"]) != (kind, number) or accessor["count"] < 0:
                raise ValueError(f"{accessor['count']} {accessor['type']} of {accessor['componentType']}")
            wide, start = {"VEC3": 3, "VEC2": 2, "SCALAR": 1}[kind], document["bufferViews"][accessor["bufferView"]]
            numbers = np.frombuffer(buffer, dtype, accessor["count"] * wide, int(start.get("byteOffset", 0)))
            arrays.append(numbers.reshape(-1, wide))
        sizes = document["asset"].get("extras")
        places, parts = arrays[0][:, :2].astype(np.float64), arrays[1].astype(np.float64)
        triangles = arrays[2].reshape(-1, 3).astype(np.int64)
        return (places, parts, triangles), sizes if isinstance(sizes, dict) else {}
