"""What `camtorch augment --dataset` does to each image of a data set with its labels, in whatever process."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from camtorch.augment import RandomCamera
from camtorch.camera import Camera
from camtorch.cli import cameras, coco, images
from camtorch.data.samples import MapSamples
from camtorch.data.seeded import generator
from camtorch.io.writing import replacing
from camtorch.jobs.items import Item, Listener

Json = dict[str, Any]
_EYE, _EYES = "gaze_from", "keypoints_gaze_from"
_MOST_SIZES = 4


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
    _augmentations: dict[str, tuple[RandomCamera, MapSamples]] = field(default_factory=dict)

    def settings(self) -> Json:
        """All that outputs depend on beside images and labels; JSON."""
        names = ("rescale", "like", "image_size", "min_filled", "ranges", "seed", "copies")
        return {
            "camera": None if self.camera is None else coco.parts_of(self.camera),
            **{name: getattr(self, name) for name in names},
        }

    def __call__(self, item: Item, listener: Listener) -> Json:
        """Entries of the new images and their annotations, where labels are no files; what was lost."""
        assert isinstance(item, Labelled)
        image, orientation = images.read(item.inputs[0], tell=listener.note)
        entry, annotations = json.loads(item.labels) if item.labels else (_read(item.inputs[1]), [])
        rows, columns = image.shape[-2:]
        if item.labels and (entry.get("height", rows), entry.get("width", columns)) != (rows, columns):
            stated = f"{entry.get('width')}x{entry.get('height')}"
            raise ValueError(f"it is {columns}x{rows}, and its labels are for {stated}")
        if orientation not in (None, 1):
            listener.note(f"{item.name} is taken as stored, not turned by its Exif orientation, and so are its labels")
        camera = self._camera(item.inputs[0], (rows, columns), entry.get("camera"))
        augmentation, move = self._augmentation(camera)
        result: Json = {"images": [], "annotations": []}
        for copy in range(self.copies):
            key = item.place, copy
            target = item.outputs[copy]
            if item.labels:
                new, entries = self._annotated(image, camera, augmentation, key, annotations, listener)
                result["images"].append(entries[0])
                result["annotations"].append(entries[1])
            else:
                new, labels = _labelled(image, camera, move, key, entry)
            made = images.from_tensor(new)
            images.write(target, made, orientation=orientation, tell=listener.note, synced=False)
            if not item.labels:
                _write(item.outputs[self.copies + copy], labels)
        return result

    def _camera(self, path: Path, size: tuple[int, int], stated: Any) -> Camera:
        if stated is None:
            if self.camera is None or self.path is None:
                raise ValueError("which camera took it? Neither its labels nor --camera FILE say so")
            return cameras.fitting(self.camera, self.path, path, size, self.rescale)
        if self.camera is not None:
            raise ValueError(f"its labels state its camera, and so does --camera {self.path}; leave that out")
        return cameras.stated(stated, size)

    def _augmentation(self, camera: Camera) -> tuple[RandomCamera, MapSamples]:
        """For images of a camera, which mostly is the same one, and for such with labels."""
        known = json.dumps(coco.parts_of(camera))
        if known not in self._augmentations:
            while len(self._augmentations) >= _MOST_SIZES:
                del self._augmentations[next(iter(self._augmentations))]
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
            self._augmentations[known] = augmentation, MapSamples(augmentation, key="key", seed=self.seed)
        return self._augmentations[known]

    @torch.no_grad()
    def _annotated(
        self,
        image: Tensor,
        camera: Camera,
        augmentation: RandomCamera,
        key: tuple[str, int],
        annotations: list[Json],
        listener: Listener,
    ) -> tuple[Tensor, tuple[Json, list[Json | None]]]:
        augmentation.tell_of_empty_images(camera)
        change = augmentation.change(camera, augmentation.draw(1, generator(key, seed=self.seed)))
        entry = {"camera": coco.parts_of(change.target[0]), "rotation": change.rotation[0].tolist()}
        new = change.images(image[None])[0]
        return new, (entry, coco.moved(annotations, change, listener.note))


def _labelled(
    image: Tensor, camera: Camera, move: MapSamples, key: tuple[str, int], labels: Json
) -> tuple[Tensor, Json]:
    labels = {**labels, "camera": camera}
    if _EYE in labels:
        labels[_EYES] = [labels.pop(_EYE)]
    array = image.permute(1, 2, 0).numpy() if len(image) > 1 else image[0].numpy()
    moved = move({"key": key, "png": array, "json": labels})
    labels, array = moved["json"], moved["png"]
    if _EYES in labels:
        (labels[_EYE],), (labels[f"{_EYE}_valid"],) = labels.pop(_EYES), labels.pop(f"{_EYES}_valid")
    new = torch.from_numpy(array)
    return new.permute(2, 0, 1) if new.ndim == 3 else new[None], labels


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
