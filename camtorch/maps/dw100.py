"""Vertex maps of the DW100 of NXP's i.MX8MP: Linux's control V4L2_CID_DW100_DEWARPING_16x16_VERTEX_MAP.

A 32-bit word, little-endian, for each corner of the blocks of 16x16 pixels of the target, in raster order,
(ceil(W/16) + 1) x (ceil(H/16) + 1) of them: y in the upper half and x in the lower one, each of the source in
sixteenths of a pixel, unsigned. Integers are pixel centres. The hardware interpolates bilinearly between the corners.
Images are 176x144 to 4096x3072 pixels; the driver rounds sizes to multiples of 8.

https://docs.kernel.org/userspace-api/media/drivers/dw100.html
"""

from typing import Any

import numpy as np

from camtorch.io.record import CameraFileError
from camtorch.maps.lookup import Exact, Floats
from camtorch.maps.mesh import Mesh, Table, table

_FRACTIONS = 16
_LARGEST = (1 << 16) - 1
_SMALLEST_SIZE, _LARGEST_SIZE = (144, 176), (3072, 4096)


class DW100(Table):
    """The format of the DW100; see the module."""

    name = "dw100"
    options: tuple[str, ...] = ("clip",)
    step = 16
    steps: tuple[int, ...] = (16,)
    fractions = _FRACTIONS

    def limits(self, path: str, exact: Exact, places: Floats) -> tuple[Floats, Floats]:
        for what, size in (("source", exact.source_size), ("target", exact.target_size)):
            if any(
                not low <= side <= high for low, side, high in zip(_SMALLEST_SIZE, size, _LARGEST_SIZE, strict=True)
            ):
                reason = f"must be 176x144 to 4096x3072 pixels for the DW100; got {size[1]}x{size[0]}"
                raise CameraFileError(path, f"{what} size", reason)
        return np.zeros(2), np.full(2, _LARGEST / _FRACTIONS)

    def pack(self, path: str, mesh: Mesh, exact: Exact) -> tuple[bytes, dict[str, Any]]:
        parts = (mesh.nodes * _FRACTIONS).astype(np.int64)
        return (parts[..., 1] << 16 | parts[..., 0]).astype("<u4").tobytes(), {}

    def unpack(self, content: bytes, blank: Mesh) -> Floats:
        words = table(content, "<u4", blank.nodes.shape[:2])
        return np.stack((words & _LARGEST, words >> 16), -1) / _FRACTIONS
