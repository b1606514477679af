"""Detection of a board in an image by OpenCV: the pixels of its points. An integer coordinate is a pixel's centre."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import AprilGrid, Board, Charuco, Chessboard, opencv

Pixels = NDArray[np.float64]
Grey = NDArray[np.uint8]

_FEWEST = 6  # points that determine the pose of a board well
_PIXELS = 3e6  # at most, of an image to search for chessboards; they are refined in the whole one
_SMALL_PIXELS = 1.5e6  # an image of fewer is also searched for markers at twice the size
_WINDOWS = (0.2, 0.3, 0.4)  # half the sides of windows around corners, in distances to the nearest corner
_STRAY = 0.15  # such distances, from which a corner is too far from the place expected by its rows


def detect(board: Board, image: NDArray[Any]) -> tuple[Pixels, str]:
    """Find a board in an image (H, W) of uint8 or uint16: pixels (N, 2), NaN if unseen; or all NaN, and the reason.

    The top left square of a chessboard is black; of several such orders the one nearest the image's top left is taken.
    """
    cv2 = opencv("finding boards in images")
    if image.dtype != np.uint8:  # stretched from the range that is used
        low, high = np.percentile(image, (0.1, 99.9))
        image = np.clip((image.astype(np.float32) - low) * (255 / max(high - low, 1)), 0, 255)
    find: Any = {Chessboard: _chessboard, Charuco: _charuco, AprilGrid: _aprilgrid}[type(board)]
    pixels = find(cv2, board, np.ascontiguousarray(image, np.uint8))
    seen = np.isfinite(pixels[:, 0])
    if not seen.any():
        return pixels, "no board found"
    if seen.sum() < _FEWEST:
        return _no_pixels(board), f"only {seen.sum()} points found, of which {_FEWEST} are needed"
    if np.linalg.matrix_rank(np.diff(board.points()[seen], axis=0)) < 2:
        return _no_pixels(board), "the points found lie on one line, which leaves the board's pose open"
    return pixels, ""


def _no_pixels(board: Board) -> Pixels:
    return np.full((len(board.points()), 2), np.nan)


def _refine(cv2: Any, grey: Grey, corners: Pixels, radius: float) -> Pixels:
    """Return corners moved to the points at which gradients meet, in windows of half the side `radius`."""
    half = int(np.clip(round(radius), 2, 20))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    refined = cv2.cornerSubPix(grey, corners.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), stop)
    return np.asarray(refined.reshape(-1, 2), np.float64)


def _chessboard(cv2: Any, board: Chessboard, grey: Grey) -> Pixels:
    size, small, shrunk = (board.columns, board.rows), grey, math.sqrt(grey.size / _PIXELS)
    if shrunk > 1:
        height, width = (round(side / shrunk) for side in grey.shape)
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(small, size, flags=flags)
    if not found:  # the older method finds some boards that are blurred or unevenly lit
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        found, corners = cv2.findChessboardCorners(small, size, flags=flags)
    if not found or len(corners) != size[0] * size[1]:
        return _no_pixels(board)
    scale = np.array([grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0]])
    grid = (corners.reshape(board.rows, board.columns, 2).astype(np.float64) + 0.5) * scale - 0.5
    # the corners were found from any one on
    right, down = (grid[:, -1] - grid[:, 0]).mean(0), (grid[-1] - grid[0]).mean(0)
    if right[0] * down[1] < right[1] * down[0]:  # boards are seen from the front
        grid = grid[:, ::-1]
    orders = [np.rot90(grid, k) for k in ((0, 2) if grid.shape[0] != grid.shape[1] else (0, 1, 2, 3))]
    # if a board begins with white in every order, none is better
    orders = [order for order in orders if _begins_with_black(grey, order)] or orders
    first = min(orders, key=lambda order: float(order[0, 0].sum()))
    return _at_gradients(cv2, grey, np.ascontiguousarray(first))


def _begins_with_black(grey: Grey, grid: Pixels) -> bool:
    """Whether the first square between corners is black, like the board's top left square, diagonal to it."""
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    columns, rows = np.rint(middles).astype(int).T  # (columns, rows) of the grid each
    inside = (columns >= 0) & (columns < grey.shape[1]) & (rows >= 0) & (rows < grey.shape[0])
    values = np.where(inside, grey[rows.clip(0, grey.shape[0] - 1), columns.clip(0, grey.shape[1] - 1)], np.nan)
    black = np.add.outer(*map(np.arange, values.shape)) % 2 == 0
    return bool(np.nanmean(values[~black]) > np.nanmean(values[black]))


