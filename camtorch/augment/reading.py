"""What is read of a sample before it moves: its fields by their kinds, checked, and its cameras."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.fields import FRONT_ENDS, IMAGES, KEEP, KINDS, Named
from camtorch.augment.names import kind_of, refuse_unknown
from camtorch.cameras.camera import Camera
from camtorch.evaluate.door import is_cheap_to_read
from camtorch.evaluate.tensors import known_true
from camtorch.values.arguments import warn
from camtorch.values.dtypes import check_averaged
from camtorch.warp import arrays
from camtorch.warp.warp import as_sized

_OFF = 0.1  # of the image's sides: keypoints so far outside of it are not of it
_RANKS = {kind: (not field.tells_batches, i) for i, (kind, field) in enumerate(KINDS.items())}
"""Kinds that tell a batch from a sample first, then in the order of `KINDS`."""


def moving(sample: Mapping[str, Any], fields: Mapping[str, str], owner: str) -> Named:
    """Return the fields that move, at least one; fields: name -> kind, of other names.

    Raises a ValueError for a field of unknown name that may be geometry, with a dim B or without it.
    """
    refuse_unknown(sample, fields, owner, single=False)
    named: Named = {}
    for name, value in sample.items():
        kind = None if value is None else kind_of(name, value, fields, owner)
        if kind is None or kind == KEEP:
            continue
        if isinstance(value, (list, tuple)):
            named[name] = kind, [as_tensor(item, f"{name}[{i}]", kind, owner) for i, item in enumerate(value)]
        else:
            named[name] = kind, as_tensor(value, name, kind, owner)
    if not named:
        raise ValueError(f"{owner}: the sample must have a field that moves; got none of {', '.join(KINDS)}")
    return named


def check_shapes(named: Named, batched: bool, has_frames: bool, owner: str) -> int:
    """Raise if the shape of a field is wrong; return the number of samples.

    has_frames: whether values of a single sample may have leading dims.
    """
    count = -1
    for name, (kind, value) in named.items():
        several = isinstance(value, list)
        for which, item in _items(name, value):
            more = item.ndim - KINDS[kind].most_dims
            frame = item.new_empty(item.shape[more:]) if more > 0 and has_frames else item
            check_shape(kind, which, frame, batched and not several, owner)
        rows = len(value) if batched or several else 1
        count = rows if count < 0 else count
        if rows != count:
            raise ValueError(f"{owner}: {name} must be of {count} samples, as other fields; got {rows}")
    return count


def check_values(sample: Mapping[str, Any], named: Named, mode: str, owner: str) -> None:
    """Raise if the values of a field are wrong, and warn if they seem to be; mode: how images are sampled."""
    images = [value for kind, value in named.values() if kind == "image"]
    size = images[0][0].shape[-2:] if images and len(images[0]) else ()
    for name, (kind, value) in named.items():
        given, check = sample.get(f"{name}_valid"), KINDS[kind].check
        for i, (which, item) in enumerate(_items(name, value)):
            if check is not None:
                check(item, which, owner)
            if kind == "image":
                check_averaged(item, mode, which, owner)
            if len(size) == 2:
                flags = given
                if isinstance(value, list) and given is not None:
                    flags = given[i] if i < len(given) else ()
                warn_of_numbers(kind, which, item, flags, size, owner)


def _items(name: str, value: Any) -> list[tuple[str, Tensor]]:
    """Return the tensors of a field, with their names in errors: one, or those of a list."""
    return [(f"{name}[{i}]", item) for i, item in enumerate(value)] if isinstance(value, list) else [(name, value)]


def check_cameras(camera: object, count: int, named: Named, owner: str) -> None:
    """Raise a ValueError unless a camera, or a list of some, are those of images of `count` samples."""
    several = isinstance(camera, (list, tuple))
    cameras: list[Any] = list(camera) if several else [camera]  # type: ignore[call-overload]
    if not cameras:
        raise ValueError(
            f"{owner}: camera must be a camera or a list of some; got an empty list. Samples may be none with one "
            "camera"
        )
    if several and len(cameras) != count:
        raise ValueError(f"{owner}: camera must have one for each of {count} samples; got {len(cameras)}")
    images = [(name, value) for name, (found, value) in named.items() if found in IMAGES]
    for i, one in enumerate(cameras):
        name = f"camera[{i}]" if several else "camera"
        shape = tuple(as_sized(one, name, owner).batch_shape)
        if shape not in ((), (1,), (count,)) or (shape and len(cameras) > 1):
            hint = f". Flatten cameras (B, N) to (B N): {name}=ct.cat(list(camera))" if len(shape) == 2 else ""
            raise ValueError(f"{owner}: {name} must have no batch dims, or those of {count} samples; got {shape}{hint}")
        for field, value in images:
            shapes = [v.shape for v in value] if isinstance(value, list) else [value.shape]
            if several and isinstance(value, list):
                shapes = shapes[i : i + 1]
            for of_image in shapes:
                _check_size(field, tuple(of_image), name, one.image_size, owner)
    check_one_size("camera", {one.image_size for one in cameras}, owner)


def check_one_size(name: str, sizes: set[tuple[int, int]], owner: str) -> None:
    """Raise a ValueError if the images of a batch, or their cameras, are of several sizes."""
    if len(sizes) > 1:
        raise ValueError(
            f"{owner}: the images of a batch must be of one size; got {name} of {sorted(sizes)} (height, width). Give "
            "the samples one by one, as a DataLoader's workers do, or resize them before"
        )


def _check_size(field: str, shape: tuple[int, ...], name: str, size: tuple[int, int], owner: str) -> None:
    if shape[-2:] == size:
        return
    if shape[-3:-1] == size:
        to = "0, 3, 1, 2" if len(shape) == 4 else "2, 0, 1"
        raise ValueError(
            f"{owner}: {field} must have its channels first; got {shape}, with the channels last. Pass "
            f"{field}.permute({to}), of an array {field}.transpose({to}); camtorch.augment.numpy takes arrays as they "
            "are"
        )
    raise ValueError(
        f"{owner}: {field} must be of {name}'s image_size {size}; got {shape[-2:]} (height, width). camera.resize, "
        ".crop and .pad give the camera of an edited image"
    )


def as_tensor(value: object, name: str, kind: str, owner: str) -> Tensor:
    """Return the value of a field as a tensor of real numbers."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        value = arrays.as_tensor(value, name, owner)
    if not isinstance(value, Tensor) or value.dtype.is_complex:
        what = f"dtype {value.dtype}" if isinstance(value, (Tensor, np.ndarray)) else type(value).__name__
        hint = _hint(name)
        if isinstance(value, (list, tuple, int, float)):
            hint = ". Plain numbers go in as torch.tensor(numbers); a list has a tensor for each sample"
        elif kind == "image" and hasattr(value, "mode"):
            hint = f". {FRONT_ENDS}"
        raise TypeError(f"{owner}: {name} must be a tensor of real numbers, {KINDS[kind].shape}; got {what}{hint}")
    if kind not in IMAGES and not value.dtype.is_floating_point:
        value = value.to(torch.get_default_dtype())  # whole pixels do not stay whole
    return value


