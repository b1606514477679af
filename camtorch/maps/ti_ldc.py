"""Meshes of TI's lens distortion correction, the LDC of the VPAC in TDA4 and AM6xA.

At every 2^m-th pixel of the target, ceil(W / 2^m) + 1 in each of ceil(H / 2^m) + 1 lines, source minus target: x and y
as signed 16-bit eighths of a pixel, interleaved, little-endian, lines filled up to 16 bytes. The hardware interpolates
bilinearly and draws positions in to the image.

It makes the target block by block, and fetches for each the part of the source around what the block's corners say,
with a padding that software has to state so that all pixels of the block find what they need. Both are reported: the
largest of the usual block sizes whose padding the register holds, and the padding, for the bicubic filter.

Technical reference manuals, e.g. SPRUJ28, "LDC Lens Distortion Back-Mapping" and "LDC Input Block Fetch".
"""

from typing import Any

import numpy as np

from camtorch.io.record import CameraFileError
from camtorch.maps.lookup import Exact, Floats
from camtorch.maps.mesh import Mesh, Table, table

_FRACTIONS = 8
_LOW, _HIGH = -(1 << 15), (1 << 15) - 1
_ALIGNMENT_BYTES = 16
_LARGEST_SIDE = 8192  # pixels
_BLOCKS = ((64, 64), (32, 64), (32, 32), (16, 32), (16, 16), (8, 16), (8, 8), (4, 8), (2, 8))  # height, width
_MOST_PADDING = 15  # four bits
_BEFORE, _AFTER = 1, 2  # pixels around the whole part of a position that a bicubic filter reads


class TILDC(Table):
    """The format of TI's LDC; see the module."""

    name = "ti_ldc"
    options: tuple[str, ...] = ("step", "clip")
    step = 8
    steps: tuple[int, ...] = tuple(1 << m for m in range(8))
    fractions = _FRACTIONS

    def limits(self, path: str, exact: Exact, places: Floats) -> tuple[Floats, Floats]:
        if max(*exact.source_size, *exact.target_size) > _LARGEST_SIDE:
            raise CameraFileError(path, "size", f"sides must be at most {_LARGEST_SIDE} px for the LDC; got more")
        return places + _LOW / _FRACTIONS, places + _HIGH / _FRACTIONS

    def pack(self, path: str, mesh: Mesh, exact: Exact) -> tuple[bytes, dict[str, Any]]:
        n, m = mesh.nodes.shape[:2]
        lines = np.zeros((n, _pitch(m) // 2), "<i2")
        lines[:, : 2 * m] = ((mesh.nodes - mesh.places) * _FRACTIONS).reshape(n, -1)
        size, padding, largest = _fetched(path, mesh.positions(exact.target_size), exact.source_size)
        facts = {"line_offset": _pitch(m), "block_size": size, "pixel_padding": padding, "source_block": largest}
        return lines.tobytes(), facts

    def unpack(self, content: bytes, blank: Mesh) -> Floats:
        n, m = blank.nodes.shape[:2]
        lines = table(content, "<i2", (n, _pitch(m) // 2))
        return blank.places + lines[:, : 2 * m].reshape(n, m, 2) / _FRACTIONS


def _pitch(columns: int) -> int:
    """Return the bytes from line to line."""
    return -(-4 * columns // _ALIGNMENT_BYTES) * _ALIGNMENT_BYTES


def _fetched(path: str, positions: Floats, source: tuple[int, int]) -> tuple[tuple[int, int], int, tuple[int, int]]:
    """Return block size, padding and the largest part of the source that is fetched; raise if no block fits."""
    drawn = positions.clip(0, np.array(source[::-1], np.float64) - 1)
    for size in _BLOCKS:
        height, width = drawn.shape[:2]
        rows, columns = -(-height // size[0]), -(-width // size[1])
        whole = np.pad(drawn, ((0, rows * size[0] - height), (0, columns * size[1] - width), (0, 0)), "edge")
        blocks = whole.reshape(rows, size[0], columns, size[1], 2).transpose(0, 2, 1, 3, 4)
        corners = blocks[:, :, [0, 0, -1, -1], [0, -1, 0, -1]]  # (rows, columns, 4, 2)
        first, last = np.floor(corners.min(2)), np.ceil(corners.max(2))
        flat = blocks.reshape(rows, columns, -1, 2)
        low, high = np.floor(flat.min(2)) - _BEFORE, np.floor(flat.max(2)) + _AFTER
        padding = int(max((first - low).max(), (high - last).max(), 0))
        if padding <= _MOST_PADDING:
            across, down = (last - first).reshape(-1, 2).max(0) + 1 + 2 * padding
            return size, padding, (int(down), int(across))
    most = f"at most {_MOST_PADDING} pixels around their corners' positions"
    raise CameraFileError(path, "pixel padding", f"blocks of {size[1]}x{size[0]} must need {most}; got {padding}")
