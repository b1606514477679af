"""Real lenses by words, as people write them."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Sequence
from functools import cache

from camtorch.lenses.collection import Lens, entries
from camtorch.models import KannalaBrandt
from camtorch.values.arguments import GUESS_CAMERA, as_image_size

_WORD = re.compile(r"\d+(?:\.\d+)?|[^\W\d_]+")
_NO_SPACE = re.compile(r"(?<!\d) | (?!\d)")  # but between two numbers
_ASPECT = 0.01  # the part by which aspect ratios may differ, as sizes are rounded
_SHOWN = 8


def search(words: str = "", *, image_size: Sequence[int] | None = None) -> list[Lens]:
    """The lenses whose names have all of these words, best first; all lenses if there are none.

    Case, spaces and signs do not count, nor does the order of words: "A7S III", "a7sIII" and "a7s-iii" are the same; a
    number is whole, so that HERO9 is no HERO99. Best are those that have the words in a row; then those with the least
    beside them; then those that are neither stretched nor reprojected by the camera; then those of the smallest
    reprojection error.

    Args:
        words: of brand, camera, lens and setting, or a size: "GoPro HERO9 wide", "Laowa 7.5mm 3840x2160".
        image_size: (height, width): only lenses that were calibrated for images of this aspect ratio, those of this
            size first.
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
    """The camera of the best match of `search`, in float64, with nothing to learn.

    Args:
        words: see `search`, which also lists what else they may mean.
        image_size: (height, width) of the images at hand: the camera is scaled to them. By default that of the
            calibration.

    Raises:
        ValueError: nothing has all of these words (the text lists the names most like them), or nothing of that aspect
            ratio. TypeError: no text.
    """
    if not _terms(words, "find"):
        raise ValueError(f"lenses.find: words must name a camera or a lens, as 'GoPro HERO9 wide'; got {words!r}")
    if not (found := search(words)):
        near = difflib.get_close_matches(words, dict.fromkeys(lens.name for lens in entries()), _SHOWN, 0.5)
        what = f"; the nearest are {', '.join(map(repr, near))}" if near else ""
        raise ValueError(f"lenses.find: no lens is called {words!r}{what}. {GUESS_CAMERA}")
    if (size := as_image_size(image_size, "lenses.find")) is None:
        return found[0].camera()
    if not (fitting := search(words, image_size=size)):
        sizes = sorted({lens.image_size for lens in found})
        raise ValueError(
            f"lenses.find: {words!r} was not calibrated for images of the aspect ratio of {size}, but (height, width) "
            f"{', '.join(map(str, sizes[:_SHOWN]))}; camera.crop takes a part of one. {GUESS_CAMERA}"
        )
    camera = fitting[0].camera()
    return camera if camera.image_size == size else camera.resize(*size)


def _squeezed(text: str) -> str:
    return _NO_SPACE.sub("", " ".join(_WORD.findall(unicodedata.normalize("NFKC", text).casefold())))


def _terms(words: str, function: str) -> list[str]:
    if not isinstance(words, str):
        raise TypeError(f"lenses.{function}: words must be a text; got {type(words).__name__}")
    return [term for term in map(_squeezed, words.split()) if term]


def _pattern(term: str) -> re.Pattern[str]:
    """A term as names may have it, its numbers whole."""
    first, last = ("(?<!\\d)" if term[0].isdigit() else ""), ("(?!\\d)" if term[-1].isdigit() else "")
    return re.compile(first + re.escape(term) + last)


@cache
def _texts() -> list[tuple[str, int]]:
    """Of every entry its name and size, and how long the name is."""
    names = [_squeezed(lens.name) for lens in entries()]
    sizes = [f"{lens.image_size[1]}x{lens.image_size[0]}" for lens in entries()]
    return [(f"{name} {size}", len(name)) for name, size in zip(names, sizes, strict=True)]
