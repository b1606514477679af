"""Maps of `cv2.remap`: float, or fixed-point as `cv2.convertMaps` makes them; FileStorage (.yml, .xml) and .npz.

The keys are `map1` and `map2`, what `cv2.remap(image, map1, map2, ...)` takes, and `source_height`, `source_width`.
Float maps are two CV_32FC1, x and y of the source. Fixed-point ones are CV_16SC2, the whole parts of x and y, and
CV_16UC1, the rest in thirty-seconds, five bits of y above five of x. Integers are pixel centres, as here.

Pixels without a position get -32768, which `cv2.remap` fills by BORDER_CONSTANT.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from camtorch.io._errors import CameraFileError
from camtorch.maps.arrays import Arrays, as_archive, as_storage, from_archive, from_storage
from camtorch.maps.exact import Exact, Floats
from camtorch.maps.lookup import LookupMap
from camtorch.maps.protocol import MOST_PIXELS, SIZES, MapFormat, Options, checked

_NOWHERE = -32768
_LONGEST = 32766  # pixels: cv2.remap wants sides below SHRT_MAX
_PARTS = 32  # of a pixel
_PAIRS = (("map1", "map2"), ("map_x", "map_y"), ("mapx", "mapy"), ("mapX", "mapY"), ("map1x", "map1y"), ("x", "y"))


class OpenCV(MapFormat):
    """The formats: see the module. "opencv_fixed" is in fixed point."""

    suffixes: tuple[str, ...] = (".yml", ".yaml", ".xml", ".npz")

    def __init__(self, name: str):
        self.name = name

    def encode(self, path: str, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        sides = (*exact.source_size, *exact.target_size)
        if max(sides) > _LONGEST:
            raise CameraFileError(path, "size", f"a side of {max(sides)} px; cv2.remap takes at most {_LONGEST}")
        positions = exact.positions.clip(_NOWHERE, -_NOWHERE - 1)
        positions[~exact.mapped] = _NOWHERE
        if self.name == "opencv_fixed":
            parts = np.rint(positions * _PARTS).astype(np.int32)
            whole, rest = parts >> 5, (parts & (_PARTS - 1)).astype(np.uint16)
            maps = {"map1": whole.astype("<i2"), "map2": (rest[..., 1] * _PARTS + rest[..., 0]).astype("<u2")}
        else:
            maps = {name: positions[..., i].astype("<f4") for i, name in enumerate(("map1", "map2"))}
        keys = {**maps, **dict(zip(SIZES[:2], exact.source_size, strict=True))}
        if path.lower().endswith(".npz"):
            return as_archive(keys), {}
        return as_storage(keys, xml=path.lower().endswith(".xml")), {}

    def matches(self, path: str, content: bytes) -> bool:
        """See `MapFormat`. Which of the two it is the types of its matrices say."""
        return content[:100].lstrip().startswith((b"PK\3\4", b"%YAML", b"<?xml", b"<opencv_storage"))

    def decode(self, content: bytes, given: Options) -> LookupMap:
        arrays = from_archive(content) if content.startswith(b"PK") else from_storage(content)
        positions, fixed = _positions(arrays)
        positions[(positions <= _NOWHERE).any(-1) | ~np.isfinite(positions).all(-1)] = np.nan
        stated = [arrays[key].item() for key in SIZES[:2] if key in arrays and arrays[key].size == 1]
        size = checked("source_size", stated if len(stated) == 2 else given.source_size)
        return LookupMap(torch.from_numpy(positions), size, "opencv_fixed" if fixed else "opencv", {})


def _positions(arrays: Arrays) -> tuple[Floats, bool]:
    """(H', W', 2) of what `cv2.remap` takes, and whether that is fixed-point."""
    names = next((names for names in _PAIRS if names[0] in arrays), None)
    if names is None:
        raise ValueError(f"no map of that name; it has {', '.join(arrays) or 'nothing'}")
    first, second = arrays[names[0]], arrays.get(names[1])
    if first.size > 2 * MOST_PIXELS:
        raise ValueError(f"more than {MOST_PIXELS} pixels")
    if second is not None and second.size and second.shape != first.shape[:2]:
        raise ValueError(f"maps of shapes {first.shape} and {second.shape}")
    second = second if second is not None and second.size else None
    if first.size and first.dtype.kind == "f" and first.ndim == 2 and second is not None:
        return np.stack((first, second), -1).astype(np.float64), False
    if first.size and first.ndim == 3 and first.shape[2] == 2:
        if first.dtype.kind == "f":
            return first.astype(np.float64), False
        if first.dtype == np.int16 and second is None:
            return first.astype(np.float64), True
        if first.dtype == np.int16 and second is not None and second.dtype in (np.uint16, np.int16):
            rest = second.astype(np.int64)
            return first + np.stack((rest & (_PARTS - 1), rest // _PARTS & (_PARTS - 1)), -1) / _PARTS, True
    shapes = " and ".join(f"{a.dtype} {a.shape}" for a in (first, second) if a is not None)
    raise ValueError(f"no maps of cv2.remap: {shapes}")
