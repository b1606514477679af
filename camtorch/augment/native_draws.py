"""New cameras of drawn numbers, by native code; `new_camera` in `drawer.py` has the same formulas in torch.

A `Start` holds all that is the same for each draw: the source, the base, and the struct that C reads, with their
numbers; `native/draws.h` describes its fields. `Start.warp` then draws in four steps: it copies the struct, packs the
values of a draw, has C write the new cameras, and reads these.

The lens of a new camera is that of the base, unless its coefficients are jittered. Then C makes it, or if C cannot
compute where such a lens ends, Python makes candidates, and C chooses among them.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from ctypes import addressof, c_double, c_float
from functools import lru_cache, partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.filling import looked_at, with_care
from camtorch.augment.jitter import border, lens_ends, measured_once, sensitivity
from camtorch.augment.part import LazyWarp
from camtorch.cameras.camera import Camera
from camtorch.native import structs
from camtorch.native.library import loaded
from camtorch.optics.radial_inverse import TABLE_WIDTH
from camtorch.projection.evaluation import camera_rows
from camtorch.projection.native_cameras import Lenses, Native, address, lenses_of, native_of
from camtorch.projection.rows import CameraRows
from camtorch.rays.lattices import defined_or
from camtorch.values.arguments import present
from camtorch.values.module import model_of, remade
from camtorch.warp.options import Options

# Name of a range -> the code that C has for its values, and how many numbers each is
DRAWN_KINDS = {
    "yaw": (structs.YAW, 1),
    "pitch": (structs.PITCH, 1),
    "roll": (structs.ROLL, 1),
    "zoom": (structs.ZOOM, 1),
    "fov": (structs.WIDTH, 1),
    "focal": (structs.FOCAL, 1),
    "centre": (structs.CENTRE, 2),
    "distortion": (structs.DISTORTION, structs.AMOUNTS),
    "crop": (structs.CROP, 1),
    "place": (structs.PLACE, 2),
}
_TURNS = {"yaw", "pitch", "roll"}
# How many numbers C writes for a camera, before its coefficients
_INTRINSICS, _ROTATION = 4, 9


@lru_cache(maxsize=64)
def _array(kind: type[c_double | c_float], count: int) -> Any:
    """Return the type of an array; ctypes makes a new one each time, in more time than the array takes."""
    return kind * count


def too_wide(owner: str, base: Camera, fov: float) -> ValueError:
    """Return the error of a field of view in degrees that a lens does not have."""
    reach = f"the reach of a {base.key} lens of these coefficients"
    return ValueError(f"{owner}: fov must be within {reach}; got {fov:g} degrees")


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


def _rows_of(camera: Camera) -> CameraRows:
    tensors = [t.expand(*camera.batch_shape, t.shape[-1]) for t in camera.tensors]
    return camera_rows(camera, *tensors)


class Start:
    """Cameras that others are drawn from, as native code takes them; kept for as long as their numbers stay."""

    @classmethod
    def of(cls, wanted: Wanted) -> Start | None:
        """Return a `Start`; None if C lacks a range or a model, dtypes differ, or some numbers are no camera's."""
        source, base = wanted.source, wanted.base
        if not wanted.names <= DRAWN_KINDS.keys():
            return None
        of_source, of_base = _rows_of(source), _rows_of(base)
        if of_source.native is None or of_base.native is None:
            return None
        if of_source.usable is not None or of_base.usable is not None:  # flags of the numbers that are no camera's
            return None
        if {t.dtype for t in source.tensors} != {base.intrinsics.dtype}:
            return None
        return cls(wanted, of_source.native, of_base.native)

    def __init__(self, wanted: Wanted, source_native: Native, base_native: Native):
        """Start from the source and the base as native code takes them: `source_native` and `base_native`."""
        source, base = wanted.source, wanted.base
        self.base, self._source_native, self._base_native = base, source_native, base_native
        self._size, self._owner = wanted.size, wanted.owner
        self._keeps_lens = base is source
        self._is_flat = source.turn_axis is None and base.turn_axis is None
        self._batch = tuple(wanted.sized.shape[:-1]) or base.batch_shape  # (B,) if each camera has a lens of its own
        self._distortion = base.distortion.detach()
        self._coefficients: np.ndarray[Any, Any] = self._distortion.numpy()  # of new cameras, unless they are jittered
        self._sensitivity: Tensor | None = None  # of the image to the values of `distortion`, if they are jittered
        self._lenses_by: Literal["base", "C", "candidates"] = "base"  # how new cameras come to their lenses
        self._needs_limits = False  # whether new lenses of an earlier call needed limits on azimuths
        height, width = wanted.size
        count = self._distortion.shape[-1]
        self._call = structs.Draws(count=count, height=height, width=width)
        self._room = _INTRINSICS + _ROTATION + count  # how many numbers C writes for a camera; a lens takes more
        self._types = (c_float, np.float32) if base_native.dtype == torch.float32 else (c_double, np.float64)
        self._add_base(wanted)
        if wanted.share:
            self._add_source(wanted.share, source)
        self._add_values(wanted.names)
        if wanted.nominal is not None:
            self._add_coefficients(wanted.nominal)

    def _keep(self, tensor: Tensor, *row: int) -> int:
        """Keep a tensor, of each camera if there are several, and return where its numbers lie."""
        if self._batch and row:
            tensor = tensor.expand(*self._batch, *row)
        return self._call.keep(tensor.contiguous())

    def _add_base(self, wanted: Wanted) -> None:
        """Give new cameras the lens of the base, which is copied with its table, for those that unproject."""
        call, native = self._call, self._base_native
        native.add_table()
        call.base, call.made, call.made.usable = native.pointer, native.struct, None
        call.is_each, call.sized = bool(self._batch), self._keep(wanted.sized)
        call.reach = None if wanted.covered_radius is None else self._keep(wanted.covered_radius.double())

    def _add_source(self, share: float, source: Camera) -> None:
        """Have C look at the source, as a share of new images has to be filled."""
        call, native = self._call, self._source_native
        native.add_table()
        call.share, call.source = with_care(share), native.pointer
        call.source_height, call.source_width = source.size_for("min_filled")
        call.looked_at = self._keep(looked_at(self._size, self._base_native.dtype))

    def _add_values(self, names: Set[str]) -> None:
        """State where the drawn numbers of each kind begin."""
        self._names = [name for name in DRAWN_KINDS if name in names]
        self._turns = not _TURNS.isdisjoint(names)
        self._drawn = 0  # how many numbers are drawn for a camera
        self._call.first[:] = [-1] * structs.DRAWN_KINDS
        for name in self._names:
            code, size = DRAWN_KINDS[name]
            self._call.first[code] = self._drawn
            self._drawn += size

    def _add_coefficients(self, nominal: Tensor) -> None:
        """Have coefficients jittered, by steps that are measured on a lens of nominal intrinsics."""
        call, base, native, plan = self._call, self.base, self._base_native, self._base_native.plan
        measured = measured_once(sensitivity, remade(base, image_size=self._size), base.distortion, nominal)
        self._lenses_by, self._sensitivity = "candidates", measured
        call.sensitivity = self._keep(measured, call.count)
        call.coefficients = self._keep(self._distortion, call.count)
        call.border = self._keep(border(self._size, native.dtype))
        call.made.limits2 = call.made.extent = None  # which are those of the base
        # C makes the new lenses if it can compute where they end
        if plan.places is None or plan.chart_is_inverted or plan.is_long or not base.always_defined:
            return
        if plan.has_stages:
            call.domain = native.lenses.request
            if native.dtype not in plan.fixed_ends:
                return
            for name, radii in native.lenses.radii_wanted().items():
                setattr(call.domain, name, self._keep(radii))
        self._lenses_by = "C"
        call.places = self._keep(plan.places)
        self._room += plan.parameters + 4 + TABLE_WIDTH

    def warp(self, source: Camera, values: Mapping[str, Any], options: Options) -> LazyWarp:
        """Return the warp from the source to new cameras of values (B,) and (B, size), or numbers and lists for one."""
        packed, batch = self._packed(values)
        rows = batch[0] if batch else 1
        number, dtype = self._types
        room = _array(number, rows * self._room)()
        call = structs.Draws.from_buffer_copy(self._call)
        call.values, call.room = addressof(packed), addressof(room)
        call.cameras = call.made.cameras = rows
        zooms: Any = ()
        filled: Any = ()
        if call.share:
            zooms, filled = _array(c_double, rows)(), _array(c_double, rows)()
            call.factors, call.filled = addressof(zooms), addressof(filled)
        left = self._run(call, values)
        # The room holds the intrinsics of all cameras, then their rotations, coefficients, and the rest of their lenses
        numbers = np.frombuffer(room, dtype)  # numpy cuts it in half the time of torch
        turns = rows * _INTRINSICS  # where rotations begin
        jittered = turns + rows * _ROTATION  # where coefficients begin
        intrinsics, rotation, k = numbers[:turns].reshape(*batch, 4), None, self._coefficients
        if self._turns:
            rotation = torch.from_numpy(numbers[turns:jittered].reshape(*batch, 3, 3))
        if self._lenses_by != "base":
            k = numbers[jittered : jittered + rows * call.count].reshape(*batch, call.count)
        native = self._native(call, room, intrinsics, k) if self._is_flat and not left else None
        natives = None if native is None else (self._source_native, native)
        like = source if self._keeps_lens else self.base
        return LazyWarp(like, intrinsics, k, self._size, rotation, options, natives, zooms, filled)

    def _packed(self, values: Mapping[str, Any]) -> tuple[Any, tuple[int, ...]]:
        """Return drawn values kind after kind, as C takes them, and (B,); () for numbers and lists of one camera."""
        given: list[Any] = [*map(values.__getitem__, self._names)]
        if given and isinstance(given[0], np.ndarray):
            batch = self._batch or (len(given[0]),)
            numbers = np.concatenate(given, None)
            if len(numbers) != batch[0] * self._drawn:
                raise self._wrong_count(len(numbers), batch[0])
            return _array(c_double, len(numbers)).from_buffer(numbers), batch
        if len(given) < self._drawn:  # some values are several numbers
            flat: list[float] = []
            for value in given:
                flat += value if isinstance(value, list) else (value,)
            given = flat
        if len(given) != self._drawn:
            raise self._wrong_count(len(given), 1)
        return _array(c_double, len(given))(*given), self._batch

    def _wrong_count(self, count: int, rows: int) -> ValueError:
        """Return the error of so many numbers, as C reads all that cameras are made of."""
        several = [f"{name} as Range(low, high, {size})" for name, (_, size) in DRAWN_KINDS.items() if size > 1]
        wanted = f"{self._drawn} numbers for a sample, {', '.join(several)}, and others as Range(low, high)"
        return ValueError(f"{self._owner}: ranges must draw {wanted}; got {count} for {rows} samples")

    def _run(self, call: structs.Draws, values: Mapping[str, Any]) -> int:
        """Have C write the new cameras; return flags, zero unless some numbers are no camera's.

        C returns flags of limits and ends that it lacked. Python computes them and calls again; those of the source and
        the base serve all later draws.
        """
        candidates = None
        if self._lenses_by == "candidates" and call.cameras:
            candidates = self._candidates(values, call)
        if self._needs_limits:
            self._add_limits(call)
        run = loaded().camtorch_draws
        left = run(call)
        while left & ~structs.NO_CAMERA:
            self._complete(left, values, call, candidates)
            left = run(call)
        if self._lenses_by != "base" and call.followed < call.cameras:
            call.made.limits2 = call.made.extent = None
        return left

    def _native(
        self, call: structs.Draws, room: object, intrinsics: np.ndarray[Any, Any], k: np.ndarray[Any, Any]
    ) -> Native | None:
        """Return the new cameras as native code takes them; None if it lacks the lenses of several."""
        base = self._base_native
        if self._lenses_by == "C" or (self._lenses_by == "base" and base.cameras == call.cameras):
            # the function keeps the call, of which the struct is a part, and all that this points to
            return Native(base.plan, call.made, partial(self._lenses, call, room, k))
        if intrinsics.ndim == 1:
            numbers_of_one = torch.from_numpy(intrinsics)[None], torch.from_numpy(k)[None]
            return native_of(model_of(self.base).optics, *numbers_of_one, None, tables=True)
        return None

    def _candidates(self, values: Mapping[str, Any], call: structs.Draws) -> Native:
        """Make the lenses that native code chooses among, of a model whose domain it does not make by itself."""
        measured = present(self._sensitivity, "the sensitivity to the values of distortion")
        amounts = torch.from_numpy(np.asarray(values["distortion"]).reshape(-1, structs.AMOUNTS))
        amounts = amounts[:, torch.arange(call.count) % structs.AMOUNTS]  # of each coefficient
        steps = (amounts * measured)[:, None]
        given = self._distortion.double().reshape(-1, 1, call.count)
        parts = given.new_tensor(structs.JITTER_PARTS)[:, None]
        tried = (given + parts * steps).to(self._base_native.dtype)
        tried, allowed = defined_or(self.base, tried, given.to(tried).expand_as(tried))
        tried = tried.reshape(call.cameras * len(structs.JITTER_PARTS), call.count)
        lenses = CameraRows(model_of(self.base), tried.new_ones(len(tried), 4), tried)
        native = present(lenses.native, "compiled code for lenses like the base")
        native.add_table()
        call.tries, call.tried, call.allowed = native.pointer, tried.data_ptr(), address(allowed)
        call.hold((tried, allowed))
        return native

    def _complete(self, left: int, values: Mapping[str, Any], call: structs.Draws, candidates: Native | None) -> None:
        """Compute what C lacked, by the flags `left`."""
        if left & structs.TOO_WIDE:
            raise too_wide(self._owner, self.base, np.max(values["fov"]))
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

    def _lenses(self, call: structs.Draws, room: object, coefficients: np.ndarray[Any, Any]) -> Lenses:
        """Return the lenses of new cameras: those of the base, or new ones, kept for later ones of the same numbers."""
        if self._lenses_by == "base":
            return self._base_native.lenses
        plan, model = self._base_native.plan, model_of(self.base)
        k = torch.from_numpy(coefficients.reshape(call.cameras, call.count))

        def new() -> Lenses:
            struct = structs.Cameras.from_buffer_copy(call.made)
            struct.hold((call, room, self))
            return Lenses(plan, model.optics, k, struct)

        return lenses_of(plan, k, new)
