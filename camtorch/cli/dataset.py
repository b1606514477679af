"""A data set as other cameras see it: `camtorch augment --dataset`."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from camtorch.augment import RandomCamera
from camtorch.camera import Camera
from camtorch.cli import cameras, coco, images, many
from camtorch.cli.labels import Json, read_json
from camtorch.data.samples import MapSamples
from camtorch.io.writing import replacing
from camtorch.jobs import inputs, items
from camtorch.jobs.items import Item, Listener, Shard
from camtorch.jobs.manifest import Manifest, lock

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

    def __call__(self, item: Item, listener: Listener) -> Json:
        """Entries of the new images and their annotations, where labels are no files."""
        assert isinstance(item, Labelled)
        image, orientation = images.read(item.inputs[0], tell=listener.note)
        entry, annotations = json.loads(item.labels) if item.labels else (read_json(item.inputs[1]), [])
        size = rows, columns = image.shape[-2], image.shape[-1]
        if item.labels and (entry.get("height", rows), entry.get("width", columns)) != size:
            stated = f"{entry.get('width')}x{entry.get('height')}"
            raise ValueError(f"it is {columns}x{rows}, and its labels are for {stated}")
        if orientation not in (None, 1):
            listener.note(f"{item.name} is taken as stored, not turned by its Exif orientation, and so are its labels")
        camera = self._camera(item.inputs[0], size, entry.get("camera"))
        known = json.dumps(cameras.settings_of(camera))
        if known not in self._samples:  # mostly it is that of the image before
            self._samples = {known: MapSamples(self.augmentation(camera), key="key", seed=self.seed)}
        samples = self._samples[known]
        moving = coco.Annotations(annotations, size, listener.note)
        labels = moving.labels if item.labels else dict(entry)
        if _EYE in labels:  # a pixel, though its name begins with that of a direction
            labels[_EYES] = [labels.pop(_EYE)]
        array = image.permute(1, 2, 0).numpy() if len(image) > 1 else image[0].numpy()
        result: Json = {"images": [], "annotations": []}
        for copy in range(self.copies):
            named = {"key": (item.place, copy)}

            def move(labels: Json, named: Json = named) -> Json:
                moved: Json = samples({**named, "json": {**labels, "camera": camera}})["json"]
                return moved

            moved = samples({**named, "json": {**labels, "camera": camera}, "png": array})
            new, pixels = moved["json"], torch.from_numpy(moved["png"])
            made = images.from_tensor(pixels.permute(2, 0, 1) if pixels.ndim == 3 else pixels[None])
            images.write(item.outputs[copy], made, orientation=orientation, tell=listener.note, synced=False)
            if item.labels:
                result["images"].append({name: new[name] for name in ("camera", "rotation")})
                result["annotations"].append(moving.moved(new, move))
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


def run(arguments: argparse.Namespace, like: str | None, ranges: dict[str, Any]) -> int:
    """Carry it out, with such lenses and ranges of `RandomCamera`."""
    folder, source, copies = arguments.image, arguments.dataset, arguments.copies or 1
    if folder is None or not folder.is_dir():
        raise ValueError(f"--dataset: which images? camtorch augment FOLDER --dataset LABELS; got {folder}")
    output = many.output_folder(None if arguments.output is None else str(arguments.output))
    shard = arguments.shard or Shard.of_environment()
    data = None if source.is_dir() else coco.read(source)
    everything, faults = (
        _by_files(folder, source, output, copies) if data is None else (_by_entries(folder, data, output, copies), [])
    )
    if not everything:
        raise ValueError(f"{source}: no images")
    for item in everything:
        for path in item.outputs[:copies]:
            images.check_kind(path)
    merged = None if data is None else output / data.path.name
    others = [path for path in (arguments.camera, None if data is None else source) if path is not None]
    items.check(everything, others)
    if merged is not None:
        taken = {os.path.realpath(path) for item in everything for path in (*item.inputs, *item.outputs)}
        if os.path.realpath(merged) in {*taken, *map(os.path.realpath, others)}:
            raise ValueError(f"{merged}: would overwrite what is read; -o names another folder")
    sources = [item.inputs[0] for item in everything]
    camera = None if arguments.camera is None else cameras.read_for_many(sources, images.size_of, arguments)
    options = {"like": like, "image_size": arguments.size, "min_filled": arguments.min_filled or None, **ranges}
    work = Augmenting(camera, arguments.camera, arguments.rescale, arguments.seed, copies, options)
    work.augmentation(camera)  # what is wrong with it is so for all
    manifest = Manifest(output, "augment", work.settings(), shard)
    if merged is not None and os.path.lexists(merged) and not (arguments.resume or arguments.force):
        manifest.read()
        if shard.count == 1 or not any(map(manifest.has_begun, everything)):
            raise ValueError(f"{merged}: exists already; --resume goes on where it was broken off, --force overwrites")
    mine = shard.of(everything)
    status = many.carry_out(mine, faults, work, manifest, arguments, doing="augmenting", units="images")
    if data is not None and merged is not None and not arguments.dry_run:
        with (output / ".camtorch-augment.lock").open("wb") as file:  # the last shard has what all have made
            lock(file, wait=True)
            _merge(data, everything, manifest, merged, copies)
    return status


def _copies_of(place: Path, copies: int) -> list[Path]:
    """What the copies of an image are called: as it is, if there is one only."""
    return [place] if copies == 1 else [place.with_stem(f"{place.stem}-{copy + 1}") for copy in range(copies)]


def _by_files(folder: Path, labels: Path, output: Path, copies: int) -> tuple[list[Labelled], list[tuple[Path, str]]]:
    """The images of a folder, whose labels lie in files of the same names; and what could not be looked into."""
    found, faults = inputs.find([str(folder)], inputs.IMAGES, output)
    result = []
    for one in found:
        places = [output / place for place in _copies_of(one.place, copies)]
        outputs = (*places, *(place.with_suffix(".json") for place in places))
        of_image = labels / one.place.with_suffix(".json")
        result.append(Labelled((one.path, of_image), outputs, place=one.place.as_posix()))
    if result and not any(item.inputs[1].is_file() for item in result):
        raise ValueError(f"{labels}: no labels; those of {result[0].place} would be in {result[0].inputs[1]}")
    return result, faults


def _by_entries(folder: Path, data: coco.DataSet, output: Path, copies: int) -> list[Labelled]:
    """The images of a file of annotations."""
    result = []
    for image in data.images:
        place = Path(image["file_name"])
        annotations = [one for _, one in data.annotations[image["id"]]]
        labels = json.dumps([image, annotations], sort_keys=True)
        variant = hashlib.blake2b(labels.encode(), digest_size=16).hexdigest()
        outputs = tuple(output / copy for copy in _copies_of(place, copies))
        result.append(Labelled((folder / place,), outputs, variant, place=place.as_posix(), labels=labels))
    return result


def _merge(data: coco.DataSet, everything: Sequence[Labelled], manifest: Manifest, path: Path, copies: int) -> None:
    """Write the annotations of all images that there are by now, of all shards."""
    manifest.read()
    new_images: list[Json] = []
    new_annotations: list[tuple[int, Json]] = []
    made = left = 0
    for position, (image, item) in enumerate(zip(data.images, everything, strict=True)):
        result = _result(item, manifest)
        if result is None:
            continue
        made += 1
        for copy, entry in enumerate(result["images"]):
            number = image["id"] if copies == 1 else position * copies + copy + 1
            height, width = entry["camera"]["image_size"]
            name = item.outputs[copy].relative_to(manifest.folder).as_posix()
            source = {} if copies == 1 else {"source_id": image["id"]}
            new_images.append(
                {**image, **source, "id": number, "file_name": name, "width": width, "height": height, **entry}
            )
            for (place, old), new in zip(data.annotations[image["id"]], result["annotations"][copy], strict=True):
                if new is None:
                    left += 1
                    continue
                own = old.get("id") if copies == 1 else place * copies + copy + 1
                new_annotations.append((place * copies + copy, {**new, "id": own, "image_id": number}))
    if not made:
        return
    ordered = [one for _, one in sorted(new_annotations, key=lambda pair: pair[0])]
    _write(path, {**data.rest, "images": new_images, "annotations": ordered})
    of = f", of {made} of the {len(everything)} images so far" if made < len(everything) else ""
    print(f"{path}: {len(new_images)} images, {len(ordered)} annotations{of}; {left} annotations left their images")


def _result(item: Labelled, manifest: Manifest) -> Json | None:
    """What was kept of an item that was made, by whatever shard."""
    for line in reversed(manifest.records(item)):
        if (line["variant"], line["settings"]) == (item.variant, manifest.settings):
            result: Json = line["result"]
            return result if all(path.is_file() for path in item.outputs) else None
    return None


def _write(path: Path, content: Json, *, synced: bool = True) -> None:
    with replacing(path, synced=synced) as (file,):
        file.write(json.dumps(content, allow_nan=False).encode() + b"\n")
