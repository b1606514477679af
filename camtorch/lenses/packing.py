"""The collection as a file of the package: the numbers' own bits, columns side by side, a third smaller than as text.

`python camtorch/lenses/packing.py gyroflow.csv.gz camtorch/lenses/gyroflow.npz` made it.
"""

from __future__ import annotations

import csv
import gzip
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

TEXTS = "brand", "camera", "lens", "setting", "width", "height", "readout_ms", "h_stretch", "v_stretch", "digital_lens"
"""Columns that are kept as text, among them numbers that repeat or are missing."""
NUMBERS = "fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "rms_px"
"""Columns of doubles, whose low bits are noise that nothing makes smaller."""


def pack(table: Path, path: Path) -> None:
    """Write a file of the package from a table (.csv.gz) that has the columns `TEXTS` and `NUMBERS`."""
    with gzip.open(table, "rt", encoding="utf-8", newline="") as lines:
        rows = list(csv.DictReader(lines))
    text = "\0".join(row[name] for name in TEXTS for row in rows)
    texts = {name: [row[name] for row in rows] for name in TEXTS}
    bits = np.array([[float(row[name]) for row in rows] for name in NUMBERS]).view(np.int64)
    steps = bits - _expected(bits, texts)
    # the sign as the lowest bit: numbers near zero then begin with zeros
    codes = ((steps << 1) ^ (steps >> 63)).astype("<i8")
    planes = codes[..., None].view(np.uint8).transpose(0, 2, 1)
    np.savez_compressed(path, text=np.frombuffer(text.encode(), np.uint8), planes=planes)


def unpack(path: Path) -> tuple[dict[str, list[str]], NDArray[np.float64]]:
    """The columns of text by their names, and those of numbers (9, N)."""
    with np.load(path) as file:
        text, planes = file["text"].tobytes().decode(), file["planes"]
    lines, count = text.split("\0"), planes.shape[-1]
    texts = {name: lines[i * count : (i + 1) * count] for i, name in enumerate(TEXTS)}
    codes = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<i8")[..., 0].astype(np.int64)
    bits = ((codes >> 1) & np.int64(2**63 - 1)) ^ -(codes & 1)
    for i in range(len(NUMBERS)):  # one after the other: fy is told by fx
        bits[i] += _expected(bits, texts)[i]
    return texts, bits.view(np.float64)


def _expected(bits: NDArray[np.int64], texts: dict[str, list[str]]) -> NDArray[np.int64]:
    """What numbers are near to, as bits: fy to fx, the principal point to the image's middle."""
    near = np.zeros_like(bits)
    near[1] = bits[0]
    for i, side in ((2, "width"), (3, "height")):
        near[i] = (np.array([float(text) for text in texts[side]]) / 2).view(np.int64)
    return near


if __name__ == "__main__":
    pack(Path(sys.argv[1]), Path(sys.argv[2]))
