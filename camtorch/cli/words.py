"""Types of option values for argparse."""

import argparse
import math
import re
from collections.abc import Callable
from pathlib import Path

LENS, GUESS = "lens:", "guess:"  # prefixes in place of a file: of a real lens, of a guess in degrees
_LARGEST_SIDE = 32768  # pixels
_UNITS = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254, "m": 1.0}
_WrongWord = argparse.ArgumentTypeError


def path(text: str) -> Path:
    """Return the path of a file."""
    return Path(raw_path(text))


def raw_path(text: str) -> str:
    """Return a path as written: a slash at its end means a folder."""
    if not text or "\0" in text:
        raise _WrongWord(f"the path must be a file name; got {text!r}")
    return text


def suffix(text: str) -> str:
    """Return a suffix, as in ".png"."""
    if not (text.startswith(".") and text[1:].isalnum()):
        raise _WrongWord(f"must be a suffix, as in .png; got {text!r}")
    return text


def size(text: str) -> tuple[int, int]:
    """Return (height, width) of "WIDTHxHEIGHT"."""
    sides = re.fullmatch(r"0*([1-9][0-9]{0,4})[xX]0*([1-9][0-9]{0,4})", text)
    if not sides or max(map(int, sides.groups())) > _LARGEST_SIDE:
        raise _WrongWord(f"must be WIDTHxHEIGHT, as in 1280x720, each from 1 to {_LARGEST_SIDE} pixels; got {text!r}")
    return int(sides[2]), int(sides[1])


def board(text: str) -> tuple[int, int]:
    """Return (columns, rows) of "COLUMNSxROWS"."""
    counts = re.fullmatch(r"([0-9]{1,4})[xX]([0-9]{1,4})", text)
    if not counts:
        raise _WrongWord(f"must be COLUMNSxROWS, as in 9x6; got {text!r}")
    return int(counts[1]), int(counts[2])


def count(most: int) -> Callable[[str], int]:
    """Return a parser of whole numbers from 1 to `most`."""

    def parse(text: str) -> int:
        if not (text.isascii() and text.isdigit() and 1 <= int(text) <= most):
            raise _WrongWord(f"must be a whole number from 1 to {most}; got {text!r}")
        return int(text)

    return parse


def _number(text: str) -> float:
    """Return a number; NaN for other text."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def guess(text: str) -> Path:
    """Return a guessed field of view in degrees, with a prefix, in place of a calibration file."""
    if not 2 * math.pi < _number(text) <= 360:
        raise _WrongWord(f"must be a field of view in degrees, as in 120; got {text!r}")
    return Path(GUESS + text)


def length(text: str) -> float:
    """Return the metres of "30mm", "3cm", "0.03m", "0.03" or "1in"."""
    unit = next((unit for unit in _UNITS if text.endswith(unit)), "")
    metres = _number(text.removesuffix(unit)) * _UNITS.get(unit, 1.0)
    if not 0 < metres < (math.inf if unit else 1.0):
        raise _WrongWord(f"must be a length with its unit, as in 30mm, 3cm, 1in, or in metres below 1; got {text!r}")
    return metres
