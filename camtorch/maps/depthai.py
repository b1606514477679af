"""Meshes of DepthAI (Luxonis): float32 positions at every 16th pixel of the target, in raster order, little-endian.

(ceil(W / step) + 1) x (ceil(H / step) + 1) nodes. order="yx" is what `StereoDepth.loadMeshFiles` and `loadMeshData`
take; order="xy" the points of `setWarpMesh`, for which `numpy.fromfile(path, "<f4").reshape(-1, 2)` reads them.
Integers are pixel centres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from camtorch._arguments import shown
from camtorch.io._errors import CameraFileError
from camtorch.maps.exact import Exact, Floats
from camtorch.maps.mesh import Mesh
from camtorch.maps.protocol import Given, Options
from camtorch.maps.tables import Table, table

_ORDERS = {"yx": slice(None, None, -1), "xy": slice(None)}  # of x and y


class DepthAI(Table):
    """The format: see the module."""

    name = "depthai"
    options: tuple[str, ...] = ("step", "order")

    def pack(self, path: str, mesh: Mesh, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        """Raises ValueError: an order that is none."""
        order = "yx" if options.order is None else options.order
        if not isinstance(order, str) or order not in _ORDERS:
            raise ValueError(f"Warp.save: order must be 'yx' (loadMeshFiles) or 'xy' (setWarpMesh); got {shown(order)}")
        return np.ascontiguousarray(mesh.nodes[..., _ORDERS[order]], "<f4").tobytes(), {"order": order}

    def unpack(
        self, path: str, content: bytes, columns: Floats, rows: Floats, given: Given
    ) -> tuple[Floats, dict[str, Any]]:
        """Raises CameraFileError: no such order."""
        order = given.order or "yx"
        if not isinstance(order, str) or order not in _ORDERS:
            raise CameraFileError(path, "order", f"must be 'yx' or 'xy'; got {order!r:.60}")
        nodes = table(path, content, "<f4", (len(rows), len(columns), 2)).astype(np.float64)
        return nodes[..., _ORDERS[order]], {"order": order}
