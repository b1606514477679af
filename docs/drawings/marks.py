"""Marks on images, in one palette, drawn by Pillow."""

import functools
import math
from collections.abc import Sequence
from typing import Any

from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont

INK, GREY, RIM, PAPER = (43, 42, 46), (122, 112, 100), (214, 202, 182), (250, 245, 235)
POINT, BOX, GAZE = (226, 29, 72), (255, 190, 40), (30, 100, 240)
"""The colours of marks."""
WHITE = (255, 255, 255, 235)
_REACH = 0.35  # length of gaze arrows, as a part of the distance to the eyes
_SHARP = 3  # marks are drawn that many times as large, and reduced


@functools.cache
def font(size: int) -> Font:
    """Pillow's own font."""
    return ImageFont.load_default(size=size)


def shown(pixels: Tensor, height: int, width: int) -> Image.Image:
    """An image (3, H, W), uint8 or of values from 0 to 1, in another size."""
    if pixels.is_floating_point():
        pixels = (255 * pixels).round().byte()
    image = Image.fromarray(pixels.permute(1, 2, 0).contiguous().numpy())
    return image.resize((width, height), Image.Resampling.LANCZOS)


class Marks:
    """Marks with smooth edges, to be laid over an image.

    Places are the pixels (x, y) of an original, an integer being a pixel's centre; lengths are pixels of the image
    shown.

    Args:
        width: of the image shown.
        height: likewise.
        scale: how many of its pixels one of the original takes.
    """

    def __init__(self, width: int, height: int, scale: float = 1.0):
        self.width, self.height, self.scale = width, height, scale
        self._image = Image.new("RGBA", (_SHARP * width, _SHARP * height))
        self._draw = ImageDraw.Draw(self._image)

    def over(self, image: Image.Image) -> None:
        """Lay the marks over an image."""
        marks = self._image.reduce(_SHARP)
        image.paste(marks, (0, 0), marks)

    def point(self, at: Sequence[float] | Tensor, weight: float = 1.0) -> None:
        """A keypoint, on any ground; likewise boxes and arrows: the weight is that of lines."""
        x, y = self._place(at)
        for radius, colour in ((2.7, WHITE), (1.9, POINT)):
            r = _SHARP * radius * weight
            self._draw.ellipse((x - r, y - r, x + r, y + r), colour)

    def box(self, edges: Sequence[float] | Tensor, weight: float = 1.0) -> None:
        """A box x1, y1, x2, y2."""
        corners = (*self._place(edges[:2]), *self._place(edges[2:]))
        weight *= _SHARP
        for out, width, colour in ((1.6, 3.4, (*INK, 150)), (1.0, 2.0, BOX)):
            x1, y1, x2, y2 = (c + s * out * weight for c, s in zip(corners, (-1, -1, 1, 1), strict=True))
            self._draw.rounded_rectangle(
                (x1, y1, x2, y2), (1 + out) * weight, outline=colour, width=round(width * weight)
            )

    def arrow(self, start: Sequence[float] | Tensor, end: Sequence[float] | Tensor, weight: float = 1.0) -> None:
        """An arrow, unless it would be a point."""
        (x, y), (to_x, to_y) = self._place(start), self._place(end)
        length, weight = math.dist((x, y), (to_x, to_y)), _SHARP * weight
        if length < weight:
            return
        along_x, along_y, tip = (to_x - x) / length, (to_y - y) / length, min(9 * weight, 0.5 * length)
        for rim, colour in ((1.3 * weight, WHITE), (0.0, GAZE)):
            neck, half = tip + rim, 0.5 * tip + 1.4 * rim
            back_x, back_y = to_x - neck * along_x, to_y - neck * along_y
            self._draw.line((x, y, back_x, back_y), fill=colour, width=round(2.4 * weight + 2 * rim))
            point = to_x + 1.6 * rim * along_x, to_y + 1.6 * rim * along_y
            sides = [(back_x + s * half * along_y, back_y - s * half * along_x) for s in (1, -1)]
            self._draw.polygon([point, *sides], fill=colour)

    def _place(self, pixel: Sequence[float] | Tensor) -> tuple[float, float]:
        # drawn in: what lies far off must not make Pillow draw for ever
        far = 9.0 * self.width
        x, y = (_SHARP * min(max((float(c) + 0.5) * self.scale, -far), far) for c in pixel)
        return x, y


def mark(marks: Marks, sample: dict[str, Any], weight: float) -> None:
    """Mark the valid `boxes` and `keypoints` of a sample, and its `gaze` from `points`."""
    for box in _valid(sample, "boxes"):
        marks.box(box, weight)
    if "gaze" in sample:
        eyes, camera = sample["points"], sample["camera"]
        ends = eyes + _REACH * eyes.norm(dim=-1, keepdim=True) * sample["gaze"]
        (start, seen), (end, ahead) = camera.project(eyes), camera.project(ends)
        for i in (seen & ahead & camera.contains(start)).nonzero()[:, 0].tolist():
            marks.arrow(start[i], end[i], weight)
    for pixel in _valid(sample, "keypoints"):
        marks.point(pixel, weight)


def _valid(sample: dict[str, Any], name: str) -> Sequence[Tensor]:
    valid = sample.get(f"{name}_valid", slice(None))
    return sample[name][valid] if name in sample else ()


def marked(sample: dict[str, Any], height: int, width: int) -> Image.Image:
    """The image of a sample, (3, H, W), as large as fits, with its valid labels."""
    rows, columns = sample["image"].shape[-2:]
    scale = min(height / rows, width / columns)
    height, width = max(1, round(rows * scale)), max(1, round(columns * scale))
    tile, marks = shown(sample["image"], height, width), Marks(width, height, width / columns)
    mark(marks, sample, max(1.0, width / 640))
    marks.over(tile)
    return tile
