"""New cameras of drawn numbers, by native code; `new_camera` in `drawer.py` has the same formulas in torch.

A `Start` is made once for the cameras that draws start from, and has what all draws share: the struct `Start` of
`native/draws.h`, which describes its fields, and both cameras for native code. `Start.warp` is a draw: it gives C the
drawn numbers and memory, and returns the numbers of the new cameras, which C wrote there. New cameras have the lens of
the base, or, if coefficients are drawn, lenses that C makes. Where C cannot make these, as it cannot compute where they
end, `Start.of` returns None; and `Start.warp` where C, which does not ask, took coefficients without a formula.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from ctypes import addressof, c_char, c_double, sizeof
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
from camtorch.projection.native_cameras import Native, NativeLenses, lenses_of
from camtorch.projection.rows import CameraRows
from camtorch.values.arguments import present
from camtorch.values.module import model_of, remade
from camtorch.warp.options import Options

# Name of a range that C knows -> how many numbers it draws
DRAWN_SIZES = {name: getattr(structs.Drawn, name).size // sizeof(c_double) for name, *_ in structs.Drawn._fields_}
_TURNS = {"yaw", "pitch", "roll"}
_NOTHING_DRAWN: Any = structs.Drawn(zoom=1, focal=1, crop=1)
_DRAWN = np.dtype(structs.Drawn)


@lru_cache(maxsize=64)
def _array(kind: Any, count: int) -> Any:
    """Return the type of an array; ctypes makes a new one each time, in more time than the array takes."""
    return kind * count


@lru_cache(maxsize=64)
def _room(number: str, batch: tuple[int, ...], count: int, rest: int) -> tuple[Any, np.dtype[Any]]:
    """Return the type of the memory that C writes new cameras (B,) or () to, for ctypes and with names for NumPy.

    number: the type of its numbers. count: how many coefficients a camera has. rest: how many more numbers a new lens
    has. The order is that of `room` in `native/draws.h`.
    """
    shapes = {"intrinsics": (4,), "rotation": (3, 3), "distortion": (count,), "rest": (rest,)}
    layout = np.dtype([(name, number, (*batch, *shape)) for name, shape in shapes.items()])
    return c_char * layout.itemsize, layout


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
        """Return a `Start`.

        None if C lacks a range, a model or its new lenses, dtypes differ, or some numbers are no camera's.
        """
        source, base = wanted.source, wanted.base
        if not wanted.names <= DRAWN_SIZES.keys():
            return None
        of_source, of_base = _rows_of(source), _rows_of(base)
        if of_source.native is None or of_base.native is None:
            return None
        if of_source.usable is not None or of_base.usable is not None:  # flags of the numbers that are no camera's
            return None
        if {t.dtype for t in source.tensors} != {base.intrinsics.dtype}:
            return None
        if wanted.nominal is not None and not _can_make_lenses(of_base.native):
            return None
        return cls(wanted, of_source.native, of_base.native)

    def __init__(self, wanted: Wanted, source_native: Native, base_native: Native):
        """Start from the source and the base as native code takes them: `source_native` and `base_native`."""
        source, base = wanted.source, wanted.base
        self._wanted, self._source_native, self._base_native = wanted, source_native, base_native
        self._single = [name for name in wanted.names if DRAWN_SIZES[name] == 1]
        self._several = [name for name in wanted.names if DRAWN_SIZES[name] > 1]
        self._names = self._single + self._several
        self._batch = tuple(wanted.sized.shape[:-1]) or base.batch_shape  # (B,) if each camera has a lens of its own
        self._turns = not _TURNS.isdisjoint(wanted.names)
        self._is_flat = source.turn_axis is None and base.turn_axis is None
        self._number = "f4" if base_native.dtype == torch.float32 else "f8"
        self._distortion = base.distortion.detach().numpy()
        self._rest = self._limits = 0  # how many numbers a new lens has besides coefficients, and of limits of azimuths
        self._may_lack_formula = wanted.nominal is not None and not base.always_defined
        base_native.add_table()  # new cameras of its lens have it too, for those that unproject
        start = self._struct = structs.Start(count=base.distortion.shape[-1], is_each=bool(self._batch))
        start.height, start.width = wanted.size
        start.base, start.sized = base_native.pointer, self._keep_each(wanted.sized, 4)
        if wanted.covered_radius is not None:
            start.reach = self._keep_each(wanted.covered_radius.double())
        if wanted.share:
            source_native.add_table()
            start.share, start.source = with_care(wanted.share), source_native.pointer
            start.source_height, start.source_width = source.size_for("min_filled")
            start.looked_at = start.keep(looked_at(wanted.size, base_native.dtype))
        if wanted.nominal is not None:
            self._add_new_lenses(wanted.nominal)

    def _keep_each(self, tensor: Tensor, *row: int) -> int:
        """Keep the rows of all cameras whose lenses differ, or the one of all, and return where the numbers lie."""
        return self._struct.keep(tensor.expand((*self._batch, *row)).contiguous())

    def _add_new_lenses(self, nominal: Tensor) -> None:
        """Have C make lenses of drawn coefficients, by steps measured on a lens of nominal intrinsics."""
        start, native, plan, base = self._struct, self._base_native, self._base_native.plan, self._wanted.base
        size = self._wanted.size
        self._rest = plan.parameters + 4 + TABLE_WIDTH
        measured = measured_once(sensitivity, remade(base, image_size=size), base.distortion, nominal)
        start.sensitivity = self._keep_each(measured, start.count)
        start.coefficients = self._keep_each(base.distortion.detach(), start.count)
        start.places = start.keep(present(plan.places, "the places of parameters among coefficients"))
        start.border = start.keep(border(size, native.dtype))
        if plan.has_stages or plan.chart_is_inverted:
            start.domain = native.lenses.request
            start.domain.is_chart = plan.chart_is_inverted
        if plan.has_stages:
            if native.dtype not in plan.fixed_ends:
                start.domain.ends = None  # which C finds
            for name, radii in native.lenses.radii_wanted().items():
                setattr(start.domain, name, start.keep(radii.contiguous()))
            self._limits = 0 if plan.is_radial else structs.AZIMUTHS + structs.EXTENT

    def warp(
        self, source: Camera, values: Mapping[str, Any], options: Options
    ) -> tuple[LazyWarp, Sequence[float], Sequence[float]] | None:
        """Return the warp from the source to new cameras of values (B,) and (B, size), or numbers and lists for one.

        Also the factors (B,) on focal lengths for `min_filled`, and the part of each image that is filled then, (B,);
        both are empty if nothing has to be filled. None if a model has no formula for the coefficients that C took.
        """
        drawn, batch = self._packed(values)
        rows = batch[0] if batch else 1
        memory_type, layout = _room(self._number, batch, self._struct.count, self._rest)
        memory, limits = memory_type(), None
        draws = structs.Draws(cameras=rows)
        draws.start, draws.drawn, draws.room = addressof(self._struct), addressof(drawn), addressof(memory)
        if self._limits:
            limits = torch.empty(rows * self._limits, dtype=self._base_native.dtype, device="cpu")
            draws.limits = limits.data_ptr()
        zooms: Any = ()
        filled: Any = ()
        if self._struct.share:
            zooms, filled = _array(c_double, rows)(), _array(c_double, rows)()
            draws.factors, draws.filled = addressof(zooms), addressof(filled)
        run = loaded().camtorch_draws
        left = run(draws)
        while left & ~structs.NO_CAMERA:
            self._complete(left, values)
            left = run(draws)
        room = np.ndarray((), layout, memory)  # in less time than tensors
        rotation = torch.from_numpy(room["rotation"]) if self._turns else None
        k = room["distortion"] if self._rest else self._distortion
        if self._may_lack_formula and not self._has_formula(k):
            return None
        if limits is not None and draws.followed == rows:
            draws.hold(limits)
        # some numbers may be no camera's
        native = self._native(draws, room) if self._is_flat and not left else None
        natives = None if native is None else (self._source_native, native)
        size, base = self._wanted.size, self._wanted.base
        like = source if base is self._wanted.source else base
        return LazyWarp(like, room["intrinsics"], k, size, rotation, options, natives), zooms, filled

    def _packed(self, values: Mapping[str, Any]) -> tuple[Any, tuple[int, ...]]:
        """Return drawn values as C takes them, and (B,), which is () for numbers and lists of one camera."""
        first = values[self._names[0]] if self._names else None
        if not isinstance(first, np.ndarray) and self._batch in ((), (1,)):
            one = structs.Drawn.from_buffer_copy(_NOTHING_DRAWN)
            try:
                for name in self._single:
                    setattr(one, name, values[name])
                for name in self._several:
                    getattr(one, name)[:] = values[name]
            except (TypeError, ValueError):
                raise self._wrong_size(values, ()) from None
            return one, self._batch
        batch = self._batch or values[self._names[0]].shape[:1]
        many = _array(structs.Drawn, batch[0])()
        table = np.ndarray(batch, _DRAWN, many)
        table[:] = np.ndarray((), _DRAWN, _NOTHING_DRAWN)
        for name in self._names:
            value = values[name]
            if value.shape != table[name].shape:
                raise self._wrong_size(values, batch)
            table[name] = value
        return many, batch

    def _wrong_size(self, values: Mapping[str, Any], batch: tuple[int, ...]) -> ValueError:
        """Return the error of values of cameras (B,) or () that are not as many as C reads."""
        for name in self._names:
            size = DRAWN_SIZES[name]
            shape = (*batch, size) if size > 1 else batch
            if np.shape(values[name]) != shape:
                break
        wanted = "Range(low, high)" if size == 1 else f"Range(low, high, {size})"
        return ValueError(
            f"{self._wanted.owner}: the range {name!r} must be {wanted}, which draws {shape}; got values "
            f"{np.shape(values[name])}"
        )

    def _complete(self, left: int, values: Mapping[str, Any]) -> None:
        """Compute what C lacked of the source or the base, by the flags `left`; it serves all later draws."""
        wanted = self._wanted
        if left & structs.TOO_WIDE:
            raise too_wide(wanted.owner, wanted.base, np.max(values["fov"]))
        if left & structs.LEFT_BASE:
            self._base_native.follow()
        if left & structs.LEFT_SOURCE:
            self._source_native.follow()
        if left & structs.LEFT_ENDS:
            base = remade(wanted.base, image_size=wanted.size)
            ends = measured_once(lens_ends, base, base.distortion.detach())
            self._struct.ends = self._keep_each(ends, *ends.shape[-2:])

    def _has_formula(self, k: np.ndarray[Any, Any]) -> bool:
        """Return whether the model has a formula for coefficients (B, n) or (n,)."""
        sense = self._wanted.base.defined(torch.from_numpy(k).unbind(-1))
        return sense is None or bool((sense > 0).all())

    def _native(self, draws: structs.Draws, room: np.ndarray[Any, Any]) -> Native | None:
        """Return the cameras that C made, as native code takes them.

        None for several cameras with one lens, that of the base, as native code takes as many lenses as cameras.
        """
        if not self._rest and draws.cameras != self._base_native.cameras:
            return None
        made = draws.made  # it keeps `draws` alive, and the function for the lenses keeps the memory
        return Native(self._base_native.plan, made, partial(self._lenses, made, room))

    def _lenses(self, made: structs.Cameras, room: np.ndarray[Any, Any]) -> NativeLenses:
        """Return the lenses of cameras that C made in that memory; new ones are kept for later cameras like these."""
        if not self._rest:
            return self._base_native.lenses
        plan, optics = self._base_native.plan, model_of(self._wanted.base).optics
        k = torch.from_numpy(room["distortion"].reshape(made.cameras, self._struct.count))

        def new() -> NativeLenses:
            made.hold(room)
            return NativeLenses(plan, optics, k, made)

        return lenses_of(plan, k, new)


def _can_make_lenses(native: Native) -> bool:
    """Return whether C can make lenses like these of other coefficients."""
    plan = native.plan
    if plan.places is None or plan.is_long:
        return False
    if not plan.has_stages:
        return True
    plan.ends(native.lenses)
    knows_end = native.dtype in plan.fixed_ends or plan.parts[0].kind == structs.UNIFIED
    return knows_end and not plan.chart_is_inverted
