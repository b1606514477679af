"""Boards found in images: the pixels of their points, by OpenCV.

An integer coordinate is a pixel's centre.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import AprilGrid, Board, Charuco, Chessboard, dictionary_of, opencv

Pixels = NDArray[np.float64]

_PIXELS = 3e6
"""Chessboards are searched for in images of at most so many pixels, and refined in the whole one."""
_WINDOWS = (0.2, 0.3, 0.4)
"""Half the sides of windows around corners, in distances to the nearest other one."""
_STRAY = 0.15
"""How far a corner may be from where its rows have it, in distances to the nearest other one."""
_SMALL = 1.5e6
"""Markers in images of fewer pixels are also searched for in one of twice the size."""
_FEWEST = 6
"""Points of a board, below which what is seen does not tell its pose well."""
NOT_FOUND = "no board found"


class Detection(NamedTuple):
    """What one image shows of a board."""

    pixels: Pixels
    """(N, 2) of the board's points, NaN where unseen; all NaN if the image is of no use."""
    reason: str = ""
    """Why it is of no use, or empty."""


def detect(board: Board, image: NDArray[Any]) -> Detection:
    """Find a board in an image.

    The points of a chessboard are told apart as its colours allow: where black is at the top left of the first one. If
    they allow several orders (`board.is_symmetric`), the first point is the one nearest to the image's top left corner.
    image: (H, W) of grey values, uint8 or uint16.

    Raises:
        ImportError: there is no OpenCV. ValueError: a dictionary of markers that it does not have.
    """
    cv2 = opencv("finding boards in images")
    grey = _as_grey8(image)
    find: Any = {Chessboard: _chessboard, Charuco: _charuco, AprilGrid: _aprilgrid}[type(board)]
    pixels = find(cv2, board, grey)
    nothing = np.full((len(board.points()), 2), np.nan)
    if pixels is None or np.isnan(pixels).all():
        return Detection(nothing, NOT_FOUND)
    seen = np.isfinite(pixels[:, 0])
    if seen.sum() < _FEWEST:
        return Detection(nothing, f"only {seen.sum()} points of the board found, of which {_FEWEST} are needed")
    if np.linalg.matrix_rank(np.diff(board.points()[seen], axis=0)) < 2:
        return Detection(nothing, "the points found lie on one line, which does not tell where the board is")
    return Detection(pixels)


def _as_grey8(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Of deep images the range that they use."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    low, high = np.percentile(image, (0.1, 99.9))
    scaled = (image.astype(np.float32) - low) * (255 / max(high - low, 1))
    return np.asarray(np.clip(scaled, 0, 255), np.uint8)


# -- chessboards


def _chessboard(cv2: Any, board: Chessboard, grey: NDArray[np.uint8]) -> Pixels | None:
    size, small = (board.columns, board.rows), _shrunk(cv2, grey)
    found, corners = cv2.findChessboardCornersSB(small, size, flags=_flags(cv2))
    if not found:  # of blurred or unevenly lit boards the older method finds some
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        found, corners = cv2.findChessboardCorners(small, size, flags=flags)
    if not found or len(corners) != board.columns * board.rows:
        return None
    scale = np.array([grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0]])
    pixels = (corners.reshape(-1, 2).astype(np.float64) + 0.5) * scale - 0.5
    return _moved_by_gradients(cv2, board, grey, _ordered(board, grey, pixels))


def _flags(cv2: Any) -> int:
    return int(cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)


