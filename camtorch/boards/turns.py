"""Boards that look the same after a turn: which points are which, where several cameras see one board at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import Board

Array = NDArray[np.float64]

_APART = 0.5
"""Radians, or sizes of the board, from which on two mounts are simply not the same."""


def turns_of(board: Board) -> list[tuple[NDArray[np.int64], Array]]:
    """The turns of a board about its middle that leave it looking the same, the first of them none.

    Returns:
        Of each, for every point the number of the one that comes where it is, (N,), and the turn as (4, 4).
    """
    points, rows = board.points(), np.arange(math.prod(board.grid)).reshape(board.grid)
    middle, found = (points.min(0) + points.max(0)) / 2, []
    for turn in range(board.symmetries):
        angle = 2 * math.pi * turn / board.symmetries
        matrix = np.eye(4)
        matrix[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        matrix[:3, 3] = middle - matrix[:3, :3] @ middle
        # from x to y is a quarter turn against numpy's, whose rows grow downwards as y does
        found.append((np.rot90(rows, turn * 4 // board.symmetries).ravel(), matrix))
    return found


def agreeing(board: Board, poses: Mapping[str, Mapping[int, Array]]) -> dict[str, dict[int, int]]:
    """The turn, of `turns_of`, by which each camera's view of the board is the first camera's.

    A camera's place among the others is the same in all views, which only one turn in each view allows, unless the
    boards hardly move.
    poses: camera -> view -> (4, 4) camera from board, with the points numbered as they were found. Returned is
    camera -> view -> number of the turn; for cameras that share no view with the others the first.
    """
    turns = [matrix for _, matrix in turns_of(board)]
    size = float(np.ptp(board.points(), axis=0).max())
    names = list(poses)
    settled: dict[str, dict[int, int]] = {names[0]: dict.fromkeys(poses[names[0]], 0)}
    while len(settled) < len(names):

        def shared(name: str, known: str) -> list[int]:
            return sorted(set(poses[name]) & set(settled[known]))

        # the one that shares most with those that are settled
        name = max(set(names) - set(settled), key=lambda name: max(len(shared(name, known)) for known in settled))
        found: dict[int, int] = {}
        for known in sorted(settled, key=lambda known: -len(shared(name, known))):
            views = shared(name, known)
            if not set(views) - set(found):
                continue
            boards = {view: np.linalg.inv(poses[known][view] @ turns[settled[known][view]]) for view in views}
            mounts = np.array([[poses[name][view] @ turn @ boards[view] for turn in turns] for view in views])
            found = dict(zip(views, _nearest(mounts, size), strict=True)) | found
        settled[name] = dict.fromkeys(poses[name], 0) | found
    return settled


def _nearest(mounts: Array, size: float) -> list[int]:
    """Which of each view's (V, S, 4, 4) is nearest to the one on which most views agree."""
    each = mounts.reshape(-1, 4, 4)
    cosines = (np.einsum("aij,vsij->avs", each[:, :3, :3], mounts[..., :3, :3]) - 1) / 2
    angles = np.arccos(np.clip(cosines, -1, 1))
    shifts = np.linalg.norm(each[:, None, None, :3, 3] - mounts[..., :3, 3], axis=-1)
    errors = angles + shifts / size
    best = np.minimum(errors.min(-1), _APART).sum(-1).argmin()
    return [int(turn) for turn in errors[best].argmin(-1)]


def reordered(board: Board, pixels: Array, turns: Sequence[int]) -> Array:
    """Pixels (V, N, 2) with the points of each view numbered as the turn of that view, of `turns_of`, has them."""
    orders = [order for order, _ in turns_of(board)]
    return np.stack([of_view[orders[turn]] for of_view, turn in zip(pixels, turns, strict=True)])
