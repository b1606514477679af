"""Samples of a camera: lattices of pixels and fans of rays; its field of view, and how far coefficients move it."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from camtorch.optics.derivatives import jacobian_of
from camtorch.optics.model_spec import Optics
from camtorch.optics.radial_inverse import precise
from camtorch.projection.camera_like import CameraLike
from camtorch.values.arguments import broadcast_shapes, columns
from camtorch.values.module import remade

CameraT = TypeVar("CameraT", bound=CameraLike)

AXES = ("horizontal", "vertical", "diagonal")  # of an image, along which a field of view is measured

_LINE_POINTS = 513
_STEP = 1e-4  # of a coefficient


def image_edges(image_size: tuple[int, int], like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the outer corners (u, v) of an image at the top left and at the bottom right, (2,) each."""
    height, width = image_size
    return like.new_full((2,), -0.5), like.new_tensor([width - 0.5, height - 0.5])


def image_lattice(camera: CameraLike, rows: int, columns: int) -> Tensor:
    """Return pixels (rows, columns, 2) in even steps from outer edge to outer edge of the image."""
    return pixel_lattice(*image_edges(camera.size_for("a lattice of pixels"), camera.intrinsics), rows, columns)


def pixel_lattice(low: Tensor, high: Tensor, rows: int, columns: int) -> Tensor:
    """Return pixels (*C, rows, columns, 2) in even steps from low to high, (*C, 2) each, both included."""

    def steps(axis: int, count: int) -> Tensor:
        share = torch.linspace(0, 1, count, dtype=low.dtype, device=low.device)
        return low[..., axis, None] + (high - low)[..., axis, None] * share

    u, v = steps(0, columns), steps(1, rows)
    return torch.stack(torch.broadcast_tensors(u[..., None, :], v[..., :, None]), -1)


def ray_fan(angles: Tensor, azimuths: int) -> Tensor:
    """Return rays (*C, K, azimuths, 3) at angles (*C, K), evenly around the axis, none on the cut of panoramas."""
    around = (torch.arange(azimuths, device=angles.device).to(angles) + 0.25) * (2 * math.pi / azimuths)
    return polar_rays(angles[..., None], around)


def polar_rays(angles: Tensor, azimuths: Tensor) -> Tensor:
    """Return unit rays (..., 3) at angles from the axis and azimuths, both in radians (...)."""
    across = angles.sin()
    return torch.stack(torch.broadcast_tensors(across * azimuths.cos(), across * azimuths.sin(), angles.cos()), -1)


def angles_from_axis(rays: Tensor) -> Tensor:
    """Return the angles (...) in radians between rays (..., 3) and the optical axis."""
    x, y, z = rays.unbind(-1)
    return torch.atan2(torch.hypot(x, y), z)


