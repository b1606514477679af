"""Augmentations for numpy arrays, called like those of albumentations: one sample of keyword arguments.

    transform = camtorch.augment.numpy.Transform(camtorch.augment.RandomMount(yaw=20))
    out = transform(image=image, mask=mask, keypoints=points, bboxes=boxes, gaze=gaze, camera=camera)

The module is imported by name: `import camtorch.augment.numpy`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.augmentation import Augmentation
from camtorch.augment.face import FaceNormalizer
from camtorch.augment.fields import IMAGES, KEEP, KINDS, PLACE
from camtorch.augment.front_end import FrontEnd, check_front_end
from camtorch.augment.names import ALIASES, kind_of, refuse_unknown
from camtorch.augment.sample import Sample, Single, refuse_options
from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.warp.arrays import as_array, as_planes, as_tensor, can_share, plain

_OWNER = "numpy.Transform"
_VALID = "_valid"


class Way(NamedTuple):
    """How the fields of a form are read, and written as they were given."""

    read: Callable[[Any], Sample]  # value -> tensors by name
    write: Callable[[Sample, Any], Any]  # (moved sample, value as given) -> value


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
        camera: for samples that hold none; default: the augmentation's. It is copied, and does not learn. A number is
            for photographs of unknown cameras, see `Augmentation`.

    Raises:
        TypeError: If augmentation is no augmentation, or camera is no Camera.
    """

    _name = _OWNER
    augmentation: Augmentation | FaceNormalizer
    camera: Camera | float | None

    def __init__(self, augmentation: Augmentation | FaceNormalizer, camera: Camera | float | None = None):
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
        refuse_options(fields, type(self.augmentation).__name__)
        tensors, write = self._read(sample, fields, self.camera)
        options = _set(draw=draw, generator=generator)
        if options and isinstance(self.augmentation, FaceNormalizer):
            raise TypeError(f"{_OWNER}: draw and generator must be None for a FaceNormalizer, as it draws nothing")
        with torch.no_grad():
            return write(self.augmentation.forward(tensors, **options))

    def inverse(
        self,
        sample: Mapping[str, Any] | None = None,
        *,
        draw: Mapping[str, Tensor] | None = None,
        camera: Camera | None = None,
        **fields: Any,
    ) -> Sample:
        """Move a sample back, see `Augmentation.inverse`: by the last call's change, or by `draw` and its `camera`."""
        options = {} if draw is None else _set(draw=draw, camera=self.camera if camera is None else camera)
        if draw is None and camera is not None:
            fields["camera"] = camera
        with torch.no_grad():  # as the camera before may learn
            tensors, write = self._read(sample, fields)
            return write(self.augmentation.inverse(tensors, **options))

    def __repr__(self) -> str:
        return f"Transform({self.augmentation!r})"

    def _read(
        self, sample: Any, fields: Sample, otherwise: Camera | float | None = None
    ) -> tuple[Single, Callable[[Sample], Sample]]:
        """Return a sample as the augmentation takes it, and the function that writes a moved one as it was given."""
        if sample is not None and not isinstance(sample, Mapping):
            raise TypeError(
                f"{_OWNER}: sample must be a dict, or keywords as in transform(image=...); got {type(sample).__name__}"
            )
        sample = {**(sample or {}), **fields}
        camera = sample.get("camera")
        if camera is None and otherwise is not None:
            camera = sample["camera"] = otherwise
        ways = self._ways(sample, camera)
        tensors = Single()
        for name, way in ways.items():
            tensors.update(way.read(sample[name]))

        def write(moved: Sample) -> Sample:
            lost = tensors.keys() - moved.keys()  # a face is moved back without its rotation
            result = {}
            for name, way in ways.items():
                if name not in lost:
                    result[name] = way.write(moved, sample[name])
            for name, value in moved.items():
                if tensors.get(name) is None or name == PLACE:
                    value = plain(value) if isinstance(value, Tensor) else value
                    result[name] = value[0] if name.endswith(_VALID) and value.ndim == 3 else value
            return result

        return tensors, write

    def _kind(self, name: str, value: Any, sample: Mapping[str, Any]) -> str | None:
        """Return the kind of a field, or of the field whose validity it is; see `kind_of`."""
        kind = kind_of(name, value, self.augmentation.fields, _OWNER)
        if kind not in KINDS and name.endswith(_VALID):
            name = name.removesuffix(_VALID)
            kind = kind_of(name, sample.get(name), self.augmentation.fields, _OWNER)
            if kind in IMAGES and np.ndim(value) <= 1:  # a flag for each sample
                return KEEP
        return kind

    def _ways(self, sample: Sample, camera: Any) -> dict[str, Way]:
        """Return the way of each field, which are kept by the form of the sample."""
        form, own = _form_of(sample), self.augmentation
        if form is None:
            return self._new_ways(sample, camera)
        key = form, own.mirroring, *own.fields.items()
        ways: dict[str, Way] = self._forms.get((), key, self._new_ways, sample, camera)
        return ways

    def _new_ways(self, sample: Sample, camera: Any) -> dict[str, Way]:
        """Return the way of each field, which its form alone decides: of images, of one, of numbers, or of all else."""
        refuse_unknown(sample, self.augmentation.fields, _OWNER, single=True)
        ways, mirroring = dict[str, Way](), self.augmentation.mirroring
        size = getattr(self.augmentation.camera if camera is None else camera, "image_size", None)
        for name, value in sample.items():
            kind = None if value is None else self._kind(name, value, sample)
            if kind in IMAGES and (name in ALIASES or isinstance(value, (list, tuple))):
                ways[name] = _way_of_images(name, value, size, kind)
            elif kind in IMAGES:
                ways[name] = _way_of_image(name, value, size)
            elif kind in KINDS or (mirroring is not None and name in mirroring.by_name):
                ways[name] = _way_of_numbers(name, value, kind)
            else:
                ways[name] = _way_of_others(name)
        return ways


