"""Batches of rows, dicts of numpy arrays: what Ray Data's `map_batches` calls with, and others likewise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from camtorch._arguments import is_list, shown
from camtorch.augment.sample import Sample
from camtorch.data.columns import PARTS, to_columns
from camtorch.data.moving import Mover, Moves
from camtorch.data.seeded import Key

Array: TypeAlias = "np.ndarray[Any, Any]"
Batch = dict[str, Any]
"""Column -> an array or a list, of as many rows as all others."""
_OWNER = "MapBatches"


class MapBatches(Mover):
    """Augments, or warps, batches of rows: the function of Ray Data's `map_batches`, and of whatever calls like it.

        rows = ray.data.read_images("images/", include_paths=True)
        rows = rows.map_batches(ct.data.MapBatches(augment, key="path", seed=0), batch_size=32)

    Columns are arrays (B, ...), or arrays of objects where rows differ in shape, and named as the fields of an
    `Augmentation`, without its batch dim:

    * `image` (B, H, W, C) or (B, H, W), channels last, usually uint8; `mask`, `depth`, `distance` likewise.
    * `keypoints` (B, N, 2), `boxes` or `bboxes` (B, M, 4) x1 y1 x2 y2, `polygons`, in pixels with the centre of the
      top-left one at (0, 0); `gaze` (B, 3), `head_pose` (B, 4, 4), `rvec`, `tvec`, `points`, and all others.
    * The camera of every row as numbers, `camera_model`, `camera_intrinsics` (B, 4), `camera_distortion` (B, n) and
      `camera_image_size` (B, 2), see `to_columns`; without them that of the augmentation, or of the warp.

    They come out with their layout and dtype, coordinates of whole numbers in float32, beside `keypoints_valid` (B, N)
    and so on, `rotation` (B, 3, 3) and the columns of the new camera, of which `from_columns` makes a batch of cameras.
    All other columns are passed on; numbers that might be geometry have to be named in `fields`.

    Every row is computed by itself, and drawn by its key: so it comes out the same to the bit, in whatever batch, block
    or worker, and in a loop in one process.

    Args:
        transform: an augmentation, or a `Warp` or `Dewarp`.
        key: the column that names a row for ever, of whole numbers or strings, or a list of such columns. Only what
            draws needs it. Paths should begin at the folder of the data set where they differ between machines.
        seed, epoch: of what is drawn.
        fields: column -> kind, for columns of other names; "keep" passes one on as it is. See `Augmentation`.

    Raises:
        TypeError: nothing that moves samples. ValueError: no key for what draws.
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
        self._keys = [key] if isinstance(key, str) else list(key) if is_list(key) else []
        if not (key is None or isinstance(key, str) or is_list(key)) or not all(isinstance(k, str) for k in self._keys):
            raise TypeError(f"{_OWNER}: key must be the name of a column, or several in a list; got {shown(key)}")
        if self._seeded is not None and not self._keys:
            raise ValueError(
                f'{_OWNER}: key must name the column whose value names a row, as in key="path" after '
                "read_images(..., include_paths=True): what a row draws follows from it, and not from its place; "
                f"got key={key!r}"
            )

    def __call__(self, batch: Mapping[str, Any]) -> Batch:
        """A batch, moved row by row.

        Raises:
            ValueError: columns of several lengths, no column of the key, and what the augmentation raises. TypeError:
                no dict of columns.
        """
        if not isinstance(batch, Mapping) or not all(hasattr(column, "__len__") for column in batch.values()):
            kind = shown(batch) if isinstance(batch, Mapping) else type(batch).__name__
            raise TypeError(f'{_OWNER}: a batch must be a dict of arrays, as of batch_format="numpy"; got {kind}')
        counts = {name: len(column) for name, column in batch.items()}
        if len(set(counts.values())) > 1:
            raise ValueError(f"{_OWNER}: all columns must have as many rows; got {counts}")
        missing = [name for name in self._keys if name not in batch]
        if missing:
            raise ValueError(f"{_OWNER}: no column {missing[0]!r} to name the rows; there are {', '.join(batch)}")
        count = max(counts.values(), default=0)
        rows = [self._row({name: column[i] for name, column in batch.items()}) for i in range(count)]
        if not rows:
            return dict(batch)
        names = list(dict.fromkeys(name for row in rows for name in row))
        result = {**batch, **{name: _column([row.get(name) for row in rows]) for name in names}}
        for name, column in batch.items():  # of one type in all blocks
            if name in names and _is_objects(column) and not _is_objects(result[name]):
                result[name] = _objects(list(result[name]))
        return result

    def _row(self, row: dict[str, Any]) -> Sample:
        """What has changed in a row."""
        values = [row.pop(name) for name in self._keys]
        values = [value.item() if isinstance(value, np.generic) else value for value in values]
        key: Key | None = tuple(values) if len(values) > 1 else values[0] if values else None
        row["camera"] = {part: row.pop(f"camera_{part}") for part in PARTS if f"camera_{part}" in row} or None
        moved = dict(self._moved(key, row))
        camera = moved.pop("camera", None)
        return moved if camera is None else {**moved, **to_columns(camera)}


def _is_objects(column: Any) -> bool:
    return isinstance(column, np.ndarray) and column.dtype == object


def _column(values: list[Any]) -> Array:
    """Rows as one array, of objects where their shapes or types differ."""
    if len({(getattr(v, "shape", None), getattr(v, "dtype", type(v))) for v in values}) == 1 and values[0] is not None:
        return np.stack(values) if isinstance(values[0], np.ndarray) else np.asarray(values)
    return _objects(values)


def _objects(values: list[Any]) -> Array:
    column = np.empty(len(values), object)
    for i, value in enumerate(values):
        column[i] = value
    return column