def slopes_at_axis(optics: Optics, k: Tensor) -> Tensor:
    """Return derivatives (C, 2) of the point on the sensor by x and y of a ray (x, y, 1) at the axis, graph-free."""

    def to_sensor(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        chart, lens = optics(columns(k.detach().clone()))
        a, b = chart.to_plane(x, y, torch.ones_like(x), order=1)
        return lens(a, b) if lens.stages else (a, b)

    zero = k.detach().new_zeros(len(k), 1)
    across, _, _, down = jacobian_of(to_sensor, zero, zero)
    slopes = torch.cat((across, down), -1)
    return torch.where(torch.isfinite(slopes) & (slopes > 0), slopes, 1.0)


def movement(camera: CameraLike, distortion: Tensor, nominal: Tensor, lattice: int = 9) -> Tensor:
    """Return by how many pixels one unit of each coefficient (*B, n) moves the image at most, float64 on the CPU.

    The lens has `nominal` intrinsics, and is tried at so many rows and columns: finer ones come nearer to a lens's end.
    """
    count, size = distortion.shape[-1], camera.size_for("the effect of its coefficients")
    batch = broadcast_shapes(nominal.shape[:-1], distortion.shape[:-1])
    intrinsics, k = (
        t.detach().double().expand(*batch, t.shape[-1]).reshape(-1, t.shape[-1]) for t in (nominal, distortion)
    )
    pixels = _over(size, lattice).to(k.device).expand(len(k), -1, -1)
    rays, seen = remade(camera, intrinsics=intrinsics, distortion=k).unproject(pixels)
    # each coefficient less, then each more; the bits do not depend on the image's part
    change = _STEP * torch.eye(count, dtype=torch.float64, device=k.device)
    lenses, _ = defined_or(camera, k[:, None] + torch.cat((-change, change)), k[:, None])
    many = [t.repeat_interleave(2 * count, 0) for t in (intrinsics, rays)]
    ends, valid = remade(camera, intrinsics=many[0], distortion=lenses.flatten(0, 1)).project(many[1])
    # (B, less and more, n, N, 2), and plain arithmetic on a few numbers
    places, known = (t.unflatten(0, (-1, 2, count)).cpu().numpy() for t in (ends, valid))
    moved = np.linalg.norm(places[:, 1] - places[:, 0], axis=-1) / (2 * _STEP)
    most = np.where(known.all(1) & seen.cpu().numpy()[:, None], moved, 0.0).max(-1)
    return torch.from_numpy(most.reshape(*batch, count))


@lru_cache(maxsize=16)
def _over(size: tuple[int, int], lattice: int) -> Tensor:
    """Return pixels (N, 2) in float64, in even steps over images of a size, to their outer edges."""
    with torch.inference_mode(False):
        edges = image_edges(size, torch.empty(0, dtype=torch.float64))
        return pixel_lattice(*edges, lattice, lattice).flatten(0, 1)


def defined_or(camera: CameraLike, distortion: Tensor, otherwise: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return coefficients (*B, n), `otherwise` for undefined ones, and which are defined, (*B,); None if all are."""
    sense = camera.defined(distortion.unbind(-1))
    if sense is None:
        return distortion, None
    return torch.where((sense > 0).unsqueeze(-1), distortion, otherwise), sense > 0


def ideal(camera: CameraT) -> CameraT:
    """Return a single camera with the same pixels per radian at the axis and coefficients without effect."""
    if not camera.distortion_names:
        return camera
    values = camera.distortion.new_tensor(camera.ideal(len(camera.distortion_names)))
    intrinsics = camera.intrinsics.detach()
    slopes = slopes_at_axis(camera.optics, camera.distortion.detach()[None])[0]
    # the slope of a chart or a table at the axis belongs to the focal length; rounding does not
    slopes = torch.where((slopes - 1).abs() > 1e-9, slopes, 1.0)
    return remade(camera, intrinsics=torch.cat((intrinsics[:2] * slopes, intrinsics[2:])), distortion=values)


def reach(
    covers: Callable[[Tensor], Tensor], azimuths: Tensor, *, most: float = math.pi, steps: int, rounds: int
) -> Tensor:
    """Return the angle (*B, K), at most `most`, up to which all rays towards azimuths (K,) are covered; 0 if none is.

    covers: from unit rays (K, S, 3) or (*B, K, S, 3) to bool (*B, K, S). Each round divides a step of the one before.
    """
    share = torch.linspace(0, 1, steps + 1, dtype=azimuths.dtype, device=azimuths.device)
    low, width = azimuths.new_zeros(len(azimuths), 1), most
    for _ in range(rounds):
        angles = (low + width * share).clamp(max=most)
        covered = covers(polar_rays(angles, azimuths[:, None]))
        last = (covered.long().cumprod(-1).sum(-1, keepdim=True) - 1).clamp(min=0)
        low, width = angles.expand(covered.shape).gather(-1, last), width / steps
    return low.squeeze(-1)


def followed(camera: CameraLike, angles: Tensor, azimuths: int) -> tuple[Tensor, Tensor]:
    """Return pixels (*C, K, azimuths, 2) of a fan of ascending angles (*C, K), and whether all up to each are valid."""
    pixels, valid = camera.project(ray_fan(angles, azimuths))
    return pixels, valid.long().cumprod(-2).bool()


def around_ends(share: Tensor, valid: Tensor) -> Tensor:
    """Return shares (..., 66): finer steps around the first and last valid of ascending shares (..., n) of a line."""
    first, last = valid.long().argmax(-1, True), share.shape[-1] - 1 - valid.flip(-1).long().argmax(-1, True)
    around = [share.gather(-1, i.clamp(0, share.shape[-1] - 1)) for i in (first - 1, first, last, last + 1)]
    steps = torch.linspace(0, 1, 33).to(share)
    return torch.cat([low + (high - low) * steps for low, high in (around[:2], around[2:])], -1)


@torch.no_grad()
def field_of_view(camera: CameraLike) -> Tensor:
    """Return angles (*B, 3) in radians along `AXES`, between outer edges or the last rays, without a graph."""
    low, high = image_edges(camera.size_for("field_of_view"), camera.intrinsics)
    (left, top), (right, bottom) = low, high
    cx, cy = camera.intrinsics.expand(*camera.batch_shape, 4)[..., 2:].clamp(low, high).unbind(-1)
    lines = (left, cy, right, cy), (cx, top, cx, bottom), (left, top, right, bottom), (left, bottom, right, top)
    ends = torch.stack([torch.stack(torch.broadcast_tensors(*line, cx)[:4], -1) for line in lines], -2)
    start, along = ends[..., None, :2], ends[..., None, 2:] - ends[..., None, :2]
    least = precise(start).new_full(start.shape[:-2], torch.inf)
    most = -least
    share = torch.linspace(0, 1, _LINE_POINTS).to(start).expand(*least.shape, _LINE_POINTS)
    for _ in range(4):  # the whole line, then closer around the ends of its visible part
        rays, valid = camera.unproject(start + share[..., None] * along)
        x, y, z = precise(rays).unbind(-1)
        # signed angles from the axis, whose sum may exceed half a circle, unlike an angle between two rays
        forward = x * along[..., 0] + y * along[..., 1]
        angles = torch.atan2(torch.hypot(x, y).copysign(forward), z)
        least = torch.minimum(least, torch.where(valid, angles, torch.inf).amin(-1))
        most = torch.maximum(most, torch.where(valid, angles, -torch.inf).amax(-1))
        share = around_ends(share, valid)
    wide, tall, *diagonals = (most - least).clamp(min=0).to(start.dtype).unbind(-1)
    return torch.stack((wide, tall, torch.maximum(*diagonals)), -1)


@torch.no_grad()
def focal_for(camera: CameraLike, fov: Tensor, image_size: tuple[int, int], axis: str) -> tuple[Tensor, Tensor]:
    """Return the focal length (*B,) for a `fov` in radians, or else the widest, and whether it is reached.

    camera: with focal length 1.
    """
    height, width = image_size
    ends = {"horizontal": [(width, 0)], "vertical": [(0, height)], "diagonal": [(width, height), (width, -height)]}
    half = fov.new_tensor(ends[axis]) / 2

    def angle(per_pixel: Tensor) -> Tensor:
        """Return angles (*B, K) between both ends for (*B, K) plane units a pixel; infinite if an end has no ray."""
        toward = per_pixel[..., None, None] * half
        rays, valid = camera.unproject(torch.stack((toward, -toward), -2))
        angles = angles_from_axis(rays).sum(-1).amax(-1)
        return torch.where(valid.flatten(-2).all(-1), angles, torch.inf)

    share = torch.linspace(0, 1, _LINE_POINTS).to(fov)
    reach = half.norm(dim=-1).amax()
    low, high = fov.new_full(fov.shape, 1e-6), fov.new_full(fov.shape, 1e5)
    scale = low[..., None] * (high / low)[..., None] ** share / reach
    for _ in range(5):  # the first in even ratios, the others in even steps
        below = (angle(scale) < fov[..., None]).long().cumprod(-1).sum(-1, keepdim=True).clamp(1, _LINE_POINTS - 1)
        low, high = scale.gather(-1, below - 1), scale.gather(-1, below)
        scale = low + (high - low) * share
    found = angle(torch.cat((low, high), -1))
    reached = torch.isfinite(found[..., 1]) & (found[..., 1] >= fov)
    # panoramas end at a whole turn
    return 1 / torch.where(reached, high[..., 0], low[..., 0]), reached | (fov - found[..., 0] < 1e-6)
