"""A sheet of labelled images: the first one larger, labels drawn on all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from PIL import Image

from camtorch._drawing import GREY, INK, MARGIN, MIDDLE, SMALL, Marks, Sheet, font, shortened, shown, wrapped
from camtorch.cli.labelled_image import LabelledImage

TILE = (315, 420)
"""(height, width) within which the new images are shown."""
_BAND, _LINE = 54, 21
_NARROWEST = 340  # px that captions need
_REACH = 0.35  # length of gaze arrows, as a part of the distance to the eyes


def drawing(images: Sequence[LabelledImage], title: str, origin: str) -> Image.Image:
    """One image of all: the first and larger one is that before; `title` and `origin` stand above."""
    cell = _fitted(images[1].image, *TILE)
    cell = cell[0], max(cell[1], _NARROWEST)
    columns, span = _columns(len(images) - 1)
    lot = cell[0] + _BAND + MARGIN, cell[1] + MARGIN
    width = columns * lot[1] + MARGIN
    lines = wrapped(origin, MIDDLE, width - 2 * MARGIN)
    head = 66 + 24 * len(lines) + 14
    rows = -(-(len(images) - 1 + span * span) // columns)
    sheet = Sheet(width, head + rows * lot[0], title)
    if not images[0].is_made_up:
        _legend(sheet, images[0], width - MARGIN, 26)
    for i, line in enumerate(lines):
        sheet.text((MARGIN, 64 + 24 * i), line, size=MIDDLE, colour=GREY)
    places = [(row, column) for row in range(rows) for column in range(columns) if row >= span or column >= span]
    for image, (row, column) in zip(images, [(0, 0), *places], strict=False):
        first = image is images[0]
        room = (span * lot[0] - _BAND - MARGIN, span * lot[1] - MARGIN) if first else cell
        tile = marked(image, *room)
        left, top = MARGIN + column * lot[1], head + row * lot[0]
        sheet.put(tile, (left, top))
        size, below = MIDDLE if first and room != cell else SMALL, top + tile.height + 8
        for i, line in enumerate(image.caption):
            text = shortened(line, size, room[1])
            sheet.text((left, below + _LINE * i), text, size=size, colour=INK if i == 0 else GREY)
    return sheet.image


def _legend(sheet: Sheet, image: LabelledImage, right: float, top: int) -> None:
    """What the marks are, from the right."""
    labels, wide, high = image.labels, 30, 22
    for name, there in (("gaze", labels.gaze), ("boxes", labels.boxes), ("points", labels.keypoints)):
        if len(there) == 0:
            continue
        right -= font(MIDDLE).getlength(name)
        sheet.text((right, top), name, size=MIDDLE, colour=GREY)
        icon = Marks(wide, high)
        if name == "gaze":
            icon.arrow((0.1 * wide, 0.5 * high), (0.85 * wide, 0.5 * high))
        elif name == "boxes":
            icon.box((0.35 * wide, 0.25 * high, 0.8 * wide, 0.75 * high))
        else:
            icon.point((0.7 * wide, 0.5 * high), 1.3)
        right -= wide + 3
        icon.over(sheet.image, (round(right), top))
        right -= 14


def counted(number: int, name: str) -> str:
    """The number in words if it is small, and the name in the plural if it is not one."""
    words = ["one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
    return f"{words[number - 1] if number <= len(words) else number} {name}{'s' * (number != 1)}"


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


def _columns(count: int) -> tuple[int, int]:
    """How many columns a sheet has, and how many of them, and rows, the first image takes."""
    if count < 4:
        return count + 1, 1
    cells = count + 4
    # few cells empty, and somewhat wider than high
    return min(range(3, 14), key=lambda n: 0.6 * (-cells % n) + abs(math.log(n * n / cells / 1.4))), 2
