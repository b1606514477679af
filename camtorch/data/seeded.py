"""Draws that depend only on the key of a sample, not on its batch, its worker or earlier samples."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.augmentation import Augmentation
from camtorch.augment.numpy import Transform
from camtorch.augment.sample import Sample
from camtorch.values.arguments import as_whole

Key = int | str | Sequence["int | str"]
"""Name of a sample: its index, its path, or a tuple of several of these."""


def generator(key: Key, *, seed: int = 0, epoch: int = 0) -> torch.Generator:
    """Return a generator for one sample, the same on every machine, for `augmentation(..., generator=...)`.

    Args:
        key: Key of the sample, the same in each epoch; a tuple, as of a path and a number, is one key.
        seed: Seed of the whole run.
        epoch: Epoch, so that a sample is drawn anew in each one.

    Raises:
        TypeError: If the key is neither an integer nor a string nor a tuple of them, or seed or epoch is no
            integer. ValueError: If seed or epoch is negative.
    """
    numbers = _number(seed, "seed"), _number(epoch, "epoch")
    digest = hashlib.blake2b(repr((*numbers, _plain(key))).encode(), digest_size=8).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little"))


def _number(value: int, name: str) -> int:
    whole = as_whole(value, name, "generator")
    if not 0 <= whole < 1 << 63:
        raise ValueError(f"generator: {name} must be 0 or more, and below 2 to the 63rd; got {value}")
    return whole


def _plain(key: object) -> object:
    """Return a key of any library as Python's own types."""
    if isinstance(key, (np.ndarray, Tensor)) and key.ndim == 0:
        key = key.item()
    if isinstance(key, (tuple, list)) and key:
        return tuple(map(_plain, key))
    if isinstance(key, (int, np.integer)) and not isinstance(key, bool):
        return int(key)
    if isinstance(key, str):
        return str(key)
    wanted = "identify a sample on every machine: an integer, a string or a tuple of them"
    raise TypeError(f"generator: key must {wanted}; got {key!r:.60}")


class Seeded:
    """An augmentation whose draw for a sample depends only on the sample's key, a seed and the epoch.

    Processes, ranks, workers, batches, the order of samples and interruptions do not change it, and no generator state
    must be saved. In a dataset, write `augment(image=..., key=index)`; for a batch, pass its keys as a list or a
    tensor, `augment(batch, key=batch["index"])`, and each sample is drawn alone.

        augment = ct.data.Seeded(ct.augment.RandomMount(camera=camera), seed=0)
        for epoch in range(10):
            augment.set_epoch(epoch)  # also reaches persistent workers of a DataLoader
            for batch in loader: ...

    Args:
        augmentation: An `Augmentation`, or a `Transform` of `camtorch.augment.numpy`.
        seed: Seed of the whole run, the same in all ranks.
        epoch: First epoch.

    Raises:
        TypeError: If it is another transform. ValueError: If it draws for whole batches (`same_on_batch`).
    """

    augmentation: Transform | Augmentation

    def __init__(self, augmentation: Augmentation | Transform, *, seed: int = 0, epoch: int = 0):
        inner = augmentation.augmentation if isinstance(augmentation, Transform) else augmentation
        if not isinstance(inner, Augmentation):
            wanted = "an Augmentation, or camtorch.augment.numpy's Transform of one"
            raise TypeError(f"Seeded: augmentation must be {wanted}; got {type(inner).__name__}")
        if inner.same_on_batch:
            raise ValueError("Seeded: same_on_batch must be False, because no draw depends on the batch here; got True")
        self.augmentation = augmentation
        # in shared memory, so that running processes see a new epoch
        self._numbers = torch.tensor([_number(seed, "seed"), _number(epoch, "epoch")]).share_memory_()

    @property
    def seed(self) -> int:
        """Seed of the whole run."""
        return int(self._numbers[0])

    @property
    def epoch(self) -> int:
        """Current epoch."""
        return int(self._numbers[1])

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the draws, also in the workers of a DataLoader; call it between two iterations."""
        self._numbers[1] = _number(epoch, "epoch")

    def generator(self, key: Key) -> torch.Generator:
        """Return the generator of a sample."""
        return generator(key, seed=self.seed, epoch=self.epoch)

    def draw(self, keys: Sequence[Key] | Tensor | np.ndarray[Any, Any]) -> dict[str, Tensor]:
        """Return the draws of a batch of samples, each drawn alone with `augmentation.draw`."""
        own = self.augmentation
        inner = cast("Augmentation", own.augmentation) if isinstance(own, Transform) else own
        draws = [inner.draw(1, self.generator(key)) for key in keys]
        if not draws:
            return inner.draw(0)
        return {name: torch.cat([draw[name] for draw in draws]) for name in draws[0]}

    def __call__(
        self,
        sample: Mapping[str, Any] | None = None,
        *,
        key: Key | Sequence[Key] | Tensor | np.ndarray[Any, Any],
        **fields: Any,
    ) -> Sample:
        """Augment a sample, a dict or keyword arguments, by its key; or a batch, by a list or a tensor of its keys."""
        many = key.ndim > 0 if isinstance(key, (Tensor, np.ndarray)) else isinstance(key, list)
        if not many:
            moved = self.augmentation(sample, generator=self.generator(key), **fields)  # type: ignore[arg-type]
            rotation = moved["rotation"]
            if rotation.ndim == 3 and len(rotation) > 1:
                got = f"{key!r:.60}. A clip of one sample goes in as image[None] with key=[...]"
                raise ValueError(f"Seeded: key must be a list, one for each of {len(rotation)} samples; got {got}")
            return moved
        if isinstance(self.augmentation, Transform):
            raise TypeError(f"Seeded: key must be a single one for a Transform of arrays; got {key!r:.60}")
        return self.augmentation(sample, draw=self.draw(key), **fields)  # type: ignore[arg-type]

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._numbers.share_memory_()

    def __repr__(self) -> str:
        return f"Seeded({self.augmentation!r}, seed={self.seed}, epoch={self.epoch})"
