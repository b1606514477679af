"""The collection as a file of the package: the numbers' own bits, columns side by side, a third smaller than as text.

Text is compressed by LZMA, a seventh smaller than by Deflate; for the numbers, whose low bits are noise, it gains
nothing and takes longer to read. fy is kept as its difference to fx, the principal point to the image's middle, each
with its sign as the lowest bit, and the bytes of a column one plane after another.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

TEXTS = "brand", "camera", "lens", "setting", "width", "height", "readout_ms", "h_stretch", "v_stretch", "digital_lens"
"""Columns that are kept as text, among them numbers that repeat or are missing."""
NUMBERS = "fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "rms_px"
"""Columns of doubles, whose low bits are noise that nothing makes smaller."""


def unpack(path: Path) -> tuple[dict[str, list[str]], NDArray[np.float64]]:
    """The columns of text by their names, and those of numbers (9, N)."""
    with np.load(path) as file:
        text, planes = file["text"].tobytes().decode(), file["planes"]
    lines, count = text.split("\0"), planes.shape[-1]
    texts = {name: lines[i * count : (i + 1) * count] for i, name in enumerate(TEXTS)}
    codes = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<i8")[..., 0].astype(np.int64)
    bits = ((codes >> 1) & np.int64(2**63 - 1)) ^ -(codes & 1)
    bits[1] += bits[0]
    bits[2:4] += _middles(texts)
    return texts, bits.view(np.float64)


def _middles(texts: dict[str, list[str]]) -> NDArray[np.int64]:
    """The bits of the middles of the images, which principal points are near to."""
    return (np.array([texts[side] for side in ("width", "height")], float) / 2).view(np.int64)
