"""Masks as runs, the way COCO's files hold them: down the columns, one after another, beginning with zeros.

Source: "Data format" of cocodataset.org. As a text each number is groups of five bits, the lowest first, with a sixth
one where more follow, as characters from "0" on; from the fourth number on it is the difference to the one before last.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def decode(counts: Any, size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask (H, W) of runs, a list or a text.

    Raises:
        ValueError: no such runs, or not of that many pixels.
    """
    runs = _of_text(counts) if isinstance(counts, str) else counts
    height, width = size
    if not isinstance(runs, list) or not all(type(run) is int and 0 <= run < 1 << 32 for run in runs):
        raise ValueError("counts are no runs of pixels")
    if sum(runs) != height * width:
        raise ValueError(f"counts are of {sum(runs)} pixels, and the size says {width}x{height}")
    mask: NDArray[np.bool_] = np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T
    return mask


def encode(mask: NDArray[np.bool_], *, as_text: bool) -> list[int] | str:
    """The runs of a mask (H, W)."""
    flat = np.concatenate([[False], mask.T.reshape(-1)])
    runs: list[int] = np.diff(np.flatnonzero(flat[1:] != flat[:-1]), prepend=0, append=mask.size).tolist()
    return _as_text(runs) if as_text else runs


def _as_text(runs: list[int]) -> str:
    characters = []
    for i, run in enumerate(runs):
        rest, more = run - runs[i - 2] if i > 2 else run, True
        while more:
            low, rest = rest & 31, rest >> 5
            more = rest != (-1 if low & 16 else 0)
            characters.append(chr(low + 32 * more + 48))
    return "".join(characters)


def _of_text(text: str) -> list[int]:
    runs: list[int] = []
    value = shift = 0
    for character in text:
        group = ord(character) - 48
        if not 0 <= group < 64 or shift > 60:
            raise ValueError("counts are no runs of pixels")
        value |= (group & 31) << shift
        shift += 5
        if not group & 32:
            value -= group >> 4 << shift  # the sixth bit is 0 here, the fifth is the sign
            runs.append(value + runs[-2] if len(runs) > 2 else value)
            value = shift = 0
    if shift:
        raise ValueError("counts end within a number")
    return runs
