"""Stereo: pairs of uint8 images rectified by maps that are there, beside OpenCV's remap by its own.

All maps are of the same rectified cameras. The error is the largest difference to float64, in grey levels of noise,
where all neighbours lie inside the image; results in uint8 are up to 0.5 off by rounding.
"""

from collections.abc import Iterator

import cv2
import numpy as np
import torch

import camtorch as ct
from benchmarks import cameras
from benchmarks.harness import NAMES, OURS, Figure, Options, Row, Run, Table, measure, threads
from benchmarks.images import LARGE, MODELS, OPENCV_MAPS, QUICK, as_tensor, opencv_maps, true_images

_EVERYONE = {OURS: (OURS,), "OpenCV": OPENCV_MAPS}
TABLES = (
    Table("stereo", "a pair rectified, ms", _EVERYONE),
    Table("stereo, errors", "largest difference, grey levels", _EVERYONE, 1, None),
)


def rows(options: Options) -> Iterator[Row]:
    """Measure colour and grey pairs of both models."""
    with torch.no_grad():
        for key in options.chosen(MODELS):
            for channels in (1, 3):
                yield from _pair(key, channels, options)


def rectification(key: str, size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> ct.Rectification:
    """Return two cameras of a model, a little turned against each other, into images of their size."""
    camera = cameras.camera(key, device, dtype, size=size).requires_grad_(False)
    extrinsics = ct.Extrinsics([0.01, -0.02, 0.015], [-0.1, 0.002, -0.001]).to(device).requires_grad_(False)
    wide = np.degrees(2 * np.arctan(size[1] / 2 / float(camera.intrinsics[0])))
    return ct.rectify(camera, camera, extrinsics, fov=float(wide), image_size=size, align="opencv")


def _pair(key: str, channels: int, options: Options) -> Iterator[Row]:
    size, device = QUICK if options.quick else LARGE, options.device
    ours = rectification(key, size, torch.float32, device)
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(256, (2, 1, channels, *size), generator=generator, dtype=torch.uint8).to(device)
    arrays = [np.ascontiguousarray(image[0].permute(1, 2, 0).cpu().numpy()) for image in images]
    runs: dict[str, Run] = {OURS: lambda: ours(*images)}
    for name, kind in zip(OPENCV_MAPS, (cv2.CV_32FC1, cv2.CV_16SC2), strict=True):
        runs[name] = _remap(ours, arrays, kind)
    case = f"{NAMES[key]}, {channels}x{size[0]}x{size[1]} uint8"
    yield measure("stereo", case, runs, options)
    if options.threads > 1 and device.type == "cpu":
        with threads(1):
            yield measure("stereo", f"{case}, 1 thread", runs, options)
    double = rectification(key, size, torch.float64, device)
    found = [true_images(image, warp) for image, warp in zip(images, (double.left, double.right), strict=True)]
    truth, inside = map(torch.cat, zip(*found, strict=True))
    errors = {}
    for name, run in runs.items():
        pair = run()
        made = torch.cat(pair) if isinstance(pair, tuple) else as_tensor(pair)
        errors[name] = Figure((made.double() - truth).abs()[inside].max().item())
    yield Row("stereo, errors", case, errors)


def _remap(found: ct.Rectification, arrays: list[np.ndarray], kind: int) -> Run:
    """OpenCV's maps of the same rectified cameras, made once."""
    sides = (found.source_left, found.rotation_left), (found.source_right, found.rotation_right)
    maps = [opencv_maps(camera, found.camera_left, turn.cpu().numpy(), kind)() for camera, turn in sides]
    return lambda: [cv2.remap(array, *pair, cv2.INTER_LINEAR) for array, pair in zip(arrays, maps, strict=True)]
