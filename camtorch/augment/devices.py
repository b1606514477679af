"""Changes of samples on other devices: cameras that do not learn are drawn on the CPU, and their numbers sent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor

from camtorch.augment.change import Change, TensorOrPair, as_is
from camtorch.augment.part import Part
from camtorch.augment.ranges import Draw
from camtorch.cameras.camera import Camera
from camtorch.cameras.mixed import Mixed
from camtorch.evaluate.devices import may_read, on_cpu, remember, sent
from camtorch.evaluate.door import outside_inference
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import is_unknown
from camtorch.native.library import native_available
from camtorch.values.module import remade
from camtorch.warp.affine import made_like

_twins = Kept(16)


def twin_of(camera: Camera) -> Camera | None:
    """Return a copy on the CPU, kept until values change.

    None if the camera is on the CPU already, learns, is traced, or the library is missing.
    """
    members = cast("list[Camera]", list(camera.cameras)) if isinstance(camera, Mixed) else [camera]
    if members[0].intrinsics.is_cpu or is_unknown(members[0].intrinsics) or not native_available():
        return None
    tensors = [t for one in members for t in one.tensors]
    if not may_read(*tensors):
        return None

    def made() -> Camera:
        values = iter(on_cpu(*tensors, may_wait=True) or ())
        twins = [remade(one, intrinsics=next(values), distortion=next(values)) for one in members]
        return camera.of_members(twins) if isinstance(camera, Mixed) else twins[0]

    return _twins(tensors, (camera.form,), made)


def remember_camera(camera: Camera, twin: Camera) -> None:
    """Have `twin_of` find the numbers of a camera that was made from its twin."""
    if isinstance(camera, Mixed) and isinstance(twin, Mixed):
        for (_, group), (_, its) in zip(camera.groups, twin.groups, strict=True):
            remember_camera(group, its)
        return
    for there, here in zip(camera.tensors, twin.tensors, strict=True):
        for shape in {there.shape, (*camera.batch_shape, there.shape[-1])}:  # also as calls expand it
            remember(there.expand(shape), here.expand(shape))


def change_on_host(camera: Camera, draw: Draw, make: Callable[[Camera, Draw], Change], may: bool) -> Change:
    """Return `make(camera, draw)`, computed on the CPU also for a fixed camera elsewhere, if the draw is there.

    may: whether new cameras follow from the numbers of cameras alone.
    """
    twin = None if camera.intrinsics.is_cpu or not may else twin_of(camera)
    if twin is None or not all(getattr(value, "is_cpu", True) for value in draw.values()):
        return make(camera, draw)
    return Elsewhere(make(twin, draw), camera.intrinsics.device)


class Elsewhere(Change):
    """A change whose cameras are computed on the CPU, of samples on another device."""

    def __init__(self, host: Change, device: torch.device):
        with outside_inference():
            parts = _remade(host.parts, lambda numbers: sent(numbers, device))
        super().__init__(host.count, parts, mixed=host.mixed, gate=host.gate)
        self.host, self._device = host, device
        self._wide: Change | None = None

    def each(
        self, value: Tensor, move: Callable[[Part, Tensor], TensorOrPair], stay: Callable[[Camera, Tensor], Any] = as_is
    ) -> TensorOrPair:
        of_cameras = self.parts[0].camera.intrinsics.dtype
        dtype = torch.promote_types(value.dtype, of_cameras) if value.dtype.is_floating_point else of_cameras
        if dtype == of_cameras:
            return super().each(value, move, stay)
        # labels are computed in the wider dtype, and so are the cameras' tables
        if self._wide is None:
            wide = _remade(self.host.parts, lambda numbers: [t.to(dtype) for t in numbers])
            self._wide = Elsewhere(self.host._with_parts(wide), self._device)
        return self._wide.each(value, move, stay)

    def camera_for_sample(self, batched: bool) -> Camera:
        camera = super().camera_for_sample(batched)
        remember_camera(camera, self.host.camera_for_sample(batched))
        return camera

    @property
    def mirrored(self) -> Tensor | None:
        mirrored = self.host.mirrored
        return None if mirrored is None else sent([mirrored], self._device)[0]

    def inverse(self) -> Change:
        self._inverse = self._inverse or Elsewhere(self.host.inverse(), self._device)
        return self._inverse


def _remade(parts: Sequence[Part], converted: Callable[[list[Tensor]], list[Tensor]]) -> list[Part]:
    """Return parts with all their numbers converted by one call; `twin_of` finds the cameras before."""
    given: list[Tensor] = []
    for part in parts:
        given += [t for camera in _cameras(part) for t in camera.tensors]
        given += [t for t in (part.rotation, part.light) if t is not None]
    numbers = iter(converted(given))

    # takes the next numbers, in the order in which `given` lists them
    def remade_as(camera: Camera) -> Camera:
        made = remade(camera, intrinsics=next(numbers), distortion=next(numbers))
        remember_camera(made, camera)
        return made

    made = []
    for part in parts:
        source, *targets = map(remade_as, _cameras(part))
        rotation, light = (None if t is None else next(numbers) for t in (part.rotation, part.light))
        warps = []
        for host, target in zip([part.warp, *(part.shades or ())], targets, strict=True) if targets else ():
            warps.append(made_like(host, source, target, rotation, host.options).follow_host(host))
        shades = (warps[1], warps[2]) if part.shades else None
        made.append(replace(part, motion=warps[0] if warps else None, camera=source, shades=shades, light=light))
    return made


def _cameras(part: Part) -> list[Camera]:
    """Return the cameras of a part: before, and after, of each colour."""
    if part.motion is None:
        return [part.camera]
    return [part.camera, part.target, *(warp.target for warp in part.shades or ())]
