"""Ranges that random augmentations draw from, and draws.

A draw holds, by name, a row for each of B samples: `apply` (B,), whether an augmentation moves it; the numbers of each
range, (B,) or (B, size); and what is taken from the sample, such as its `box` (B, 4), as tensors. The others have one
of these forms:

* lists, which one sample makes in the least time;
* arrays of NumPy, of several samples, or of a draw that was given and may be read;
* tensors where numbers may not be read, as in traced code, or have a graph, or a generator is on another device;
* tensors of bool and float64, which `Augmentation.draw` returns. A draw that is given may hold any numbers: `apply` is
  then true above one half, and so is the `apply` of a part of a `Compose`, whose draw is named "0.apply" and so on.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.evaluate.door import has_tangent, is_cheap_to_read, is_eager, keeps_graph
from camtorch.evaluate.tensors import are_numbers, known_false, known_true
from camtorch.values.arguments import as_mapping, as_number, shown, warn

RangeLike = float | Sequence[float]
Draw = Mapping[str, Any]
"""A draw in any of its forms."""

POSITIVE = frozenset({"zoom", "fov", "focal", "crop"})
"""Names of ranges whose numbers make no camera unless they are positive."""

Spans = SimpleNamespace  # by that name pickles of 0.4.0 have one that nothing reads
TURN: dict[str, Any] = {"least": -180, "most": 180, "degrees": "degrees"}
"""The options of `as_range` for turns."""
_RADIANS = 0.8  # 45 degrees: a range of degrees within it is more likely in radians


@dataclass(frozen=True)
class Range:
    """Even chances between two numbers; `size` of them for each sample, or one.

    Raises:
        ValueError: NaN, infinity, or the wrong order.
    """

    low: float
    high: float
    size: int | None = None

    def __post_init__(self) -> None:
        low, high = as_number(self.low, "low", "Range"), as_number(self.high, "high", "Range")
        if not -math.inf < low <= high < math.inf:
            raise ValueError(f"Range: low and high must be finite, with low <= high; got {self.low!r}, {self.high!r}")

    @property
    def middle(self) -> float:
        """The number between both ends."""
        return (self.low + self.high) / 2

    def __str__(self) -> str:
        return f"({self.low:g}, {self.high:g})"


def as_range(
    value: object,
    name: str,
    owner: str,
    *,
    around: float = 0.0,
    least: float = -math.inf,
    most: float = math.inf,
    size: int | None = None,
    is_pair: bool = False,
    degrees: str = "",
) -> Range:
    """Return a checked range of (low, high); a single number x is that from `around` - x to `around` + x.

    is_pair: whether a single number is refused. degrees: the unit in words, if it is one of degrees: numbers that seem
    to be radians are warned of.
    """
    try:
        if isinstance(value, Iterable) and not isinstance(value, str):
            low, high = map(float, value)
        else:
            number = as_number(value, name, owner)
            low, high = around - number, around + number
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise TypeError(f"{owner}: {name} must be a range (low, high) or a number; got {shown(value)}") from None
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError(f"{owner}: {name} must be finite; got {value!r}")
    if low > high:
        raise ValueError(f"{owner}: {name} must be (low, high) with low <= high; got {value!r}")
    if is_pair and not isinstance(value, Iterable):
        raise TypeError(f"{owner}: {name} must be a range (low, high); got {value!r}")
    if low < least or high > most:
        means = "" if isinstance(value, Iterable) else f", which stands for ({low:g}, {high:g})"
        raise ValueError(f"{owner}: {name} must lie within [{least:g}, {most:g}]; got {value!r}{means}")
    if degrees and 0 < max(-low, high) < _RADIANS:
        warn(
            f"{owner}: {name} is in {degrees}, and {shown(value)} seems to be radians. math.degrees() converts them; a "
            "range of less than a degree is taken as it is"
        )
    return Range(low, high, size)


def draw_numbers(
    ranges: Mapping[str, Range], count: int, p: float, same: bool, generator: torch.Generator | None
) -> Draw:
    """Return a draw in the form that takes the least time: `apply`, true with probability p, and all ranges."""
    if not (generator is None or isinstance(generator, torch.Generator)):
        raise TypeError(f"draw: generator must be a torch.Generator, or None; got {shown(generator)}")
    rows = min(count, 1) if same else count
    total = 0
    for interval in ranges.values():
        total += rows * (interval.size or 1)
    device = "cpu" if generator is None else generator.device
    # the order is kornia's: the gate first
    gate = torch.rand(rows, generator=generator, dtype=torch.float32, device=device) < p if 0 < p < 1 else None
    # in float64, so that what is drawn is what every precision sees
    shares: Any = torch.rand(total, generator=generator, dtype=torch.float64, device=device)
    if not (shares.is_cpu and is_eager()):
        values: dict[str, Any] = {"apply": torch.full((rows,), p >= 1, device=device) if gate is None else gate}
    else:
        applied = [p >= 1] * rows if gate is None else gate.tolist()
        if rows == count == 1:
            return {"apply": applied, **_one_row(ranges, shares.tolist())}
        values, shares = {"apply": np.array(applied, bool)}, shares.numpy()
    start = 0
    for name, interval in ranges.items():
        low, wide, end = interval.low, interval.high - interval.low, start + rows * (interval.size or 1)
        value = low + wide * shares[start:end]
        values[name] = value.reshape(rows, interval.size) if interval.size else value
        start = end
    return values if rows == count else rows_of(values, [0] * count)


def _one_row(ranges: Mapping[str, Range], shares: Sequence[float]) -> dict[str, list[Any]]:
    """Return the numbers of one sample at shares of their ranges, by name: lists (1,) or (1, size)."""
    values: dict[str, list[Any]] = {}
    start = 0
    for name, interval in ranges.items():
        low, size = interval.low, interval.size
        wide = interval.high - low
        if size is None:
            values[name] = [low + wide * shares[start]]
            start += 1
        else:
            values[name] = [[low + wide * share for share in shares[start : start + size]]]
            start += size
    return values


def rows_of(draw: Draw, rows: list[int] | None) -> Draw:
    """Return these rows of a draw of arrays or tensors; None: all."""
    return {name: value if rows is None else value[rows] for name, value in draw.items()}


def which_apply(applied: Any) -> list[bool] | None:
    """Return which samples a draw of arrays or tensors moves, (B,), by its `apply`; None if values may not be read."""
    if isinstance(applied, Tensor) and len(applied) and not is_cheap_to_read(applied):
        return None
    chosen: list[bool] = applied.tolist()
    return chosen


def values_for(source: Camera, draw: Draw) -> dict[str, Any]:
    """Return drawn values, (*B,) or (*B, size).

    If one camera serves all samples and all draws are equal, the dim *B is left out: one warp serves all.
    """
    if isinstance(draw["apply"], list):  # of one sample
        values = {}
        for name, rows in draw.items():
            values[name] = rows[0]
        del values["apply"]
        return values
    values = {name: value for name, value in draw.items() if name != "apply"}
    if source.batch_shape or (len(draw["apply"]) != 1 and not all(map(_are_alike, values.values()))):
        return values
    return {n: value[0].tolist() if isinstance(value, np.ndarray) else value[0] for n, value in values.items()}


def _are_alike(value: Any) -> bool:
    """Whether all rows of an array or a tensor are known to be the same, and none has a derivative of its own."""
    if isinstance(value, Tensor) and (keeps_graph(value) or has_tangent(value)):
        return False
    same = value == value[:1]
    return same.size > 0 and bool(same.all()) if isinstance(same, np.ndarray) else known_true(same)


def as_tensors(source: Camera, values: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return values as tensors in the source's dtype and on its device."""
    dtype = torch.promote_types(source.intrinsics.dtype, torch.float32)
    return {n: torch.as_tensor(value, dtype=dtype, device=source.intrinsics.device) for n, value in values.items()}


