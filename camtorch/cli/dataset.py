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

from camtorch.augment import RandomCamera
from camtorch.camera import Camera
from camtorch.cli import cameras, coco, images, many
from camtorch.cli.coco import Json, read_json
from camtorch.data.samples import MapSamples
from camtorch.io.writing import replacing
from camtorch.jobs import inputs, items
from camtorch.jobs.items import Item, Tell
from camtorch.jobs.run import Account

_EYE, _EYES = "gaze_from", "keypoints_gaze_from"


@dataclass(frozen=True)
class Labelled(Item):
    """An image with labels: as many outputs as copies; then, where labels are files, as many of those."""

    place: str = ""
    """What the image is called in the data set, of which its draws follow."""
    labels: str = ""
    """The image's entry and its annotations, as JSON; empty where labels are a file, the second input."""


@dataclass
class Augmenting:
    """Makes the copies of an image; a `camtorch.jobs.items.Work`."""

    camera: Camera | None
    """Of a known size; None where the labels state the camera of each image."""
    path: Path | None
    """Of the file it is from."""
    rescale: bool
    seed: int
    copies: int
    options: dict[str, Any]
    """Of `RandomCamera`."""
    _samples: dict[str, MapSamples] = field(default_factory=dict)

    def settings(self) -> Json:
        """All that outputs depend on beside images and labels; JSON."""
        camera = None if self.camera is None else cameras.settings_of(self.camera)
        return {"camera": camera, "rescale": self.rescale, "seed": self.seed, "copies": self.copies, **self.options}

    def __call__(self, item: Item, tell: Tell) -> list[Any]:
        """For each copy the entry of the new image and its annotations; nothing where labels are files."""
        assert isinstance(item, Labelled)
        image, orientation = images.read(item.inputs[0], tell)
        entry, annotations = json.loads(item.labels) if item.labels else (read_json(item.inputs[1]), [])
        size = rows, columns = image.shape[-2], image.shape[-1]
        if item.labels and (entry.get("height", rows), entry.get("width", columns)) != size:
            stated = f"{entry.get('width')}x{entry.get('height')}"
            raise ValueError(f"it is {columns}x{rows}, and its labels are for {stated}")
        if orientation not in (None, 1):
            tell(f"{item.name} is taken as stored, not turned by its Exif orientation, and so are its labels")
        camera = self._camera(item.inputs[0], size, entry.get("camera"))
        known = json.dumps(cameras.settings_of(camera))
        if known not in self._samples:  # mostly it is that of the image before
            self._samples = {known: MapSamples(self.augmentation(camera), key="key", seed=self.seed)}
        moving = coco.Annotations(annotations, size)
        labels = {**(moving.labels if item.labels else entry), "camera": camera}
        if _EYE in labels:  # a pixel, though its name begins with that of a direction
            labels[_EYES] = [labels.pop(_EYE)]
        array = image.permute(1, 2, 0).numpy() if len(image) > 1 else image[0].numpy()
        result = []
        for copy in range(self.copies):
            moved = self._samples[known]({"key": (item.place, copy), "json": labels, "png": array})
            new, pixels = moved["json"], torch.from_numpy(moved["png"])
            made = images.from_tensor(pixels.permute(2, 0, 1) if pixels.ndim == 3 else pixels[None])
            images.write(item.outputs[copy], made, orientation=orientation, tell=tell, synced=False)
            if item.labels:
                result.append(({name: new[name] for name in ("camera", "rotation")}, moving.moved(new)))
                continue
            if _EYES in new:
                (new[_EYE],), (new[f"{_EYE}_valid"],) = new.pop(_EYES), new.pop(f"{_EYES}_valid")
            _write(item.outputs[self.copies + copy], new, synced=False)
        return result

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
    folder, source, copies = arguments.image, arguments.dataset, arguments.copies or 1
    if folder is None or not folder.is_dir():
        raise ValueError(f"--dataset: which images? camtorch augment FOLDER --dataset LABELS; got {folder}")
    output, shard = many.output_folder(arguments.output), many.shard_of(arguments)
    everything = _by_files(folder, source, output, copies) if source.is_dir() else []
    merged = None if source.is_dir() else output / source.name
    if merged is not None:
        rest, entries, annotations = coco.read(source)
        everything = [_by_entry(folder, entry, annotations[entry["id"]], output, copies) for entry in entries]
    if not everything:
        raise ValueError(f"{source}: no images")
    for item in everything:
        for path in item.outputs[:copies]:
            images.check_kind(path)
    whole = [*everything, *([] if merged is None else [Item((source,), (merged,))])]
    items.check(whole, [] if arguments.camera is None else [arguments.camera])
    sources = [item.inputs[0] for item in everything]
    camera = None if arguments.camera is None else cameras.read_for_many(sources, images.size_of, arguments)
    work = Augmenting(camera, arguments.camera, arguments.rescale, arguments.seed, copies, options)
    work.augmentation(camera)  # what is wrong with it is so for all
    account = Account(output, "augment", work.settings(), shard)
    if merged is not None and merged.exists() and not (arguments.force or account.has_begun):
        raise ValueError(f"{merged}: exists already; --force overwrites it")
    status = many.carry_out(shard.of(everything), work, account, arguments)
    if merged is not None and not arguments.dry_run:
        _merge(merged, rest, entries, annotations, everything, account, copies)
    return status


