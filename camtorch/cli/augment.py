"""The command `camtorch augment`: an image, or a whole data set, with its labels as other cameras see them."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from camtorch.augment import PRESETS, RandomCamera
from camtorch.augment.sample import Sample
from camtorch.cli import cameras, dataset, images, sheet
from camtorch.cli.coco import read_json
from camtorch.cli.commands import SHEET, SHEET_COUNT
from camtorch.cli.terminal import note
from camtorch.data.labelled import failing_at
from camtorch.data.seeded import generator

_MUCH = 1 / 3  # of the new images
_NOTHING = (233, 225, 209)  # the colour of what no camera saw
_FINE = 3  # times what a sheet shows are the new images, so that its edges are smooth
_REAL = "another of 7,000 calibrated lenses for each image, of the field of view that --fov says"


def run(arguments: argparse.Namespace) -> int:
    """Carry it out."""
    if arguments.list:
        for name, preset in PRESETS.items():
            height, width = preset.image_size
            print(f"{name:<12} {preset.model:<15} {f'{width}x{height}':<10} {preset.origin}")
        print(f"{'real':<12} {'kannala_brandt':<15} {'any':<10} {_REAL}")
        return 0
    is_sheet = arguments.dataset is None
    for name in ("jobs", "resume", "shard", "dry_run") if is_sheet else ("n", "labels"):
        if getattr(arguments, name):
            option = "-n" if name == "n" else f"--{name.replace('_', '-')}"
            raise ValueError(f"{option} is for {'--dataset' if is_sheet else 'a sheet, without --dataset'}")
    if is_sheet and arguments.image is None:
        raise ValueError("which image? camtorch augment IMAGE --camera FILE")
    if is_sheet and arguments.image.is_dir():
        raise ValueError(f"{arguments.image}: a folder; a sheet is of one image, and --dataset LABELS is for a folder")
    like = None if arguments.preset == "none" else arguments.preset
    if like is not None and like != "real" and like not in PRESETS:
        known = "; ".join(f"{name}, {preset.origin}" for name, preset in PRESETS.items())
        raise ValueError(f"there is no preset {like!r}. There are none, the image's own lens; {known}; real, {_REAL}")
    given = {name: getattr(arguments, name) for name in ("yaw", "pitch", "roll", "zoom", "fov")}
    options = {name: value for name, value in given.items() if value is not None}
    options |= {"like": like, "image_size": arguments.size, "min_filled": arguments.min_filled or None}
    if not is_sheet:
        return dataset.run(arguments, options)
    output, count = arguments.output or Path(SHEET), arguments.n or SHEET_COUNT
    images.check_target(output, force=arguments.force, inputs=(arguments.image, arguments.camera, arguments.labels))
    before = _photograph(arguments)
    camera = before["camera"]
    shown = [(before, [f"before: {arguments.image.name}", f"{camera.key}, {float(camera.fov[0]):.0f}° wide"])]
    empty = 0.0
    for new, caption, told in _augmented(before, count, arguments.seed, options):
        print(f"{len(shown):3}: {told}", flush=True)
        shown.append((new, caption))
        empty += 1 - float(new["image_valid"].double().mean())
    if empty > _MUCH * count and not arguments.min_filled:
        note(
            f"{100 * empty / count:.0f} % of the new images shows nothing, as the camera of the image does not see so "
            "far; --fov source or --min-filled 0.9 takes less of that"
        )
    images.write(output, sheet.sheet(shown, f"One image, {count} other camera{'s' * (count != 1)}"))
    print(f"{output}: the image before, and as each of them sees it")
    return 0


@torch.no_grad()
def _photograph(arguments: argparse.Namespace) -> Sample:
    """The image given, in colour, with its labels."""
    image, orientation = images.read_stored(arguments.image)
    size, path = (image.shape[-2], image.shape[-1]), arguments.labels
    entries = {} if path is None else read_json(path)
    if "annotations" in entries:
        raise ValueError(
            f"{path}: labels of a data set in COCO's form, which --dataset takes; --labels is of one image"
        )
    if orientation not in (None, 1):
        note(f"{arguments.image} is shown as stored, not turned by its Exif orientation: so labels know it")
    if entries.get("camera") is None:
        camera, _ = cameras.read_posed(arguments.image, size, arguments)
    elif arguments.camera is None:
        camera = cameras.stated(entries["camera"], size)
    else:
        raise ValueError(f"{path}: states the camera, and so does --camera; leave that out")
    sample: Sample = {"image": images.in_colour(image, _NOTHING), "camera": camera}
    with failing_at(path, "", ValueError, TypeError, RuntimeError, OverflowError):
        for name in ("keypoints", "boxes"):
            if entries.get(name):
                with failing_at(name, "", ValueError, TypeError):
                    sample[name] = torch.from_numpy(np.asarray(entries[name], np.float64))
                count, valid = len(sample[name]), entries.get(f"{name}_valid", True)
                seen = camera.contains(sample[name].reshape(count, -1)[:, :2])  # what begins off the image is not shown
                sample[f"{name}_valid"] = seen & torch.as_tensor(valid, dtype=torch.bool)
        if entries.get("gaze") is not None and entries.get("gaze_from") is not None:
            sample["gaze"] = torch.from_numpy(np.asarray(entries["gaze"], np.float64).reshape(-1, 3))
            eyes, seen = camera.unproject(np.asarray(entries["gaze_from"], np.float64).reshape(1, 2))
            if not bool(seen):
                raise ValueError(f"gaze_from: the camera has no ray at {entries['gaze_from']}")
            sample["points"] = eyes.double().expand_as(sample["gaze"])
        RandomCamera(min_filled=0)(**sample)  # which says what is wrong with them
    if path is not None and not entries.keys() & {"keypoints", "boxes", "gaze"}:
        note(f"{path}: has no keypoints, boxes or gaze, so no labels are shown")
    return sample


@torch.no_grad()
def _augmented(
    before: Sample, count: int, seed: int, options: dict[str, Any]
) -> Iterator[tuple[Sample, list[str], str]]:
    """What random cameras make of a sample, each with its caption, and in a line; the same first ones for any count."""
    camera = before["camera"]
    height, width = options["image_size"] or (camera.height, camera.width)
    scale = _FINE * min(sheet.TILE[0] / height, sheet.TILE[1] / width)
    size = max(1, round(height * scale)), max(1, round(width * scale))
    options = {**options, "image_size": size}
    augmentation = RandomCamera(antialias=True, fill=_NOTHING, valid_mask=True, **options)
    for i in range(count):
        draw = augmentation.draw(1, generator(i, seed=seed))
        new = augmentation(before, draw=draw)
        angles = [f"{name} {float(draw[name]) + 0.0:+.1f}°" for name in ("yaw", "pitch", "roll")]
        wide = f"{options['like'] or camera.key}, {float(new['camera'].fov[0]):.0f}° wide"
        filled = f"{100 * float(new['image_valid'].double().mean()):.0f} % filled"
        inside = [
            f"{int(new[f'{name}_valid'].sum())} of {len(new[name])} {name}"
            for name in ("keypoints", "boxes")
            if name in new
        ]
        told = ", ".join([*angles, wide, filled, *inside]).replace("°", " degrees")
        yield new, ["   ".join(angles), f"{wide}, {filled}"], told
