"""Images bent as rubber is, with all their labels: a B-spline surface after the lens."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch._arguments import as_whole, columns
from camtorch._derived import with_surface
from camtorch.augment.augmentation import Augmentation, EditOptions, Range, as_range
from camtorch.camera import Camera
from camtorch.optics.charts import Chart

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
        grid: (down, across): cells of the surface over the image, or one number; more cells bend more finely.
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
        grid: int | Sequence[int] = 6,
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
        self.grid = down, across
        self.ranges: dict[str, Range] = {
            "amount": drawn,
            "bends": Range(-1, 1, 2 * (across + _BESIDE) * (down + _BESIDE)),
        }

    def new_camera(self, source: Camera, values: Mapping[str, Tensor]) -> tuple[Camera, None]:
        """The camera with the surface; see `Augmentation.new_camera`."""
        if ":elastic=" in source.key:
            raise ValueError(f"{self._name}: the camera is elastic already, {source.key}")
        try:
            _chart_of(source).end(torch.float32)
        except NotImplementedError:
            raise ValueError(
                f"{self._name}: no surface can follow {type(source).__name__}, whose formula has no lens after it; "
                "camera.convert(ct.KannalaBrandt).camera is one that has"
            ) from None
        height, width = source._size_for(self._name)
        down, across = self.grid
        focal, centre = source.intrinsics.detach().split(2, -1)
        middle = (centre.new_tensor([width - 1, height - 1]) / 2 - centre) / focal
        cells = centre.new_tensor([across / width, down / height]) * focal
        # the principal point of what was cut out may lie outside of the image, and shall lie on the surface
        away = ((middle * cells).abs().reshape(-1, 2).amax(0) - centre.new_tensor([across, down]) / 2).tolist()
        more = [max(0, math.ceil(w)) for w in away]
        bends = values["bends"].unflatten(-1, (down + _BESIDE, across + _BESIDE, 2))
        bends = torch.nn.functional.pad(bends, (0, 0, more[0], more[0], more[1], more[1]))
        moved = values["amount"][..., None, None, None] * min(height, width) * bends
        model: type[Camera] = with_surface(type_before_parametrizations(source), *bends.shape[-2:-4:-1])
        batch = torch.broadcast_shapes(moved.shape[:-3], source.batch_shape)
        moved = moved.expand(*batch, *moved.shape[-3:]) / focal[..., None, None, :]
        parts = source.distortion, cells, middle, moved.flatten(-3)
        distortion = torch.cat([part.expand(*batch, part.shape[-1]).to(moved.dtype) for part in parts], -1)
        intrinsics = source.intrinsics.expand(*batch, 4).to(moved.dtype)
        return model(intrinsics, distortion, image_size=source.image_size).freeze_like(source), None


def _chart_of(camera: Camera) -> Chart:
    """The chart of a camera of that model."""
    ideal = camera.ideal(camera.distortion.shape[-1])
    return camera.optics(columns(camera.distortion.new_tensor([ideal])))[0]
