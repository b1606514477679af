"""A part of a change: rows of a batch that one warp moves, and the warp, or the numbers that it is made of later."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from camtorch.cameras.camera import Camera
from camtorch.cameras.editing import edited
from camtorch.evaluate.tensors import are_numbers
from camtorch.poses.rotations import is_right, turn
from camtorch.projection.evaluation import camera_rows
from camtorch.projection.native_cameras import Native
from camtorch.values.module import remade
from camtorch.warp.affine import AffineWarp, HalvingWarp, after, made_like
from camtorch.warp.options import Options
from camtorch.warp.panorama import seam_of
from camtorch.warp.shutter import ShutterWarp
from camtorch.warp.warp import Warp


@dataclass(slots=True)
class LazyWarp:
    """A warp to cameras of which native code wrote the numbers; warp and cameras become modules at first use.

    Changes and plans ask a `Warp` and a `LazyWarp` by the same names, those with a star in the table of `RoutedWarp`.
    """

    moves_by_cameras: ClassVar[bool] = True
    like: Camera  # the new cameras are of its model
    intrinsics: np.ndarray[Any, Any]  # (4,) of one, or (B, 4)
    distortion: np.ndarray[Any, Any]  # (n,) of one, or (B, n)
    image_size: tuple[int, int]
    rotation: Tensor | None  # (3, 3) or (B, 3, 3), or None
    options: Options  # of the warp
    natives: tuple[Native, Native] | None  # the cameras before and the new ones, for native code; None if it lacks any
    may_mirror: bool = False  # whether the rotation may be a mirror, as after a flip
    _warp: Warp | None = field(default=None, init=False)  # `warp()`, once it was called
    _target: Camera | None = field(default=None, init=False)  # `target`, once it was read

    @property
    def target(self) -> Camera:
        """The new cameras of the change; samples get copies of them."""
        if self._target is None:
            if self.natives is not None:
                self.natives[1].keep_lenses()  # the new camera finds them
            self._target = self.new_target(self.intrinsics.shape[:-1])
        return self._target

    def new_target(self, batch: tuple[int, ...]) -> Camera:
        """Return the new cameras, of memory of their own; one camera may serve a batch (B,), or be of none, ()."""
        if torch.is_inference_mode_enabled():  # a graph could not use its tensors later
            with torch.inference_mode(False), torch.no_grad():
                return self.new_target(batch)
        numbers, k = self.intrinsics, self.distortion
        if numbers.shape[:-1] != batch:
            numbers, k = (np.broadcast_to(each.reshape(-1), (*batch, each.size)) for each in (numbers, k))
        intrinsics, distortion = torch.from_numpy(numbers.copy()).as_subclass(nn.Parameter), torch.from_numpy(k.copy())
        distortion = distortion.as_subclass(nn.Parameter) if k.shape[-1] else distortion
        return remade(self.like, intrinsics=intrinsics, distortion=distortion, image_size=self.image_size)

    def transform_positions(self, points: Tensor) -> Tensor:
        """Return points (B, *N, 3) of the source's frame in the target's."""
        return turn(self.rotation, points, "points")

    def warp(self, source: Camera) -> Warp:
        if self._warp is None:
            self._warp = HalvingWarp(source, self.target, self.rotation, **self.options)
        return self._warp

    def starting_at(self, native: Native | None, rotation: Tensor | None) -> LazyWarp:
        """Return the warp from another camera, as native code takes it, by a rotation that may be a mirror."""
        natives = None if native is None or self.natives is None else (native, self.natives[1])
        may_mirror = rotation is not None and (rotation.ndim > 2 or not is_right(rotation))
        return replace(self, rotation=rotation, natives=natives, may_mirror=may_mirror)


@dataclass(slots=True)
class Part:
    """Rows of a batch that move by one warp, or stay as they are."""

    camera: Camera  # before the change; the warp's source
    motion: Warp | LazyWarp | None = None  # what the rows move by; None if nothing happens to them
    shades: tuple[Warp, Warp] | None = None  # how red and blue move, where they do not move as green
    light: Tensor | None = None  # (n or 1, 1, H', W'): what the lens lets through
    rows: list[int] | None = None  # which samples of the batch, or None for all

    @property
    def warp(self) -> Warp:
        assert self.motion is not None
        return self.motion.warp(self.camera) if isinstance(self.motion, LazyWarp) else self.motion

    @property
    def target(self) -> Camera:
        return self.camera if self.motion is None else self.motion.target

    @property
    def rotation(self) -> Tensor | None:
        """`ray_after = R ray_before`, (3, 3) or (n, 3, 3); None where nothing turns."""
        return None if self.motion is None else self.motion.rotation

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) after the change."""
        return self.camera.size_for("Warp") if self.motion is None else self.motion.image_size

    def with_warps(self, other: Callable[[Warp], Warp]) -> Part:
        """Return the part with another warp for each of its own: `other(warp)`."""
        shades = None if self.shades is None else (other(self.shades[0]), other(self.shades[1]))
        return replace(self, motion=None if self.motion is None else other(self.warp), shades=shades)

    def with_options(self, options: Options) -> Part:
        """Return the part with its warps made anew by other options."""
        if isinstance(self.motion, LazyWarp):
            return replace(self, motion=replace(self.motion, options=options))

        def optioned(warp: Warp) -> Warp:
            if warp.options == options:
                return warp
            return made_like(warp, warp.source, warp.target, warp.rotation, options)

        return self.with_warps(optioned)

    def take(self, index: list[int]) -> Part:
        """Return these rows of the part as a part of its own."""

        def of(camera: Camera) -> Camera:
            return camera[index] if camera.batch_shape else camera  # a single one serves all rows

        def taken(warp: Warp) -> Warp:
            rotation = warp.rotation if warp.rotation is None or warp.rotation.ndim == 2 else warp.rotation[index]
            return made_like(warp, camera, of(warp.target), rotation, warp.options, index)

        camera, light = of(self.camera), self.light
        light = light if light is None or len(light) == 1 else light[index]
        return replace(self.with_warps(taken), rows=None, camera=camera, light=light)

    def then(self, second: Part) -> Part:
        """Return one part that does with one warp, by the options of the second, what both do in turn."""
        first, last = self.motion, second.motion
        if last is None:
            return self
        if first is None:
            return replace(second, camera=self.camera)
        if isinstance(last, ShutterWarp):
            return self.with_warps(lambda warp: last.between(warp.source, warp.target, warp.rotation, **last.options))
        rotation = _turned(first.rotation, last.rotation)
        if isinstance(last, AffineWarp):
            return self._edited(last, rotation)
        if self.shades is not None or self.light is not None:
            raise ValueError(
                "Compose: chromatic and vignetting must be those of the last lens of a chain; got an earlier one, "
                "whose colours or light would be seen through another lens"
            )
        are_known = rotation is None or are_numbers(rotation)  # else the rotation may learn
        if isinstance(last, LazyWarp) and are_known and not self.camera.batch_shape:
            natives = first.natives if isinstance(first, LazyWarp) else None
            native = _single(self.camera) if natives is None else natives[0]
            return replace(second, camera=self.camera, motion=last.starting_at(native, rotation))
        moved = second.with_warps(lambda warp: HalvingWarp(self.camera, warp.target, rotation, **warp.options))
        return replace(moved, camera=self.camera)

    def _edited(self, edit: AffineWarp, rotation: Tensor | None) -> Part:
        """Return this part, then an edit, as one part; the rotation is that of both."""
        size = edit.target.image_size
        if isinstance(self.motion, AffineWarp):
            matrix = after(edit.map, self.motion.map)
            target = edited(self.camera, matrix, size)
            return replace(self, motion=AffineWarp(self.camera, target, matrix, rotation, **edit.options))

        def with_edit(warp: Warp) -> Warp:
            return HalvingWarp(self.camera, edited(warp.target, edit.map, size), rotation, **edit.options)

        light = None if self.light is None else edit(self.light, padding_mode="border")
        return replace(self.with_warps(with_edit), light=light)


def _turned(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """Return the rotation (3, 3) or (B, 3, 3) of two in turn; None is none."""
    if first is None or second is None:
        return second if first is None else first
    dtype = torch.promote_types(first.dtype, second.dtype)
    return (second.to(dtype).unsqueeze(-1) * first.to(dtype).unsqueeze(-3)).sum(-2)


def _single(camera: Camera) -> Native | None:
    """Return a single camera for native code; None if it cannot evaluate it."""
    if seam_of(camera) is not None or not are_numbers(*camera.tensors):
        return None
    rows = camera_rows(camera, *camera.tensors)
    return rows.native if rows.usable is None else None
