"""The command `camtorch augment`: an image, or a whole data set, with its labels as other cameras see them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from camtorch.cli import cameras, coco, dataset, images, labels, sheet
from camtorch.cli.commands import SHEET, SHEET_COUNT
from camtorch.cli.terminal import note

_MUCH = 1 / 3  # of the new images


def run(arguments: argparse.Namespace) -> int:
    """Carry it out."""
    if arguments.list:
        print("\n".join(sheet.presets()))
        return 0
    is_sheet = arguments.dataset is None
    for name in ("jobs", "resume", "shard", "dry_run", "copies") if is_sheet else ("n", "labels"):
        if getattr(arguments, name):
            option = "-n" if name == "n" else f"--{name.replace('_', '-')}"
            raise ValueError(f"{option} is for {'--dataset' if is_sheet else 'a sheet, without --dataset'}")
    if is_sheet and arguments.image is None:
        raise ValueError("which image? camtorch augment IMAGE --camera FILE")
    like = sheet.lens(arguments.preset)
    if not 0 <= arguments.seed < 1 << 63:
        raise ValueError(f"--seed must be 0 or more, and below 2 to the 63rd; got {arguments.seed}")
    if not 0 <= arguments.min_filled <= 1:
        raise ValueError(f"--min-filled must be 0 to 1; got {arguments.min_filled:g}")
    if arguments.camera is None:
        for name in ("from_model", "name", "rescale"):
            if getattr(arguments, name):
                raise ValueError(f"--{name.replace('_', '-')} needs --camera FILE")
    given = {name: getattr(arguments, name) for name in ("yaw", "pitch", "roll", "zoom", "fov")}
    ranges = {name: value for name, value in given.items() if value is not None}
    if not is_sheet:
        return dataset.run(arguments, like, ranges)
    _sheet(arguments, like, ranges)
    return 0


def _sheet(arguments: argparse.Namespace, like: str | None, ranges: dict[str, Any]) -> None:
    output, count = arguments.output or Path(SHEET), arguments.n or SHEET_COUNT
    images.check_target(output, force=arguments.force, inputs=(arguments.image, arguments.camera, arguments.labels))
    before = _photograph(arguments)
    shown = [before]
    for new in sheet.augmented(before, like, count, arguments.seed, arguments.size, arguments.min_filled, **ranges):
        print(new.note, flush=True)
        shown.append(new)
    empty = 1 - sum(new.filled for new in shown[1:]) / count
    if empty > _MUCH and not arguments.min_filled:
        note(
            f"{100 * empty:.0f} % of the new images shows nothing, as the camera of the image does not see so far; "
            "--fov source or --min-filled 0.9 takes less of that"
        )
    title = f"One image, {count} other camera{'s' * (count != 1)}"
    images.write(output, sheet.drawing(shown, title, sheet.origin(like, before)))
    told = "" if before.is_made_up else ", with what became of the labels"
    print(f"{output}: the image before, and as each of them sees it{told}")


def _photograph(arguments: argparse.Namespace) -> sheet.LabelledImage:
    """The image given, with its labels."""
    image, orientation = images.read(arguments.image)
    height, width = image.shape[-2:]
    entries = None if arguments.labels is None else labels.read_json(arguments.labels)
    if entries is not None and "images" in entries:
        entries = coco.labels_of(arguments.labels, arguments.image, (height, width))
    if entries is None or entries.get("camera") is None:
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
