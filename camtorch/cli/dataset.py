"""A data set as other cameras see it: what `camtorch augment --dataset` reads and writes."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from camtorch.cli import cameras, coco, images, labelled_image, many
from camtorch.cli.augmenting import Augmenting, Json, Labelled
from camtorch.cli.labels import LabelsError
from camtorch.cli.options import checked_ranges
from camtorch.io.writing import replacing
from camtorch.jobs import inputs, items
from camtorch.jobs.manifest import Manifest, lock


def run(arguments: argparse.Namespace) -> int:
    """Carry it out."""
    like = labelled_image.lens(arguments.preset)
    ranges = checked_ranges(arguments)
    folder, source, copies = arguments.image, arguments.dataset, arguments.copies or 1
    if folder is None or not folder.is_dir():
        raise ValueError(f"--dataset: which images? camtorch augment FOLDER --dataset LABELS; got {folder}")
    output = many.output_folder(None if arguments.output is None else str(arguments.output))
    shard = many.shard_of(arguments)
    data = None if source.is_dir() else coco.read(source)
    faults: list[tuple[Path, str]] = []
    if data is None:
        everything, faults = _by_files(folder, source, output, copies)
    else:
        everything = _by_entries(folder, data, output, copies)
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
    work = Augmenting(
        _camera(arguments, everything),
        arguments.camera,
        arguments.rescale,
        like,
        arguments.size,
        arguments.min_filled or None,
        ranges,
        arguments.seed,
        copies,
    )
    manifest = Manifest(output, "augment", work.settings(), shard)
    if merged is not None and os.path.lexists(merged) and not (arguments.resume or arguments.force):
        manifest.read()
        if shard.count == 1 or not any(map(manifest.has_begun, everything)):
            raise ValueError(f"{merged}: exists already; --resume goes on where it was broken off, --force overwrites")
    status, report = many.carry_out(
        shard.of(everything),
        faults if shard.rank == 0 else [],
        work,
        manifest,
        arguments,
        doing="augmenting",
        units="images",
    )
    if data is not None and merged is not None and report is not None:
        with (output / ".camtorch-augment.lock").open("wb") as file:  # the last shard has what all have made
            lock(file, wait=True)
            _merge(data, everything, manifest, merged, copies)
    return status


def _camera(arguments: argparse.Namespace, everything: Sequence[Labelled]) -> Any:
    """Of all images; None where their labels are to state it."""
    if arguments.camera is None:
        for name in ("from_model", "name", "rescale"):
            if getattr(arguments, name):
                raise ValueError(f"--{name.replace('_', '-')} needs --camera FILE")
        return None
    return cameras.read_for_many([item.inputs[0] for item in everything], images.size_of, arguments)


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
    """The images of a file of annotations.

    Raises:
        LabelsError: numbers that JSON does not know, which could not be written again.
    """
    _text_of(data.rest, f'{data.path}: what is beside "images" and "annotations"')
    result = []
    for i, image in enumerate(data.images):
        place = Path(image["file_name"])
        labels = _text_of([image, [one for _, one in data.of(image)]], f"{data.path}: images[{i}] and its annotations")
        result.append(
            Labelled(
                (folder / place,),
                tuple(output / copy for copy in _copies_of(place, copies)),
                hashlib.blake2b(labels.encode(), digest_size=16).hexdigest(),
                place=place.as_posix(),
                labels=labels,
            )
        )
    return result


def _text_of(content: Any, what: str) -> str:
    try:
        return json.dumps(content, sort_keys=True, allow_nan=False)
    except ValueError:
        raise LabelsError(f"{what}: NaN and infinity are no JSON; null is, or leave them out") from None


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
            for (place, old), new in zip(data.of(image), result["annotations"][copy], strict=True):
                if new is None:
                    left += 1
                    continue
                own = old.get("id") if copies == 1 else place * copies + copy + 1
                new_annotations.append((place * copies + copy, {**new, "id": own, "image_id": number}))
    ordered = [one for _, one in sorted(new_annotations, key=lambda pair: pair[0])]
    with replacing(path) as (file,):
        content = {**data.rest, "images": new_images, "annotations": ordered}
        file.write(json.dumps(content, allow_nan=False).encode() + b"\n")
    of = f", of {made} of the {len(everything)} images so far" if made < len(everything) else ""
    print(f"{path}: {len(new_images)} images, {len(ordered)} annotations{of}; {left} annotations left their images")


def _result(item: Labelled, manifest: Manifest) -> Json | None:
    """What was kept of an item that was made, by whatever shard."""
    for line in reversed(manifest.records(item)):
        if (line["variant"], line["settings"]) == (item.variant, manifest.settings):
            there = all(path.is_file() for path in item.outputs)
            result: Json | None = line["result"] if there else None
            return result
    return None
