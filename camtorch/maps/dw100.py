"""Vertex maps of the DW100 of NXP's i.MX8MP: Linux's control V4L2_CID_DW100_DEWARPING_16x16_VERTEX_MAP.

A 32-bit word, little-endian, for each corner of the blocks of 16x16 pixels of the target, in raster order,
(ceil(W/16) + 1) x (ceil(H/16) + 1) of them: y in the upper half and x in the lower one, each of the source in
sixteenths of a pixel, unsigned. Integers are pixel centres. The hardware interpolates bilinearly between the corners.
Images are 176x144 to 4096x3072 pixels; the driver rounds sizes to multiples of 8.

https://docs.kernel.org/userspace-api/media/drivers/dw100.html
"""

from __future__ import annotations

import numpy as np

from camtorch.io._errors import CameraFileError
from camtorch.maps.exact import Exact
from camtorch.maps.lookup import LookupMap
from camtorch.maps.mesh import held, mesh_of, nodes_every, rounded
from camtorch.maps.protocol import Encoded, Given, Options
from camtorch.maps.tables import lookup, sizes, table

_STEP = 16
_PARTS = 16
_MOST = (1 << 16) - 1
_SMALLEST, _LARGEST = (144, 176), (3072, 4096)


class DW100:
    """The format: see the module."""

    name = "dw100"
    suffixes: tuple[str, ...] = ()
    options: tuple[str, ...] = ("clip",)
    described = True

    def encode(self, path: str, exact: Exact, options: Options) -> Encoded:
        """Raises CameraFileError: sizes that the hardware does not take, positions off 0 to 4095.9375."""
        for what, size in (("source", exact.source_size), ("target", exact.target_size)):
            if any(not low <= side <= high for low, side, high in zip(_SMALLEST, size, _LARGEST, strict=True)):
                raise CameraFileError(
                    path, f"{what} size", f"{size[1]}x{size[0]}; the DW100 takes 176x144 to 4096x3072 pixels"
                )
        height, width = exact.target_size
        mesh = mesh_of(path, exact, nodes_every(_STEP, width), nodes_every(_STEP, height))
        low, high = np.zeros(2), np.full(2, _MOST / _PARTS)
        mesh = held(path, "dw100", mesh, low, high, clip=bool(options.clip))
        parts = rounded(mesh, exact, _PARTS, low, high)
        words = (parts[..., 1] << 16 | parts[..., 0]).astype("<u4")
        return Encoded(words.tobytes(), {"step": _STEP, "nodes": words.shape})

    def matches(self, path: str, content: bytes) -> bool:
        return False

    def decode(self, path: str, content: bytes, given: Given) -> LookupMap:
        """Raises CameraFileError: another length, nobody says the sizes."""
        source, target = sizes(path, given)
        shape = len(nodes_every(_STEP, target[0])), len(nodes_every(_STEP, target[1]))
        words = table(path, content, "<u4", shape)
        nodes = np.stack((words & _MOST, words >> 16), -1) / _PARTS
        return lookup(path, self.name, nodes, _STEP, source, target, {})
