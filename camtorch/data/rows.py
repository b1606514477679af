"""Rows and samples of arrays, moved one by one, as called by Ray Data's `map_batches` and WebDataset's `map`."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from camtorch.augment.augmentation import Augmentation
from camtorch.augment.face import FaceNormalizer
from camtorch.augment.fields import IMAGES, KEEP, KINDS
from camtorch.augment.names import kind_of, refuse_unknown
from camtorch.augment.numpy import Transform, shaped_if_empty
from camtorch.augment.part import Part
from camtorch.augment.sample import Sample
from camtorch.cameras.camera import Camera
from camtorch.data.columns import PARTS, camera_of, to_columns
from camtorch.data.seeded import Key, Seeded
from camtorch.values.arguments import as_mapping, is_list, shown
from camtorch.warp.plane import PlaneWarp
from camtorch.warp.warp import Warp

Batch = dict[str, Any]  # column -> an array or a list, all with as many rows
Moves = Augmentation | FaceNormalizer | Warp  # transforms of samples
_ENDINGS = ("jpg", "jpeg", "png", "webp", "ppm", "pgm", "tif", "tiff", "bmp", "npy")


class Always(Augmentation):
    """A single warp that is applied to every sample."""

    def __init__(self, warp: Warp, owner: str, fields: Mapping[str, str] | None = None):
        if isinstance(warp, PlaneWarp):
            raise TypeError(f"{owner}: warp must move labels too; got {type(warp).__name__}. Call it on images alone")
        if warp.batch_shape:
            raise ValueError(f"{owner}: the warp must be a single one; got batch dims {tuple(warp.batch_shape)}")
        warp = warp.detach()
        super().__init__(camera=warp.source, fields=fields, min_filled=0)
        self.warp = warp

    def _part(self, source: Camera, draw: Mapping[str, Tensor]) -> Part:
        return Part(self.warp.source, self.warp)


class Mover:
    """Common part of `MapBatches` and `MapSamples`: moves single samples of arrays by their keys."""

    def __init__(self, transform: Moves, seed: int, epoch: int, fields: Mapping[str, str] | None):
        self._owner = owner = type(self).__name__
        self._fields = dict(as_mapping(fields, "fields", owner, "{'lidar': 'points'}"))
        if isinstance(transform, (Augmentation, FaceNormalizer)):
            own: Augmentation | FaceNormalizer = copy.copy(transform)
            own.fields = self._fields = {**transform.fields, **self._fields}
        elif isinstance(transform, Warp):
            own = Always(transform, owner, self._fields)
        else:
            raise TypeError(f"{owner}: transform must be an augmentation or a Warp; got {type(transform).__name__}")
        self._fixed = Transform(own)  # by this name in pickles of 0.5
        draws = isinstance(transform, Augmentation)
        self._seeded = Seeded(self._fixed, seed=seed, epoch=epoch) if draws else None

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the draws; copies that workers and engines already have are not changed."""
        if self._seeded is not None:
            self._seeded.set_epoch(epoch)

    def _moved(self, key: Key | None, row: Mapping[str, Any]) -> Sample:
        """Return the changed fields of a row of arrays or lists: moved fields, their validity, `rotation`, `camera`."""
        try:
            moving = {name: value for name, value in row.items() if self._moves(name, value)}
            fields = {name: _dense(name, value, self._kind(name, value)) for name, value in moving.items()}
            camera = row.get("camera")
            if camera is not None:
                fields["camera"] = camera if isinstance(camera, Camera) else self._camera(camera, fields)
            if self._seeded is None:
                return self._fixed(fields)
            return self._seeded(fields, key=key)  # type: ignore[arg-type]
        except (ValueError, TypeError) as error:
            which = "" if key is None else f"sample {key!r:.200}: "
            kind = TypeError if isinstance(error, TypeError) else ValueError
            raise kind(f"{self._owner}: {which}{str(error).removeprefix(f'{self._owner}: ')}") from error

    def _moves(self, name: str, value: object) -> bool:
        """Whether a value is a field that moves, or the validity of one; raise if its name does not tell."""
        if name == "camera" or value is None:
            return False
        refuse_unknown({name: value}, self._fields, self._owner, single=False)
        return name.endswith("_valid") or self._kind(name, value) in KINDS

    def _kind(self, name: str, value: object) -> str | None:
        return kind_of(name, value, self._fields, self._owner)

    def _camera(self, parts: Mapping[str, Any], fields: Sample) -> Camera:
        """Return the camera of its numbers, with the size of an image if it has none."""
        if parts.get("image_size") is None:
            images = [value for name, value in fields.items() if self._kind(name, value) in IMAGES]
            sizes = [image.shape[:2] for image in images if np.ndim(image) in (2, 3)]
            parts = {**parts, "image_size": sizes[0] if sizes else None}
        if missing := [part for part in ("model", "intrinsics", "image_size") if parts.get(part) is None]:
            raise ValueError(f"the camera must have {', '.join(missing)}; got none. ct.data.to_columns makes all")
        return camera_of({part: _dense(part, value) for part, value in parts.items()}, self._owner)


