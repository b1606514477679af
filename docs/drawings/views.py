"""Pictures of projections and of plots."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import torch
from PIL import Image

import camtorch as ct
from camtorch._drawing import PAPER, shown
from drawings.augmentations import GAP, TILE, WIDTH, put
from drawings.models import rendered
from drawings.pages import DOCS, IMAGES, code, sections

TESTS = DOCS.parent / "tests"


def pair(camera: ct.Camera, made: ct.Warp | ct.views.Views) -> Image.Image:
    """A room before and after a warp, or in several views, three in a row."""
    height, width = TILE
    large, _ = rendered(camera, 4)
    after = made(large[None])[0]
    if after.ndim == 4:
        after = torch.cat([torch.cat(list(row), -1) for row in after.split(3)], -2)
    tiles = []
    for image in (large, after):
        scale = min(height / image.shape[-2], width / image.shape[-1])
        tiles.append(shown(image, round(scale * image.shape[-2]), round(scale * image.shape[-1])))
    sheet = Image.new("RGB", (WIDTH, max(tile.height for tile in tiles) + 2 * GAP), PAPER)
    for i, tile in enumerate(tiles):
        put(sheet, tile, GAP + i * (width + GAP) + (width - tile.width) // 2, (sheet.height - tile.height) // 2)
    return sheet


def figures(text: str) -> Image.Image:
    """What code plots, in rows of two, on white."""
    plt.close("all")
    exec(text, {})
    tiles = []
    for number in plt.get_fignums():
        figure = plt.figure(number)
        figure.set_size_inches(7.2, 5.4)
        file = io.BytesIO()
        figure.savefig(file, dpi=83)
        tiles.append(Image.open(file).convert("RGB"))
    plt.close("all")
    columns = min(2, len(tiles))
    width, height = tiles[0].size
    rows = -(-len(tiles) // columns)
    sheet = Image.new("RGB", (columns * width, rows * height), "white")
    for i, tile in enumerate(tiles):
        sheet.paste(tile, (i % columns * width, i // columns * height))
    return sheet


def files(folder: Path) -> None:
    """What the code on the page reads."""
    import numpy as np

    sys.path.insert(0, str(TESTS))
    from boards import opencv_left

    shutil.copy(TESTS / "files" / "kalibr_camchain.yaml", folder / "camchain.yaml")
    left, _ = opencv_left()
    np.savez(folder / "corners.npz", object_points=left.object_points, image_points=left.image_points)


def main(names: list[str]) -> None:
    """Make all pictures of the page, or some by the names of their files."""
    folder = IMAGES / "views"
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        files(Path(place))
        for text in sections("views.md").values():
            name = re.findall(r"\(\.\./images/views/(.*?)\)", text)[0]
            if names and Path(name).stem not in names:
                continue
            if name.endswith(".png"):
                with contextlib.chdir(place):
                    sheet = figures(code(text))
                sheet.quantize(128, dither=Image.Dither.NONE).save(folder / name, optimize=True)
            else:
                made: dict[str, Any] = {}
                exec(code(text), made)
                moved = (made.get("warp") or made["views"]).requires_grad_(False)
                pair(made["camera"], moved).save(folder / name, quality=80, optimize=True)
