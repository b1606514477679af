"""What networks of `training` learn from, and are tested on: faces of drivers, cut out of the images of cameras.

Convention: gaze is in the frame of the camera, as everything else; faces are cut out as a face detector would do it,
and scaled to one size. A camera's rays say where in its image, and behind which lens, a face was.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from camtorch.augment import PRESETS, RandomCamera, mount_rotation
from camtorch.camera import Camera
from camtorch.demo import cabin
from camtorch.models import Pinhole
from camtorch.rotations import rotation_matrix
from camtorch.warp.shutter import RollingShutter
from camtorch.warp.warp import Warp

NAMES = (
    *("right_eye_outer", "right_eye_inner", "left_eye_inner", "left_eye_outer"),
    *("nose_tip", "mouth_right", "mouth_left", "chin"),
)
SIDE = 64
"""Pixels of a face's image, in width and height."""
SIZE = (240, 320)
"""Of the images that faces are cut out of."""
LENSES = "webcam", "dms90", "tumvi", "aria", "aria_rgb"
"""The lenses that networks are tested behind: presets that were calibrated for others, of three models."""
TRAINING_SETS = {
    "plain": "one camera's images",
    "plain_rays": "... and rays",
    "affine": "... with RandomAffine",
    "camtorch": "... with camtorch",
    "camtorch_rays": "... with camtorch and rays",
}
"""What networks learn from. Those with rays are told beside each face where its image's corners look."""
TESTS = {
    "seen": "the same camera",
    "mounts": "other lenses and mounts",
    "shutter": "... and rolling shutters",
}
"""What networks are tested on, each with other drivers."""
MOUNTS = (30.0, 15.0, 20.0)
"""Degrees of yaw, pitch and roll to either side, within which cameras of the tests are mounted."""
_WIDER = (35.0, 20.0, 25.0)  # what augmentation prepares for, as nobody knows the mounts to come
_READOUT, _RATE = 0.03, 2.0  # seconds from the first row to the last; radians per second, of each axis
_MARGIN = 1.35  # of a cut around the face
_DRAWS = 40


@dataclass
class Samples:
    """Faces as a camera sees them, a batch of B; `NAMES` are the landmarks.

    Attributes:
        image: (B, 3, SIDE, SIDE).
        keypoints: (B, N, 2), landmarks in pixels of these.
        gaze: (B, 3), unit directions in the camera's frame.
        rays: (B, 4, 3), where the corners of the image look.
        weight: (B,), 1 where the whole face was on the camera's image, else 0.
    """

    image: Tensor
    keypoints: Tensor
    gaze: Tensor
    rays: Tensor
    weight: Tensor

    def __len__(self) -> int:
        return len(self.image)

    def __getitem__(self, index: Tensor | slice | int) -> Samples:
        return Samples(*(value[index] for value in vars(self).values()))

    @staticmethod
    def joined(parts: list[Samples]) -> Samples:
        """All of some batches, one after the other."""
        return Samples(*(torch.cat(column) for column in zip(*(vars(p).values() for p in parts), strict=True)))


Augment = Callable[[Tensor, torch.Generator], Samples]
"""Makes of photographs, which the tensor numbers, samples that are learned from."""


@dataclass
class Photographs:
    """What a camera took of drivers, whole: what augmentation turns and puts other lenses before.

    Attributes:
        image: (B, 3, H, W).
        points: (B, M, 3) in the camera's frame: the landmarks, and beyond the N of `NAMES` the face's outline.
        gaze: (B, 3) likewise.
        camera: of all of them.
    """

    image: Tensor
    points: Tensor
    gaze: Tensor
    camera: Camera


def teacher() -> Camera:
    """The camera whose images are learned from: a pinhole, 60 degrees wide."""
    return Pinhole.from_fov(60.0, image_size=SIZE).requires_grad_(False)


