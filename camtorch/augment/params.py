"""What the params of a batch carry for each of its samples: the boxes to crop, and the numbers of its cameras."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.nn.utils.parametrize import type_before_parametrizations
from torch.utils._pytree import tree_map

from camtorch._arguments import as_values, check_boxes, shown
from camtorch._module import remade
from camtorch.augment.collate import collate_cameras
from camtorch.camera import Camera

Params: TypeAlias = dict[str, Tensor]
KIND = "source_kind"
_NUMBERS = "source_intrinsics", "source_distortion"


def with_boxes(params: Any, boxes: Tensor) -> Any:
    """Params with the boxes (B, 4) that a `BoxCrop` crops, pixels x1, y1, x2, y2: of one augmentation, or a container.

    `params = aug.forward_parameters(images.shape)`, then `aug(images, params=with_boxes(params, boxes))`.

    Raises:
        ValueError: If the boxes have another shape or number, or nothing among the params crops.
    """
    given = as_values(boxes, "boxes", "with_boxes")
    check_boxes(given, "boxes", "with_boxes")
    result, found = _edited(params, "box", "with_boxes: params must be those of a BoxCrop")
    for own, name in found:
        if tuple(given.shape) != (len(own[name]), 4):
            raise ValueError(f"with_boxes: boxes must be ({len(own[name])}, 4); got {tuple(given.shape)}")
        own[name] = given
    return result


def with_cameras(params: Any, cameras: Camera | Sequence[Camera]) -> Any:
    """Params for images whose cameras differ in their numbers: of one augmentation, or the list of a container.

    `params = aug.forward_parameters(images.shape)`, then `aug(images, params=with_cameras(params, cameras))`.

    Args:
        params: they stay as they are.
        cameras: a batch, or a list, that differ only in their numbers. Of a video, one for each clip or each frame.

    Raises:
        ValueError: If the cameras are of another kind or number, or the params of no camera augmentation.
        TypeError: If they are no cameras.
    """
    if isinstance(cameras, (list, tuple)) and all(isinstance(camera, Camera) for camera in cameras):
        cameras = collate_cameras(cameras)
    if not isinstance(cameras, Camera) or cameras.is_mixed:
        got = [type(one).__name__ for one in cameras] if isinstance(cameras, list) else type(cameras).__name__
        raise TypeError(
            "with_cameras: cameras must be a Camera with a batch dim, or single ones of one model and size, in a list; "
            f"got {got}"
        )
    result, found = _edited(params, KIND, "with_cameras: params must be those of a camera augmentation")
    for own, name in found:
        kinds, kind, batch = own[name], kind_of_camera(cameras), tuple(cameras.batch_shape)
        if len(kinds) and kinds[0].tolist() != kind:
            need, got = (f"{k[1]} coefficients and image_size {tuple(k[2:])}" for k in (kinds[0].tolist(), kind))
            raise ValueError(
                f"with_cameras: needs the augmentation's model, {need}; got {type(cameras).__name__}, {got}"
            )
        count, clips = len(kinds), int(own.get("video_batch_size", len(kinds)))
        if batch not in ((), (1,), (count,), (clips,)):
            raise ValueError(f"with_cameras: the params are for {count} samples; got cameras of batch dims {batch}")
        frames = count // clips if batch == (clips,) and clips else 1
        for key, numbers in zip(_NUMBERS, (cameras.intrinsics, cameras.distortion), strict=True):
            own[key] = numbers.expand(*(batch or (1,)), -1).repeat_interleave(frames, 0).expand(count, -1)
    return result


def _edited(params: Any, name: str, need: str) -> tuple[Any, list[tuple[Params, str]]]:
    """Return a copy of params, of one augmentation or a list, and where in it are those of a name; an error if none."""
    result, found = tree_map(lambda value: value, params), list[tuple[Params, str]]()
    parts = [result]
    for part in parts:
        if isinstance(part, dict):
            found += [(part, key) for key in part if key.rpartition(".")[2] == name]
        else:
            parts += [item.data for item in part if getattr(item, "data", None)]
    if not found:
        raise ValueError(f"{need}; got {shown(params)}")
    return result, found


def camera_of(params: Params, own: Camera, device: torch.device | None) -> Camera:
    """Return the camera with the numbers that the params carry, by default those of `own`."""
    given = own.intrinsics, own.distortion
    device = own.intrinsics.device if device is None else device
    intrinsics, distortion = (params.get(n, value).to(device) for n, value in zip(_NUMBERS, given, strict=True))
    same = intrinsics is given[0] and distortion is given[1]
    return own if same else remade(own, intrinsics=intrinsics, distortion=distortion)


def kind_of_camera(camera: Camera) -> list[int]:
    """Model, number of coefficients and image_size as integers, for params hold tensors only."""
    return [
        zlib.crc32(type_before_parametrizations(camera).__name__.encode()),
        camera.distortion.shape[-1],
        *(camera.image_size or (0, 0)),
    ]
