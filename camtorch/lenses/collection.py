"""The collection of real lenses, searched by words; entries are read on first use.

Numbers in the file are exact, in columns; text is compressed by LZMA. fy is stored as its difference to
fx, the principal point relative to the image's middle, each with its sign as the lowest bit, and the bytes of a
column one plane after another.
"""

import difflib
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from camtorch.models import KannalaBrandt
from camtorch.values.arguments import GUESS_CAMERA, as_image_size

_FILE = Path(__file__).with_name("gyroflow.npz")
_TEXTS = "brand", "camera", "lens", "setting", "width", "height", "readout_ms", "h_stretch", "v_stretch", "digital_lens"
_WORD = re.compile(r"\d+(?:\.\d+)?|[^\W\d_]+")
_NO_SPACE = re.compile(r"(?<!\d) | (?!\d)")  # except between two numbers
_ASPECT = 0.01  # relative tolerance of aspect ratios, because sizes are rounded
_SHOWN = 8


@dataclass(frozen=True, repr=False)
class Lens:
    """A lens on a camera, as calibrated for the collection gyroflow/lens_profiles (public domain)."""

    brand: str
    """Brand of the camera. Names are the collection's own."""
    body: str
    """Name of the camera."""
    lens: str
    """Name of the lens, or the mode of a camera with one lens."""
    setting: str
    """Further notes: resolution, focal length of a zoom, remarks."""
    image_size: tuple[int, int]
    """Calibrated (height, width)."""
    intrinsics: tuple[float, ...]
    """Intrinsics fx, fy, cx, cy in pixels."""
    distortion: tuple[float, ...]
    """Coefficients k1 ... k4 of `KannalaBrandt`."""
    rms: float
    """Reprojection error of the calibration in pixels."""
    readout_ms: float | None
    """Milliseconds from the first row to the last of a rolling shutter, negative if it reads from the bottom up. Many
    calibrations state 0 if it is unknown. None: unknown.
    """
    stretch: tuple[float | None, float | None]
    """Horizontal and vertical factor to stretch recorded images by; None: not stated."""
    digital: str
    """Reprojection by the camera itself, as GoPro's SuperView; empty if there is none."""

    @property
    def name(self) -> str:
        """Brand, camera, lens and setting."""
        return " ".join(part for part in (self.brand, self.body, self.lens, self.setting) if part)

    @property
    def is_optical(self) -> bool:
        """Whether a lens makes such images: not stretched or reprojected, positive focal lengths (31 have negative)."""
        return not self.digital and all(factor in (None, 1.0) for factor in self.stretch) and self._exists

    @property
    def _exists(self) -> bool:
        return min(self.intrinsics[:2]) > 0

    def camera(self) -> KannalaBrandt:
        """Return the camera, in float64 and frozen.

        Raises:
            ValueError: If its focal lengths are negative.
        """
        if not self._exists:
            way = "Choose another one of lenses.search with is_optical True"
            raise ValueError(f"{self.name}: focal lengths must be positive; got {self.intrinsics[:2]}. {way}")
        intrinsics, distortion = (torch.tensor(v, dtype=torch.float64) for v in (self.intrinsics, self.distortion))
        made = KannalaBrandt(torch.nn.Parameter(intrinsics), distortion, image_size=self.image_size)
        return made.requires_grad_(False)  # a Parameter, as some are off centre

    def __repr__(self) -> str:
        height, width = self.image_size
        parts = [f"{width}x{height}"]
        if self._exists:
            parts.append(f"{float(self.camera().fov[0]):.3g} degrees wide")
        parts.append(f"rms {self.rms:.2g} px")
        if self.readout_ms:
            parts.append(f"readout {self.readout_ms:g} ms")
        if not self.is_optical:
            parts.append(self.digital or ("stretched" if self._exists else "astray"))
        return f"<{self.name}: {', '.join(parts)}>"


@cache
def columns() -> tuple[dict[str, list[str]], NDArray[np.float64]]:
    """Return the columns of text by name, and the columns of numbers (9, N): fx fy cx cy k1 k2 k3 k4 rms."""
    with np.load(_FILE) as file:
        text, planes = file["text"].tobytes().decode(), file["planes"]
    lines, count = text.split("\0"), planes.shape[-1]
    texts = {name: lines[i * count : (i + 1) * count] for i, name in enumerate(_TEXTS)}
    codes = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<i8")[..., 0].astype(np.int64)
    bits = ((codes >> 1) & np.int64(2**63 - 1)) ^ -(codes & 1)
    bits[1] += bits[0]
    bits[2:4] += (np.array([texts["width"], texts["height"]], float) / 2).view(np.int64)
    return texts, bits.view(np.float64)


