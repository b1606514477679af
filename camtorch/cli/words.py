"""How the command line reads paths, sizes, lengths and ranges: types of options, as argparse takes them."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

LARGEST_SIDE = 32768
"""Pixels."""
LENS = "lens:"
"""What the name of a real lens begins with, in the place of a calibration file."""
GUESS = "guess:"
"""What a guessed horizontal field of view in degrees begins with, in the place of a calibration file."""
_UNITS = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254, "m": 1.0}
_WrongWord = argparse.ArgumentTypeError


def path(text: str) -> Path:
    """A path that a file can have."""
    return Path(raw_path(text))


def raw_path(text: str) -> str:
    """A path as it was written: a slash at its end says that it is a folder."""
    if not text or "\0" in text:
        raise _WrongWord(f"{text!r} is no name of a file")
    return text


def suffix(text: str) -> str:
    """A suffix, as ".png"."""
    if not (text.startswith(".") and text[1:].isalnum()):
        raise _WrongWord(f"{text!r} is no suffix, as .png is")
    return text


def _counts(text: str, separator: str) -> tuple[int, ...]:
    """Two whole numbers of up to eight digits, or nothing."""
    words = text.lower().split(separator)
    fits = len(words) == 2 and all(word.isascii() and word.isdigit() and len(word) < 9 for word in words)
    return tuple(map(int, words)) if fits else ()


def size(text: str) -> tuple[int, int]:
    """(height, width) of "WIDTHxHEIGHT"."""
    sides = _counts(text, "x")
    if not sides or not all(0 < side <= LARGEST_SIDE for side in sides):
        raise _WrongWord(f"{text!r} is not WIDTHxHEIGHT, as in 1280x720, each of 1 to {LARGEST_SIDE} pixels")
    return sides[1], sides[0]


def board(text: str) -> tuple[int, int]:
    """(columns, rows) of "COLUMNSxROWS"."""
    counts = _counts(text, "x")
    if not counts or max(counts) > 9999:
        raise _WrongWord(f"{text!r} is not COLUMNSxROWS, as in 9x6")
    return counts[0], counts[1]


def count(most: int, least: int = 1) -> Callable[[str], int]:
    """What reads a whole number of a range."""

    def parse(text: str) -> int:
        if not (text.isascii() and text.isdigit() and least <= int(text) <= most):
            raise _WrongWord(f"{text!r} is not a whole number from {least} to {most}")
        return int(text)

    return parse


def guess(text: str) -> Path:
    """A guessed field of view in degrees, in the place of a calibration file."""
    try:
        degrees = float(text)
    except ValueError:
        degrees = math.nan
    if not 2 * math.pi < degrees <= 360:
        raise _WrongWord(f"{text!r} is no field of view in degrees, as 120")
    return Path(GUESS + text)


def length(text: str) -> float:
    """Metres of "30mm", "3cm", "0.03m", "0.03" or "1in"."""
    unit = next((unit for unit in _UNITS if text.endswith(unit)), "")
    try:
        metres = float(text.removesuffix(unit)) * _UNITS.get(unit, 1.0)
    except ValueError:
        metres = math.nan
    if not 0 < metres < (math.inf if unit else 1.0):
        raise _WrongWord(
            f"{text!r} is no length above 0 with its unit, as 30mm, 3cm, 1in; without one it is in metres, below 1"
        )
    return metres
