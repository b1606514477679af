"""Two cameras at one place: pixels of one as pixels of the other."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.native.structs import ON_IMAGE, PIXELS
from camtorch.poses.rotations import transposed, turn
from camtorch.projection.evaluation import native_forms
from camtorch.projection.native_moves import NativeMove
from camtorch.values.arguments import Numbers
from camtorch.warp.lattice import to_positions
from camtorch.warp.panorama import goes_round, off_poles, within_turn


class CameraPair(NamedTuple):
    """Two cameras at one place: `ray_target = R ray_source`."""

    source: Camera
    target: Camera
    rotation: Tensor | None

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors that pixels of the one on the image of the other depend on."""
        found = [*self.source.tensors, *self.target.tensors]
        return found if self.rotation is None else [*found, self.rotation]

    @property
    def back(self) -> CameraPair:
        """The way from target to source."""
        return CameraPair(self.target, self.source, None if self.rotation is None else self.rotation.mT)

    @property
    def goes_round(self) -> bool:
        """Whether images of one of them show a whole turn, which native code does not wrap."""
        return goes_round(self.source) is not None or goes_round(self.target) is not None

    def native(self, like: Tensor) -> NativeMove | None:
        """Return the native geometry from source to target for pixels of the dtype of `like`; None in a graph."""
        source, target, rotation = self
        made = native_forms((source, target), like, *(() if rotation is None else (rotation,)))
        if made is None:
            return None
        (start, end), is_batch = made
        if rotation is not None:
            is_batch, rotation = is_batch or rotation.ndim == 3, rotation.to(like.dtype)
        return NativeMove(start, end, rotation, target.size_for("Warp"), is_batch)

    def move(self, pixels: Numbers, on_image: bool = False) -> tuple[Tensor, Tensor]:
        """Return pixels (B, *N, 2) or (*N, 2) of the source as pixels of the target, (-1, -1) for none, and validity.

        on_image: whether only pixels on the target's image are valid.
        """
        if isinstance(pixels, Tensor) and pixels.ndim > 0 and pixels.shape[-1] == 2:
            ready = self.native(pixels)
            if ready is not None and ((pixels.ndim > 1 and pixels.shape[0] == ready.cameras) or not ready.is_batch):
                moved, valid = ready.rows(pixels.reshape(ready.cameras, -1, 2), ON_IMAGE if on_image else PIXELS)
                return moved.view(pixels.shape), valid.view(pixels.shape[:-1])
        rays, has_ray = self.source.unproject(pixels)
        moved, mapped = self.target.project(turn(self.rotation, rays, "pixels"))
        return placed(self.target, moved, mapped & has_ray, on_image)

    @property
    def like(self) -> Tensor:
        """A tensor of the dtype and on the device to compute with the target's pixels in."""
        like = self.target.intrinsics
        return like if like.dtype.itemsize >= 4 else like.float()

    def pixels_of(self, rows: range) -> Tensor:
        """Return the centres (len(rows), W', 2) of the target's pixels."""
        like = self.like
        v = torch.arange(rows.start, rows.stop, dtype=like.dtype, device=like.device)
        u = torch.arange(self.target.size_for("Warp")[1], dtype=like.dtype, device=like.device)
        return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)

    def native_positions(self) -> NativeMove | None:
        """Return the native geometry from target to source; None in a graph, and for images of a whole turn."""
        return None if self.goes_round else self.back.native(self.like)

    def exact(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return where the source sees pixels of the target, by torch.

        Pixels (h, w, 2) are those of every camera, and (B, h, w, 2) of each its own. Returns positions (B or 1, h, w,
        2) as of `grid_sample`, `OUTSIDE` where no ray is mapped, and bool (B or 1, h, w): whether one is.
        """
        source, target, rotation = self
        if pixels.ndim == 3 and target.batch_shape:
            pixels = pixels.expand(*target.batch_shape, *pixels.shape)
        rays, has_ray = target.unproject(within_turn(target, pixels))
        if rays.ndim == 3:
            rays, has_ray = rays.unsqueeze(0), has_ray.unsqueeze(0)
        rays = turn(transposed(rotation), rays, "rays")
        seen, mapped = source.project(off_poles(source, rays))
        del rays
        mapped = mapped & has_ray
        return to_positions(seen, mapped, source.size_for("Warp")), mapped


def placed(camera: Camera, pixels: Tensor, valid: Tensor, on_image: bool) -> tuple[Tensor, Tensor]:
    """Return pixels, (-1, -1) for those not valid, and which are valid: if `on_image`, those on the camera's image."""
    pixels = torch.where(valid.unsqueeze(-1), pixels, -1.0)
    return pixels, valid & camera.contains(pixels) if on_image else valid
