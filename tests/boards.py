"""Corners of boards: the real ones of `golden/calibration`, and made ones of any camera."""

import functools
import json
import math
from pathlib import Path
from typing import NamedTuple

import torch

import camtorch as ct
from camtorch.poses.rotations import rotation_matrix

STEREO = {
    "left": ct.KannalaBrandt([300.0, 301.0, 321.0, 238.0], [0.02, -0.01, 0.003, -0.001], image_size=(480, 640)),
    "right": ct.BrownConrady([420.0, 421.0, 402.0, 295.0], [-0.2, 0.05, 1e-3, -5e-4, 0.0], image_size=(600, 800)),
}
FOLDER = Path(__file__).parent / "golden" / "calibration"


class Corners(NamedTuple):
    """What a camera saw: object points (N, 3), image points (V, N, 2) with NaN where unseen, float64."""

    object_points: torch.Tensor
    image_points: torch.Tensor
    image_size: tuple[int, int]


def chessboard(columns, rows, square):
    """(N, 3) float64: inner corners, rows first."""
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return torch.stack((x, y, 0 * x), -1).reshape(-1, 3).double() * square


def opencv_left():
    """OpenCV's thirteen views of its left camera, and its optima: dicts, by their number of coefficients."""
    given = json.loads((FOLDER / "opencv_left.json").read_text())
    # OpenCV takes the points in float32
    points = chessboard(given["columns"], given["rows"], given["square"]).float().double()
    pixels = torch.tensor(given["pixels"], dtype=torch.float64).unflatten(1, (-1, 2))
    optima = {
        optimum["coefficients"]: {
            name: torch.tensor(value, dtype=torch.float64) for name, value in optimum.items() if name != "coefficients"
        }
        for optimum in given["optima"]
    }
    return Corners(points, pixels, tuple(given["image_size"])), optima


@functools.cache
def opencv_calibration():
    """The calibration of those views, which several files look at."""
    corners, _ = opencv_left()
    return ct.calibrate("brown_conrady", *corners[:2], image_size=corners.image_size)


def ov_plane(part):
    """The views "train" or "test" of OV-plane."""
    given = json.loads((FOLDER / "ov_plane.json").read_text())
    i = torch.arange(484)
    points = torch.stack((0.75 * (1 + i % 22), 0.75 * (22 - i // 22), 0.0 * i), -1).double()
    pixels = torch.full((len(given[part]), len(points), 2), math.nan, dtype=torch.float64)
    for row, view in zip(pixels, given[part], strict=True):
        row[view["corners"]] = torch.tensor(view["pixels"], dtype=torch.float64).unflatten(0, (-1, 2))
    return Corners(points, pixels, tuple(given["image_size"]))


@torch.no_grad()
def seen_by(camera, views, *, noise=0.0, columns=9, rows=6, square=0.025, near=0.15, far=0.5, tilt=40.0, seed=0):
    """Made views of a chessboard, each placed about the ray of a random pixel and tilted; and the poses.

    Returns:
        the corners, NaN outside the image, and rotations (V, 3, 3) and translations (V, 3), camera from board.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    camera = camera.double()
    height, width = camera.image_size
    board = chessboard(columns, rows, square)
    middle = board.mean(0)
    pixels = 0.1 + 0.8 * uniform(views, 2)
    rays, valid = camera.unproject(pixels * pixels.new_tensor([width - 1.0, height - 1.0]))
    assert valid.all()
    # towards the ray, then tilted about an axis in the board, and turned about its normal
    axis = torch.nn.functional.pad(torch.stack((-rays[:, 1], rays[:, 0]), -1), (0, 1))
    angle = torch.atan2(axis.norm(dim=-1), rays[:, 2])
    towards = rotation_matrix(torch.nn.functional.normalize(axis, dim=-1) * angle[:, None])
    phi = 2 * math.pi * uniform(views)
    lean = torch.stack((phi.cos(), phi.sin(), 0 * phi), -1) * (math.radians(tilt) * (0.2 + 0.8 * uniform(views, 1)))
    roll = torch.nn.functional.pad(math.pi * (2 * uniform(views, 1) - 1), (2, 0))
    rotations = towards @ rotation_matrix(lean) @ rotation_matrix(roll)
    distances = near + (far - near) * uniform(views, 1)
    translations = rays * distances - (rotations @ middle)
    seen, valid = camera.project(board @ rotations.mT + translations[:, None])
    seen = seen.detach() + noise * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    inside = ((seen >= 0) & (seen <= seen.new_tensor([width - 1.0, height - 1.0]))).all(-1)
    seen = torch.where((valid & inside)[..., None], seen, torch.nan)
    return Corners(board, seen, camera.image_size), rotations, translations


def stereo(views=25, noise=0.1):
    """What a fisheye camera and a webcam beside it see of the same boards.

    Returns:
        the corners of the left one, the image points of the right one, and its pose from the left one.
    """
    corners, rotations, translations = seen_by(STEREO["left"], views, noise=noise)
    rotation = rotation_matrix(torch.tensor([0.05, -0.9, 0.02], dtype=torch.float64))
    translation = torch.tensor([-0.12, 0.003, 0.01], dtype=torch.float64)
    points = corners.object_points @ rotations.mT + translations[:, None]
    with torch.no_grad():
        pixels, valid = STEREO["right"].double().project(points @ rotation.mT + translation)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    inside = ((pixels >= 0) & (pixels <= pixels.new_tensor([799.0, 599.0]))).all(-1) & valid
    inside &= inside.sum(-1, keepdim=True) > 11
    return corners, torch.where(inside[..., None], pixels, torch.nan), rotation, translation
