"""STMaps: images of float whose red is u and whose green is v of the source, as Nuke, Resolve and others take them.

u and v run from 0 to 1 from edge to edge, pixel i's centre is at (i + 0.5) / size. v runs upward, as Nuke has it,
unless v="down" is asked for. Blue is 0. Pixels without a position have u = v = -1. The file says which way v runs and
the size of the source, as attributes (EXR) or in its description (TIFF). EXR by OpenEXR, TIFF by tifffile: the extra
`maps`.
"""

from __future__ import annotations

import io
import json
import math
import os
import tempfile
from typing import Any

import numpy as np
import torch

from camtorch._arguments import shown
from camtorch.io.exr import as_exr, needed
from camtorch.maps.exact import Exact
from camtorch.maps.lookup import LookupMap
from camtorch.maps.protocol import MOST_PIXELS, SIZES, MapFormat, Options, checked

_WAYS = ("up", "down")
_KEYS = ("v", *SIZES[:2])
_PREFIX = "camtorch_"  # of attributes of an EXR
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_MOST_CHANNELS = 4  # of the largest map
_EXR = b"\x76\x2f\x31\x01"


class STMap(MapFormat):
    """The format: see the module."""

    name = "stmap"
    suffixes: tuple[str, ...] = (".exr", ".tif", ".tiff")
    options: tuple[str, ...] = ("v",)

    def encode(self, path: str, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        way = "up" if options.v is None else options.v
        if way not in _WAYS:
            raise ValueError(f"Warp.save: v must be 'up' (as Nuke has it) or 'down'; got {shown(way)}")
        height, width = exact.source_size
        parts = (exact.positions + 0.5) / (width, height)
        if way == "up":
            parts[..., 1] = 1 - parts[..., 1]
        pixels = np.zeros((*exact.target_size, 3), np.float32)
        pixels[..., :2] = np.where(exact.mapped[..., None], parts, -1.0)
        facts = {"v": way, "source_height": height, "source_width": width}
        return (_as_exr if path.lower().endswith(".exr") else _as_tiff)(pixels, facts), {"v": way}

    def matches(self, path: str, content: bytes) -> bool:
        return content.startswith((_EXR, *_TIFF))

    def decode(self, content: bytes, given: Options) -> LookupMap:
        pixels, stated = (_from_exr if content.startswith(_EXR) else _from_tiff)(content)
        if any(plane.ndim != 2 or plane.dtype.kind != "f" or not plane.size for plane in pixels):
            raise ValueError("red and green are not float")
        way, *sides = (stated[key] for key in _KEYS)
        size = checked("source_size", sides)
        parts = np.stack(pixels, -1).astype(np.float64)
        nowhere = (parts == -1).all(-1) | ~np.isfinite(parts).all(-1)
        if way == "up":
            parts[..., 1] = 1 - parts[..., 1]
        positions = parts * (size[1], size[0]) - 0.5
        positions[nowhere] = np.nan
        return LookupMap(torch.from_numpy(positions), size, self.name, {"v": way})


def _as_exr(pixels: np.ndarray, facts: dict[str, Any]) -> bytes:
    return as_exr(pixels, {_PREFIX + key: value for key, value in facts.items()})


def _from_exr(content: bytes) -> tuple[list[np.ndarray], dict[str, Any]]:
    openexr = needed("OpenEXR", "EXR")
    with tempfile.TemporaryDirectory() as folder:
        file = os.path.join(folder, "map.exr")
        with open(file, "wb") as copy:
            copy.write(content)
        header = openexr.File(file, header_only=True).parts[0].header
        (left, top), (right, bottom) = header["dataWindow"]
        _check_size((int(right) - int(left) + 1) * (int(bottom) - int(top) + 1) * len(header["channels"]))
        with openexr.File(file, separate_channels=True) as image:
            if not image.parts:
                raise ValueError("cut off, or its pixels are damaged")
            channels = image.parts[0].channels
            planes = [np.array(channels[name].pixels) for name in "RG"]
    found = {key: header[_PREFIX + key] for key in _KEYS if _PREFIX + key in header}
    return planes, {key: value for key, value in found.items() if isinstance(value, (str, int))}


def _check_size(count: int) -> None:
    if count > _MOST_CHANNELS * MOST_PIXELS:
        raise ValueError(f"{count} numbers")


def _as_tiff(pixels: np.ndarray, facts: dict[str, Any]) -> bytes:
    tifffile = needed("tifffile", "TIFF")
    file = io.BytesIO()
    tifffile.imwrite(file, pixels, photometric="rgb", description=json.dumps(facts), metadata=None, software="camtorch")
    return file.getvalue()


def _from_tiff(content: bytes) -> tuple[list[np.ndarray], dict[str, Any]]:
    tifffile = needed("tifffile", "TIFF")
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        page = file.pages[0]
        _check_size(math.prod(page.shape))
        pixels, stated = page.asarray(), json.loads(page.description)
    return [pixels[..., 0], pixels[..., 1]], stated
