"""How a sample moves by a change: all that is the same for samples of one form is planned once.

1. `form_of` says what a plan depends on. A sample without a form, as one with a list, or in traced code, has a plan of
   its own. The plan is kept by the form, and `_new_batch` in `sample.py` makes it.
2. A `SamplePlan` names the fields that move, and whether there is a dim B. A `Batch` is a sample with its plan.
3. `Batch.together` moves what one call can move, by the column `together` of the table `KINDS`: of C, which each thread
   keeps, or without the library of torch.
4. `Batch.alone` moves each other field, by the column `move`.
"""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from camtorch.augment.change import Change
from camtorch.augment.fields import KINDS, Named, field_of
from camtorch.augment.part import LazyWarp
from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import are_free, are_numbers
from camtorch.native.library import native_available
from camtorch.values.dtypes import in_range
from camtorch.values.threads import thread_count
from camtorch.warp.options import Options
from camtorch.warp.together import How, Label, MovedField, SampleCall, Sizes, call_for, pixels_together

# Labels of a single sample that one call of C moves beside pixels: where it may be mirrored, and where it is not
_LABELS_OF_MIRRORS: Sequence[Label] = "boxes", "rays"
_LABELS_OF_TURNS: Sequence[Label] = *_LABELS_OF_MIRRORS, "columns", "pose", "rotation vectors"
_MANY_PIXELS = 1 << 15  # coordinates of a batch: so many are shared by threads


class _OfThread(threading.local):
    """What each thread has of its own: a call of C holds memory that one thread writes."""

    def __init__(self) -> None:
        self.calls = Kept(16)  # the last ones, of all transforms


_own = _OfThread()


def form_of(
    sample: Mapping[str, Any], camera: object, fields: Mapping[str, str], revision: object
) -> tuple[Any, ...] | None:
    """Return all that a plan depends on, by which it is kept; None if it cannot be. `revision`: of the options."""
    if not isinstance(camera, Camera) or camera.is_mixed:
        return None
    # Of tensors all but the numbers counts, of other values the type; what a list or a dict holds is not looked at
    tensors: list[Tensor] = []
    values: list[Any] = []
    for name, value in sample.items():
        if isinstance(value, Tensor):
            tensors.append(value)
            values += name, type(value), value.shape, value.stride(), value.dtype, value.device
        elif value is None or isinstance(value, (str, int, float, Camera)):
            values += name, type(value)
        else:
            return None
    # If tensors learn or are elsewhere, the plan is another, which moves nothing together; of traced calls none is kept
    is_free = are_free(*tensors)
    if not is_free and not are_free():
        return None
    intrinsics, distortion = camera.intrinsics, camera.distortion
    numbers = intrinsics.shape, intrinsics.dtype, intrinsics.device, distortion.shape
    return revision, is_free, type(camera), camera.image_size, *numbers, type(sample), *values, *fields.items()


def form_together(named: Named, batched: bool, masks: Sequence[str], mask_fill: float) -> tuple[Any, ...] | None:
    """Return all that a call for several fields depends on, beside the motion; None if each field moves alone.

    These are of name -> kind and value; see `SamplePlan` for the others.
    """
    if "image_valid" in masks:  # which asks for the position of each pixel: the call would compute them once more
        return None
    values: list[Any] = []
    for name, (kind, value) in named.items():
        if isinstance(value, list) or not are_free(value):
            return None
        values += name, kind, type(value), value.shape, value.stride(), value.dtype
    return batched, mask_fill, *values


@dataclass(frozen=True)
class SamplePlan:
    """How samples of one form move. It is made once, and kept as long as the form and the transform stay the same."""

    fields: Mapping[str, str]  # name -> kind of what moves, in the order of the sample
    batched: bool
    count: int
    matrices: Sequence[str]  # names of the fields that are matrices K
    masks: Sequence[str]  # names of the masks of validity that come out: "image_valid" and so on
    mask_fill: float
    form_together: tuple[Any, ...] | None  # what the function of that name returns

    def rows(self, value: Any) -> Any:
        """Return a value with a dim B; a list has one already."""
        return value if self.batched or isinstance(value, list) else value.unsqueeze(0)


