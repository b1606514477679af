"""Meshes of DepthAI (Luxonis): float32 positions at every 16th pixel of the target, in raster order, little-endian.

(ceil(W / step) + 1) x (ceil(H / step) + 1) nodes. order="yx" is what `StereoDepth.loadMeshFiles` and `loadMeshData`
take; order="xy" the points of `setWarpMesh`, for which `numpy.fromfile(path, "<f4").reshape(-1, 2)` reads them.
Integers are pixel centres.
"""

from __future__ import annotations

import numpy as np

from camtorch._arguments import shown
from camtorch.io._errors import CameraFileError
from camtorch.maps.exact import Exact
from camtorch.maps.lookup import LookupMap
from camtorch.maps.mesh import as_step, mesh_of, nodes_every
from camtorch.maps.protocol import Encoded, Given, Options
from camtorch.maps.tables import lookup, sizes, table

_ORDERS = ("yx", "xy")


class DepthAI:
    """The format: see the module."""

    name = "depthai"
    suffixes: tuple[str, ...] = ()
    options: tuple[str, ...] = ("step", "order")
    described = True

    def encode(self, path: str, exact: Exact, options: Options) -> Encoded:
        """Raises ValueError: an option that is none."""
        step, order = as_step(options.step, "Warp.save"), "yx" if options.order is None else options.order
        if not isinstance(order, str) or order not in _ORDERS:
            raise ValueError(f"Warp.save: order must be 'yx' (loadMeshFiles) or 'xy' (setWarpMesh); got {shown(order)}")
        height, width = exact.target_size
        mesh = mesh_of(path, exact, nodes_every(step, width), nodes_every(step, height))
        nodes = mesh.nodes if order == "xy" else mesh.nodes[..., ::-1]
        facts = {"step": step, "nodes": (len(mesh.rows), len(mesh.columns)), "order": order}
        return Encoded(np.ascontiguousarray(nodes, "<f4").tobytes(), facts)

    def matches(self, path: str, content: bytes) -> bool:
        return False

    def decode(self, path: str, content: bytes, given: Given) -> LookupMap:
        """Raises CameraFileError: another length, no such order or step, nobody says the sizes."""
        source, target = sizes(path, given)
        order = given.order or "yx"
        if order not in _ORDERS:
            raise CameraFileError(path, "order", f"must be 'yx' or 'xy'; got {order!r}")
        try:
            step = as_step(given.step, "load_map")
        except ValueError as error:
            raise CameraFileError(path, "step", str(error)) from None
        shape = len(nodes_every(step, target[0])), len(nodes_every(step, target[1])), 2
        nodes = table(path, content, "<f4", shape).astype(np.float64)
        return lookup(
            path, self.name, nodes if order == "xy" else nodes[..., ::-1], step, source, target, {"order": order}
        )
