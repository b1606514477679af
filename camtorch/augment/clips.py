"""Clips, (B, T, ...): samples of frames that move by one draw."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from camtorch.augment.fields import KINDS, PLACE, Named
from camtorch.augment.matrices import check_alike
from camtorch.augment.names import kind_of
from camtorch.augment.reading import moving
from camtorch.cameras.camera import Camera
from camtorch.values.arguments import as_mapping


@dataclass(frozen=True)
class Clips:
    """A sample of clips, whose fields hold a value for each frame or for each clip."""

    sample: Mapping[str, Any]
    per_frame: Sequence[str]  # the names of those with a value for each frame
    per_clip: Sequence[str]
    shape: tuple[int, ...]  # (B, T), that of `image`
    image: str  # the name of the field that tells that these are clips
    owner: str

    @classmethod
    def of(
        cls, sample: Mapping[str, Any], fields: Mapping[str, str], tables: Iterable[str], owner: str
    ) -> Clips | None:
        """Return the clips of a sample, if an image has the dims (B, T, C, H, W).

        fields: name -> kind, of other names. tables: names of the fields with tables of landmarks.
        """
        given = {name: value for name, value in sample.items() if value is not None}
        kinds = {name: kind_of(name, value, fields, owner) for name, value in given.items()}
        dims = {name: getattr(value, "ndim", 0) for name, value in given.items()}
        image = next((name for name, kind in kinds.items() if kind == "image" and dims[name] == 5), None)
        if image is None:
            return None
        per_clip = ["camera", "rotation", PLACE]
        for name, kind in kinds.items():
            if kind == "K" and dims[name] == 4:  # of each frame
                check_alike(name, given[name], owner)
            elif kind == "K":
                per_clip.append(name)
        found = {name for name, kind in kinds.items() if kind in KINDS and name not in per_clip}
        found |= {f"{name}_valid" for name in found} | {"image_valid", *tables}
        per_frame = [name for name in given if name in found]
        return cls(sample, per_frame, per_clip, tuple(given[image].shape[:2]), image, owner)

    def frames(self, camera: Any) -> dict[str, Any]:
        """Return the sample as a batch of B * T frames, each with the `camera` of its clip, if any."""
        flat = dict(self.sample)
        for name in self.per_frame:
            value = flat[name]
            shape = tuple(getattr(value, "shape", ()))
            if shape[:2] != self.shape or not self.shape[1]:
                raise ValueError(
                    f"{self.owner}: {name} must be ({self.shape[0]}, {self.shape[1] or 'T > 0'}, ...), as {self.image} "
                    f"is of clips (B, T, ...); got {f'shape {shape}' if shape else type(value).__name__}"
                )
            flat[name] = torch.as_tensor(value).flatten(0, 1)
        for name in self.per_clip:
            value = camera if name == "camera" else flat.get(name)
            if value is not None:
                flat[name] = self.repeated(value, name)
        return flat

    def first_frames(self, frames: Mapping[str, Any], fields: Mapping[str, str]) -> Named:
        """Return the fields that move of the first frame of each clip."""
        named = moving(frames, fields, self.owner)
        return {name: (kind, value[:: self.shape[1]]) for name, (kind, value) in named.items()}

    def for_frames(self, draw: Mapping[str, Any]) -> dict[str, Any]:
        """Return a draw for the clips as one for their frames."""
        draw = as_mapping(draw, "draw", self.owner, "what draw() returns")
        return {name: self.repeated(value, f"draw[{name!r}]") for name, value in draw.items()}

    def repeated(self, value: Any, name: str) -> Any:
        """Return a value (B, ...) of each clip, repeated for each of its frames; a single camera serves all."""
        try:
            count = len(value)
        except TypeError:  # a single camera, or a number
            return value
        clips, frames = self.shape
        several = isinstance(value, Camera) and len(value.batch_shape) > 1
        if count != clips or several:
            got, hint = tuple(value.batch_shape) if several else count, ""
            if name == "camera":
                flat = "ct.cat(list(camera))" if several else "camera, one for each"
                hint = (
                    f". Images (B, N, C, H, W) of N cameras each go in flattened to (B N): {self.image}.flatten(0, 1) "
                    f"and labels likewise, camera={flat}; results by .unflatten(0, {self.shape})"
                )
            raise ValueError(f"{self.owner}: {name} must be of {clips} clips, as {self.image} is; got {got}{hint}")
        rows = [i for i in range(clips) for _ in range(frames)]
        return [value[i] for i in rows] if isinstance(value, (list, tuple)) else value[rows]

    def restored(self, moved: Mapping[str, Any]) -> dict[str, Any]:
        """Return moved frames as clips; values of a whole clip, such as its camera, are returned once."""
        result = dict(moved)
        for name, value in moved.items():
            if name in self.per_clip and value is not None:
                rows = list(range(0, len(value), self.shape[1]))
                result[name] = [value[i] for i in rows] if isinstance(value, list) else value[rows]
            elif value is not self.sample.get(name):
                result[name] = value.unflatten(0, self.shape)
        return result
