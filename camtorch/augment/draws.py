"""Draws that somebody gave, checked, and the boxes that they take from a sample; `ranges.py` explains their forms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.ranges import Draw
from camtorch.evaluate.tensors import are_numbers
from camtorch.values.arguments import as_mapping, shown


def checked_draw(draw: Mapping[str, Tensor], sizes: Mapping[str, int | None], owner: str) -> Draw:
    """Return a draw that was given as arrays, or as tensors if numbers may not be read.

    sizes: name -> how many numbers it holds for each sample; None: one, without a dim.
    """
    as_mapping(draw, "draw", owner, "what draw() returns")
    if missing := [name for name in ("apply", *sizes) if name not in draw]:
        has = ", ".join(map(str, draw)) or "nothing"
        raise ValueError(f"{owner}: draw must have {', '.join(missing)}; got {has}")
    values: dict[str, Any] = {name: torch.as_tensor(draw[name]) for name in ("apply", *sizes)}
    if values["apply"].ndim != 1:
        raise ValueError(f"{owner}: draw['apply'] must be (B,), which of B samples move; got {shown(draw['apply'])}")
    values["apply"] = values["apply"] > 0.5
    if are_numbers(*values.values()):
        values = {n: (value if n == "apply" else value.double()).numpy() for n, value in values.items()}
    for name, size in sizes.items():
        value, count = values[name], len(values["apply"])
        shape = (count,) if size is None else (count, size)
        if tuple(value.shape) != shape:
            raise ValueError(f"{owner}: draw[{name!r}] must be {shape}; got shape {tuple(value.shape)}")
        if isinstance(value, np.ndarray) and not np.isfinite(value).all():
            raise ValueError(f"{owner}: draw[{name!r}] must be finite; got {value.tolist()}")
    return values


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
