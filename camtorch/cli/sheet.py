"""A sheet of an image with its labels, as other cameras see both."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from camtorch._drawing import GREY, INK, MARGIN, MIDDLE, SMALL, Marks, Sheet, shortened, shown, wrapped
from camtorch.augment import PRESETS, RandomCamera, mount_rotation
from camtorch.camera import Camera
from camtorch.cli import images
from camtorch.cli.labels import Labels

NEW_SIZE = (945, 1260)
"""(height, width) within which new images are made: thrice what a sheet shows, so that its edges are smooth."""
_TILE = (315, 420)  # (height, width) within which they are shown
_NOTHING = (233, 225, 209)  # the colour of what no camera saw
_BAND, _LINE = 54, 21
_NARROWEST = 340  # px that captions need
_WIDER = 1.4  # columns for each row
_REACH = 0.35  # length of gaze arrows, as a part of the distance to the eyes
_REAL = "another of 7,000 calibrated lenses for each image, of the field of view that --fov says"


@dataclass
class LabelledImage:
    """An image, its camera, and labels that hold for both."""

    image: Tensor
    """(3, H, W) uint8."""
    camera: Camera
    labels: Labels
    caption: list[str]
    keypoints_valid: Tensor
    """(N,) bool; likewise the boxes'."""
    boxes_valid: Tensor
    filled: float = 1.0
    """The part of the image that shows something."""
    note: str = ""
    """The caption, and more, in one line."""
    is_made_up: bool = False
    """Whether the labels are a lattice that only shows how the image is bent."""


# -- presets


def lens(preset: str) -> str | None:
    """What `augmented` gets as `like` for the name of a preset, or for "none".

    Raises:
        ValueError: no preset has this name; the text lists those there are.
    """
    if preset in ("none", "real") or preset in PRESETS:
        return None if preset == "none" else preset
    known = "; ".join(f"{name}, {known.origin}" for name, known in PRESETS.items())
    raise ValueError(f"there is no preset {preset!r}. There are none, the image's own lens; {known}; real, {_REAL}")


def origin(like: str | None, before: LabelledImage) -> str:
    """Where the lens of the new images comes from."""
    if like is None:
        return f"{before.camera.key}: the image's own lens, as lenses made alike differ"
    return f"{like}: {_REAL if like == 'real' else PRESETS[like].origin}"


def presets() -> Iterator[str]:
    """A line about each preset."""
    for name, preset in PRESETS.items():
        height, width = preset.image_size
        yield f"{name:<12} {preset.model:<15} {f'{width}x{height}':<10} {preset.origin}"
    yield f"{'real':<12} {'kannala_brandt':<15} {'any':<10} {_REAL}"


# -- images


@torch.no_grad()
def photograph(image: Tensor, camera: Camera, labels: Labels | None, title: str) -> LabelledImage:
    """An image, (C, H, W) as `images.read` has it; without labels, with a lattice of dots and a box."""
    is_made_up = labels is None
    if labels is None:
        height, width = camera.height, camera.width
        steps = [(torch.arange(n, dtype=torch.float64) + 0.5) * side / n - 0.5 for n, side in ((7, height), (9, width))]
        y, x = torch.meshgrid(*steps, indexing="ij")
        box = torch.tensor([[0.3 * width, 0.25 * height, 0.7 * width, 0.75 * height]], dtype=torch.float64) - 0.5
        none = torch.zeros(0, 3, dtype=torch.float64)
        labels = Labels(torch.stack([x, y], -1).flatten(0, 1), box, none, none)
    x1, y1, x2, y2 = labels.boxes.unbind(-1)
    overlap = (x1 <= camera.width - 0.5) & (x2 >= -0.5) & (y1 <= camera.height - 0.5) & (y2 >= -0.5)
    caption = [f"before: {title}", f"{camera.key}, {float(camera.fov[0]):.0f}° wide"]
    coloured, seen = images.in_colour(image, _NOTHING), camera.contains(labels.keypoints)
    return LabelledImage(coloured, camera, labels, caption, seen, overlap, is_made_up=is_made_up)


