"""Options that several commands have, and how the command line reads paths, sizes and ranges."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from camtorch.jobs.items import Shard

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[argparse.ArgumentParser]

LARGEST_SIDE = 32768
"""Pixels."""


def parse_path(text: str) -> Path:
    """A path that a file can have."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(f"{text!r} is no name of a file")
    return Path(text)


def parse_size(text: str) -> tuple[int, int]:
    """(height, width) of "WIDTHxHEIGHT"."""
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() and len(side) < 9 for side in sides):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, as in 1280x720")
    width, height = map(int, sides)
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
        raise argparse.ArgumentTypeError(f"{text!r}: each side must be 1 to {LARGEST_SIDE} pixels")
    return height, width


def parse_count(most: int) -> Callable[[str], int]:
    """What reads a whole number from 1 to `most`."""

    def parse(text: str) -> int:
        if not (text.isascii() and text.isdigit() and 0 < int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {most}")
        return int(text)

    return parse


def parse_range(text: str) -> float | tuple[float, float]:
    """A number, or two."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 2):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor LOW,HIGH, as in -5,20")
    return (numbers[0], numbers[1]) if len(numbers) == 2 else numbers[0]


def parse_fov(text: str) -> float | tuple[float, float] | str:
    """A range, or the word "source"."""
    return text if text == "source" else parse_range(text)


LENS = "lens:"
"""What the name of a real lens begins with, in the place of a calibration file."""


def parse_lens(text: str) -> Path:
    """The name of a real lens, in the place of a calibration file."""
    return parse_path(LENS + text)


GUESS = "guess:"
"""What a guessed horizontal field of view in degrees begins with, in the place of a calibration file."""


def _parse_guess(text: str) -> Path:
    try:
        degrees = float(text)
    except ValueError:
        degrees = math.nan
    if 0 < degrees <= 2 * math.pi:
        raise argparse.ArgumentTypeError(
            f"{text} seems to be radians: {math.degrees(degrees):.4g} degrees; it takes degrees"
        )
    if not 0 < degrees <= 360:
        raise argparse.ArgumentTypeError(f"{text!r} is no field of view in degrees, as 120")
    return Path(GUESS + text)


def add_photograph(command: argparse.ArgumentParser) -> None:
    """The calibration of an image."""
    which = command.add_mutually_exclusive_group()
    which.add_argument("--camera", type=parse_path, metavar="FILE", help="its calibration, of any format")
    which.add_argument(
        "--lens",
        type=parse_lens,
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


def add_projection(command: argparse._ActionsContainer) -> None:
    """What a dewarped image shows."""
    command.add_argument(
        "--projection", choices=("perspective", "cylindrical", "equirectangular"), default="perspective"
    )
    command.add_argument(
        "--fov",
        type=float,
        metavar="DEGREES",
        help="horizontal field of view of the new image; by default that of the old one, up to 120 in perspective",
    )
    command.add_argument(
        "--size", type=parse_size, metavar="WxH", help="size of the new image; by default the old one's"
    )


def checked_ranges(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the options of `camtorch augment` say of the ranges of `RandomCamera`.

    Raises:
        ValueError: a seed or a --min-filled that is none.
    """
    if not 0 <= arguments.seed < 1 << 63:
        raise ValueError(f"--seed must be 0 or more, and below 2 to the 63rd; got {arguments.seed}")
    if not 0 <= arguments.min_filled <= 1:
        raise ValueError(f"--min-filled must be 0 to 1; got {arguments.min_filled:g}")
    ranges = {name: getattr(arguments, name) for name in ("yaw", "pitch", "roll", "zoom", "fov")}
    return {name: value for name, value in ranges.items() if value is not None}


def add_calibration(
    command: argparse.ArgumentParser, of_name: str = "which camera, in a file with several", size: str = "--size"
) -> None:
    """How to read a calibration that is the command's subject; `size` is the option that says for which images."""
    command.add_argument("--name", help=of_name)
    _add_from_model(command)
    command.add_argument(size, type=parse_size, metavar="WxH", help="of images, where the file does not say")


def _add_from_model(command: argparse.ArgumentParser, *others: str) -> None:
    command.add_argument(
        "--from-model",
        *others,
        metavar="KEY",
        help="the model in the file, where that does not say it: kannala_brandt, brown_conrady ...",
    )


def _add_rescale(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--rescale", action="store_true", help="scale the camera to the image's resolution, of the same aspect ratio"
    )


def add_output(command: argparse.ArgumentParser, default: str | None, text: str = "the new image") -> None:
    """Where the result goes."""
    usual = f"; {default} by default" if default else ""
    command.add_argument(
        "-o", "--output", type=parse_path, default=default and Path(default), metavar="OUT", help=text + usual
    )
    add_force(command)


def add_jobs(command: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """How many files are worked on."""
    group = command.add_argument_group("many files")
    group.add_argument(
        "--jobs", type=parse_count(1024), metavar="N", help="processes; by default as many as there are cores"
    )
    group.add_argument(
        "--resume", action="store_true", help="go on where a run was broken off; what is done and unchanged is kept"
    )
    group.add_argument(
        "--shard",
        type=_parse_shard,
        metavar="I/N",
        help="only the I-th of N parts, as 1/4; processes of torchrun and srun know theirs",
    )
    group.add_argument("--dry-run", action="store_true", help="print what would be done")
    return group


def _parse_shard(text: str) -> Shard:
    place, _, count = text.partition("/")
    if not all(part.isascii() and part.isdigit() for part in (place, count)) or not 0 < int(place) <= int(count):
        raise argparse.ArgumentTypeError(f"{text!r} is not I/N, the I-th of N parts, from 1/N to N/N")
    return Shard(int(place) - 1, int(count))


def parse_suffix(text: str) -> str:
    """A suffix, as ".png"."""
    if not (text.startswith(".") and text[1:].isalnum()):
        raise argparse.ArgumentTypeError(f"{text!r} is no suffix, as .png is")
    return text


def add_force(command: argparse.ArgumentParser) -> None:
    """Whether OUT may exist."""
    command.add_argument("--force", action="store_true", help="overwrite OUT if it exists")
