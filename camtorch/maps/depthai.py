"""Meshes of DepthAI (Luxonis): float32 y, x at every 16th pixel of the target, in raster order, little-endian.

(ceil(W / step) + 1) x (ceil(H / step) + 1) nodes, as `StereoDepth.loadMeshFiles` and `loadMeshData` take them. Integers
are pixel centres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from camtorch.maps.exact import Exact, Floats
from camtorch.maps.mesh import Mesh
from camtorch.maps.protocol import Options
from camtorch.maps.tables import Table, table


class DepthAI(Table):
    """The format: see the module."""

    name = "depthai"
    options: tuple[str, ...] = ("step",)

    def pack(self, path: str, mesh: Mesh, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        return np.ascontiguousarray(mesh.nodes[..., ::-1], "<f4").tobytes(), {}

    def unpack(self, content: bytes, columns: Floats, rows: Floats, given: Options) -> tuple[Floats, dict[str, Any]]:
        nodes = table(content, "<f4", (len(rows), len(columns), 2)).astype(np.float64)
        return np.ascontiguousarray(nodes[..., ::-1]), {}