@torch.no_grad()
def augmented(
    before: LabelledImage,
    like: str | None,
    count: int,
    seed: int,
    size: tuple[int, int] | None = None,
    min_filled: float = 0.0,
    **ranges: Any,
) -> Iterator[LabelledImage]:
    """What `count` random cameras make of an image.

    Args:
        before: the image.
        like: whose lens they have; see `RandomCamera`.
        count: how many.
        seed: of the draws; the first ones are the same for every count.
        size: (height, width) of the new images; by default that of the old one. They are scaled to fit `NEW_SIZE`
            and show the same.
        min_filled: of `RandomCamera`.
        ranges: its other ones.
    """
    height, width = size or (before.camera.height, before.camera.width)
    scale = min(NEW_SIZE[1] / width, NEW_SIZE[0] / height)
    new = RandomCamera(
        like,
        camera=before.camera,
        image_size=(max(1, round(height * scale)), max(1, round(width * scale))),
        antialias=True,
        fill=_NOTHING,
        valid_mask=True,
        min_filled=min_filled,
        **ranges,
    )
    labels, generator = before.labels, torch.Generator().manual_seed(seed)
    for i in range(count):
        moved = new(
            image=before.image,
            keypoints=labels.keypoints,
            boxes=labels.boxes,
            points=labels.eyes,
            gaze=labels.gaze,
            keypoints_valid=before.keypoints_valid,
            boxes_valid=before.boxes_valid,
            draw=new.draw(1, generator),
        )
        camera, valid = moved["camera"], (moved["keypoints_valid"], moved["boxes_valid"])
        turn = zip(("yaw", "pitch", "roll"), _mount_angles(moved["rotation"]), strict=True)
        # a sum with zero has no negative one
        angles = [f"{name} {round(angle, 1) + 0.0:+.1f}°" for name, angle in turn]
        filled = float(moved["image_valid"].double().mean())
        wide = f"{like or camera.key}, {float(camera.fov[0]):.0f}° wide"
        inside = [f"{int(v.sum())} of {len(v)} {n}" for n, v in zip(("points", "boxes"), valid, strict=True) if len(v)]
        told = [*angles, wide, f"{100 * filled:.0f} % filled", *([] if before.is_made_up else inside)]
        yield LabelledImage(
            moved["image"],
            camera,
            Labels(moved["keypoints"], moved["boxes"], moved["points"], moved["gaze"]),
            ["   ".join(angles), f"{wide}, {100 * filled:.0f} % filled"],
            *valid,
            filled=filled,
            note=f"{i + 1:3}: {', '.join(told)}".replace("°", " degrees"),
        )


def _mount_angles(rotation: Tensor) -> tuple[float, float, float]:
    """Yaw, pitch and roll in degrees, of which `mount_rotation` makes this rotation."""
    x, y, z = rotation[2].double().tolist()  # where the new camera looks, in the old one's frame
    yaw, pitch = math.degrees(math.atan2(x, z)), math.degrees(math.atan2(-y, math.hypot(x, z)))
    rest = rotation.double() @ mount_rotation(*torch.tensor([yaw, pitch, 0.0], dtype=torch.float64)).mT
    return yaw, pitch, math.degrees(math.atan2(float(rest[0, 1]), float(rest[0, 0])))


# -- drawing


def drawing(images: Sequence[LabelledImage], title: str, origin: str) -> Image.Image:
    """One image of all, that before first; `title` and `origin` stand above."""
    cell = _fitted(images[1].image, *_TILE)
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
    for box in image.labels.boxes[image.boxes_valid]:
        marks.box(box, weight)
    for start, end in arrows(image):
        marks.arrow(start, end, weight)
    for pixel in image.labels.keypoints[image.keypoints_valid]:
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


def _fitted(image: Tensor, height: int, width: int) -> tuple[int, int]:
    """The largest (height, width) of that shape within another."""
    scale = min(height / image.shape[-2], width / image.shape[-1])
    return max(1, round(image.shape[-2] * scale)), max(1, round(image.shape[-1] * scale))
