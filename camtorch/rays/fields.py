"""Fields of a camera for networks, pixel by pixel: lines in the world, local pinholes, latitude and up."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from camtorch.evaluate.door import in_graph
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import is_unknown, known_false
from camtorch.poses.extrinsics import Extrinsics
from camtorch.poses.rotations import rotate_planes, rotation_matrix
from camtorch.projection.camera_like import CameraLike
from camtorch.values.arguments import (
    Numbers,
    as_coordinates,
    as_points,
    as_vectors,
    as_whole,
    broadcast_shapes,
    check_devices,
    working_dtype,
)

_MOST_KEPT_RAYS = 1 << 19  # 6 MB in float32, at most, that each camera of a large data set keeps
_VERTICAL_SINE_SQ = 1e-24  # the squared sine of the angle to the vertical up to which a ray counts as vertical


def on_image(pixels: Numbers, size: tuple[int, int], owner: str) -> Tensor:
    """Whether pixels lie on the image; see `Camera.contains`."""
    pixels = as_coordinates(pixels, "pixels", 2, owner)
    (u, v), (height, width) = pixels.unbind(-1), size
    return (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)


def patch_centres(size: tuple[int, int], stride: int, like: Tensor, owner: str) -> Tensor:
    """Return centres (H / stride, W / stride, 2) of patches of stride x stride pixels, which must fill the image."""
    step = as_whole(stride, "stride", owner)
    if step < 1:
        raise ValueError(f"{owner}: stride must be at least 1; got {step}")
    if any(side % step for side in size):
        raise ValueError(
            f"{owner}: stride must divide both sides of the image, {size} (height, width); got {step}. Edit the camera "
            "as the image is: .crop if a convolution drops the rest, .pad if the image is padded, or .resize"
        )
    middle = (step - 1) / 2
    rows, columns = (torch.arange(side // step, dtype=like.dtype, device=like.device) * step + middle for side in size)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack((u, v), -1)


def over_image(
    camera: CameraLike, memo: Kept, inputs: Sequence[Tensor], stride: int, make: Callable[[Tensor], tuple[Tensor, ...]]
) -> tuple[Tensor, ...]:
    """Make planes from all pixels or patches (*B, H, W, 2); small results are kept while no `inputs` learn."""

    def compute() -> tuple[Tensor, ...]:
        grid = camera.pixel_grid(stride)
        return make(grid.expand(*camera.batch_shape, *grid.shape))

    if is_unknown(camera.intrinsics):  # nothing is kept, and a comparison would bound symbolic sizes
        return compute()
    step = max(as_whole(stride, "stride", "pixel_grid"), 1)
    if math.prod((*camera.batch_shape, *camera.size_for("pixel_grid"))) // step**2 > _MOST_KEPT_RAYS:
        return compute()
    if torch.is_grad_enabled() and any(map(in_graph, inputs)):
        return compute()
    # copies, as the caller may write into them
    return tuple(t.clone() for t in memo(inputs, (camera.form, stride), compute))


def plucker(rays: Tensor, valid: Tensor, extrinsics: Extrinsics | None, owner: str) -> tuple[Tensor, Tensor]:
    """Return lines (*B, H, W, 6) in the world along rays (*B, H, W, 3), and valid (*B, H, W); see `Camera.plucker`."""
    if extrinsics is None:
        return torch.cat((torch.where(valid[..., None], rays, 0.0), torch.zeros_like(rays)), -1), valid
    if not isinstance(extrinsics, Extrinsics):
        raise TypeError(
            f"{owner}: extrinsics must be ct.Extrinsics, camera from world; got {type(extrinsics).__name__}. "
            "ct.Extrinsics.from_matrix(T) makes them, and .inverse() of a camera's pose"
        )
    check_devices(owner, camera=rays, extrinsics=extrinsics.rotation)
    dtype, (height, width) = working_dtype(rays, extrinsics.rotation, extrinsics.translation), rays.shape[-3:-1]
    batch = _broadcast(rays.shape[:-3], extrinsics.batch_shape, "extrinsics", owner)
    planes = [plane.to(dtype).expand(*batch, height, width).flatten(-2) for plane in rays.unbind(-1)]
    direction = rotate_planes(rotation_matrix(-extrinsics.rotation).to(dtype), (*planes,)).movedim(0, -1)
    moment = torch.linalg.cross(extrinsics.position.to(dtype).unsqueeze(-2).expand_as(direction), direction)
    lines = torch.cat((direction, moment), -1).unflatten(-2, (height, width))
    valid = valid.expand(*batch, height, width)
    return torch.where(valid[..., None], lines, 0.0), valid


def _broadcast(batch: torch.Size, other: torch.Size, name: str, owner: str) -> torch.Size:
    try:
        return broadcast_shapes(batch, other)
    except ValueError:
        raise ValueError(
            f"{owner}: batch dims of {name} must broadcast against the camera's {tuple(batch)}; got {tuple(other)}"
        ) from None


def tangents(camera: CameraLike, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return unit rays of pixels (*B, *N, 2), their exact derivatives by the pixel to the right and down, and valid.

    They have a graph if the camera or pixels have one.
    """
    if is_unknown(pixels):
        right, below = (pixels.new_tensor(unit).expand_as(pixels) for unit in ((1.0, 0.0), (0.0, 1.0)))
        by_u: Any = torch.func.jvp(camera.unproject, (pixels,), (right,), has_aux=True)
        by_v: Any = torch.func.jvp(camera.unproject, (pixels,), (below,), has_aux=True)
        return by_u[0], by_u[1], by_v[1], by_u[2]
    learns = torch.is_grad_enabled() and any(t.requires_grad for t in (pixels, *camera.tensors))
    with torch.inference_mode(False), torch.enable_grad():
        given = pixels if learns and pixels.requires_grad else pixels.detach().clone().requires_grad_()
        rays, valid = camera.unproject(given)
        by_pixel = [
            torch.autograd.grad(plane, given, torch.ones_like(plane), retain_graph=True, create_graph=learns)[0]
            for plane in rays.unbind(-1)
        ]
    across, down = torch.stack(by_pixel, -1).unbind(-2)
    return rays if learns else rays.detach(), across, down, valid


