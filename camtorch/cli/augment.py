"""The command `camtorch augment`: an image, or a whole data set, with its labels as other cameras see them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from camtorch.cli.options import (
    add_jobs,
    add_output,
    add_photograph,
    checked_ranges,
    parse_count,
    parse_fov,
    parse_path,
    parse_range,
    parse_size,
)
from camtorch.cli.terminal import note
from camtorch.jobs import pool

if TYPE_CHECKING:
    from camtorch.cli.options import Commands
    from camtorch.cli.sheet import LabelledImage

_SHEET = "augment.png"
_COUNT = 8
_MUCH = 1 / 3  # of the new images


def add(commands: Commands) -> None:
    """Add the command to a command line."""
    command = commands.add_parser(
        "augment",
        help="a sheet of an image with its labels, or a data set, as other cameras see them",
        description="A sheet of an image with its labels as other cameras see them. With --dataset a new data set: "
        "camtorch augment images/ --dataset annotations.json --camera camera.yml -o new/. A RANGE is LOW,HIGH, as in "
        "--yaw=-5,20, or a number: so far to either side of doing nothing, or just that --fov.",
        allow_abbrev=False,
    )
    command.set_defaults(run=run, prepare=prepare)
    command.add_argument(
        "image", type=parse_path, nargs="?", metavar="IMAGE", help="the image; the folder of images of a data set"
    )
    command.add_argument(
        "--labels",
        type=parse_path,
        metavar="FILE",
        help="of IMAGE: JSON of keypoints, boxes, gaze_from in pixels, gaze, and perhaps its camera",
    )
    command.add_argument("--preset", default="none", metavar="NAME", help="whose lens the other cameras have")
    command.add_argument("--list", action="store_true", help="print the presets, and nothing else")
    command.add_argument(
        "-n", type=parse_count(100), metavar="COUNT", help=f"how many other cameras; {_COUNT} by default"
    )
    command.add_argument("--seed", type=int, default=0, help="of what is drawn; 0 by default")
    command.add_argument("--size", type=parse_size, metavar="WxH", help="of the new images; by default the old one's")
    for name, text in (
        ("yaw", "degrees by which the camera turns to its right"),
        ("pitch", "degrees by which it then looks up"),
        ("roll", "degrees by which it then leans to its right"),
        ("zoom", "factor on the focal lengths"),
    ):
        command.add_argument(f"--{name}", type=parse_range, metavar="RANGE", help=text)
    command.add_argument(
        "--fov",
        type=parse_fov,
        metavar="RANGE",
        help="horizontal field of view in degrees; or source: as much of the lens's as the image fills",
    )
    command.add_argument(
        "--min-filled",
        type=float,
        default=0.0,
        metavar="PART",
        help="of each new image that has to show something, 0 to 1: it zooms until it does; 0 by default",
    )
    add_photograph(command)
    add_output(command, None, f"the sheet, {_SHEET} by default; of a data set, a folder")
    many = add_jobs(command)
    many.add_argument(
        "--dataset",
        type=parse_path,
        metavar="LABELS",
        help="of all images of the folder IMAGE: a JSON file in COCO's format, or a folder of a JSON file for each",
    )
    many.add_argument("--copies", type=parse_count(10000), metavar="N", help="new images of each; 1 by default")


def prepare(arguments: argparse.Namespace) -> None:
    """Before torch is imported: let processes begin to do so as well."""
    if arguments.dataset is not None and arguments.jobs != 1 and not arguments.dry_run:
        pool.prepare("camtorch.cli.dataset")


def run(arguments: argparse.Namespace) -> int:
    """Carry it out."""
    from camtorch.cli import dataset, sheet

    if arguments.list:
        print("\n".join(sheet.presets()))
        return 0
    is_sheet = arguments.dataset is None
    for name in ("jobs", "resume", "shard", "dry_run", "copies") if is_sheet else ("n", "labels"):
        if getattr(arguments, name):
            option = "-n" if name == "n" else f"--{name.replace('_', '-')}"
            raise ValueError(f"{option} is for {'--dataset' if is_sheet else 'a sheet, without --dataset'}")
    if not is_sheet:
        return dataset.run(arguments)
    _sheet(arguments)
    return 0


def _sheet(arguments: argparse.Namespace) -> None:
    from camtorch.cli import images, sheet

    if arguments.image is None:
        raise ValueError("which image? camtorch augment IMAGE --camera FILE")
    output, count = arguments.output or Path(_SHEET), arguments.n or _COUNT
    lens, ranges = sheet.lens(arguments.preset), checked_ranges(arguments)
    for name in ("from_model", "name"):
        if arguments.camera is None and getattr(arguments, name):
            raise ValueError(f"--{name.replace('_', '-')} needs --camera FILE")
    images.check_target(output, force=arguments.force, inputs=(arguments.image, arguments.camera, arguments.labels))
    before = _photograph(arguments)
    shown, ranges = [before], {"min_filled": arguments.min_filled, **ranges}
    for new in sheet.augmented(before, lens, count, arguments.seed, arguments.size, **ranges):
        print(new.note, flush=True)
        shown.append(new)
    empty = 1 - sum(new.filled for new in shown[1:]) / count
    if empty > _MUCH and not arguments.min_filled:
        note(
            f"{100 * empty:.0f} % of the new images shows nothing, as the camera of the image does not see so far; "
            "--fov source or --min-filled 0.9 takes less of that"
        )
    title = f"One image, {count} other camera{'s' * (count != 1)}"
    images.write(output, sheet.drawing(shown, title, sheet.origin(lens, before)))
    told = "" if before.is_made_up else ", with what became of the labels"
    print(f"{output}: the image before, and as each of them sees it{told}")


def _photograph(arguments: argparse.Namespace) -> LabelledImage:
    """The image given, with its labels."""
    from camtorch.cli import cameras, images, labels, sheet

    image, orientation = images.read(arguments.image)
    height, width = image.shape[-2:]
    entries = None if arguments.labels is None else labels.read_json(arguments.labels)
    if entries is None or "camera" not in entries:
        camera, _ = cameras.read_posed(arguments.image, (height, width), arguments)
    elif arguments.camera is None:
        try:
            camera = cameras.stated(entries["camera"], (height, width))
        except ValueError as error:
            raise ValueError(f"{arguments.image}: {error}") from None
    else:
        raise ValueError(f"{arguments.labels}: states the camera, and so does --camera; leave that out")
    if orientation not in (None, 1):
        note(f"{arguments.image} is shown as stored, not turned by its Exif orientation: so labels know it")
    known = None if entries is None else labels.labels_of(entries, arguments.labels, camera)
    return sheet.photograph(image, camera, known, arguments.image.name)
