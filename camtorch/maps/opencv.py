"""Maps of `cv2.remap`: float, or fixed-point as `cv2.convertMaps` makes them; FileStorage (.yml) and .npz.

The keys are `map1` and `map2`, what `cv2.remap(image, map1, map2, ...)` takes, and `source_height`, `source_width`.
Float maps are two CV_32FC1, x and y of the source. Fixed-point ones are CV_16SC2, the whole parts of x and y, and
CV_16UC1, the rest in thirty-seconds, five bits of y above five of x. Integers are pixel centres, as here.

Pixels without a position get -32768, which `cv2.remap` fills by BORDER_CONSTANT.
"""

import base64
import io
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from camtorch.io.parsing import arrays_of
from camtorch.io.record import CameraFileError
from camtorch.maps.lookup import Exact, LookupMap
from camtorch.maps.protocol import MOST_PIXELS, SIZES, MapFormat, checked

_NOWHERE = -32768
_LONGEST_SIDE = 32766  # pixels: cv2.remap needs sides below SHRT_MAX
_PARTS = 32  # of a pixel
_LARGEST_ARRAY = 8 * MOST_PIXELS
# matrices in YAML, with their data in base64
_TYPES = {"f": "<f4", "d": "<f8", "s": "<i2", "w": "<u2", "i": "<i4", "u": "u1"}
_LETTERS = {np.dtype(code): letter for letter, code in _TYPES.items()}
_HEADER = 24  # bytes before the data in base64, which repeat the type
_LINE = 76  # characters of base64 in a line


class OpenCV(MapFormat):
    """The formats of cv2.remap; see the module. "opencv_fixed" is in fixed point."""

    suffixes: tuple[str, ...] = (".yml", ".yaml", ".npz")

    def __init__(self, name: str):
        self.name = name

    def encode(self, path: str, exact: Exact, options: Mapping[str, Any]) -> tuple[bytes, dict[str, Any]]:
        sides = (*exact.source_size, *exact.target_size)
        if max(sides) > _LONGEST_SIDE:
            raise CameraFileError(
                path, "size", f"sides must be at most {_LONGEST_SIDE} px for cv2.remap; got {max(sides)}"
            )
        positions = exact.positions.clip(_NOWHERE, -_NOWHERE - 1)
        positions[~exact.mapped] = _NOWHERE
        if self.name == "opencv_fixed":
            parts = np.rint(positions * _PARTS).astype(np.int32)
            whole, rest = parts >> 5, (parts & (_PARTS - 1)).astype(np.uint16)
            maps = {"map1": whole.astype("<i2"), "map2": (rest[..., 1] * _PARTS + rest[..., 0]).astype("<u2")}
        else:
            maps = {name: positions[..., i].astype("<f4") for i, name in enumerate(("map1", "map2"))}
        arrays = {**maps, **{name: np.array(side) for name, side in zip(SIZES[:2], exact.source_size, strict=True)}}
        if not path.lower().endswith(".npz"):
            return _as_yaml(arrays), {}
        file = io.BytesIO()
        np.savez(file, **arrays)
        return file.getvalue(), {}

    def matches(self, path: str, content: bytes) -> bool:
        """Whether a content is such a file; see `MapFormat`. The types of the matrices decide between both."""
        return content.startswith((b"PK\3\4", b"%YAML"))

    def decode(self, content: bytes, described: Mapping[str, Any]) -> LookupMap:
        found = arrays_of(content, _LARGEST_ARRAY) if content.startswith(b"PK") else _from_yaml(content)
        arrays = {name: array for name, array in found.items() if array is not None}
        first, second = arrays["map1"], arrays["map2"]
        is_fixed = first.dtype == np.int16
        if is_fixed:
            rest = second.astype(np.uint16).astype(np.int64)
            positions = first + np.stack((rest % _PARTS, rest // _PARTS % _PARTS), -1) / _PARTS
        else:
            positions = np.stack((first, second), -1).astype(np.float64)
        if positions.ndim != 3 or not positions.size or positions.shape[-1] != 2:
            raise ValueError(f"must be cv2.remap's; got {first.dtype} {first.shape} and {second.dtype} {second.shape}")
        positions[(positions <= _NOWHERE).any(-1) | ~np.isfinite(positions).all(-1)] = np.nan
        size = checked("source_size", [int(arrays[key]) for key in SIZES[:2]])
        return LookupMap(torch.from_numpy(positions), size, "opencv_fixed" if is_fixed else "opencv", {})


def _as_yaml(arrays: dict[str, np.ndarray]) -> bytes:
    """Return a file for `cv2.FileStorage`: matrices as written with WRITE_BASE64, and whole numbers."""
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


def _from_yaml(content: bytes) -> dict[str, np.ndarray]:
    """Return the matrices of a file, (rows, columns[, channels]), and the whole numbers; raise if it is damaged."""
    arrays = {found[1].decode(): np.array(int(found[2])) for found in _NUMBER.finditer(content)}
    for found in _MATRIX.finditer(content):
        end = _END.search(content, found.end())
        data = base64.b64decode(b"".join(content[found.end() : end and end.start()].split()), validate=True)
        values = np.frombuffer(data, _TYPES[found[5].decode()], offset=_HEADER)
        channels = (int(found[4]),) if found[4] else ()
        arrays[found[1].decode()] = values.reshape(int(found[2]), int(found[3]), *channels)
    return arrays