def _hint(name: str) -> str:
    return "" if name in KINDS else f". If it is something else, fields={{{name!r}: '{KEEP}'}} keeps it unchanged"


def check_shape(kind: str, name: str, value: Tensor, batched: bool, owner: str) -> None:
    """Raise a ValueError if a kind does not take this shape."""
    field, shape = KINDS[kind], tuple(value.shape)
    fits = not field.ends or any(shape[-len(end) :] == end for end in field.ends)
    if not fits or not field.dims <= len(shape) - batched <= field.most_dims:
        what = field.shape if batched else field.shape.replace("(B, ", "(")
        hint = "" if field.hint is None else field.hint(value, name, batched)
        hint = f". {hint}" if hint else _hint(name)
        raise ValueError(f"{owner}: {name} must be {what}; got shape {shape}{hint}")


def warn_of_numbers(kind: str, name: str, value: Tensor, flags: Any, size: Sequence[int], owner: str) -> None:
    """Warn of labels that seem to be parts of an image's sides, of an image of another size, or to mean "not seen"."""
    if not KINDS[kind].in_pixels or not value.is_cpu:
        return
    are_points = value.shape[-1] == 2
    pixels = value[..., :2] if value.shape[-1] == 3 else value
    if are_points and _are_off(value, flags, size):
        warn(
            f"{owner}: {name} must be pixels of the image, of (height, width) = {tuple(size)}; got most of them far "
            "outside of it, as of an image of another size. Scale x by (x + 0.5) * width / old width - 0.5, and so y. "
            f"For points that are not seen pass NaN, or {name}_valid=..., a flag for each"
        )
    if are_points and flags is None and known_true((pixels == -1).all(-1).any()):
        warn(
            f"{owner}: {name} has points at (-1, -1), which move as any pixels. If these are not seen, pass NaN, or "
            f"{name}_valid=..., a flag for each"
        )
    if value.numel() <= 3 or not known_true((pixels == pixels.clamp(0, 1)).all() & (pixels % 1 != 0).any()):
        return
    if value.shape[-1] != 3:
        form = "pixels" if are_points else KINDS[kind].shape.partition(") ")[2]
        of = " from x and y" if kind.startswith("boxes_") else ""
        warn(
            f"{owner}: {name} must be {form}; got values within [0, 1], as parts of an image's sides. Multiply them by "
            f"width and height, and subtract 0.5{of}"
        )
    elif known_true((value[..., 2] <= 0).any()):
        warn(
            f"{owner}: {name} must be points of the camera frame, in front of it; got x and y within [0, 1] and z of 0 "
            f"or less, as a detector's. Pass pixels, {name}[..., :2] times width and height, less 0.5"
        )


def _are_off(points: Tensor, flags: Any, size: Sequence[int]) -> bool:
    """Whether most points (..., 2), of those that are seen, are off the image by more than a tenth of its sides."""
    if not points.numel() or not is_cheap_to_read(points):
        return False
    pixels, sides = points.detach().reshape(-1, 2), (size[1], size[0])
    ends = zip(pixels.amin(0).tolist(), pixels.amax(0).tolist(), sides, strict=True)
    if all(-_OFF * side < low and high < (1 + _OFF) * side - 1 for low, high, side in ends):  # as in most samples
        return False
    seen = torch.isfinite(pixels).all(-1)
    if flags is not None:
        given = torch.as_tensor(flags).reshape(-1)
        seen = seen & (given != 0) if len(given) == len(seen) else seen
    off = ((pixels + 0.5) / pixels.new_tensor(sides) - 0.5).abs().amax(-1) > 0.5 + _OFF
    return int((off & seen).sum()) > int(seen.sum()) / 2


def is_batch(named: Named, camera: object) -> bool:
    """Whether `named` is a batch, by its first image, pixels, boxes or pose, else by cameras, else any field."""
    if isinstance(camera, (list, tuple)):
        return True
    for kind, value in sorted(named.values(), key=lambda pair: _RANKS[pair[0]]):
        if isinstance(value, (list, tuple)):
            return True
        if KINDS[kind].tells_batches:
            return bool(value.ndim > KINDS[kind].dims)
    if isinstance(camera, Camera) and camera.batch_shape:
        return True
    return any(value.ndim > KINDS[kind].dims for kind, value in named.values())
