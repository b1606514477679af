"""Stereo: pairs of uint8 images rectified by maps that are there, beside OpenCV's remap by its own.

All maps are of the same rectified cameras. The error is the largest difference to float64, in grey levels of noise,
where all neighbours lie inside the image; results in uint8 are up to 0.5 off by rounding.

What is required is judged by the fastest rounds.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.image_peers import OPENCV_FIXED, OPENCV_FLOAT, OPENCV_MAPS, as_tensor
from benchmarks.options import Options, progress
from benchmarks.point_peers import OURS
from benchmarks.tables import Record, only, table
from benchmarks.timing import Run, measure, threads
from benchmarks.verdict import Requirement, figures, times_faster, verdict

MODELS = ("brown_conrady", "kannala_brandt")
LARGE, QUICK = (720, 1280), (120, 160)
RECTIFY = "a pair"
_ONE_THREAD = ", 1 thread"
_BOUND = 2.0  # times OpenCV


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    records: list[Record] = []
    with torch.no_grad():
        for key in options.chosen(MODELS):
            for channels in (1, 3):
                records += _pair(key, channels, options)
    times = only(records, "seconds")
    faster = times_faster(figures(records, "fastest"), OURS, OPENCV_MAPS)
    tables = [
        table("Stereo: milliseconds for a pair (times camtorch)", times, scale=1e3, beside=OURS),
        table("Stereo: largest difference to float64, in grey levels", only(records, "error")),
        verdict(
            [
                Requirement(f"rectifying a pair of colour images: {_BOUND:g} times OpenCV", _BOUND, _of(3, faster)),
                Requirement("rectifying a pair of grey images: no slower than OpenCV", 1.0, _of(1, faster)),
            ]
        ),
    ]
    return records, tables


def _of(channels: int, ratios: dict[str, float]) -> dict[str, float]:
    return {row: ratio for row, ratio in ratios.items() if f" 2x{channels}x" in row}


def rectification(key: str, size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> ct.Rectification:
    """Two cameras of a model, a little turned against each other, into images of their size."""
    camera = cameras.camera(key, device, dtype, size=size).requires_grad_(False)
    extrinsics = ct.Extrinsics([0.01, -0.02, 0.015], [-0.1, 0.002, -0.001]).to(device).requires_grad_(False)
    focal = camera.intrinsics.detach().double().tolist()
    wide = np.degrees(2 * np.arctan(size[1] / 2 / focal[0]))
    return ct.rectify(camera, camera, extrinsics, fov=float(wide), image_size=size, align="opencv")


def _pair(key: str, channels: int, options: Options) -> list[Record]:
    size, device = QUICK if options.quick else LARGE, options.device
    case = f"{key} 2x{channels}x{size[0]}x{size[1]} uint8"
    progress(f"{case}: preparing")
    ours = rectification(key, size, torch.float32, device)
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(256, (2, 1, channels, *size), generator=generator, dtype=torch.uint8).to(device)
    arrays = [np.ascontiguousarray(image[0].permute(1, 2, 0).cpu().numpy()) for image in images]
    runs: dict[str, Run] = {OURS: lambda: ours(*images)}
    for name, kind in ((OPENCV_FLOAT, cv2.CV_32FC1), (OPENCV_FIXED, cv2.CV_16SC2)):
        runs[name] = _remap(key, ours, arrays, kind)
    records = measure(case, RECTIFY, runs, options)
    if options.threads > 1 and device.type == "cpu":
        with threads(1):
            records += measure(case, RECTIFY + _ONE_THREAD, runs, options)
    truth, inside = _truth(rectification(key, size, torch.float64, device), images)
    for name, result in runs.items():
        pair = result()
        made = torch.cat(pair) if isinstance(pair, tuple) else as_tensor(pair)
        error = (made.double() - truth).abs()[inside].max().item()
        records.append(Record(case, name, RECTIFY, "error", error))
    return records


def _remap(key: str, found: ct.Rectification, arrays: list[np.ndarray], kind: int) -> Run:
    """OpenCV's maps of the same rectified cameras, made once."""
    initialise = cv2.fisheye.initUndistortRectifyMap if key == "kannala_brandt" else cv2.initUndistortRectifyMap
    straight, maps = found.camera_left.K.cpu().double().numpy(), []
    for camera, turn in ((found.source_left, found.rotation_left), (found.source_right, found.rotation_right)):
        lens = camera.K.cpu().double().numpy(), camera.distortion.cpu().double().numpy()
        maps.append(initialise(*lens, turn.cpu().numpy(), straight, found.camera_left.image_size[::-1], kind))
    return lambda: [cv2.remap(array, *pair, cv2.INTER_LINEAR) for array, pair in zip(arrays, maps, strict=True)]


def _truth(found: ct.Rectification, images: Tensor) -> tuple[Tensor, Tensor]:
    """(2, C, H, W) in float64, and where no neighbour lies off the image."""
    truths, insides = [], []
    for warp, image in zip((found.left, found.right), images, strict=True):
        rays, _ = warp.target.rays()
        pixels, mapped = warp.source.project(rays @ warp.rotation)
        last = pixels.new_tensor([warp.source.width - 1, warp.source.height - 1])
        inside = ((pixels > 0) & (pixels < last)).all(-1) & mapped
        grid = (2 * pixels / last - 1)[None]
        truths.append(torch.nn.functional.grid_sample(image.double(), grid, align_corners=True))
        insides.append(inside.expand_as(truths[-1]))
    return torch.cat(truths), torch.cat(insides)
