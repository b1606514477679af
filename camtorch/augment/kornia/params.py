"""What params of kornia carry for camtorch: the cameras of samples, and the boxes that are cropped."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.augment.kornia.private import ParamItem
from camtorch.cameras.camera import Camera
from camtorch.cameras.mixed import collate_cameras
from camtorch.evaluate.door import pytree
from camtorch.values.arguments import as_values, check_boxes, shown
from camtorch.values.module import remade

Params: TypeAlias = dict[str, Tensor]
KIND = "source_kind"
_NUMBERS = "source_intrinsics", "source_distortion"


def with_boxes(params: Any, boxes: Tensor) -> Any:
    """Return params with the boxes (B, 4) that a `BoxCrop` crops, x1, y1, x2, y2, for an augmentation or a container.

    `params = aug.forward_parameters(images.shape)`, then `aug(images, params=with_boxes(params, boxes))`.

    Raises:
        ValueError: If the boxes have another shape or number, or the params are not those of a `BoxCrop`.
    """
    given = as_values(boxes, "boxes", "with_boxes")
    check_boxes(given, "boxes", "with_boxes")
    result, found = _edited(params, "box", "with_boxes: params must be those of a BoxCrop")
    for one, name in found:
        if tuple(given.shape) != (len(one[name]), 4):
            raise ValueError(f"with_boxes: boxes must be ({len(one[name])}, 4); got {tuple(given.shape)}")
        one[name] = given
    return result


def with_cameras(params: Any, cameras: Camera | Sequence[Camera]) -> Any:
    """Return params for images whose cameras differ in their numbers, for an augmentation or the list of a container.

    `params = aug.forward_parameters(images.shape)`, then `aug(images, params=with_cameras(params, cameras))`.

    Args:
        params: the params, which are not changed.
        cameras: a batch or list of cameras that differ only in their numbers. For a video, one for each clip or frame.

    Raises:
        ValueError: If the cameras are of another kind or number, or the params are not of a camera augmentation.
        TypeError: If they are no cameras.
    """
    if isinstance(cameras, (list, tuple)) and all(isinstance(camera, Camera) for camera in cameras):
        cameras = collate_cameras(cameras)
    if not isinstance(cameras, Camera) or cameras.is_mixed:
        raise TypeError(
            f"with_cameras: cameras must be a batch, or a list, of one model and size; got {type(cameras).__name__}"
        )
    result, found = _edited(params, KIND, "with_cameras: params must be those of a camera augmentation")
    kind, batch = kind_of_camera(cameras), tuple(cameras.batch_shape)
    for one, name in found:
        kinds = one[name]
        if len(kinds) and kinds[0].tolist() != kind:
            raise ValueError(f"with_cameras: cameras must be of the params' model and image_size; got {cameras!r:.200}")
        count = len(kinds)
        clips = int(one.get("video_batch_size", count))
        if batch not in ((), (1,), (count,), (clips,)):
            raise ValueError(f"with_cameras: cameras must be {count}, one for each sample; got batch dims {batch}")
        frames = count // clips if batch == (clips,) and clips else 1
        for key, numbers in zip(_NUMBERS, (cameras.intrinsics, cameras.distortion), strict=True):
            one[key] = numbers.expand(*(batch or (1,)), -1).repeat_interleave(frames, 0).expand(count, -1)
    return result


def _edited(params: Any, name: str, need: str) -> tuple[Any, list[tuple[Params, str]]]:
    """Return a copy of params, and the dicts in it that hold `name`, each with its key; raise if there are none."""
    result = pytree.tree_map(lambda value: value, params)
    found = [(one, key) for _, one in params_of_each(result) for key in one if key.rpartition(".")[2] == name]
    if not found:
        raise ValueError(f"{need}; got {shown(params)}")
    return result, found


def params_of_each(params: Any, module: nn.Module | None = None) -> Iterator[tuple[Any, Params]]:
    """Yield the params of single augmentations, in order, with the augmentation if they are those of `module`."""
    if isinstance(params, dict):
        yield module, params
    for item in params if isinstance(params, (list, tuple)) else ():
        if isinstance(item, ParamItem):
            yield from params_of_each(item.data, None if module is None else module.get_submodule(item.name))


def camera_with_params(params: Params, camera: Camera, device: torch.device | None) -> Camera:
    """Return the camera with the numbers that the params carry, by default those that it has."""
    numbers = camera.intrinsics, camera.distortion
    device = camera.intrinsics.device if device is None else device
    intrinsics, distortion = (params.get(n, value).to(device) for n, value in zip(_NUMBERS, numbers, strict=True))
    same = intrinsics is numbers[0] and distortion is numbers[1]
    return camera if same else remade(camera, intrinsics=intrinsics, distortion=distortion)


_CODES: dict[str, int] = {}  # of names of models; compilers, which do not know zlib, look them up


def kind_of_camera(camera: Camera) -> list[int]:
    """Return model, number of coefficients and image_size as integers, since params hold only tensors."""
    model = type_before_parametrizations(camera).__name__
    if model not in _CODES:
        _CODES[model] = zlib.crc32(model.encode())
    return [_CODES[model], camera.distortion.shape[-1], *(camera.image_size or (0, 0))]
