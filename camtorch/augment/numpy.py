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
from camtorch.augment.sample import IMAGES, KINDS, OWN, Sample, Single, check, kind_of
from camtorch.camera import Camera

Array: TypeAlias = "np.ndarray[Any, Any]"
Restore = Callable[[list[Tensor], tuple[int, int]], Any]
_OWNER = "numpy.Transform"
_SEEN = "image_valid"
_FEW = 4  # channels
_MOST_FORMS = 64  # of fields whose way is remembered


class Transform:
    """An augmentation, or a `FaceNormalizer`, of one sample of numpy arrays.

    The fields are those of `Augmentation`, without their batch dim, and images have their channels last:

    * `image` (H, W, C) or (H, W), of any real dtype, usually uint8, uint16 or float32; `mask`, `depth`, `distance`
      likewise. `images` and `masks` are lists of such, or arrays (N, H, W) or (N, H, W, C). Three channels are red,
      green, blue, which matters to chromatic aberration only.
    * `keypoints` (N, 2), or OpenCV's (N, 1, 2); `bboxes` or `boxes` (M, 4) as x1 y1 x2 y2; both in pixels with
      the centre of the top-left one at (0, 0). Boxes between pixel edges, albumentations' "pascal_voc", are these
      plus 0.5.
    * `gaze` (3,), `head_pose` (4, 4), `rvec` (3,), `tvec` (3,), `points` (N, 3), and all other fields.
    * `camera`: the camera of the images, unless this or the augmentation has one. Edits need none.

    Whatever is no field is passed on as it is. All arrays come out with the layout and the dtype that they came in
    with, but coordinates of whole numbers come out in float32. Beside them come `keypoints_valid` (N,), `bboxes_valid`
    (M,) and so on, bool, the new `camera`, and `rotation` (3, 3). Nothing is ever dropped or sorted: what left the
    image has a False there. Pipelines of albumentations, with their `bbox_params` and `keypoint_params`, take the
    `Transform` of `camtorch.augment.albumentations`.

    Numbers are drawn from torch's generator, `torch.manual_seed`, which DataLoader seeds differently in each of its
    workers, and not from numpy's. The same seed draws the same in every front end. Nothing is differentiated.

    Args:
        augmentation: what to do.
        camera: of samples that hold none; by default the augmentation's.

    Raises:
        TypeError: it is no augmentation; a camera that is none.
    """

    def __init__(self, augmentation: Augmentation | FaceNormalizer, camera: Camera | None = None):
        self.camera = check_front_end(_OWNER, augmentation, camera, Augmentation, FaceNormalizer)
        self.augmentation = augmentation
        self._ways: dict[Any, Callable[[str, Array], tuple[dict[str, Tensor], Restore]]] = {}

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
        sample = {**(sample or {}), **fields}
        if otherwise is not None and sample.get("camera") is None:
            sample["camera"] = otherwise
        inside = Single()
        entries: dict[str, tuple[dict[str, Tensor], Restore | None]] = {}
        camera = sample.get("camera")
        size = getattr(self.augmentation._held("camera") if camera is None else camera, "image_size", None)
        context = size, *self.augmentation.fields.items()
        for name, value in sample.items():
            is_array = isinstance(value, np.ndarray)
            form = (name, value.dtype, value.shape, *context) if is_array else None
            way = self._ways.get(form)
            entries[name] = way(name, value) if way else self._entry(name, value, sample, size, form)
            tensors, restore = entries[name]
            inside.update({name: value} if restore is None else tensors)
        with torch.no_grad():
            moved = move(inside, **{key: value for key, value in options.items() if value is not None})
        after: Any = moved.get("camera")
        if after is None and isinstance(self.last, Change):
            after = self.last.parts[0].target
        result = {}
        for name, (tensors, restore) in entries.items():
            if restore is not None and tensors.keys() <= moved.keys():
                result[name] = restore([moved.pop(key) for key in tensors], after.image_size)
            elif name in moved:
                result[name] = moved.pop(name)
        for name, value in moved.items():
            value = _plain(value) if isinstance(value, Tensor) else value
            result[name] = value[0] if name == _SEEN else value
        return result

    def _entry(
        self, name: str, value: Any, sample: Mapping[str, Any], size: tuple[int, int] | None, form: Any
    ) -> tuple[dict[str, Tensor], Restore | None]:
        """Return a field as tensors, and what gives them, and a new image_size, their layout back; or None."""
        if name in OWN or value is None:
            return {}, None
        if name == _SEEN or (name.endswith("_valid") and name.removesuffix("_valid") in sample):
            valid = _tensor(np.asarray(value, dtype=bool))
            if name == _SEEN:
                return {name: valid[None]}, lambda moved, size: moved[0][0].cpu().numpy()
            return {name: valid}, lambda moved, size: moved[0].cpu().numpy()
        kind = kind_of(name, value, self.augmentation.fields, _OWNER)
        if kind is None:
            mirroring = self.augmentation.mirroring
            if mirroring is None or name not in mirroring.by_name:
                return {}, None
            return {name: _tensor(_checked(name, np.asarray(value)))}, lambda moved, size: moved[0].cpu().numpy()
        if kind not in IMAGES:
            numbers = _checked(name, _numbers(value, kind))
            check(kind, name, _tensor(numbers), False, _OWNER)
            if numbers is value:
                self._remember(form, _labels)
            return _labels(name, numbers)
        many = isinstance(value, (list, tuple))
        if not many and name not in ("images", "masks"):
            as_tensor(name, value, size)
            self._remember(form, _image)
            return _image(name, value)
        # names that begin with their kind are known to the augmentation
        tensors = {f"{kind}_{name}[{i}]": as_tensor(f"{name}[{i}]", one, size) for i, one in enumerate(value)}

        def restore(moved: list[Tensor], size: tuple[int, int]) -> Any:
            arrays = [as_array(image, one) for image, one in zip(moved, value, strict=True)]
            if many:
                return arrays
            return np.stack(arrays) if arrays else np.zeros((0, *size, *value.shape[3:]), value.dtype)

        return tensors, restore

    def _remember(self, form: Any, way: Callable[[str, Array], tuple[dict[str, Tensor], Restore]]) -> None:
        if len(self._ways) >= _MOST_FORMS:
            self._ways.clear()
        self._ways[form] = way


def _labels(name: str, array: Array) -> tuple[dict[str, Tensor], Restore]:
    return {name: _tensor(array)}, lambda moved, size: _plain(moved[0]).astype(array.dtype, copy=False)


def _image(name: str, array: Array) -> tuple[dict[str, Tensor], Restore]:
    return {name: _planes(array)}, lambda moved, size: as_array(moved[0], array)


def _plain(tensor: Tensor) -> Array:
    return tensor.numpy() if tensor.is_cpu else tensor.cpu().numpy()


def _planes(array: Array) -> Tensor:
    """(C, H, W) of an array (H, W, C) or (H, W)."""
    tensor = _tensor(array)
    return tensor.permute(2, 0, 1) if array.ndim == 3 else tensor[None]


def _numbers(value: Any, kind: str) -> Any:
    """Coordinates of floating point; a list of numbers is taken for an array."""
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
    return _planes(array)


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
