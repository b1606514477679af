"""The command `camtorch demo`: render, and measure what camtorch makes of it. In a checkout of the repository."""

from __future__ import annotations

import argparse
import importlib.util
from typing import TYPE_CHECKING

from camtorch.cli.options import add_output

if TYPE_CHECKING:
    from camtorch.cli.options import Commands

GET_IT = "git clone https://github.com/camtorch/camtorch && pip install -e camtorch"


def add(commands: Commands) -> None:
    """Add the command to a command line."""
    command = commands.add_parser(
        "demo", help="render, and measure what camtorch makes of it (in a checkout)", allow_abbrev=False
    )
    command.set_defaults(run=run)
    command.add_argument(
        "subject",
        nargs="?",
        choices=("room", "stereo", "surround", "training", "camera"),
        default="room",
        help="room: dewarp a room seen by five lenses (the default); stereo: measure it by two fisheyes (with OpenCV); "
        "surround: a car park from above, by four; training: teach networks with augmentation (some minutes); camera: "
        "teach one to tell the lens of an image (a minute)",
    )
    add_output(command, "demo.png", "the image")


def installed() -> bool:
    """Whether the rendered scenes are there; wheels leave them out."""
    return importlib.util.find_spec("camtorch.demo") is not None


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    from camtorch.cli import images

    if not installed():
        raise ValueError(f"the demo comes with the repository, not with the installed package: {GET_IT}")
    images.check_target(arguments.output, force=arguments.force)
    # not before: what is installed may be without it
    from camtorch.demo import dewarping, prediction, stereo, surround, training

    if arguments.subject == "stereo":
        image = stereo.drawing(*stereo.run(_line))
        caption = "what the cameras see, rectified, the distances found in it, and the points"
    elif arguments.subject == "surround":
        image = surround.drawing(surround.run(_line))
        caption = "what the cameras see, and the ground from above"
    elif arguments.subject == "training":
        image = training.drawing(training.run(_line))
        caption = "what each network learned from, and what it finds behind the fisheye"
    elif arguments.subject == "camera":
        image = prediction.drawing(prediction.run(_line))
        caption = "images of lenses that the network has not seen, and what it found"
    else:
        image = dewarping.drawing(dewarping.run(_line))
        caption = "the sources, what became of them, and what separates that from the truth"
    images.write(arguments.output, image)
    print(f"{arguments.output}: {caption}")


def _line(text: str) -> None:
    print(text, flush=True)
