"""NumPy archives (.npz) of matrices, as `numpy.savez(path, K=K, D=D)` writes them; pickled objects are not read."""

from __future__ import annotations

import io
import math
import os
import zipfile
import zlib
from typing import Any

import numpy as np

from camtorch.io._errors import CameraFileError

_MOST_ARRAYS = 1000
_SIZES = ("image_size", "imagesize", "img_size", "imgsize", "size", "resolution")
_LARGEST_ARRAY = 1 << 16  # bytes; that of a camera has 14 numbers


def parse_archive(path: str | os.PathLike[str], content: bytes) -> dict[str, Any]:
    """The keys of an archive, as `camtorch.io.parsing.parse_mapping`: arrays as lists, single numbers as text.

    Arrays that no camera has, large ones or those of objects, are None.

    Raises:
        CameraFileError: another archive, a damaged one, or one of very many arrays.
    """
    if content.count(b"PK\1\2") > _MOST_ARRAYS:
        raise CameraFileError(path, "content", f"more than {_MOST_ARRAYS} arrays")
    keys: dict[str, Any] = {}
    name = "content"
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for entry in archive.infolist():
                name = entry.filename.removesuffix(".npy")
                if name == entry.filename:
                    raise ValueError("the files of numpy.savez end in .npy")
                with archive.open(entry) as file:
                    keys[name] = _values(file.read(_LARGEST_ARRAY + 1))
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError, NotImplementedError) as error:
        place = name if name.isprintable() and len(name) <= 60 else f"{name!r:.60}"
        raise CameraFileError(path, place, f"no array of NumPy's: {error}") from None
    for name, value in keys.items():
        if name.lower() in _SIZES and isinstance(value, list) and len(set(value)) == 2:
            raise CameraFileError(
                path,
                name,
                f"{' '.join(value)} may be (width, height) or (height, width); save image_width and image_height",
            )
    return keys


def _values(content: bytes) -> Any:
    """What an array says, or None."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if len(content) > _LARGEST_ARRAY or dtype.kind not in "fiub" or len(shape) > 4:
        return None
    if math.prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError("not as much data as it says")
    file.seek(0)
    return _texts(np.lib.format.read_array(file, allow_pickle=False).tolist())


def _texts(value: Any) -> Any:
    return [_texts(item) for item in value] if isinstance(value, list) else repr(value)
