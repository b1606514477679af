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
from camtorch.augment.fields import ALIASES, IMAGES, KINDS, OWN, kind_of
from camtorch.augment.front_end import FrontEnd, check_front_end
from camtorch.augment.sample import Sample, Single
from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.warp.arrays import as_array, as_planes, as_tensor, can_share, plain

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
        self.augmentation, self.camera, self._forms = augmentation, camera, Kept(16)

    def __call__(
        self,
        sample: Mapping[str, Any] | None = None,
        *,
        draw: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
        **fields: Any,
    ) -> Sample:
        """Augment a sample: keyword arguments, a dict, or both; see `Augmentation.forward` for the other arguments."""
        options = {"draw": draw, "generator": generator}
        return self._moved(self.augmentation.forward, sample, fields, options, self.camera)

    def inverse(
        self,
        sample: Mapping[str, Any] | None = None,
        *,
        draw: Mapping[str, Tensor] | None = None,
        camera: Camera | None = None,
        **fields: Any,
    ) -> Sample:
        """Move a sample back, see `Augmentation.inverse`: by the last call's change, or by `draw` and its `camera`."""
        options = {} if draw is None else {"draw": draw, "camera": self.camera if camera is None else camera}
        if draw is None and camera is not None:
            fields["camera"] = camera
        with torch.no_grad():  # as the camera before may learn
            return self._moved(self.augmentation.inverse, sample, fields, options)

    def __repr__(self) -> str:
        return f"Transform({self.augmentation!r})"

    def _moved(
        self, move: Callable[..., Sample], sample: Any, fields: Sample, options: Sample, otherwise: Camera | None = None
    ) -> Sample:
        if sample is not None and not isinstance(sample, Mapping):
            raise TypeError(
                f"{_OWNER}: sample must be a dict, or keywords as in transform(image=...); got {type(sample).__name__}"
            )
        sample = {**(sample or {}), **fields}
        if sample.get("camera") is None and otherwise is not None:
            sample["camera"] = otherwise
        camera = self.augmentation.camera if sample.get("camera") is None else sample["camera"]
        size = getattr(camera, "image_size", None)
        own, form = self.augmentation, _form_of(sample)
        options = {key: value for key, value in options.items() if value is not None}
        if form is not None:
            form = form, size, {**own.fields}, own.mirroring
            layouts = self._forms((), form, lambda: self._layouts(sample, size))
            if layouts is not None:
                learns = not isinstance(camera, Camera) or any(t.requires_grad for t in camera.tensors)
                return _moved_arrays(move, sample, options, layouts, learns)
        entries = {name: self._entry(name, value, sample, size) for name, value in sample.items()}
        inside = {key: tensor for tensors, _ in entries.values() for key, tensor in tensors.items()}
        with torch.no_grad():
            moved = move(Single(inside), **options)
        result = {name: to(moved) for name, (tensors, to) in entries.items() if tensors.keys() <= moved.keys()}
        for name in moved.keys() - inside.keys():
            value = plain(moved[name]) if isinstance(moved[name], Tensor) else moved[name]
            flat = name.endswith(_VALID) and self._kind(name, value, sample) in IMAGES
            result[name] = value[0] if flat else value
        return result

    def _layouts(self, sample: Sample, size: tuple[int, int] | None) -> list[tuple[str, int | None]] | None:
        """Return fields with the dims of image arrays, 0 for labels, None for others; None if a field needs more."""
        layouts: list[tuple[str, int | None]] = []
        mirroring = self.augmentation.mirroring
        for name, value in sample.items():
            kind = None if name in OWN or value is None else self._kind(name, value, sample)
            if kind is None and (mirroring is None or name not in mirroring.by_name):
                layouts.append((name, None))
            elif kind is None or name.endswith(_VALID) or not isinstance(value, np.ndarray) or not can_share(value):
                return None
            elif kind in IMAGES and name not in ALIASES:
                as_planes(value, name, _OWNER, size)
                layouts.append((name, value.ndim))
            elif kind not in IMAGES and value.dtype.kind == "f":
                layouts.append((name, 0))
            else:
                return None
        return layouts

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


def _form_of(sample: Sample) -> tuple[Any, ...] | None:
    """Return a key of all but the arrays' values; None if an array is read-only, or a value is of another kind."""
    parts: list[Any] = []
    for name, value in sample.items():
        if type(value) is np.ndarray:
            if not value.flags.writeable:
                return None
            parts += name, value.dtype, value.shape, value.strides
        elif value is None or isinstance(value, (str, int, float, Camera)):
            parts += name, type(value)
        else:
            return None
    return tuple(parts)


def _moved_arrays(
    move: Callable[..., Sample], sample: Sample, options: Sample, layouts: list[tuple[str, int | None]], learns: bool
) -> Sample:
    """Move a sample whose arrays torch can read without a copy; see `Transform._layouts`.

    learns: whether the camera may require grad; the sample is then moved without gradients.
    """
    given = Single()
    for name, dims in layouts:
        value = sample[name]
        if dims is not None:
            value = torch.from_numpy(value)
            value = value.permute(2, 0, 1) if dims == 3 else value[None] if dims == 2 else value
        given[name] = value
    with torch.no_grad() if learns else contextlib.nullcontext():
        moved = move(given, **options)
    result: Sample = {}
    for name, dims in layouts:
        if name in moved:
            value = moved[name] if dims is None else moved[name].numpy()
            result[name] = (
                np.ascontiguousarray(value.transpose(1, 2, 0)) if dims == 3 else value[0] if dims == 2 else value
            )
    for name, value in moved.items():
        if name not in given:
            value = value.numpy() if isinstance(value, Tensor) else value
            result[name] = value[0] if name.endswith(_VALID) and value.ndim == 3 else value
    return result


def _numbers(value: Any, name: str, kind: str | None) -> Any:
    """Return coordinates as floating point, flags as bool, and a list of numbers as an array."""
    if kind is None or name.endswith(_VALID):
        return np.asarray(value, bool if name.endswith(_VALID) else None)
    if isinstance(value, (list, tuple)):
        with contextlib.suppress(TypeError, ValueError):
            value = np.asarray(value, np.float32)
            value = value.reshape(0, *KINDS[kind].last[:1]) if not value.size and KINDS[kind].last else value
    return value.astype(np.float32) if isinstance(value, np.ndarray) and value.dtype.kind in "iub" else value
