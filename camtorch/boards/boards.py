"""Calibration boards: their points, in the board's frame.

The frame lies in the board, as OpenCV's: x right, y down, z away from the viewer. Lengths are in the caller's unit.
"""

import re
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from camtorch.values.arguments import imported, shown


def opencv(owner: str) -> Any:
    """Return the module cv2, or raise an ImportError if it is not installed or older than 4.8."""
    return imported("cv2", f"{owner} needs OpenCV 4.8 or newer", "calibrate", has="aruco.CharucoDetector")


@dataclass(frozen=True)
class Board:
    """The common part of all boards: `columns` and `rows` of what is `counted`, and the side of a `square` or tag."""

    columns: int
    rows: int
    square: float = 1.0
    kind: ClassVar[str]
    counted: ClassVar[str]
    least: ClassVar[int] = 3  # OpenCV finds no smaller boards

    @property
    def is_symmetric(self) -> bool:
        """Whether the board looks the same after a half turn, so that its first point is ambiguous."""
        return isinstance(self, Chessboard) and (self.columns + self.rows) % 2 == 0  # a half turn keeps black and white

    def points(self) -> NDArray[np.float64]:
        """Return the points (N, 3), row by row from the top left."""
        x, y = np.meshgrid(*(self.square * self._places(count) for count in (self.columns, self.rows)))
        return np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)

    def _places(self, count: int) -> NDArray[np.float64]:
        """Return the places of points along a side, in squares."""
        raise NotImplementedError

    def words(self, unit: str = "") -> str:
        """Return a description; lengths in millimetres if the unit is "m"."""
        side = f"{1000 * self.square:.6g} mm" if unit == "m" else f"{self.square:.6g}"
        of = "tags" if self.counted == "tags" else "squares"
        return f"{self.kind}, {self.columns}x{self.rows} {self.counted}, {of} of {side}"


@dataclass(frozen=True)
class Chessboard(Board):
    """A chessboard, counted by inner corners as in OpenCV; it has one square more each way."""

    kind = "chessboard"
    counted = "inner corners"

    def _places(self, count: int) -> NDArray[np.float64]:
        return np.arange(float(count))


@dataclass(frozen=True)
class Charuco(Board):
    """OpenCV's ChArUco: a chessboard with markers in its white squares, of which a part is enough.

    `legacy` boards, of OpenCV before 4.6, have a white square at the top left if the rows are even.
    """

    marker: float = 0.75
    dictionary: str = "5X5_1000"
    legacy: bool = False
    kind = "charuco"
    counted = "squares"

    def _places(self, count: int) -> NDArray[np.float64]:
        return np.arange(1.0, count)


@dataclass(frozen=True)
class AprilGrid(Board):
    """Kalibr's grid of AprilTags; tag 0 is at the bottom left, numbers grow to the right, then up.

    `spacing` is the gap between two tags in sides of a tag, `border` the black cells around a tag's code, Kalibr's 2.
    """

    spacing: float = 0.3
    dictionary: str = "APRILTAG_36h11"
    border: int = 2
    kind = "aprilgrid"
    counted = "tags"
    least = 2

    def _places(self, count: int) -> NDArray[np.float64]:
        return np.ravel(np.arange(count)[:, None] * (1 + self.spacing) + (0.0, 1.0))

    def corners_of(self, tag: int) -> list[int]:
        """Return the numbers of a tag's points, clockwise from its top left."""
        row, column = self.rows - 1 - tag // self.columns, tag % self.columns
        first = 4 * row * self.columns + 2 * column
        return [first, first + 1, first + 2 * self.columns + 1, first + 2 * self.columns]


BOARDS: dict[str, type[Board]] = {board.kind: board for board in (Chessboard, Charuco, AprilGrid)}


def as_board(board: Any, square: float, options: dict[str, Any], owner: str) -> Board:
    """Return the board of words like "charuco 5x7", or of OpenCV's (9, 6), if it exists and has such options."""
    if isinstance(board, (tuple, list)) and len(board) == 2:
        board = f"{board[0]}x{board[1]}"
    words = r"\s*(?:([a-z]+)\s+)?(\d+)\s*[x,]\s*(\d+)\s*"
    match = re.fullmatch(words, board.lower()) if isinstance(board, str) else None
    if match is None:
        raise ValueError(
            f'{owner}: board must be "9x6" (inner corners of a chessboard), "charuco 5x7" or "aprilgrid 6x6"; got '
            f"{shown(board)}"
        )
    kind = BOARDS.get(match[1] or "chessboard")
    if kind is None:
        raise ValueError(f"{owner}: a board's type must be one of {', '.join(BOARDS)}; got {match[1]!r}")
    known = [field.name for field in fields(kind)][3:]
    if strange := sorted(set(options) - set(known)):
        raise ValueError(f"{owner}: {kind.kind} options must be {', '.join(known) or 'none'}; got {', '.join(strange)}")
    options = ({"marker": 0.75 * square} if kind is Charuco else {}) | options
    found = kind(int(match[2]), int(match[3]), square, **options)
    rules: list[tuple[bool, str]] = [
        (min(found.columns, found.rows) < kind.least, f"must have at least {kind.least}x{kind.least} {kind.counted}"),
        (not 0 < square < float("inf"), "must have positive, finite lengths"),
        (isinstance(found, Charuco) and not 0 < found.marker < square, "must have markers smaller than its squares"),
        (isinstance(found, AprilGrid) and not 0 < found.spacing <= 2, "must have a spacing above 0, at most 2 sides"),
        (isinstance(found, AprilGrid) and found.border not in (1, 2, 3), "must have a border of 1, 2 or 3 cells"),
    ]
    for is_broken, rule in rules:
        if is_broken:
            raise ValueError(f"{owner}: a board {rule}; got {found}")
    return found
