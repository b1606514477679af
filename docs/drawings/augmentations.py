"""One image for each augmentation: a sample with its labels before and after."""

import re
from typing import Any

import torch
from PIL import Image, ImageDraw, ImageFilter
from scenes import cabin, portrait

import camtorch as ct
from drawings.marks import INK, PAPER, Marks, font, mark, shown
from drawings.pages import IMAGES, code, sections
from drawings.sheets import GAP, TILE, WIDTH, pair, put

VIOLET = (150, 60, 230)
BAND = 28  # pixels of a caption
SEEDS = {"mount": 3, "real": 7, "resized-crop": 4, "crop": 2, "camera": 4}
"""Of draws, by the file's name; 1 otherwise."""


def sample() -> dict[str, Any]:
    """The driver behind a fisheye, with labels."""
    lens = ct.KannalaBrandt.from_fov(130, image_size=(480, 640), distortion=[0.02, -0.01, 0.003, -0.001])
    found = portrait.driver(lens.double().requires_grad_(False))
    classes = cabin.render_classes(found.camera, found.drivers)[0]
    person = [cabin.CLASSES.index(name) for name in ("skin", "hair", "eye", "clothes")]
    return {
        "image": found.image,
        "mask": torch.isin(classes, torch.tensor(person, dtype=classes.dtype)),
        "keypoints": found.keypoints,
        "boxes": found.boxes,
        "points": found.eyes,
        "gaze": found.gaze,
        "head_pose": found.drivers.pose[0],
        "camera": found.camera,
    }


def marked(of: dict[str, Any], scale: float) -> Image.Image:
    """The image of a sample, with its valid labels, and the rim of its mask."""
    height, width = (max(1, round(scale * side)) for side in of["image"].shape[-2:])
    tile = shown(of["image"], height, width)
    mask = Image.fromarray(255 * of["mask"][0].byte().numpy()).resize((width, height), Image.Resampling.BILINEAR)
    mask = mask.point(lambda value: 255 * (value > 127))
    rim = Image.composite(Image.new("L", mask.size), mask.filter(ImageFilter.MaxFilter(5)), mask)
    tile.paste(VIOLET, (0, 0), rim.filter(ImageFilter.SMOOTH))
    marks = Marks(width, height, scale)
    mark(marks, of, 1.0)
    marks.over(tile)
    return tile


def scale_of(of: dict[str, Any], height: int, width: int, most: float) -> float:
    """How large an image is shown: `most`, or less to fit."""
    return min(height / of["image"].shape[-2], width / of["image"].shape[-1], most)


def in_one_scale(before: dict[str, Any], after: dict[str, Any]) -> tuple[Image.Image, Image.Image]:
    """Before and after, in one scale where they fit."""
    scale = scale_of(before, *TILE, 9)
    return marked(before, scale), marked(after, scale_of(after, *TILE, scale))


def several(before: dict[str, Any], after: dict[str, dict[str, Any]]) -> Image.Image:
    """Before and all that follow, with captions, in rows."""
    columns = 2 if len(after) in (1, 3) else 3
    width = (WIDTH - GAP) // columns - GAP
    height = width * 3 // 4
    views = [("before", before), *after.items()]
    rows = -(-len(views) // columns)
    sheet = Image.new("RGB", (WIDTH, rows * (height + BAND + GAP) + GAP), PAPER)
    for i, (name, view) in enumerate(views):
        left, top = GAP + i % columns * (width + GAP), GAP // 2 + i // columns * (height + BAND + GAP)
        tile = marked(view, scale_of(view, height, width, 9))
        ImageDraw.Draw(sheet).text((left + width / 2, top), name, INK, font(20), anchor="ma")
        put(sheet, tile, left + (width - tile.width) // 2, top + BAND + (height - tile.height) // 2)
    return sheet


def main(names: list[str]) -> None:
    """Make the images of all augmentations, or of some by the names of their files."""
    folder = IMAGES / "augment"
    folder.mkdir(exist_ok=True)
    before = sample()
    for title, text in sections("augmentations.md").items():
        file = re.search(r"\(\.\./images/augment/(.*?)\.jpg\)", text)
        if file is None:
            raise ValueError(f"{title}: no image")
        if names and file[1] not in names:
            continue
        made: dict[str, Any] = {}
        exec(code(text), made)
        torch.manual_seed(SEEDS.get(file[1], 1))
        if "augment" in made:
            sheet = pair(*in_one_scale(before, made["augment"](before)))
        else:
            views = {name: augment(before) for name, augment in made["augments"].items()}
            sheet = several(before, views)
        sheet.save(folder / f"{file[1]}.jpg", quality=82, optimize=True)
