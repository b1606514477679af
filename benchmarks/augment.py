"""Augmentation: a random camera for every image of a batch, with its mask and its landmarks.

Every call draws anew and moves the image, a mask and 68 keypoints of each sample. OpenCV goes sample by sample, from
a lens that it knows to a turned pinhole camera, and cannot do the other cases. kornia's RandomAffine moves the same
data by an affine map, which needs no camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import kornia.augmentation as K  # noqa: N812 (kornia's own name for it)
import numpy as np
import torch

import camtorch as ct
from benchmarks import cameras
from benchmarks.options import Options
from benchmarks.point_peers import COMPILED, OPENCV, OURS
from benchmarks.tables import Record, only, table
from benchmarks.timing import Run, measure
from camtorch.augment import RandomCamera
from camtorch.augment.kornia import RandomCamera as KorniaRandomCamera

ADAPTER, AFFINE = "camtorch in kornia", "kornia RandomAffine"
BATCH, SIZE, QUICK_SIZE, LANDMARKS = 8, (480, 640), (120, 160), 68
_ANGLES = {"yaw": 10, "pitch": 10, "roll": 10, "min_filled": 0}
_DEGREES = np.radians(10)


@dataclass(frozen=True)
class Case:
    """From which camera to which lens."""

    name: str
    source: str
    like: str | None
    fov: tuple[float, float] | None = None


CASES = (
    Case("brown_conrady to pinhole", "brown_conrady", "pinhole", (65, 80)),
    Case("kannala_brandt to pinhole", "kannala_brandt", "pinhole", (65, 80)),
    Case("kannala_brandt to its like", "kannala_brandt", None),
    Case("pinhole to dms130", "pinhole", "dms130"),
    Case("pinhole to aria", "pinhole", "aria"),
)


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    size = QUICK_SIZE if options.quick else SIZE
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(BATCH, 1, *size, generator=generator).to(options.device)
    mask = (image > 0.5).to(image)
    keypoints = torch.rand(BATCH, LANDMARKS, 2, generator=generator) * torch.tensor(size[::-1])
    data = image, mask, keypoints.to(options.device)
    records = []
    for case in CASES[:2] if options.quick else CASES:
        records += measure(case.name, "image, mask, keypoints", _contestants(case, size, data, options), options)
    title = f"Augmentation of {BATCH}x1x{size[0]}x{size[1]}: milliseconds (times camtorch)"
    return records, [table(title, only(records, "seconds"), scale=1e3, beside=OURS)]


def _contestants(case: Case, size: tuple[int, int], data: tuple, options: Options) -> dict[str, Run]:
    camera = cameras.camera(case.source, options.device, size=size).requires_grad_(False)
    ours = RandomCamera(case.like, camera=camera, fov=case.fov, **_ANGLES)
    adapter = K.AugmentationSequential(
        KorniaRandomCamera(camera, case.like, fov=case.fov, **_ANGLES), data_keys=["input", "mask", "keypoints"]
    )
    affine = K.AugmentationSequential(
        K.RandomAffine(10.0, translate=(0.02, 0.02), scale=(0.95, 1.05), p=1.0),
        data_keys=["input", "mask", "keypoints"],
    )
    image, mask, keypoints = data

    def apply(image, mask, keypoints, draw):
        moved = ours(image=image, mask=mask, keypoints=keypoints, draw=draw)
        return moved["image"], moved["mask"], moved["keypoints"], moved["keypoints_valid"]

    def drawn(function: Callable):
        return function(image, mask, keypoints, ours.draw(BATCH))

    runs = {OURS: partial(drawn, apply), ADAPTER: lambda: adapter(*data), AFFINE: lambda: affine(*data)}
    if options.compile:
        runs[COMPILED] = partial(drawn, torch.compile(apply, fullgraph=True))
        compiled = torch.compile(lambda *tensors: affine(*tensors))
        runs[f"{AFFINE}, compiled"] = lambda: compiled(*data)
    if case.like == "pinhole":
        runs[OPENCV] = _opencv(case, camera, data)
    return runs


def _opencv(case: Case, camera: ct.Camera, data: tuple) -> Run:
    """Sample by sample: a turned pinhole camera, its map, the image, the mask and the landmarks."""
    matrix = camera.K.cpu().double().numpy()
    distortion = camera.distortion.cpu().double().numpy()
    image, mask, keypoints = (t.cpu().numpy() for t in data)
    (height, width), fisheye = image.shape[-2:], case.source == "kannala_brandt"
    module = cv2.fisheye if fisheye else cv2
    random = np.random.default_rng(0)

    def run():
        results = []
        for i in range(BATCH):
            rotation, _ = cv2.Rodrigues(random.uniform(-_DEGREES, _DEGREES, 3))
            focal = width / 2 / np.tan(np.radians(random.uniform(*case.fov)) / 2)
            target = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
            maps = module.initUndistortRectifyMap(matrix, distortion, rotation, target, (width, height), cv2.CV_32FC1)
            warped = cv2.remap(image[i, 0], *maps, cv2.INTER_LINEAR)
            label = cv2.remap(mask[i, 0], *maps, cv2.INTER_NEAREST)
            points = module.undistortPoints(keypoints[i][:, None], matrix, distortion, R=rotation, P=target)
            results.append((warped, label, points))
        return results

    return run
