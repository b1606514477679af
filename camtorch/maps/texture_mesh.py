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
from typing import Any, NoReturn

import numpy as np
import torch

from camtorch.io._errors import CameraFileError
from camtorch.maps.exact import Bools, Exact, Floats
from camtorch.maps.lookup import LookupMap
from camtorch.maps.mesh import Mesh, as_step, mesh_of
from camtorch.maps.protocol import SIZES, Encoded, Given, Options, checked, named_sizes, sizes_in, suffix_of

_GLB = b"glTF"
_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # kinds of chunks
_URI = "data:application/octet-stream;base64,"
_FLOAT, _UNSIGNED = 5126, 5125  # component types
_FAILURES = (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError, struct.error)


class TextureMesh:
    """A format: see the module.

    Args:
        name: "obj" or "gltf".
        suffixes: of its files.
    """

    options: tuple[str, ...] = ("step",)
    described = False
    name: str
    suffixes: tuple[str, ...]

    def __init__(self, name: str, suffixes: tuple[str, ...]):
        self.name, self.suffixes = name, suffixes

    def encode(self, path: str, exact: Exact, options: Options) -> Encoded:
        """Raises ValueError: a step that is none, or another suffix."""
        suffix, step = suffix_of(path, self), as_step(options.step, "Warp.save")
        height, width = exact.target_size
        mesh = mesh_of(path, exact, _edges(step, width), _edges(step, height), triangles=True)
        columns, rows = mesh.columns + 0.5, height - (mesh.rows + 0.5)
        places = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
        parts = ((mesh.nodes + 0.5) / exact.source_size[::-1]).reshape(-1, 2)
        assert mesh.drawn is not None
        triangles = _triangles(mesh.drawn)
        sizes = named_sizes(exact.source_size, exact.target_size)
        if self.name == "obj":
            content = _as_obj(places, parts, triangles, sizes)
        else:
            content = _as_gltf(places, parts, triangles, sizes, binary=suffix == ".glb")
        shape = len(mesh.rows), len(mesh.columns)
        return Encoded(content, {"step": step, "nodes": shape, "triangles": len(triangles)})

    def matches(self, path: str, content: bytes) -> bool:
        if self.name == "obj":
            return path.lower().endswith(".obj")
        return content.startswith(_GLB) or path.lower().endswith(".gltf")

    def decode(self, path: str, content: bytes, given: Given) -> LookupMap:
        """Raises CameraFileError: damaged, no lattice of vertices as it is written here, no size of the source."""
        read = _from_obj if self.name == "obj" else _from_gltf
        try:
            places, parts, triangles, stated = read(content)
        except _FAILURES as error:
            raise CameraFileError(path, "content", f"no mesh in {self.name}: {error}") from None
        sizes = sizes_in(stated) or (given.source_size, given.target_size)
        source, target = (checked(path, *pair) for pair in zip(("source_size", "target_size"), sizes, strict=True))
        mesh = _lattice(path, places, parts, triangles, source, target[0])
        facts = {"nodes": (len(mesh.rows), len(mesh.columns)), "triangles": len(triangles)}
        return LookupMap(torch.from_numpy(mesh.positions(target)), source, self.name, facts)


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


def _lattice(
    path: str, places: Floats, parts: Floats, triangles: np.ndarray, source: tuple[int, int], height: int
) -> Mesh:
    """The mesh of vertices, if they stand in raster order, two triangles to a cell."""

    def fail(reason: str) -> NoReturn:
        raise CameraFileError(path, "vertices", f"{reason}; meshes are read as they are written here")

    if not len(places) or not np.isfinite(places).all() or not np.isfinite(parts).all():
        fail("none, or not finite")
    columns = int(np.argmax(places[:, 1] != places[0, 1])) or len(places)
    if columns < 2 or len(places) % columns or len(places) == columns:
        fail("no lattice")
    grid = places.reshape(-1, columns, 2)
    x, y = grid[0, :, 0], height - grid[:, 0, 1]
    level = (grid[..., 0] == x).all() and (grid[..., 1] == grid[:, :1, 1]).all()
    if not level or (np.diff(x) <= 0).any() or (np.diff(y) <= 0).any():
        fail("no lattice in raster order")
    start, steps = triangles[:, 0], triangles[:, 1:] - triangles[:, :1]
    above, below = ((steps == half).all(-1) for half in ((columns + 1, 1), (columns, columns + 1)))
    i, j = start // columns, start % columns
    if not ((above | below) & (i >= 0) & (i < len(y) - 1) & (j < columns - 1)).all():
        fail("triangles other than halves of cells")
    drawn = np.zeros((len(y) - 1, columns - 1, 2), np.bool_)
    drawn[i, j, below.astype(np.intp)] = True
    nodes = parts.reshape(*grid.shape) * source[::-1] - 0.5
    return Mesh(x - 0.5, y - 0.5, nodes, drawn=drawn)


# -- OBJ


def _as_obj(places: Floats, parts: Floats, triangles: np.ndarray, sizes: dict[str, int]) -> bytes:
    lines = [
        "# a warp: v in pixels of the target from its lower left corner, y up; vt on the source",
        *(f"# {name} {value}" for name, value in sizes.items()),
    ]
    lines += [f"v {x:.9g} {y:.9g} 0" for x, y in places.tolist()]
    lines += [f"vt {u:.9g} {1 - v:.9g}" for u, v in parts.tolist()]
    lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in (triangles + 1).tolist()]
    return ("\n".join(lines) + "\n").encode()


