"""New cameras of drawn numbers, by native code; `new_camera` in `drawer.py` has the same formulas in torch.

A `Start` holds all that is the same for each draw: the source, the base, and a struct of C with their numbers. It is
kept for as long as these stay. `warp` copies the struct, points it to the values of a draw and to room for the new
cameras, and calls C. C returns flags of what it lacked: limits of lenses, or the ends of the base. Python computes them
once, and calls again; those of the source and the base serve all later draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from ctypes import addressof, c_double, c_float
from functools import lru_cache, partial
from typing import Any, NamedTuple

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

_SIZES = {"centre": 2, "distortion": structs.AMOUNTS, "place": 2}
_CODES = {
    "yaw": structs.YAW,
    "pitch": structs.PITCH,
    "roll": structs.ROLL,
    "zoom": structs.ZOOM,
    "fov": structs.WIDTH,
    "focal": structs.FOCAL,
    "centre": structs.CENTRE,
    "distortion": structs.DISTORTION,
    "crop": structs.CROP,
    "place": structs.PLACE,
}
_TURNS = {"yaw", "pitch", "roll"}


@lru_cache(maxsize=64)
def _array(kind: type[c_double | c_float], count: int) -> Any:
    """Return the type of an array; ctypes makes a new one each time, in more time than the array takes."""
    return kind * count


class Wanted(NamedTuple):
    """What new cameras are made of, whatever is drawn."""

    source: Camera  # the camera before
    base: Camera  # whose lens the new ones have, single or (B,)
    sized: Tensor  # (4,) or (B, 4) in float64: intrinsics of the base for images of the new size
    covered_radius: Tensor | None  # of real lenses; see `reach` in `lenses.drawing.Lenses`
    size: tuple[int, int]  # (height, width) of new images
    names: Set[str]  # of the values that are drawn
    nominal: Tensor | None  # intrinsics (*B, 4) of the lens by which coefficients are measured, if they are jittered
    share: float | None  # of each image that has to be filled, if any has to
    owner: str  # the augmentation's name, for errors


class Start:
    """Cameras that others are drawn from, as native code takes them; kept for as long as their numbers stay."""

    @classmethod
    def of(cls, wanted: Wanted) -> Start | None:
        """Return a `Start`; None if C lacks a range or a model, dtypes differ, or some numbers are no camera's."""
        source, base = wanted.source, wanted.base
        if not wanted.names <= _CODES.keys():
            return None
        of_source, of_base = (
            camera_rows(camera, *[t.expand(*camera.batch_shape, t.shape[-1]) for t in camera.tensors])
            for camera in (source, base)
        )
        if of_source.native is None or of_base.native is None:
            return None
        if of_source.usable is not None or of_base.usable is not None:
            return None
        if {t.dtype for t in source.tensors} != {base.intrinsics.dtype}:
            return None
        return cls(wanted, of_source.native, of_base.native)

    def __init__(self, wanted: Wanted, source_native: Native, base_native: Native):
        """Start from the source and the base as native code takes them: `source_native` and `base_native`."""
        source, base, size = wanted.source, wanted.base, wanted.size
        self.base, self._source_native, self._base_native, self._size = base, source_native, base_native, size
        self._owner = wanted.owner
        self._is_flat = source.turn_axis is None and base.turn_axis is None
        self._names: list[str] = [name for name in _CODES if name in wanted.names]
        self._batch = tuple(wanted.sized.shape[:-1]) or base.batch_shape  # (B,) if each camera has a lens of its own
        self._types = (c_float, np.float32) if base_native.dtype == torch.float32 else (c_double, np.float64)
        self._needs_limits = False  # whether new lenses of an earlier call needed limits on azimuths
        self._distortion = base.distortion.detach()
        self._coefficients: np.ndarray[Any, Any] = self._distortion.numpy()
        self._sensitivity: Tensor | None = None  # to the values of `distortion`; None: coefficients stay
        count = self._distortion.shape[-1]
        call = self._call = structs.Draws(cameras=1, count=count, height=size[0], width=size[1])
        call.is_each = bool(self._batch)
        call.first[:] = [-1] * structs.DRAWN_KINDS
        self._drawn = 0  # how many numbers are drawn for a camera
        for name in self._names:
            call.first[_CODES[name]] = self._drawn
            self._drawn += _SIZES.get(name, 1)
        base_native.add_table()  # the table of the inverse, for cameras that unproject
        call.base, call.made, call.made.usable = base_native.pointer, base_native.struct, None
        call.made.cameras = 1
        call.sized = self._keep(wanted.sized)
        call.reach = None if wanted.covered_radius is None else self._keep(wanted.covered_radius.double())
        if wanted.share:
            call.share, call.source = with_care(wanted.share), source_native.pointer
            call.source_height, call.source_width = source.size_for("min_filled")
            call.looked_at = self._keep(looked_at(size, base_native.dtype))
            source_native.add_table()
        self._room = 4 + 9 + count  # how many numbers C writes for a camera; a lens that it makes takes more
        if wanted.nominal is not None:
            self._add_coefficients(wanted.nominal)

    def _keep(self, tensor: Tensor, *row: int) -> int:
        """Keep a tensor, of each camera if there are several, and return where its numbers lie."""
        return self._call.keep((tensor.expand(*self._batch, *row) if self._batch and row else tensor).contiguous())

    def _add_coefficients(self, nominal: Tensor) -> None:
        call, base, native, lenses = self._call, self.base, self._base_native, self._base_native.lenses
        plan = native.plan
        measured = measured_once(sensitivity, remade(base, image_size=self._size), base.distortion, nominal)
        self._sensitivity, call.sensitivity = measured, self._keep(measured, call.count)
        call.coefficients = self._keep(self._distortion, call.count)
        call.border = self._keep(border(self._size, native.dtype))
        call.made.limits2 = call.made.extent = None
        if plan.places is None or plan.chart_is_inverted or plan.is_long or not base.always_defined:
            return  # `_candidates` makes new lenses instead
        if plan.has_stages:
            call.domain = lenses.request
            if native.dtype not in plan.fixed_ends:
                return
            for name, radii in lenses.radii_wanted().items():
                setattr(call.domain, name, self._keep(radii))
        call.places = self._keep(plan.places)  # C makes the lenses
        self._room += plan.parameters + 4 + TABLE_WIDTH

    def warp(self, values: Mapping[str, Any], base: Camera, options: Options) -> LazyWarp:
        """Return the warp to cameras like `base` of values (B,) and (B, size), or numbers and lists for one."""
        call, native, (number, dtype) = structs.Draws.from_buffer_copy(self._call), self._base_native, self._types
        packed, batch = self._packed(values)
        jitters, c_makes_lenses = self._sensitivity is not None, call.places is not None
        rows = batch[0] if batch else 1
        # numpy cuts this in half the time of torch
        room = _array(number, rows * self._room)()
        numbers = np.frombuffer(room, dtype)
        call.values, call.room = addressof(packed), addressof(room)
        if rows != 1:  # as they are one at first
            call.cameras = call.made.cameras = rows
        if call.share:
            shares = _array(c_double, 2 * rows)()  # the factors, and what is filled
            call.factors = addressof(shares)
            call.filled = call.factors + 8 * rows
        candidates = self._candidates(values, call) if rows and jitters and not c_makes_lenses else None
        if self._needs_limits:
            self._add_limits(call)
        run = loaded().camtorch_draws
        while (left := run(call)) & ~structs.NO_CAMERA:
            self._complete(left, values, call, candidates)
        if jitters and call.followed < rows:
            call.made.limits2 = call.made.extent = None
        # C writes the intrinsics of all cameras, then their rotations, their coefficients, and the rest of their lenses
        intrinsics, rotation, k, made = numbers[: 4 * rows].reshape(*batch, 4), None, self._coefficients, None
        if not _TURNS.isdisjoint(self._names):
            rotation = torch.from_numpy(numbers[4 * rows : 13 * rows].reshape(*batch, 3, 3))
        if jitters:
            k = numbers[13 * rows : (13 + call.count) * rows].reshape(*batch, call.count)
        if self._is_flat and not left:
            if c_makes_lenses or (not jitters and native.cameras == rows):
                # the function keeps the call, of which the struct is a part, and all that this points to
                made = Native(native.plan, call.made, partial(self._lenses, call, room, k))
            elif not batch:
                made = single_native(model_of(self.base), torch.from_numpy(intrinsics), torch.from_numpy(k))
        shares = (shares[:rows], shares[rows:]) if call.share else ()
        return LazyWarp(base, intrinsics, k, self._size, rotation, options, self._source_native, made, *shares)

    def _packed(self, values: Mapping[str, Any]) -> tuple[Any, tuple[int, ...]]:
        """Return drawn values kind after kind, as C takes them, and (B,); () for numbers and lists of one camera."""
        given: Any = [*map(values.__getitem__, self._names)]
        if given and isinstance(given[0], np.ndarray):
            batch = self._batch or (len(given[0]),)
            given = np.concatenate(given, None)
            self._check_count(len(given), batch[0])
            return _array(c_double, len(given)).from_buffer(given), batch
        if len(given) < self._drawn:  # some values are several numbers
            flat: list[float] = []
            for value in given:
                flat += value if isinstance(value, list) else (value,)
            given = flat
        if len(given) != self._drawn:
            self._check_count(len(given), 1)
        return _array(c_double, len(given))(*given), self._batch

    def _check_count(self, count: int, rows: int) -> None:
        """Raise a ValueError unless so many numbers are what cameras are made of, as C reads all of them."""
        if count != self._drawn * rows:
            sizes = ", ".join(f"{name} as Range(low, high, {size})" for name, size in _SIZES.items())
            raise ValueError(
                f"{self._owner}: ranges must draw {self._drawn} numbers for a sample, {sizes}, and others as "
                f"Range(low, high); got {count} for {rows} samples"
            )

    def _complete(self, left: int, values: Mapping[str, Any], call: structs.Draws, candidates: Native | None) -> None:
        """Compute the limits and ends that C lacked, of new lenses and of the cameras that it starts from."""
        if left & structs.TOO_WIDE:
            raise ValueError(
                f"{self._owner}: fov must be within the reach of a {self.base.key} lens of these coefficients; got "
                f"{np.max(values['fov']):g} degrees"
            )
        if left & structs.LEFT_LENS and candidates is not None:
            candidates.follow()
        elif left & structs.LEFT_LENS:
            self._needs_limits = True
            self._add_limits(call)
        if left & structs.LEFT_BASE:
            self._base_native.follow()
        if left & structs.LEFT_SOURCE:
            self._source_native.follow()
        if left & structs.LEFT_ENDS:
            ends = measured_once(lens_ends, remade(self.base, image_size=self._size), self._distortion)
            self._call.ends = call.ends = self._keep(ends, *ends.shape[-2:])

    def _add_limits(self, call: structs.Draws) -> None:
        """Allocate limits and extents of new lenses."""
        call.made.limits2, call.made.extent = (
            call.keep(torch.empty(call.cameras * count, dtype=self._base_native.dtype, device="cpu"))
            for count in (structs.AZIMUTHS, structs.EXTENT)
        )

    def _candidates(self, values: Mapping[str, Any], call: structs.Draws) -> Native:
        """Make the lenses that native code chooses among, of a model whose domain it does not make by itself."""
        measured = present(self._sensitivity, "the sensitivity to the values of distortion")
        amounts = torch.from_numpy(np.asarray(values["distortion"]).reshape(-1, structs.AMOUNTS))
        steps = (amounts.repeat(1, -(-call.count // structs.AMOUNTS))[:, : call.count] * measured)[:, None]
        given = self._distortion.double().reshape(-1, 1, call.count)
        tried = (given + given.new_tensor(structs.JITTER_PARTS)[:, None] * steps).to(self._base_native.dtype)
        tried, allowed = defined_or(self.base, tried, given.to(tried).expand_as(tried))
        tried = tried.reshape(call.cameras * len(structs.JITTER_PARTS), call.count)
        lenses = CameraRows(model_of(self.base), tried.new_ones(len(tried), 4), tried)
        native = present(lenses.native, "compiled code for lenses like the base")
        native.add_table()
        call.tries, call.tried, call.allowed = native.pointer, tried.data_ptr(), address(allowed)
        call.hold((tried, allowed))
        return native

    def _lenses(self, call: structs.Draws, room: object, coefficients: np.ndarray[Any, Any]) -> Lenses:
        """Return the lenses of new cameras: those of the base, or new ones, kept for later ones of the same numbers."""
        if self._sensitivity is None:
            return self._base_native.lenses
        plan, model = self._base_native.plan, model_of(self.base)
        k = torch.from_numpy(coefficients.reshape(call.cameras, call.count))

        def new() -> Lenses:
            struct = structs.Cameras.from_buffer_copy(call.made)
            struct.hold((call, room, self))
            return Lenses(plan, model.optics, k, partial(domain_for, model, k, False), struct)

        return lenses_of(plan, k, new)