def _copies_of(place: Path, copies: int) -> list[Path]:
    """What the copies of an image are called: as it is, if there is one only."""
    return [place] if copies == 1 else [place.with_stem(f"{place.stem}-{copy + 1}") for copy in range(copies)]


def _by_files(folder: Path, labels: Path, output: Path, copies: int) -> list[Labelled]:
    """The images of a folder, whose labels lie in files of the same names."""
    result = []
    for path, place in inputs.find([str(folder)], inputs.IMAGES, output):
        made = [output / copy for copy in _copies_of(place, copies)]
        outputs = (*made, *(copy.with_suffix(".json") for copy in made))
        result.append(Labelled((path, labels / place.with_suffix(".json")), outputs, place=place.as_posix()))
    if not any(item.inputs[1].is_file() for item in result):
        raise ValueError(f"{labels}: no labels; those of {result[0].place} would be in {result[0].inputs[1]}")
    return result


def _by_entry(
    folder: Path, entry: Json, annotations: Sequence[tuple[int, Json]], output: Path, copies: int
) -> Labelled:
    """An image of a file of annotations."""
    place = Path(entry["file_name"])
    labels = json.dumps([entry, [one for _, one in annotations]], sort_keys=True)
    variant = hashlib.blake2b(labels.encode(), digest_size=16).hexdigest()
    outputs = tuple(output / copy for copy in _copies_of(place, copies))
    return Labelled((folder / place,), outputs, variant, place=place.as_posix(), labels=labels)


def _merge(
    path: Path,
    rest: Json,
    entries: Sequence[Json],
    annotations: dict[Any, list[tuple[int, Json]]],
    everything: Sequence[Labelled],
    account: Account,
    copies: int,
) -> None:
    """Write the annotations of all images that there are by now, of all shards."""
    made, left, new_images, ordered = 0, 0, list[Json](), list[Json]()
    while account.read():  # again after it is written: another shard may have ended meanwhile
        made, left, new_images = 0, 0, []
        new_annotations: list[tuple[int, Json]] = []
        for position, (entry, item) in enumerate(zip(entries, everything, strict=True)):
            record = account.standing(item, None)
            made += record is not None
            for copy, (new, moved) in enumerate([] if record is None else record["result"]):
                number = entry["id"] if copies == 1 else position * copies + copy + 1
                height, width = new["camera"]["image_size"]
                name = item.outputs[copy].relative_to(account.folder).as_posix()
                own = {} if copies == 1 else {"source_id": entry["id"]}
                own |= {"id": number, "file_name": name, "width": width, "height": height}
                new_images.append({**entry, **own, **new})
                for (place, old), one in zip(annotations[entry["id"]], moved, strict=True):
                    order = place * copies + copy
                    named = {"id": old.get("id") if copies == 1 else order + 1, "image_id": number}
                    left += one is None
                    new_annotations += [] if one is None else [(order, {**one, **named})]
        ordered = [one for _, one in sorted(new_annotations, key=lambda pair: pair[0])]
        if made:
            _write(path, {**rest, "images": new_images, "annotations": ordered})
    if not made:
        return
    of = f", of {made} of the {len(everything)} images so far" if made < len(everything) else ""
    print(f"{path}: {len(new_images)} images, {len(ordered)} annotations{of}; {left} annotations left their images")


def _write(path: Path, content: Json, *, synced: bool = True) -> None:
    with replacing(path, synced=synced) as (file,):
        file.write(json.dumps(content, allow_nan=False).encode() + b"\n")