def lens(name: str) -> Camera:
    """The lens of a preset, its image cut to the shape of `SIZE` and scaled to it."""
    camera = PRESETS[name].camera().double()
    rows = min(camera.height, camera.width * SIZE[0] // SIZE[1])
    columns = rows * SIZE[1] // SIZE[0]
    return camera.crop((camera.height - rows) // 2, (camera.width - columns) // 2, rows, columns).resize(*SIZE)


def photograph(drivers: cabin.Drivers, workers: int = 1) -> Photographs:
    """Whole images of drivers by the `teacher`."""
    camera = teacher()
    parts = [drivers[slice(i, i + 25)] for i in range(0, len(drivers), 25)]
    with ThreadPoolExecutor(workers) as pool:
        image = torch.cat(list(pool.map(lambda part: cabin.render(camera, part, samples=1), parts)))
    return Photographs(image, _points(drivers), drivers.gaze, camera)


def faces_of(drivers: cabin.Drivers, test: str, generator: torch.Generator, workers: int = 1) -> Samples:
    """Faces of drivers before the cameras of a test, as these see them."""
    if test == "seen":
        return _faces(teacher(), drivers, torch.zeros(len(drivers), 3), torch.zeros(len(drivers), 3))
    cameras = [lens(name) for name in LENSES]
    groups = torch.arange(len(drivers)).tensor_split(len(cameras))
    jobs = []
    for camera, rows in ((camera, rows) for camera, rows in zip(cameras, groups, strict=True) if len(rows)):
        mounts = _mounts(camera, drivers[rows], generator)
        rates = _RATE * (2 * torch.rand(len(rows), 3, generator=generator) - 1) * (test == "shutter")
        jobs.append((camera, drivers[rows], mounts, rates))
    with ThreadPoolExecutor(workers) as pool:
        return Samples.joined(list(pool.map(lambda job: _faces(*job), jobs)))


def _points(drivers: cabin.Drivers) -> Tensor:
    """Landmarks (`NAMES`) and the face's outline, (B, M, 3)."""
    landmarks = drivers.landmarks()[:, [cabin.LANDMARKS.index(name) for name in NAMES]]
    return torch.cat((landmarks, drivers.face_box_points()), 1)


def _turn(mounts: Tensor) -> Tensor:
    return mount_rotation(*mounts.double().unbind(-1))


def _mounts(camera: Camera, drivers: cabin.Drivers, generator: torch.Generator) -> Tensor:
    """Mounts (B, 3), in degrees, within `MOUNTS`, in which the camera sees the whole of each face."""
    draws = (2 * torch.rand(_DRAWS, len(drivers), 3, generator=generator) - 1) * torch.tensor(MOUNTS)
    pixels, valid = camera.project(_points(drivers) @ _turn(draws).mT)
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
    middle, side = (low + high) / 2, _MARGIN * (high - low).amax(-1, keepdim=True)
    if jitter is not None:
        side = side * (1 - 0.1 * jitter[:, :1])
        middle = middle + 0.06 * side * jitter[:, 1:]
    # a face that is not there has no square
    side = torch.where(whole[:, None], side, float(SIDE)).detach()
    middle = torch.where(whole[:, None], middle, SIDE / 2)
    focal, centre = camera.intrinsics.expand(len(pixels), 4).split(2, -1)
    scale = SIDE / side
    intrinsics = torch.cat((focal * scale, (centre - middle) * scale + (SIDE - 1) / 2), -1)
    distortion = camera.distortion.expand(len(pixels), -1)
    return camera.replace(intrinsics, distortion, (SIDE, SIDE)), whole


def _faces(camera: Camera, drivers: cabin.Drivers, mounts: Tensor, rates: Tensor) -> Samples:
    """What a camera, mounted so and turning at such rates (radians per second), sees of faces."""
    camera, mount = camera.double().requires_grad_(False), _turn(mounts)
    points = _points(drivers) @ mount.mT
    near, whole = cut(camera, *camera.project(points))
    # the camera turns while it reads: each row of the square has a mount of its own
    seconds = _READOUT / SIZE[0] * camera.fx / near.fx
    keypoints = near.project(points[:, : len(NAMES)])[0]
    for _ in range(8):  # the row of a point says when it was read, and that where it is
        turned = _in_rows(rates, seconds, keypoints[..., 1]) @ points[:, : len(NAMES), :, None]
        keypoints = near.project(turned[..., 0])[0]
    rows = _in_rows(rates, seconds, torch.arange(SIDE, dtype=torch.float64).expand(len(drivers), -1))
    image = cabin.render(near, drivers, rows @ mount[:, None])
    gaze = (mount @ drivers.gaze[..., None])[..., 0]
    return Samples(image, keypoints.float(), gaze.float(), _rays(near), whole.float())


def _in_rows(rates: Tensor, seconds: Tensor, rows: Tensor) -> Tensor:
    """(B, N, 3, 3): how far a camera has turned by the time it reads rows (B, N), from the middle one on."""
    times = seconds[:, None] * (rows - (SIDE - 1) / 2)
    return rotation_matrix(rates.double()[:, None] * times[..., None])


def _rays(camera: Camera) -> Tensor:
    last = SIDE - 1.0
    corners = camera.intrinsics.new_tensor([[0.0, 0.0], [last, 0.0], [0.0, last], [last, last]])
    rays, valid = camera.unproject(corners.expand(*camera.batch_shape, 4, 2))
    return torch.where(valid[..., None], rays, 0.0).float()


# -- what is learned from


def augmentation(name: str, seen: Photographs) -> Augment:
    """What makes of photographs the samples that are learned from under a name."""
    if name.startswith("camtorch"):
        return _by_camera(seen)
    pixels, valid = seen.camera.project(seen.points)

    def plain(index: Tensor, generator: torch.Generator) -> Samples:
        jitter = 2 * torch.rand(len(index), 3, generator=generator) - 1
        camera, whole = cut(seen.camera, pixels[index], valid[index], jitter)
        return _seen(seen, index, Warp(seen.camera, camera, padding_mode="border"), whole)

    return _by_affine(plain) if name == "affine" else plain


def _seen(seen: Photographs, index: Tensor, warp: Warp, whole: Tensor) -> Samples:
    """What becomes of photographs by a warp."""
    pixels = seen.camera.project(seen.points[index, : len(NAMES)])[0]
    keypoints = warp.transform_points(pixels)[0]
    gaze = warp.transform_rays(seen.gaze[index][:, None])[:, 0]
    return Samples(warp(seen.image[index]), keypoints.float(), gaze.float(), _rays(warp.target), whole.float())


def _by_camera(seen: Photographs) -> Augment:
    """Real lenses, mounted anywhere and turning, of whose images the faces are cut: one warp from the first to the cut.

    What it needs beyond `RandomCamera` is that the cut follows the face.
    """
    yaw, pitch, roll = _WIDER
    augment = RandomCamera("real", fov=(60, 160), yaw=yaw, pitch=pitch, roll=roll, crop=None, min_filled=0)

    def by_camera(index: Tensor, generator: torch.Generator) -> Samples:
        change = augment.change(seen.camera, augment.draw(len(index), generator))
        camera, turn = change.target, change.rotation
        jitter, rates = (2 * torch.rand(2, len(index), 3, generator=generator) - 1).unbind()
        near, whole = cut(camera, *camera.project(seen.points[index].to(turn) @ turn.mT), jitter)
        readout = SIDE * _READOUT / SIZE[0] * camera.fx / near.fx
        shutter = RollingShutter(readout, _RATE * rates)
        return _seen(seen, index, Warp(seen.camera, near, turn, target_shutter=shutter, padding_mode="border"), whole)

    return by_camera


def _by_affine(plain: Augment) -> Augment:
    """Turns cut faces by as much as `_by_camera` rolls, and scales, shears and shifts them."""
    from kornia.augmentation import RandomAffine

    augment = RandomAffine(_WIDER[2], (0.05, 0.05), (0.85, 1.15), (-8.0, 8.0), p=1.0, padding_mode="border")

    def by_affine(index: Tensor, generator: torch.Generator) -> Samples:
        p = plain(index, generator)
        image = augment(p.image)
        matrix = cast(Tensor, augment.transform_matrix)
        linear, step = matrix[:, :2, :2], matrix[:, None, :2, 2]
        keypoints = p.keypoints @ linear.mT + step
        # what in it is a turn, gaze turns by
        u, _, v = torch.linalg.svd(linear)
        gaze = torch.cat(((u @ v @ p.gaze[:, :2, None])[..., 0], p.gaze[:, 2:]), -1)
        return Samples(image, keypoints, gaze, p.rays, p.weight)

    return by_affine
