"""How the command line reads paths, sizes, lengths and ranges; and the options that several commands have."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

from camtorch.jobs.items import Shard

LARGEST_SIDE = 32768
"""Pixels."""
LENS = "lens:"
"""What the name of a real lens begins with, in the place of a calibration file."""
GUESS = "guess:"
"""What a guessed horizontal field of view in degrees begins with, in the place of a calibration file."""
PAPERS = ("a4", "a3", "a2", "a1", "a0", "letter", "legal", "tabloid")
_KINDS = ("chessboard", "charuco", "aprilgrid")  # as `camtorch.boards` has them, which takes numpy to import
_UNITS = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254, "m": 1.0}
_WrongWord = argparse.ArgumentTypeError


# -- words


def parse_path(text: str) -> Path:
    """A path that a file can have."""
    return Path(parse_word(text))


def parse_word(text: str) -> str:
    """A path as it was written: a slash at its end says that it is a folder."""
    if not text or "\0" in text:
        raise _WrongWord(f"{text!r} is no name of a file")
    return text


def parse_suffix(text: str) -> str:
    """A suffix, as ".png"."""
    if not (text.startswith(".") and text[1:].isalnum()):
        raise _WrongWord(f"{text!r} is no suffix, as .png is")
    return text


def _counts(text: str, separator: str) -> tuple[int, ...]:
    """Two whole numbers of up to eight digits, or nothing."""
    words = text.lower().split(separator)
    fits = len(words) == 2 and all(word.isascii() and word.isdigit() and len(word) < 9 for word in words)
    return tuple(map(int, words)) if fits else ()


def parse_size(text: str) -> tuple[int, int]:
    """(height, width) of "WIDTHxHEIGHT"."""
    if not (sides := _counts(text, "x")):
        raise _WrongWord(f"{text!r} is not WIDTHxHEIGHT, as in 1280x720")
    if not all(0 < side <= LARGEST_SIDE for side in sides):
        raise _WrongWord(f"{text!r}: each side must be 1 to {LARGEST_SIDE} pixels")
    return sides[1], sides[0]


def parse_board(text: str) -> tuple[int, int]:
    """(columns, rows) of "COLUMNSxROWS"."""
    counts = _counts(text, "x")
    if not counts or max(counts) > 9999:
        raise _WrongWord(f"{text!r} is not COLUMNSxROWS, as in 9x6")
    return counts[0], counts[1]


def parse_shard(text: str) -> Shard:
    """The I-th of N parts, of "I/N"."""
    part = _counts(text, "/")
    if not part or not 0 < part[0] <= part[1]:
        raise _WrongWord(f"{text!r} is not I/N, the I-th of N parts, from 1/N to N/N")
    return Shard(part[0] - 1, part[1])


def parse_count(most: int) -> Callable[[str], int]:
    """What reads a whole number from 1 to `most`."""

    def parse(text: str) -> int:
        if not (text.isascii() and text.isdigit() and 0 < int(text) <= most):
            raise _WrongWord(f"{text!r} is not a whole number from 1 to {most}")
        return int(text)

    return parse


def parse_range(text: str) -> float | tuple[float, float]:
    """A number, or two."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 2):
        raise _WrongWord(f"{text!r} is neither a number nor LOW,HIGH, as in -5,20")
    return (numbers[0], numbers[1]) if len(numbers) == 2 else numbers[0]


def parse_fov(text: str) -> float | tuple[float, float] | str:
    """A range, or the word "source"."""
    return text if text == "source" else parse_range(text)


def _parse_guess(text: str) -> Path:
    try:
        degrees = float(text)
    except ValueError:
        degrees = math.nan
    if 0 < degrees <= 2 * math.pi:
        raise _WrongWord(f"{text} seems to be radians: {math.degrees(degrees):.4g} degrees; it takes degrees")
    if not 0 < degrees <= 360:
        raise _WrongWord(f"{text!r} is no field of view in degrees, as 120")
    return Path(GUESS + text)


def parse_length(text: str) -> float:
    """Metres of "30mm", "3cm", "0.03m", "0.03" or "1in"."""
    unit = next((unit for unit in _UNITS if text.endswith(unit)), "")
    try:
        length = float(text.removesuffix(unit)) * _UNITS.get(unit, 1.0)
    except ValueError:
        length = math.nan
    if not 0 < length < math.inf:
        raise _WrongWord(f"{text!r} is no length above 0, as 30mm, 3cm, 1in or, in metres, 0.03")
    if not unit and length >= 1:
        raise _WrongWord(f"{text!r} would be metres: {text}mm, or {text}m if it is that large")
    return length


