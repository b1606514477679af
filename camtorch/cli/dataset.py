"""A data set as other cameras see it: `camtorch augment --dataset`."""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from camtorch._arguments import warn
from camtorch.augment import RandomCamera
from camtorch.camera import Camera
from camtorch.cli import cameras, coco, images, many
from camtorch.cli.coco import Json, read_json
from camtorch.data.samples import MapSamples
from camtorch.io.writing import replacing
from camtorch.jobs import inputs, items
from camtorch.jobs.items import Item
from camtorch.jobs.run import Account

_EYE, _EYES = "gaze_from", "keypoints_gaze_from"


@dataclass(frozen=True)
class Labelled(Item):
    """An image with labels; where these are a file, it is the second input, and the new one the second output."""

    place: str = ""
    """What the image is called in the data set, of which its draws follow."""
    labels: str = ""
    """The image's entry and its annotations, as JSON; empty where labels are a file, the second input."""


@dataclass
class Augmenting:
    """Makes a new image of one; a `camtorch.jobs.items.Work`."""

    camera: Camera | None
    """Of a known size; None where the labels state the camera of each image."""
    path: Path | None
    """Of the file it is from."""
    rescale: bool
    seed: int
    options: dict[str, Any]
    """Of `RandomCamera`."""
    _samples: dict[str, MapSamples] = field(default_factory=dict)

    def settings(self) -> Json:
        """All that outputs depend on beside images and labels; JSON."""
        camera = None if self.camera is None else cameras.settings_of(self.camera)
        return {"camera": camera, "rescale": self.rescale, "seed": self.seed, **self.options}

    def __call__(self, item: Item) -> Any:
        """What the entry of the new image has, and its annotations; nothing where labels are files."""
        assert isinstance(item, Labelled)
        image, orientation = images.read_stored(item.inputs[0])
        entry, annotations = json.loads(item.labels) if item.labels else (read_json(item.inputs[1]), [])
        size = rows, columns = image.shape[-2], image.shape[-1]
        if item.labels and (entry.get("height", rows), entry.get("width", columns)) != size:
            stated = f"{entry.get('width')}x{entry.get('height')}"
            raise ValueError(f"it is {columns}x{rows}, and its labels are for {stated}")
        if orientation not in (None, 1):
            text = f"{item.name} is taken as stored, not turned by its Exif orientation, and so are its labels"
            warn(text)
        camera = self._camera(item.inputs[0], size, entry.get("camera"))
        known = json.dumps(cameras.settings_of(camera))
        if known not in self._samples:  # mostly it is that of the image before
            self._samples = {known: MapSamples(self.augmentation(camera), key="key", seed=self.seed)}
        moving = coco.Annotations(annotations, size)
        labels = {**(moving.labels if item.labels else entry), "camera": camera}
        if _EYE in labels:  # a pixel, though its name begins with that of a direction
            labels[_EYES] = [labels.pop(_EYE)]
        array = image.permute(1, 2, 0).numpy() if len(image) > 1 else image[0].numpy()
        # the zero is of times when there were several of an image: draws stay what they were
        moved = self._samples[known]({"key": (item.place, 0), "json": labels, "png": array})
        new, pixels = moved["json"], torch.from_numpy(moved["png"])
        made = images.from_tensor(pixels.permute(2, 0, 1) if pixels.ndim == 3 else pixels[None])
        images.write(item.outputs[0], made, orientation=orientation, synced=False)
        if item.labels:
            return {name: new[name] for name in ("camera", "rotation")}, moving.moved(new)
        if _EYES in new:
            (new[_EYE],), (new[f"{_EYE}_valid"],) = new.pop(_EYES), new.pop(f"{_EYES}_valid")
        _write(item.outputs[1], new, synced=False)
        return None

    def _camera(self, path: Path, size: tuple[int, int], stated: Any) -> Camera:
        if self.camera is None or self.path is None:
            if stated is None:
                raise ValueError("which camera took it? Neither its labels nor --camera FILE say so")
            return cameras.stated(stated, size)
        if stated is not None:
            raise ValueError(f"its labels state its camera, and so does --camera {self.path}; leave that out")
        return cameras.fitting(self.camera, self.path, path, size, self.rescale)

    def augmentation(self, camera: Camera | None) -> RandomCamera:
        """For images of a camera."""
        size = self.options["image_size"]
        shrinks = camera is not None and size is not None and (size[0] < camera.height or size[1] < camera.width)
        return RandomCamera(camera=camera and camera.requires_grad_(False), antialias=shrinks, **self.options)


