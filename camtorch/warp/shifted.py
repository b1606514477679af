"""Images of a camera that moved by a little, by the depth that its images come with."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from camtorch.camera import Camera
from camtorch.projection.depth import as_depth, depth_scale
from camtorch.warp.grid import Sampling, to_positions
from camtorch.warp.panorama import rays_of, seam_of, seen_by
from camtorch.warp.sampling import PaddingMode
from camtorch.warp.warp import Warp

_STEPS = 12  # of the search along a ray
_CLOSE = 1e-4  # of the distance, within which a ray has met what the source sees
_EDGE = 0.05  # of the distance: neighbours that differ by more are two surfaces
_MOST_GAPS = 8  # px between pixels that were neighbours, of an image that is enlarged


class ShiftedWarp(Warp):
    """A warp to a camera at another place: `p_target = R (p_source - shift)`, for images whose depth is known.

    Each ray of the target is followed to the surface that the source sees, the nearest one first. What the source does
    not see, because something stands before it or its depth is not known, is not mapped. Pixels have the depth of their
    place in the source's image.

    Args:
        depth: (B, 1, H, W) of the source, positive where it is known.
        kind: what depth holds, "z" or "distance".
        shift: (B, 3), how far the camera moves, in its own frame.
    """

    is_an_operator: ClassVar[bool] = False
    batch_shape: torch.Size
    shift: Tensor
    distance: Tensor
    """(B, H, W): along the rays of the source; 0 where it is not known."""

    def __init__(
        self,
        source: Camera,
        target: Camera,
        rotation: Tensor | None,
        depth: Tensor,
        kind: str,
        shift: Tensor,
        **options: Any,
    ):
        super().__init__(source, target, **options)
        self.turned_by(rotation)
        count = len(shift)
        as_depth(depth, kind, source._size_for("RandomMount"), "RandomMount", depth.device)
        with torch.no_grad():
            rays, has_ray = _rays(source)
            length, known = depth_scale(depth[:, 0].to(rays), rays, has_ray, kind)
            distance = torch.where(known, length, 0.0).expand(count, -1, -1)
        self.batch_shape = torch.Size((count,))
        self.register_buffer("shift", shift.to(rays), persistent=False)
        self.register_buffer("distance", distance, persistent=False)
        self._found: tuple[Tensor, Tensor] | None = None

    def rows_of(self, source: Camera, target: Camera, rotation: Tensor | None, index: list[int]) -> ShiftedWarp:
        """That of these rows, whose cameras and turns are given."""
        depth = self.distance[index][:, None]
        return ShiftedWarp(source, target, rotation, depth, "distance", self.shift[index], **self.options)

    def inverse(self) -> Warp:
        raise ValueError(
            "RandomMount: a shift has no inverse: what the camera saw may be hidden now. Keep the sample as it was"
        )

    def transform_positions(self, points: Tensor) -> Tensor:
        """Points (B, *N, 3) of the source's frame in the target's."""
        return self.transform_rays(points - self.shift.to(points).view(-1, *[1] * (points.ndim - 2), 3))

    def moved_distance(self, distance: Tensor) -> Tensor:
        """Distances (B, 1, H, W) from the source as those from the target (B, 1, H', W'), 0 for none."""
        seen, mapped = self._surface()
        length = _between(distance[:, 0].expand(len(seen), -1, -1), seen.to(distance))
        rays = rays_of(self.source, seen)[0].to(distance)
        away = (rays * length[..., None] - self.shift.to(distance)[:, None, None]).norm(dim=-1)
        return torch.where(mapped & (length > 0), away, 0.0)[:, None]

    def _locate(self, rows: range, padding: PaddingMode, tolerance: float) -> Sampling:
        seen, mapped = (t[:, rows.start : rows.stop] for t in self._surface())
        return Sampling(
            to_positions(seen.clone(), mapped, self.source._size_for("Warp")), mapped, None, seam_of(self.source)
        )

    def _move(self, pixels: Any, back: bool = False, on_image: bool = False) -> tuple[Tensor, Tensor]:
        if back:
            seen, mapped = self._surface()
            u, v = pixels.round().long().unbind(-1)
            height, width = mapped.shape[1:]
            at = v.clamp(0, height - 1) * width + u.clamp(0, width - 1)
            index = at.reshape(len(mapped), -1)
            found = seen.flatten(1, 2).gather(1, index[..., None].expand(-1, -1, 2)).view(pixels.shape)
            return found, mapped.flatten(1).gather(1, index).view(at.shape)
        rays, has_ray = rays_of(self.source, pixels)
        length = _between(self.distance.to(rays), pixels.detach())
        moved, mapped = seen_by(self.target, self.transform_positions(rays * length[..., None]))
        valid = has_ray & mapped & (length > 0)
        moved = torch.where(valid[..., None], moved, -1.0)
        return moved, valid & self.target.contains(moved) if on_image else valid

    @torch.no_grad()
    def _surface(self) -> tuple[Tensor, Tensor]:
        """Where in the source's image (B, H', W', 2) each pixel of the target is seen, and whether it is."""
        if self._found is None:
            height, width = self.target._size_for("Warp")
            rays, has_ray = _rays(self.target)
            count = len(self.shift)
            rays, has_ray = rays.expand(count, height, width, 3), has_ray.expand(count, height, width)
            turned = rays if self.rotation is None else rays.flatten(1, 2) @ self.rotation.to(rays)
            turned, shift = turned.view_as(rays), self.shift[:, None, None]
            far = self._nearest((height, width))
            for _ in range(_STEPS):
                at = shift + far[..., None] * turned
                seen, mapped = seen_by(self.source, at)
                there = _between(self.distance, seen)
                off = there - at.norm(dim=-1)
                good = mapped & has_ray & (there > 0) & (off.abs() < _CLOSE * there)
                far = torch.where(good | (there <= 0), far, (far + off).clamp(min=0))
            self._found = seen, good
        return self._found

    def _nearest(self, size: tuple[int, int]) -> Tensor:
        """(B, H', W'): about how far the nearest surface is that the target sees; 0 where nothing is near."""
        height, width = size
        rays = _rays(self.source)[0]
        points = self.transform_positions((rays * self.distance[..., None]).flatten(1, 2)).view(*self.distance.shape, 3)
        pixels, mapped = seen_by(self.target, points)
        u, v = pixels.round().unbind(-1)
        on = mapped & (self.distance > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        place = torch.where(on, v * width + u, 0.0).long().flatten(1)
        far = torch.where(on, points.norm(dim=-1), torch.inf).flatten(1)
        near = far.new_full((len(far), height * width), torch.inf).scatter_reduce(1, place, far, "amin")
        both = on[..., 1:] & on[..., :-1]
        steps = (pixels[..., 1:, :] - pixels[..., :-1, :]).norm(dim=-1)[both]
        gap = float(steps.median()) if steps.numel() else 1.0
        close = -near.view(-1, 1, height, width).clamp(max=torch.finfo(far.dtype).max)
        for _ in range(1 + min(math.ceil(gap), _MOST_GAPS)):
            close = max_pool2d(close, 3, 1, 1)
        found = -close[:, 0]
        return torch.where(found < 1e30, found, 0.0)


def _rays(camera: Camera) -> tuple[Tensor, Tensor]:
    """(*B, H, W, 3) of all pixels, and whether they have some."""
    grid = camera.pixel_grid()
    return rays_of(camera, grid.expand(*camera.batch_shape, *grid.shape))


def _between(distance: Tensor, pixels: Tensor) -> Tensor:
    """Distances (B, *N) at pixels (B, *N, 2) of maps (B, H, W), 0 where none is known.

    Linear between the four pixels around; where these show two surfaces, or nothing, that of the nearest one.
    """
    height, width = distance.shape[1:]
    flat = pixels.reshape(len(distance), -1, 2)
    limits = flat.new_tensor([width - 1.0, height - 1.0])
    on = ((flat >= -0.5) & (flat <= limits + 0.5)).all(-1)
    inner = torch.where(on[..., None], flat, 0.0).clamp(min=flat.new_zeros(2), max=limits)
    low = torch.minimum(inner.floor(), (limits - 1).clamp(min=0))
    share = inner - low
    rows = distance.flatten(1)

    def at(step_u: int, step_v: int) -> Tensor:
        u, v = (low[..., 0] + step_u).clamp(max=width - 1), (low[..., 1] + step_v).clamp(max=height - 1)
        return rows.gather(1, (v * width + u).long())

    corners = torch.stack([at(0, 0), at(1, 0), at(0, 1), at(1, 1)])
    a, b = share.unbind(-1)
    weights = torch.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    one = (corners.amax(0) - corners.amin(0) < _EDGE * corners.amax(0)) & (corners.amin(0) > 0)
    nearest = corners.gather(0, weights.argmax(0)[None])[0]
    return torch.where(on, torch.where(one, (weights * corners).sum(0), nearest), 0.0).view(pixels.shape[:-1])