def _way_of_others(name: str) -> Way:
    return Way(lambda given: {name: given}, lambda moved, given: moved[name])


def _way_of_numbers(name: str, value: Any, kind: str | None) -> Way:
    """Return the way of labels, of flags, and of orders of landmarks, which have no kind."""
    if kind in KINDS and _is_shared(name, value) and value.dtype.kind == "f":
        return Way(lambda given: {name: torch.from_numpy(given)}, lambda moved, given: moved[name].numpy())

    def read(given: Any) -> Sample:
        return {name: as_tensor(_numbers(given, name, kind), name, _OWNER)}

    def write(moved: Sample, given: Any) -> Any:
        return plain(moved[name]).astype(_numbers(given, name, kind).dtype, copy=False)

    return Way(read, write)


def _way_of_image(name: str, value: Any, size: tuple[int, int] | None) -> Way:
    """Return the way of an array (H, W) or (H, W, C) of an image, a mask or a depth, or of its flags."""
    are_flags = name.endswith(_VALID)

    def read(given: Any) -> Sample:
        return {name: as_planes(np.asarray(given, bool) if are_flags else given, name, _OWNER, size)}

    def write(moved: Sample, given: Any) -> Any:
        return as_array(moved[name], np.asarray(given, bool) if are_flags else given)

    read(value)  # raises if it is none
    if not _is_shared(name, value):
        return Way(read, write)
    if value.ndim == 2:
        return Way(lambda given: {name: torch.from_numpy(given)[None]}, lambda moved, given: moved[name].numpy()[0])
    return Way(lambda given: {name: torch.from_numpy(given).permute(2, 0, 1)}, write)


def _way_of_images(name: str, value: Any, size: tuple[int, int] | None, kind: str | None) -> Way:
    """Return the way of several such arrays, in a list or in an array (N, H, W) or (N, H, W, C)."""
    key, is_list = f"{kind}_{name}", isinstance(value, (list, tuple))  # a name that begins with a kind is known
    if not is_list and not len(value):  # only the size changes; an image has no channels
        return Way(
            lambda given: {key: torch.from_numpy(given.reshape(given.shape[:3]))},
            lambda moved, given: np.empty((*moved[key].shape, *given.shape[3:]), given.dtype),
        )

    def read(given: Any) -> Sample:
        return {f"{key}[{i}]": as_planes(one, f"{name}[{i}]", _OWNER, size) for i, one in enumerate(given)}

    def write(moved: Sample, given: Any) -> Any:
        images = [as_array(moved[f"{key}[{i}]"], one) for i, one in enumerate(given)]
        return images if is_list else np.stack(images)

    return Way(read, write)


def _is_shared(name: str, value: Any) -> bool:
    """Whether torch reads an array's memory as it is: the next samples of the form are then read without questions."""
    return isinstance(value, np.ndarray) and not name.endswith(_VALID) and value.flags.writeable and can_share(value)


def _set(**options: Any) -> Sample:
    """Return the options that are not None."""
    return {name: value for name, value in options.items() if value is not None}


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


def shaped_if_empty(array: Any, kind: str | None) -> Any:
    """Return an array; one without numbers in the shape of no values of a kind, as (0, 2) for keypoints."""
    if array.size or kind not in KINDS or not KINDS[kind].ends:
        return array
    rows = max(KINDS[kind].dims - 1, 1)
    return array.reshape(*(0,) * rows, KINDS[kind].ends[0][-1])


def _numbers(value: Any, name: str, kind: str | None) -> Any:
    """Return coordinates as floating point, flags as bool, and a list of numbers as an array."""
    if kind not in KINDS or name.endswith(_VALID):
        return np.asarray(value, bool if name.endswith(_VALID) else None)
    if isinstance(value, (list, tuple)):
        with contextlib.suppress(TypeError, ValueError):
            value = shaped_if_empty(np.asarray(value, np.float32), kind)
    return value.astype(np.float32) if isinstance(value, np.ndarray) and value.dtype.kind in "iub" else value
