"""The rays of a camera on a lattice over its image or in all directions, which a conversion compares."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.convert.fitting import RayPixels
from camtorch.projection.camera_like import CameraLike
from camtorch.rays import lattices

_ANGLES, _AZIMUTHS, _RADII = 180, 16, 64  # samples of a whole camera
_END_AHEAD = math.radians(87)  # the last angle of a camera without an image that does not see sideways


class Lattice(NamedTuple):
    """Even steps from `low` to `high`, (C, 2) each: over pixels, or over the angles from the axis and azimuths."""

    low: Tensor
    high: Tensor
    side: int  # number of nodes along each coordinate, both ends included
    are_pixels: bool
    limit: float  # radians from the axis, beyond which rays do not count

    def nodes(self) -> Tensor:
        """Return the nodes (C, side^2, 2)."""
        return lattices.pixel_lattice(self.low, self.high, self.side, self.side).flatten(1, 2)

    def sampled(self, camera: CameraLike, places: Tensor) -> RayPixels:
        """Return the rays of a camera at places (C, N, 2)."""
        if self.are_pixels:
            rays, found = camera.unproject(places)
        else:
            rays = lattices.polar_rays(*places.unbind(-1))
            found = torch.ones_like(rays[..., 0], dtype=torch.bool)
        pixels, valid = camera.project(rays)
        valid = valid & found & (lattices.angles_from_axis(rays) <= self.limit * (1 + 1e-12))
        return RayPixels(rays, pixels, valid.to(pixels.dtype))


def lattice(camera: CameraLike, image_size: tuple[int, int] | None, side: int, limit: float) -> Lattice:
    """Return a lattice over the image up to the angle `limit`, edges included; over all directions without an image."""
    count = len(camera.intrinsics)
    if image_size is None:
        # the angle (C, 1) up to which the camera has rays on some azimuth
        azimuths = (torch.arange(_AZIMUTHS).to(camera.intrinsics) + 0.25) * (2 * math.pi / _AZIMUTHS)

        def covers(rays: Tensor) -> Tensor:
            return camera.project(rays.expand(count, *rays.shape[-3:]))[1]

        ends = lattices.reach(covers, azimuths, steps=_ANGLES, rounds=1).amax(-1, keepdim=True)
        most = torch.where(ends < math.pi / 2, ends.clamp(max=_END_AHEAD), ends).clamp(max=limit)
        # no node lies on the cut of panoramas, and the last azimuth is next to the first one
        first, last = (torch.full_like(most, (i + 0.25) * 2 * math.pi / side) for i in (0, side - 1))
        low, high = torch.cat((torch.zeros_like(most), first), -1), torch.cat((most, last), -1)
        return Lattice(low, high, side, False, limit)
    low, high = (corner.expand(count, 2) for corner in lattices.image_edges(image_size, camera.intrinsics))
    if limit < math.pi:
        ring, valid = camera.project(lattices.ray_fan(low.new_full((count, 1), limit), 64).flatten(1, 2))
        closed = valid.all(-1)[:, None] & (limit < math.pi / 2)
        least, most = (torch.where(closed, end, whole) for end, whole in ((ring.amin(1), low), (ring.amax(1), high)))
        inside = (least < high) & (most > low)
        low, high = torch.where(inside, least.clamp(min=low), low), torch.where(inside, most.clamp(max=high), high)
    return Lattice(low, high, side, True, limit)


def sample(camera: CameraLike, image_size: tuple[int, int] | None, side: int, limit: float) -> RayPixels:
    """Return side^2 rays on the image or in all directions; those that the camera has up to `limit` are valid."""
    nodes = lattice(camera, image_size, side, limit)
    return nodes.sampled(camera, nodes.nodes())


def with_rings(whole: RayPixels, camera: CameraLike, image_size: tuple[int, int] | None) -> RayPixels:
    """Return the rays and more of them on circles around the axis: errors of a radial lens change along radii."""
    reach = torch.where(whole.valid, whole.angles, 0.0).amax(-1, keepdim=True)
    # steps of float32 might exceed half a circle
    steps = torch.linspace(0, 1, _RADII, dtype=reach.dtype, device=reach.device)
    rings = seen(camera, image_size, lattices.ray_fan(reach * steps, _AZIMUTHS))
    return RayPixels(*(torch.cat(pair, 1) for pair in zip(whole, rings, strict=True)))


def seen(camera: CameraLike, image_size: tuple[int, int] | None, fan: Tensor) -> RayPixels:
    """Return the rays (C, A * N, 3) of a fan (C, A, N, 3); those on the image are valid."""
    rays = fan.flatten(1, 2)
    pixels, valid = camera.project(rays)
    if image_size is not None:
        low, high = lattices.image_edges(image_size, pixels)
        valid = valid & (pixels >= low).all(-1) & (pixels <= high).all(-1)
    return RayPixels(rays, pixels, valid.to(pixels.dtype))


def focal_at_axis(camera: CameraLike) -> Tensor:
    """Return the focal lengths at the axis and the pixel of the axis, (C, 4)."""
    stated = camera.intrinsics
    fair = torch.isfinite(stated).all(-1) & (stated[:, :2] > 0).all(-1)
    stated = torch.where(fair[:, None], stated, stated.new_tensor([1.0, 1, 0, 0]))
    return torch.cat((stated[:, :2] * lattices.slopes_at_axis(camera.optics, camera.distortion), stated[:, 2:]), -1)


def radii(camera: CameraLike, slopes: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Return angles and radii for `Camera.fit_start`; reach: (C,) the last angle, 0 if nothing is seen."""
    steps = torch.arange(1, _RADII + 1, device=slopes.device).to(slopes) / _RADII
    angles = torch.where(reach > 0, reach, 1.0)[:, None] * steps
    pixels, valid = camera.project(lattices.ray_fan(angles, _AZIMUTHS))
    plane = (pixels - slopes[:, None, None, 2:]) / slopes[:, None, None, :2]
    radii = (torch.linalg.vector_norm(plane, dim=-1) * valid).sum(-1) / valid.sum(-1).clamp(min=1)
    growth = radii.diff(dim=-1, prepend=torch.zeros_like(radii[:, :1]))
    seen = valid.any(-1).long().cumprod(-1) * (growth > 0).long().cumprod(-1)
    last = seen.sum(-1, keepdim=True)
    at = (last - 1).clamp(min=0)
    end, slope = (torch.where(last > 0, t.gather(-1, at), angles[:, :1]) for t in (radii, growth))
    index = torch.arange(_RADII, device=slopes.device)
    return angles, torch.where(seen > 0, radii, end + slope * (index - at))
