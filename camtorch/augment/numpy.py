"""Augmentations for numpy arrays, called like those of albumentations: one sample of keyword arguments.

    transform = camtorch.augment.numpy.Transform(camtorch.augment.RandomMount(yaw=20))
    out = transform(image=image, mask=mask, keypoints=points, bboxes=boxes, gaze=gaze, camera=camera)

The module is imported by name: `import camtorch.augment.numpy`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.augmentation import Augmentation
from camtorch.augment.face import FaceNormalizer
from camtorch.augment.front_end import FrontEnd, check_front_end
from camtorch.augment.kinds import ALIASES, IMAGES, KINDS, OWN, kind_of
from camtorch.augment.sample import Sample, Single
from camtorch.cameras.camera import Camera
from camtorch.warp.arrays import as_array, as_planes, as_tensor, plain

_OWNER = "numpy.Transform"
_VALID = "_valid"


class Transform(FrontEnd):
    """An augmentation, or a `FaceNormalizer`, of one sample of numpy arrays.

    The fields are those of `Augmentation`, by the same names and without their batch dim:

    * Images, masks and depth have their channels last, (H, W, C) or (H, W), and any real dtype. A plural name holds a
      list of such arrays, or one array (N, H, W) or (N, H, W, C).
    * Labels have the shape of a single sample, also with several faces. Lists of numbers become arrays. The centre of
      the top-left pixel is (0, 0); boxes of albumentations' "pascal_voc" are these plus 0.5.
    * The camera of the images is in the sample, or given to this transform or the augmentation. Edits need none.

    Other fields are passed on, except that unknown names of numbers raise an error, as in `Augmentation`. Arrays keep
    their layout and dtype; coordinates of whole numbers become float32. The result also has the validity, the new
    `camera` and `rotation` (3, 3). Nothing is dropped or sorted. For pipelines with `bbox_params` and
    `keypoint_params`, use the `Transform` of `camtorch.augment.albumentations`. Numbers are drawn from torch's
    generator, `torch.manual_seed`, which DataLoader seeds differently in each worker, not from numpy's. The same seed
    draws the same in every front end. There are no gradients.

    Args:
        augmentation: the augmentation to apply.
        camera: for samples that hold none; default: the augmentation's. It is copied, and does not learn.

    Raises:
        TypeError: If augmentation is no augmentation, or camera is no Camera.
    """

    _name = _OWNER
    augmentation: Augmentation | FaceNormalizer
    camera: Camera | None

    def __init__(self, augmentation: Augmentation | FaceNormalizer, camera: Camera | None = None):
        check_front_end(_OWNER, augmentation, Augmentation, FaceNormalizer)
        self.augmentation, self.camera = augmentation, camera

    def __call__(
        self,
        sample: Mapping[str, Any] | None = None,
        *,
        draw: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
        **fields: Any,
    ) -> Sample:
        """Augment a sample: keyword arguments, a dict, or both; see `Augmentation.forward` for the other arguments."""
        if sample is not None and not isinstance(sample, Mapping):
            raise TypeError(
                f"{_OWNER}: sample must be a dict, or keywords as in transform(image=...); got {type(sample).__name__}"
            )
        sample = {**(sample or {}), **fields}
        if sample.get("camera") is None and self.camera is not None:
            sample["camera"] = self.camera
        camera = self.augmentation._held("camera") if sample.get("camera") is None else sample["camera"]
        size = getattr(camera, "image_size", None)
        given: Sample = {"draw": draw, "generator": generator}
        options = {name: value for name, value in given.items() if value is not None}  # a FaceNormalizer has none
        entries = {name: self._entry(name, value, sample, size) for name, value in sample.items()}
        inside = {key: tensor for tensors, _ in entries.values() for key, tensor in tensors.items()}
        with torch.no_grad():
            moved = self.augmentation.forward(Single(inside), **options)
        result = {name: to(moved) for name, (tensors, to) in entries.items() if tensors.keys() <= moved.keys()}
        for name in moved.keys() - inside.keys():
            value = plain(moved[name]) if isinstance(moved[name], Tensor) else moved[name]
            flat = name.endswith(_VALID) and value.ndim == 3 and self._kind(name, value, sample) in IMAGES
            result[name] = value[0] if flat else value
        return result

    def __repr__(self) -> str:
        return f"Transform({self.augmentation!r})"

    def _kind(self, name: str, value: Any, sample: Mapping[str, Any]) -> str | None:
        """Return the kind of a field, or of the field whose validity it is; None if it is not moved."""
        kind = kind_of(name, value, self.augmentation.fields, _OWNER, single=True)
        if kind is None and name.endswith(_VALID):
            name = name.removesuffix(_VALID)
            kind = kind_of(name, sample.get(name), self.augmentation.fields, _OWNER)
            kind = kind if kind not in IMAGES or np.ndim(value) > 1 else None  # a flag for each sample
        return kind

    def _entry(
        self, name: str, value: Any, sample: Mapping[str, Any], size: tuple[int, int] | None
    ) -> tuple[Sample, Callable[[Sample], Any]]:
        """Return a field as tensors, and a function that restores its layout."""
        kind = None if name in OWN or value is None else self._kind(name, value, sample)
        mirroring = self.augmentation.mirroring
        if kind is None and (mirroring is None or name not in mirroring.by_name):
            return {name: value}, lambda moved: moved[name]
        if kind not in IMAGES:
            value = _numbers(value, name, kind)
            tensor = as_tensor(value, name, _OWNER)
            return {name: tensor}, lambda moved: plain(moved[name]).astype(value.dtype, copy=False)
        many = isinstance(value, (list, tuple))
        if not many and name not in ALIASES:
            value = np.asarray(value, bool) if name.endswith(_VALID) else value
            return {name: as_planes(value, name, _OWNER, size)}, lambda moved: as_array(moved[name], value)
        key = f"{kind}_{name}"  # the augmentation knows a name that begins with a kind
        if not many and not len(value):  # only the size changes; an image has no channels
            empty = torch.from_numpy(value.reshape(value.shape[:3]))
            return {key: empty}, lambda moved: np.empty((*moved[key].shape, *value.shape[3:]), value.dtype)
        tensors = {f"{key}[{i}]": as_planes(one, f"{name}[{i}]", _OWNER, size) for i, one in enumerate(value)}
        to = list if many else np.stack
        return tensors, lambda moved: to([as_array(moved[k], one) for k, one in zip(tensors, value, strict=True)])


def _numbers(value: Any, name: str, kind: str | None) -> Any:
    """Return coordinates as floating point, flags as bool, and a list of numbers as an array."""
    if kind is None or name.endswith(_VALID):
        return np.asarray(value, bool if name.endswith(_VALID) else None)
    if isinstance(value, (list, tuple)):
        with contextlib.suppress(TypeError, ValueError):
            value = np.asarray(value, np.float32)
            value = value.reshape(0, *KINDS[kind].last[:1]) if not value.size and KINDS[kind].last else value
    return value.astype(np.float32) if isinstance(value, np.ndarray) and value.dtype.kind in "iub" else value
