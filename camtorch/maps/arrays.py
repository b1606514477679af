"""Matrices of `cv2.FileStorage` in map files: YAML with its data in base64."""

from __future__ import annotations

import base64
import re

import numpy as np

Arrays = dict[str, np.ndarray]

_TYPES = {"f": "<f4", "d": "<f8", "s": "<i2", "w": "<u2", "i": "<i4", "u": "u1"}
_LETTERS = {np.dtype(code): letter for letter, code in _TYPES.items()}
_HEADER = 24  # bytes before the data in base64, which say the type once more
_LINE = 76  # characters of base64 in a line


def as_storage(arrays: Arrays) -> bytes:
    """Return what `cv2.FileStorage` reads: matrices as it writes them with WRITE_BASE64, and whole numbers."""
    parts = [b"%YAML:1.0\n---\n"]
    for key, value in arrays.items():
        if value.ndim == 0:
            parts.append(f"{key}: {value}\n".encode())
            continue
        rows, columns, channels = value.shape if value.ndim == 3 else (*value.shape, 1)
        letter = _LETTERS[value.dtype]
        dt = letter if channels == 1 else f'"{channels}{letter}"'
        text = base64.b64encode(f"{channels}{letter}".ljust(_HEADER).encode() + np.ascontiguousarray(value).tobytes())
        parts.append(f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: {dt}\n".encode())
        parts.append(b"   data: !!binary |\n")
        parts += [b"    %b\n" % text[i : i + _LINE] for i in range(0, len(text), _LINE)]
    return b"".join(parts)


_MATRIX = re.compile(
    rb'^([\w.-]{1,99}): !!opencv-matrix\s{1,9}rows: (\d{1,9})\s{1,9}cols: (\d{1,9})\s{1,9}dt: "?(\d{0,3})([a-z])"?'
    rb"\s{1,9}data: !!binary \|",
    re.MULTILINE,
)
_NUMBER = re.compile(rb"^([\w.-]{1,99}): (\d{1,9})\s*$", re.MULTILINE)
_END = re.compile(rb"^\S|\Z", re.MULTILINE)


def from_storage(content: bytes) -> Arrays:
    """Return the matrices of such a file, (rows, columns[, channels]), and the whole numbers; raise if damaged."""
    arrays = {found[1].decode(): np.array(int(found[2])) for found in _NUMBER.finditer(content)}
    for found in _MATRIX.finditer(content):
        end = _END.search(content, found.end())
        data = base64.b64decode(b"".join(content[found.end() : end and end.start()].split()), validate=True)
        values = np.frombuffer(data, _TYPES[found[5].decode()], offset=_HEADER)
        channels = (int(found[4]),) if found[4] else ()
        arrays[found[1].decode()] = values.reshape(int(found[2]), int(found[3]), *channels)
    return arrays
