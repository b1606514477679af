"""Images bent as rubber is, with all their labels: a B-spline surface after the lens."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch._arguments import are_numbers, as_whole, columns
from camtorch._derived import with_surface
from camtorch._evaluation import rows_of
from camtorch._module import Memo
from camtorch.augment.augmentation import Augmentation, EditOptions, Range, as_range
from camtorch.augment.change import Part, View
from camtorch.camera import Camera

if TYPE_CHECKING:
    from typing_extensions import Unpack

_MOST = 32  # cells across or down
_BESIDE = 4  # control points more than cells: those that have a part in the image, and half a cell around it


class RandomElastic(Augmentation):
    """The image bent smoothly, as rubber is: every place moves by a B-spline surface, drawn at random.

    The new camera is the old one with a `ct.optics.Surface` after its lens. So the image is one warp; keypoints, boxes
    and masks move by the same surface, exactly and in both directions; points in space, gaze and head pose, which hold
    in the camera's frame, stay. The surface is one-to-one, whatever is drawn. An image that is elastic already is not
    bent once more.

    Args:
        amount: how far a place moves at the most, to either side, up and down: a part of the image's shorter side, a
            range or one number.
        grid: (down, across): cells of the surface over the image, or one number. More cells bend more finely, and take
            longer where they come to few pixels: on images of 256 x 256, six a quarter longer than four.
        options: see `Augmentation`.

    Raises:
        ValueError: an amount that is negative, or with which so fine a grid might fold: 4 amount cells is 1 or more; a
            camera that is elastic already; a panorama, `FOV` or `Division`, which no lens follows.
    """

    grid: tuple[int, int]
    """Cells of the surface over the image, down and across."""
    other_words: ClassVar[Mapping[str, str]] = {"alpha": "amount", "sigma": "grid", "cells": "grid"}

    def __init__(
        self,
        *,
        amount: float | Sequence[float] = (0.0, 0.02),
        grid: int | Sequence[int] = 4,
        **options: Unpack[EditOptions],
    ):
        super().__init__(**options)
        pair = (grid, grid) if not isinstance(grid, Sequence) else tuple(grid)
        if len(pair) != 2:
            raise ValueError(f"{self._name}: grid must be (down, across), or one number of cells; got {grid!r}")
        down, across = (as_whole(n, "grid", self._name) for n in pair)
        if not 0 < min(down, across) <= max(down, across) <= _MOST:
            raise ValueError(f"{self._name}: grid must be from 1 to {_MOST} cells; got {grid!r}")
        given = (amount, amount) if isinstance(amount, (int, float)) else amount
        drawn, most = as_range(given, "amount", self._name, least=0.0), 1 / (4 * max(down, across))
        if not drawn.high < most:
            raise ValueError(
                f"{self._name}: amount must be below {most:.3g} for {max(down, across)} cells, else the surface might "
                f"fold; got {amount!r}"
            )
        self.grid, self._memo = (down, across), Memo()
        self.ranges: dict[str, Range] = {
            "amount": drawn,
            "bends": Range(-1, 1, 2 * (across + _BESIDE) * (down + _BESIDE)),
        }

    def new_camera(self, source: Camera, values: Mapping[str, Tensor]) -> tuple[Camera, None]:
        """The camera with the surface; see `Augmentation.new_camera`."""
        model, distortion = self._with_surface(source, values)
        intrinsics = source.intrinsics.expand(*distortion.shape[:-1], 4).to(distortion.dtype)
        return model(intrinsics, distortion, image_size=source.image_size).freeze_like(source), None

    def _with_surface(self, source: Camera, values: Mapping[str, Tensor]) -> tuple[type[Camera], Tensor]:
        """The model of the new camera, and its distortion."""
        kind, reach, place, more = self._surface(source)
        bends, down, across = values["bends"], self.grid[0] + _BESIDE, self.grid[1] + _BESIDE
        moved = bends.view(*bends.shape[:-1], down * across, 2) * (values["amount"][..., None] * reach)[..., None, :]
        if any(more):
            moved = torch.nn.functional.pad(moved.unflatten(-2, (down, across)), (0, 0, *more[:1] * 2, *more[1:] * 2))
            across, down, moved = across + 2 * more[0], down + 2 * more[1], moved.flatten(-3, -2)
        parts = source.distortion, place, moved.flatten(-2)
        distortion = torch.cat([part.expand(*moved.shape[:-2], -1).to(moved.dtype) for part in parts], -1)
        return with_surface(kind, across, down), distortion

    def _surface(self, source: Camera) -> tuple[type[Camera], Tensor, Tensor, list[int]]:
        """The model of a camera, and what `_placed` says."""
        if ":elastic=" in source.key:
            raise ValueError(f"{self._name}: the camera is elastic already, {source.key}")
        kind: type[Camera] = type_before_parametrizations(source)
        if not _takes_surface(kind, source.distortion.shape[-1]):  # type: ignore[arg-type]  # a class can be hashed
            raise ValueError(
                f"{self._name}: no surface can follow {type(source).__name__}, whose formula has no lens after it; "
                "camera.convert(ct.KannalaBrandt).camera is one that has"
            )
        size = source._size_for(self._name)
        return kind, *self._memo((source.intrinsics,), (size,), lambda: self._placed(source, size))

    def _placed(self, source: Camera, size: tuple[int, int]) -> tuple[Tensor, Tensor, list[int]]:
        """How far an amount of 1 goes on the plane; cells and centre of a surface over the image; and how many control
        points more it takes to either side, as the principal point of what was cut out may lie outside, and shall not.
        """
        (height, width), (down, across) = size, self.grid
        focal, centre = source.intrinsics.detach().split(2, -1)
        middle = (centre.new_tensor([width - 1, height - 1]) / 2 - centre) / focal
        cells = centre.new_tensor([across / width, down / height]) * focal
        away = (middle * cells).abs().reshape(-1, 2).amax(0) - centre.new_tensor([across, down]) / 2
        return min(size) / focal, torch.cat((cells, middle), -1), [max(0, math.ceil(w)) for w in away.tolist()]

    def _part(self, rows: list[int] | None, source: Camera, draw: Mapping[str, Any]) -> Part:
        view = self._view(source, draw)
        return super()._part(rows, source, draw) if view is None else Part(rows, view, source)

    def _view(self, source: Camera, draw: Mapping[str, Any]) -> View | None:
        """What a draw makes of a single camera as plain numbers; None where it takes more than that."""
        is_usual = type(self).new_camera is RandomElastic.new_camera and self.options["tolerance"]
        if not is_usual or self.min_filled or self.options["antialias"] or isinstance(draw["apply"], Tensor):
            return None
        if source.batch_shape or not are_numbers(*source._tensors):
            return None
        before = rows_of(source, *source._tensors)
        values = self._values(source, draw)
        if before.usable is not None or any(isinstance(value, (np.ndarray, Tensor)) for value in values.values()):
            return None
        model, distortion = self._with_surface(source, self._like(source, values))
        if not math.isfinite(distortion.sum()):
            return None
        base = _prototype(model, distortion.shape[-1], distortion.dtype)  # type: ignore[arg-type]  # likewise
        numbers = source.intrinsics.tolist()
        return View(base, numbers, distortion, source._size_for(self._name), None, self.options, before.native)


@functools.lru_cache(maxsize=64)
def _takes_surface(model: type[Camera], count: int) -> bool:
    """Whether a lens follows the chart of a model of so many coefficients."""
    try:
        model.optics(columns(torch.tensor([model.ideal(count)])))[0].end(torch.float32)
    except NotImplementedError:
        return False
    return True


@functools.lru_cache(maxsize=64)
def _prototype(model: type[Camera], count: int, dtype: torch.dtype) -> Camera:
    """Some camera of a model."""
    with torch.inference_mode(False):
        ones = torch.ones(4, dtype=dtype)
        return model(ones, ones.new_tensor(model.ideal(count))).detach()
