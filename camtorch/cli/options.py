"""The size of an image, as the command line takes it."""

import argparse

_LARGEST_SIDE = 32768


def parse_size(text: str) -> tuple[int, int]:
    """(height, width) of "WIDTHxHEIGHT"."""
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() and len(side) < 9 for side in sides):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, as in 1280x720")
    width, height = map(int, sides)
    if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
        raise argparse.ArgumentTypeError(f"{text!r}: each side must be 1 to {_LARGEST_SIDE} pixels")
    return height, width
