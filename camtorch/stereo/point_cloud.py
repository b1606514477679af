"""Files of points in space: binary PLY, which every viewer reads."""

from __future__ import annotations

import os

import numpy as np
from torch import Tensor

from camtorch.io.writing import replacing

_ROW = np.dtype([(name, "<f4") for name in ("x", "y", "z")] + [(name, "u1") for name in ("red", "green", "blue")])


def write_ply(path: str | os.PathLike[str], points: Tensor, colours: Tensor) -> None:
    """Write points (N, 3) with colours (N, 3) uint8, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    rows = np.empty(len(points), _ROW)
    values = [*points.detach().float().cpu().numpy().T, *colours.cpu().numpy().T]
    for name, column in zip(_ROW.names or (), values, strict=True):
        rows[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    with replacing(path) as (file,):
        file.write("\n".join([*header, "end_header\n"]).encode())
        file.write(rows.tobytes())
