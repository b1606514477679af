"""Boards as cameras see them: rendered from what OpenCV prints."""

import functools

import cv2
import numpy as np
import torch

import camtorch as ct
from camtorch.boards.boards import AprilGrid, Charuco
from camtorch.poses.rotations import rotation_matrix

SHARP, SCALE, MARGIN = 2, 3000, 30  # finer rays; pixels a metre of paper; pixels around a board


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
    """The print (H, W) uint8 of a board whose sides are whole pixels, and the pixel edge its frame begins at."""
    side = round(SCALE * board.square)
    if isinstance(board, Charuco):
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
        printed = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
        printed.setLegacyPattern(board.legacy)
        image, begin = printed.generateImage((side * board.columns, side * board.rows)), 0
    elif isinstance(board, AprilGrid):
        begin = round(side * board.spacing)
        step, dictionary = side + begin, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        image = np.full((step * board.rows + begin, step * board.columns + begin), 255, np.uint8)
        for row, column in np.ndindex(board.rows + 1, board.columns + 1):
            image[row * step : row * step + begin, column * step : column * step + begin] = 0
        for tag in range(board.columns * board.rows):
            x, y, _ = np.rint(SCALE * board.points()[board.corners_of(tag)[0]]).astype(int) + begin
            image[y : y + side, x : x + side] = dictionary.generateImageMarker(tag, side, borderBits=board.border)
    else:
        begin, black = side, np.add.outer(np.arange(board.rows + 1), np.arange(board.columns + 1)) % 2 == 0
        image = np.kron(np.where(black, 0, 255).astype(np.uint8), np.ones((side, side), np.uint8))
    return np.pad(image, MARGIN, constant_values=255), begin + MARGIN


def photograph(board, camera, rotation, translation, *, noise=2.0, seed=0):
    """(H, W) uint8 of a board, lengths in metres, at a pose (camera from board), and the true pixels of its points."""
    paper, begin = paper_of(board)
    turn = rotation_matrix(torch.tensor(rotation, dtype=torch.float64))
    move = torch.tensor(translation, dtype=torch.float64)
    matrix = turn.float().numpy()
    # where rays meet the board, in its frame: eye + distance * ray
    eye, rays = (-move @ turn).tolist(), rays_of(camera)
    along = [rays[0] * matrix[0, k] + rays[1] * matrix[1, k] + rays[2] * matrix[2, k] for k in range(3)]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -eye[2] / along[2]
        at = [SCALE * (eye[k] + distance * along[k]) + begin for k in (0, 1)]
    x, y = (np.where(distance > 0, side - 0.5, -1e4).astype(np.float32) for side in at)
    image = cv2.remap(paper, x, y, cv2.INTER_LINEAR, borderValue=140)
    image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    image = 30 + 0.7 * cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.6)
    image += noise * np.random.default_rng(seed).standard_normal(image.shape, np.float32)
    pixels, _ = camera.project(torch.as_tensor(board.points()) @ turn.T + move)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), pixels.numpy()
