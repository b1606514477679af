"""New cameras of drawn numbers, by compiled code; `drawer.py` has the same formulas, recorded by torch."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from ctypes import addressof, byref, c_double, c_int64
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.change import Drawn
from camtorch.augment.jitter import DRAWN, PARTS, border, defined_or, lens_ends, measured_once, sensitivity
from camtorch.cameras.camera import Camera
from camtorch.projection.evaluation import rows_of
from camtorch.projection.native_cameras import (
    CamerasStruct,
    DomainStruct,
    Lenses,
    Native,
    address,
    entry,
    fields,
    keep_lenses,
)
from camtorch.projection.rows import CameraRows, domain_for, single_native
from camtorch.values.module import model_of, remade
from camtorch.warp.sampling import Options

_SIZES = {"centre": 2, "distortion": DRAWN, "place": 2}
_KINDS = "yaw", "pitch", "roll", "zoom", "fov", "focal", "centre", "distortion", "crop", "place"
_TURNS = {"yaw", "pitch", "roll"}
_LEFT_BASE, _LEFT_LENS, _LEFT_ENDS, _TOO_WIDE, _NO_CAMERA = 1, 2, 4, 8, 16
_TABLE, _AZIMUTHS, _EXTENT = 2 + 2 * 1024, 336, 80 + 336 * 80 + 336  # numbers of a camera; see geometry.h


class _Draws(ctypes.Structure):
    """`Draws` of draws.h."""

    _fields_ = fields(
        "*values first cameras count height width is_each *sized *reach *coefficients *sensitivity *ends *base *border "
        "*places domain *tries *tried *allowed made *distortion *rotations followed",
        first=c_int64 * len(_KINDS),
        height=c_double,
        width=c_double,
        domain=DomainStruct,
        made=CamerasStruct,
    )


class Start:
    """Cameras that others are drawn from, as compiled code takes them; kept for as long as their numbers stay."""

    @classmethod
    def of(cls, source: Camera, base: Camera, *numbers: Any) -> Start | None:
        """Return it, or None where compiled code does not know a model, or a camera is none.

        source: the camera before. base: whose lens the new ones have, single or (B,). numbers: see `__init__`.
        """
        before, cameras = (
            rows_of(camera, *[t.expand(*camera.batch_shape, t.shape[-1]) for t in camera._tensors])
            for camera in (source, base)
        )
        if cameras.native is None or cameras.usable is not None or before.usable is not None:
            return None
        return cls(before.native, base, cameras.native, *numbers)

    def __init__(
        self,
        before: Native | None,
        base: Camera,
        native: Native,
        sized: Tensor,
        reach: Tensor | None,
        size: tuple[int, int],
        names: Sequence[str],
        nominal: Tensor | None,
    ):
        """Of intrinsics `sized`, (4,) or (B, 4) in float64, before images of a size.

        reach: see `lenses.drawing.Lenses`. names: of the values that are drawn. nominal: intrinsics (*B, 4) of the lens
        by which coefficients are measured, if they move.
        """
        self.before, self.native, self.size = before, native, size
        self._model, self.base, self._names = model_of(base), base, [name for name in _KINDS if name in names]
        self._rows = len(sized) if sized.ndim == 2 else native.cameras if base.batch_shape else 0
        self._turns, self._count = not _TURNS.isdisjoint(names), base.distortion.shape[-1]
        self.distortion = base.distortion.detach()
        self._kept: list[Any] = []
        call = self._call = _Draws(count=self._count, height=size[0], width=size[1], is_each=self._rows > 0)
        at, call.first[:] = 0, [-1] * len(_KINDS)
        for name in self._names:
            call.first[_KINDS.index(name)], at = at, at + _SIZES.get(name, 1)
        call.base, call.made = native.pointer, native.struct
        call.made.usable = call.made.limits2 = call.made.extent = None
        call.sized = self._keep(sized)
        call.reach = None if reach is None else self._keep(reach.double())
        self._moves = nominal is not None
        self._is_known = False
        if nominal is not None:
            self._add_coefficients(nominal)

    def _keep(self, tensor: Tensor, *row: int) -> int:
        """Keep a tensor, of each camera if there are several, and return where its numbers lie."""
        tensor = (tensor.expand(self._rows, *row) if self._rows and row else tensor).contiguous()
        self._kept.append(tensor)
        return tensor.data_ptr()

    def _add_coefficients(self, nominal: Tensor) -> None:
        call, plan, base, lenses = self._call, self.native.plan, self.base, self.native.lenses
        lens = remade(base, image_size=self.size)
        self._sensitivity = measured_once(sensitivity, lens, base.distortion, nominal)
        call.sensitivity = self._keep(self._sensitivity, self._count)
        call.coefficients = self._keep(self.distortion, self._count)
        call.border = self._keep(border(self.size, self.native.dtype))
        self.native.add_table()
        if plan.places is None or plan.is_chart or plan.is_long or not base.always_defined:
            return  # compiled code alone does not make these
        domain = lenses.asked if plan.has_stages else DomainStruct()
        if plan.has_stages and not plan.has_fixed_ends(self.native.dtype):
            return
        self._is_known, call.domain, call.places = True, domain, self._keep(plan.places)
        for name, count in lenses.radii_wanted().items() if plan.has_stages else ():
            setattr(call.domain, name, self._keep(count))

    def drawn(self, values: Mapping[str, Any], base: Camera, options: Options) -> Drawn:
        """Return the new cameras, modules like `base`, of values (B,) and (B, size), or numbers and lists for one."""
        call, plan, wide = _Draws.from_buffer_copy(self._call), self.native.plan, self.native.dtype.itemsize
        given = [values[name] for name in self._names]
        several = [len(value) for value in given if isinstance(value, np.ndarray)]
        rows, is_one = self._rows or (several[0] if several else 1), not (self._rows or several)
        if is_one:
            flat = [number for value in given for number in (value if isinstance(value, list) else (value,))]
            numbers: Any = (c_double * len(flat))(*flat)
            call.values = addressof(numbers)
        elif given:
            numbers = np.concatenate(given, None)
            call.values = numbers.ctypes.data
        call.cameras = call.made.cameras = rows
        sizes = {"intrinsics": 4, "rotations": 9 * self._turns, "distortion": self._count * self._moves}
        if self._is_known:
            sizes["parameters"] = plan.parameters
            if plan.has_stages:
                sizes |= {"inner2": 1, "usual2": 1, "table": _TABLE * plan.has_factor}
                sizes |= {"circle2": plan.has_rest, "stagewise": plan.has_rest}
        room = torch.empty(rows * sum(sizes.values()), dtype=self.native.dtype, device="cpu")
        at, places = 0, {}
        for name, size in sizes.items():
            if size:
                places[name], at = room[at : at + rows * size], at + rows * size
                setattr(call if name in ("rotations", "distortion") else call.made, name, places[name].data_ptr())
        tries = self._tries(values, rows, call) if self._moves and not self._is_known else None
        run, more = entry("camtorch_draws", c_int64), None
        while (left := run(byref(call))) & ~_NO_CAMERA:
            if left & _TOO_WIDE:
                widest = np.max(values["fov"])
                raise ValueError(f"fov: a {base.key} lens of these coefficients does not reach {widest:g} degrees")
            if left & _LEFT_BASE:
                self.native.follow()
            if left & _LEFT_ENDS:
                lens = remade(self.base, image_size=self.size)
                ends = measured_once(lens_ends, lens, self.distortion)
                self._call.ends = call.ends = self._keep(ends, *ends.shape[-2:])
            if left & _LEFT_LENS and tries is not None:
                tries.follow()
            elif left & _LEFT_LENS:
                more = torch.empty(rows * (_AZIMUTHS + _EXTENT), dtype=self.native.dtype, device="cpu")
                call.made.limits2, call.made.extent = more.data_ptr(), more.data_ptr() + rows * _AZIMUTHS * wide
        intrinsics, distortion = places["intrinsics"].view(rows, 4), self.distortion
        if self._moves:
            distortion = places["distortion"].view(rows, self._count)
            if self._is_known:
                self._keep_lenses(call, distortion, room, more)
        rotation = places["rotations"].view(rows, 3, 3) if self._turns else None
        drawn = Drawn(base, intrinsics, distortion, self.size, rotation, options, self.before)
        if is_one:
            drawn.intrinsics, drawn.rotation = intrinsics[0], None if rotation is None else rotation[0]
            drawn.distortion = distortion[0] if self._moves else distortion
            if left:
                drawn.start = None
            elif self._moves:
                drawn.native = single_native(self._model, drawn.intrinsics, drawn.distortion)
            else:
                drawn.native = self.native.before(intrinsics)
        return drawn

    def _tries(self, values: Mapping[str, Any], rows: int, call: _Draws) -> Native | None:
        """Make the lenses that compiled code chooses among, of a model whose domain it does not make by itself."""
        amounts = torch.as_tensor(np.asarray(values["distortion"]).reshape(-1, DRAWN))
        steps = (amounts.repeat(1, -(-self._count // DRAWN))[:, : self._count] * self._sensitivity)[:, None]
        given = self.distortion.double().reshape(-1, 1, self._count)
        tried = (given + torch.tensor(PARTS, dtype=torch.float64)[:, None] * steps).to(self.native.dtype)
        tried, allowed = defined_or(self.base, tried, given.to(tried).expand_as(tried))
        tried = tried.reshape(rows * len(PARTS), self._count)
        native = CameraRows(self._model, tried.new_ones(len(tried), 4), tried).native
        assert native is not None  # as the base has one
        native.add_table()
        call.tries, call.tried, call.allowed = native.pointer, tried.data_ptr(), address(allowed)
        call.kept = tried, allowed
        return native

    def _keep_lenses(self, call: _Draws, distortion: Tensor, room: Tensor, more: Tensor | None) -> None:
        """Keep what was found of new lenses, which whoever evaluates the cameras asks for."""
        struct = CamerasStruct.from_buffer_copy(call.made)
        struct.intrinsics = None
        if more is None or call.followed < len(distortion):
            struct.limits2 = struct.extent = None
        domain = partial(domain_for, self._model, distortion, False)
        lenses = Lenses.known(self.native.plan, self._model.optics, distortion, domain, struct, (room, more))
        keep_lenses(lenses, distortion)
