"""Boards that are photographed to calibrate: their points, and the black cells that they are printed from.

A board's frame lies in it: x right, y down, z away from who looks at it, as OpenCV's; lengths in the caller's unit.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray


def opencv(owner: str) -> Any:
    """The module cv2.

    Raises:
        ImportError: it is not installed, or older than 4.8.
    """
    try:
        module = importlib.import_module("cv2")
    except ImportError:
        module = None
    if not hasattr(getattr(module, "aruco", None), "CharucoDetector"):
        raise ImportError(f'{owner} needs OpenCV 4.8 or newer: pip install "camtorch[calibrate]"')
    return module


class Cells(NamedTuple):
    """A grid (rows, columns) of squares of side `pitch`, some black; x, y: its top left in the board's frame."""

    black: NDArray[np.bool_]
    x: float
    y: float
    pitch: float


@dataclass(frozen=True)
class Board:
    """A board: what all kinds have.

    Raises:
        ValueError: numbers that no board has.
    """

    columns: int
    rows: int
    square: float = 1.0
    kind: ClassVar[str]
    counted: ClassVar[str]
    """What `columns` and `rows` count."""
    least: ClassVar[int]
    sides: ClassVar[tuple[str, ...]] = ("square",)
    """Which of its numbers are lengths."""

    def __post_init__(self) -> None:
        owner = type(self).__name__
        if min(self.columns, self.rows) < self.least:
            raise ValueError(
                f"{owner}: at least {self.least}x{self.least} {self.counted} are needed; got {self.columns}x{self.rows}"
            )
        if not 0 < self.square < float("inf"):
            raise ValueError(f"{owner}: lengths must be positive and finite; got {self.square:g}")

    @property
    def grid(self) -> tuple[int, int]:
        """(rows, columns) of the points."""
        return self.rows, self.columns

    @property
    def is_symmetric(self) -> bool:
        """Whether it looks the same after a turn, so that nothing tells which of its points is the first."""
        return False

    def points(self) -> NDArray[np.float64]:
        """(N, 3), row by row from the top left."""
        raise NotImplementedError

    def cells(self) -> Iterator[Cells]:
        """What is black."""
        raise NotImplementedError

    def options(self) -> dict[str, str | int | float]:
        """What makes this board, in plain values; `board_of` reads it."""
        return {"type": self.kind, **asdict(self)}

    def looks_like(self, other: Board) -> bool:
        """Whether it is the same but for its size: its points are found at the same pixels."""
        mine, its = (
            board.options() | {side: round(float(getattr(board, side)) / board.square, 6) for side in board.sides}
            for board in (self, other)
        )
        return mine == its

    def words(self, unit: str = "") -> str:
        """What it is, in a few words."""
        return f"{self.kind}, {self.columns}x{self.rows} {self.counted}, {self.lengths(unit)}"

    def lengths(self, unit: str) -> str:
        """Its lengths in words; in millimetres if the unit is "m"."""
        return f"squares of {shown_length(self.square, unit)}"


def _grid_points(xs: NDArray[Any], ys: NDArray[Any]) -> NDArray[np.float64]:
    x, y = np.meshgrid(xs.astype(np.float64), ys.astype(np.float64))
    return np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)


def _chessboard(columns: int, rows: int) -> NDArray[np.bool_]:
    """(rows, columns) squares, black at the top left."""
    return np.asarray((np.arange(rows)[:, None] + np.arange(columns)) % 2 == 0)


@dataclass(frozen=True)
class Chessboard(Board):
    """A chessboard.

    Args:
        columns: of inner corners, where four squares meet, as OpenCV counts; the squares are one more.
        rows: likewise.
        square: the side of a square.
    """

    kind = "chessboard"
    counted = "inner corners"
    least = 3  # of which OpenCV finds no fewer

    @property
    def is_symmetric(self) -> bool:
        return (self.columns + self.rows) % 2 == 0  # else a half turn exchanges black and white

    def points(self) -> NDArray[np.float64]:
        return _grid_points(self.square * np.arange(self.columns), self.square * np.arange(self.rows))

    def cells(self) -> Iterator[Cells]:
        yield Cells(_chessboard(self.columns + 1, self.rows + 1), -self.square, -self.square, self.square)


@dataclass(frozen=True)
class Charuco(Board):
    """A chessboard whose white squares hold markers, which say what is seen where only part of it is: OpenCV's ChArUco.

    Args:
        columns: of squares, as OpenCV counts.
        rows: likewise.
        square: the side of a square.
        marker: the side of a marker.
        dictionary: of the markers, as OpenCV calls it, without DICT_.
        legacy: with a white square at the top left where the rows are even: boards of OpenCV before 4.6.
    """

    marker: float = 0.75
    dictionary: str = "5X5_1000"
    legacy: bool = False
    kind = "charuco"
    counted = "squares"
    least = 3
    sides: ClassVar[tuple[str, ...]] = ("square", "marker")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.marker < self.square:
            got = f"{self.marker:g} in {self.square:g}"
            raise ValueError(f"Charuco: a marker must be smaller than its square; got {got}")

    @property
    def grid(self) -> tuple[int, int]:
        return self.rows - 1, self.columns - 1

    def points(self) -> NDArray[np.float64]:
        return _grid_points(self.square * np.arange(1, self.columns), self.square * np.arange(1, self.rows))

    def cells(self) -> Iterator[Cells]:
        black = _chessboard(self.columns, self.rows)
        if self.legacy and self.rows % 2 == 0:
            black = ~black
        yield Cells(black, 0.0, 0.0, self.square)
        margin = (self.square - self.marker) / 2
        for number, (row, column) in enumerate(np.argwhere(~black)):
            marker = self.square * column + margin, self.square * row + margin
            yield _tag(self.dictionary, number, 1, *marker, self.marker)

    def lengths(self, unit: str) -> str:
        markers = f"markers of {shown_length(self.marker, unit)} of {self.dictionary}"
        return f"{super().lengths(unit)}, {markers}{', legacy pattern' if self.legacy else ''}"


