"""Warps between cameras that stand at different places, by a proxy of the scene: a plane, a sphere, a depth map."""

from __future__ import annotations

import torch
from torch import Tensor

from camtorch._arguments import Numbers
from camtorch.rotations import rotate_planes
from camtorch.warp.grid import Sampling, pixels_of_rows, scaled, to_positions
from camtorch.warp.panorama import rays_of, seam_of, seen_by
from camtorch.warp.sampling import PaddingMode
from camtorch.warp.warp import Warp


class ProxyWarp(Warp):
    """A `Warp` whose cameras see the same points of a proxy, which says where rays of one meet those of the other.

    Positions are exact, and full-size: no lattice.
    """

    is_an_operator = False

    def _to_source(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Rays of the target (B, *N, 3) to directions in which the source sees their points, and whether there are."""
        raise NotImplementedError

    def _to_target(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """The other way."""
        raise NotImplementedError

    def _locate(self, rows: range, padding: PaddingMode, tolerance: float) -> Sampling:
        if not self.antialias:
            return Sampling(*self._of_rows(rows), None, seam_of(self.source))
        # the scale is that between neighbours
        around = range(max(rows.start - 1, 0), min(rows.stop + 1, self.target._size_for("Warp")[0]))
        where = scaled(self.source, *self._of_rows(around))
        return where.part(slice(rows.start - around.start, rows.stop - around.start))

    def _of_rows(self, rows: range) -> tuple[Tensor, Tensor]:
        pixels = pixels_of_rows(self.target, rows)
        rays, has_ray = rays_of(self.target, pixels.expand(*self.target.batch_shape, *pixels.shape))
        if rays.ndim == 3:
            rays, has_ray = rays[None], has_ray[None]
        directions, met = self._to_source(rays)
        count = self.source.batch_shape.numel()
        if self.source.batch_shape and len(directions) == 1:
            directions = directions.expand(count, *directions.shape[1:])
        seen, mapped = seen_by(self.source, directions)
        mapped = mapped & has_ray & met
        return to_positions(seen, mapped, self.source._size_for("Warp")), mapped

    def _move(self, pixels: Numbers, back: bool = False, on_image: bool = False) -> tuple[Tensor, Tensor]:
        source, target, carried = self.source, self.target, self._to_target
        if back:
            source, target, carried = target, source, self._to_source
        rays, has_ray = rays_of(source, pixels)
        directions, met = carried(rays)
        seen, mapped = seen_by(target, directions)
        valid = mapped & has_ray & met
        seen = torch.where(valid.unsqueeze(-1), seen, -1.0)
        return seen, valid & target.contains(seen) if on_image else valid


def turned(rotation: Tensor, rays: Tensor) -> Tensor:
    """Matrices (*B, 3, 3) applied to (B, *N, 3) or (*N, 3)."""
    if rotation.ndim == 2:
        return rotate_planes(rotation, rays.unbind(-1)).movedim(0, -1)
    rows = rays.expand(len(rotation), *rays.shape[1:]) if len(rays) == 1 else rays
    planes = rows.flatten(1, -2).unbind(-1)
    return rotate_planes(rotation, planes).movedim(0, -1).reshape(max(len(rows), len(rotation)), *rows.shape[1:])
