"""Images of projections and of plots."""

import contextlib
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from boards import opencv_left
from PIL import Image

import camtorch as ct
from drawings.marks import shown
from drawings.models import rendered
from drawings.pages import DOCS, IMAGES, code, sections
from drawings.sheets import TILE, drawn, pair

TESTS = DOCS.parent / "tests"


def before_and_after(camera: ct.Camera, made: ct.Warp | ct.views.Views) -> list[Image.Image]:
    """A room before and after a warp, or in several views, three in a row."""
    large, _ = rendered(camera, 4)
    after = made(large[None])[0]
    if after.ndim == 4:
        after = torch.cat([torch.cat(list(row), -1) for row in after.split(3)], -2)
    tiles = []
    for image in (large, after):
        scale = min(most / side for most, side in zip(TILE, image.shape[-2:], strict=True))
        tiles.append(shown(image, *(round(scale * side) for side in image.shape[-2:])))
    return tiles


def figures(text: str) -> Image.Image:
    """What code plots, in rows of two, on white."""
    plt.close("all")
    exec(text, {})
    tiles = []
    for number in plt.get_fignums():
        figure = plt.figure(number)
        if len(plt.get_fignums()) > 1:
            figure.set_size_inches(7.2, 5.4)
        tiles.append(drawn(figure, dpi=83))
    columns = min(2, len(tiles))
    width, height = tiles[0].size
    rows = -(-len(tiles) // columns)
    sheet = Image.new("RGB", (columns * width, rows * height), "white")
    for i, tile in enumerate(tiles):
        sheet.paste(tile, (i % columns * width, i // columns * height))
    return sheet


def files(folder: Path) -> None:
    """What the code on the page reads."""
    shutil.copy(TESTS / "files" / "kalibr_camchain.yaml", folder / "camchain.yaml")
    left, _ = opencv_left()
    np.savez(folder / "corners.npz", object_points=left.object_points, image_points=left.image_points)


def main(names: list[str]) -> None:
    """Make all images of the page, or some by the names of their files."""
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
                pair(*before_and_after(made["camera"], moved)).save(folder / name, quality=80, optimize=True)
