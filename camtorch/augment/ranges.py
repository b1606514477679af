"""Ranges, and drawing from them: named tensors that can be looked at, saved, edited and used again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Range:
    """Even chances between two numbers; `size` of them for each sample, or one."""

    low: float
    high: float
    size: int | None = None

    @property
    def middle(self) -> float:
        """Between both ends."""
        return (self.low + self.high) / 2

    def __str__(self) -> str:
        return f"({self.low:g}, {self.high:g})"


def as_range(
    value,
    name: str,
    owner: str,
    *,
    around: float = 0.0,
    least: float = -math.inf,
    most: float = math.inf,
    size: int | None = None,
) -> Range:
    """A checked range of (low, high); a single number x is the range from `around` - x to `around` + x.

    Raises:
        TypeError: neither a number nor two. ValueError: NaN, the wrong order, or outside of [least, most].
    """
    try:
        pair = (
            tuple(map(float, value)) if isinstance(value, Iterable) else (around - float(value), around + float(value))
        )
        low, high = pair
    except (TypeError, ValueError):
        raise TypeError(f"{owner}: {name} must be a range (low, high) or a number; got {value!r}") from None
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError(f"{owner}: {name} must be finite; got {value!r}")
    if low > high:
        raise ValueError(f"{owner}: {name} must be (low, high) with low <= high; got {value!r}")
    if low < least or high > most:
        raise ValueError(f"{owner}: {name} must lie within [{least:g}, {most:g}]; got {value!r}")
    return Range(low, high, size)


def draw(
    ranges: Mapping[str, Range], count: int, p: float, same: bool, generator: torch.Generator | None
) -> dict[str, Tensor]:
    """`apply` (count,) bool, which is true with probability p, and a value (count,) or (count, size) for every range.

    The numbers come in the order in which kornia asks for them: first the gate, if there is a choice, then the ranges.
    """
    rows = min(count, 1) if same else count
    like = {"generator": generator, "device": generator.device if generator is not None else "cpu"}
    values = {
        "apply": torch.rand(rows, **like) < p if 0 < p < 1 else torch.full((rows,), p >= 1, device=like["device"])
    }
    for name, interval in ranges.items():
        shape = (rows,) if interval.size is None else (rows, interval.size)
        # in float64, so that what is drawn is what every precision sees
        share = torch.rand(shape, dtype=torch.float64, **like)
        values[name] = interval.low + (interval.high - interval.low) * share
    return {name: value.expand(count, *value.shape[1:]).contiguous() for name, value in values.items()}
