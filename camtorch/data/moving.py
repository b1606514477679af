"""One sample of arrays after another, each with its labels and its camera, by whatever moves them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch._arguments import as_mapping
from camtorch._module import Memo
from camtorch.augment.augmentation import Augmentation
from camtorch.augment.change import Part
from camtorch.augment.face import FaceNormalizer
from camtorch.augment.numpy import Transform
from camtorch.augment.sample import IMAGES, Sample, kind_of
from camtorch.camera import Camera
from camtorch.data.columns import camera_of
from camtorch.data.seeded import Key, Seeded
from camtorch.warp.proxy import ProxyWarp
from camtorch.warp.shutter import Shutters
from camtorch.warp.warp import Warp

Moves = Augmentation | FaceNormalizer | Warp | Callable[[Camera], Warp]
"""What moves samples: an augmentation, a warp, or what makes the warp of a sample's camera, such as `ct.Dewarp`."""
_MOST_WARPS = 16  # whose maps are kept


class Always(Augmentation):
    """One warp, for every sample: the same map each time."""

    warp: Warp

    def __init__(self, warp: Warp, owner: str, fields: Mapping[str, str] | None = None):
        if isinstance(warp, ProxyWarp):
            raise TypeError(f"{owner}: {type(warp).__name__} moves images alone; call it on them, without their labels")
        if warp.batch_shape:
            raise ValueError(f"{owner}: the warp must be a single one; got batch dims {tuple(warp.batch_shape)}")
        source, target = warp.source.detach(), warp.target.detach()
        super().__init__(camera=source, fields=fields, min_filled=0)
        rotation = None if warp.rotation is None else warp.rotation.detach()
        first, last = warp.shutter, warp.target_shutter
        shutters: Shutters = {"shutter": first and first.detached(), "target_shutter": last and last.detached()}
        self.warp = Warp(source, target, rotation, **warp.options, **shutters)

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
        self._make: Callable[[Camera], Warp] | None = None
        self._made = Memo(_MOST_WARPS)
        if isinstance(transform, (Augmentation, FaceNormalizer)):
            transform = copy.copy(transform)
            transform.fields = self._fields = {**transform.fields, **self._fields}
            if isinstance(transform, FaceNormalizer):
                self._fixed = Transform(transform)
            else:
                self._seeded = Seeded(Transform(transform), seed=seed, epoch=epoch)
        elif isinstance(transform, Warp):
            self._fixed = Transform(Always(transform, owner, self._fields))
        elif callable(transform) and not isinstance(transform, torch.nn.Module):
            self._make = transform
        else:
            raise TypeError(
                f"{owner}: transform must be an augmentation, a Warp, or what makes a Warp of a camera, as ct.Dewarp "
                f"does; got {type(transform).__name__}"
            )

    def set_epoch(self, epoch: int) -> None:
        """Draw for this epoch from now on; workers and engines that were given a copy before do not hear of it."""
        if self._seeded is not None:
            self._seeded.set_epoch(epoch)

    def _kind(self, name: str, value: object) -> str | None:
        """The kind of a field that moves, else None."""
        return kind_of(name, value, self._fields, self._owner)

    def _camera(self, parts: Mapping[str, Any], sample: Sample) -> Camera:
        """The camera of a sample: its numbers, and the size of an image where they do not say it."""
        if parts.get("image_size") is None:
            sizes = (v.shape[:2] for n, v in sample.items() if self._kind(n, v) in IMAGES and np.ndim(v) in (2, 3))
            parts = {**parts, "image_size": next(sizes, None)}
        missing = [part for part in ("model", "intrinsics", "image_size") if parts.get(part) is None]
        if missing:
            has_none = ", ".join(missing)
            raise ValueError(f"{self._owner}: the camera has no {has_none}; ct.data.to_columns tells all of it")
        return camera_of(parts, self._owner)

    @contextmanager
    def _naming(self, key: object) -> Iterator[None]:
        """Errors inside of it name the sample."""
        try:
            yield
        except (ValueError, TypeError) as error:
            which = "" if key is None else f"sample {key!r:.200}: "
            kind = TypeError if isinstance(error, TypeError) else ValueError
            raise kind(f"{self._owner}: {which}{str(error).removeprefix(f'{self._owner}: ')}") from error

    def _move(self, key: Key | None, sample: Sample) -> Sample:
        """The sample moved, with the validity of its labels, `rotation`, and `camera`, a Camera."""
        if self._seeded is not None:
            return self._seeded(sample, key=key)  # type: ignore[arg-type]
        if self._fixed is not None:
            return self._fixed(sample)
        camera, make = sample.get("camera"), self._make
        if not isinstance(camera, Camera) or make is None:
            there = ", ".join(sample) or "nothing"
            raise ValueError(f"no camera in the sample, of which a warp is made; it has {there}")

        def made() -> Transform:
            warp = make(camera)
            if not isinstance(warp, Warp):
                raise TypeError(f"what makes the warp of a camera must return a Warp; got {type(warp).__name__}")
            return Transform(Always(warp, self._owner, self._fields))

        found: Transform = self._made((camera.intrinsics, camera.distortion), (camera.key, camera.image_size), made)
        return found(sample)
