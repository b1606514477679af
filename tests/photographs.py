"""Boards as cameras see them: rendered from what is printed."""

import functools

import cv2
import numpy as np
import torch

import camtorch as ct
from camtorch.boards import printing
from camtorch.rotations import rotation_matrix

SHARP, SCALE = 2, 3.0


def raster(page, scale):
    """(H, W) uint8 of a page, `scale` pixels a millimetre, edges averaged: outlines run along rows and columns."""
    fine = SHARP * scale
    crossed = np.zeros((round(page.height * fine), round(page.width * fine)), np.uint8)
    for line in page.outlines:
        corners = np.rint(np.array(line) * fine).astype(int)
        for (x, y), (_, end) in zip(corners, np.roll(corners, -1, 0), strict=True):
            crossed[min(y, end) : max(y, end), x] += 1
    image = 255 * (1 - np.cumsum(crossed, axis=1, dtype=np.uint8) % 2)
    return cv2.resize(image, None, fx=1 / SHARP, fy=1 / SHARP, interpolation=cv2.INTER_AREA)


@functools.cache
def fisheye():
    camera = ct.KannalaBrandt([260.0, 261, 322, 238], [-0.02, 0.004, -0.003, 0.0006], image_size=(480, 640))
    return camera.double().requires_grad_(False)


@functools.cache
def rays_of(camera):
    """(3, H, W) of an image SHARP times as large, (0, 0, 0) where there is none."""
    rays, valid = camera.resize(SHARP * camera.height, SHARP * camera.width).rays()
    return (rays * valid[..., None]).movedim(-1, 0).float().numpy()


@functools.cache
def paper_of(board):
    """Its raster, and where the board's frame begins on it, in mm."""
    page = printing.page(board, None, ())
    left, top, right, bottom = printing.extent(board)
    origin = (page.width - 1000 * (right + left)) / 2, (page.height - 16 - 1000 * (bottom + top)) / 2
    return raster(page, SCALE), origin


def photograph(board, camera, rotation, translation, *, noise=2.0, seed=0):
    """(H, W) uint8 of a board, lengths in metres, at a pose (camera from board), and the true pixels of its points."""
    paper, origin = paper_of(board)
    turn = rotation_matrix(torch.tensor(rotation, dtype=torch.float64))
    move = torch.tensor(translation, dtype=torch.float64)
    matrix = turn.float().numpy()
    # where rays meet the board, in its frame: eye + distance * ray
    eye, rays = (-move @ turn).tolist(), rays_of(camera)
    along = [rays[0] * matrix[0, k] + rays[1] * matrix[1, k] + rays[2] * matrix[2, k] for k in range(3)]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -eye[2] / along[2]
        at = [1000 * (eye[k] + distance * along[k]) + origin[k] for k in (0, 1)]
    x, y = (np.where(distance > 0, side * SCALE - 0.5, -1e4).astype(np.float32) for side in at)
    image = cv2.remap(paper, x, y, cv2.INTER_LINEAR, borderValue=140)
    image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    image = 30 + 0.7 * cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.6)
    image += noise * np.random.default_rng(seed).standard_normal(image.shape, np.float32)
    pixels, _ = camera.project(torch.as_tensor(board.points()) @ turn.T + move)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), pixels.numpy()
