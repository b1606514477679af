"""Crops of faces for networks to learn from: as taken, by `ct.augment`, by kornia, and by cameras that look at them."""

from collections.abc import Callable
from typing import Any

import torch
from kornia.augmentation import RandomAffine
from torch import Tensor

import camtorch as ct
from scenes import faces
from scenes.faces import SIDE, WIDER, Photographs, Samples

YAW, PITCH, ROLL = 35.0, 20.0, 25.0  # degrees, wider than those of the tests: nobody knows the mounts to come
FOV = (60, 160)
MARGIN = 0.175  # of boxes to either side: as wide as the squares of plain crops


def plain(seen: Photographs, generator: torch.Generator) -> Samples:
    """Cut faces out somewhat larger or smaller, and to the side."""
    return plain_crops(seen, 2 * torch.rand(len(seen.image), 3, generator=generator) - 1)


def plain_crops(seen: Photographs, jitter: Tensor | None = None) -> Samples:
    """Cut the squares around faces."""
    near, whole = faces.cut(seen.camera, *seen.camera.project(seen.points), jitter)
    return moved(seen, ct.Warp(seen.square, near, padding_mode="border"), seen.camera, whole).samples()


def box_crops(seen: Photographs, generator: torch.Generator | None = None) -> Samples:
    """Crop by cameras that look at the faces; with a generator roughly at them, and nearer or farther."""
    ranges: dict[str, Any] = {} if generator is None else {"yaw": 1.5, "pitch": 1.5, "zoom": 0.1}
    augment = ct.augment.BoxCrop((SIDE, SIDE), margin=MARGIN, **ranges)
    outline = seen.square.project(seen.points)[0]
    draw = augment.draw(len(outline), generator)
    draw["box"] = torch.cat((outline.amin(1), outline.amax(1)), -1)
    # a face outside of the image has no box
    draw["box"] = torch.where(seen.whole[:, None], draw["box"], draw["box"].new_tensor([20, 20, 40, 40]))
    change = augment.change(seen.square, draw)
    warp = ct.Warp(seen.square, change.target, change.rotation, padding_mode="border")
    return moved(seen, warp, change.target, seen.whole).samples()


def random_cameras(seen: Photographs, generator: torch.Generator, draws: int = 3) -> tuple[ct.Camera, Tensor]:
    """Draw a real lens and a mount for each face: of a few draws the first that sees the whole face."""
    augment = ct.augment.RandomCamera("real", fov=FOV, yaw=YAW, pitch=PITCH, roll=ROLL, crop=None, min_filled=0)
    count = len(seen.image)
    change = augment.change(seen.camera, augment.draw(draws * count, generator))
    camera, turn = change.target, change.rotation
    assert isinstance(camera, ct.Camera)
    assert turn is not None
    pixels, valid = camera.project(seen.points.repeat(draws, 1, 1) @ turn.to(seen.points).mT)
    whole = (valid & camera.contains(pixels)).all(-1).unflatten(0, (draws, count))
    chosen = whole.to(torch.uint8).argmax(0) * count + torch.arange(count)
    return camera[chosen], turn[chosen]


def with_camtorch(seen: Photographs, generator: torch.Generator) -> Samples:
    """Cut squares around faces as other cameras see them: one warp from the photograph to the square."""
    return rolled(seen, *random_cameras(seen, generator), generator).samples()


def with_box_crop(seen: Photographs, generator: torch.Generator) -> Samples:
    """Do the same, and crop the result by `BoxCrop`."""
    return box_crops(rolled(seen, *random_cameras(seen, generator), generator, WIDER), generator)


def as_taken(seen: Photographs, generator: torch.Generator) -> Samples:
    """Cut faces out of the images as they are, with a rolling shutter."""
    turn = torch.eye(3, dtype=torch.float64).expand(len(seen.image), 3, 3)
    return rolled(seen, seen.camera, turn, generator).samples()


def rolled(
    seen: Photographs, camera: ct.Camera, turn: Tensor, generator: torch.Generator, wider: float = 1.0
) -> Photographs:
    """Cut faces as `camera` (single, or one for each) sees them when it is turned and its shutter rolls."""
    jitter, rates = (2 * torch.rand(2, len(seen.image), 3, generator=generator) - 1).unbind()
    seen = seen._replace(points=seen.points @ turn.to(seen.points).mT)
    pixels, valid = camera.project(seen.points)
    near, whole = faces.cut(camera, pixels, valid, jitter if wider == 1 else None, wider)
    readout = near.height * faces.READOUT / faces.SIZE[0] * camera.fx / near.fx
    shutter = ct.RollingShutter(readout, faces.RATE * rates)
    warp = ct.ShutterWarp(seen.square, near, turn, target_shutter=shutter, padding_mode="border")
    return moved(seen, warp, camera, whole)


def moved(seen: Photographs, warp: ct.Warp, camera: ct.Camera, whole: Tensor) -> Photographs:
    """Warp photographs and their labels."""
    keypoints = warp.transform_points(seen.keypoints)[0]
    gaze = warp.transform_rays(seen.gaze[:, None])[:, 0]
    return Photographs(warp(seen.image), keypoints, seen.points, gaze, camera, warp.target, whole)


def with_affine(seen: Photographs, generator: torch.Generator) -> Samples:
    """Turn cut faces by as much as `random_cameras` rolls, and scale, shear and shift them."""
    augment = RandomAffine(ROLL, (0.05, 0.05), (0.85, 1.15), (-8.0, 8.0), p=1.0, padding_mode="border")
    cut = plain(seen, generator)
    image = augment(cut.image)
    matrix = torch.as_tensor(augment.transform_matrix)
    linear, step = matrix[:, :2, :2], matrix[:, None, :2, 2]
    u, _, v = torch.linalg.svd(linear)  # what in it is a turn, gaze turns by
    gaze = torch.cat(((u @ v @ cut.gaze[:, :2, None])[..., 0], cut.gaze[:, 2:]), -1)
    return cut._replace(image=image, keypoints=cut.keypoints @ linear.mT + step, gaze=gaze)


Augment = Callable[[Photographs, torch.Generator], Samples]
AUGMENTATIONS: dict[str, Augment] = {
    "plain": plain,
    "affine": with_affine,
    "camtorch": with_camtorch,
    "box": with_box_crop,
}
