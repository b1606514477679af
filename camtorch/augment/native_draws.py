"""New cameras of drawn numbers, by native code; `new_camera` in `drawer.py` has the same formulas in torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from ctypes import addressof, c_double, c_float
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.change import LazyWarp
from camtorch.augment.filling import looked_at, with_care
from camtorch.augment.jitter import border, lens_ends, measured_once, sensitivity
from camtorch.cameras.camera import Camera
from camtorch.native import structs
from camtorch.native.library import loaded
from camtorch.optics.radial_inverse import TABLE_WIDTH
from camtorch.projection.evaluation import camera_rows
from camtorch.projection.native_cameras import Lenses, Native, address, lenses_of
from camtorch.projection.rows import CameraRows, domain_for, single_native
from camtorch.rays.lattices import defined_or
from camtorch.values.arguments import present
from camtorch.values.module import model_of, remade
from camtorch.warp.options import Options
from camtorch.warp.panorama import PANORAMAS

_SIZES = {"centre": 2, "distortion": structs.AMOUNTS, "place": 2}
_KINDS = {"yaw": structs.YAW, "pitch": structs.PITCH, "roll": structs.ROLL, "zoom": structs.ZOOM, "fov": structs.WIDTH}
_KINDS |= {"focal": structs.FOCAL, "centre": structs.CENTRE, "distortion": structs.DISTORTION, "crop": structs.CROP}
_KINDS["place"] = structs.PLACE
_TURNS = {"yaw", "pitch", "roll"}


@lru_cache(maxsize=64)
def _array(kind: type[c_double | c_float], count: int) -> Any:
    """Return the type of an array; ctypes makes a new one each time, in more time than the array takes."""
    return kind * count


class Start:
    """Cameras that others are drawn from, as native code takes them; kept for as long as their numbers stay."""

    @staticmethod
    def draws(names: Set[str]) -> bool:
        """Whether native code knows all ranges of these names."""
        return names <= _KINDS.keys()

    @classmethod
    def of(cls, source: Camera, base: Camera, *numbers: Any) -> Start | None:
        """Return a `Start`; None if native code lacks a model, dtypes differ, or some numbers are no camera's.

        source: the camera before. base: whose lens the new ones have, single or (B,). numbers: see `__init__`.
        """
        before, cameras = (
            camera_rows(camera, *[t.expand(*camera.batch_shape, t.shape[-1]) for t in camera.tensors])
            for camera in (source, base)
        )
        if before.native is None or cameras.native is None or before.usable is not None or cameras.usable is not None:
            return None
        if {t.dtype for t in source.tensors} != {base.intrinsics.dtype}:
            return None
        return cls(source, before.native, base, cameras.native, *numbers)

    def __init__(
        self,
        source: Camera,
        before: Native,
        base: Camera,
        native: Native,
        sized: Tensor,
        reach: Tensor | None,
        size: tuple[int, int],
        names: Sequence[str],
        nominal: Tensor | None,
        share: float | None,
    ):
        """Start from intrinsics `sized`, (4,) or (B, 4) in float64, for images of a size.

        reach: see `lenses.drawing.Lenses`. names: of the values that are drawn. nominal: intrinsics (*B, 4) of the lens
        by which coefficients are measured, if they move. share: of each image that has to be filled, if any has to.
        """
        self.before, self.base, self.size, self._native = before, base, size, native
        self.names: list[str] = [name for name in _KINDS if name in names]
        self._has_rows = not _SIZES.keys().isdisjoint(names)  # whether some values are several numbers
        self._share, self._is_flat = share, not isinstance(source, PANORAMAS) and not isinstance(base, PANORAMAS)
        self._rows = len(sized) if sized.ndim == 2 else native.cameras if base.batch_shape else 0
        self._turns, self._moves, self._knows = not _TURNS.isdisjoint(names), nominal is not None, False
        self._kinds = (c_float, np.float32) if native.dtype == torch.float32 else (c_double, np.float64)
        self._follows = False  # whether new lenses need limits on azimuths
        self._distortion = base.distortion.detach()
        self._coefficients: np.ndarray[Any, Any] = self._distortion.numpy()
        count = self._distortion.shape[-1]
        call = self._call = structs.Draws(cameras=1, count=count, height=size[0], width=size[1], is_each=self._rows > 0)
        call.first[:] = [-1] * structs.DRAWN_KINDS
        at, self._room = 0, 13 + count
        for name in self.names:
            call.first[_KINDS[name]], at = at, at + _SIZES.get(name, 1)
        native.add_table()  # the table of the inverse, for cameras that unproject
        call.base, call.made, call.made.usable = native.pointer, native.struct, None
        call.made.cameras = 1
        call.sized = self._keep(sized)
        call.reach = None if reach is None else self._keep(reach.double())
        if share:
            call.share, call.source = with_care(share), before.pointer
            call.source_height, call.source_width = source.size_for("min_filled")
            call.looked_at = self._keep(looked_at(size, native.dtype))
            before.add_table()
        if nominal is not None:
            self._add_coefficients(nominal)

    def _keep(self, tensor: Tensor, *row: int) -> int:
        """Keep a tensor, of each camera if there are several, and return where its numbers lie."""
        return self._call.keep((tensor.expand(self._rows, *row) if self._rows and row else tensor).contiguous())

    def _add_coefficients(self, nominal: Tensor) -> None:
        call, base, native, lenses = self._call, self.base, self._native, self._native.lenses
        plan = native.plan
        measured = measured_once(sensitivity, remade(base, image_size=self.size), base.distortion, nominal)
        self._sensitivity, call.sensitivity = measured, self._keep(measured, call.count)
        call.coefficients = self._keep(self._distortion, call.count)
        call.border = self._keep(border(self.size, native.dtype))
        call.made.limits2 = call.made.extent = None
        if plan.places is None or plan.is_chart or plan.is_long or not base.always_defined:
            return  # `_tries` makes new lenses instead
        if plan.has_stages:
            call.domain = lenses.asked
            if native.dtype not in plan.fixed_ends:
                return
            for name, radii in lenses.radii_wanted().items():
                setattr(call.domain, name, self._keep(radii))
        self._knows, call.places = True, self._keep(plan.places)
        self._room += plan.parameters + 4 + TABLE_WIDTH

    def _limits(self, call: structs.Draws, rows: int) -> list[Any]:
        """Allocate limits and extents of new lenses, and return the tensors."""
        kept = [
            torch.empty(rows * count, dtype=self._native.dtype, device="cpu")
            for count in (structs.AZIMUTHS, structs.EXTENT)
        ]
        call.made.limits2, call.made.extent = (tensor.data_ptr() for tensor in kept)
        return kept

    def warp(self, values: Mapping[str, Any], base: Camera, options: Options) -> LazyWarp:
        """Return the warp to cameras like `base` of values (B,) and (B, size), or numbers and lists for one."""
        call, native, names = structs.Draws.from_buffer_copy(self._call), self._native, self.names
        given: Any = [*map(values.__getitem__, names)]
        is_one, rows, (of_numbers, dtype) = not self._rows, self._rows or 1, self._kinds
        if given and isinstance(given[0], np.ndarray):
            is_one, rows = False, self._rows or len(given[0])
        if not is_one and given:
            given = np.concatenate(given, None)
            call.values = given.ctypes.data
        elif is_one:
            if self._has_rows:
                flat: list[float] = []
                for value in given:
                    flat += value if isinstance(value, list) else (value,)
                given = flat
            given = _array(c_double, len(given))(*given)
            call.values = addressof(given)
        # numpy cuts this in half the time of torch
        room = _array(of_numbers, rows * self._room)()
        numbers = np.frombuffer(room, dtype)
        call.room = addressof(room)
        if rows != 1:  # as they are one at first
            call.cameras = call.made.cameras = rows
        filled: Sequence[float] = ()
        if self._share:
            filled = shares = _array(c_double, 2 * rows)()  # the factors, and what is filled
            call.factors = addressof(shares)
            call.filled = call.factors + 8 * rows
        tries = self._tries(values, rows, call) if rows and self._moves and not self._knows else None
        kept: list[Any] = [numbers]
        run = loaded().camtorch_draws
        if self._follows:  # an earlier call has needed limits
            kept += self._limits(call, rows)
        while (left := run(call)) & ~structs.NO_CAMERA:
            if left & structs.TOO_WIDE:
                widest = np.max(values["fov"])
                raise ValueError(
                    f"fov must be within the reach of a {base.key} lens of these coefficients; got {widest:g} degrees"
                )
            if left & structs.LEFT_LENS and tries is not None:
                tries.follow()
            elif left & structs.LEFT_LENS:
                self._follows = True
                kept += self._limits(call, rows)
            self._follow(left, call)
        if self._moves and call.followed < rows:
            call.made.limits2 = call.made.extent = None
        intrinsics, rotation, k = numbers[: 4 * rows], None, self._coefficients
        if self._turns:
            rotation = torch.from_numpy(numbers[4 * rows : 13 * rows].reshape((3, 3) if is_one else (rows, 3, 3)))
        if self._moves:
            k = numbers[13 * rows : (13 + call.count) * rows]
            k = k if is_one else k.reshape(rows, call.count)
        if not is_one:
            intrinsics = intrinsics.reshape(rows, 4)
        made, serves = None, self._is_flat and not left
        if serves and (self._knows or (not self._moves and native.cameras == rows)):
            lenses = partial(self._lenses, numbers, rows) if self._knows else lambda _: native.lenses
            made = Native.made(native, call.made, (call, kept, self), lenses)
        elif serves and is_one:
            made = single_native(model_of(self.base), torch.from_numpy(intrinsics), torch.from_numpy(k))
        return LazyWarp(base, intrinsics, k, self.size, rotation, options, self.before, made, filled)

    def _follow(self, left: int, call: structs.Draws) -> None:
        """Compute limits and ends that C lacked of the cameras that it starts from."""
        if left & structs.LEFT_BASE:
            self._native.follow()
        if left & structs.LEFT_SOURCE:
            self.before.follow()
        if left & structs.LEFT_ENDS:
            ends = measured_once(lens_ends, remade(self.base, image_size=self.size), self._distortion)
            self._call.ends = call.ends = self._keep(ends, *ends.shape[-2:])

    def _tries(self, values: Mapping[str, Any], rows: int, call: structs.Draws) -> Native:
        """Make the lenses that native code chooses among, of a model whose domain it does not make by itself."""
        amounts = torch.from_numpy(np.asarray(values["distortion"]).reshape(-1, structs.AMOUNTS))
        steps = (amounts.repeat(1, -(-call.count // structs.AMOUNTS))[:, : call.count] * self._sensitivity)[:, None]
        given = self._distortion.double().reshape(-1, 1, call.count)
        tried = (given + given.new_tensor(structs.JITTER_PARTS)[:, None] * steps).to(self._native.dtype)
        tried, allowed = defined_or(self.base, tried, given.to(tried).expand_as(tried))
        tried = tried.reshape(rows * len(structs.JITTER_PARTS), call.count)
        lenses = CameraRows(model_of(self.base), tried.new_ones(len(tried), 4), tried)
        native = present(lenses.native, "compiled code for lenses like the base")
        native.add_table()
        call.tries, call.tried, call.allowed = native.pointer, tried.data_ptr(), address(allowed)
        call.hold((tried, allowed))
        return native

    def _lenses(self, numbers: Any, rows: int, made: Native) -> Lenses:
        """Return the new lenses with their domains, kept for later cameras with the same coefficients."""
        model, count = model_of(self.base), self._call.count
        k = torch.from_numpy(numbers[13 * rows : (13 + count) * rows].reshape(rows, count))
        domain = partial(domain_for, model, k, False)
        return lenses_of(made.plan, k, lambda: Lenses.known(made.plan, model.optics, k, domain, made))
