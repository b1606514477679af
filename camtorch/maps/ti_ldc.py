"""Meshes of TI's lens distortion correction, the LDC of the VPAC in TDA4 and AM6xA.

At every 2^m-th pixel of the target, ceil(W / 2^m) + 1 in each of ceil(H / 2^m) + 1 lines, source minus target: x and y
as signed 16-bit eighths of a pixel, interleaved, little-endian, lines filled up to 16 bytes. The hardware interpolates
bilinearly and draws positions in to the image.

It makes the target block by block, and fetches for each the part of the source around what the block's corners say,
with a padding that software has to state so that all pixels of the block find what they need. Both are reported: the
largest of the usual block sizes whose padding the register holds, or that asked for, and the padding, for the bicubic
filter. Widths of blocks are multiples of 8, heights even.

Technical reference manuals, e.g. SPRUJ28, "LDC Lens Distortion Back-Mapping" and "LDC Input Block Fetch".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from camtorch.io._errors import CameraFileError
from camtorch.maps.exact import Exact, Floats
from camtorch.maps.mesh import Mesh, held, rounded
from camtorch.maps.protocol import Options
from camtorch.maps.tables import Table, table

_PARTS = 8
_LOW, _HIGH = -(1 << 15), (1 << 15) - 1
_ALIGNED = 16  # bytes
_LARGEST = 8192  # pixels along a side
_BLOCKS = ((64, 64), (32, 64), (32, 32), (16, 32), (16, 16), (8, 16), (8, 8), (4, 8), (2, 8))  # height, width
_MOST_PADDING = 15  # four bits
_BEFORE, _AFTER = 1, 2  # pixels beside the whole part of a position that a bicubic filter reads
_LONGEST_BLOCK = 255  # eight bits


class TILDC(Table):
    """The format: see the module."""

    name = "ti_ldc"
    options: tuple[str, ...] = ("step", "block", "clip")
    step = 8
    steps: Sequence[int] = tuple(1 << m for m in range(8))

    def pack(self, path: str, mesh: Mesh, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        """Raises CameraFileError: sizes, offsets or padding that the LDC does not take. ValueError: a bad block."""
        block = options.block
        if block is not None and (block[1] % 8 or block[0] % 2 or not all(0 < s <= _LONGEST_BLOCK for s in block)):
            raise ValueError(
                "Warp.save: block=(height, width) must be of an even height and a width that is a multiple of 8, each "
                f"at most {_LONGEST_BLOCK}; got {block}"
            )
        if max(*exact.source_size, *exact.target_size) > _LARGEST:
            raise CameraFileError(path, "size", f"a side above {_LARGEST} px, which the LDC does not take")
        places = np.stack(np.meshgrid(mesh.columns, mesh.rows), -1)
        limits = places + _LOW / _PARTS, places + _HIGH / _PARTS
        mesh = held(path, self.name, mesh, *limits, clip=bool(options.clip))
        parts = rounded(mesh, exact, _PARTS, *limits)
        pitch = _pitch(len(mesh.columns))
        lines = np.zeros((len(mesh.rows), pitch // 2), "<i2")
        lines[:, : 2 * len(mesh.columns)] = (parts - places * _PARTS).reshape(len(mesh.rows), -1)
        positions = replace(mesh, nodes=parts / _PARTS).positions(exact.target_size)
        size, padding, largest = _fetched(path, positions, exact.source_size, block)
        facts = {"line_offset": pitch, "block_size": size, "pixel_padding": padding, "source_block": largest}
        return lines.tobytes(), facts

    def unpack(self, content: bytes, columns: Floats, rows: Floats, given: Options) -> tuple[Floats, dict[str, Any]]:
        lines = table(content, "<i2", (len(rows), _pitch(len(columns)) // 2))
        offsets = lines[:, : 2 * len(columns)].reshape(len(rows), len(columns), 2) / _PARTS
        return np.stack(np.meshgrid(columns, rows), -1) + offsets, {}


def _pitch(columns: int) -> int:
    """Bytes from line to line."""
    return -(-4 * columns // _ALIGNED) * _ALIGNED


def _fetched(
    path: str, positions: Floats, source: tuple[int, int], block: tuple[int, int] | None
) -> tuple[tuple[int, int], int, tuple[int, int]]:
    """The size of a block of the target, the padding that it needs, and the largest part of the source fetched.

    Raises:
        CameraFileError: more padding than the hardware has.
    """
    drawn = positions.clip(0, np.array(source[::-1], np.float64) - 1)
    padding = -1
    for size in _BLOCKS if block is None else (block,):
        padding, largest = _padding(drawn, size)
        if padding <= _MOST_PADDING:
            return size, padding, largest
    size = _BLOCKS[-1] if block is None else block
    raise CameraFileError(
        path,
        "pixel padding",
        f"blocks of {size[1]}x{size[0]} need {padding} pixels of the source around what their corners say; the LDC has "
        f"at most {_MOST_PADDING}{'' if block is None else '; smaller blocks need less'}",
    )


def _padding(drawn: Floats, size: tuple[int, int]) -> tuple[int, tuple[int, int]]:
    """The padding of blocks (height, width), and the largest part of the source fetched with it, (height, width)."""
    height, width = drawn.shape[:2]
    rows, columns = -(-height // size[0]), -(-width // size[1])
    whole = np.pad(drawn, ((0, rows * size[0] - height), (0, columns * size[1] - width), (0, 0)), "edge")
    blocks = whole.reshape(rows, size[0], columns, size[1], 2).transpose(0, 2, 1, 3, 4)
    corners = blocks[:, :, [0, 0, -1, -1], [0, -1, 0, -1]]  # (rows, columns, 4, 2)
    first, last = np.floor(corners.min(2)), np.ceil(corners.max(2))
    flat = blocks.reshape(rows, columns, -1, 2)
    low, high = np.floor(flat.min(2)) - _BEFORE, np.floor(flat.max(2)) + _AFTER
    padding = int(max((first - low).max(), (high - last).max(), 0))
    across, down = (last - first).reshape(-1, 2).max(0) + 1 + 2 * padding
    return padding, (int(down), int(across))
