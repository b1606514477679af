"""Calibration: a camera from views of a chessboard, and poses of a known camera, beside OpenCV.

The views are made: a board of 9 by 6 corners about random pixels of a camera, tilted up to 40 degrees, each corner with
0.2 px of noise. All start from nothing: no focal length is given. camtorch always finds the covariances as well; of
OpenCV that is calibrateCameraExtended, whose time grows with more than the number of views, so that it takes part up to
200 of them, as does its fisheye calibration, which has no covariances.

What is required is judged by the fastest rounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.memory import growth
from benchmarks.options import Options, progress
from benchmarks.point_peers import OPENCV, OURS
from benchmarks.tables import Record, only, table
from benchmarks.timing import measure
from benchmarks.verdict import Requirement, verdict
from camtorch.rotations import rotation_matrix

MODELS = ("brown_conrady", "kannala_brandt")
VIEWS, QUICK_VIEWS = (10, 50, 200, 2000), (10, 20)
POSES, QUICK_POSES = 1000, 20
COLUMNS, ROWS, SQUARE, NOISE = 9, 6, 0.025, 0.2
_SECONDS = {200: 1.0, 2000: 10.0}  # that so many views may take
_POSE_SECONDS = 0.1
_LINEAR = 1.3  # times as much for each of ten times as many views
CALIBRATE, POSE = "calibrate", "solve_pnp"
EXTENDED = "OpenCV, covariances"
_MOST = 200  # views, for the slow ones


class Views(NamedTuple):
    """Boards that a camera sees: object points (N, 3), image points (V, N, 2), float64."""

    board: Tensor
    pixels: Tensor


def views(camera: ct.Camera, count: int) -> Views:
    """So many views with all corners in the image."""
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.arange(ROWS), torch.arange(COLUMNS), indexing="ij")
    board = torch.stack((x, y, 0 * x), -1).reshape(-1, 3).double() * SQUARE
    size = torch.tensor(cameras.SIZE[::-1], dtype=torch.float64)
    kept: list[Tensor] = []
    while sum(map(len, kept)) < count:
        uniform = torch.rand(4 * count, 6, generator=generator, dtype=torch.float64)
        rays, _ = camera.unproject(uniform[:, :2] * (size - 1))
        lean = 2 * math.pi * uniform[:, 2]
        axis = torch.stack((lean.cos(), lean.sin(), 0 * lean), -1) * math.radians(40) * uniform[:, 3:4]
        roll = torch.nn.functional.pad(2 * math.pi * uniform[:, 4:5], (2, 0))
        outwards = torch.nn.functional.pad(torch.stack((-rays[:, 1], rays[:, 0]), -1), (0, 1))
        angle = torch.atan2(outwards.norm(dim=-1), rays[:, 2])[:, None]
        towards = rotation_matrix(torch.nn.functional.normalize(outwards, dim=-1) * angle)
        turn = towards @ rotation_matrix(axis) @ rotation_matrix(roll)
        points = (board - board.mean(0)) @ turn.mT + (rays * (0.2 + 0.4 * uniform[:, 5:]))[:, None]
        pixels, valid = camera.project(points)
        inside = (valid[..., None] & (pixels >= 0) & (pixels <= size - 1)).all(-1).all(-1)
        kept.append(pixels[inside])
    pixels = torch.cat(kept)[:count]
    return Views(board, pixels + NOISE * torch.randn(pixels.shape, generator=generator, dtype=torch.float64))


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    keys = options.chosen(MODELS)
    times, poses, errors, memory = [], [], [], []
    with torch.no_grad():
        for key in keys:
            camera = cameras.camera(key, options.device, torch.float64).cpu()
            for count in QUICK_VIEWS if options.quick else VIEWS:
                made = views(camera, count)
                times += _calibrations(key, made, options)
                errors += _errors(key, made)
                memory += _memory(key, made, options)
            poses += _poses(camera, key, options)
    tables = [
        table("Calibration: seconds, for V views of 54 corners (times camtorch)", only(times, "seconds"), beside=OURS),
        table("Calibration: rms of the residuals, px", errors),
        table("Calibration: megabytes at the most, beyond the input", memory, scale=1e-6),
        table("Poses: milliseconds (times camtorch)", only(poses, "seconds"), scale=1e3, beside=OURS),
        verdict(_requirements(times, poses, memory)),
    ]
    return times + poses + errors + memory, tables


def _ours(key: str, made: Views, device: torch.device) -> ct.Calibration:
    return ct.calibrate(key, made.board.to(device), made.pixels.to(device), image_size=cameras.SIZE)


def _peers(key: str, made: Views) -> dict[str, Callable[[], float]]:
    """By contestant, what gives OpenCV's rms."""
    boards, pixels, size = [made.board.numpy()] * len(made.pixels), [*made.pixels.numpy()], cameras.SIZE[::-1]
    few = len(made.pixels) <= _MOST
    if key == "kannala_brandt":
        flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW  # without the first it ends 21 px off
        rows = [[points[None] for points in views] for views in (boards, pixels)]
        return {OPENCV: lambda: cv2.fisheye.calibrate(*rows, size, None, None, flags=flags)[0]} if few else {}
    singles = [[points.astype(np.float32) for points in views] for views in (boards, pixels)]
    plain = {OPENCV: lambda: cv2.calibrateCamera(*singles, size, None, None)[0]}
    return plain | ({EXTENDED: lambda: cv2.calibrateCameraExtended(*singles, size, None, None)[0]} if few else {})


