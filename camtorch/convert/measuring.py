"""The errors of a converted camera, which `Conversion` states."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from camtorch.convert import views
from camtorch.convert.fitting import RayPixels
from camtorch.least_squares.jacobians import to_sensor
from camtorch.projection.camera_like import CameraLike
from camtorch.rays.lattices import ray_fan

_SIDE = 193  # nodes along a side of the lattice of pixels to compare at
_PEAKS, _ROUNDS, _RIM = 16, 4, 720  # peaks of errors to search from, rounds, and rays at the largest angle
_ROUNDING = 1e-9  # px


class Reference(NamedTuple):
    """The rays of cameras (C,) at which others are compared: up to an angle, and all rays of the image."""

    camera: CameraLike
    image_size: tuple[int, int] | None
    lattice: views.Lattice
    rays: RayPixels
    all_rays: RayPixels

    @property
    def reach(self) -> Tensor:
        """The largest angle (C,) from the axis, up to the limit; 0 if there are no rays."""
        return torch.where(self.rays.valid, self.rays.angles, 0.0).amax(-1)


def reference(camera: CameraLike, image_size: tuple[int, int] | None, limit: float) -> Reference:
    """Return the rays of cameras (C,); rays up to `limit` radians from the axis count."""
    lattice = views.lattice(camera, image_size, _SIDE, limit)
    rays = lattice.sampled(camera, lattice.nodes())
    all_rays = rays if limit == math.pi else views.sample(camera, image_size, _SIDE, math.pi)
    return Reference(camera, image_size, lattice, rays, all_rays)


def measure(target: CameraLike, k: Tensor, exact: Tensor, source: Reference) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return rms, max_error, max_angle and valid_fraction (C,) of cameras (C,) with coefficients k (C, n).

    The largest error is searched from the highest peaks among the nodes, and on the rim of the largest angle.
    """

    def compared(rays: RayPixels) -> tuple[Tensor, Tensor]:
        pixels, mapped = target.project(rays.rays)
        return torch.linalg.vector_norm(pixels - rays.pixels, dim=-1), mapped

    def reached(rays: RayPixels) -> Tensor:
        # rays out of the fit's reach are no part of its result
        return to_sensor(target, k, rays.rays).covered | exact[:, None]

    rays, angles = source.rays, source.rays.angles
    errors, mapped = compared(rays)
    mapped = mapped & reached(rays)
    first_hole = torch.where(rays.valid & ~mapped, angles, torch.inf).amin(-1, keepdim=True)
    inside = rays.valid & mapped & (angles < first_hole)
    errors, some = torch.where(inside, errors, 0.0), inside.any(-1)
    max_angle = torch.where(inside, angles, 0.0).amax(-1)

    def error_within(rays: RayPixels) -> Tensor:
        errors, mapped = compared(rays)
        return torch.where(mapped & rays.valid & (rays.angles <= max_angle[:, None]), errors, 0.0)

    max_error = errors.amax(-1)
    if bool((max_error > _ROUNDING).any()):
        max_error = torch.maximum(max_error, _largest_near_peaks(errors, source, error_within))
        rim = ray_fan(max_angle[:, None] * (1 - 1e-12), _RIM)
        max_error = torch.maximum(max_error, error_within(views.seen(source.camera, source.image_size, rim)).amax(-1))
    rms = (errors.square().sum(-1) / inside.sum(-1).clamp(min=1)).sqrt()
    rms, max_error = (torch.where(some, number, torch.inf) for number in (rms, max_error))
    every = source.all_rays
    mapped = mapped if every is rays else compared(every)[1] & reached(every)
    shown = every.valid & mapped & (every.angles <= max_angle[:, None]) & some[:, None]
    return rms, max_error, max_angle, shown.sum(-1) / every.valid.sum(-1).clamp(min=1)


def _largest_near_peaks(errors: Tensor, source: Reference, error_at: Callable[[RayPixels], Tensor]) -> Tensor:
    """Return the largest error (C,) near the highest peaks of errors (C, side^2): each moves to the best finer node."""
    lattice = source.lattice
    count, side = len(errors), lattice.side
    field = errors.view(count, 1, side, side)
    peaks = torch.where(field == max_pool2d(field, 3, 1, 1), field, 0.0).flatten(1)
    places = lattice.nodes().gather(1, peaks.topk(_PEAKS).indices[..., None].expand(-1, -1, 2))
    share = torch.linspace(-1, 1, 7, dtype=errors.dtype, device=errors.device)
    offsets = torch.cartesian_prod(share, share)
    step = ((lattice.high - lattice.low) / (side - 1))[:, None, None]
    for _ in range(_ROUNDS):
        near = (places[:, :, None] + step * offsets).flatten(1, 2)
        clamped = near.clamp(lattice.low[:, None], lattice.high[:, None])  # except for azimuths
        near = clamped if lattice.are_pixels else torch.stack((clamped[..., 0], near[..., 1]), -1)
        found, best = error_at(lattice.sampled(source.camera, near)).unflatten(1, (_PEAKS, -1)).max(-1)
        places = near.unflatten(1, (_PEAKS, -1)).gather(2, best[..., None, None].expand(-1, -1, 1, 2))[:, :, 0]
        step = step / 3
    largest: Tensor = found.amax(-1)
    return largest
