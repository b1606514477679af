"""Images in rows, on paper."""

import io
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
from PIL import Image, ImageDraw
from torch import Tensor

from drawings.marks import INK, PAPER, RIM, font, shown

WIDTH, TILE, GAP = 960, (345, 460), 13
"""Pixels: of an image in the galleries, of a part of it at its most (height, width), between them."""


def put(sheet: Image.Image, tile: Image.Image, left: int, top: int) -> None:
    """An image with a rim."""
    sheet.paste(tile, (left, top))
    ImageDraw.Draw(sheet).rectangle((left - 1, top - 1, left + tile.width, top + tile.height), outline=RIM)


def pair(before: Image.Image, after: Image.Image) -> Image.Image:
    """One on the left, one on the right, both at most as large as a tile."""
    sheet = Image.new("RGB", (WIDTH, max(before.height, after.height) + 2 * GAP), PAPER)
    for i, tile in enumerate((before, after)):
        left = GAP + i * (TILE[1] + GAP) + (TILE[1] - tile.width) // 2
        put(sheet, tile, left, (sheet.height - tile.height) // 2)
    return sheet


def in_rows(panels: Sequence[tuple[Image.Image, str]], columns: int) -> Image.Image:
    """Images of one size with their titles above them."""
    (width, height), gap, band = panels[0][0].size, 16, 30
    rows = -(-len(panels) // columns)
    sheet = Image.new("RGB", (columns * (width + gap) + gap, rows * (height + band + gap) + gap), PAPER)
    for i, (tile, title) in enumerate(panels):
        left, top = gap + i % columns * (width + gap), gap + i // columns * (height + band + gap)
        put(sheet, tile, left, top + band)
        ImageDraw.Draw(sheet).text((left, top), title, INK, font(18))
    return sheet


def tiles(panels: Sequence[tuple[Tensor, str]], columns: int) -> Image.Image:
    """The same of images (3, H, W) in [0, 1]."""
    return in_rows([(shown(image, *image.shape[1:]), title) for image, title in panels], columns)


def drawn(figure: plt.Figure, **options: Any) -> Image.Image:
    """A figure as an image; it is closed."""
    file = io.BytesIO()
    figure.savefig(file, **{"dpi": figure.dpi} | options)
    plt.close(figure)
    return Image.open(file).convert("RGB")
