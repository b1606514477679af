"""Masks as runs, the way COCO's files hold them: down the columns, one after another, beginning with zeros.

Source: "Data format" of cocodataset.org. As a text each number is groups of five bits, the lowest first, with a sixth
one where more follow, as characters from "0" on; from the fourth number on it is the difference to the one before last.
"""

from __future__ import annotations

from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LARGEST = 1 << 32


def decode(counts: Any, size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask (H, W) of runs, a list or a text.

    Raises:
        ValueError: no such runs, or not of that many pixels.
    """
    runs = _of_text(counts) if isinstance(counts, str) else counts
    height, width = size
    if not isinstance(runs, list) or not all(type(run) is int and 0 <= run < _LARGEST for run in runs):
        raise ValueError("counts are no runs of pixels")
    if sum(runs) != height * width:
        raise ValueError(f"counts are of {sum(runs)} pixels, and the size says {width}x{height}")
    values = np.arange(len(runs)) % 2 == 1
    mask: np.ndarray = np.repeat(values, runs).reshape(width, height).T
    return mask


def encode(mask: NDArray[np.bool_], *, as_text: bool) -> list[int] | str:
    """The runs of a mask (H, W)."""
    flat = mask.T.reshape(-1)
    ends = [0, *(np.flatnonzero(flat[1:] != flat[:-1]) + 1).tolist(), flat.size]
    runs = [after - before for before, after in pairwise(ends)]
    if flat.size and flat[0]:
        runs.insert(0, 0)
    return _as_text(runs) if as_text else runs


def _as_text(runs: list[int]) -> str:
    characters = []
    for i, run in enumerate(runs):
        rest = run - runs[i - 2] if i > 2 else run
        more = True
        while more:
            low, rest = rest & 31, rest >> 5
            more = rest != (-1 if low & 16 else 0)
            characters.append(chr(low + 32 * more + 48))
    return "".join(characters)


def _of_text(text: str) -> list[int]:
    numbers, value, shift = [], 0, 0
    for character in text:
        group = ord(character) - 48
        if not 0 <= group < 64 or shift > 60:
            raise ValueError("counts are no runs of pixels")
        value |= (group & 31) << shift
        shift += 5
        if not group & 32:
            numbers.append(value - (1 << shift) if group & 16 else value)
            value, shift = 0, 0
    if shift:
        raise ValueError("counts end within a number")
    # those at odd places go on from each other, and so do those at even ones but the first
    numbers[1::2], numbers[2::2] = accumulate(numbers[1::2]), accumulate(numbers[2::2])
    return numbers
