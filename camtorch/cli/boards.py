"""Options that say which board is meant, and lengths with their units."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from camtorch.boards.boards import Board

_KINDS = ("chessboard", "charuco", "aprilgrid")  # as `camtorch.boards` has them, which takes numpy to import
_UNITS = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254, "m": 1.0}


def parse_length(text: str) -> float:
    """Metres of "30mm", "3cm", "0.03m", "0.03" or "1in"."""
    unit = next((unit for unit in _UNITS if text.endswith(unit)), "")
    try:
        length = float(text.removesuffix(unit)) * _UNITS.get(unit, 1.0)
    except ValueError:
        length = math.nan
    if not 0 < length < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no length above 0, as 30mm, 3cm, 1in or, in metres, 0.03")
    if not unit and length >= 1:
        raise argparse.ArgumentTypeError(f"{text!r} would be metres: {text}mm, or {text}m if it is that large")
    return length


def parse_counts(text: str) -> tuple[int, int]:
    """(columns, rows) of "COLUMNSxROWS"."""
    counts = text.lower().split("x")
    if len(counts) != 2 or not all(count.isascii() and count.isdigit() and 0 < len(count) < 5 for count in counts):
        raise argparse.ArgumentTypeError(f"{text!r} is not COLUMNSxROWS, as in 9x6")
    return int(counts[0]), int(counts[1])


def add_board(command: argparse.ArgumentParser, square: str) -> None:
    """The board, of which `square` says what its side is without --square."""
    group = command.add_argument_group("board")
    group.add_argument("--type", choices=_KINDS, help="chessboard by default")
    group.add_argument(
        "--board",
        type=parse_counts,
        metavar="CxR",
        help="columns and rows: of a chessboard's inner corners, of ChArUco's squares, of AprilGrid's tags",
    )
    group.add_argument(
        "--square",
        type=parse_length,
        metavar="LENGTH",
        help=f"the side of a square or AprilTag, as 30mm, or in metres: 0.03; {square}",
    )
    group.add_argument("--marker", type=parse_length, metavar="LENGTH", help="of ChArUco; by default 3/4 of a square")
    group.add_argument("--legacy", action="store_true", help="a ChArUco board drawn by OpenCV before 4.6")
    group.add_argument("--spacing", type=float, metavar="PART", help="of AprilTags, in sides of a tag; 0.3 by default")
    group.add_argument("--border", type=int, metavar="CELLS", help="of AprilTags; 2 by default, as Kalibr prints")
    group.add_argument(
        "--dictionary",
        metavar="NAME",
        help="of markers, as OpenCV calls it; 5X5_1000 for ChArUco and APRILTAG_36h11 by default",
    )


def read_board(arguments: argparse.Namespace, square: float) -> Board:
    """The board that the options of `add_board` say, with squares of `square` if they do not say that.

    Raises:
        ValueError: no --board, options of another type of board, numbers that no board has.
    """
    from camtorch.boards.boards import board_of

    if arguments.board is None:
        raise ValueError("which board? --board COLUMNSxROWS says so, as in 9x6")
    kind, length = arguments.type or "chessboard", arguments.square or square
    columns, rows = arguments.board
    options = {"type": kind, "columns": columns, "rows": rows, "square": length}
    own = {"charuco": ("marker", "legacy", "dictionary"), "aprilgrid": ("spacing", "border", "dictionary")}
    for name in ("marker", "legacy", "spacing", "border", "dictionary"):
        value = getattr(arguments, name)
        if value in (None, False):
            continue
        if name not in own.get(kind, ()):
            kinds = " or ".join(f"--type {other}" for other in own if name in own[other])
            raise ValueError(f"--{name} is for {kinds}; this is a {kind}")
        options[name] = value
    if kind == "charuco":
        options.setdefault("marker", 0.75 * length)
    return board_of(options)


def said(board: Board) -> str:
    """The options that say which board it is."""
    options = board.options()
    words = f"--board {options.pop('columns')}x{options.pop('rows')}"
    kind = options.pop("type")
    if kind != "chessboard":
        words = f"--type {kind} {words}"
    for name, value in options.items():
        if isinstance(value, bool):
            words += f" --{name}" if value else ""
        else:
            words += f" --{name} {value:.6g}" if isinstance(value, float) else f" --{name} {value}"
    return words
