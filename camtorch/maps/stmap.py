"""STMaps: images of float whose red is u and whose green is v of the source, as Nuke, Resolve and others take them.

u and v run from 0 to 1 from edge to edge, pixel i's centre is at (i + 0.5) / size. v runs upward, as Nuke has it,
unless v="down" is asked for. Blue is 0. Pixels without a position have u = v = -1. The file says which way v runs and
the size of the source, as attributes (EXR) or in its description (TIFF). EXR by OpenEXR, TIFF by tifffile: the extra
`maps`.
"""

from __future__ import annotations

import io
import json
import os
import tempfile
from types import ModuleType
from typing import Any

import numpy as np
import torch

from camtorch._arguments import shown
from camtorch.io._errors import CameraFileError
from camtorch.maps.exact import Exact
from camtorch.maps.lookup import LookupMap
from camtorch.maps.protocol import MOST_PIXELS, SIZES, Encoded, Given, Options, checked, suffix_of

_WAYS = ("up", "down")
_KEYS = ("v", *SIZES[:2])
_PREFIX = "camtorch_"  # of attributes of an EXR
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_MOST_CHANNELS = 4  # of the largest map
_EXR = b"\x76\x2f\x31\x01"


class STMap:
    """The format: see the module."""

    name = "stmap"
    suffixes: tuple[str, ...] = (".exr", ".tif", ".tiff")
    options: tuple[str, ...] = ("v",)
    described = False

    def encode(self, path: str, exact: Exact, options: Options) -> Encoded:
        """Raises ValueError: a way that v does not run, or another suffix. ImportError: the extra is missing."""
        suffix = suffix_of(path, self)
        way = _way("up" if options.v is None else options.v)
        height, width = exact.source_size
        parts = (exact.positions + 0.5) / (width, height)
        if way == "up":
            parts[..., 1] = 1 - parts[..., 1]
        pixels = np.zeros((*exact.target_size, 3), np.float32)
        pixels[..., :2] = np.where(exact.mapped[..., None], parts, -1.0)
        facts = {"v": way, "source_height": height, "source_width": width}
        return Encoded((_as_exr if suffix == ".exr" else _as_tiff)(pixels, facts), {"v": way})

    def matches(self, path: str, content: bytes) -> bool:
        return content.startswith((_EXR, *_TIFF))

    def decode(self, path: str, content: bytes, given: Given) -> LookupMap:
        """Raises CameraFileError: damaged, no float image, no size of the source. ImportError: the extra is missing."""
        read = _from_exr if content.startswith(_EXR) else _from_tiff
        pixels, stated = read(path, content)
        way = stated.get("v", given.v or "up")
        if way not in _WAYS or (given.v is not None and given.v != way):
            raise CameraFileError(path, "v", f"runs {way!r}, and was said to run {given.v!r}")
        says = all(key in stated for key in _KEYS[1:])
        size = checked(path, "source_size", [stated[key] for key in _KEYS[1:]] if says else given.source_size)
        parts = pixels[..., :2].astype(np.float64)
        nowhere = (parts == -1).all(-1) | ~np.isfinite(parts).all(-1)
        if way == "up":
            parts[..., 1] = 1 - parts[..., 1]
        positions = parts * (size[1], size[0]) - 0.5
        positions[nowhere] = np.nan
        return LookupMap(torch.from_numpy(positions), size, self.name, {"v": way})


def _way(v: str) -> str:
    if not isinstance(v, str) or v not in _WAYS:
        raise ValueError(f"Warp.save: v must be 'up' (as Nuke has it) or 'down'; got {shown(v)}")
    return v


def _needed(name: str, package: str) -> ModuleType:
    try:
        return __import__(name)
    except ImportError:
        raise ImportError(f'STMaps need {package}: pip install "camtorch[maps]"') from None


def _as_exr(pixels: np.ndarray, facts: dict[str, Any]) -> bytes:
    openexr = _needed("OpenEXR", "OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    header |= {_PREFIX + key: value for key, value in facts.items()}
    planes = {channel: np.ascontiguousarray(pixels[..., i]) for i, channel in enumerate("RGB")}
    with tempfile.TemporaryDirectory() as folder:  # it writes to names alone
        file = os.path.join(folder, "map.exr")
        openexr.File(header, planes).write(file)
        with open(file, "rb") as written:
            return written.read()


def _from_exr(path: str, content: bytes) -> tuple[np.ndarray, dict[str, Any]]:
    openexr = _needed("OpenEXR", "OpenEXR")
    with tempfile.TemporaryDirectory() as folder:
        file = os.path.join(folder, "map.exr")
        with open(file, "wb") as copy:
            copy.write(content)
        try:
            header = openexr.File(file, header_only=True).parts[0].header
            (left, top), (right, bottom) = header["dataWindow"]
            pixels = (int(right) - int(left) + 1) * (int(bottom) - int(top) + 1)
            if pixels * len(header["channels"]) > _MOST_CHANNELS * MOST_PIXELS:
                raise ValueError(f"{len(header['channels'])} channels of {pixels} pixels")
            with openexr.File(file, separate_channels=True) as image:
                if not image.parts:
                    raise ValueError("cut off, or its pixels are damaged")
                channels = image.parts[0].channels
                planes = [np.array(channels[name].pixels) for name in "RG"]
            found = {key: header[_PREFIX + key] for key in _KEYS if _PREFIX + key in header}
            stated = {key: value for key, value in found.items() if isinstance(value, (str, int))}
        except Exception as error:  # whatever its C++ raises
            raise CameraFileError(path, "content", f"no EXR with red and green: {error}") from None
    if any(plane.ndim != 2 or plane.dtype.kind != "f" or plane.shape != planes[0].shape for plane in planes):
        raise CameraFileError(path, "content", "red and green are not float, or not of one size")
    return np.stack(planes, -1), stated


def _as_tiff(pixels: np.ndarray, facts: dict[str, Any]) -> bytes:
    tifffile = _needed("tifffile", "tifffile")
    file = io.BytesIO()
    tifffile.imwrite(file, pixels, photometric="rgb", description=json.dumps(facts), metadata=None, software="camtorch")
    return file.getvalue()


def _from_tiff(path: str, content: bytes) -> tuple[np.ndarray, dict[str, Any]]:
    tifffile = _needed("tifffile", "tifffile")
    try:
        with tifffile.TiffFile(io.BytesIO(content)) as file:
            page = file.pages[0]
            if len(page.shape) != 3 or np.prod(page.shape, dtype=object) > _MOST_CHANNELS * MOST_PIXELS:
                raise ValueError(f"{page.dtype} of shape {page.shape}")
            pixels, text = page.asarray(), page.description
            if page.axes.startswith("S"):  # planes one after the other
                pixels = np.moveaxis(pixels, 0, -1)
            if pixels.ndim != 3 or pixels.shape[2] < 2 or not pixels.size or pixels.dtype.kind != "f":
                raise ValueError(f"{pixels.dtype} of shape {pixels.shape}")
    except Exception as error:  # whatever a damaged file makes of its tags
        raise CameraFileError(path, "content", f"no TIFF of float with red and green: {error}") from None
    try:
        stated = json.loads(text)
    except (ValueError, RecursionError):
        stated = None
    return pixels, stated if isinstance(stated, dict) else {}
