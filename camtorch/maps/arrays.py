"""Arrays in map files: archives of NumPy and matrices of `cv2.FileStorage`, never trusted."""

from __future__ import annotations

import base64
import io
import re
import zipfile
from typing import Any

import numpy as np

from camtorch.maps.protocol import MOST_PIXELS

Arrays = dict[str, np.ndarray]

_TYPES = {"f": "<f4", "d": "<f8", "s": "<i2", "w": "<u2", "i": "<i4", "u": "u1"}
_LETTERS = {np.dtype(code): letter for letter, code in _TYPES.items()}
_HEADER = 24  # bytes before the data in base64, which say the type once more
_LINE = 76  # characters of base64 in a line
_MOST_ARRAYS = 100
_MOST_NUMBERS = 2 * MOST_PIXELS
_MOST_BYTES = 8 * _MOST_NUMBERS + (1 << 20)


def as_archive(arrays: dict[str, Any]) -> bytes:
    """What `numpy.savez` writes."""
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def from_archive(content: bytes) -> Arrays:
    """The arrays of an archive; pickled objects are not read.

    Raises:
        ValueError: arrays of other than numbers, or too large ones; and whatever NumPy makes of a damaged archive.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
            raise ValueError(f"more than {_MOST_BYTES} bytes")
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays: Arrays = dict(file)
    if any(not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu" for array in arrays.values()):
        raise ValueError("arrays of other than numbers")
    return arrays


def as_storage(arrays: dict[str, Any], *, xml: bool) -> bytes:
    """What `cv2.FileStorage` reads: matrices in base64, as it writes them with WRITE_BASE64; and whole numbers."""
    parts = [b'<?xml version="1.0"?>\n<opencv_storage>\n' if xml else b"%YAML:1.0\n---\n"]
    for key, value in arrays.items():
        if isinstance(value, int):
            parts.append((f"<{key}>{value}</{key}>\n" if xml else f"{key}: {value}\n").encode())
            continue
        rows, columns, channels = value.shape if value.ndim == 3 else (*value.shape, 1)
        letter = _LETTERS[value.dtype]
        dt = letter if channels == 1 else f'"{channels}{letter}"'
        text = base64.b64encode(f"{channels}{letter}".ljust(_HEADER).encode() + np.ascontiguousarray(value).tobytes())
        lines = b"\n    ".join(text[i : i + _LINE] for i in range(0, len(text), _LINE))
        if xml:
            start = (
                f'<{key} type_id="opencv-matrix">\n  <rows>{rows}</rows>\n  <cols>{columns}</cols>\n  <dt>{dt}</dt>\n'
            )
            data, end = '  <data type_id="binary">\n    ', f"\n    </data></{key}>\n"
        else:
            start = f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: {dt}\n"
            data, end = "   data: !!binary |\n    ", "\n"
        parts += [(start + data).encode(), lines, end.encode()]
    return b"".join([*parts, b"</opencv_storage>\n" if xml else b""])


_YAML_MATRIX = re.compile(
    rb'^([\w.-]{1,99}): !!opencv-matrix\s{1,9}rows: (\d{1,9})\s{1,9}cols: (\d{1,9})\s{1,9}dt: "?(\d{0,3})([a-z])"?'
    rb"\s{1,9}data: (\[|!!binary \|)",
    re.MULTILINE,
)
_XML_MATRIX = re.compile(
    rb'<([\w.-]{1,99}) type_id="opencv-matrix">\s{0,9}<rows>(\d{1,9})</rows>\s{0,9}<cols>(\d{1,9})</cols>\s{0,9}'
    rb'<dt>"?(\d{0,3})([a-z])"?</dt>\s{0,9}<data( type_id="binary")?>'
)
_YAML_NUMBER = re.compile(rb"^([\w.-]{1,99}): (\d{1,9})\s*$", re.MULTILINE)
_XML_NUMBER = re.compile(rb"^<([\w.-]{1,99})>(\d{1,9})</[\w.-]{1,99}>\s*$", re.MULTILINE)
_YAML_END = re.compile(rb"^\S", re.MULTILINE)


def from_storage(content: bytes) -> Arrays:
    """The matrices of a YAML or XML file that `cv2.FileStorage` wrote, (rows, columns[, channels]), and whole numbers.

    Raises:
        ValueError: a matrix that is damaged, too large or of another type.
    """
    xml = content.lstrip()[:1] == b"<"
    arrays: Arrays = {}
    for found in (_XML_NUMBER if xml else _YAML_NUMBER).finditer(content):
        arrays[found[1].decode()] = np.array(int(found[2]))
    for count, found in enumerate((_XML_MATRIX if xml else _YAML_MATRIX).finditer(content)):
        name, letter = found[1].decode(), found[5].decode()
        rows, columns, channels = int(found[2]), int(found[3]), int(found[4] or 1)
        coded = found[6] is not None and found[6] != b"["
        if xml or not coded:
            end = content.find(b"</data>" if xml else b"]", found.end())
        else:
            following = _YAML_END.search(content, found.end())
            end = following.start() if following else len(content)
        what = f"{name}: {rows}x{columns} of type {channels}{letter}"
        if end < 0 or letter not in _TYPES or rows * columns * channels > _MOST_NUMBERS or count >= _MOST_ARRAYS:
            raise ValueError(f"{what} without an end, or too large")
        dtype, data = np.dtype(_TYPES[letter]), content[found.end() : end]
        try:
            if coded:
                values = np.frombuffer(base64.b64decode(b"".join(data.split()), validate=True), dtype, offset=_HEADER)
            else:
                values = _from_words(data, dtype)
            arrays[name] = values.reshape((rows, columns, channels) if channels > 1 else (rows, columns))
        except ValueError as error:
            raise ValueError(f"{what}: {error}") from None
    return arrays


def _from_words(data: bytes, dtype: np.dtype) -> np.ndarray:
    text = data.lower().replace(b",", b" ").replace(b".nan", b"nan").replace(b".inf", b"inf")
    values = np.array(text.split(), np.float64)
    if dtype.kind != "f":
        limits = np.iinfo(dtype)
        if not ((values >= limits.min) & (values <= limits.max) & (values == np.rint(values))).all():
            raise ValueError("not whole numbers of that type")
    return values.astype(dtype)