@cache
def entries() -> tuple[Lens, ...]:
    """Return all lenses, in the order of the collection."""
    texts, numbers = columns()
    names = zip(*(texts[name] for name in _TEXTS[:4]), strict=True)
    sizes = zip(map(int, texts["height"]), map(int, texts["width"]), strict=True)
    readouts, across, down = ([float(text) if text else None for text in texts[name]] for name in _TEXTS[6:9])
    stretches = zip(across, down, strict=True)
    rows = zip(names, sizes, numbers.T.tolist(), readouts, stretches, texts["digital_lens"], strict=True)
    return tuple(
        Lens(brand, body, lens, setting, size, tuple(each[:4]), tuple(each[4:8]), each[8], readout, stretch, digital)
        for (brand, body, lens, setting), size, each, readout, stretch, digital in rows
    )


def search(words: str = "", *, image_size: Sequence[int] | None = None) -> list[Lens]:
    """Return the lenses whose names have all of these words, best first; all lenses if there are none.

    Case, spaces, signs and the order of words do not count: "A7S III", "a7sIII" and "a7s-iii" are the same; a
    number is whole, so HERO9 does not match HERO99. Lenses with the words in a row come first; then those with the
    fewest other words; then those neither stretched nor reprojected; then those with the smallest reprojection error.

    Args:
        words: Words of brand, camera, lens and setting, or a size: "GoPro HERO9 wide", "Laowa 7.5mm 3840x2160".
        image_size: (height, width): only lenses calibrated for images of this aspect ratio, this size first.
    """
    size = as_image_size(image_size, "lenses.search")
    terms = _terms(words, "search")
    patterns, row = [_pattern(term) for term in terms], _pattern("".join(terms)) if terms else None
    found = [
        (not (row and row.search(text)), length, not lens.is_optical, lens.rms, i)
        for i, (lens, (text, length)) in enumerate(zip(entries(), _texts(), strict=True))
        if all(pattern.search(text) for pattern in patterns)
    ]
    lenses = [entries()[i] for *_, i in (sorted(found) if patterns else found)]
    if size is None:
        return lenses
    alike = [one for one in lenses if abs(one.image_size[1] * size[0] / (one.image_size[0] * size[1]) - 1) < _ASPECT]
    return sorted(alike, key=lambda lens: lens.image_size != size)


def find(words: str, *, image_size: Sequence[int] | None = None) -> KannalaBrandt:
    """Return the camera of the best match of `search`, in float64 and frozen.

    Args:
        words: Words as for `search`, which also lists the other matches.
        image_size: (height, width) of your images, to which the camera is scaled. Default: the calibration's.

    Raises:
        ValueError: If no lens has all of these words, or none has that aspect ratio. TypeError: If `words` is no text.
    """
    if not _terms(words, "find"):
        raise ValueError(f"lenses.find: words must name a camera or a lens, as 'GoPro HERO9 wide'; got {words!r}")
    if not (found := search(words)):
        near = difflib.get_close_matches(words, dict.fromkeys(lens.name for lens in entries()), _SHOWN, 0.5)
        what = f". The nearest are {', '.join(map(repr, near))}" if near else ""
        raise ValueError(f"lenses.find: words must name a known lens; got {words!r}{what}. {GUESS_CAMERA}")
    if (size := as_image_size(image_size, "lenses.find")) is None:
        return found[0].camera()
    if not (fitting := search(words, image_size=size)):
        sizes = sorted({lens.image_size for lens in found})
        known = f"an aspect ratio calibrated for {words!r}, (height, width) {', '.join(map(str, sizes[:_SHOWN]))}"
        raise ValueError(f"lenses.find: image_size must have {known}; got {size}. {GUESS_CAMERA}")
    camera = fitting[0].camera()
    return camera if camera.image_size == size else camera.resize(*size)


def _squeeze(text: str) -> str:
    return _NO_SPACE.sub("", " ".join(_WORD.findall(unicodedata.normalize("NFKC", text).casefold())))


def _terms(words: str, function: str) -> list[str]:
    if not isinstance(words, str):
        raise TypeError(f"lenses.{function}: words must be a text; got {type(words).__name__}")
    return [term for term in map(_squeeze, words.split()) if term]


def _pattern(term: str) -> re.Pattern[str]:
    """Return a pattern of a term in names, with whole numbers."""
    first, last = ("(?<!\\d)" if term[0].isdigit() else ""), ("(?!\\d)" if term[-1].isdigit() else "")
    return re.compile(first + re.escape(term) + last)


@cache
def _texts() -> list[tuple[str, int]]:
    """Return name and size, and the length of the name, of every entry."""
    names = [_squeeze(lens.name) for lens in entries()]
    sizes = [f"{lens.image_size[1]}x{lens.image_size[0]}" for lens in entries()]
    return [(f"{name} {size}", len(name)) for name, size in zip(names, sizes, strict=True)]
