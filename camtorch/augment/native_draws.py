"""New cameras of drawn numbers, by native code; `new_camera` in `drawer.py` has the same formulas in torch.

A `Start` is made once for the cameras that draws start from. It has all that draws share: both cameras for native code,
the order of drawn values, the way to new lenses, and the struct of `native/draws.h`, which describes its fields.
`Start.warp` is a draw: it copies the struct, packs the values, has C write the new cameras, and cuts their numbers out
of the memory that C wrote them to. A new camera comes to its lens in one of three ways, with the same methods:
`_BaseLens`, that of the base; `_NewLens`, which C makes of jittered coefficients; and `_ChosenLens`, which C chooses
among lenses that Python made, as it cannot compute where such a lens ends.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from ctypes import addressof, c_double, c_float
from functools import lru_cache, partial
from typing import Any, NamedTuple

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
from camtorch.projection.native_cameras import Native, NativeLenses, lenses_of, native_of
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
    """What draws from the same cameras share; kept for as long as the numbers of these stay."""

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
        source, base, count = wanted.source, wanted.base, wanted.base.distortion.shape[-1]
        self._wanted, self._source_native, self._base_native = wanted, source_native, base_native
        self._batch = tuple(wanted.sized.shape[:-1]) or base.batch_shape  # (B,) if each camera has a lens of its own
        self._order = _Order(wanted.names, self._batch, wanted.owner)
        self._turns = not _TURNS.isdisjoint(wanted.names)
        self._is_flat = source.turn_axis is None and base.turn_axis is None
        self._types = (c_float, np.float32) if base_native.dtype == torch.float32 else (c_double, np.float64)
        base_native.add_table()  # new cameras of its lens have it too, for those that unproject
        call = self._call = structs.Draws(count=count, is_each=bool(self._batch))
        call.height, call.width = wanted.size
        call.first[:] = self._order.firsts
        call.base, call.made, call.made.usable = base_native.pointer, base_native.struct, None
        call.sized = self._keep_each(wanted.sized, 4)
        if wanted.covered_radius is not None:
            call.reach = self._keep_each(wanted.covered_radius.double())
        if wanted.share:
            source_native.add_table()
            call.share, call.source = with_care(wanted.share), source_native.pointer
            call.source_height, call.source_width = source.size_for("min_filled")
            call.looked_at = call.keep(looked_at(wanted.size, base_native.dtype))
        self._lens = _BaseLens(wanted, base_native) if wanted.nominal is None else self._jittered(wanted.nominal)
        self._room = _INTRINSICS + _ROTATION + count + self._lens.room  # how many numbers C writes for a camera

    def _keep_each(self, tensor: Tensor, *row: int) -> int:
        """Keep the rows of all cameras whose lenses differ, or the one of all, and return where the numbers lie."""
        return self._call.keep(tensor.expand((*self._batch, *row)).contiguous())

    def _jittered(self, nominal: Tensor) -> _BaseLens:
        """Return the way to lenses of jittered coefficients, by steps measured on a lens of nominal intrinsics."""
        call, wanted, native, plan = self._call, self._wanted, self._base_native, self._base_native.plan
        base = wanted.base
        measured = measured_once(sensitivity, remade(base, image_size=wanted.size), base.distortion, nominal)
        call.sensitivity = self._keep_each(measured, call.count)
        call.coefficients = self._keep_each(base.distortion.detach(), call.count)
        call.border = call.keep(border(wanted.size, native.dtype))
        call.made.limits2 = call.made.extent = None  # which are those of the base
        chosen = _ChosenLens(wanted, native, measured)
        if plan.places is None or plan.chart_is_inverted or plan.is_long or not base.always_defined:
            return chosen
        if plan.has_stages:
            call.domain = native.lenses.request
            if native.dtype not in plan.fixed_ends:
                return chosen
            for name, radii in native.lenses.radii_wanted().items():
                setattr(call.domain, name, call.keep(radii.contiguous()))
        call.places = call.keep(plan.places)
        return _NewLens(wanted, native)

    def warp(self, source: Camera, values: Mapping[str, Any], options: Options) -> LazyWarp:
        """Return the warp from the source to new cameras of values (B,) and (B, size), or numbers and lists for one."""
        packed, batch = self._order.packed(values)
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
        lens, run = self._lens, loaded().camtorch_draws
        follow = lens.prepare(call, values)
        left = run(call)
        while left & ~structs.NO_CAMERA:
            self._complete(left, call, values, follow)
            left = run(call)
        # The room holds the intrinsics of all cameras, then their rotations, coefficients, and the rest of their lenses
        numbers = np.frombuffer(room, dtype)  # numpy cuts it in half the time of torch
        turns = rows * _INTRINSICS  # where rotations begin
        jittered = turns + rows * _ROTATION  # where coefficients begin
        intrinsics, rotation, k = numbers[:turns].reshape(*batch, 4), None, lens.coefficients
        if self._turns:
            rotation = torch.from_numpy(numbers[turns:jittered].reshape(*batch, 3, 3))
        if k is None:
            k = numbers[jittered : jittered + rows * call.count].reshape(*batch, call.count)
        # some numbers may be no camera's
        native = lens.native(call, room, intrinsics, k) if self._is_flat and not left else None
        natives = None if native is None else (self._source_native, native)
        size, like = self._wanted.size, self._wanted.base
        like = source if like is self._wanted.source else like
        return LazyWarp(like, intrinsics, k, size, rotation, options, natives, zooms, filled)

    def _complete(
        self, left: int, call: structs.Draws, values: Mapping[str, Any], follow: Callable[[], None] | None
    ) -> None:
        """Compute what C lacked, by the flags `left`; what is the source's or the base's serves all later draws."""
        wanted = self._wanted
        if left & structs.TOO_WIDE:
            raise too_wide(wanted.owner, wanted.base, np.max(values["fov"]))
        if left & structs.LEFT_LENS:
            present(follow, "limits of new lenses")()
        if left & structs.LEFT_BASE:
            self._base_native.follow()
        if left & structs.LEFT_SOURCE:
            self._source_native.follow()
        if left & structs.LEFT_ENDS:
            base = remade(wanted.base, image_size=wanted.size)
            ends = measured_once(lens_ends, base, base.distortion.detach())
            self._call.ends = call.ends = self._keep_each(ends, *ends.shape[-2:])


class _Order:
    """The order in which C takes the drawn values: kind after kind, of each the values of all cameras."""

    def __init__(self, names: Set[str], batch: tuple[int, ...], owner: str):
        """Take the names of values, (B,) of lenses or (), and the name of an augmentation, for errors."""
        self._names = [name for name in DRAWN_KINDS if name in names]
        self._batch, self._owner = batch, owner
        self._count = 0  # how many numbers are drawn for a camera
        self.firsts = [-1] * structs.DRAWN_KINDS  # which of these is the first of a kind, by the kind's code
        for name in self._names:
            code, size = DRAWN_KINDS[name]
            self.firsts[code] = self._count
            self._count += size

    def packed(self, values: Mapping[str, Any]) -> tuple[Any, tuple[int, ...]]:
        """Return drawn values as C takes them, and (B,), which is () for numbers and lists of one camera."""
        given: list[Any] = [*map(values.__getitem__, self._names)]
        if given and isinstance(given[0], np.ndarray):
            batch = self._batch or (len(given[0]),)
            numbers = np.concatenate(given, None)
            if len(numbers) != batch[0] * self._count:
                raise self._wrong_count(len(numbers), batch[0])
            return _array(c_double, len(numbers)).from_buffer(numbers), batch
        if len(given) < self._count:  # some values are several numbers
            flat: list[float] = []
            for value in given:
                flat += value if isinstance(value, list) else (value,)
            given = flat
        if len(given) != self._count:
            raise self._wrong_count(len(given), 1)
        return _array(c_double, len(given))(*given), self._batch

    def _wrong_count(self, count: int, rows: int) -> ValueError:
        """Return the error of so many numbers, as C reads all that cameras are made of."""
        several = [f"{name} as Range(low, high, {size})" for name, (_, size) in DRAWN_KINDS.items() if size > 1]
        wanted = f"{self._count} numbers for a sample, {', '.join(several)}, and others as Range(low, high)"
        return ValueError(f"{self._owner}: ranges must draw {wanted}; got {count} for {rows} samples")


class _BaseLens:
    """The way of new cameras to their lenses if these are the base's."""

    room = 0  # how many numbers C writes for a lens, besides its coefficients
    coefficients: np.ndarray[Any, Any] | None  # of new cameras; None if C writes them

    def __init__(self, wanted: Wanted, native: Native):
        self._base, self._native, self.coefficients = wanted.base, native, wanted.base.distortion.detach().numpy()

    def prepare(self, call: structs.Draws, values: Mapping[str, Any]) -> Callable[[], None] | None:
        """Set what C needs for new lenses; return what to do if it lacks their limits of azimuths."""
        return None

    def native(
        self, call: structs.Draws, room: object, intrinsics: np.ndarray[Any, Any], k: np.ndarray[Any, Any]
    ) -> Native | None:
        """Return the new cameras that C wrote, as native code takes them; None if it lacks the lenses of several."""
        if self._native.cameras != call.cameras:
            return None
        return Native(self._native.plan, call.made, partial(self._lenses, call, room, k))

    def _lenses(self, call: structs.Draws, room: object, k: np.ndarray[Any, Any]) -> NativeLenses:
        """Return the lenses of new cameras, which hold this function: it keeps the memory of their struct alive."""
        return self._native.lenses


