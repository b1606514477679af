"""Cameras as rows of a batch: taken out, put together, and made anew from other numbers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.utils.data._utils.collate import default_collate_fn_map

from camtorch._tracing import in_graph
from camtorch.camera import Camera


def camera_like(camera: Camera, intrinsics: Tensor, distortion: Tensor, image_size: tuple[int, int] | None) -> Camera:
    """A camera of the same model with these numbers; nothing in it learns that is not part of a graph already."""
    held = [t if in_graph(t) else nn.Parameter(t.detach(), requires_grad=False) for t in (intrinsics, distortion)]
    return type(camera)(*(held if distortion.shape[-1] else held[:1]), image_size=image_size)


def frozen(camera: Camera, image_size: tuple[int, int] | None) -> Camera:
    """A camera of the same numbers that does not learn."""
    return camera_like(camera, camera.intrinsics.detach(), camera.distortion.detach(), image_size)


def on_device(camera: Camera, device: torch.device) -> Camera:
    """The camera where the images are."""
    if camera.intrinsics.device == device:
        return camera
    return camera_like(camera, camera.intrinsics.to(device), camera.distortion.to(device), camera.image_size)


def kind(camera: Camera) -> tuple:
    """What cameras must have in common to be rows of one batch."""
    return type(camera), camera.distortion.shape[-1], camera.image_size


def alone(camera: Camera) -> Camera:
    """A batch of one as the camera that it holds, which serves any number of samples."""
    return singles(camera)[0] if tuple(camera.batch_shape) == (1,) else camera


def rows_of(camera: Camera, index: Tensor) -> Camera:
    """The cameras of these rows; one without batch dims serves all of them."""
    if not camera.batch_shape:
        return camera
    numbers = (t.expand(*camera.batch_shape, -1)[index] for t in (camera.intrinsics, camera.distortion))
    return camera_like(camera, *numbers, camera.image_size)


def expanded(camera: Camera, count: int) -> Camera:
    """A batch of `count` rows."""
    if tuple(camera.batch_shape) == (count,):
        return camera
    numbers = (t.expand(count, t.shape[-1]) for t in (camera.intrinsics, camera.distortion))
    return camera_like(camera, *numbers, camera.image_size)


def singles(camera: Camera) -> list[Camera]:
    """The cameras of a batch, one by one."""
    numbers = [t.expand(*camera.batch_shape, t.shape[-1]) for t in (camera.intrinsics, camera.distortion)]
    return [camera_like(camera, *(t[i] for t in numbers), camera.image_size) for i in range(camera.batch_shape[0])]


def joined(cameras: Sequence[Camera], order: Tensor | None = None) -> Camera:
    """One batch of cameras of one kind that have a batch dim each, in another order if wanted."""
    numbers = []
    for name in ("intrinsics", "distortion"):
        tensors = [getattr(c, name).expand(*c.batch_shape, -1) for c in cameras]
        number = torch.cat(tensors)
        numbers.append(number if order is None else number[order])
    return camera_like(cameras[0], *numbers, cameras[0].image_size)


def collate(batch: Sequence[Camera], *, collate_fn_map=None) -> Camera | list[Camera]:
    """Single cameras as one batch, or as a list where they are of several models or sizes."""
    if any(camera.batch_shape for camera in batch) or len({kind(camera) for camera in batch}) > 1:
        return list(batch)
    return joined([expanded(camera, 1) for camera in batch])


# Samples that hold cameras then go through a DataLoader as they are. torch documents this map for the purpose.
default_collate_fn_map[Camera] = collate