def _from_obj(content: bytes) -> tuple[Floats, Floats, np.ndarray, dict[str, int]]:
    places: list[list[float]] = []
    parts: list[list[float]] = []
    triangles: list[list[int]] = []
    sizes: dict[str, int] = {}
    for line in content.decode("ascii").splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            places.append([float(word) for word in words[1:3]])
        elif words[0] == "vt":
            u, v = words[1:3]
            parts.append([float(u), 1 - float(v)])
        elif words[0] == "f":
            corners = [word.split("/")[:2] for word in words[1:]]
            if len(corners) != 3 or any(len(set(corner)) != 1 for corner in corners):
                raise ValueError(f"{line:.60}: no triangle of vertices with texture coordinates of their own")
            triangles.append([int(corner[0]) - 1 for corner in corners])
        elif words[0] == "#" and len(words) == 3 and words[1] in SIZES and words[2].isdigit() and len(words[2]) < 9:
            sizes[words[1]] = int(words[2])
    if len(parts) != len(places):
        raise ValueError(f"{len(places)} vertices and {len(parts)} texture coordinates")
    points = np.array(places, np.float64).reshape(-1, 2)
    return points, np.array(parts, np.float64).reshape(-1, 2), np.array(triangles, np.int64).reshape(-1, 3), sizes


# -- glTF


def _as_gltf(places: Floats, parts: Floats, triangles: np.ndarray, sizes: dict[str, int], *, binary: bool) -> bytes:
    points = np.zeros((len(places), 3), "<f4")
    points[:, :2] = places
    arrays = points.tobytes(), parts.astype("<f4").tobytes(), triangles.astype("<u4").tobytes()
    buffer = b"".join(arrays)
    views, start = [], 0
    for array, target in zip(arrays, (34962, 34962, 34963), strict=True):  # vertices, vertices, indices
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(array), "target": target})
        start += len(array)
    low, high = points.min(0).tolist(), points.max(0).tolist()
    accessors = [
        {"bufferView": 0, "componentType": _FLOAT, "count": len(points), "type": "VEC3", "min": low, "max": high},
        {"bufferView": 1, "componentType": _FLOAT, "count": len(points), "type": "VEC2"},
        {"bufferView": 2, "componentType": _UNSIGNED, "count": triangles.size, "type": "SCALAR"},
    ]
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
    length = 12 + 8 + len(text) + 8 + len(buffer)
    head = struct.pack("<4sII", _GLB, 2, length) + struct.pack("<II", len(text), _JSON)
    return head + text + struct.pack("<II", len(buffer), _BINARY) + buffer


def _from_gltf(content: bytes) -> tuple[Floats, Floats, np.ndarray, dict[str, int]]:
    buffer = None
    if content.startswith(_GLB):
        length, kind = struct.unpack_from("<II", content, 12)
        if kind != _JSON:
            raise ValueError("no JSON in it")
        text, rest = content[20 : 20 + length], content[20 + length :]
        length, kind = struct.unpack_from("<II", rest)
        if kind != _BINARY or length > len(rest) - 8:
            raise ValueError("no buffer in it")
        buffer = rest[8 : 8 + length]
    else:
        text = content
    document = json.loads(text)
    if buffer is None:
        uri = document["buffers"][0]["uri"]
        if not uri.startswith("data:") or "," not in uri:
            raise ValueError("a buffer in another file, which is not read")
        buffer = base64.b64decode(uri.partition(",")[2], validate=True)
    primitive = document["meshes"][0]["primitives"][0]
    names = primitive["attributes"]
    points = _accessed(document, buffer, names["POSITION"], ("VEC3", _FLOAT))
    parts = _accessed(document, buffer, names["TEXCOORD_0"], ("VEC2", _FLOAT))
    triangles = _accessed(document, buffer, primitive["indices"], ("SCALAR", _UNSIGNED)).reshape(-1, 3)
    if len(parts) != len(points):
        raise ValueError(f"{len(points)} vertices and {len(parts)} texture coordinates")
    sizes = document["asset"].get("extras")
    sizes = sizes if isinstance(sizes, dict) else {}
    return points[:, :2].astype(np.float64), parts.astype(np.float64), triangles.astype(np.int64), sizes


def _accessed(document: dict[str, Any], buffer: bytes, index: int, kind: tuple[str, int]) -> np.ndarray:
    accessor = document["accessors"][index]
    if (accessor["type"], accessor["componentType"]) != kind:
        raise ValueError(f"{accessor['type']} of {accessor['componentType']}; {kind} are read")
    view = document["bufferViews"][accessor["bufferView"]]
    start, count = int(view.get("byteOffset", 0)), int(accessor["count"])
    wide = {"VEC3": 3, "VEC2": 2, "SCALAR": 1}[kind[0]]
    if count < 0:  # -1 means all there is to NumPy
        raise ValueError(f"{count} values")
    return np.frombuffer(buffer, "<f4" if kind[1] == _FLOAT else "<u4", count * wide, start).reshape(count, wide)
