"""A sheet of labelled images: labels drawn on all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from PIL import Image

from camtorch._drawing import GREY, INK, MARGIN, MIDDLE, SMALL, Marks, Sheet, shortened, shown, wrapped
from camtorch.cli.labelled_image import LabelledImage

TILE = (315, 420)
"""(height, width) within which the new images are shown."""
_BAND, _LINE = 54, 21
_NARROWEST = 340  # px that captions need
_WIDER = 1.4  # columns for each row
_REACH = 0.35  # length of gaze arrows, as a part of the distance to the eyes


def drawing(images: Sequence[LabelledImage], title: str, origin: str) -> Image.Image:
    """One image of all, that before first; `title` and `origin` stand above."""
    cell = _fitted(images[1].image, *TILE)
    cell = cell[0], max(cell[1], _NARROWEST)
    columns = min(len(images), math.ceil(math.sqrt(_WIDER * len(images))))
    lot = cell[0] + _BAND + MARGIN, cell[1] + MARGIN
    width = columns * lot[1] + MARGIN
    lines = wrapped(origin, MIDDLE, width - 2 * MARGIN)
    head = 66 + 24 * len(lines) + 14
    sheet = Sheet(width, head + -(-len(images) // columns) * lot[0], title)
    for i, line in enumerate(lines):
        sheet.text((MARGIN, 64 + 24 * i), line, size=MIDDLE, colour=GREY)
    for number, image in enumerate(images):
        row, column = divmod(number, columns)
        tile, left, top = marked(image, *cell), MARGIN + column * lot[1], head + row * lot[0]
        sheet.put(tile, (left, top))
        for i, line in enumerate(image.caption):
            at = left, top + tile.height + 8 + _LINE * i
            sheet.text(at, shortened(line, SMALL, cell[1]), size=SMALL, colour=INK if i == 0 else GREY)
    return sheet.image


def marked(image: LabelledImage, height: int, width: int) -> Image.Image:
    """An image, as large as fits, with its valid labels."""
    height, width = _fitted(image.image, height, width)
    tile = shown(image.image, height, width)
    marks = Marks(width, height, width / image.image.shape[-1])
    weight = max(1.0, width / 640)
    labels = image.labels
    for box in labels.boxes[image.boxes_valid]:
        marks.box(box, weight)
    for start, end in arrows(image):
        marks.arrow(start, end, weight)
    for pixel in labels.keypoints[image.keypoints_valid]:
        marks.point(pixel, weight)
    marks.over(tile)
    return tile


def arrows(image: LabelledImage) -> list[tuple[list[float], list[float]]]:
    """Pixels of the eyes that the image shows, and of the places at which they look."""
    labels, camera = image.labels, image.camera
    ends = labels.eyes + _REACH * labels.eyes.norm(dim=-1, keepdim=True) * labels.gaze
    (start, seen), (end, ahead) = camera.project(labels.eyes), camera.project(ends)
    use = seen & ahead & camera.contains(start)
    return list(zip(start[use].tolist(), end[use].tolist(), strict=True))


def _fitted(image: torch.Tensor, height: int, width: int) -> tuple[int, int]:
    """The largest (height, width) of that shape within another."""
    scale = min(height / image.shape[-2], width / image.shape[-1])
    return max(1, round(image.shape[-2] * scale)), max(1, round(image.shape[-1] * scale))
