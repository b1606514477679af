"""One sample of arrays after another, each with its labels and its camera, by whatever moves them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from camtorch._arguments import as_mapping
from camtorch._module import Memo
from camtorch.augment.augmentation import Augmentation
from camtorch.augment.change import Part
from camtorch.augment.face import FaceNormalizer
from camtorch.augment.numpy import Transform
from camtorch.augment.sample import Sample, kind_of
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
    """Moves single samples of arrays by their keys; see `MapBatches`.

    Args:
        transform: what moves them.
        owner: who is named by errors.
        seed, epoch: of what is drawn.
        fields: name -> kind, beside those of an augmentation.

    Raises:
        TypeError: nothing that moves samples.
    """

    owner: str
    fields: dict[str, str]

    def __init__(self, transform: Moves, owner: str, seed: int, epoch: int, fields: Mapping[str, str] | None):
        self.owner, self.fields = owner, dict(as_mapping(fields, "fields", owner, "{'lidar': 'points'}"))
        self._seeded: Seeded | None = None
        self._fixed: Transform | None = None
        self._make: Callable[[Camera], Warp] | None = None
        self._made = Memo(_MOST_WARPS)
        if isinstance(transform, (Augmentation, FaceNormalizer)):
            transform = copy.copy(transform)
            transform.fields = self.fields = {**transform.fields, **self.fields}
            if isinstance(transform, FaceNormalizer):
                self._fixed = Transform(transform)
            else:
                self._seeded = Seeded(Transform(transform), seed=seed, epoch=epoch)
        elif isinstance(transform, Warp):
            self._fixed = Transform(Always(transform, owner, self.fields))
        elif callable(transform) and not isinstance(transform, torch.nn.Module):
            self._make = transform
        else:
            raise TypeError(
                f"{owner}: transform must be an augmentation, a Warp, or what makes a Warp of a camera, as ct.Dewarp "
                f"does; got {type(transform).__name__}"
            )

    @property
    def draws(self) -> bool:
        """Whether anything is drawn, so that samples need keys."""
        return self._seeded is not None

    def set_epoch(self, epoch: int) -> None:
        """Draw for this epoch from now on."""
        if self._seeded is not None:
            self._seeded.set_epoch(epoch)

    def kind(self, name: str, value: object) -> str | None:
        """The kind of a field that moves, else None."""
        return kind_of(name, value, self.fields, self.owner)

    def camera(self, parts: Mapping[str, Any], size: tuple[int, int] | None) -> Camera:
        """The camera of a sample: its numbers, and the size of its image where they do not say it."""
        missing = [part for part in ("model", "intrinsics") if parts.get(part) is None]
        if parts.get("image_size") is None:
            if size is None:
                missing.append("image_size")
            parts = {**parts, "image_size": size}
        if missing:
            raise ValueError(
                f"{self.owner}: the camera has no {', '.join(missing)}; ct.data.to_columns tells all of it"
            )
        return camera_of(parts, self.owner)

    @contextmanager
    def naming(self, key: object) -> Iterator[None]:
        """Errors inside of it name the sample."""
        try:
            yield
        except (ValueError, TypeError) as error:
            which = "" if key is None else f"sample {key!r:.200}: "
            kind = TypeError if isinstance(error, TypeError) else ValueError
            raise kind(f"{self.owner}: {which}{str(error).removeprefix(f'{self.owner}: ')}") from error

    def __call__(self, key: Key | None, sample: Sample) -> Sample:
        """The sample moved, with the validity of its labels, `rotation`, and `camera`, a Camera."""
        if self._seeded is not None:
            return self._seeded(sample, key=key)  # type: ignore[arg-type]
        return (self._fixed or self._of_camera(sample))(sample)

    def _of_camera(self, sample: Sample) -> Transform:
        camera = sample.get("camera")
        if not isinstance(camera, Camera) or self._make is None:
            raise ValueError(
                f"no camera in the sample, of which a warp is made; it has {', '.join(sample) or 'nothing'}"
            )
        make = self._make

        def made() -> Transform:
            warp = make(camera)
            if not isinstance(warp, Warp):
                raise TypeError(f"what makes the warp of a camera must return a Warp; got {type(warp).__name__}")
            return Transform(Always(warp, self.owner, self.fields))

        found: Transform = self._made((camera.intrinsics, camera.distortion), (camera.key, camera.image_size), made)
        return found
