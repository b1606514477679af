"""Samples as WebDataset decodes them: an image by its file name's ending, labels of JSON, and the key."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from camtorch._arguments import shown
from camtorch.augment.sample import IMAGES, KEEP
from camtorch.camera import Camera
from camtorch.data.columns import PARTS, to_columns
from camtorch.data.moving import Mover, Moves

_OWNER = "MapSamples"
_ENDINGS = ("jpg", "jpeg", "png", "webp", "ppm", "pgm", "tif", "tiff", "bmp", "npy")


class MapSamples(Mover):
    """Augments, or warps, samples of a WebDataset pipeline, one by one: the function of its `.map`.

        samples = wds.WebDataset("train-{00..15}.tar").decode("rgb8")
        samples = samples.map(ct.data.MapSamples(augment, seed=0))

    A sample is a dict of decoded entries:

    * `jpg`, `png`, `webp` and so on: the image, a uint8 array (H, W, C) or (H, W). `mask.png`, `depth.npy`: what the
      name says, moved as such.
    * `json`: an object of labels, named as the fields of an `Augmentation`, of numbers in lists or arrays:
      `keypoints` [[x, y], ...], `boxes` [[x1, y1, x2, y2], ...], `gaze` [x, y, z], `head_pose` and so on; and `camera`,
      an object of `model`, `intrinsics`, `distortion` and `image_size`, if the transform has none.

    Lists come out as lists, arrays as arrays, in the same places. `keypoints_valid` and so on, `rotation` and the new
    `camera` join the labels, so that a `ShardWriter` can write what comes out. Everything else is passed on.

    A sample is drawn by its key: it comes out the same to the bit from whatever shard, node or worker.

    Args:
        transform: an augmentation, or a `Warp` or `Dewarp`.
        key: the entry that names a sample for ever. Where several shards hold the same keys, something that tells
            them apart has to be put in.
        labels: the entry of labels.
        seed, epoch: of what is drawn.
        fields: name -> kind, for entries and labels of other names; "keep" passes one on as it is.

    Raises:
        TypeError: nothing that moves samples.
    """

    def __init__(
        self,
        transform: Moves,
        *,
        key: str = "__key__",
        labels: str = "json",
        seed: int = 0,
        epoch: int = 0,
        fields: Mapping[str, str] | None = None,
    ):
        super().__init__(transform, seed, epoch, fields)
        for name, value in (("key", key), ("labels", labels)):
            if not isinstance(value, str):
                raise TypeError(f"{_OWNER}: {name} must name an entry of a sample; got {shown(value)}")
        self._key, self._labels = key, labels

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """A sample, moved.

        Raises:
            ValueError: no key, images that are not decoded, and what the augmentation raises. TypeError: no dict.
        """
        if not isinstance(sample, Mapping):
            raise TypeError(
                f"{_OWNER}: a sample must be a dict of entries, before .to_tuple; got {type(sample).__name__}"
            )
        if self._seeded is not None and self._key not in sample:
            raise ValueError(f"{_OWNER}: no {self._key!r} to name the sample; it has {', '.join(map(str, sample))}")
        labels = sample.get(self._labels, {})
        if not isinstance(labels, Mapping):
            raise TypeError(
                f"{_OWNER}: {self._labels} must be an object of labels; got {type(labels).__name__}"
                + (". Undecoded ones are decoded by .decode()" if isinstance(labels, bytes) else "")
            )
        entry_of: dict[str, str] = {}
        for entry, value in sample.items():
            if (field := self._field(entry, value)) is not None:
                if field in entry_of or field in labels:
                    raise ValueError(f"{_OWNER}: {entry} and {entry_of.get(field, self._labels)} both hold {field}")
                entry_of[field] = entry
        moved = self._moved(sample.get(self._key), {**labels, **{f: sample[entry] for f, entry in entry_of.items()}})
        result, told = dict(sample), dict(labels)
        for name, value in moved.items():
            if name in entry_of:
                result[entry_of[name]] = value
            elif name == "image_valid":
                result[f"{name}.npy"] = value
            elif isinstance(value, Camera):
                told[name] = dict(zip(PARTS, map(_plain, to_columns(value).values()), strict=True))
            else:
                told[name] = value if isinstance(labels.get(name), np.ndarray) else _plain(value)
        result[self._labels] = told
        return result

    def _field(self, entry: str, value: Any) -> str | None:
        """The field that an entry holds, or None if it is passed on."""
        stem, _, ending = entry.rpartition(".")
        if entry in self._fields or entry.startswith("__") or entry in (self._key, self._labels):
            return entry if entry in self._fields else None
        name = stem if ending in _ENDINGS else entry
        if not stem and ending in _ENDINGS and ending != "npy":
            name = "image"
        if ending in _ENDINGS and isinstance(value, (bytes, bytearray)):
            raise ValueError(f'{_OWNER}: {entry} is not decoded; .decode("rgb8") before .map makes arrays of images')
        if self._moves(name or entry, value):
            if not isinstance(value, np.ndarray):
                raise TypeError(f"{_OWNER}: {entry} must be a numpy array; got {type(value).__name__}")
            return name
        if ending in _ENDINGS and np.ndim(value) >= 2 and name not in self._fields:
            raise ValueError(
                f"{_OWNER}: whether {entry} moves is not known; fields={{{entry!r}: KIND}} says so, where KIND is "
                f"{', '.join(IMAGES)} or {KEEP}, among others"
            )
        return None


def _plain(value: Any) -> Any:
    """Of Python's own types, as JSON takes them."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