def _dense(name: str, value: Any, kind: str | None = None) -> Any:
    """Return lists, or arrays in an array of objects, as an array of numbers, or of bool for validity."""
    if isinstance(value, list):
        try:
            array = np.asarray(value, bool if name.endswith("_valid") else np.float64)
        except (ValueError, TypeError, OverflowError):
            raise ValueError(f"{name} must be numbers in lists of one length; got {value!r:.80}") from None
        return shaped_if_empty(array, kind)
    if isinstance(value, np.ndarray) and value.dtype == object:
        parts = [_dense(name, part) for part in value]
        if parts and all(isinstance(part, np.ndarray) and part.shape == parts[0].shape for part in parts):
            return np.stack(parts)
    return value


class MapBatches(Mover):
    """Augmentation or warp of batches of rows: a function for Ray Data's `map_batches` and similar callers.

        rows = ray.data.read_images("images/", include_paths=True)
        moved = ct.data.MapBatches(augment, key="path", seed=0)
        rows = rows.map_batches(moved, batch_size=32)

    Columns are arrays (B, ...), or arrays of objects if rows differ in shape, with the names of the fields of an
    `Augmentation`, without its batch dim:

    * `image` (B, H, W, C) or (B, H, W), channels last, usually uint8; `mask`, `depth`, `distance` too.
    * `keypoints` (B, N, 2), `boxes` or `bboxes` (B, M, 4) x1 y1 x2 y2, `polygons`, in pixels with the centre of the
      top-left one at (0, 0); `gaze` (B, 3), `head_pose` (B, 4, 4), `rvec`, `tvec`, `points`, and all others.
    * The camera of every row as numbers, `camera_model`, `camera_intrinsics` (B, 4), `camera_distortion` (B, n) and
      `camera_image_size` (B, 2), see `to_columns`; by default the camera of the augmentation, or of the warp.

    Results keep their layout and dtype; coordinates of whole numbers become float32. The result also has
    `keypoints_valid` (B, N) and so on, `rotation` (B, 3, 3) and the columns of the new camera, which `from_columns`
    reads. Other columns are passed on; numbers that might be geometry must be named in `fields`. Every row is computed
    alone and drawn by its key: its result is the same to the bit in any batch, block or worker, and in a loop in one
    process.

    Args:
        transform: an augmentation, or a `Warp` or `Dewarp`.
        key: the column that identifies a row in every run, of whole numbers or strings, or a list of such columns, for
            transforms that draw. Paths should be relative to the data set's folder, which may differ between machines.
        seed, epoch: seed and epoch of the draws.
        fields: column -> kind, for columns of other names; "keep" passes one on unchanged. See `Augmentation`.

    Raises:
        TypeError: If `transform` moves no samples. ValueError: If it draws, and no key is given.
    """

    def __init__(
        self,
        transform: Moves,
        *,
        key: str | Sequence[str] | None = None,
        seed: int = 0,
        epoch: int = 0,
        fields: Mapping[str, str] | None = None,
    ):
        super().__init__(transform, seed, epoch, fields)
        keys = () if key is None else (key,) if isinstance(key, str) else key
        if not is_list(keys) or not all(isinstance(name, str) for name in keys):
            raise TypeError(f"{self._owner}: key must be the name of a column, or several in a list; got {shown(key)}")
        self._keys = list(keys)
        if self._seeded is not None and not self._keys:
            raise ValueError(
                f'{self._owner}: key must name the column that identifies a row, as in key="path" after '
                "read_images(..., include_paths=True), since the draw of a row depends on its key alone; "
                f"got key={key!r}"
            )

    def __call__(self, batch: Mapping[str, Any]) -> Batch:
        """Return a batch, moved row by row.

        Raises:
            ValueError: If columns differ in length, the key is missing, or an augmentation raises. TypeError: If it is
                no dict of columns.
        """
        if not isinstance(batch, Mapping) or not all(hasattr(column, "__len__") for column in batch.values()):
            kind = shown(batch) if isinstance(batch, Mapping) else type(batch).__name__
            raise TypeError(f'{self._owner}: a batch must be a dict of arrays, as of batch_format="numpy"; got {kind}')
        counts = {name: len(column) for name, column in batch.items()}
        if len(set(counts.values())) > 1:
            raise ValueError(f"{self._owner}: all columns must have as many rows; got {counts}")
        if missing := [name for name in self._keys if name not in batch]:
            raise ValueError(f"{self._owner}: a batch must have the column {missing[0]!r}; got {', '.join(batch)}")
        count = max(counts.values(), default=0)
        rows = [self._row({name: column[i] for name, column in batch.items()}) for i in range(count)]
        if not rows:
            return dict(batch)
        names = list(dict.fromkeys(name for row in rows for name in row))
        result = {**batch, **{name: _column([row.get(name) for row in rows]) for name in names}}
        for name, column in batch.items():  # columns have one type in all blocks
            if name in names and _is_objects(column) and not _is_objects(result[name]):
                result[name] = np.fromiter(result[name], object)
        return result

    def _row(self, row: dict[str, Any]) -> Sample:
        values = [row.pop(name) for name in self._keys]
        values = [value.item() if isinstance(value, np.generic) else value for value in values]
        key: Key | None = tuple(values) if values else None
        if len(values) == 1:
            key = values[0]
        row["camera"] = {part: row.pop(f"camera_{part}") for part in PARTS if f"camera_{part}" in row} or None
        moved = dict(self._moved(key, row))
        camera = moved.pop("camera", None)
        return moved if camera is None else {**moved, **to_columns(camera)}


