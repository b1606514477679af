"""How a sample moves by a change: all that is the same for samples of one form is planned once.

1. `form_of` says what a plan depends on. A sample that has no form, as one of lists, or in traced code, has a plan of
   its own. The plan is kept by the form, and `_new_batch` in `sample.py` makes it.
2. A `SamplePlan` names the fields that move, and whether there is a dim B. A `Batch` is a sample with its plan.
3. `SamplePlan.together` moves what it can by one call of C, also kept: images and pixels of samples that all move by
   one warp, if nothing is recorded. Of a single sample whose camera C drew, it moves most other labels, too.
4. `Batch.moved` moves each other field by itself: `move` calls what the table `KINDS` has for its kind.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from threading import get_ident
from typing import Any, NamedTuple

import torch
from torch import Tensor

from camtorch.augment.change import Change
from camtorch.augment.fields import KINDS, Named, field_of
from camtorch.augment.part import LazyWarp, Part
from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import are_free, are_numbers, known_true
from camtorch.native.library import native_available
from camtorch.native.structs import EDGE_POINTS
from camtorch.values.threads import thread_count
from camtorch.warp.at_once import Label, MovedField, SampleCall, call_for
from camtorch.warp.boxes import along_edges, around, corners_of, in_order
from camtorch.warp.options import Options, Sampler

# Labels of a single sample that one call of C moves beside pixels: where it may be mirrored, and where it is not
_LABELS_OF_MIRRORS: Sequence[Label] = "boxes", "rays"
_LABELS_OF_TURNS: Sequence[Label] = *_LABELS_OF_MIRRORS, "columns", "pose", "rotation vectors"
_MANY_PIXELS = 1 << 15  # coordinates of a batch: so many are shared by threads


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
    # If tensors learn or are elsewhere, the plan is another, without a call of C; of traced calls none is kept
    is_free = are_free(*tensors)
    if not is_free and not are_free():
        return None
    # Each thread keeps plans of its own, as calls of C hold memory that one thread writes
    state = revision, get_ident(), is_free
    intrinsics, distortion = camera.intrinsics, camera.distortion
    numbers = intrinsics.shape, intrinsics.dtype, intrinsics.device, distortion.shape
    return *state, type(camera), camera.image_size, *numbers, type(sample), *values, *fields.items()


class CallOfFields(NamedTuple):
    """A call of C that moves several fields at once, and their names."""

    names: Sequence[str]
    narrowed: Sequence[str]  # of those, pixels and boxes that come out in another dtype than that of the cameras
    call: SampleCall


@dataclass(frozen=True)
class SamplePlan:
    """How samples of one form move. It is made once, and kept as long as the form and the transform stay the same."""

    fields: Mapping[str, str]  # name -> kind of what moves, in the order of the sample
    batched: bool
    count: int
    matrices: Sequence[str]  # names of the fields that are matrices K
    masks: Sequence[str]  # names of the masks of validity that come out: "image_valid" and so on
    mask_fill: float
    calls: Kept | None
    """Maps settings to the `CallOfFields`, or to None if no call serves; None itself if autograd may record."""

    def rows(self, value: Any) -> Any:
        """Return a value with a dim B; a list has one already."""
        return value if self.batched or isinstance(value, list) else value.unsqueeze(0)

    def together(self, change: Change, values: Mapping[str, Any]) -> Mapping[str, MovedField | None]:
        """Move by one call of C: images, pixels, and of a single sample whose camera C drew also boxes and rays.

        A `LazyWarp` goes to such a camera. Without the library, pixels and boxes move by one evaluation in torch. The
        other fields, and all of them if no call serves, are not in the result, or None.
        """
        part, calls = change.parts[0], self.calls
        motion = part.motion
        # 1. One call moves all rows by one warp, and records nothing
        if calls is None or motion is None or part.rows is not None or change.gate is not None or not self.count:
            return {}
        if not native_available():
            return self._pixels_at_once(part, values)
        # 2. C needs both cameras, and a camera, or a turn, for each row; images whose colours or light change go alone
        natives = None if part.shades or part.light is not None else motion.natives
        if natives is None:
            return {}
        source, target = natives
        rotation = motion.rotation
        if self.count > 1:
            turns = 1 if rotation is None else rotation.numel() // 9
            if self.count not in (source.cameras, target.cameras, turns):
                return {}
        # 3. The call is kept by all that it depends on, beside the form
        labels: Sequence[Label] = ()
        if isinstance(motion, LazyWarp) and self.count == 1:
            labels = _LABELS_OF_MIRRORS if motion.may_mirror else _LABELS_OF_TURNS
        size = motion.image_size
        settings = size, source.dtype, labels, thread_count(), *motion.options.values()
        how = values, part.camera, size, source.dtype, motion.options, labels
        of_fields: CallOfFields | None = calls.get((), settings, self._new_call, *how)
        if of_fields is None:
            return {}
        # 4. The call moves its fields, or refuses the values
        moved = of_fields.call(source, target, rotation, [*map(values.__getitem__, of_fields.names)])
        if moved is None:
            return {}
        results = dict(zip(of_fields.names, moved, strict=True))
        for name in of_fields.narrowed:
            pair = results[name]
            if pair is not None:
                results[name] = _in_range(pair[0], values[name].dtype), pair[1]
        return results

    def _new_call(
        self,
        values: Mapping[str, Any],
        camera: Camera,
        size: tuple[int, int],
        dtype: torch.dtype,
        options: Options,
        labels: Sequence[Label],
    ) -> CallOfFields | None:
        """Return the call of C that moves several fields; None if no call serves.

        camera, size: of the images, and of the new ones. dtype, options: as of `call_for`. labels: those that it moves
        beside pixels.
        """
        hows: dict[str, Sampler | Label] = {}
        for name, kind in self.fields.items():
            value = values[name]
            if isinstance(value, list) or field_of(kind, value).by_c == "never":
                return None
            how = self._how_of(kind, value, dtype, options, labels)
            if how is not None:
                hows[name] = how
        if not hows:
            return None
        sizes = camera.size_for("Warp"), size
        call = call_for(sizes, dtype, options, [values[name] for name in hows], [*hows.values()], self.batched)
        if call is None:
            return None
        narrowed = [name for name, how in hows.items() if how in ("pixels", "boxes") and values[name].dtype != dtype]
        return CallOfFields([*hows], narrowed, call)

    def _how_of(
        self, kind: str, value: Tensor, dtype: torch.dtype, options: Options, labels: Sequence[Label]
    ) -> Sampler | Label | None:
        """Return how one call of C moves a value, see `_new_call`; None if it does not."""
        how: Any = field_of(kind, value).by_c
        if how is None or value.ndim - self.batched > KINDS[kind].most_dims:  # frames move by `move`
            return None
        if callable(how):
            sampler: Sampler = how(options, self.mask_fill)
            return sampler if len(sampler.fill) == 1 or len(sampler.fill) == value.shape[-3] else None
        label: Label = how
        if label == "pixels":
            return label if self.count == 1 or value.numel() < _MANY_PIXELS else None
        if label not in labels or value.dtype != dtype or not are_numbers(value):
            return None
        return label if label == "boxes" or value.is_contiguous() else None

    def _pixels_at_once(self, part: Part, values: Mapping[str, Any]) -> dict[str, MovedField]:
        """Move all pixels and boxes by one evaluation of the cameras: in torch each takes hundreds of operations."""
        warp, dtype = part.warp, part.camera.intrinsics.dtype
        given: dict[str, Tensor] = {}
        outlines: list[Tensor] = []
        for name, kind in self.fields.items():
            value = values[name]
            if isinstance(value, list) or value.dtype != dtype or value.ndim - self.batched > KINDS[kind].most_dims:
                continue
            how = field_of(kind, value).by_c
            if how == "pixels" or (how == "boxes" and known_true(in_order(value).all())):
                given[name] = rows = self.rows(value)
                outlines.append(rows if how == "pixels" else along_edges(corners_of(rows), EDGE_POINTS))
        if len(given) < 2 or not warp.moves_by_cameras:  # others move points by more than their cameras
            return {}
        moved, mapped = warp.move(torch.cat([outline.flatten(1, -2) for outline in outlines], 1))
        counts = [outline.shape[1:-1].numel() for outline in outlines]
        pairs = zip(moved.split(counts, 1), mapped.split(counts, 1), strict=True)
        results: dict[str, MovedField] = {}
        for (name, rows), outline, pair in zip(given.items(), outlines, pairs, strict=True):
            places, seen = pair[0].reshape(outline.shape), pair[1].reshape(outline.shape[:-1])
            if outline is rows:
                seen = seen & warp.target.contains(places)
            else:
                places, seen = around(warp, corners_of(rows), places, seen)
            results[name] = (places, seen) if self.batched else (places.squeeze(0), seen.squeeze(0))
        return results


class Batch(NamedTuple):
    """Samples as they move: their plan, the values of its fields, and their cameras."""

    plan: SamplePlan
    values: Mapping[str, Any]  # as they came, where these are tensors; without a dim B if the plan is not `batched`
    camera: Camera
    must_check: bool  # whether values are to be checked as they move: they were not, and come from no network

    def rows(self) -> Named:
        """Return name -> kind and value, with a dim B."""
        return {name: (kind, self.plan.rows(self.values[name])) for name, kind in self.plan.fields.items()}

    def moved(self, name: str, change: Change, options: Mapping[str, float], owner: str) -> tuple[Any, Any]:
        """Return a field after a change, with a dim B or as a list if it came so, and which of it is valid, if any."""
        kind, value, batched = self.plan.fields[name], self.values[name], self.plan.batched
        if isinstance(value, list):
            pairs = [move(change.row(i), kind, v.unsqueeze(0), options) for i, v in enumerate(value)]
            flags = [valid.squeeze(0) for _, valid in pairs if valid is not None]
            return [rows.squeeze(0) for rows, _ in pairs], flags or None
        if self.must_check:
            KINDS[kind].check(value, name, owner)
        rows, valid = move(change, kind, value if batched else value.unsqueeze(0), options)
        return (rows, valid) if batched else (rows.squeeze(0), None if valid is None else valid.squeeze(0))


def move(change: Change, kind: str, value: Tensor, options: Mapping[str, float]) -> MovedField:
    """Return values (B, ...) of a kind moved by a change; those of one sample may have more dims, of frames."""
    lead = value.shape[1 : value.ndim - KINDS[kind].most_dims]
    if lead:
        frames = change._with_parts([replace(part, rows=None) for part in change.parts], [0] * math.prod(lead))
        result, valid = move(frames, kind, value.flatten(0, len(lead)), options)
        valid = None if valid is None else valid.reshape(1, *lead, *valid.shape[1:])
        return result.reshape(1, *lead, *result.shape[1:]), valid
    result = KINDS[kind].move(change, value, options)
    result, valid = result if isinstance(result, tuple) else (result, None)
    # geometry is computed in float32 at least; what came in half precision goes out in it
    return _in_range(result, value.dtype) if value.dtype.is_floating_point else result, valid


def _in_range(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Return values in a dtype, which may be narrower: finite values stay finite."""
    if dtype == torch.float16 != values.dtype:
        most = torch.finfo(dtype).max
        values = values.clamp(-most, most)
    return values.to(dtype)