class Batch(NamedTuple):
    """Samples as they move: their plan, the values of its fields, and their cameras."""

    plan: SamplePlan
    values: Mapping[str, Any]  # as they came, where these are tensors; without a dim B if the plan is not `batched`
    camera: Camera
    checked: bool  # whether values need no check as they move: they had it, or come from a network

    def rows(self) -> Named:
        """Return name -> kind and value, with a dim B."""
        return {name: (kind, self.plan.rows(self.values[name])) for name, kind in self.plan.fields.items()}

    def together(self, change: Change) -> Mapping[str, MovedField | None]:
        """Move fields by one call, of C or without the library of torch; what is not in the result, or None, is left.

        C moves images and pixels, and of a single sample whose camera C drew also boxes, rays, columns, poses and
        rotation vectors; it takes a `LazyWarp` without making a warp. Torch moves pixels and boxes.
        """
        plan, part = self.plan, change.parts[0]
        motion, form, count = part.motion, plan.form_together, plan.count
        # 1. One motion moves all rows, and nothing is recorded
        if form is None or motion is None or part.rows is not None or change.gate is not None or not count:
            return {}
        options = motion.options
        if not native_available():
            hows = self._hows(part.camera.intrinsics.dtype, options, ["boxes"])
            return pixels_together(part.warp, self.values, hows, plan.batched)
        # 2. C needs both cameras, and a camera, or a turn, for each row; images whose colours or light change go alone
        natives = None if part.shades or part.light is not None else motion.natives
        if natives is None:
            return {}
        source, target = natives
        rotation = motion.rotation
        if count > 1:
            turns = 1 if rotation is None else rotation.numel() // 9
            if count not in (source.cameras, target.cameras, turns):
                return {}
        # 3. The call is kept by all that it depends on
        labels: Sequence[Label] = ()
        if isinstance(motion, LazyWarp) and count == 1:
            labels = _LABELS_OF_MIRRORS if motion.may_mirror else _LABELS_OF_TURNS
        sizes = part.camera.image_size, motion.image_size
        key = form, sizes, source.dtype, labels, thread_count(), *options.values()
        call: SampleCall | None = _own.calls.get((), key, self._new_call, sizes, source.dtype, options, labels)
        return {} if call is None else call(source, target, rotation, self.values)

    def _new_call(
        self, sizes: Sizes, dtype: torch.dtype, options: Options, labels: Sequence[Label]
    ) -> SampleCall | None:
        """Return the call of C that moves several fields; None if none serves, or if an image moves alone.

        sizes: of the images and of the new ones. dtype, options: as of `call_for`. labels: those that it moves beside
        pixels.
        """
        kinds = [KINDS[kind] for kind in self.plan.fields.values()]
        hows = self._hows(dtype, options, labels)
        if not hows or any(kind.is_image and kind.together is None for kind in kinds):
            return None
        return call_for(sizes, dtype, options, self.values, hows, self.plan.batched)

    def _hows(self, dtype: torch.dtype, options: Options, labels: Sequence[Label]) -> dict[str, How]:
        """Return name -> how it moves with others, for the fields that do; see `_new_call`."""
        hows = {name: self._how_of(name, dtype, options, labels) for name in self.plan.fields}
        return {name: how for name, how in hows.items() if how is not None}

    def _how_of(self, name: str, dtype: torch.dtype, options: Options, labels: Sequence[Label]) -> How | None:
        plan, value = self.plan, self.values[name]
        kind = plan.fields[name]
        how = field_of(kind, value).together
        if how is None or value.ndim - plan.batched > KINDS[kind].most_dims:  # frames move by `move`
            return None
        if callable(how):
            sampler = how(options, plan.mask_fill)
            return sampler if len(sampler.fill) == 1 or len(sampler.fill) == value.shape[-3] else None
        if how == "pixels":
            return how if plan.count == 1 or value.numel() < _MANY_PIXELS else None
        if how not in labels or value.dtype != dtype or not are_numbers(value):
            return None
        return how if how == "boxes" or value.is_contiguous() else None

    def alone(self, name: str, change: Change, options: Mapping[str, float], owner: str) -> tuple[Any, Any]:
        """Return a field after a change, with a dim B or as a list if it came so, and which of it is valid, if any."""
        kind, value, batched = self.plan.fields[name], self.values[name], self.plan.batched
        if isinstance(value, list):
            pairs = [move(change.row(i), kind, v.unsqueeze(0), options) for i, v in enumerate(value)]
            flags = [valid.squeeze(0) for _, valid in pairs if valid is not None]
            return [rows.squeeze(0) for rows, _ in pairs], flags or None
        check = KINDS[kind].check
        if check is not None and not self.checked:
            check(value, name, owner)
        rows, valid = move(change, kind, value if batched else value.unsqueeze(0), options)
        return (rows, valid) if batched else (rows.squeeze(0), None if valid is None else valid.squeeze(0))


def move(change: Change, kind: str, value: Tensor, options: Mapping[str, float]) -> MovedField:
    """Return values (B, ...) of a kind moved by a change, and which are valid, if any; see also `_move_frames`."""
    dims = value.ndim - 1 - KINDS[kind].most_dims
    if dims > 0:
        return _move_frames(change, kind, value, dims, options)
    result = KINDS[kind].move(change, value, options)
    result, valid = result if isinstance(result, tuple) else (result, None)
    # geometry is computed in float32 at least; what came in half precision goes out in it
    return in_range(result, value.dtype) if value.dtype.is_floating_point else result, valid


def _move_frames(change: Change, kind: str, value: Tensor, dims: int, options: Mapping[str, float]) -> MovedField:
    """Return values (1, *frames, ...) of one sample, with `dims` dims of frames: its change moves each of them."""
    frames = value.shape[1 : 1 + dims]
    parts = [replace(part, rows=None) for part in change.parts]
    of_frames = change._with_parts(parts, samples=[0] * math.prod(frames))
    result, valid = move(of_frames, kind, value.flatten(0, dims), options)
    valid = None if valid is None else valid.reshape(1, *frames, *valid.shape[1:])
    return result.reshape(1, *frames, *result.shape[1:]), valid
