"""What is read of a sample before it moves: its fields by their kinds, checked, and its cameras."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from camtorch.augment.fields import IMAGES, KINDS, OWN, PLACE, Named, as_tensor, check_shape, kind_of, warn_of_numbers
from camtorch.values.dtypes import check_averaged
from camtorch.warp.warp import as_sized


def moving(sample: Mapping[str, Any], fields: Mapping[str, str], owner: str, single: bool = False) -> Named:
    """Return the fields that move, at least one.

    fields: name -> kind, of other names. single: whether the sample is known to be without a dim B.
    """
    named: Named = {}
    for name, value in sample.items():
        stays = name in OWN or name == PLACE or value is None
        kind = None if stays else kind_of(name, value, fields, owner, single)
        if kind is not None and isinstance(value, (list, tuple)):
            named[name] = kind, [as_tensor(item, f"{name}[{i}]", kind, owner) for i, item in enumerate(value)]
        elif kind is not None:
            named[name] = kind, as_tensor(value, name, kind, owner)
    if not named:
        raise ValueError(f"{owner}: the sample must have a field that moves; got none of {', '.join(KINDS)}")
    return named


def check_fields(
    sample: Mapping[str, Any], named: Named, batched: bool, has_frames: bool, owner: str, mode: str | None
) -> int:
    """Raise if the shape or the values of a field are wrong; return the number of samples.

    has_frames: whether values of a single sample may have leading dims. mode: how images are sampled; None if values
    may be bad, as predictions are.
    """
    images = [value for kind, value in named.values() if kind == "image"]
    size = images[0][0].shape[-2:] if images and len(images[0]) else ()
    count = -1
    for name, (kind, value) in named.items():
        several, field = isinstance(value, list), KINDS[kind]
        for i, item in enumerate(value if several else [value]):
            which, more = f"{name}[{i}]" if several else name, item.ndim - field.most_dims
            frame = item.new_empty(item.shape[more:]) if more > 0 and has_frames else item
            check_shape(kind, which, frame, batched and not several, owner)
            if mode is None:
                continue
            field.check(item, which, owner)
            if kind == "image":
                check_averaged(item, mode, which, owner)
            if len(size) == 2:
                flags = sample.get(f"{name}_valid")
                if several and flags is not None:
                    flags = flags[i] if i < len(flags) else ()
                warn_of_numbers(kind, which, item, flags, size, owner)
        own = len(value) if batched or several else 1
        count = own if count < 0 else count
        if own != count:
            raise ValueError(f"{owner}: {name} must be of {count} samples, as other fields; got {own}")
    return count


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
            for of_image in shapes[i : i + 1] if several and isinstance(value, list) else shapes:
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
