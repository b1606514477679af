"""Real lenses by words, as people write them."""

from __future__ import annotations

import difflib
import itertools
import re
import unicodedata
from collections.abc import Sequence
from functools import cache

from camtorch._arguments import GUESS_CAMERA, as_image_size
from camtorch.lenses.collection import Lens, entries
from camtorch.models import KannalaBrandt

_WORD = re.compile(r"\d+(?:\.\d+)?|[^\W\d_]+")  # "HERO9", "Hero 9" and "hero-9" are the same two
_ROMAN = {"ii": "2", "iii": "3", "iv": "4", "v": "5", "vi": "6", "vii": "7"}
_GENERATION = re.compile(r" (?P<stem>[^\W\d_]??)(?P<roman>ii|iii|iv|v|vi|vii)(?= )")
_JOINED = re.compile(r"([^\W\d_]{4,})(?=\d)")
_MARK = re.compile(r" ([^\W\d_]?)(?:m|mk|mark) (?=[2-7] )")
_NUMBER = re.compile(r"\d+")
_ASPECT = 0.01  # the part by which aspect ratios may differ, as sizes are rounded
_SHOWN = 8


def search(words: str = "", *, image_size: Sequence[int] | None = None) -> list[Lens]:
    """The lenses whose names have all of these words, best first; all lenses if there are none.

    Case, spaces and signs do not count, nor does the order of words, and "A7S III", "A7S3", "A7S Mark III" and
    "ILCE-7SM3" are the same. The last letters of a word may be missing, and words that no name has are taken for the
    most similar one of the same numbers. Best are those with the fewest other words; then those that are neither
    stretched nor reprojected by the camera; then those of the smallest reprojection error.

    Args:
        words: of brand, camera, lens and setting, or a size: "GoPro HERO9 wide", "Laowa 7.5mm 3840x2160".
        image_size: (height, width): only lenses that were calibrated for images of this aspect ratio, those of this
            size first.
    """
    size = as_image_size(image_size, "lenses.search")
    terms = _terms(words, "search")
    found = list(entries()) if not terms else _matching(terms)
    if not found:
        found = _matching(_terms(_JOINED.sub(r"\1 ", " ".join(terms)), "search"))  # "gopro11"
    if not found:
        found = _matching([_nearest(term) for term in terms])
    if size is None:
        return found
    alike = [lens for lens in found if abs(lens.image_size[1] * size[0] / (lens.image_size[0] * size[1]) - 1) < _ASPECT]
    return sorted(alike, key=lambda lens: lens.image_size != size)


def find(words: str, *, image_size: Sequence[int] | None = None) -> KannalaBrandt:
    """The camera of the best match of `search`, in float64, with nothing to learn.

    Args:
        words: see `search`, which also lists what else they may mean.
        image_size: (height, width) of the images at hand: the camera is scaled to them. By default that of the
            calibration.

    Raises:
        ValueError: nothing has all of these words (the text lists what has most of them), or nothing of that aspect
            ratio. TypeError: no text.
    """
    terms = _terms(words, "find")
    if not terms:
        raise ValueError(f"lenses.find: words must name a camera or a lens, as 'GoPro HERO9 wide'; got {words!r}")
    found = search(words)
    if not found:
        near = list(dict.fromkeys(repr(lens.name) for lens in _most_alike(terms)))
        what = f"; the nearest are {', '.join(near[:_SHOWN])}{' ...' * (len(near) > _SHOWN)}" if near else ""
        raise ValueError(f"lenses.find: no lens is called {words!r}{what}. {GUESS_CAMERA}")
    size = as_image_size(image_size, "lenses.find")
    if size is None:
        return found[0].camera()
    fitting = search(words, image_size=size)
    if not fitting:
        sizes = sorted({lens.image_size for lens in found})
        raise ValueError(
            f"lenses.find: {words!r} was not calibrated for images of the aspect ratio of {size}, but (height, width) "
            f"{', '.join(map(str, sizes[:_SHOWN]))}; camera.crop takes a part of one. {GUESS_CAMERA}"
        )
    camera = fitting[0].camera()
    return camera if camera.image_size == size else camera.resize(*size)


def _words_of(text: str) -> list[str]:
    return _WORD.findall(unicodedata.normalize("NFKC", text).casefold())


def _terms(words: str, function: str) -> list[str]:
    """What is to be found in a name, each without the spaces and signs within."""
    if not isinstance(words, str):
        raise TypeError(f"lenses.{function}: words must be a text; got {type(words).__name__}")
    return [term for term in ("".join(_words_of(part)) for part in words.split()) if term]