def _at_gradients(cv2: Any, grey: Grey, grid: Pixels) -> Pixels:
    """Return the corners (N, 2) moved to the points at which gradients meet, or as found if noise makes that worse.

    A lens bends rows of corners smoothly, so their third differences are noise: the corners with the least are taken. A
    corner far from the place expected by its rows, like some of OpenCV's in steep ones, is searched there, or unseen.
    """
    numbers = np.arange(grid[..., 0].size).reshape(grid.shape[:2])
    runs = [line[i : i + 4] for line in (*numbers, *numbers.T) for i in range(len(line) - 3)]
    differences = np.zeros((len(runs), numbers.size))
    differences[np.arange(len(runs))[:, None], np.reshape(runs, (-1, 4))] = 1, -3, 3, -1
    expected = grid.reshape(-1, 2).copy()
    strays, weights = np.zeros(len(expected), bool), np.maximum(np.square(differences).sum(0), 1)
    for _ in range(len(expected) // 10):
        off = differences.T @ (differences @ expected) / weights[:, None]  # the best move of one corner alone
        far = np.linalg.norm(off, axis=1) / np.maximum(_to_nearest(expected), 1e-9)
        worst = int(far.argmax())
        if far[worst] < _STRAY:
            break
        expected[worst] -= off[worst]
        strays[worst] = True
    nearest = _to_nearest(expected)
    tried = [np.where(strays[:, None], np.nan, expected)]
    for part in _WINDOWS:
        moved = [_refine(cv2, grey, one, part * side) for one, side in zip(expected, nearest, strict=True)]
        corners = np.concatenate(moved)
        lost = strays & (np.linalg.norm(corners - expected, axis=1) > _STRAY * nearest)
        tried.append(np.where(lost[:, None], np.nan, corners))
    return min(tried, key=lambda c: float(np.square(differences @ np.where(np.isnan(c), expected, c)).sum()))


def _to_nearest(pixels: Pixels) -> Pixels:
    """Return the distance (N,) of each corner to the nearest other one."""
    return np.partition(np.linalg.norm(pixels[:, None] - pixels, axis=-1), 1, axis=1)[:, 1]


def _dictionary(cv2: Any, name: str) -> Any:
    known = {key[5:].lower(): key for key in dir(cv2.aruco) if key.startswith("DICT_")}
    key = known.get(name.lower().removeprefix("dict_"))
    if key is None:
        raise ValueError(f"board: dictionary must be one of {', '.join(sorted(known))}; got {name!r}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, key))


def _passes(cv2: Any, grey: Grey, border: int = 1) -> list[tuple[Grey, int, Any]]:
    """Return images to search for markers, their scales, and the parameters; the most promising first."""
    low, high = np.percentile(grey, (2, 98))
    images = [(grey, 1)]
    if grey.size < _SMALL_PIXELS:
        images.insert(0, (cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), 2))
    passes = []
    for margin in (0.1 * float(high - low), 7.0):  # one that separates shapes that nearly touch, and OpenCV's own
        parameters = cv2.aruco.DetectorParameters()
        parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = 5, 53
        parameters.adaptiveThreshWinSizeStep = 6
        parameters.adaptiveThreshConstant = margin
        parameters.minMarkerPerimeterRate = 0.015
        parameters.markerBorderBits = border
        passes += [(image, scale, parameters) for image, scale in images]
    return passes


def _charuco(cv2: Any, board: Charuco, grey: Grey) -> Pixels:
    lengths, dictionary = (float(board.square), float(board.marker)), _dictionary(cv2, board.dictionary)
    target = cv2.aruco.CharucoBoard((board.columns, board.rows), *lengths, dictionary)
    target.setLegacyPattern(board.legacy)
    most, count = _no_pixels(board), 0
    for image, scale, parameters in _passes(cv2, grey):
        corners, ids, *_ = cv2.aruco.CharucoDetector(target, detectorParams=parameters).detectBoard(image)
        if ids is not None and len(ids) > count:
            most, count = _no_pixels(board), len(ids)
            found = _from_centres(cv2, image, np.asarray(corners, np.float64).reshape(-1, 2))
            most[ids.ravel()] = (found + 0.5) / scale - 0.5
        if count == len(most):
            break
    return most


def _from_centres(cv2: Any, image: Grey, corners: Pixels) -> Pixels:
    """Return ChArUco's corners with integers at pixels' centres: those of OpenCV 4 may be half a pixel off."""
    return corners + np.rint(2 * np.median(_refine(cv2, image, corners, 3) - corners, axis=0)) / 2


def _aprilgrid(cv2: Any, board: AprilGrid, grey: Grey) -> Pixels:
    dictionary, count = _dictionary(cv2, board.dictionary), board.columns * board.rows
    tags: dict[int, Pixels] = {}
    for image, scale, parameters in _passes(cv2, grey, board.border):
        corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
        for tag, pixels in zip([] if ids is None else ids.ravel().tolist(), corners, strict=True):
            if tag < count:
                tags.setdefault(tag, (pixels.reshape(4, 2).astype(np.float64) + 0.5) / scale - 0.5)
        if len(tags) == count:
            break
    found = _no_pixels(board)
    for tag, corners in _consistent_tags(cv2, board, tags).items():
        gap = board.spacing * np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).min()
        refined = _refine(cv2, grey, corners, 0.45 * gap)
        doubt = np.linalg.norm(refined - _refine(cv2, grey, corners, 0.3 * gap), axis=1)
        rim = np.minimum(refined, (grey.shape[1] - 1, grey.shape[0] - 1) - refined).min(1)
        # at the rim a part of the window is missing
        good = (np.linalg.norm(refined - corners, axis=1) < max(0.4 * gap, 2)) & (doubt < 0.3) & (rim > 0.45 * gap)
        found[board.corners_of(tag)] = np.where(good[:, None], refined, np.nan)
    return found


