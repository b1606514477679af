"""One sample of arrays after another, each with its labels and its camera, by whatever moves them."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from camtorch._arguments import as_mapping
from camtorch.augment.augmentation import Augmentation
from camtorch.augment.change import Part
from camtorch.augment.face import FaceNormalizer
from camtorch.augment.numpy import Transform
from camtorch.augment.sample import IMAGES, KINDS, Sample, kind_of
from camtorch.camera import Camera
from camtorch.data.columns import camera_of
from camtorch.data.seeded import Key, Seeded
from camtorch.warp.proxy import ProxyWarp
from camtorch.warp.warp import Warp

Moves = Augmentation | FaceNormalizer | Warp
"""What moves samples."""


class Always(Augmentation):
    """One warp, for every sample: the same map each time."""

    warp: Warp

    def __init__(self, warp: Warp, owner: str, fields: Mapping[str, str] | None = None):
        if isinstance(warp, ProxyWarp):
            raise TypeError(f"{owner}: {type(warp).__name__} moves images alone; call it on them, without their labels")
        if warp.batch_shape:
            raise ValueError(f"{owner}: the warp must be a single one; got batch dims {tuple(warp.batch_shape)}")
        warp = warp.detach()
        super().__init__(camera=warp.source, fields=fields, min_filled=0)
        self.warp = warp

    def _part(self, rows: list[int] | None, source: Camera, draw: Mapping[str, Tensor]) -> Part:
        return Part(rows, self.warp, self.warp.source)


class Mover:
    """Moves single samples of arrays by their keys; the common part of `MapBatches` and `MapSamples`.

    Args:
        transform: what moves them.
        seed, epoch: of what is drawn.
        fields: name -> kind, beside those of an augmentation.
    """

    def __init__(self, transform: Moves, seed: int, epoch: int, fields: Mapping[str, str] | None):
        self._owner = owner = type(self).__name__
        self._fields = dict(as_mapping(fields, "fields", owner, "{'lidar': 'points'}"))
        self._seeded: Seeded | None = None
        self._fixed: Transform | None = None
        if isinstance(transform, (Augmentation, FaceNormalizer)):
            transform = copy.copy(transform)
            transform.fields = self._fields = {**transform.fields, **self._fields}
            if isinstance(transform, FaceNormalizer):
                self._fixed = Transform(transform)
            else:
                self._seeded = Seeded(Transform(transform), seed=seed, epoch=epoch)
        elif isinstance(transform, Warp):
            self._fixed = Transform(Always(transform, owner, self._fields))
        else:
            raise TypeError(f"{owner}: transform must be an augmentation or a Warp; got {type(transform).__name__}")

    def set_epoch(self, epoch: int) -> None:
        """Draw for this epoch from now on; workers and engines that were given a copy before do not hear of it."""
        if self._seeded is not None:
            self._seeded.set_epoch(epoch)

    def _moved(self, key: Key | None, row: Mapping[str, Any]) -> Sample:
        """What changes of a row: fields that move, what is valid of them, `rotation`, and `camera`, a Camera.

        A row has arrays, or lists of numbers; `camera` is one, or an object of its numbers.
        """
        try:
            moving = {name: value for name, value in row.items() if self._moves(name, value)}
            fields = {name: _dense(name, value, self._fields.get(name, name)) for name, value in moving.items()}
            camera = row.get("camera")
            if camera is not None:
                fields["camera"] = camera if isinstance(camera, Camera) else self._camera(camera, fields)
            if self._fixed is not None:
                return self._fixed(fields)
            assert self._seeded is not None
            return self._seeded(fields, key=key)  # type: ignore[arg-type]
        except (ValueError, TypeError) as error:
            which = "" if key is None else f"sample {key!r:.200}: "
            kind = TypeError if isinstance(error, TypeError) else ValueError
            raise kind(f"{self._owner}: {which}{str(error).removeprefix(f'{self._owner}: ')}") from error

    def _moves(self, name: str, value: object) -> bool:
        """Whether a value is a field that moves, or says what is valid of one."""
        if name == "camera" or value is None:
            return False
        return name.endswith("_valid") or kind_of(name, value, self._fields, self._owner) is not None

    def _camera(self, parts: Mapping[str, Any], fields: Sample) -> Camera:
        """The camera of its numbers, and the size of an image where they do not say it."""
        if parts.get("image_size") is None:
            images = (v for n, v in fields.items() if kind_of(n, v, self._fields, self._owner) in IMAGES)
            parts = {**parts, "image_size": next((v.shape[:2] for v in images if np.ndim(v) in (2, 3)), None)}
        if missing := [part for part in ("model", "intrinsics", "image_size") if parts.get(part) is None]:
            raise ValueError(f"the camera has no {', '.join(missing)}; ct.data.to_columns tells all of it")
        return camera_of({part: _dense(part, value) for part, value in parts.items()}, self._owner)


def _dense(name: str, value: Any, kind: str = "") -> Any:
    """An array of numbers, or of bool for validity, where it came as lists, or as arrays in an array of objects."""
    if isinstance(value, list):
        try:
            array = np.asarray(value, bool if name.endswith("_valid") else np.float64)
        except (ValueError, TypeError, OverflowError):
            raise ValueError(f"{name} must be numbers in lists of one length; got {value!r:.80}") from None
        if array.size or kind not in KINDS:
            return array
        return array.reshape(*[0] * (KINDS[kind].dims - 1), *KINDS[kind].last)
    if isinstance(value, np.ndarray) and value.dtype == object:
        parts = [_dense(name, part) for part in value]
        if parts and all(isinstance(part, np.ndarray) and part.shape == parts[0].shape for part in parts):
            return np.stack(parts)
    return value