def _numbered(words: list[str]) -> list[str]:
    """Words with generations as numbers: a7SIII, A7S3, ILCE-7SM3 and A7S Mark III are all a 7 s 3."""
    line = f" {' '.join(words)} ".replace(" ilce ", " a ")
    line = _GENERATION.sub(lambda found: f" {found['stem']} {_ROMAN[found['roman']]}", line)
    return _MARK.sub(r" \1 ", " ".join(line.split()).join("  ")).split()


@cache
def _names() -> tuple[list[str], list[str], list[int]]:
    """Of every entry, the words of its name, and of its size, between spaces; the same `_numbered`; and how many words
    the name has.
    """
    words = [_words_of(lens.name) for lens in entries()]
    sizes = [f"{lens.image_size[1]} x {lens.image_size[0]}" for lens in entries()]
    lines, numbered = (
        [f" {' '.join(name)} {size} " for name, size in zip(of, sizes, strict=True)]
        for of in (words, map(_numbered, words))
    )
    return lines, numbered, [len(name) for name in words]


@cache
def _vocabulary() -> list[str]:
    """What terms may have meant: words, and two that stand together."""
    names = [line.split() for line in _names()[0]]
    pairs = (a + b for words in names for a, b in itertools.pairwise(words))
    return sorted({word for words in names for word in words} | set(pairs))


def _pattern(term: str) -> re.Pattern[str]:
    """A term as names may have it: with spaces in between, up to the end of a word, or of some of its letters."""
    end = "(?= )" if term[-1].isdigit() else r"(?= |([^\W\d_]))"
    return re.compile(" " + " ?".join(map(re.escape, term)) + end)


def _matching(terms: list[str]) -> list[Lens]:
    """Lenses with all of the terms, best first. Terms in a row may be one word of a name: "A7S III" is "a7sIII"."""
    runs = {}
    for i, j in ((i, i + n) for n in (1, 2, 3) for i in range(len(terms) - n + 1)):
        part, numbered = terms[i:j], _numbered(_words_of(" ".join(terms[i:j])))
        if all(len(b) == 1 or not (a[-1] + b[0]).isdigit() for a, b in itertools.pairwise(part)):  # "9 48mm" is no 948
            other = _pattern("".join(numbered)) if any(word in _ROMAN.values() for word in numbered) else None
            runs[i, j] = _pattern("".join(part)), other
    generations = [
        run
        for i, term in enumerate(terms)
        if (term in _ROMAN or term in _ROMAN.values())
        and (run := (i - 1 - (terms[i - 1] in ("m", "mk", "mark")), i + 1)) in runs
    ]
    count, ranked = sum(len(_words_of(term)) for term in terms), []
    for lens, line, digits, length in zip(entries(), *_names(), strict=True):

        def found(run: tuple[int, int], line: str = line, digits: str = digits) -> re.Match[str] | None:
            pattern, other = runs[run]
            return pattern.search(line) or (other.search(digits) if other else None)

        whole, cut = set[int](), set[int]()
        for i, j in runs:
            if not whole.issuperset(range(i, j)) and (hit := found((i, j))):
                (cut if hit.lastindex else whole).update(range(i, j))
        if len(whole | cut) == len(terms):
            apart = sum(not found(run) for run in generations)  # "A7 3" is rather an a7III than an a7RIII
            ranked.append((len(terms) - len(whole), apart, length - count, not lens.is_optical, lens.rms, lens))
    ranked.sort(key=lambda entry: entry[:5])
    return [entry[5] for entry in ranked]


def _nearest(term: str) -> str:
    """The term if a name has it, or else the most similar that one has, of the same numbers: a HERO99 is no HERO9."""
    if any(map(_pattern(term).search, _names()[0])):
        return term
    numbers = _NUMBER.findall(term)
    alike = [word for word in _vocabulary() if _NUMBER.findall(word) == numbers]
    return (difflib.get_close_matches(term, alike, 1, 0.75) or [term])[0]


def _most_alike(terms: list[str]) -> list[Lens]:
    """The lenses with the most of the terms, or of what is most like them."""
    patterns, (names, _, lengths) = [_pattern(_nearest(term)) for term in terms], _names()
    counts = [sum(bool(pattern.search(line)) for pattern in patterns) for line in names]
    most = max(counts)
    alike = [i for i, count in enumerate(counts) if count == most > 0]
    return [entries()[i] for i in sorted(alike, key=lambda i: lengths[i])]