def _is_objects(column: Any) -> bool:
    return isinstance(column, np.ndarray) and column.dtype == object


def _column(values: list[Any]) -> np.ndarray[Any, Any]:
    """Return rows as one array, of objects if their shapes or types differ."""
    if len({(getattr(v, "shape", None), getattr(v, "dtype", type(v))) for v in values}) == 1 and values[0] is not None:
        return np.stack(values) if isinstance(values[0], np.ndarray) else np.asarray(values)
    return np.fromiter(values, object)


class MapSamples(Mover):
    """Augmentation or warp of single samples of a WebDataset pipeline: a function for its `.map`.

        samples = wds.WebDataset("train-{00..15}.tar").decode("rgb8")
        samples = samples.map(ct.data.MapSamples(augment, seed=0))

    A sample is a dict of decoded entries:

    * `jpg`, `png`, `webp` and so on: the image, a uint8 array (H, W, C) or (H, W). `mask.png`, `depth.npy` move by
      their names.
    * `json`: an object of labels, named as the fields of an `Augmentation`, of numbers in lists or arrays:
      `keypoints` [[x, y], ...], `boxes` [[x1, y1, x2, y2], ...], `gaze` [x, y, z], `head_pose` and so on; and `camera`,
      an object of `model`, `intrinsics`, `distortion` and `image_size`, if the transform has none.

    Lists stay lists, arrays stay arrays, in the same places. `keypoints_valid` and so on, `rotation` and the new
    `camera` join the labels, so that a `ShardWriter` can write the result. Other entries are passed on. A sample is
    drawn by its key: its result is the same to the bit from any shard, node or worker.

    Args:
        transform: an augmentation, or a `Warp` or `Dewarp`.
        key: the entry that identifies a sample in every run. If several shards hold the same keys, make them different.
        labels: the entry of labels.
        seed, epoch: seed and epoch of the draws.
        fields: name -> kind, for entries and labels of other names; "keep" passes one on unchanged.

    Raises:
        TypeError: If `transform` moves no samples.
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
                raise TypeError(f"{self._owner}: {name} must name an entry of a sample; got {shown(value)}")
        self._key, self._labels = key, labels

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Return a sample, moved.

        Raises:
            ValueError: If key or decoding is missing, or the augmentation raises one. TypeError: If it is no dict.
        """
        owner = self._owner
        if not isinstance(sample, Mapping):
            kind = type(sample).__name__
            raise TypeError(f"{owner}: a sample must be a dict of entries, before .to_tuple; got {kind}")
        if self._seeded is not None and self._key not in sample:
            raise ValueError(f"{owner}: a sample must have {self._key!r}; got {', '.join(map(str, sample))}")
        labels = sample.get(self._labels, {})
        if not isinstance(labels, Mapping):
            raise TypeError(
                f"{owner}: {self._labels} must be an object of labels; got {type(labels).__name__}"
                + (". Add .decode() before .map" if isinstance(labels, bytes) else "")
            )
        entry_of: dict[str, str] = {}
        for entry, value in sample.items():
            field = self._field(entry, value)
            if field is not None:
                if field in entry_of or field in labels:
                    raise ValueError(f"{owner}: {entry} and {entry_of.get(field, self._labels)} both hold {field}")
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
        """Return the field that an entry holds, or None if it is passed on."""
        owner = self._owner
        if entry in self._fields:
            return entry
        if entry.startswith("__") or entry in (self._key, self._labels):
            return None
        stem, _, ending = entry.rpartition(".")
        has_ending = ending in _ENDINGS
        name = stem if has_ending else entry
        if has_ending and not stem and ending != "npy":
            name = "image"
        if has_ending and isinstance(value, (bytes, bytearray)):
            raise ValueError(f'{owner}: {entry} must be decoded; got bytes. Add .decode("rgb8") before .map')
        if self._moves(name or entry, value):
            if not isinstance(value, np.ndarray):
                raise TypeError(f"{owner}: {entry} must be a numpy array; got {type(value).__name__}")
            return name
        if has_ending and np.ndim(value) >= 2 and name not in self._fields:
            raise ValueError(
                f"{owner}: {entry} must have a kind; got none. Pass fields={{{entry!r}: KIND}}, with KIND one of "
                f"{', '.join(IMAGES)} or {KEEP}, among others"
            )
        return None


def _plain(value: Any) -> Any:
    """Return a value in Python's own types, as JSON needs them."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
