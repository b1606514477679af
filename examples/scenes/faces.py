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
MOUNTS = ((0.0, 30.0), (0.0, 15.0), (0.0, 20.0))
"""Degrees of yaw, pitch and roll, from the least to the most to either side, by which these cameras are mounted."""
WIDER = 1.5
"""Widths of a crop that are kept of photographs, so that crops which turn find their corners there."""
_DRAWS = 40  # of mounts, until the camera sees the whole face


class Samples(NamedTuple):
    """Faces as a network gets them, a batch of B."""

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
    """What a camera took of drivers, cut to squares around their faces."""

    image: Tensor
    """(B, 3, S, S) in [0, 1]."""
    keypoints: Tensor
    """(B, N, 2), the landmarks `NAMES` in pixels of these."""
    points: Tensor
    """(B, M, 3) in the camera's frame: the landmarks `NAMES`, and beyond them the face's outline."""
    gaze: Tensor
    """(B, 3) likewise."""
    camera: Camera
    """Of the whole images: single, or a batch of B."""
    square: Camera
    """Of the squares, a batch of B."""
    whole: Tensor
    """(B,), whether the whole face was on the camera's image."""

    def rows(self, index: Tensor) -> Photographs:
        """Return some of the photographs."""
        image, keypoints, points, gaze = (v[index] for v in (self.image, self.keypoints, self.points, self.gaze))
        return Photographs(image, keypoints, points, gaze, self.camera, self.square[index], self.whole[index])

    def samples(self) -> Samples:
        """Return squares of `SIDE` pixels for a network."""
        return Samples(
            self.image, self.keypoints.float(), self.gaze.float(), corner_rays(self.square), self.whole.float()
        )


def teacher() -> Camera:
    """The camera whose images are learned from: a pinhole, 60 degrees wide."""
    return Pinhole.from_fov(60.0, image_size=SIZE).requires_grad_(False)


def lens(name: str) -> Camera:
    """The lens of a preset, its image cut to the shape of `SIZE` and scaled to it."""
    camera = PRESETS[name].camera().double()
    rows = min(camera.height, camera.width * SIZE[0] // SIZE[1])
    columns = rows * SIZE[1] // SIZE[0]
    return camera.crop((camera.height - rows) // 2, (camera.width - columns) // 2, rows, columns).resize(*SIZE)


def mounts(
    camera: Camera,
    drivers: cabin.Drivers,
    generator: torch.Generator,
    ranges: tuple[tuple[float, float], ...] = MOUNTS,
) -> Tensor:
    """Draw mounts (B, 3), in degrees, within `ranges`, in which the camera sees the whole of each face."""
    low, high = torch.tensor(ranges).unbind(-1)
    draws = 2 * torch.rand(_DRAWS, len(drivers), 3, generator=generator) - 1
    draws = draws.sign() * torch.lerp(low, high, draws.abs())
    pixels, valid = camera.project(points_of(drivers) @ mount_rotation(*draws.double().unbind(-1)).mT)
    whole = (valid & camera.contains(pixels)).all(-1)
    return draws[whole.to(torch.uint8).argmax(0), torch.arange(len(drivers))]


def points_of(drivers: cabin.Drivers) -> Tensor:
    """The landmarks `NAMES` and the face's outline, (B, M, 3)."""
    landmarks = drivers.landmarks()[:, [cabin.LANDMARKS.index(name) for name in NAMES]]
    return torch.cat((landmarks, drivers.face_box_points()), 1)


def cut(
    camera: Camera, pixels: Tensor, valid: Tensor, jitter: Tensor | None = None, wider: float = 1.0
) -> tuple[Camera, Tensor]:
    """The camera of a square around each face, scaled to `SIDE` pixels, and whether the whole face is on its image.

    Args:
        camera: single, or a batch of B.
        pixels: (B, M, 2), of the face.
        valid: (B, M), which of them the lens maps.
        jitter: (B, 3) from -1 to 1: how much smaller the square is cut, and how far beside the face.
        wider: how many times as wide the square is, and its pixels as many.
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
    pixels_wide = round(wider * SIDE)
    numbers = torch.cat((focal * SIDE / side, (centre - middle) * SIDE / side + (pixels_wide - 1) / 2), -1)
    k = camera.distortion.expand(len(pixels), -1) if camera.distortion_names else None
    return camera.replace(numbers, k, (pixels_wide, pixels_wide)).requires_grad_(False), whole


def corner_rays(camera: Camera) -> Tensor:
    """(B, 4, 3) float32: where the corners of faces look."""
    last = SIDE - 1.0
    corners = camera.intrinsics.new_tensor([[0.0, 0.0], [last, 0.0], [0.0, last], [last, last]])
    rays, valid = camera.unproject(corners.expand(*camera.batch_shape, 4, 2))
    return torch.where(valid[..., None], rays, 0.0).float()


def photograph(
    camera: Camera,
    drivers: cabin.Drivers,
    mounts: Tensor | None = None,
    rates: Tensor | None = None,
    wider: float = WIDER,
) -> Photographs:
    """Render faces as a camera sees them, in squares that are wider than those of networks.

    Args:
        camera: without batch dims.
        drivers: B of them.
        mounts: (B, 3) degrees of yaw, pitch and roll, of the camera.
        rates: (B, 3) radians per second, at which what it sees turns while it reads row after row.
        wider: see `cut`.
    """
    nothing = torch.zeros(len(drivers), 3)
    mounts, rates = (nothing if values is None else values for values in (mounts, rates))
    camera, mount = camera.double(), mount_rotation(*mounts.double().unbind(-1))
    points = points_of(drivers) @ mount.mT
    near, whole = cut(camera, *camera.project(points), wider=wider)
    # each row of the square has a mount of its own
    seconds = READOUT / SIZE[0] * camera.fx / near.fx
    keypoints = near.project(points[:, : len(NAMES)])[0]
    for _ in range(8):  # the row of a point says when it was read, and that where it is
        turned = _in_rows(rates, seconds, keypoints[..., 1], near.height) @ points[:, : len(NAMES), :, None]
        keypoints = near.project(turned[..., 0])[0]
    rows = _in_rows(rates, seconds, torch.arange(near.height).double().expand(len(drivers), -1), near.height)
    turns = rows @ mount[:, None]
    parts = [slice(i, i + 25) for i in range(0, len(drivers), 25)]
    image = torch.cat([cabin.render(near[part], drivers[part], turns[part], samples=1) for part in parts])
    gaze = (mount @ drivers.gaze[..., None])[..., 0]
    return Photographs(image, keypoints, points, gaze, camera, near, whole)


def _in_rows(rates: Tensor, seconds: Tensor, rows: Tensor, height: int) -> Tensor:
    """(B, N, 3, 3): how far all has turned by the time that rows (B, N) are read, from the middle one on."""
    times = seconds[:, None] * (rows - (height - 1) / 2)
    return rotation_matrix(rates.double()[:, None] * times[..., None])
