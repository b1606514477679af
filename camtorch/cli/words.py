"""How options are read: types as argparse takes them."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from pathlib import Path

LENS, GUESS = "lens:", "guess:"  # in the place of a calibration file, before a real lens, or a guess in degrees
_LARGEST_SIDE = 32768  # pixels
_UNITS = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254, "m": 1.0}
_WrongWord = argparse.ArgumentTypeError


def path(text: str) -> Path:
    """Return a path that a file can have."""
    return Path(raw_path(text))


def raw_path(text: str) -> str:
    """Return a path as it was written: a slash at its end says that it is a folder."""
    if not text or "\0" in text:
        raise _WrongWord(f"{text!r} is no name of a file")
    return text


def suffix(text: str) -> str:
    """Return a suffix, as ".png"."""
    if not (text.startswith(".") and text[1:].isalnum()):
        raise _WrongWord(f"{text!r} is no suffix, as .png is")
    return text


def size(text: str) -> tuple[int, int]:
    """Return (height, width) of "WIDTHxHEIGHT"."""
    sides = re.fullmatch(r"0*([1-9][0-9]{0,4})[xX]0*([1-9][0-9]{0,4})", text)
    if not sides or max(map(int, sides.groups())) > _LARGEST_SIDE:
        raise _WrongWord(f"{text!r} is not WIDTHxHEIGHT, as in 1280x720, each of 1 to {_LARGEST_SIDE} pixels")
    return int(sides[2]), int(sides[1])


def board(text: str) -> tuple[int, int]:
    """Return (columns, rows) of "COLUMNSxROWS"."""
    if not (counts := re.fullmatch(r"([0-9]{1,4})[xX]([0-9]{1,4})", text)):
        raise _WrongWord(f"{text!r} is not COLUMNSxROWS, as in 9x6")
    return int(counts[1]), int(counts[2])


def count(most: int) -> Callable[[str], int]:
    """Return what reads a whole number from 1 to `most`."""

    def parse(text: str) -> int:
        if not (text.isascii() and text.isdigit() and 1 <= int(text) <= most):
            raise _WrongWord(f"{text!r} is not a whole number from 1 to {most}")
        return int(text)

    return parse


def _number(text: str) -> float:
    """Return a number; NaN of what is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def guess(text: str) -> Path:
    """Return a guessed field of view in degrees, in the place of a calibration file."""
    if not 2 * math.pi < _number(text) <= 360:
        raise _WrongWord(f"{text!r} is no field of view in degrees, as 120")
    return Path(GUESS + text)


def length(text: str) -> float:
    """Return the metres of "30mm", "3cm", "0.03m", "0.03" or "1in"."""
    unit = next((unit for unit in _UNITS if text.endswith(unit)), "")
    metres = _number(text.removesuffix(unit)) * _UNITS.get(unit, 1.0)
    if not 0 < metres < (math.inf if unit else 1.0):
        raise _WrongWord(
            f"{text!r} is no length above 0 with its unit, as 30mm, 3cm, 1in; without one it is in metres, below 1"
        )
    return metres
