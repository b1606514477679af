"""Augmentations for numpy arrays, called as those of albumentations are: one sample of keyword arguments.

    transform = camtorch.augment.numpy.Transform(camtorch.augment.RandomMount(yaw=20))
    out = transform(image=image, mask=mask, keypoints=points, bboxes=boxes, gaze=gaze, camera=camera)

The module is imported by name: `import camtorch.augment.numpy`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.augmentation import Augmentation, check_front_end
from camtorch.augment.change import Change
from camtorch.augment.face import FaceNormalizer
from camtorch.augment.sample import _ALIASES, IMAGES, KINDS, OWN, Sample, Single, kind_of
from camtorch.camera import Camera

Array: TypeAlias = "np.ndarray[Any, Any]"
_OWNER = "numpy.Transform"
_VALID = "_valid"
_FEW = 4  # channels


class Transform:
    """An augmentation, or a `FaceNormalizer`, of one sample of numpy arrays.

    The fields are those of `Augmentation`, by the same names and without their batch dim:

    * Images, masks and depth have their channels last, (H, W, C) or (H, W), and any real dtype. Under a plural name
      they are lists of such arrays, or one array (N, H, W) or (N, H, W, C).
    * Labels have the shape of a single sample, with several faces too. Lists of numbers are taken for arrays. Pixels
      have the centre of the top-left one at (0, 0); boxes of albumentations' "pascal_voc" are these plus 0.5.
    * The camera of the images is in the sample, or given to this or the augmentation. Edits need none.

    Everything else is passed on; unknown names that hold numbers are refused, as by `Augmentation`. Arrays come out in
    the layout and the dtype that they had, coordinates of whole numbers in float32. Validity, the new `camera` and
    `rotation` (3, 3) come out as well. Nothing is dropped or sorted. For pipelines with `bbox_params` and
    `keypoint_params`, use the `Transform` of `camtorch.augment.albumentations`.

    Numbers are drawn from torch's generator, `torch.manual_seed`, which DataLoader seeds differently in each of its
    workers, and not from numpy's. The same seed draws the same in every front end. Nothing is differentiated.

    Args:
        augmentation: what to do.
        camera: of samples that hold none; by default the augmentation's.

    Raises:
        TypeError: If it is no augmentation, or the camera is none.
    """

    def __init__(self, augmentation: Augmentation | FaceNormalizer, camera: Camera | None = None):
        self.camera = check_front_end(_OWNER, augmentation, camera, Augmentation, FaceNormalizer)
        self.augmentation = augmentation

    def __call__(
        self,
        sample: Mapping[str, Any] | None = None,
        *,
        draw: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
        **fields: Any,
    ) -> Sample:
        """Augment a sample, keyword arguments, or a dict, or both; arguments are those of `Augmentation.forward`."""
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
        return self._moved(self.augmentation.inverse, sample, fields, options)

    @property
    def last(self) -> Change | None:
        """The change of the last call: its `source`, `target` and `rotation`."""
        return getattr(self.augmentation, "last", None)

    def __repr__(self) -> str:
        return f"Transform({self.augmentation!r})"

    def _moved(
        self, move: Callable[..., Sample], sample: Any, fields: Sample, options: Sample, otherwise: Camera | None = None
    ) -> Sample:
        if sample is not None and not isinstance(sample, Mapping):
            raise TypeError(
                f"{_OWNER}: the fields go in by name, as in transform(image=...); got {type(sample).__name__}"
            )
        sample = {**({} if sample is None else sample), **fields}
        if otherwise is not None and sample.get("camera") is None:
            sample["camera"] = otherwise
        entries = {}
        camera = sample.get("camera")
        size = getattr(self.augmentation._held("camera") if camera is None else camera, "image_size", None)
        for name, value in sample.items():
            entries[name] = self._entry(name, value, sample, size)
        inside = {key: tensor for tensors, _ in entries.values() for key, tensor in tensors.items()}
        with torch.no_grad():
            moved = move(Single(inside), **{key: value for key, value in options.items() if value is not None})
        result = {name: to(moved) for name, (tensors, to) in entries.items() if tensors.keys() <= moved.keys()}
        for name, value in moved.items():
            if name not in inside:
                value = _plain(value) if isinstance(value, Tensor) else value
                flat = name.endswith(_VALID) and self._kind(name, value, sample) in IMAGES
                result[name] = value[0] if flat else value
        return result

    def _kind(self, name: str, value: Any, sample: Mapping[str, Any]) -> str | None:
        """Return the kind of a field, or of the field whose validity this is; None if it stays."""
        kind = kind_of(name, value, self.augmentation.fields, _OWNER)
        if kind is None and name.endswith(_VALID):
            name = name.removesuffix(_VALID)
            kind = kind_of(name, sample.get(name), self.augmentation.fields, _OWNER)
            kind = kind if kind not in IMAGES or np.ndim(value) > 1 else None  # a flag for each sample
        return kind

    def _entry(
        self, name: str, value: Any, sample: Mapping[str, Any], size: tuple[int, int] | None
    ) -> tuple[Sample, Callable[[Sample], Any]]:
        """Return a field as tensors, and what gives them their layout back."""
        kind = None if name in OWN or value is None else self._kind(name, value, sample)
        mirroring = self.augmentation.mirroring
        if kind is None and (mirroring is None or name not in mirroring.by_name):
            return {name: value}, lambda moved: moved[name]
        if kind not in IMAGES:
            array = _checked(name, _numbers(value, name, kind))
            return {name: _tensor(array)}, lambda moved: _plain(moved[name]).astype(array.dtype, copy=False)
        many = isinstance(value, (list, tuple))
        if not many and name not in _ALIASES:
            value = np.asarray(value, bool) if name.endswith(_VALID) else value
            return {name: as_tensor(name, value, size)}, lambda moved: as_array(moved[name], value)
        key = f"{kind}_{name}"  # which begins with its kind, and is known to the augmentation
        if not many and not len(value):  # what changes is the size, of an image without channels
            empty = _tensor(value.reshape(value.shape[:3]))
            return {key: empty}, lambda moved: np.empty((*moved[key].shape, *value.shape[3:]), value.dtype)
        parts = {f"{key}[{i}]": (f"{name}[{i}]", one) for i, one in enumerate(value)}
        tensors = {key: as_tensor(*part, size) for key, part in parts.items()}
        to = list if many else np.stack
        return tensors, lambda moved: to([as_array(moved[key], one) for key, (_, one) in parts.items()])


def _plain(tensor: Tensor) -> Array:
    return tensor.numpy() if tensor.is_cpu else tensor.cpu().numpy()


def _numbers(value: Any, name: str, kind: str | None) -> Any:
    """Coordinates of floating point, flags of bool; a list of numbers is taken for an array."""
    if name.endswith(_VALID):
        return np.asarray(value, bool)
    if kind is None:
        return np.asarray(value)
    if isinstance(value, (list, tuple)):
        try:
            value = np.asarray(value, np.float32)
        except (TypeError, ValueError):
            return value
        last = KINDS[kind].last
        value = value if value.size or not last else value.reshape(0, last[0])
    return value.astype(np.float32) if isinstance(value, np.ndarray) and value.dtype.kind in "iub" else value


def as_tensor(name: str, value: object, size: tuple[int, int] | None = None) -> Tensor:
    """(C, H, W) of an array (H, W, C) or (H, W), which should be of that size."""
    array = _checked(name, value)
    shape = array.shape
    if len(shape) not in (2, 3):
        raise ValueError(f"{_OWNER}: {name} must be (H, W, C) or (H, W); got shape {shape}")
    if size == shape[1:] and size != shape[:2]:
        raise ValueError(
            f"{_OWNER}: {name} must be (H, W, C) or (H, W); got shape {shape}, which has its channels first: "
            "np.moveaxis(image, 0, -1) puts them last"
        )
    tensor = _tensor(array)
    return tensor.permute(2, 0, 1) if array.ndim == 3 else tensor[None]


def as_array(image: Tensor, like: Array) -> Array:
    """An image (C, H, W) in the layout and the dtype of an array: itself, if its channels come last in memory too."""
    planes = _plain(image.detach() if image.requires_grad else image)
    return np.ascontiguousarray(planes.transpose(1, 2, 0) if like.ndim == 3 else planes[0], like.dtype)


def _checked(name: str, value: object) -> Array:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        what = f"dtype {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        hint = f"; np.array({name}) makes one of it" if hasattr(value, "__array_interface__") else ""
        raise TypeError(f"{_OWNER}: {name} must be a numpy array of real numbers; got {what}{hint}")
    return value


class _Lent:
    """The memory of a read-only array, as what may be written to: torch warns of all else, which it would only read."""

    def __init__(self, array: Array):
        self.array = array  # whose memory lasts as long as this
        interface = array.__array_interface__
        self.__array_interface__ = {**interface, "data": (interface["data"][0], False)}


def _tensor(array: Array) -> Tensor:
    """A tensor in the memory of an array, where torch can read it there; for reading alone."""
    if array.flags.carray and array.dtype.isnative and array.itemsize <= 8 and min(array.strides, default=0) >= 0:
        return torch.from_numpy(array)
    # torch takes neither other byte orders nor long doubles, nor strides that are negative or end within a number
    dtype = array.dtype.newbyteorder("=") if array.dtype.itemsize <= 8 else np.dtype(np.float64)
    flags, steps = array.flags, array.strides
    # a dim of one, which may run backwards, leaves an array contiguous
    whole = flags.aligned and all(step >= 0 and step % array.itemsize == 0 for step in steps)
    if array.dtype != dtype or not whole:
        return torch.from_numpy(_dense(array, dtype))
    return torch.from_numpy(array if flags.writeable else np.asarray(_Lent(array)))


def _dense(array: Array, dtype: np.dtype[Any]) -> Array:
    """A copy without gaps."""
    copy = np.empty(array.shape, dtype)
    if array.ndim == 3 and array.shape[-1] <= _FEW and min(array.strides[1:]) < 0:
        # of pixels that run backwards, or whose channels do: all at once would take three times as long
        for channel in range(array.shape[-1]):
            copy[..., channel] = array[..., channel]
    else:
        copy[...] = array
    return copy
