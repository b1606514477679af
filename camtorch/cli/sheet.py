"""Samples as images: with marks where their labels are, and many on a sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence

from PIL import Image, ImageDraw
from torch import Tensor

from camtorch._drawing import GREY, INK, PAPER, RIM, Marks, font, shown
from camtorch.augment.sample import Sample

TILE = (315, 420)
"""(height, width) within which images are shown."""
_TITLE, _BAND, _LINE, _MARGIN = 80, 54, 21, 20
_NARROWEST = 340  # px that captions need
_WIDER = 1.4  # columns for each row
_REACH = 0.35  # length of gaze arrows, as a part of the distance to the eyes


def sheet(samples: Sequence[tuple[Sample, list[str]]], title: str) -> Image.Image:
    """One image of all samples, each with the lines of its caption."""
    height, width = fitted(samples[-1][0]["image"], *TILE)
    columns = min(len(samples), math.ceil(math.sqrt(_WIDER * len(samples))))
    down, across = height + _BAND + _MARGIN, max(width, _NARROWEST) + _MARGIN
    page = Image.new("RGB", (columns * across + _MARGIN, _TITLE - (-len(samples) // columns) * down), PAPER)
    draw = ImageDraw.Draw(page)
    draw.text((_MARGIN, 14), title, INK, font(34))
    for number, (sample, caption) in enumerate(samples):
        row, column = divmod(number, columns)
        tile, left, top = marked(sample, height, width), _MARGIN + column * across, _TITLE + row * down
        page.paste(tile, (left, top))
        draw.rectangle((left - 1, top - 1, left + tile.width, top + tile.height), outline=RIM)
        for i, line in enumerate(caption):
            draw.text((left, top + tile.height + 8 + _LINE * i), line, GREY if i else INK, font(16))
    return page


def marked(sample: Sample, height: int, width: int) -> Image.Image:
    """The image of a sample, (3, H, W), as large as fits, with its valid `keypoints`, `boxes` and `gaze`."""
    height, width = fitted(sample["image"], height, width)
    tile = shown(sample["image"], height, width)
    marks = Marks(width, height, width / sample["image"].shape[-1])
    mark(marks, sample, max(1.0, width / 640))
    marks.over(tile)
    return tile


def mark(marks: Marks, sample: Sample, weight: float) -> None:
    """Mark what a sample has of valid `boxes`, of `gaze` from `points`, and of valid `keypoints`."""
    for box in _valid(sample, "boxes"):
        marks.box(box, weight)
    for start, end in arrows(sample):
        marks.arrow(start, end, weight)
    for pixel in _valid(sample, "keypoints"):
        marks.point(pixel, weight)


def _valid(sample: Sample, name: str) -> Sequence[Tensor]:
    if name not in sample:
        return ()
    places: Sequence[Tensor] = sample[name][sample[f"{name}_valid"]] if f"{name}_valid" in sample else sample[name]
    return places


def arrows(sample: Sample) -> list[tuple[list[float], list[float]]]:
    """Pixels of the eyes, `points`, that the image shows, and of the places at which they look, along `gaze`."""
    if "points" not in sample or "gaze" not in sample:
        return []
    eyes, camera = sample["points"], sample["camera"]
    ends = eyes + _REACH * eyes.norm(dim=-1, keepdim=True) * sample["gaze"]
    (start, seen), (end, ahead) = camera.project(eyes), camera.project(ends)
    use = seen & ahead & camera.contains(start)
    return list(zip(start[use].tolist(), end[use].tolist(), strict=True))


def fitted(image: Tensor, height: int, width: int) -> tuple[int, int]:
    """The largest (height, width) of that shape within another."""
    scale = min(height / image.shape[-2], width / image.shape[-1])
    return max(1, round(image.shape[-2] * scale)), max(1, round(image.shape[-1] * scale))
