"""What `camtorch augment --dataset` does to each image of a data set with its labels, in whatever process."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from camtorch.augment import RandomCamera
from camtorch.camera import Camera
from camtorch.cli import cameras, coco, images
from camtorch.data.columns import PARTS, to_columns
from camtorch.data.samples import MapSamples
from camtorch.io.writing import replacing
from camtorch.jobs.items import Item, Listener

Json = dict[str, Any]
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
    like: str | None
    """Whose lens new cameras have."""
    image_size: tuple[int, int] | None
    min_filled: float | None
    ranges: dict[str, Any]
    seed: int
    copies: int
    _samples: dict[str, MapSamples] = field(default_factory=dict)

    def settings(self) -> Json:
        """All that outputs depend on beside images and labels; JSON."""
        names = ("rescale", "like", "image_size", "min_filled", "ranges", "seed", "copies")
        camera = None if self.camera is None else _parts_of(self.camera)
        return {"camera": camera, **{name: getattr(self, name) for name in names}}

    def __call__(self, item: Item, listener: Listener) -> Json:
        """Entries of the new images and their annotations, where labels are no files."""
        assert isinstance(item, Labelled)
        image, orientation = images.read(item.inputs[0], tell=listener.note)
        entry, annotations = json.loads(item.labels) if item.labels else (_read(item.inputs[1]), [])
        size = rows, columns = image.shape[-2], image.shape[-1]
        if item.labels and (entry.get("height", rows), entry.get("width", columns)) != size:
            stated = f"{entry.get('width')}x{entry.get('height')}"
            raise ValueError(f"it is {columns}x{rows}, and its labels are for {stated}")
        if orientation not in (None, 1):
            listener.note(f"{item.name} is taken as stored, not turned by its Exif orientation, and so are its labels")
        camera = self._camera(item.inputs[0], size, entry.get("camera"))
        samples = self._samples_of(camera)
        labels = coco.labels_of(annotations, size, listener.note) if item.labels else dict(entry)
        if _EYE in labels:  # a pixel, though its name begins with that of a direction
            labels[_EYES] = [labels.pop(_EYE)]
        array = image.permute(1, 2, 0).numpy() if len(image) > 1 else image[0].numpy()
        result: Json = {"images": [], "annotations": []}
        for copy in range(self.copies):
            key = item.place, copy

            def move(labels: Json, key: object = key, **others: Any) -> Json:
                moved: Json = samples({"key": key, "json": {**labels, "camera": camera}, **others})
                return moved["json"] if not others else moved

            moved = move(coco.packed(labels) if item.labels else labels, png=array)
            new, pixels = moved["json"], torch.from_numpy(moved["png"])
            made = images.from_tensor(pixels.permute(2, 0, 1) if pixels.ndim == 3 else pixels[None])
            images.write(item.outputs[copy], made, orientation=orientation, tell=listener.note, synced=False)
            if item.labels:
                result["images"].append({name: new[name] for name in ("camera", "rotation")})
                result["annotations"].append(coco.moved(annotations, labels, new, move, size))
            else:
                if _EYES in new:
                    (new[_EYE],), (new[f"{_EYE}_valid"],) = new.pop(_EYES), new.pop(f"{_EYES}_valid")
                _write(item.outputs[self.copies + copy], new)
        return result

    def _camera(self, path: Path, size: tuple[int, int], stated: Any) -> Camera:
        if stated is None:
            if self.camera is None or self.path is None:
                raise ValueError("which camera took it? Neither its labels nor --camera FILE say so")
            return cameras.fitting(self.camera, self.path, path, size, self.rescale)
        if self.camera is not None:
            raise ValueError(f"its labels state its camera, and so does --camera {self.path}; leave that out")
        return cameras.stated(stated, size)

    def _samples_of(self, camera: Camera) -> MapSamples:
        """For images of a camera, which mostly is that of the image before."""
        known = json.dumps(_parts_of(camera))
        if known not in self._samples:
            size = self.image_size
            shrinks = size is not None and (size[0] < camera.height or size[1] < camera.width)
            augmentation = RandomCamera(
                self.like,
                camera=camera.requires_grad_(False),
                image_size=size,
                antialias=shrinks,
                min_filled=self.min_filled,
                **self.ranges,
            )
            self._samples = {known: MapSamples(augmentation, key="key", seed=self.seed)}
        return self._samples[known]


def _parts_of(camera: Camera) -> Json:
    columns = to_columns(camera, "")
    return {part: columns[f"_{part}"].tolist() for part in PARTS[1:]} | {"model": camera.key}


def _read(path: Path) -> Json:
    try:
        labels = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: no JSON: {error}") from None
    if not isinstance(labels, dict):
        raise ValueError(f'{path}: must be an object, as {{"keypoints": [[x, y], ...]}}')
    return labels


def _write(path: Path, labels: Json) -> None:
    try:
        text = json.dumps(labels, allow_nan=False)
    except ValueError:
        raise ValueError("its labels hold NaN or infinity, which are no JSON; null is, or leave them out") from None
    with replacing(path, synced=False) as (file,):
        file.write(text.encode() + b"\n")
