"""Meshes of DepthAI (Luxonis): float32 positions at every 16th pixel of the target, in raster order, little-endian.

(ceil(W / step) + 1) x (ceil(H / step) + 1) nodes. order="yx" is what `StereoDepth.loadMeshFiles` and `loadMeshData`
take; order="xy" the points of `setWarpMesh`, for which `numpy.fromfile(path, "<f4").reshape(-1, 2)` reads them.
Integers are pixel centres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from camtorch._arguments import shown
from camtorch.maps.exact import Exact, Floats
from camtorch.maps.mesh import Mesh
from camtorch.maps.protocol import Options
from camtorch.maps.tables import Table, table


class DepthAI(Table):
    """The format: see the module."""

    name = "depthai"
    options: tuple[str, ...] = ("step", "order")

    def pack(self, path: str, mesh: Mesh, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        order = _order(options)
        return np.ascontiguousarray(_ordered(mesh.nodes, order), "<f4").tobytes(), {"order": order}

    def unpack(self, content: bytes, columns: Floats, rows: Floats, given: Options) -> tuple[Floats, dict[str, Any]]:
        order = _order(given)
        nodes = table(content, "<f4", (len(rows), len(columns), 2)).astype(np.float64)
        return _ordered(nodes, order), {"order": order}


def _order(options: Options) -> str:
    order = "yx" if options.order is None else options.order
    if order not in ("yx", "xy"):
        raise ValueError(f"order must be 'yx' (loadMeshFiles) or 'xy' (setWarpMesh); got {shown(order)}")
    return order


def _ordered(nodes: Floats, order: str) -> Floats:
    """Nodes (..., 2) of x and y in an order, or back."""
    return nodes[..., ::-1] if order == "yx" else nodes