def run(arguments: argparse.Namespace, options: dict[str, Any]) -> int:
    """Carry it out, with these options of `RandomCamera`."""
    folder, source = arguments.image, arguments.dataset
    if folder is None or not folder.is_dir():
        raise ValueError(f"--dataset: which images? camtorch augment FOLDER --dataset LABELS; got {folder}")
    output, shard = many.output_folder(arguments.output), many.shard_of(arguments)
    everything = _by_files(folder, source, output) if source.is_dir() else []
    merged = None if source.is_dir() else output / source.name
    if merged is not None:
        rest, entries, annotations = coco.read(source)
        everything = [_by_entry(folder, entry, annotations[entry["id"]], output) for entry in entries]
    if not everything:
        raise ValueError(f"{source}: no images")
    for item in everything:
        images.check_kind(item.outputs[0])
    whole = [*everything, *([] if merged is None else [Item((source,), (merged,))])]
    items.check(whole, [] if arguments.camera is None else [arguments.camera])
    sources = [item.inputs[0] for item in everything]
    camera = None if arguments.camera is None else cameras.read_for_many(sources, images.size_of, arguments)
    work = Augmenting(camera, arguments.camera, arguments.rescale, arguments.seed, options)
    work.augmentation(camera)  # what is wrong with it is so for all
    account = Account(output, "augment", work.settings(), shard)
    if merged is not None and merged.exists() and not (arguments.force or account.has_begun):
        raise ValueError(f"{merged}: exists already; --force overwrites it")
    status = many.carry_out(shard.of(everything), work, account, arguments)
    if merged is not None and not arguments.dry_run:
        _merge(merged, rest, entries, annotations, everything, account)
    return status


def _by_files(folder: Path, labels: Path, output: Path) -> list[Labelled]:
    """The images of a folder, whose labels lie in files of the same names."""
    result = []
    for path, place in inputs.find([str(folder)], inputs.IMAGES, output):
        label = place.with_suffix(".json")
        result.append(Labelled((path, labels / label), (output / place, output / label), place=place.as_posix()))
    if not any(item.inputs[1].is_file() for item in result):
        raise ValueError(f"{labels}: no labels; those of {result[0].place} would be in {result[0].inputs[1]}")
    return result


def _by_entry(folder: Path, entry: Json, annotations: Sequence[tuple[int, Json]], output: Path) -> Labelled:
    """An image of a file of annotations."""
    place = Path(entry["file_name"])
    labels = json.dumps([entry, [one for _, one in annotations]], sort_keys=True)
    variant = hashlib.blake2b(labels.encode(), digest_size=16).hexdigest()
    return Labelled((folder / place,), (output / place,), variant, place=place.as_posix(), labels=labels)


def _merge(
    path: Path,
    rest: Json,
    entries: Sequence[Json],
    annotations: dict[Any, list[tuple[int, Json]]],
    everything: Sequence[Labelled],
    account: Account,
) -> None:
    """Write the annotations of all images that there are by now, of all shards."""
    new_images, moved = list[Json](), list[tuple[int, Json | None]]()
    while account.read():  # again after it is written: another shard may have ended meanwhile
        new_images, moved = [], []
        for entry, item in zip(entries, everything, strict=True):
            record = account.standing(item, None)
            if record is not None:
                new, annotated = record["result"]
                height, width = new["camera"]["image_size"]
                new_images.append({**entry, "width": width, "height": height, **new})
                moved += zip((place for place, _ in annotations[entry["id"]]), annotated, strict=True)
        if new_images:
            left = [one for _, one in sorted(moved, key=lambda pair: pair[0]) if one is not None]
            _write(path, {**rest, "images": new_images, "annotations": left})
    if new_images:
        gone = sum(one is None for _, one in moved)
        print(
            f"{path}: {len(new_images)} of {len(everything)} images so far, {len(moved) - gone} annotations; {gone} "
            "annotations left their images"
        )


def _write(path: Path, content: Json, *, synced: bool = True) -> None:
    with replacing(path, synced=synced) as (file,):
        file.write(json.dumps(content, allow_nan=False).encode() + b"\n")
