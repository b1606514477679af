"""Checks that the images of a sample, and its cameras, are of one size and as many as the samples."""

from __future__ import annotations

from typing import Any

from camtorch.augment.fields import IMAGES, Named
from camtorch.warp.warp import as_sized


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
