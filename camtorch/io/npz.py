"""NumPy archives (.npz) of matrices, as `numpy.savez(path, K=K, D=D)` writes them; pickled objects are not read."""

from __future__ import annotations

import contextlib
import io
import os
import zipfile
import zlib
from typing import Any

import numpy as np

from camtorch.io._errors import CameraFileError

_MOST_ARRAYS = 1000
_SIZES = ("image_size", "imagesize", "img_size", "imgsize", "size", "resolution")
_LARGEST_ARRAY = 1 << 16  # bytes; that of a camera has 14 numbers


def arrays_of(content: bytes, largest: int) -> dict[str, np.ndarray | None]:
    """Return arrays of numbers by their names; None for damaged or larger ones, and for objects.

    A damaged archive raises BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError, NotImplementedError.
    """
    if content.count(b"PK\1\2") > _MOST_ARRAYS:
        raise ValueError(f"more than {_MOST_ARRAYS} arrays")
    arrays: dict[str, np.ndarray | None] = {}
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            array = None
            if entry.file_size <= largest:
                with archive.open(entry) as file, contextlib.suppress(ValueError, MemoryError):
                    array = np.lib.format.read_array(file, allow_pickle=False)
            arrays[name] = array if array is not None and array.dtype.kind in "fiub" else None
    return arrays


def parse_archive(path: str | os.PathLike[str], content: bytes) -> dict[str, Any]:
    """Return the keys of an archive, arrays as lists; refuse damaged ones, and sizes whose order is not known."""
    try:
        arrays = arrays_of(content, _LARGEST_ARRAY)
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError, NotImplementedError) as error:
        raise CameraFileError(path, "content", f"no archive of NumPy's: {error}") from None
    keys = {name: None if array is None else array.astype(np.float64).tolist() for name, array in arrays.items()}
    for name, value in keys.items():
        if name.lower() in _SIZES and isinstance(value, list) and len(value) == 2 and value[0] != value[1]:
            either = f"{value[0]:g} {value[1]:g} may be (width, height) or (height, width)"
            raise CameraFileError(path, name, f"{either}; save image_width and image_height")
    return keys