def checked_draw(
    draw: Mapping[str, Tensor], ranges: Mapping[str, Range], crops: Iterable[str], labels: Iterable[str], owner: str
) -> Draw:
    """Return a draw that was given as arrays, or as tensors if numbers may not be read.

    Args:
        draw: what was given.
        ranges: what it must hold, by name.
        crops: further names that it must hold, of a box (4,) for each sample.
        labels: names of labels that it may hold, which stay as they are.
        owner: the augmentation's name, for errors.
    """
    sizes: dict[str, int | None] = {name: interval.size for name, interval in ranges.items()}
    sizes |= dict.fromkeys(crops, 4)
    draw = as_mapping(draw, "draw", owner, "what draw() returns")
    if missing := [name for name in ("apply", *sizes) if name not in draw]:
        has = ", ".join(map(str, draw)) or "nothing"
        raise ValueError(f"{owner}: draw must have {', '.join(missing)}; got {has}")
    values: dict[str, Any] = {name: _as_tensor(draw[name], name, owner) for name in ("apply", *sizes)}
    if values["apply"].ndim != 1:
        raise ValueError(f"{owner}: draw['apply'] must be (B,), which of B samples move; got {shown(draw['apply'])}")
    values["apply"] = values["apply"] > 0.5
    for name, size in sizes.items():
        value, count = values[name], len(values["apply"])
        shape = (count,) if size is None else (count, size)
        if tuple(value.shape) != shape:
            raise ValueError(f"{owner}: draw[{name!r}] must be {shape}; got shape {tuple(value.shape)}")
        if known_false(value.isfinite()):
            raise ValueError(f"{owner}: draw[{name!r}] must be finite; got {value.double().tolist()}")
        is_positive = name in ranges and name.rpartition(".")[2] in POSITIVE and ranges[name].low > 0
        if is_positive and known_false(value > 0):
            raise ValueError(f"{owner}: draw[{name!r}] must be positive; got {value.double().tolist()}")
    if are_numbers(*values.values()):
        values = {name: (value if name == "apply" else value.double()).numpy() for name, value in values.items()}
    return values | {name: draw[name] for name in labels if name in draw}


def _as_tensor(value: Any, name: str, owner: str) -> Tensor:
    try:
        return torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{owner}: draw[{name!r}] must be numbers; got {shown(value)}") from None


def chosen_boxes(crops: Mapping[str, int], boxes: Iterable[Tensor] | None, owner: str) -> dict[str, Tensor]:
    """Return a box of each sample by its name in draws, (B, 4).

    crops: that name -> the index of the box in each sample. boxes: (M, 4) of each sample; None if samples have none.
    """
    if boxes is None:
        raise ValueError(
            f"{owner}: the sample must have boxes, (B, M, 4) pixels x1, y1, x2, y2, to crop one of; got none"
        )
    samples = list(boxes)
    for i, rows in enumerate(samples):
        for index in crops.values():
            if not -len(rows) <= index < len(rows):
                raise ValueError(f"{owner}: sample {i} must have a box of index {index}; got {len(rows)} boxes")
    if not samples:
        return {name: torch.empty(0, 4) for name in crops}
    return {name: torch.stack([rows[index] for rows in samples]) for name, index in crops.items()}
