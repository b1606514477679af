"""Augmentations as a transform of albumentations, for the pipelines of `A.Compose`.

    transform = camtorch.augment.albumentations.Transform(camtorch.augment.RandomMount(yaw=20), camera)
    pipeline = A.Compose([transform, A.GaussNoise()], bbox_params=..., keypoint_params=...)

The module is imported by name: `import camtorch.augment.albumentations`. Without pipelines of albumentations, the
`Transform` of `camtorch.augment.numpy` takes the same arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import albumentations as A  # noqa: N812 (everybody's name for it)
import numpy as np
import torch
from albumentations.core.type_definitions import Targets

from camtorch.augment import numpy as arrays
from camtorch.augment.augmentation import Augmentation, camera_of_sample, check_front_end
from camtorch.augment.change import Change
from camtorch.augment.sample import KINDS, Unknown
from camtorch.camera import Camera

_OWNER = "albumentations.Transform"
_KINDS = {kind: kind for kind in KINDS if kind not in ("polygons", "boxes", "landmarks")}
_KINDS |= {"images": "image", "masks": "mask", "bboxes": "boxes"}
"""Targets of pipelines, and the kinds of fields that they are."""


class Transform(A.DualTransform):
    """An augmentation among those of albumentations: image, masks, boxes and keypoints of a sample move by one draw.

    Under their own names, `gaze`, `directions`, `points`, `pitch_yaw`, `head_pose`, `rvec`, `tvec`, `depth` and
    `distance` move as well; see `Augmentation`. A `camera` in the sample is that of its images, and every sample comes
    out with the new `camera`, from which the next transform of camtorch goes on. What albumentations itself does
    in between to where pixels lie, as a crop or a flip, no camera knows of; the edits of camtorch tell it.

    Keypoints and boxes are given and filtered as `keypoint_params` and `bbox_params` of the pipeline say. That is
    where their validity goes: a keypoint without a place on the new camera becomes (-1, -1), off the image, and
    `remove_invisible=True` takes it away with its labels; `False` keeps it there. A lost box has no area. Angles and
    sizes of keypoints stay as they are.

    Numbers are drawn by the generator of the pipeline, `A.Compose(..., seed=...)`, and replayed by `A.ReplayCompose`.
    Nothing is differentiated, and volumes are not taken.

    Args:
        augmentation: what to do.
        camera: of samples that hold none; by default the augmentation's.
        p: how likely a sample is augmented; by default as the augmentation says.

    Raises:
        TypeError: it is no augmentation; a camera that is none.
        ValueError: no camera, one with batch dims, images that are not of the camera's image_size.
    """

    _targets = (Targets.IMAGE, Targets.MASK, Targets.BBOXES, Targets.KEYPOINTS)
    augmentation: Augmentation
    camera: Camera | None

    def __init__(self, augmentation: Augmentation, camera: Camera | None = None, p: float | None = None):
        self.camera = check_front_end(_OWNER, augmentation, camera)
        super().__init__(p=augmentation.p if p is None else p)
        self.augmentation = augmentation
        self._arrays = arrays.Transform(augmentation)

    @property
    def targets(self) -> dict[str, Callable[..., Any]]:
        nothing: Callable[..., Any] = self.apply  # they move together, see `apply_with_params`
        return dict.fromkeys((*_KINDS, "camera"), nothing)

    @property
    def last(self) -> Change | None:
        """The change of the last sample that it was applied to: its `source`, `target` and `rotation`."""
        return self.augmentation.last

    def __call__(self, *args: Any, force_apply: bool = False, **data: Any) -> dict[str, Any]:
        """Transform a sample of keyword arguments; see the class."""
        result: dict[str, Any] = super().__call__(*args, force_apply=force_apply, **data)
        camera = self._source(data) if result.get("camera") is None else result["camera"]
        return result if isinstance(camera, Unknown) else {**result, "camera": camera.detach()}

    def get_params(self) -> dict[str, Any]:
        generator = torch.Generator().manual_seed(self.py_random.getrandbits(63))
        drawn = self.augmentation.drawn(1, 1.0, False, generator)
        return {"draw": {name: value.tolist() for name, value in drawn.items()}}

    def apply_with_params(self, params: dict[str, Any], *args: Any, **data: Any) -> dict[str, Any]:
        camera = self._source(data)
        fields: dict[str, Any] = {} if isinstance(camera, Unknown) else {"camera": camera}
        names = {}
        for i, (name, value) in enumerate(data.items()):
            target = self._additional_targets.get(name, name)
            if target in _KINDS and value is not None:
                names[name] = field = name if name == target else f"{_KINDS[target]}_{i}"
                fields[field] = _given(target, value, camera)
        drawn = {name: torch.tensor(value, dtype=torch.float64) for name, value in params["draw"].items()}
        moved = self._arrays(fields, draw=drawn)
        change = self.augmentation.last
        assert change is not None  # of this call
        result = dict(data)
        for name, field in names.items():
            target = self._additional_targets.get(name, name)
            seen = moved.get(f"{field}_valid")
            result[name] = _taken(target, data[name], moved[field], seen, change.parts[0].image_size)
        return {**result, "camera": moved["camera"]} if "camera" in moved else result

    def _source(self, data: Mapping[str, Any]) -> Camera:
        sizes = [(name, np.shape(data[name])[:2]) for name in ("image", "mask") if data.get(name) is not None]
        return camera_of_sample(_OWNER, self.augmentation, data.get("camera", self.camera), sizes)


def _given(target: str, value: Any, camera: Camera) -> Any:
    """What pipelines hand on, as `numpy.Transform` takes it: in pixels, and NaN for a keypoint without a place."""
    if target in ("images", "masks"):
        return list(value)
    if target == "bboxes":
        return value[:, :4].astype(np.float64) * _sides((camera.height, camera.width)) - 0.5
    if target == "keypoints":
        return np.where((value[:, :2] == -1).all(1, keepdims=True), np.nan, value[:, :2])
    return value


def _taken(target: str, given: Any, moved: Any, seen: Any, size: tuple[int, int]) -> Any:
    """What came of it, as they go on with it."""
    if target in ("images", "masks"):
        return np.stack(moved) if isinstance(given, np.ndarray) and len(given) else moved
    if target == "keypoints":
        return np.concatenate((np.nan_to_num(moved, nan=-1.0), given[:, 2:]), 1)
    if target == "bboxes":  # a lost one has no area
        parts = np.where(seen[:, None], (moved + 0.5) / _sides(size), 0.0)
        return np.concatenate((parts.astype(given.dtype), given[:, 4:]), 1)
    return moved


def _sides(size: tuple[int, int]) -> np.ndarray:
    """Width and height, of both corners of a box."""
    return np.array([size[1], size[0]] * 2, np.float64)
