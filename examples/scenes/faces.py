"""Faces of drivers, cut out of the images of cameras as a face detector would do it, and scaled to one size.

Convention: gaze is in the frame of the camera, as everything else. A camera's rays say where in its image, and behind
which lens, a face was.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.augment import PRESETS
from camtorch.cameras.camera import Camera
from camtorch.models import Pinhole
from camtorch.poses.rotations import mount_rotation, rotation_matrix
from scenes import cabin

NAMES = (
    *("right_eye_outer", "right_eye_inner", "left_eye_inner", "left_eye_outer"),
    *("nose_tip", "mouth_right", "mouth_left", "chin"),
)
SIDE = 64
"""Pixels of a face's image, in width and height."""
SIZE = (240, 320)
"""Of the images that faces are cut out of."""
READOUT, RATE = 0.03, 2.0
"""Of rolling shutters: seconds from the first row to the last; radians per second at most, of each axis."""
LENSES = "webcam", "dms90", "tumvi", "aria", "aria_rgb"
"""Presets before which faces are put; they were calibrated for others, and are of three models."""
MOUNTS = (30.0, 15.0, 20.0)
"""Degrees of yaw, pitch and roll to either side, within which these cameras are mounted."""
_DRAWS = 40  # of mounts, until the camera sees the whole face


class Samples(NamedTuple):
    """Faces as a camera sees them, a batch of B."""

    image: Tensor
    """(B, 3, SIDE, SIDE)."""
    keypoints: Tensor
    """(B, N, 2), the landmarks `NAMES` in pixels of these."""
    gaze: Tensor
    """(B, 3), unit directions in the camera's frame."""
    rays: Tensor
    """(B, 4, 3), where the corners of the image look."""
    weight: Tensor
    """(B,), 1 where the whole face was on the camera's image, else 0."""


class Photographs(NamedTuple):
    """What a camera took of drivers, whole: what augmentation turns and puts other lenses before."""

    image: Tensor
    """(B, 3, H, W)."""
    points: Tensor
    """(B, M, 3) in the camera's frame: the landmarks `NAMES`, and beyond them the face's outline."""
    gaze: Tensor
    """(B, 3) likewise."""
    camera: Camera
    """Of all of them."""


def teacher() -> Camera:
    """The camera whose images are learned from: a pinhole, 60 degrees wide."""
    return Pinhole.from_fov(60.0, image_size=SIZE).requires_grad_(False)


def photograph(drivers: cabin.Drivers) -> Photographs:
    """Whole images of drivers by the `teacher`."""
    return _photograph(drivers, teacher(), torch.eye(3, dtype=torch.float64).expand(len(drivers), 3, 3))


def photograph_mounted(drivers: cabin.Drivers, camera: Camera, generator: torch.Generator) -> Photographs:
    """Whole images of drivers by a camera that is mounted at random for each of them, see `MOUNTS`."""
    return _photograph(drivers, camera, mount_rotation(*_mounts(camera, drivers, generator).double().unbind(-1)))


def _photograph(drivers: cabin.Drivers, camera: Camera, mounts: Tensor) -> Photographs:
    parts = [slice(i, i + 25) for i in range(0, len(drivers), 25)]
    image = torch.cat([cabin.render(camera, drivers[part], mounts[part], samples=1) for part in parts])
    gaze = (mounts @ drivers.gaze[..., None])[..., 0]
    return Photographs(image, points_of(drivers) @ mounts.mT, gaze, camera)


def points_of(drivers: cabin.Drivers) -> Tensor:
    """The landmarks `NAMES` and the face's outline, (B, M, 3)."""
    landmarks = drivers.landmarks()[:, [cabin.LANDMARKS.index(name) for name in NAMES]]
    return torch.cat((landmarks, drivers.face_box_points()), 1)


def by_teacher(drivers: cabin.Drivers) -> Samples:
    """Faces of drivers before the `teacher`."""
    return seen_by(teacher(), drivers, *torch.zeros(2, len(drivers), 3))


def by_others(drivers: cabin.Drivers, generator: torch.Generator, *, rolling: bool = False) -> Samples:
    """Faces of drivers before `LENSES`, each mounted at random; perhaps turning while they read row after row."""
    parts = []
    for name, rows in zip(LENSES, torch.arange(len(drivers)).tensor_split(len(LENSES)), strict=True):
        camera = lens(name)
        mounts = _mounts(camera, drivers[rows], generator)
        rates = RATE * (2 * torch.rand(len(rows), 3, generator=generator) - 1) * rolling
        parts.append(seen_by(camera, drivers[rows], mounts, rates))
    return Samples(*map(torch.cat, zip(*parts, strict=True)))


