"""An image with its labels, and what an augmentation makes of both: the views that `sheet` shows."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from torch import Tensor

from camtorch.augment import PRESETS, RandomCamera
from camtorch.camera import Camera
from camtorch.cli.labels import Labels
from camtorch.demo import cabin
from camtorch.models import Pinhole

SCENE_SIZE = (480, 640)
"""(height, width) of the rendered image; of a given camera the width is this at most."""
NEW_SIZE = (945, 1260)
"""(height, width) within which new images are made: thrice what a sheet shows, so that its edges are smooth."""
NOTHING = (233, 225, 209)
"""The colour of what no camera saw."""


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
    note: str = ""
    """The caption, and more, in one line."""


# -- what to augment


@torch.no_grad()
def scene(camera: Camera | None = None) -> LabelledImage:
    """The driver that `cabin` renders, seen by a camera, by default a pinhole camera of 105 degrees."""
    height, width = SCENE_SIZE
    if camera is None:
        focal = width / 2 / math.tan(math.radians(105) / 2)
        camera = Pinhole([focal, focal, (width - 1) / 2, (height - 1) / 2], image_size=SCENE_SIZE).requires_grad_(False)
    elif camera.image_size[1] > width:
        camera = camera.resize(max(1, round(camera.image_size[0] * width / camera.image_size[1])), width)
    drivers = cabin.random_drivers(1, spread=0)
    # close by, and looking past the camera: the arrow of a gaze into it would be a point
    turn = torch.tensor(14.0, dtype=torch.float64).deg2rad()
    drivers.pose[0, 0, 0] = drivers.pose[0, 2, 2] = turn.cos()
    drivers.pose[0, 0, 2], drivers.pose[0, 2, 0] = turn.sin(), -turn.sin()
    drivers.pose[0, :3, 3] = torch.tensor([0.01, 0.0, 0.37])
    drivers.gaze = torch.nn.functional.normalize(torch.tensor([[-0.6, 0.3, -1.0]], dtype=torch.float64), dim=-1)
    box = camera.project(drivers.face_box_points()[0])[0].double()
    labels = Labels(
        keypoints=camera.project(drivers.landmarks()[0])[0].double(),
        boxes=torch.cat([box.amin(0), box.amax(0)])[None],
        eyes=drivers.eyes()[0],
        gaze=drivers.gaze.expand(2, 3),
    )
    image = (255 * _rendered(camera, drivers)).round().byte()
    return _before(image, camera, labels, "a rendered driver")


def _rendered(camera: Camera, drivers: cabin.Drivers) -> Tensor:
    """(3, H, W): the image, a strip at a time on each core: threads that share rays wait for each other."""
    height, width = camera.image_size
    rows = 120  # whatever the number of cores, for the same image
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            parts = [camera.crop(top, 0, min(rows, height - top), width) for top in range(0, height, rows)]
            return torch.cat(list(pool.map(lambda part: cabin.render(part, drivers)[0], parts)), -2)
    finally:
        torch.set_num_threads(threads)


@torch.no_grad()
def photograph(image: Tensor, camera: Camera, labels: Labels | None, title: str) -> LabelledImage:
    """An image, (C, H, W) as `image_files.read` has it; without labels, with a lattice of dots and a box."""
    if labels is None:
        height, width = camera.image_size
        steps = [(torch.arange(n, dtype=torch.float64) + 0.5) * side / n - 0.5 for n, side in ((7, height), (9, width))]
        y, x = torch.meshgrid(*steps, indexing="ij")
        box = torch.tensor([[0.3 * width, 0.25 * height, 0.7 * width, 0.75 * height]], dtype=torch.float64) - 0.5
        none = torch.zeros(0, 3, dtype=torch.float64)
        labels = Labels(torch.stack([x, y], -1).flatten(0, 1), box, none, none)
    return _before(_in_colour(image), camera, labels, title)


def _in_colour(image: Tensor) -> Tensor:
    """(3, H, W) uint8 of any image; deep ones from their darkest to their brightest, what is clear on paper."""
    if image.dtype != torch.uint8:
        deep = image.float()
        image = (255 * (deep - deep.min()) / (deep.max() - deep.min()).clamp(min=1)).round().byte()
    if len(image) in (2, 4):
        alpha = image[-1:] / 255
        image = (image[:-1] * alpha + torch.tensor(NOTHING)[:, None, None] * (1 - alpha)).round().byte()
    return image.expand(3, -1, -1)


def _before(image: Tensor, camera: Camera, labels: Labels, title: str) -> LabelledImage:
    height, width = camera.image_size
    x1, y1, x2, y2 = labels.boxes.unbind(-1)
    overlap = (x1 <= width - 0.5) & (x2 >= -0.5) & (y1 <= height - 0.5) & (y2 >= -0.5)
    caption = [f"before: {title}", f"{camera.key}, {_degrees(camera):.0f}° wide"]
    return LabelledImage(image, camera, labels, caption, camera.contains(labels.keypoints), overlap)


# -- augmenting


@torch.no_grad()
def augmented(
    before: LabelledImage, like: str | None, count: int, seed: int, size=None, **ranges
) -> Iterator[LabelledImage]:
    """What `count` random cameras make of a view.

    Args:
        before: the view.
        like: whose lens they have; see `RandomCamera`.
        count: how many.
        seed: of the draws; the first ones are the same for every count.
        size: (height, width) of the new images; by default that of the old one. They are scaled to fit `NEW_SIZE`
            and show the same.
        ranges: of `RandomCamera`.
    """
    height, width = size or before.camera.image_size
    scale = min(NEW_SIZE[1] / width, NEW_SIZE[0] / height)
    size = max(1, round(height * scale)), max(1, round(width * scale))
    new = RandomCamera(
        like, camera=before.camera, image_size=size, antialias=True, fill=NOTHING, valid_mask=True, **ranges
    )
    labels = before.labels
    generator = torch.Generator().manual_seed(seed)
    for i in range(count):
        draw = new.draw(1, generator)
        moved = new(
            image=before.image,
            keypoints=labels.keypoints,
            boxes=labels.boxes,
            points=labels.eyes,
            gaze=labels.gaze,
            keypoints_valid=before.keypoints_valid,
            boxes_valid=before.boxes_valid,
            draw=draw,
        )
        camera, valid = moved["camera"], (moved["keypoints_valid"], moved["boxes_valid"])
        angles = [f"{name} {float(draw[name]):+.1f}°" for name in ("yaw", "pitch", "roll")]
        filled = 100 * float(moved["image_valid"].double().mean())
        lens = f"{like or camera.key}, {_degrees(camera):.0f}° wide"
        inside = [f"{int(v.sum())} of {len(v)} {n}" for n, v in zip(("points", "boxes"), valid, strict=True) if len(v)]
        yield LabelledImage(
            moved["image"],
            camera,
            Labels(moved["keypoints"], moved["boxes"], moved["points"], moved["gaze"]),
            ["   ".join(angles), f"{lens}, {filled:.0f} % filled"],
            *valid,
            note=f"{i + 1:3}: {', '.join([*angles, lens, f'{filled:.0f} % filled', *inside])}".replace("°", " degrees"),
        )


def lens(preset: str) -> str | None:
    """What `augmented` gets as `like` for the name of a preset, or for "none".

    Raises:
        ValueError: no preset has this name; the text lists those there are.
    """
    if preset == "none" or preset in PRESETS:
        return None if preset == "none" else preset
    known = "; ".join(f"{name}, {known.origin}" for name, known in PRESETS.items())
    raise ValueError(f"there is no preset {preset!r}. There are none, the image's own lens; {known}")


def origin(like: str | None, before: LabelledImage) -> str:
    """Where the lens of the new images comes from."""
    if like is None:
        return f"{before.camera.key}: the image's own lens, as lenses made alike differ"
    return f"{like}: {PRESETS[like].origin}"


def presets() -> Iterator[str]:
    """A line about each preset."""
    for name, preset in PRESETS.items():
        height, width = preset.image_size
        yield f"{name:<12} {preset.model:<15} {f'{width}x{height}':<10} {preset.origin}"


def _degrees(camera: Camera) -> float:
    """The horizontal field of view through the principal point, from outer edge to outer edge, or as far as it goes."""
    cy = float(camera.intrinsics[..., 3])
    x = torch.linspace(-0.5, camera.image_size[1] - 0.5, 513, dtype=torch.float64)
    rays, valid = camera.unproject(torch.stack([x, torch.full_like(x, cy)], -1))
    angle = torch.atan2(rays[..., 0], rays[..., 2])[valid]
    return math.degrees(float(angle.max() - angle.min())) if len(angle) else 0.0