class _NewLens(_BaseLens):
    """The way of new cameras to lenses of jittered coefficients that C makes."""

    def __init__(self, wanted: Wanted, native: Native):
        super().__init__(wanted, native)
        self.coefficients = None
        self.room = native.plan.parameters + 4 + TABLE_WIDTH
        self._need_limits = False  # whether lenses of an earlier call needed limits of azimuths

    def prepare(self, call: structs.Draws, values: Mapping[str, Any]) -> Callable[[], None] | None:
        """See `_BaseLens`."""
        if self._need_limits:
            self._add_limits(call)
        return partial(self._add_limits, call)

    def _add_limits(self, call: structs.Draws) -> None:
        """Allocate limits and extents of new lenses."""
        self._need_limits = True
        call.made.limits2, call.made.extent = (
            call.keep(torch.empty(call.cameras * count, dtype=self._native.dtype, device="cpu"))
            for count in (structs.AZIMUTHS, structs.EXTENT)
        )

    def native(
        self, call: structs.Draws, room: object, intrinsics: np.ndarray[Any, Any], k: np.ndarray[Any, Any]
    ) -> Native:
        """See `_BaseLens`."""
        if call.followed < call.cameras:
            call.made.limits2 = call.made.extent = None
        return Native(self._native.plan, call.made, partial(self._lenses, call, room, k))

    def _lenses(self, call: structs.Draws, room: object, k: np.ndarray[Any, Any]) -> NativeLenses:
        """Return the lenses of new cameras, kept for later ones of the same coefficients."""
        plan, coefficients = self._native.plan, torch.from_numpy(k.reshape(call.cameras, call.count))

        def new() -> NativeLenses:
            struct = structs.Cameras.from_buffer_copy(call.made)
            struct.hold((call, room, self._native))
            return NativeLenses(plan, model_of(self._base).optics, coefficients, struct)

        return lenses_of(plan, coefficients, new)