def _calibrations(key: str, made: Views, options: Options) -> list[Record]:
    runs: dict[str, Callable[[], object]] = {OURS: partial(_ours, key, made, options.device)}
    runs |= _peers(key, made)
    return measure(f"{key}, {CALIBRATE}", f"V = {len(made.pixels)}", runs, options)


def _errors(key: str, made: Views) -> list[Record]:
    column = f"V = {len(made.pixels)}"
    progress(f"{key}, {CALIBRATE}, {column}: errors")
    records = [Record(key, OURS, column, "rms", _ours(key, made, made.pixels.device).rms)]
    return records + [Record(key, name, column, "rms", rms()) for name, rms in _peers(key, made).items()]


def _memory(key: str, made: Views, options: Options) -> list[Record]:
    most, _ = growth(partial(_ours, key, made, options.device), options.device)
    return [Record(key, OURS, f"V = {len(made.pixels)}", "bytes", most)]


def _poses(camera: ct.Camera, key: str, options: Options) -> list[Record]:
    """Poses of so many boards, all at once, and by OpenCV one after the other."""
    made = views(camera, QUICK_POSES if options.quick else POSES)
    count, device = len(made.pixels), options.device
    ours, board, pixels = camera.to(device), made.board.expand(count, -1, -1).to(device), made.pixels.to(device)
    matrix, lens = cameras.matrix(), np.array(cameras.COEFFICIENTS[key])
    solve = cv2.fisheye.solvePnP if key == "kannala_brandt" else cv2.solvePnP
    objects, images = made.board.numpy(), made.pixels.numpy()
    runs = {
        OURS: lambda: ct.solve_pnp(ours, board, pixels),
        OPENCV: lambda: [solve(objects[:, None], image[:, None], matrix, lens) for image in images],
    }
    return measure(f"{key}, {POSE}", f"{count:,} poses", runs, options)


def _requirements(times: list[Record], poses: list[Record], memory: list[Record]) -> list[Requirement]:
    fastest = {(r.case, r.operation): r.value for r in only(times, "fastest") if r.contestant == OURS}
    most = {(r.case, r.operation): r.value for r in memory}
    found = [
        Requirement(
            f"{views:,} views of 54 corners: at most {limit:g} s",
            limit,
            {case: value for (case, column), value in fastest.items() if column == f"V = {views}"},
            at_most=True,
            unit=" s",
        )
        for views, limit in _SECONDS.items()
    ]
    for text, values in (("time", fastest), ("memory", most)):
        ratios = {
            case: value / (10 * values[case, "V = 200"])
            for (case, column), value in values.items()
            if column == "V = 2000"
        }
        name = f"{text} linear in views: from 200 to 2,000 of them, a view at most {_LINEAR}x"
        found.append(Requirement(name, _LINEAR, ratios, at_most=True))
    slow = {
        r.case: r.value for r in only(poses, "fastest") if r.contestant == OURS and r.operation == f"{POSES:,} poses"
    }
    found.append(
        Requirement(f"{POSES:,} poses: at most {_POSE_SECONDS} s", _POSE_SECONDS, slow, at_most=True, unit=" s")
    )
    return found