def parse_paper(text: str) -> str | tuple[float, float]:
    """The name of a paper, or (width, height) in mm of "WIDTHxHEIGHT", as in 400x300mm."""
    name = text.lower()
    if name in (*PAPERS, "board"):
        return name
    unit = next((unit for unit in _UNITS if name.endswith(unit)), "mm")
    sides = name.removesuffix(unit).split("x")
    if len(sides) != 2:
        raise _WrongWord(f"{text!r} is no paper: {', '.join(PAPERS)}, board, or WIDTHxHEIGHT, as in 400x300mm")
    width, height = (1000 * parse_length(f"{side}{unit}") for side in sides)
    return width, height


# -- options of several commands


def add_photograph(command: argparse.ArgumentParser) -> None:
    """The calibration of an image."""
    which = command.add_mutually_exclusive_group()
    which.add_argument("--camera", type=parse_path, metavar="FILE", help="its calibration, of any format")
    which.add_argument(
        "--lens",
        type=lambda text: parse_path(LENS + text),
        dest="camera",
        metavar="NAME",
        help="instead of a calibration, a real lens by its name: camtorch lenses lists them",
    )
    which.add_argument(
        "--guess-fov",
        type=_parse_guess,
        dest="camera",
        metavar="DEGREES",
        help="instead of a calibration, a guess: a camera of this horizontal field of view, pinhole below 100 degrees, "
        "equidistant kannala_brandt from there on, or what --model says",
    )
    _add_from_model(command, "--model")
    command.add_argument("--name", help="which camera, in a file with several")
    _add_rescale(command)


def add_pair(command: argparse.ArgumentParser) -> None:
    """The calibration of a pair of images."""
    command.add_argument("--camera", type=parse_path, metavar="RIG", help="its calibration with both poses, any format")
    command.add_argument("--left-camera", metavar="NAME", help="the camera of LEFT; by default the first of two")
    command.add_argument("--right-camera", metavar="NAME", help="that of RIGHT; by default the second of two")
    _add_from_model(command)
    _add_rescale(command)


def add_calibration(
    command: argparse.ArgumentParser, of_name: str = "which camera, in a file with several", size: str = "--size"
) -> None:
    """How to read a calibration that is the command's subject; `size` is the option that says for which images."""
    command.add_argument("--name", help=of_name)
    _add_from_model(command)
    command.add_argument(size, type=parse_size, metavar="WxH", help="of images, where the file does not say")


def _add_from_model(command: argparse.ArgumentParser, *others: str) -> None:
    text = "the model in the file, where that does not say it: kannala_brandt, brown_conrady ..."
    command.add_argument("--from-model", *others, metavar="KEY", help=text)


def _add_rescale(command: argparse.ArgumentParser) -> None:
    text = "scale the camera to the image's resolution, of the same aspect ratio"
    command.add_argument("--rescale", action="store_true", help=text)


def add_projection(command: argparse._ActionsContainer) -> None:
    """What a dewarped image shows."""
    projections = ("perspective", "cylindrical", "equirectangular")
    command.add_argument("--projection", choices=projections, default="perspective")
    text = "horizontal field of view of the new image; by default that of the old one, up to 120 in perspective"
    command.add_argument("--fov", type=float, metavar="DEGREES", help=text)
    text = "size of the new image; by default the old one's"
    command.add_argument("--size", type=parse_size, metavar="WxH", help=text)


def add_board(command: argparse.ArgumentParser, square: str) -> None:
    """The board, of which `square` says what its side is without --square."""
    group = command.add_argument_group("board")
    group.add_argument("--type", choices=_KINDS, help="chessboard by default")
    group.add_argument(
        "--board",
        type=parse_board,
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
    text = "of markers, as OpenCV calls it; 5X5_1000 for ChArUco and APRILTAG_36h11 by default"
    group.add_argument("--dictionary", metavar="NAME", help=text)


def add_output(command: argparse.ArgumentParser, default: str | None, text: str = "the new image") -> None:
    """Where the result goes."""
    usual = f"; {default} by default" if default else ""
    command.add_argument(
        "-o", "--output", type=parse_path, default=default and Path(default), metavar="OUT", help=text + usual
    )
    add_force(command)


def add_force(command: argparse.ArgumentParser) -> None:
    """Whether OUT may exist."""
    command.add_argument("--force", action="store_true", help="overwrite OUT if it exists")


def add_jobs(command: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """How many files are worked on."""
    group = command.add_argument_group("many files")
    text = "processes; by default as many as there are cores"
    group.add_argument("--jobs", type=parse_count(1024), metavar="N", help=text)
    text = "go on where a run was broken off; what is done and unchanged is kept"
    group.add_argument("--resume", action="store_true", help=text)
    text = "only the I-th of N parts, as 1/4; processes of torchrun and srun know theirs"
    group.add_argument("--shard", type=parse_shard, metavar="I/N", help=text)
    group.add_argument("--dry-run", action="store_true", help="print what would be done")
    return group