def _shrunk(cv2: Any, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image that chessboards are searched for in."""
    shrunk = math.sqrt(grey.size / _PIXELS)
    if shrunk <= 1:
        return grey
    height, width = (round(side / shrunk) for side in grey.shape)
    return np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA))


def _moved_by_gradients(cv2: Any, board: Chessboard, grey: NDArray[np.uint8], pixels: Pixels) -> Pixels:
    """The corners as found, or moved to where the gradients around them say, in a smaller or larger window.

    Gradients are three times as exact in sharp images, and worse than nothing in noisy ones. A lens bends rows of
    corners smoothly, so what the third differences along them have is noise: the least of it is taken. A corner that
    is no part of its rows, as OpenCV has some at the ends of steep ones, is looked for where they say, or unseen.
    """
    differences = _third_differences(board.rows, board.columns)
    expected, strays = _mended(differences, pixels)
    nearest = _to_nearest(expected)
    tried = [np.where(strays[:, None], np.nan, expected)]
    for part in _WINDOWS:
        moved = [_refined(cv2, grey, one[None], part * side) for one, side in zip(expected, nearest, strict=True)]
        corners = np.concatenate(moved)
        far = np.linalg.norm(corners - expected, axis=1) > _STRAY * nearest
        tried.append(np.where((strays & far)[:, None], np.nan, corners))
    return min(tried, key=lambda c: float(np.square(differences @ np.where(np.isnan(c), expected, c)).sum()))


def _to_nearest(pixels: Pixels) -> Pixels:
    """(N,) the distance of each corner to the nearest other one."""
    return np.partition(np.linalg.norm(pixels[:, None] - pixels, axis=-1), 1, axis=1)[:, 1]


@functools.cache
def _third_differences(rows: int, columns: int) -> Pixels:
    """(D, N) that makes third differences, along rows and columns, of the N points of a grid."""
    numbers = np.arange(rows * columns).reshape(rows, columns)
    runs = [line[i : i + 4] for line in (*numbers, *numbers.T) for i in range(len(line) - 3)]
    matrix = np.zeros((len(runs), rows * columns))
    for row, run in zip(matrix, runs, strict=True):
        row[run] = 1, -3, 3, -1
    return matrix


def _mended(differences: Pixels, pixels: Pixels) -> tuple[Pixels, NDArray[np.bool_]]:
    """The corners with those that are far from where their rows have them put there; and which those are."""
    mended, strays = pixels.copy(), np.zeros(len(pixels), bool)
    weights = np.square(differences).sum(0)
    for _ in range(len(pixels) // 10):
        # what moving one corner does best for all differences that it is in
        off = differences.T @ (differences @ mended) / np.maximum(weights, 1)[:, None]
        far = np.linalg.norm(off, axis=1) / np.maximum(_to_nearest(mended), 1e-9)
        worst = int(far.argmax())
        if far[worst] < _STRAY:
            break
        mended[worst] -= off[worst]
        strays[worst] = True
    return mended, strays


def _refined(cv2: Any, grey: NDArray[np.uint8], pixels: Pixels, radius: float) -> Pixels:
    """Corners moved to where the gradients around them say, in a window of that half side."""
    half = int(np.clip(round(radius), 2, 20))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    corners = pixels.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), stop)
    return np.asarray(refined.reshape(-1, 2), np.float64)


def _ordered(board: Chessboard, grey: NDArray[np.uint8], pixels: Pixels) -> Pixels:
    """The points in the board's order, from whichever corner they were found."""
    grid = pixels.reshape(board.rows, board.columns, 2)
    right, down = grid[:, -1] - grid[:, 0], grid[-1] - grid[0]
    turn = right.mean(0)[0] * down.mean(0)[1] - right.mean(0)[1] * down.mean(0)[0]
    if turn < 0:  # boards are seen from the front
        grid = grid[:, ::-1]
    orders = [np.rot90(grid, k) for k in ((0, 2) if board.columns != board.rows else (0, 1, 2, 3))]
    black = [_first_is_black(grey, order) for order in orders]
    # a board that begins with white in every order has no better one
    orders = [order for order, much in zip(orders, black, strict=True) if much > 0] or orders
    first = min(orders, key=lambda order: float(order[0, 0].sum()))
    return np.ascontiguousarray(first).reshape(-1, 2)


def _first_is_black(grey: NDArray[np.uint8], grid: Pixels) -> float:
    """How much darker the squares are that are black in a board's order, of which the one at its top left is."""
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    columns, rows = np.rint(middles).astype(int).reshape(-1, 2).T
    inside = (columns >= 0) & (columns < grey.shape[1]) & (rows >= 0) & (rows < grey.shape[0])
    values = np.where(inside, grey[rows.clip(0, grey.shape[0] - 1), columns.clip(0, grey.shape[1] - 1)], np.nan)
    # the square between the first four corners touches the one at the board's top left by its corner: both are black
    black = (np.arange(grid.shape[0] - 1)[:, None] + np.arange(grid.shape[1] - 1)).ravel() % 2 == 0
    return float(np.nanmean(values[~black]) - np.nanmean(values[black]))


# -- boards with markers


def _parameters(cv2: Any, constant: float, border: int = 1) -> Any:
    """Of the search for markers: thresholds by windows of many sizes, with a margin below the mean of each.

    A margin that is large for the image's noise keeps neighbours apart whose corners nearly touch.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = 5, 53
    parameters.adaptiveThreshWinSizeStep = 6
    parameters.adaptiveThreshConstant = constant
    parameters.minMarkerPerimeterRate = 0.015
    parameters.markerBorderBits = border
    return parameters


def _passes(cv2: Any, grey: NDArray[np.uint8]) -> list[tuple[NDArray[np.uint8], int, float]]:
    """Images to search, how much larger they are, and with which margin, the most promising first."""
    low, high = np.percentile(grey, (2, 98))
    margins = [0.1 * float(high - low), 7.0]  # OpenCV's own
    images = [(grey, 1)]
    if grey.size < _SMALL:
        images.insert(0, (cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), 2))
    return [(image, scale, margin) for margin in margins for image, scale in images]


def _charuco(cv2: Any, board: Charuco, grey: NDArray[np.uint8]) -> Pixels | None:
    lengths = float(board.square), float(board.marker)
    target = cv2.aruco.CharucoBoard((board.columns, board.rows), *lengths, dictionary_of(board.dictionary))
    target.setLegacyPattern(board.legacy)
    most, count = None, 0
    for image, scale, margin in _passes(cv2, grey):
        detector = cv2.aruco.CharucoDetector(target, detectorParams=_parameters(cv2, margin))
        corners, ids, *_ = detector.detectBoard(image)
        if ids is not None and len(ids) > count:
            most, count = np.full((len(board.points()), 2), np.nan), len(ids)
            found = _from_centres(cv2, image, np.asarray(corners, np.float64).reshape(-1, 2))
            most[ids.ravel()] = (found + 0.5) / scale - 0.5
        if count == len(board.points()):
            break
    return most


def _from_centres(cv2: Any, image: NDArray[np.uint8], corners: Pixels) -> Pixels:
    """ChArUco's corners with integers at pixels' centres: OpenCV 4 has them half a pixel further right and down."""
    moved = np.median(_refined(cv2, image, corners, 3) - corners, axis=0)
    return corners + np.rint(2 * moved) / 2


def _aprilgrid(cv2: Any, board: AprilGrid, grey: NDArray[np.uint8]) -> Pixels | None:
    dictionary = dictionary_of(board.dictionary)
    tags: dict[int, Pixels] = {}
    for image, scale, margin in _passes(cv2, grey):
        detector = cv2.aruco.ArucoDetector(dictionary, _parameters(cv2, margin, board.border))
        corners, ids, _ = detector.detectMarkers(image)
        for tag, pixels in zip([] if ids is None else ids.ravel().tolist(), corners, strict=True):
            if tag < board.columns * board.rows:
                tags.setdefault(tag, (pixels.reshape(4, 2).astype(np.float64) + 0.5) / scale - 0.5)
        if len(tags) == board.columns * board.rows:
            break
    pixels = np.full((len(board.points()), 2), np.nan)
    for tag, corners in _consistent(cv2, board, tags).items():
        gap = board.spacing * np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).min()
        refined = _refined(cv2, grey, corners, 0.45 * gap)
        doubt = np.linalg.norm(refined - _refined(cv2, grey, corners, 0.3 * gap), axis=1)
        good = (np.linalg.norm(refined - corners, axis=1) < max(0.4 * gap, 2)) & (doubt < 0.3)
        rim = np.minimum(refined, (grey.shape[1] - 1, grey.shape[0] - 1) - refined).min(1)
        good &= rim > 0.45 * gap  # else a part of the window is missing
        pixels[list(board.corners_of(tag))] = np.where(good[:, None], refined, np.nan)
    return pixels


def _consistent(cv2: Any, board: AprilGrid, tags: dict[int, Pixels]) -> dict[int, Pixels]:
    """The tags that lie where their neighbours say, with their corners clockwise from the board's top left.

    OpenCV begins at the top left of a tag's code as its dictionary has it, which a board may hold turned.
    """
    places = {tag: board.points()[list(board.corners_of(tag)), :2] for tag in tags}
    pairs = [
        (a, b)
        for a, b in itertools.permutations(tags, 2)
        if np.linalg.norm(places[a][0] - places[b][0]) < 2.1 * board.square * (1 + board.spacing)
    ]
    if not pairs:
        return {}

    def errors(turn: int) -> list[float]:
        """How far the middle of b is from where a's corners put it, in sides of b."""
        found = []
        for a, b in pairs:
            corners = np.roll(tags[a], -turn, 0).astype(np.float32)
            plane = cv2.getPerspectiveTransform(places[a].astype(np.float32), corners)
            at = plane @ [*places[b].mean(0), 1.0]
            side = np.linalg.norm(tags[b] - np.roll(tags[b], 1, 0), axis=1).mean()
            found.append(float(np.linalg.norm(at[:2] / at[2] - tags[b].mean(0)) / side) if at[2] > 0 else math.inf)
        return found

    turn, of_pairs = min(((turn, errors(turn)) for turn in range(4)), key=lambda pair: float(np.median(pair[1])))
    of_tag: dict[int, list[float]] = {}
    for (_, b), error in zip(pairs, of_pairs, strict=True):
        of_tag.setdefault(b, []).append(error)
    return {tag: np.roll(tags[tag], -turn, 0) for tag, found in of_tag.items() if np.median(found) < 1}
