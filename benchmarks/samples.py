"""One sample at a time, as a worker of a DataLoader has it: a uint8 image of three channels and 68 landmarks.

Affine and OpticalDistortion are albumentations', of about the same extent; the latter moves no landmarks here, which
would make it many times slower. "RandomCamera" moves a mask as well, and stands beside the same by OpenCV: new maps,
the image, the mask and the landmarks. One thread.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec

import numpy as np
import torch

import camtorch.augment.numpy
from benchmarks import augment, cameras
from benchmarks.options import Options
from benchmarks.point_peers import OPENCV, OURS
from benchmarks.tables import Record, only, table
from benchmarks.timing import Run, measure, threads
from benchmarks.verdict import Requirement, figures, times_faster, verdict
from camtorch.augment import RandomCamera, RandomLens, RandomMount

AFFINE, DISTORTION = "albumentations Affine", "OpticalDistortion, no landmarks"
SIZES = (256, 256), (480, 640)
_ANGLES = {"yaw": 10, "pitch": 10, "roll": 10}
_ROUNDS = 0.02  # seconds that one round of a contestant takes

# of each case and size: how many times faster than the other one
BOUNDS = {
    "RandomMount": (1.2, 1.8),
    "RandomLens": (1.2, 3.0),
    "RandomLens to a fisheye": (1.2, 3.0),
    "RandomCamera, brown_conrady to pinhole": (1.1, 2.0),
    "RandomCamera, kannala_brandt to pinhole": (3.0, 5.0),
}


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    if options.device.type != "cpu":
        return [], []
    records = []
    with threads(1):
        for size in SIZES[:1] if options.quick else SIZES:
            for case, runs in contestants(size).items():
                records += measure(case, "{}x{}x3".format(*size), runs, options, shortest=_ROUNDS)
    tables = [
        table(
            "One uint8 sample, 68 landmarks: microseconds (times camtorch)",
            only(records, "seconds"),
            scale=1e6,
            beside=OURS,
        ),
        verdict(requirements(records)),
    ]
    return records, tables


def requirements(records: Sequence[Record]) -> list[Requirement]:
    """How many times faster each has to be, by the fastest rounds."""
    rows, found = figures(records, "fastest"), []
    for case, bounds in BOUNDS.items():
        for size, bound in zip(SIZES, bounds, strict=True):
            here = {row: times for row, times in rows.items() if row == (case, "{}x{}x3".format(*size))}
            ratios = times_faster(here, OURS, [AFFINE, DISTORTION, OPENCV])
            found.append(Requirement(f"{case}, {size[0]}x{size[1]}: {bound:g} times the other", bound, ratios))
    return found


def contestants(size: tuple[int, int]) -> dict[str, dict[str, Run]]:
    """Case -> name -> what is timed."""
    random = np.random.default_rng(0)
    image = random.integers(256, size=(*size, 3), dtype=np.uint8)
    mask = random.integers(2, size=size, dtype=np.uint8)
    keypoints = (random.random((augment.LANDMARKS, 2)) * size[::-1]).astype(np.float32)
    keys, cpu = ("brown_conrady", "kannala_brandt"), torch.device("cpu")
    brown, fisheye = (cameras.camera(key, cpu, size=size).requires_grad_(False) for key in keys)

    def ours(change: Callable, **fields: np.ndarray) -> Run:
        transform = camtorch.augment.numpy.Transform(change)
        return lambda: transform(image=image, keypoints=keypoints, **fields)

    found: dict[str, dict[str, Run]] = {
        "RandomMount": {OURS: ours(RandomMount(camera=brown, min_filled=0, **_ANGLES))},
        "RandomLens": {OURS: ours(RandomLens(camera=brown))},
        "RandomLens to a fisheye": {OURS: ours(RandomLens("kannala_brandt", camera=brown, fov=(60, 70), min_filled=0))},
    }
    for case, camera in zip(augment.CASES[:2], (brown, fisheye), strict=True):
        move = augment.OpenCVCamera(case, camera)
        found[f"RandomCamera, {case.name}"] = {
            OURS: ours(RandomCamera(case.like, camera=camera, fov=case.fov, **augment.ANGLES), mask=mask),
            OPENCV: partial(move, image, mask, keypoints),
        }
    if find_spec("albumentations"):
        import albumentations as A  # noqa: N812 (its own name; optional)

        points = A.KeypointParams("xy", remove_invisible=False)
        affine = A.Compose(
            [A.Affine(rotate=(-10, 10), translate_percent=0.02, scale=(0.95, 1.05), p=1)], keypoint_params=points
        )
        distortion = A.Compose([A.OpticalDistortion(distort_limit=0.3, p=1)])
        found["RandomMount"][AFFINE] = lambda: affine(image=image, keypoints=keypoints)
        for case in ("RandomLens", "RandomLens to a fisheye"):
            found[case][DISTORTION] = lambda: distortion(image=image)
    return found