def lens(name: str) -> Camera:
    """The lens of a preset, its image cut to the shape of `SIZE` and scaled to it."""
    camera = PRESETS[name].camera().double()
    rows = min(camera.height, camera.width * SIZE[0] // SIZE[1])
    columns = rows * SIZE[1] // SIZE[0]
    return camera.crop((camera.height - rows) // 2, (camera.width - columns) // 2, rows, columns).resize(*SIZE)


def _mounts(camera: Camera, drivers: cabin.Drivers, generator: torch.Generator) -> Tensor:
    """Mounts (B, 3), in degrees, within `MOUNTS`, in which the camera sees the whole of each face."""
    draws = (2 * torch.rand(_DRAWS, len(drivers), 3, generator=generator) - 1) * torch.tensor(MOUNTS)
    pixels, valid = camera.project(points_of(drivers) @ mount_rotation(*draws.double().unbind(-1)).mT)
    whole = (valid & camera.contains(pixels)).all(-1)
    first = whole.to(torch.uint8).argmax(0)
    return torch.where(whole.any(0)[:, None], draws[first, torch.arange(len(drivers))], 0.0)


def cut(camera: Camera, pixels: Tensor, valid: Tensor, jitter: Tensor | None = None) -> tuple[Camera, Tensor]:
    """The camera of a square around each face, scaled to `SIDE` pixels, and whether the whole face is on its image.

    Args:
        camera: single, or a batch of B.
        pixels: (B, M, 2), of the face.
        valid: (B, M), which of them the lens maps.
        jitter: (B, 3) from -1 to 1: how much smaller the square is cut, and how far beside the face.
    """
    whole = (valid & camera.contains(pixels)).all(-1)
    low, high = pixels.amin(1), pixels.amax(1)
    middle, side = (low + high) / 2, 1.35 * (high - low).amax(-1, keepdim=True)
    if jitter is not None:
        side = side * (1 - 0.1 * jitter[:, :1])
        middle = middle + 0.06 * side * jitter[:, 1:]
    # a face that is not there has no square
    side = torch.where(whole[:, None], side, float(SIDE))
    middle = torch.where(whole[:, None], middle, SIDE / 2)
    focal, centre = camera.intrinsics.expand(len(pixels), 4).split(2, -1)
    numbers = [torch.cat((focal * SIDE / side, (centre - middle) * SIDE / side + (SIDE - 1) / 2), -1)]
    if camera.distortion_names:
        numbers.append(camera.distortion.expand(len(pixels), -1))
    return type(camera)(*numbers, image_size=(SIDE, SIDE)).requires_grad_(False), whole


def corner_rays(camera: Camera) -> Tensor:
    """(B, 4, 3) float32: where the corners of faces look."""
    last = SIDE - 1.0
    corners = camera.intrinsics.new_tensor([[0.0, 0.0], [last, 0.0], [0.0, last], [last, last]])
    rays, valid = camera.unproject(corners.expand(*camera.batch_shape, 4, 2))
    return torch.where(valid[..., None], rays, 0.0).float()


def seen_by(camera: Camera, drivers: cabin.Drivers, mounts: Tensor, rates: Tensor) -> Samples:
    """What a camera sees of faces.

    Args:
        camera: without batch dims.
        drivers: B of them.
        mounts: (B, 3) degrees of yaw, pitch and roll, of the camera.
        rates: (B, 3) radians per second, at which what it sees turns while it reads row after row.
    """
    camera, mount = camera.double(), mount_rotation(*mounts.double().unbind(-1))
    points = points_of(drivers) @ mount.mT
    near, whole = cut(camera, *camera.project(points))
    # each row of the square has a mount of its own
    seconds = READOUT / SIZE[0] * camera.fx / near.fx
    keypoints = near.project(points[:, : len(NAMES)])[0]
    for _ in range(8):  # the row of a point says when it was read, and that where it is
        turned = _in_rows(rates, seconds, keypoints[..., 1]) @ points[:, : len(NAMES), :, None]
        keypoints = near.project(turned[..., 0])[0]
    rows = _in_rows(rates, seconds, torch.arange(SIDE, dtype=torch.float64).expand(len(drivers), -1))
    image = cabin.render(near, drivers, rows @ mount[:, None])
    gaze = (mount @ drivers.gaze[..., None])[..., 0]
    return Samples(image, keypoints.float(), gaze.float(), corner_rays(near), whole.float())


def _in_rows(rates: Tensor, seconds: Tensor, rows: Tensor) -> Tensor:
    """(B, N, 3, 3): how far all has turned by the time that rows (B, N) are read, from the middle one on."""
    times = seconds[:, None] * (rows - (SIDE - 1) / 2)
    return rotation_matrix(rates.double()[:, None] * times[..., None])