@dataclass(frozen=True)
class AprilGrid(Board):
    """A grid of AprilTags with small black squares between their corners: Kalibr's.

    Tag 0 is at the bottom left, and numbers grow to the right, then upwards.

    Args:
        columns: of tags.
        rows: likewise.
        square: the side of a tag, its black border included.
        spacing: the gap between two tags, in sides of a tag.
        dictionary: of the tags, as OpenCV calls it, without DICT_.
        border: the black border around a tag's code, in cells: Kalibr prints 2, others 1.
    """

    spacing: float = 0.3
    dictionary: str = "APRILTAG_36h11"
    border: int = 2
    kind = "aprilgrid"
    counted = "tags"
    least = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.spacing <= 2:
            raise ValueError(
                f"AprilGrid: the spacing is a part of a tag's side, above 0 and at most 2; got {self.spacing:g}"
            )
        if self.border not in (1, 2, 3):
            raise ValueError(f"AprilGrid: a tag's border is 1, 2 or 3 cells; got {self.border}")

    @property
    def grid(self) -> tuple[int, int]:
        return 2 * self.rows, 2 * self.columns

    def points(self) -> NDArray[np.float64]:
        xs, ys = (
            self.square * (np.arange(count)[:, None] * (1 + self.spacing) + (0.0, 1.0)).ravel()
            for count in (self.columns, self.rows)
        )
        return _grid_points(xs, ys)

    def corners_of(self, tag: int) -> tuple[int, int, int, int]:
        """The points of a tag, clockwise from its top left."""
        row, column = self.rows - 1 - tag // self.columns, tag % self.columns
        first = 2 * row * 2 * self.columns + 2 * column
        return first, first + 1, first + 2 * self.columns + 1, first + 2 * self.columns

    def cells(self) -> Iterator[Cells]:
        gap = self.square * self.spacing
        for tag in range(self.columns * self.rows):
            x, y, _ = self.points()[self.corners_of(tag)[0]].tolist()
            yield _tag(self.dictionary, tag, self.border, x, y, self.square)
        for row, column in np.ndindex(self.rows + 1, self.columns + 1):
            x, y = (number * (self.square + gap) - gap for number in (column, row))
            yield Cells(np.ones((1, 1), bool), x, y, gap)

    def lengths(self, unit: str) -> str:
        tags = f"{self.dictionary} with a border of {self.border}"
        return f"tags of {shown_length(self.square, unit)}, spacing {self.spacing:g}, {tags}"


BOARDS: dict[str, type[Board]] = {board.kind: board for board in (Chessboard, Charuco, AprilGrid)}


def board_of(options: Mapping[str, Any]) -> Board:
    """The board of its `options()`.

    Raises:
        ValueError: no such kind, or options that it does not have.
    """
    given = dict(options)
    kind = BOARDS.get(given.pop("type", ""))
    if kind is None:
        raise ValueError(f"a board's type must be one of {', '.join(BOARDS)}; got {options.get('type')!r}")
    known = {field.name for field in fields(kind)}
    if not {"columns", "rows"} <= set(given) <= known:
        raise ValueError(f"a {kind.kind} has {', '.join(sorted(known))}; got {', '.join(sorted(given)) or 'nothing'}")
    return kind(**given)


def dictionary_of(name: str) -> Any:
    """OpenCV's dictionary of markers.

    Raises:
        ValueError: there is none of that name.
    """
    aruco = opencv("a board with markers").aruco
    known = {key[5:].lower(): key for key in dir(aruco) if key.startswith("DICT_")}
    key = known.get(name.lower().removeprefix("dict_"))
    if key is None:
        raise ValueError(f"board: no dictionary of markers is called {name!r}; OpenCV has {', '.join(sorted(known))}")
    return aruco.getPredefinedDictionary(getattr(aruco, key))


def _tag(dictionary: str, number: int, border: int, x: float, y: float, side: float) -> Cells:
    markers = dictionary_of(dictionary)
    count = len(markers.bytesList)
    if number >= count:
        raise ValueError(f"board: the dictionary {dictionary} has {count} markers, and the board needs more")
    cells = markers.markerSize + 2 * border
    return Cells(markers.generateImageMarker(number, cells, borderBits=border) == 0, x, y, side / cells)


def shown_length(length: float, unit: str) -> str:
    """A length in words: in millimetres if the unit is "m", else bare."""
    return f"{1000 * length:.6g} mm" if unit == "m" else f"{length:.6g}"