def local_frames(rays: Tensor, across: Tensor, down: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return rotations (..., 3, 3) to local frames, pixels per unit of their planes (..., 2, 2), and valid (...) bool.

    The local z axis is the ray, and x the direction in which the ray moves with a pixel to the right, so that the
    derivative of the plane by the pixel is upper triangular. Both are identities if they are not valid.
    """
    turned = (torch.linalg.cross(across, down) * rays).sum(-1)
    valid = valid & torch.isfinite(turned) & (turned > torch.finfo(turned.dtype).tiny)
    axes = torch.eye(3, dtype=turned.dtype, device=turned.device).roll(1, 0)
    given = zip((rays, across, down), axes, strict=True)
    z, across, down = (torch.where(valid[..., None], vector, axis) for vector, axis in given)
    wide = across.square().sum(-1).sqrt()
    x = across / wide[..., None]
    y = torch.linalg.cross(z, x)
    skew, tall = (down * x).sum(-1), (down * y).sum(-1)
    per_unit = torch.stack((1 / wide, -skew / (wide * tall), torch.zeros_like(wide), 1 / tall), -1)
    return torch.stack((x, y, z), -2), per_unit.unflatten(-1, (2, 2)), valid


def local_pinhole(camera: CameraLike, pixels: Numbers) -> tuple[Tensor, Tensor]:
    """Return rotations (..., 3, 3) and matrices K (..., 3, 3); see `Camera.local_pinhole`."""
    owner = f"{type(camera).__name__}.local_pinhole"
    pixels, _ = as_points(pixels, "pixels", 2, camera.batch_shape, camera.tensors, owner)
    rotation, per_unit, valid = local_frames(*tangents(camera, pixels))
    centre = torch.where(valid[..., None], pixels.to(per_unit.dtype), 0.0)
    top = torch.cat((per_unit, centre[..., None]), -1)
    bottom = top.new_tensor([0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 3)
    return rotation, torch.cat((top, bottom), -2)


def perspective_field(camera: CameraLike, gravity: Numbers, stride: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return latitude (*B, H, W), up (*B, H, W, 2) and valid (*B, H, W); see `Camera.perspective_field`."""
    owner = f"{type(camera).__name__}.perspective_field"
    down = as_vectors(gravity, "gravity", owner)
    if known_false((down != 0).any(-1)):
        raise ValueError(f"{owner}: gravity must have a direction, as (0, 1, 0); got {down.tolist()}")
    down = down.to(camera.intrinsics.device)
    _broadcast(camera.batch_shape, down.shape[:-1], "gravity", owner)

    def field(pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        frame, per_unit, valid = local_frames(*tangents(camera, pixels))
        upward = -down / down.square().sum(-1, keepdim=True).sqrt()
        seen = (frame * upward[..., None, None, None, :].to(frame.dtype)).sum(-1)  # x, y, z of the local frame
        across, along = seen[..., :2], seen[..., 2]
        length = across.square().sum(-1)
        tilted = valid & (length > _VERTICAL_SINE_SQ)
        across = torch.where(tilted[..., None], across, across.new_tensor([0.0, -1.0]))
        up = (per_unit * across[..., None, :]).sum(-1)
        up = torch.where(tilted[..., None], up / up.square().sum(-1, keepdim=True).sqrt(), 0.0)
        latitude = torch.atan2(along, across.square().sum(-1).sqrt())
        straight = along.detach().sign() * (math.pi / 2)
        latitude = torch.where(valid, torch.where(tilted, latitude, straight), 0.0)
        return latitude, up, valid.expand(latitude.shape)

    latitude, up, valid = over_image(camera, camera._fields, (*camera.tensors, down), stride, field)
    return latitude, up, valid
