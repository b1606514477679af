"""Images of a camera that moved a little, by the depth of the images."""

import math
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.rays.depth import depth_scale
from camtorch.warp.camera_pair import placed
from camtorch.warp.lattice import PixelPositions, to_positions
from camtorch.warp.options import PaddingMode
from camtorch.warp.warp import Warp

_STEPS = 12  # of the search along a ray
_MEETING_DISTANCE = 1e-4  # of the distance: a ray this close has met a surface
_EDGE = 0.05  # of the distance: neighbours that differ by more are two surfaces
_MOST_GAPS = 8  # px between former neighbours in an image that is enlarged


class ShiftedWarp(Warp):
    """A warp to a camera at another place: `p_target = R (p_source - shift)`, for images of depth (B, 1, H, W).

    Each ray of the target is followed to the nearest surface that the source sees; without one it is not mapped.
    """

    moves_by_cameras: ClassVar[bool] = False
    seam = None
    shift: Tensor
    distance: Tensor  # (B, H, W): along the rays of the source; 0 if unknown

    def __init__(
        self,
        source: Camera,
        target: Camera,
        rotation: Tensor | None,
        depth: Tensor,
        kind: str,
        shift: Tensor,
        owner: str = "ShiftedWarp",
        **options: Any,
    ):
        """Take depth of a kind that is valid; owner: who made this warp, for errors."""
        super().__init__(source, target, **options)
        self.turned_by(rotation)
        self._owner = owner
        count = len(shift)
        with torch.no_grad():
            rays, has_ray = source.rays()
            length, known = depth_scale(depth[:, 0].to(rays), rays, has_ray, kind)
            distance = torch.where(known, length, 0.0).expand(count, -1, -1)
        self.batch_shape: torch.Size = torch.Size((count,))
        self.register_buffer("shift", shift.to(rays), persistent=False)
        self.register_buffer("distance", distance, persistent=False)

    def between(self, source: Camera, target: Camera, rotation: Tensor | None, **options: Any) -> Warp:
        return ShiftedWarp(source, target, rotation, **{**self.own_parts(), **options})

    def own_parts(self, index: list[int] | None = None) -> dict[str, Any]:
        rows = slice(None) if index is None else index
        depth, shift = self.distance[rows][:, None], self.shift[rows]
        return {"depth": depth, "kind": "distance", "shift": shift, "owner": self._owner}

    @property
    def tensors(self) -> list[Tensor]:
        return [*super().tensors, self.shift, self.distance]

    def inverse(self) -> Warp:
        raise ValueError(
            f"{self._owner}: a shift has no inverse, since the new camera may not see every point. "
            "Keep the given sample"
        )

    def transform_positions(self, points: Tensor) -> Tensor:
        """Return points (B, *N, 3) of the source's frame in the target's."""
        return self.transform_rays(points - self.shift.to(points).view(-1, *[1] * (points.ndim - 2), 3))

    def moved_distance(self, distance: Tensor) -> Tensor:
        """Return distances (B, 1, H, W) from the source as distances (B, 1, H', W') from the target, 0 for none."""
        seen, mapped = self._surface()
        length = _distances_at(distance[:, 0].expand(len(seen), -1, -1), seen.to(distance))
        rays = self.source.unproject(seen)[0].to(distance)
        away = _length(rays * length[..., None] - self.shift.to(distance)[:, None, None])
        return torch.where(mapped & (length > 0), away, 0.0)[:, None]

    def locate(self, rows: range, padding: PaddingMode, tolerance: float) -> PixelPositions:
        seen, mapped = (t[:, rows.start : rows.stop] for t in self._surface())
        return PixelPositions(to_positions(seen.clone(), mapped, self.source.size_for("Warp")), mapped, None)

    def move(self, pixels: Any, back: bool = False, on_image: bool = False) -> tuple[Tensor, Tensor]:
        if back:
            seen, mapped = self._surface()
            u, v = pixels.round().long().unbind(-1)
            height, width = mapped.shape[1:]
            at = v.clamp(0, height - 1) * width + u.clamp(0, width - 1)
            index = at.reshape(len(mapped), at.shape[1:].numel())
            found = seen.flatten(1, 2).gather(1, index[..., None].expand(-1, -1, 2)).view(pixels.shape)
            return found, mapped.flatten(1).gather(1, index).view(at.shape)
        rays, has_ray = self.source.unproject(pixels)
        length = _distances_at(self.distance.to(rays), pixels.detach())
        moved, mapped = self.target.project(self.transform_positions(rays * length[..., None]))
        return placed(self.target, moved, has_ray & mapped & (length > 0), on_image)

    def _surface(self) -> tuple[Tensor, Tensor]:
        """Return the source's pixel (B, H', W', 2) that shows what each target pixel sees, and whether there is one."""
        surfaces: Kept = self.__dict__.setdefault("_surfaces", Kept())  # which pickles of 0.5 lack
        if self.is_pinned and surfaces.result is not None:
            return surfaces.result  # type: ignore[no-any-return]
        return surfaces(self.tensors, self.form, self._found_surface)

    @torch.no_grad()
    def _found_surface(self) -> tuple[Tensor, Tensor]:
        size = self.image_size
        rays, has_ray = self.target.rays()
        far = self._nearest(size).flatten(1)
        count = len(far)
        rays, has_ray = rays.expand(count, *size, 3).flatten(1, 2), has_ray.expand(count, *size).flatten(1)
        turned = rays if self.rotation is None else rays @ self.rotation.to(rays)
        seen, good = turned.new_empty(count, *size, 2), has_ray.new_empty(count, *size)
        for i in range(count):
            pixels, meets = self._followed(i, turned[i], has_ray[i], far[i])
            seen[i], good[i] = pixels.view(*size, 2), meets.view(size)
        return seen, good

    def _followed(self, i: int, rays: Tensor, has_ray: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Return pixels (N, 2) where sample i's rays (N, 3) from the new place meet a surface, and whether they do."""
        source = self.source[i] if self.source.batch_shape else self.source
        seen, good = rays.new_zeros(len(rays), 2), torch.zeros_like(has_ray)
        left = has_ray.nonzero()[:, 0]  # the rays that have met no surface yet
        far, along = far[left], rays[left]
        for _ in range(_STEPS):
            at = self.shift[i] + far[:, None] * along
            pixels, mapped = source.project(at)
            there = _distances_at(self.distance[i : i + 1], pixels[None])[0]
            off = there - _length(at)
            met = mapped & (there > 0) & (off.abs() < _MEETING_DISTANCE * there)
            seen[left], good[left] = pixels, met
            more = (~met & (there > 0)).nonzero()[:, 0]
            if not len(more):
                break
            left, far, along = left[more], (far + off)[more].clamp(min=0), along[more]
        return seen, good

    def _nearest(self, size: tuple[int, int]) -> Tensor:
        """Return about how far the nearest surface is that a target pixel sees, (B, H', W'); 0 if none is near."""
        height, width = size
        rays = self.source.rays()[0]
        points = self.transform_positions((rays * self.distance[..., None]).flatten(1, 2)).view(*self.distance.shape, 3)
        pixels, mapped = self.target.project(points)
        u, v = pixels.round().unbind(-1)
        on = mapped & (self.distance > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        place = torch.where(on, v * width + u, 0.0).long().flatten(1)
        far = torch.where(on, _length(points), torch.inf).flatten(1)
        near = far.new_full((len(far), height * width), torch.inf).scatter_reduce(1, place, far, "amin")
        both = on[..., 1:] & on[..., :-1]
        steps = _length(pixels[..., 1:, :] - pixels[..., :-1, :])[both]
        gap = float(steps.median()) if steps.numel() else 1.0
        close = -near.view(-1, 1, height, width).clamp(max=torch.finfo(far.dtype).max)
        around = 1 + min(math.ceil(gap), _MOST_GAPS)
        for shape in ((1, 2 * around + 1), (2 * around + 1, 1)):
            close = max_pool2d(close, shape, 1, (shape[0] // 2, shape[1] // 2))
        found = -close[:, 0]
        return torch.where(found < 1e30, found, 0.0)


def _distances_at(distance: Tensor, pixels: Tensor) -> Tensor:
    """Return distances (B, *N) at pixels of maps (B, H, W), 0 if unknown: linear, or the nearest between surfaces."""
    (height, width), dtype = distance.shape[1:], torch.promote_types(distance.dtype, pixels.dtype)
    u, v = pixels.to(dtype).reshape(len(distance), pixels.shape[1:-1].numel(), 2).unbind(-1)
    on = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    u, v = torch.where(on, u, 0.0).clamp(0, width - 1), torch.where(on, v, 0.0).clamp(0, height - 1)
    left, top = u.floor().clamp(max=max(width - 2, 0)), v.floor().clamp(max=max(height - 2, 0))
    right, down = u - left, v - top
    rows, at = distance.flatten(1).to(dtype), (top * width + left).long()
    across, below = int(width > 1), width * int(height > 1)
    a, b, c, d = (rows.gather(1, at + step) for step in (0, across, below, below + across))
    low, high = a.minimum(b).minimum(c.minimum(d)), a.maximum(b).maximum(c.maximum(d))
    linear = torch.lerp(torch.lerp(a, b, right), torch.lerp(c, d, right), down)
    nearest = torch.where(down > 0.5, torch.where(right > 0.5, d, c), torch.where(right > 0.5, b, a))
    found = torch.where((high - low < _EDGE * high) & (low > 0), linear, nearest)
    return torch.where(on, found, 0.0).view(pixels.shape[:-1])


def _length(vectors: Tensor) -> Tensor:
    """Return the lengths (...) of vectors (..., n), several times as fast as torch's norm over a short last dim."""
    return torch.stack([part.square() for part in vectors.unbind(-1)]).sum(0).sqrt()
