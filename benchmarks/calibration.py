"""Calibration: a camera from views of a chessboard, and poses of a known camera, beside OpenCV.

The views are made: a board of 9 by 6 corners about random pixels of a camera, tilted up to 40 degrees, each corner with
0.2 px of noise. All start from nothing: no focal length is given. camtorch always finds the covariances as well; of
OpenCV that is calibrateCameraExtended, whose time grows with more than the number of views, so that it takes part up to
200 of them, as does its fisheye calibration, which has no covariances.
"""

import math
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import torch
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.harness import NAMES, OPENCV, OURS, Figure, Options, Row, Table, measure
from benchmarks.memory import growth
from camtorch.poses.rotations import rotation_matrix

EXTENDED = "OpenCV, covariances"
TABLES = (
    Table("calibration", "54 corners a view, s", (OURS, OPENCV, EXTENDED), 1),
    Table("calibration, residuals", "rms, px", (OURS, OPENCV, EXTENDED), 1, None),
    Table("calibration, memory", "at the most, MB", (OURS,), 1e-6),
)
MODELS = ("brown_conrady", "kannala_brandt")
VIEWS, QUICK_VIEWS, POSES, QUICK_POSES = (10, 50, 200, 2000), (10, 20), 1000, 20
COLUMNS, ROWS, SQUARE, NOISE = 9, 6, 0.025, 0.2
_MOST = 200  # views, for the slow ones


def rows(options: Options) -> Iterator[Row]:
    """Measure calibrations of more and more views, then the poses."""
    counts, poses = (QUICK_VIEWS, QUICK_POSES) if options.quick else (VIEWS, POSES)
    with torch.no_grad():
        for key in options.chosen(MODELS):
            camera = cameras.camera(key, torch.device("cpu"), torch.float64)
            for count in counts:
                yield from _calibrations(key, *_views(camera, count), options)
            yield _poses(key, camera.to(options.device), *_views(camera, poses), options)


def _views(camera: ct.Camera, count: int) -> tuple[Tensor, Tensor]:
    """The board (N, 3), and its corners (V, N, 2) in so many views that have them all; float64."""
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
        kept.append(pixels[(valid[..., None] & (pixels >= 0) & (pixels <= size - 1)).all(-1).all(-1)])
    pixels = torch.cat(kept)[:count]
    return board, pixels + NOISE * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)


def _calibrations(key: str, board: Tensor, pixels: Tensor, options: Options) -> Iterator[Row]:
    """Times, residuals and memory of one number of views."""
    here = board.to(options.device), pixels.to(options.device)
    calibrate = lambda: ct.calibrate(key, *here, image_size=cameras.SIZE)
    runs: dict[str, Callable[[], float]] = {OURS: lambda: float(calibrate().rms), **_peers(key, board, pixels)}
    name = f"{NAMES[key]}, calibrate, V = {len(pixels)}"
    yield (found := measure("calibration", name, runs, options))
    if not found.figures:
        return
    yield Row("calibration, residuals", name, {who: Figure(rms()) for who, rms in runs.items()})
    yield Row("calibration, memory", name, {OURS: Figure(growth(calibrate, options.device)[0])})


def _peers(key: str, board: Tensor, pixels: Tensor) -> dict[str, Callable[[], float]]:
    """By contestant, what gives OpenCV's rms."""
    few = len(pixels) <= _MOST
    both, size = ([board.numpy()] * len(pixels), [*pixels.numpy()]), cameras.SIZE[::-1]
    if key == "kannala_brandt":
        flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW  # without the first it ends 21 px off
        views = [[points[None] for points in views] for views in both]
        return {OPENCV: lambda: cv2.fisheye.calibrate(*views, size, None, None, flags=flags)[0]} if few else {}
    views = [[points.astype(np.float32) for points in views] for views in both]
    plain = {OPENCV: lambda: cv2.calibrateCamera(*views, size, None, None)[0]}
    return plain | ({EXTENDED: lambda: cv2.calibrateCameraExtended(*views, size, None, None)[0]} if few else {})


def _poses(key: str, camera: ct.Camera, board: Tensor, pixels: Tensor, options: Options) -> Row:
    """Poses of so many boards, all at once, and by OpenCV one after the other."""
    count, device = len(pixels), options.device
    here = board.expand(count, -1, -1).to(device), pixels.to(device)
    matrix, lens = cameras.matrix(), np.array(cameras.COEFFICIENTS[key])
    solve = cv2.fisheye.solvePnP if key == "kannala_brandt" else cv2.solvePnP
    objects, images = board.numpy(), pixels.numpy()
    runs = {
        OURS: lambda: ct.solve_pnp(camera, *here),
        OPENCV: lambda: [solve(objects[:, None], image[:, None], matrix, lens) for image in images],
    }
    return measure("calibration", f"{NAMES[key]}, solve_pnp, {count:,} poses", runs, options)
