"""Warps between cameras at different places, with a proxy of the scene: a plane, or a sphere."""

from __future__ import annotations

import torch
from torch import Tensor
from typing_extensions import Unpack

from camtorch.cameras.camera import Camera
from camtorch.poses.extrinsics import Extrinsics
from camtorch.poses.rotations import rotation_matrix, turn
from camtorch.values.arguments import Numbers, as_batch, as_coordinates, check_devices
from camtorch.warp.grid import Sampling, pixels_of_rows, scaled_rows, to_positions
from camtorch.warp.moving import placed
from camtorch.warp.panorama import off_poles
from camtorch.warp.sampling import PaddingMode, WarpOptions
from camtorch.warp.warp import Warp


class ProxyWarp(Warp):
    """A `Warp` to a camera at another place, exact for the points of a proxy that both see, without a lattice."""

    is_an_operator = False

    def __init__(self, source: Camera, target: Camera, extrinsics: Extrinsics, **options: Unpack[WarpOptions]):
        super().__init__(source, target, tolerance=0.0, **options)
        self.batch_shape: torch.Size = check_pose(
            type(self).__name__, extrinsics, "source from target", source=source, target=target
        )
        self.extrinsics = extrinsics

    def _pose(self) -> tuple[Tensor, Tensor]:
        """Return source from target: rotations (*B, 3, 3) and shifts (*B, 3)."""
        return rotation_matrix(self.extrinsics.rotation), self.extrinsics.translation

    def _proxy(self) -> tuple[Tensor, ...]:
        """Return the tensors of the pose and of the proxy."""
        return self.extrinsics.rotation, self.extrinsics.translation

    def _nearness(self, rays: Tensor, of_source: bool) -> tuple[Tensor, Tensor]:
        """Return 1 / distance to the proxy along unit rays (B, *N, 3) of either camera, and whether they meet it."""
        raise NotImplementedError

    @property
    def tensors(self) -> list[Tensor]:
        # the compiler follows no property of super()
        return [*self.source.tensors, *self.target.tensors, *self._proxy()]

    def locate(self, rows: range, padding: PaddingMode, tolerance: float) -> Sampling:
        if not self.antialias:
            return Sampling(*self._of_rows(rows), None)
        return scaled_rows(self.sampled, rows, self.target.size_for("Warp")[0], self._of_rows)

    def _of_rows(self, rows: range) -> tuple[Tensor, Tensor]:
        pixels = pixels_of_rows(self.target, rows)
        batch = self.batch_shape or (1,)
        seen, mapped = self.move(pixels.expand(*batch, *pixels.shape), back=True)
        if self.seam is not None:
            seen = seen + seen.new_tensor(self.seam.rims[::2])
        return to_positions(seen, mapped, self.sampled.size_for("Warp")), mapped

    def move(self, pixels: Numbers, back: bool = False, on_image: bool = False) -> tuple[Tensor, Tensor]:
        source, target = (self.target, self.source) if back else (self.source, self.target)
        rays, has_ray = source.unproject(pixels)
        # the other camera sees the points that the rays meet in these directions
        rotation, shift = (t.to(rays.dtype) for t in self._pose())
        if not back:
            rotation, shift = rotation.mT, -(rotation.mT @ shift[..., None])[..., 0]
        near, meets = self._nearness(rays, of_source=not back)
        directions = turn(rotation, rays, "rays") + beside(shift, rays) * near[..., None]
        seen, mapped = target.project(off_poles(target, directions))
        return placed(target, seen, mapped & has_ray & meets, on_image)

    def transform_rays(self, rays: Numbers) -> Tensor:
        rays = as_coordinates(rays, "rays", 3, type(self).__name__, self.source.intrinsics.device, "B, *N")
        return turn(self._pose()[0].mT.to(rays.dtype), rays, "rays")


def check_pose(owner: str, extrinsics: Extrinsics, between: str, **cameras: Camera) -> torch.Size:
    """Return the batch dim, or none, of cameras and the pose between them; raise if they do not fit."""
    if not isinstance(extrinsics, Extrinsics):
        raise TypeError(
            f"{owner}: extrinsics must be Extrinsics, {between}; got {type(extrinsics).__name__}. "
            "ct.Extrinsics.from_matrix(R, T) makes one from OpenCV's R and T"
        )
    intrinsics = {name: camera.intrinsics for name, camera in cameras.items()}
    check_devices(owner, **intrinsics, extrinsics=extrinsics.rotation)
    parts = {**cameras, "extrinsics": extrinsics}
    batch = as_batch(owner, **{name: (*part.batch_shape, 1) for name, part in parts.items()})
    if len(batch) > 1:
        raise ValueError(f"{owner}: cameras and extrinsics must have one batch dim at most; got {tuple(batch)}")
    return batch


def beside(vectors: Tensor, rays: Tensor) -> Tensor:
    """Return vectors (3,) or (B, 3) in the dtype of rays (B, *N, 3) and in a shape that broadcasts against them."""
    vectors = vectors.to(rays.dtype)
    return vectors if vectors.ndim == 1 else vectors.view(len(vectors), *[1] * (rays.ndim - 2), 3)