class _ChosenLens(_BaseLens):
    """The way of new cameras to lenses of jittered coefficients that C chooses among candidates."""

    def __init__(self, wanted: Wanted, native: Native, measured: Tensor):
        """Take (*B, n), by how much each coefficient changes: the sensitivity of the image to it."""
        super().__init__(wanted, native)
        self.coefficients, self._sensitivity = None, measured

    def prepare(self, call: structs.Draws, values: Mapping[str, Any]) -> Callable[[], None] | None:
        """See `_BaseLens`."""
        if not call.cameras:
            return None
        amounts = torch.from_numpy(np.asarray(values["distortion"]).reshape(-1, structs.AMOUNTS))
        amounts = amounts[:, torch.arange(call.count) % structs.AMOUNTS]  # of each coefficient
        steps = (amounts * self._sensitivity)[:, None]
        given = self._base.distortion.detach().double().reshape(-1, 1, call.count)
        parts = given.new_tensor(structs.JITTER_PARTS)[:, None]
        tried = (given + parts * steps).to(self._native.dtype)
        tried, allowed = defined_or(self._base, tried, given.to(tried).expand_as(tried))
        tried = tried.reshape(call.cameras * len(structs.JITTER_PARTS), call.count)
        lenses = CameraRows(model_of(self._base), tried.new_ones(len(tried), 4), tried)
        candidates = present(lenses.native, "compiled code for lenses like the base")
        candidates.add_table()
        call.tries, call.tried = candidates.pointer, tried.data_ptr()
        call.allowed = None if allowed is None else allowed.data_ptr()
        call.hold((tried, allowed, candidates))
        return candidates.follow

    def native(
        self, call: structs.Draws, room: object, intrinsics: np.ndarray[Any, Any], k: np.ndarray[Any, Any]
    ) -> Native | None:
        """See `_BaseLens`."""
        if intrinsics.ndim > 1:
            return None
        numbers_of_one = torch.from_numpy(intrinsics)[None], torch.from_numpy(k)[None]
        return native_of(model_of(self._base).optics, *numbers_of_one, None)
