"""The command `camtorch lenses`: lenses that exist, by their names."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from camtorch.cli.options import add_output, parse_count, parse_size

if TYPE_CHECKING:
    from camtorch.cli.options import Commands


def add(commands: Commands) -> None:
    """Add the command to a command line."""
    command = commands.add_parser(
        "lenses",
        help="find a real lens by its name",
        description="List calibrated lenses by words of their names, best first: camtorch lenses GoPro HERO9 wide. "
        "Other commands take the first of a list as --lens 'GoPro HERO9 wide'.",
        allow_abbrev=False,
    )
    command.set_defaults(run=run)
    command.add_argument("words", nargs="+", metavar="WORD", help="of brand, camera, lens and setting, in any order")
    command.add_argument(
        "--size", type=parse_size, metavar="WxH", help="of images: only lenses of that aspect ratio, scaled to it"
    )
    command.add_argument(
        "-n", type=parse_count(100000), default=10, metavar="N", help="how many are listed at most; 10 by default"
    )
    command.add_argument("--format", help="of OUT; by default what its name says")
    add_output(command, None, "the calibration of the first")


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    from camtorch import lenses
    from camtorch.cli import targets
    from camtorch.io import save

    words, output, size = " ".join(arguments.words), arguments.output, arguments.size
    if output is not None:
        targets.check(output, force=arguments.force)
    camera = lenses.find(words, image_size=size)
    found = lenses.search(words, image_size=size)
    for lens in found[: arguments.n]:
        print(str(lens)[1:-1])
    if len(found) > arguments.n:
        print(f"and {len(found) - arguments.n} more; -n {len(found)} lists them all")
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        save(camera, output, arguments.format)
        print(f"{output}: {found[0].name}, {camera.width}x{camera.height}")
