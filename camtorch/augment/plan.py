"""The form of samples, and its plan: which fields move, whether there is a dim B, and the call of C for most."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from threading import get_ident
from typing import Any, NamedTuple

import torch
from torch import Tensor

from camtorch.augment.change import Change, LazyWarp, Part
from camtorch.augment.fields import KINDS, field_of
from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import are_free, are_numbers, known_true
from camtorch.native.library import native_available
from camtorch.native.structs import EDGE_POINTS
from camtorch.projection.native_cameras import Native
from camtorch.values.threads import thread_count
from camtorch.warp.boxes import along_edges, around, corners_of, in_order
from camtorch.warp.options import Options, Sampler
from camtorch.warp.samples import Label, MovedField, call_for, natives_of

_OUTLINES = "pixels", "boxes"
_MANY_PIXELS = 1 << 15  # coordinates of a batch: so many are shared by threads


def form_of(
    sample: Mapping[str, Any], camera: object, fields: Mapping[str, str], revision: object
) -> tuple[Any, ...] | None:
    """Return all that a plan depends on; None if a plan cannot be kept.

    A plan cannot be kept if the camera is a `Mixed`, tensors are traced, or a field is, for example, a list.

    revision: that of the transform, which changes with its options.
    """
    if not isinstance(camera, Camera) or camera.is_mixed:
        return None
    is_free = are_free(*[value for value in sample.values() if isinstance(value, Tensor)])
    if not is_free and not are_free():
        return None
    intrinsics, distortion = camera.intrinsics, camera.distortion
    # each thread has calls of its own
    parts: list[Any] = [revision, get_ident(), type(sample), type(camera), camera.image_size]
    parts += intrinsics.shape, intrinsics.dtype, intrinsics.device, distortion.shape
    for name, value in sample.items():
        if isinstance(value, Tensor):
            parts += name, type(value), value.shape, value.stride(), value.dtype, value.device
        elif value is None or isinstance(value, (str, int, float, Camera)):
            parts += name, type(value)
        else:
            return None
    return *parts, is_free, *fields.items()


@dataclass(frozen=True)
class SamplePlan:
    """How samples of one form move. It is made once, and kept as long as the form and the transform stay the same."""

    fields: Mapping[str, str]  # name -> kind of what moves, in the order of the sample
    batched: bool
    count: int
    masks: Sequence[str]  # names of the masks of validity that come out: "image_valid" and so on
    mask_fill: float
    calls: Kept | None  # the names of the fields that one call of C moves, and the call; None if a graph may want them
    is_cpu: bool  # whether they lie there
    of_one: bool  # whether cameras are a batch of one, which serves all samples
    has_matrices: bool  # whether some field is a camera matrix

    def rows(self, value: Any) -> Any:
        """Return a value with a dim B; a list has one already."""
        return value if self.batched or isinstance(value, list) else value.unsqueeze(0)

    def together(self, change: Change, values: Mapping[str, Any]) -> dict[str, MovedField]:
        """Move by one call of C: images, pixels, and for a single sample boxes and rays.

        Without the library, pixels and boxes move by one evaluation in torch. The other fields, and all of them if no
        call serves, are not in the result.
        """
        part, calls = change.parts[0], self.calls
        moves = part.moves
        if calls is None or moves is None or part.rows is not None or change.gate is not None or not self.count:
            return {}
        if not native_available():
            return self._pixels_at_once(part, values)
        source: Native | None
        target: Native | None
        options, turns, is_turn = moves.options, None, False
        if isinstance(moves, LazyWarp):
            source, target, rotation, size = moves.source_native, moves.target_native, moves.rotation, moves.image_size
        elif part.shades or part.light is not None or (natives := natives_of(moves)) is None:
            return {}
        else:
            (source, target, rotation), size = natives, moves.target.size_for("Warp")
        if source is None or target is None:
            return {}
        if self.count == 1 and isinstance(moves, LazyWarp):
            turns, is_turn = source.dtype, moves.is_turn
        elif max(source.cameras, target.cameras, 1 if rotation is None else rotation.numel() // 9) != self.count:
            return {}
        sizes = part.camera.size_for("Warp"), size
        settings = sizes, source.dtype, turns, is_turn, thread_count(), *options.values()
        if (known := calls.entry((), settings)) is None:
            ways = self._ways(values, options, turns, is_turn)
            chosen = [values[name] for name in ways]
            call = call_for(sizes, source.dtype, options, chosen, [*ways.values()], self.batched) if ways else None
            others = [n for n, how in ways.items() if how in _OUTLINES and values[n].dtype != source.dtype]
            names, others, call = calls((), settings, lambda: ([*ways], others, call))
        else:
            names, others, call = known[2]
        if call is None or (moved := call(source, target, rotation, [*map(values.__getitem__, names)])) is None:
            return {}
        results: dict[str, Any] = dict(zip(names, moved, strict=True))
        if None in moved:
            results = {name: result for name, result in results.items() if result is not None}
        for name in others:  # which were computed in the dtype of the cameras
            if name in results:
                rows, valid = results[name]
                results[name] = _in_range(rows, values[name].dtype), valid
        return results

    def _pixels_at_once(self, part: Part, values: Mapping[str, Any]) -> dict[str, MovedField]:
        """Move pixels and boxes by one evaluation of the cameras, of which torch makes hundreds of operations."""
        warp, dtype = part.warp, part.camera.intrinsics.dtype
        given, outlines = dict[str, Tensor](), list[Tensor]()
        for name, kind in self.fields.items():
            value = values[name]
            if isinstance(value, list) or value.dtype != dtype or value.ndim - self.batched > KINDS[kind].most_dims:
                continue
            way = field_of(kind, value).by_c
            if way == "pixels" or (way == "boxes" and known_true(in_order(value).all())):
                given[name] = rows = self.rows(value)
                outlines.append(rows if way == "pixels" else along_edges(corners_of(rows), EDGE_POINTS))
        if len(given) < 2 or not warp.moves_by_cameras:  # others move points by more than their cameras
            return {}
        moved, mapped = warp.move(torch.cat([outline.flatten(1, -2) for outline in outlines], 1))
        counts, results = [outline.shape[1:-1].numel() for outline in outlines], dict[str, MovedField]()
        pairs = zip(moved.split(counts, 1), mapped.split(counts, 1), strict=True)
        for (name, rows), outline, pair in zip(given.items(), outlines, pairs, strict=True):
            places, seen = pair[0].reshape(outline.shape), pair[1].reshape(outline.shape[:-1])
            if outline is rows:
                seen = seen & warp.target.contains(places)
            else:
                places, seen = around(warp, corners_of(rows), places, seen)
            results[name] = (places, seen) if self.batched else (places.squeeze(0), seen.squeeze(0))
        return results

    def _ways(
        self, values: Mapping[str, Any], options: Options, turns: torch.dtype | None, is_turn: bool
    ) -> dict[str, Sampler | Label]:
        """Return how each field moves that one call of C takes.

        turns: the dtype in which labels of a single sample turn; None if they do not turn by the call. is_turn: whether
        the rotation does not mirror.
        """
        ways: dict[str, Sampler | Label] = {}
        for name, kind in self.fields.items():
            value = values[name]
            if isinstance(value, list) or (way := field_of(kind, value).by_c) == "never":
                return {}
            if value.ndim - self.batched > KINDS[kind].most_dims:  # frames
                continue
            if callable(way):
                sampler = way(options, self.mask_fill)
                ways |= {name: sampler} if len(sampler.fill) == 1 or len(sampler.fill) == value.shape[-3] else {}
            elif way == "pixels":
                ways |= {name: way} if self.count == 1 or value.numel() < _MANY_PIXELS else {}
            elif way is None or value.dtype != turns or not are_numbers(value):
                continue
            elif way == "boxes" or (value.is_contiguous() and (way == "rays" or is_turn)):
                ways[name] = way
        return ways


class Batch(NamedTuple):
    """Samples as they move: their plan, the values of its fields, and their cameras."""

    plan: SamplePlan
    values: Mapping[str, Any]  # as they came, where these are tensors; without a dim B if the plan is not `batched`
    camera: Camera
    checked: bool  # True: values were checked, or may be bad; False: their form is known, and `_moved` checks them

    def rows(self) -> dict[str, tuple[str, Any]]:
        """Return name -> kind and value, with a dim B."""
        return {name: (kind, self.plan.rows(self.values[name])) for name, kind in self.plan.fields.items()}


def move(change: Change, kind: str, value: Tensor, options: Mapping[str, float]) -> MovedField:
    """Return values (B, ...) of a kind moved by a change; those of one sample may have more dims, of frames."""
    if lead := value.shape[1 : value.ndim - KINDS[kind].most_dims]:
        frames = Change(math.prod(lead), [replace(part, rows=None) for part in change.parts])
        result, valid = move(frames, kind, value.flatten(0, len(lead)), options)
        return result.reshape(1, *lead, *result.shape[1:]), valid if valid is None else valid.reshape(
            1, *lead, *valid.shape[1:]
        )
    result = field_of(kind, value).move(change, value, options)
    result, valid = result if isinstance(result, tuple) else (result, None)
    # geometry is computed in float32 at least; what came in half precision goes out in it
    return _in_range(result, value.dtype) if value.dtype.is_floating_point else result, valid


def _in_range(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Return values in a dtype, which may be narrower: finite values stay finite."""
    if dtype == torch.float16 != values.dtype:
        most = torch.finfo(dtype).max
        values = values.clamp(-most, most)
    return values.to(dtype)
