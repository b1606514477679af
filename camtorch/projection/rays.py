"""How a camera is sampled: lattices of pixels, fans of rays; and what that tells: field of view, slopes at the axis."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from camtorch._arguments import columns

if TYPE_CHECKING:
    from camtorch.camera import Camera
    from camtorch.projection.domain import Optics

    CameraT = TypeVar("CameraT", bound=Camera)

_LINE = 513  # points along a line of the image


def image_edges(image_size: tuple[int, int], like: Tensor) -> tuple[Tensor, Tensor]:
    """(2,) each: the outer corners (u, v) of an image at the top left, and at the bottom right."""
    height, width = image_size
    return like.new_full((2,), -0.5), like.new_tensor([width - 0.5, height - 0.5])


def image_lattice(camera: Camera, rows: int, columns: int) -> Tensor:
    """(rows, columns, 2): pixels in even steps from outer edge to outer edge of the image."""
    return pixel_lattice(*image_edges(camera._size("a lattice of pixels"), camera.intrinsics), rows, columns)


def pixel_lattice(low: Tensor, high: Tensor, rows: int, columns: int) -> Tensor:
    """(*C, rows, columns, 2): pixels in even steps from low to high, (*C, 2) each, both included."""

    def steps(axis: int, count: int) -> Tensor:
        share = torch.linspace(0, 1, count, dtype=low.dtype, device=low.device)
        return low[..., axis, None] + (high - low)[..., axis, None] * share

    u, v = steps(0, columns), steps(1, rows)
    return torch.stack(torch.broadcast_tensors(u[..., None, :], v[..., :, None]), -1)


def ray_fan(angles: Tensor, azimuths: int) -> Tensor:
    """(*C, K) angles from the axis -> (*C, K, azimuths, 3) rays, evenly around it; none where panoramas are cut."""
    return polar_rays(angles[..., None], (torch.arange(azimuths).to(angles) + 0.25) * (2 * math.pi / azimuths))


def polar_rays(angles: Tensor, azimuths: Tensor) -> Tensor:
    """(..., 3): unit rays at angles from the axis, on azimuths, both radians (...)."""
    across = angles.sin()
    return torch.stack(torch.broadcast_tensors(across * azimuths.cos(), across * azimuths.sin(), angles.cos()), -1)


def angles_from_axis(rays: Tensor) -> Tensor:
    """(..., 3) rays -> (...) radians from the optical axis."""
    x, y, z = rays.unbind(-1)
    return torch.atan2(torch.hypot(x, y), z)


def slopes_at_axis(optics: Optics, k: Tensor) -> Tensor:
    """Derivatives (C, 2) of the point on the sensor by x and y of the ray (x, y, 1), at the axis; k: (C, n).

    One where the coefficients make no lens. Graph-free.
    """
    with torch.inference_mode(False), torch.enable_grad():
        x, y = (k.new_zeros(len(k), 1).requires_grad_() for _ in range(2))
        chart, lens = optics(columns(k.detach().clone()))
        a, b = chart.to_plane(x, y, torch.ones_like(x), order=1)
        if lens.stages:
            a, b = lens(a, b)
        pairs = ((a, x), (b, y))
        slopes = torch.cat([torch.autograd.grad(to.sum(), of, retain_graph=True)[0] for to, of in pairs], -1)
    return torch.where(torch.isfinite(slopes) & (slopes > 0), slopes, 1.0)


def ideal(camera: CameraT) -> CameraT:
    """The single camera of the same pixels per radian at the axis, with coefficients that do nothing."""
    if not camera.distortion_names:
        return camera
    values = camera.distortion.new_tensor(camera.ideal(len(camera.distortion_names)))
    intrinsics = camera.intrinsics.detach()
    slopes = slopes_at_axis(camera.optics, camera.distortion.detach()[None])[0]
    # that a chart or a table has a slope of its own is no distortion; rounding is no slope
    slopes = torch.where((slopes - 1).abs() > 1e-9, slopes, 1.0)
    return type(camera)(torch.cat((intrinsics[:2] * slopes, intrinsics[2:])), values, image_size=camera.image_size)


def followed(camera: Camera, angles: Tensor, azimuths: int) -> tuple[Tensor, Tensor]:
    """Pixels (*C, K, azimuths, 2) of a fan of ascending angles (*C, K), and whether all is valid up to there."""
    pixels, valid = camera.project(ray_fan(angles, azimuths))
    return pixels, valid.long().cumprod(-2).bool()


@torch.no_grad()
def field_of_view(camera: Camera) -> Tensor:
    """(*B, 3) radians: horizontal and vertical through the principal point, and on the wider diagonal of the image.

    From outer edge to outer edge, or as far as there are rays; 0 where there are none. Graph-free.
    """
    low, high = image_edges(camera._size("field_of_view"), camera.intrinsics)
    (left, top), (right, bottom) = low, high
    cx, cy = camera.intrinsics.expand(*camera.batch_shape, 4)[..., 2:].clamp(low, high).unbind(-1)
    lines = (left, cy, right, cy), (cx, top, cx, bottom), (left, top, right, bottom), (left, bottom, right, top)
    ends = torch.stack([torch.stack(torch.broadcast_tensors(*line, cx)[:4], -1) for line in lines], -2)
    start, along = ends[..., None, :2], ends[..., None, 2:] - ends[..., None, :2]
    rays, valid = camera.unproject(start + torch.linspace(0, 1, _LINE).to(start)[:, None] * along)
    x, y, z = rays.double().unbind(-1)
    # from a turn to the one side to a turn to the other: more than half a circle is no angle between two rays
    forward = x * along[..., 0] + y * along[..., 1]
    angles = torch.atan2(torch.hypot(x, y).copysign(forward), z)
    least, most = torch.where(valid, angles, torch.inf).amin(-1), torch.where(valid, angles, -torch.inf).amax(-1)
    wide, tall, *diagonals = (most - least).clamp(min=0).to(rays.dtype).unbind(-1)
    return torch.stack((wide, tall, torch.maximum(*diagonals)), -1)
