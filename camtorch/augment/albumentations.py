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
from torch import Tensor

from camtorch.augment.augmentation import Augmentation, camera_of_sample, check_front_end, move_points
from camtorch.augment.change import Change
from camtorch.augment.numpy import as_array, as_tensor
from camtorch.augment.sample import KINDS, Unknown, moves, together
from camtorch.camera import Camera

_OWNER = "albumentations.Transform"
_KINDS = [k for k in KINDS if k not in ("image", "mask", "keypoints", "polygons", "boxes", "landmarks")]


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
        check_front_end(_OWNER, augmentation, camera)
        super().__init__(p=augmentation.p if p is None else p)
        self.augmentation, self.camera = augmentation, camera

    @property
    def targets(self) -> dict[str, Callable[..., Any]]:
        moved = {name: getattr(self, f"apply_to_{name}") for name in ("images", "mask", "masks", "bboxes", "keypoints")}
        others = {name: self._mover(name) for name in _KINDS}
        return {"image": self.apply, **moved, **others, "camera": self.apply_to_camera}

    @property
    def last(self) -> Change | None:
        """The change of the last sample that it was applied to: its `source`, `target` and `rotation`."""
        return self.augmentation.last

    def __call__(self, *args: Any, force_apply: bool = False, **data: Any) -> dict[str, Any]:
        """Transform a sample of keyword arguments; see the class."""
        result: dict[str, Any] = super().__call__(*args, force_apply=force_apply, **data)
        if result.get("camera") is None and not isinstance(source := self._source(data), Unknown):
            result["camera"] = source
        return result

    def get_params(self) -> dict[str, Any]:
        generator = torch.Generator().manual_seed(self.py_random.getrandbits(63))
        drawn = self.augmentation.drawn(1, 1.0, False, generator)
        return {"draw": {name: value.tolist() for name, value in drawn.items()}}

    def apply_with_params(self, params: dict[str, Any], *args: Any, **data: Any) -> dict[str, Any]:
        camera = self._source(data)
        drawn: Any = {name: torch.tensor(value, dtype=torch.float64) for name, value in params["draw"].items()}
        if self.augmentation.crops:
            given = data.get("bboxes")
            drawn = self.augmentation.with_boxes(drawn, None if given is None else _corners(given, camera)[None])
        with torch.no_grad():
            self.augmentation.tell_of_empty_images(camera)
            change = self.augmentation.last = self.augmentation.change(camera, drawn)
            named = {name: field for name, value in data.items() if (field := self._field(name, value)) is not None}
            made = together(change, named, self.augmentation.mask_fill)
            rest = {name: value for name, value in data.items() if name not in made}
            moved: dict[str, Any] = super().apply_with_params({**params, "change": change}, *args, **rest)
            moved |= {name: self._key2func[name](data[name], change=change, made=value) for name, value in made.items()}
            result = {name: moved[name] for name in data}
            return result if isinstance(camera, Unknown) else {**result, "camera": self.apply_to_camera(camera, change)}

    def _field(self, name: str, value: Any) -> tuple[str, Tensor] | None:
        """What a sample holds as the field of a batch of one; None for what moves by itself."""
        kinds = {"apply": "image", "apply_to_mask": "mask", "apply_to_keypoints": "keypoints"}
        kind = kinds.get(getattr(self._key2func.get(name), "__name__", "")) if isinstance(value, np.ndarray) else None
        if kind is None:
            return None
        return kind, (torch.as_tensor(value[:, :2]) if kind == "keypoints" else as_tensor(name, value))[None]

    def _source(self, data: Mapping[str, Any]) -> Camera:
        sizes = [(name, np.shape(data[name])[:2]) for name in ("image", "mask") if data.get(name) is not None]
        return camera_of_sample(_OWNER, self.augmentation, data.get("camera", self.camera), sizes)

    # -- what moves

    def apply(self, img: np.ndarray, change: Change, made: Any = None, **params: Any) -> np.ndarray:
        images = change.images(as_tensor("image", img)[None]) if made is None else made[0]
        return as_array(images[0], img)

    def apply_to_mask(self, mask: np.ndarray, change: Change, made: Any = None, **params: Any) -> np.ndarray:
        fill = self.augmentation.mask_fill
        masks = change.labels(as_tensor("mask", mask)[None], fill) if made is None else made[0]
        return as_array(masks[0], mask)

    def apply_to_keypoints(self, keypoints: np.ndarray, change: Change, made: Any = None, **params: Any) -> np.ndarray:
        """Keypoints (N, 2 and more), x and y first, in pixels whose centres are whole numbers."""
        moved = move_points(self.augmentation, change, torch.as_tensor(keypoints[:, :2])[None], made)[0][0]
        return np.concatenate((moved.numpy(), keypoints[:, 2:]), 1)

    def apply_to_bboxes(self, bboxes: np.ndarray, change: Change, **params: Any) -> np.ndarray:
        """Boxes (M, 4 and more) between pixel edges, as parts of width and height."""
        target = change.parts[0].target
        moved, seen = change.boxes(_corners(bboxes, change.parts[0].camera)[None])
        after = torch.tensor([target.width, target.height] * 2, dtype=torch.float64)
        moved = torch.where(seen[0, :, None], (moved[0] + 0.5) / after, 0.0)
        return np.concatenate((moved.numpy().astype(bboxes.dtype), bboxes[:, 4:]), 1)

    def apply_to_camera(self, camera: Camera | None, change: Change, **params: Any) -> Camera:
        return change.single

    def _mover(self, kind: str) -> Callable[..., np.ndarray]:
        def move(value: np.ndarray, change: Change, **params: Any) -> np.ndarray:
            tensor = torch.as_tensor(np.asarray(value))[None]
            mirroring = self.augmentation.mirroring
            options = {} if mirroring is None else {"lateral": mirroring.lateral}
            moved: Tensor = moves(kind, tensor)(change, tensor, options)
            return moved[0].numpy()

        return move


def _corners(bboxes: Any, camera: Camera) -> Tensor:
    """(M, 4) pixels x1, y1, x2, y2 of boxes (M, 4 and more) that are parts of an image's width and height."""
    sides = torch.tensor([camera.width, camera.height] * 2, dtype=torch.float64)
    return torch.as_tensor(np.asarray(bboxes)[:, :4], dtype=torch.float64) * sides - 0.5
