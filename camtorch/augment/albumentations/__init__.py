"""Augmentations as a transform of albumentations, for the pipelines of `A.Compose`.

    transform = camtorch.augment.albumentations.Transform(camtorch.augment.RandomMount(yaw=20), camera)
    pipeline = A.Compose([transform, A.GaussNoise()], bbox_params=..., keypoint_params=...)

The module is imported by name: `import camtorch.augment.albumentations`. Without pipelines of albumentations, the
`Transform` of `camtorch.augment.numpy` takes the same arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import albumentations as A  # noqa: N812 (everybody's name for it)
import numpy as np
import torch
from albumentations.core.type_definitions import Targets

from camtorch.augment import numpy as arrays
from camtorch.augment.albumentations.saving import as_plain, from_plain
from camtorch.augment.augmentation import Augmentation
from camtorch.augment.cameras import Unknown, camera_of_sample, known_camera
from camtorch.augment.fields import KINDS, PLACE
from camtorch.augment.front_end import FrontEnd, check_front_end
from camtorch.augment.matrices import NAMES
from camtorch.augment.names import kind_of, refuse_unknown
from camtorch.augment.sample import Sample, detached
from camtorch.cameras.camera import Camera
from camtorch.values.arguments import present

_OWNER = "albumentations.Transform"
_TARGETS = "image", "images", "mask", "masks", "bboxes", "keypoints"  # of pipelines
_MAY_BE_EMPTY = "bboxes", "keypoints"  # which an image without objects has none of


class Transform(FrontEnd, A.DualTransform):
    """An augmentation among those of albumentations: all that a sample holds moves by one draw.

    Targets of pipelines follow its `bbox_params` and `keypoint_params`. A keypoint without a place on the new camera
    becomes (-1, -1), off the image: `remove_invisible=True` removes it with its labels, `False` keeps it there. A lost
    box has no area. Angles and sizes of keypoints are not changed.

    Other fields move by their names, as in `Augmentation`: `gaze`, `head_pose`, `depth` and so on, in pixels, with
    `<name>_valid` next to points and boxes. Numbers under an unknown name that might be geometry raise an error;
    `fields={"lidar": "points", "logits": "keep"}` of the augmentation gives their kinds. A `camera` in the sample is
    that of its images; every result holds the new one, which the next transform of camtorch uses. Flips, crops and
    sizes of albumentations, before or after this transform, move keypoints and boxes, and leave `gaze`, `head_pose` and
    `camera`. In their place take camtorch's own, in one transform:
    `Transform(ct.augment.Compose([ct.augment.HorizontalFlip(landmarks="ibug68"), augmentation]), camera)`. Numbers are
    drawn by the generator of the pipeline, `A.Compose(..., seed=...)`, and replayed by `A.ReplayCompose`. There are no
    gradients, and volumes are not supported.

    `A.save` writes plain numbers, with cameras as `camera.to_dict()` has them. Before `A.load`, import this module, and
    those that define augmentations of your own.

    Args:
        augmentation: the augmentation to apply.
        camera: for samples that hold none; default: the augmentation's. It is copied, and does not learn. A number is
            for photographs of unknown cameras, see `Augmentation`.
        p: probability that a sample is augmented; default: the augmentation's.

    Raises:
        TypeError: If `augmentation` is no Augmentation, or a camera is no Camera.
        ValueError: If there is no camera, or one with batch dims; if images are not of the camera's image_size; if
            numbers under an unknown name might be geometry.
    """

    _targets = (Targets.IMAGE, Targets.MASK, Targets.BBOXES, Targets.KEYPOINTS)
    augmentation: Augmentation
    camera: Camera | float | None
    _name = _OWNER

    def __init__(self, augmentation: Augmentation, camera: Camera | float | None = None, p: float | None = None):
        augmentation, camera = from_plain(augmentation, _OWNER), from_plain(camera, _OWNER)  # as of `A.load`
        check_front_end(_OWNER, augmentation)
        self.augmentation, self.camera = augmentation, camera
        self._arrays = arrays.Transform(augmentation)
        super().__init__(p=augmentation.p if p is None else p)

    @property
    def targets(self) -> dict[str, Callable[..., Any]]:
        nothing: Callable[..., Any] = self.apply  # `apply_with_params` moves all targets together
        return dict.fromkeys((*KINDS, *_TARGETS, *NAMES, *self.augmentation.fields, "camera", PLACE), nothing)

    def to_dict_private(self) -> dict[str, Any]:
        parts = {name: as_plain(getattr(self, name), f"{_OWNER}: {name}") for name in ("augmentation", "camera")}
        return {"__class_fullname__": self.get_class_fullname(), "p": self.p, **parts}

    def get_dict_with_id(self) -> dict[str, Any]:  # for a replay, which makes the transform of these values again
        return {**super().to_dict_private(), "id": id(self)}

    def __call__(self, *args: Any, force_apply: bool = False, **data: Any) -> dict[str, Any]:
        """Transform a sample of keyword arguments; see the class."""
        result: dict[str, Any] = super().__call__(*args, force_apply=force_apply, **data)
        camera = self._source(data) if result.get("camera") is None else result["camera"]
        return result if isinstance(camera, Unknown) else {**result, "camera": detached(camera)}

    def get_params(self) -> dict[str, Any]:
        drawn = self.augmentation.drawn(1, 1.0, False, torch.Generator().manual_seed(self.py_random.getrandbits(63)))
        return {"draw": {name: value.tolist() for name, value in drawn.items()}}

    def apply_with_params(self, params: dict[str, Any], *args: Any, **data: Any) -> dict[str, Any]:
        fields, write = self._read(data)
        draw = {name: torch.from_numpy(np.array(value, np.float64)) for name, value in params["draw"].items()}
        return write(self._arrays(fields, draw=draw))

    def _read(self, data: dict[str, Any]) -> tuple[Sample, Callable[[Sample], Sample]]:
        """Return targets as `numpy.Transform` takes them, and the function that writes moved ones as given."""
        camera = self._source(data)
        fields = {} if isinstance(camera, Unknown) else {"camera": camera}
        targets = {}  # field -> its name in the sample, and the target of that name
        for i, (name, value) in enumerate(data.items()):
            target, field = self._additional_targets.get(name, name), name
            if value is None or name in ("camera", "applied_transforms", self.save_key):
                continue
            if target in _MAY_BE_EMPTY and len(value) == 0:
                continue
            if name != target:
                refuse_unknown({target: value}, self.augmentation.fields, _OWNER, single=True)
                kind = self._kind(name, value)
                if kind not in KINDS:
                    continue
                field = f"{kind}_{i}"  # a name that begins with a kind is known
            targets[field] = name, target
            fields[field] = _as_field(target, value, camera)

        def write(moved: Sample) -> Sample:
            change = present(self.augmentation.last, "the change of the call that moved")
            followed = ("camera", PLACE, "rotation") if PLACE in moved else ("camera",)  # the crop's follows from both
            result = data | {name: moved[name] for name in followed if name in moved}
            for field, (name, target) in targets.items():
                seen = moved.get(f"{field}_valid")
                result[name] = _as_target(target, data[name], moved[field], seen, change.parts[0].image_size)
                if seen is not None and target not in _TARGETS:
                    result[f"{name}_valid"] = seen
            return result

        return fields, write

    def _source(self, data: dict[str, Any]) -> Camera:
        """Return the camera of a sample's images."""
        sizes = [(name, np.shape(data[name])[:2]) for name in ("image", "mask") if data.get(name) is not None]
        several = [name for name in ("images", "masks") if data.get(name) is not None and len(data[name])]
        sizes += [(name, np.shape(data[name][0])[:2]) for name in several]
        given, own = data.get("camera"), self.augmentation
        known = known_camera(self.camera if given is None else given, own.camera)
        named = [(name, value) for name, value in data.items() if value is not None]
        matrix = next((pair for pair in named if self._kind(*pair) == "K"), None)
        return camera_of_sample(_OWNER, known, own.needs_camera, sizes, matrix)

    def _kind(self, name: str, value: Any) -> str | None:
        """Return the kind of a field, by its name or by that of its target; see `kind_of`."""
        return kind_of(self._additional_targets.get(name, name), value, self.augmentation.fields, _OWNER)


def _as_field(target: str, value: Any, camera: Camera) -> Any:
    """Return a target as `numpy.Transform` takes it: in pixels, and NaN for a keypoint without a place."""
    if target == "bboxes":
        return value[:, :4].astype(np.float64) * ([camera.width, camera.height] * 2) - 0.5
    if target == "keypoints":
        return np.where((value[:, :2] == -1).all(1, keepdims=True), np.nan, value[:, :2])
    return list(value) if target in ("images", "masks") else value


def _as_target(target: str, given: Any, moved: Any, seen: Any, size: tuple[int, int]) -> Any:
    """Return a moved target in the form of pipelines."""
    if target == "keypoints":
        return np.concatenate((np.nan_to_num(moved, nan=-1.0), given[:, 2:]), 1)
    if target == "bboxes":  # a lost one has no area
        parts = np.where(seen[:, None], (moved + 0.5) / (size[::-1] * 2), 0.0)
        return np.concatenate((parts.astype(given.dtype), given[:, 4:]), 1)
    return np.stack(moved) if target in ("images", "masks") and isinstance(given, np.ndarray) and len(given) else moved
