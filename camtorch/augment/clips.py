"""Clips, (B, T, ...): samples of frames that move by one draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.camera import Camera


@dataclass(frozen=True)
class Clips:
    """A sample of clips.

    Args:
        sample: as it was given.
        fields: names of what moves, or says something of each frame.
        shape: (B, T), those of the image `name`.
        owner, name: for errors.
    """

    sample: Mapping[str, Any]
    fields: Sequence[str]
    shape: tuple[int, ...]
    owner: str
    name: str

    def frames(self, camera: Any) -> dict[str, Any]:
        """Return the sample as a batch of B * T frames, each with the camera of its clip."""
        values = {name: self._checked(name, self.sample[name]) for name in self.fields}
        flat = {**self.sample, **{name: v.reshape(-1, *v.shape[2:]) for name, v in values.items()}}
        flat |= {"camera": self.repeated(camera, "camera")} if camera is not None else {}
        turned = self.sample.get("rotation")
        return flat if turned is None else {**flat, "rotation": self.repeated(turned, "rotation")}

    def _checked(self, name: str, value: Any) -> Tensor:
        shape = tuple(getattr(value, "shape", ()))
        if not isinstance(value, (Tensor, np.ndarray)) or shape[:2] != self.shape or not self.shape[1]:
            wanted = ", ".join(map(str, self.shape)) if self.shape[1] else "B, T > 0"
            raise ValueError(
                f"{self.owner}: {name} must be ({wanted}, ...), for {self.name} holds clips (B, T, C, H, W); got "
                f"{f'shape {shape}' if shape else type(value).__name__}"
            )
        return torch.as_tensor(value)

    def repeated(self, value: Any, name: str) -> Any:
        """Return what there is of each clip, (B, ...), for each of its frames; one camera serves all."""
        clips, frames = self.shape
        rows = [i for i in range(clips) for _ in range(frames)]
        if not hasattr(value, "__len__") or (isinstance(value, Camera) and not value.batch_shape):
            return value
        if len(value) != clips:
            raise ValueError(f"{self.owner}: {name} is of {len(value)} clips, {self.name} of {clips}")
        return [value[i] for i in rows] if isinstance(value, (list, tuple)) else value[rows]

    def restored(self, moved: Mapping[str, Any]) -> dict[str, Any]:
        """Return what came of the frames as clips; what is of all frames of a clip, once."""
        result = dict(moved)
        for name, value in moved.items():
            if name in ("camera", "rotation"):
                rows = list(range(0, len(value), self.shape[1]))
                result[name] = [value[i] for i in rows] if isinstance(value, list) else value[rows]
            elif value is not self.sample.get(name):
                result[name] = value.unflatten(0, self.shape)
        return result
