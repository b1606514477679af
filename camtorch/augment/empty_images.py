"""Warnings about new images of which too little shows something of the old ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from camtorch.augment.filling import filled
from camtorch.augment.ranges import Range, draw_numbers, values_for
from camtorch.cameras.camera import Camera
from camtorch.values.arguments import warn

_LEAST_SHOWN = 2 / 3  # of what an image shows of its own camera: with less than that, on average, it warns
_TRIES = 8

NewCamera = Callable[[Camera, Mapping[str, Any]], tuple[Camera, Tensor | None]]
"""A camera and values -> the camera after and the rotation, as `Augmentation.new_camera`."""


def warn_if_empty(owner: str, camera: Camera, ranges: Mapping[str, Range], new_camera: NewCamera) -> None:
    """Warn if new images of `camera` will be mostly empty; draws from a generator of its own show it."""
    draw = draw_numbers(ranges, _TRIES, 1.0, False, torch.Generator().manual_seed(0))
    with torch.no_grad():
        first = camera.detach()
        first = first[[0] * _TRIES] if first.batch_shape else first
        shares = filled(first, *new_camera(first, values_for(first, draw)))
        most = filled(first, first, None)  # less than 1 if a fisheye shows a circle
    if shares.mean() < _LEAST_SHOWN * most.mean():
        warn(
            f"{owner}: of the new images {1 - float(shares.mean()):.0%} will show nothing, and of some "
            f"{1 - float(shares.min()):.0%}, as the camera of the images does not see so far. min_filled=0.9 zooms "
            "until that much of every image shows something; fov='source', in lenses, takes one as wide as the "
            "images are; min_filled=0 says that it is meant so"
        )


def warn_of_unfilled(owner: str, share: float, found: Tensor) -> None:
    """Warn that the parts `found` (*B,) of new images that show something are less than `min_filled`, a `share`."""
    few = int((found < share).sum())
    warn(
        f"{owner}: min_filled must be within reach; got {share:g}, and of {few} of {found.numel()} new images "
        f"down to {float(found.min()):.0%} shows something: the camera of the images does not see along the axis "
        "of the new one. Turn it less, or use less of min_filled"
    )
