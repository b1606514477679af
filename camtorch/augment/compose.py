"""Augmentations one after the other, which move images once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import Unpack

from camtorch.augment.augmentation import Augmentation, EditOptions, Range, draw
from camtorch.augment.change import Change, check_sizes
from camtorch.augment.edits import Edit, change_by
from camtorch.augment.landmarks import Mirroring
from camtorch.cameras.camera import Camera
from camtorch.values.arguments import as_mapping

_OF_IMAGES = ("mode", "padding_mode", "fill", "tolerance")


class Compose(Augmentation):
    """Augmentations one after the other, each for the camera that the one before leaves, applied all at once.

    Images are sampled once, by the warp from the first camera to the last, and labels move exactly. `nn.Sequential`
    of the same augmentations, with the same seed, moves labels alike, but samples images at every step, and
    leaves black what a later step might see again: here, what is cut off on the way and seen by the last camera is
    shown. Where all are edits no camera is needed.

        augment = ct.augment.Compose(
            [
                ct.augment.RandomResizedCrop((480, 640), scale=(0.5, 1.0)),
                ct.augment.HorizontalFlip(landmarks="ibug68"),
                ct.augment.RandomLens("dms130", fov="source"),
            ],
            camera=camera,
        )

    Args:
        augmentations: in the order in which they apply; a `Compose` among them, too.
        camera: of samples that do not bring one; by default that of the first augmentation.
        antialias: as of `Edit`: by itself where more than one and a half pixels come to one, if None.
        options: p, same_on_batch, fields, mode, padding_mode, fill, mask_fill, valid_mask, tolerance, of all of them
            together; see `Augmentation`. Those of the parts are p, same_on_batch, fields and what they draw.

    Raises:
        TypeError: something that is no augmentation. ValueError: none; two tables of landmarks that differ; a part that
            wants other images than the whole; chromatic aberration or vignetting before another lens; a
            `RandomShutter` before the last part.
    """

    augmentations: nn.ModuleList

    def __init__(
        self,
        augmentations: Iterable[Augmentation],
        **options: Unpack[EditOptions],
    ):
        name = type(self).__name__
        parts = list(augmentations) if isinstance(augmentations, Iterable) else [augmentations]
        for part in parts:
            if not isinstance(part, Augmentation):
                raise TypeError(
                    f"{name}: augmentations must be a list of augmentations of camtorch; got {type(part).__name__}. "
                    "Those of other libraries go before or after, in nn.Sequential or their own containers"
                )
        if not parts:
            raise ValueError(f"{name}: no augmentations")
        if options.get("camera") is None:
            options["camera"] = next((part.camera for part in parts if part.camera is not None), None)
        options["fields"] = {key: value for part in parts for key, value in part.fields.items()} | dict(
            as_mapping(options.get("fields"), "fields", name, "{'lidar': 'points'}")
        )
        options.setdefault("antialias", None)
        if any(part.valid_mask for part in parts):
            options.setdefault("valid_mask", True)
        ranges: dict[str, Range] = {}
        for i, part in enumerate(parts):
            ranges[f"{i}.apply"] = Range(0, 1)
            ranges |= {f"{i}.{key}": interval for key, interval in part.ranges.items()}
        super().__init__(ranges, **options)
        self.augmentations = nn.ModuleList(parts)
        self.crops: Mapping[str, int] = {
            f"{i}.{key}": index for i, part in enumerate(parts) for key, index in part.crops.items()
        }
        self.needs_camera: bool = any(part.needs_camera for part in parts)
        self._check_options(parts)
        mirrorings = {repr(m.key): m for part in parts if (m := part.mirroring) is not None}
        if len(mirrorings) > 1:
            raise ValueError(f"{name}: flips of one chain need the same landmarks, lateral_axis and swap_sides")
        self.mirroring: Mirroring | None = next(iter(mirrorings.values()), None)

    def _check_options(self, parts: Sequence[Augmentation]) -> None:
        usual = Augmentation().options
        for i, part in enumerate(parts):
            given = {**part.options, "mask_fill": part.mask_fill}
            wanted = {**self.options, "mask_fill": self.mask_fill}
            for key in (*_OF_IMAGES, "mask_fill"):
                if given[key] not in ({**usual, "mask_fill": 0.0}[key], wanted[key]):
                    raise ValueError(
                        f"{self._name}: images are sampled once, so {key}={given[key]!r} of {type(part).__name__} goes "
                        f"to {self._name} itself"
                    )
            drawn = {key.rpartition(".")[2] for key in part.ranges}
            if "shift_x" in drawn:
                raise ValueError(
                    f"{self._name}: a shift needs the depth of its own image; {type(part).__name__} with it goes before"
                )
            if "rates" in drawn and parts[i + 1 :]:
                raise ValueError(
                    f"{self._name}: what comes after a rolling shutter would move its rows; {type(part).__name__} goes "
                    "last"
                )
            coloured = {"chromatic", "vignetting", "cos4"} & drawn
            if coloured and any(later.needs_camera and not later.keeps_lens for later in parts[i + 1 :]):
                raise ValueError(
                    f"{self._name}: the {' and '.join(sorted(coloured))} of {type(part).__name__} would be seen "
                    "through another lens; only edits may follow it"
                )

    @property
    def parts(self) -> list[Augmentation]:
        """The augmentations, in their order."""
        return cast("list[Augmentation]", list(self.augmentations))

    def _numbers(self, count: int, p: float, same_on_batch: bool, generator: torch.Generator | None) -> dict[str, Any]:
        values: dict[str, Any] = draw({}, count, p, same_on_batch, generator)[0]
        values["apply"] = values["apply"] if isinstance(values["apply"], Tensor) else np.asarray(values["apply"])
        for i, part in enumerate(self.parts):
            own = part._numbers(count, part.p, same_on_batch or part.same_on_batch, generator)
            for key, value in own.items():
                values[f"{i}.{key}"] = value.double() if isinstance(value, Tensor) else np.asarray(value, np.float64)
        return values

    def size_after(self, size: tuple[int, int]) -> tuple[int, int]:
        for part in self.parts:
            size = part.size_after(size)
        return size

    def tell_of_empty_images(self, camera: Camera) -> None:
        for part in self.parts:
            part.tell_of_empty_images(camera)

    def _change(self, camera: Camera, draw: Mapping[str, Any]) -> Change:
        total, options = None, {**self.options, "antialias": self.antialias}
        steps = []
        for i, part in enumerate(self.parts):
            own = {name: draw[f"{i}.{name}"] for name in ("apply", *part.ranges, *part.crops)}
            steps.append((part, {**own, "apply": (own["apply"] > 0.5) & draw["apply"]}))
        while steps:
            edits = []
            while steps and isinstance(steps[0][0], Edit):  # those that follow each other are one
                edits.append(cast("tuple[Edit, dict[str, Any]]", steps.pop(0)))
            if edits:
                step = change_by(edits, camera, options)
            else:
                part, own = steps.pop(0)
                if total is not None:
                    own |= {name: _moved(total, own[name], camera) for name in part.crops}
                step = part._change(camera, own)
            total = step if total is None else total.then(step)
            (first, *others) = step.parts  # one camera for all where it is one
            camera = step.target if others or first.rows is not None else first.target
        assert total is not None
        check_sizes((part.image_size for part in total.parts), self._name)
        return total.with_options(options)  # type: ignore[arg-type]

    def extra_repr(self) -> str:
        """The options."""
        options = {"p": self.p, "same_on_batch": self.same_on_batch, **self.options, "antialias": self.antialias}
        return ", ".join(f"{name}={value!r}" for name, value in options.items())


def _moved(change: Change, boxes: Any, camera: Camera) -> Tensor:
    """Boxes (B, 4) after a change; one that left the image becomes the middle of it."""
    moved, valid = (t[:, 0] for t in change.boxes(torch.as_tensor(boxes)[:, None]))
    width, height = camera.width, camera.height
    middle = moved.new_tensor([0.25 * width, 0.25 * height, 0.75 * width, 0.75 * height])
    return torch.where(valid[:, None], moved, middle)
