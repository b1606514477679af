"""Vertex maps of the DW100 of NXP's i.MX8MP: Linux's control V4L2_CID_DW100_DEWARPING_16x16_VERTEX_MAP.

A 32-bit word, little-endian, for each corner of the blocks of 16x16 pixels of the target, in raster order,
(ceil(W/16) + 1) x (ceil(H/16) + 1) of them: y in the upper half and x in the lower one, each of the source in
sixteenths of a pixel, unsigned. Integers are pixel centres. The hardware interpolates bilinearly between the corners.
Images are 176x144 to 4096x3072 pixels; the driver rounds sizes to multiples of 8.

https://docs.kernel.org/userspace-api/media/drivers/dw100.html
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from camtorch.io._errors import CameraFileError
from camtorch.maps.exact import Exact, Floats
from camtorch.maps.mesh import Mesh, held, rounded
from camtorch.maps.protocol import Options
from camtorch.maps.tables import Table, table

_PARTS = 16
_MOST = (1 << 16) - 1
_SMALLEST, _LARGEST = (144, 176), (3072, 4096)


class DW100(Table):
    """The format: see the module."""

    name = "dw100"
    options: tuple[str, ...] = ("clip",)
    steps: Sequence[int] = (16,)

    def pack(self, path: str, mesh: Mesh, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        """Raises CameraFileError: sizes that the hardware does not take, positions off 0 to 4095.9375."""
        for what, size in (("source", exact.source_size), ("target", exact.target_size)):
            if any(not low <= side <= high for low, side, high in zip(_SMALLEST, size, _LARGEST, strict=True)):
                raise CameraFileError(
                    path, f"{what} size", f"{size[1]}x{size[0]}; the DW100 takes 176x144 to 4096x3072 pixels"
                )
        low, high = np.zeros(2), np.full(2, _MOST / _PARTS)
        parts = rounded(held(path, self.name, mesh, low, high, clip=bool(options.clip)), exact, _PARTS, low, high)
        return (parts[..., 1] << 16 | parts[..., 0]).astype("<u4").tobytes(), {}

    def unpack(self, content: bytes, columns: Floats, rows: Floats, given: Options) -> tuple[Floats, dict[str, Any]]:
        words = table(content, "<u4", (len(rows), len(columns)))
        return np.stack((words & _MOST, words >> 16), -1) / _PARTS, {}
