"""Pixels of one camera as pixels of another, through the rays that both see."""

from __future__ import annotations

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.native.structs import ON_IMAGE, PIXELS
from camtorch.poses.rotations import turn
from camtorch.values.arguments import Numbers
from camtorch.warp.grid import native_move


def moved_pixels(
    start: Camera, end: Camera, rotation: Tensor | None, pixels: Numbers, on_image: bool = False
) -> tuple[Tensor, Tensor]:
    """Return pixels (B, *N, 2) or (*N, 2) of `start` as pixels of `end`, (-1, -1) for none, and their validity."""
    if isinstance(pixels, Tensor) and pixels.ndim > 0 and pixels.shape[-1] == 2:
        ready = native_move(start, end, rotation, pixels)
        if ready is not None and ((pixels.ndim > 1 and pixels.shape[0] == ready.cameras) or not ready.is_batch):
            moved, valid = ready.rows(pixels.reshape(ready.cameras, -1, 2), ON_IMAGE if on_image else PIXELS)
            return moved.view(pixels.shape), valid.view(pixels.shape[:-1])
    rays, has_ray = start.unproject(pixels)
    moved, mapped = end.project(turn(rotation, rays, "pixels"))
    return placed(end, moved, mapped & has_ray, on_image)


def placed(camera: Camera, pixels: Tensor, valid: Tensor, on_image: bool) -> tuple[Tensor, Tensor]:
    """Return pixels, (-1, -1) for those not valid, and which are valid: if `on_image`, those on the camera's image."""
    pixels = torch.where(valid.unsqueeze(-1), pixels, -1.0)
    return pixels, valid & camera.contains(pixels) if on_image else valid
