"""A contact sheet of views: the first one larger, labels drawn on all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from camtorch.cli.augment import LabelledImage

TILE = (315, 420)
"""(height, width) within which the new images are shown."""
POINT, BOX, GAZE = (226, 29, 72), (255, 190, 40), (30, 100, 240)
"""The colours of the marks."""
_INK, _GREY, _RIM, _PAPER = (43, 42, 46), (122, 112, 100), (214, 202, 182), (250, 245, 235)
_WHITE = (255, 255, 255, 235)
_GAP, _BAND, _LINE = 20, 54, 21
_NARROWEST = 340  # px that captions need
_SHARP = 3  # marks are drawn that many times as large, and reduced
_REACH = 0.35  # length of gaze arrows, as a part of the distance to the eyes


def drawing(views: Sequence[LabelledImage], title: str, origin: str):
    """One Pillow image: the view before, and the others, `title` and `origin` above them."""
    from PIL import Image, ImageDraw, ImageFont

    large, middle, small = (ImageFont.load_default(size=size) for size in (34, 18, 16))
    cell = _fitted(views[1].image, *TILE)
    cell = cell[0], max(cell[1], _NARROWEST)
    columns, span = _columns(len(views) - 1)
    lot = cell[0] + _BAND + _GAP, cell[1] + _GAP
    width = columns * lot[1] + _GAP
    origin = _wrapped(origin, middle, width - 2 * _GAP)
    head = 66 + 24 * len(origin) + 14
    rows = -(-(len(views) - 1 + span * span) // columns)
    sheet = Image.new("RGB", (width, head + rows * lot[0]), _PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((_GAP, 14), title, _INK, large)
    _legend(sheet, views[0], width - _GAP, 26, middle)
    for i, line in enumerate(origin):
        draw.text((_GAP, 64 + 24 * i), line, _GREY, middle)
    places = [(row, column) for row in range(rows) for column in range(columns) if row >= span or column >= span]
    for view, (row, column) in zip(views, [(0, 0), *places], strict=False):
        room = (span * lot[0] - _BAND - _GAP, span * lot[1] - _GAP) if view is views[0] else cell
        tile = marked(view, *room)
        left, top = _GAP + column * lot[1], head + row * lot[0]
        sheet.paste(tile, (left, top))
        draw.rectangle((left - 1, top - 1, left + tile.width, top + tile.height), outline=_RIM)
        font, below = (middle if room != cell else small), top + tile.height + 8
        for i, line in enumerate(view.caption):
            draw.text((left, below + _LINE * i), _shortened(line, font, room[1]), _INK if i == 0 else _GREY, font)
    return sheet


def _legend(sheet, view: LabelledImage, right: float, top: float, font) -> None:
    """What the marks are, from the right."""
    from PIL import Image, ImageDraw

    labels, wide, high = view.labels, 30, 22
    draw = ImageDraw.Draw(sheet)
    for name, there in (("gaze", labels.gaze), ("boxes", labels.boxes), ("points", labels.keypoints)):
        if len(there) == 0:
            continue
        right -= font.getlength(name)
        draw.text((right, top), name, _GREY, font)
        icon = Image.new("RGBA", (_SHARP * wide, _SHARP * high))
        on, x, y = ImageDraw.Draw(icon), _SHARP * wide, _SHARP * high
        if name == "gaze":
            _arrow(on, (0.1 * x, 0.5 * y), (0.85 * x, 0.5 * y), _SHARP)
        elif name == "boxes":
            _box(on, (0.35 * x, 0.25 * y, 0.8 * x, 0.75 * y), _SHARP)
        else:
            _dot(on, (0.7 * x, 0.5 * y), 1.3 * _SHARP)
        right -= wide + 3
        icon = icon.reduce(_SHARP)
        sheet.paste(icon, (round(right), round(top)), icon)
        right -= 14


def counted(number: int, name: str) -> str:
    """The number in words if it is small, and the name in the plural if it is not one."""
    words = ["one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
    return f"{words[number - 1] if number <= len(words) else number} {name}{'s' * (number != 1)}"


def marked(view: LabelledImage, height: int, width: int):
    """A Pillow image of a view, as large as fits, with its valid labels."""
    from PIL import Image, ImageDraw

    height, width = _fitted(view.image, height, width)
    image = Image.fromarray(view.image.permute(1, 2, 0).contiguous().numpy())
    image = image.resize((width, height), Image.Resampling.LANCZOS)
    scale = width / view.image.shape[-1]
    weight = _SHARP * max(1.0, width / 640)

    def place(pixel) -> tuple[float, float]:
        return tuple(_SHARP * min(max((float(c) + 0.5) * scale, -9.0 * width), 9.0 * width) for c in pixel)

    marks = Image.new("RGBA", (_SHARP * width, _SHARP * height))
    draw = ImageDraw.Draw(marks)
    labels = view.labels
    for box, valid in zip(labels.boxes, view.boxes_valid, strict=True):
        if valid:
            _box(draw, (*place(box[:2]), *place(box[2:])), weight)
    for start, end in _arrows(view):
        _arrow(draw, place(start), place(end), weight)
    for pixel, valid in zip(labels.keypoints, view.keypoints_valid, strict=True):
        if valid:
            _dot(draw, place(pixel), weight)
    marks = marks.reduce(_SHARP)
    image.paste(marks, (0, 0), marks)
    return image


def _dot(draw, at, weight: float) -> None:
    for radius, colour in ((2.7 * weight, _WHITE), (1.9 * weight, POINT)):
        draw.ellipse([c + s * radius for s in (-1, 1) for c in at], fill=colour)


def _box(draw, edges, weight: float) -> None:
    for out, width, colour in ((1.6, 3.4, (*_INK, 150)), (1.0, 2.0, BOX)):
        grown = [e + s * out * weight for e, s in zip(edges, (-1, -1, 1, 1), strict=True)]
        draw.rounded_rectangle(grown, (1 + out) * weight, outline=colour, width=round(width * weight))


def _arrows(view: LabelledImage):
    """Pixels of the eyes that the image shows, and of the places at which they look."""
    labels, camera = view.labels, view.camera
    ends = labels.eyes + _REACH * labels.eyes.norm(dim=-1, keepdim=True) * labels.gaze
    (start, seen), (end, ahead) = camera.project(labels.eyes), camera.project(ends)
    use = seen & ahead & camera.contains(start)
    return list(zip(start[use].tolist(), end[use].tolist(), strict=True))


def _arrow(draw, start, end, weight: float) -> None:
    length = math.dist(start, end)
    if length < weight:
        return
    along = [(e - s) / length for s, e in zip(start, end, strict=True)]
    across = -along[1], along[0]
    tip = min(9 * weight, 0.5 * length)
    for rim, colour in ((1.3 * weight, _WHITE), (0.0, GAZE)):
        neck = [e - tip * a for e, a in zip(end, along, strict=True)]
        draw.line((*start, *neck), fill=colour, width=round(2.4 * weight + 2 * rim))
        corners = [(end[0] + 1.6 * rim * along[0], end[1] + 1.6 * rim * along[1])]
        corners += [
            tuple(n - rim * a + side * (0.5 * tip + 1.4 * rim) * b for n, a, b in zip(neck, along, across, strict=True))
            for side in (-1, 1)
        ]
        draw.polygon(corners, fill=colour)
        radius = 1.2 * weight + rim
        draw.ellipse((start[0] - radius, start[1] - radius, start[0] + radius, start[1] + radius), fill=colour)


def _fitted(image: torch.Tensor, height: int, width: int) -> tuple[int, int]:
    """The largest (height, width) of that shape within another."""
    scale = min(height / image.shape[-2], width / image.shape[-1])
    return max(1, round(image.shape[-2] * scale)), max(1, round(image.shape[-1] * scale))


def _columns(count: int) -> tuple[int, int]:
    """How many columns a sheet has, and how many of them, and rows, the first view takes."""
    if count < 4:
        return count + 1, 1
    cells = count + 4
    # few cells empty, and somewhat wider than high
    return min(range(3, 14), key=lambda n: 0.6 * (-cells % n) + abs(math.log(n * n / cells / 1.4))), 2


def _shortened(text: str, font, width: float) -> str:
    while len(text) > 4 and font.getlength(text) > width:
        text = text[:-4] + "..."
    return text


def _wrapped(text: str, font, width: float) -> list[str]:
    lines: list[str] = []
    for word in text.split():
        if lines and font.getlength(f"{lines[-1]} {word}") <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return lines