def _consistent_tags(cv2: Any, board: AprilGrid, tags: dict[int, Pixels]) -> dict[int, Pixels]:
    """Return the tags that lie where their neighbours expect them, with corners clockwise from the board's top left."""
    places = {tag: board.points()[board.corners_of(tag), :2].astype(np.float32) for tag in tags}
    reach = 2.1 * board.square * (1 + board.spacing)
    pairs = [(a, b) for a, b in itertools.permutations(tags, 2) if np.linalg.norm(places[a][0] - places[b][0]) < reach]
    if not pairs:
        return {}

    def error(turn: int, a: int, b: int) -> float:
        """Return the distance of b's middle from the place predicted by a's corners, in sides of b."""
        plane = cv2.getPerspectiveTransform(places[a], np.roll(tags[a], -turn, 0).astype(np.float32))
        x, y, w = plane @ [*places[b].mean(0), 1.0]
        side = np.linalg.norm(tags[b] - np.roll(tags[b], 1, 0), axis=1).mean()
        return float(np.linalg.norm((x, y) / w - tags[b].mean(0)) / side) if w > 0 else math.inf

    # OpenCV begins at the top left of a tag as in its dictionary; the board may hold tags turned
    errors = np.array([[error(turn, *pair) for pair in pairs] for turn in range(4)])
    turn = int(np.median(errors, axis=1).argmin())
    seconds = np.array(pairs)[:, 1]
    return {b: np.roll(tags[b], -turn, 0) for b in set(seconds.tolist()) if np.median(errors[turn, seconds == b]) < 1}
