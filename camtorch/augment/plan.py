"""The plan of a form of samples: what moves, whether there is a dim B, and the one call of C that moves most of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from camtorch.augment.change import Change, Drawn
from camtorch.augment.fields import KINDS, field_of, in_range
from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import are_numbers
from camtorch.values.threads import thread_count
from camtorch.warp.samples import Label, call_for
from camtorch.warp.sampling import Options, Sampler

_MANY_PIXELS = 1 << 15  # coordinates of a batch: so many are shared by threads


@dataclass(frozen=True)
class Plan:
    """How samples of one form move. It is made once, and kept as long as the form and the transform stay the same."""

    fields: Mapping[str, str]  # name -> kind of what moves, in the order of the sample
    batched: bool
    count: int
    masks: Sequence[str]  # names of the masks of validity that come out: "image_valid" and so on
    calls: Kept | None  # the names of the fields that one call of C moves, and the call; None if a graph may want them

    def rows(self, value: Any) -> Any:
        """Return a value with a dim B; a list has one already."""
        return value if self.batched or isinstance(value, list) else value.unsqueeze(0)

    def together(
        self, change: Change, values: Mapping[str, Any], mask_fill: float
    ) -> dict[str, tuple[Tensor, Tensor | None]]:
        """Move by one call of C: images, pixels, and for a single sample boxes and rays; also return their validity.

        The other fields, and all of them where no call serves, are not in the result.
        """
        part = change.parts[0]
        moves = part.moves
        if moves is None or part.rows is not None or change.gate is not None or not self.count or self.calls is None:
            return {}
        if (between := part.between()) is None:
            return {}
        source, target, rotation = between
        most = max(source.cameras, target.cameras, 1 if rotation is None else rotation.numel() // 9)
        if most != self.count:
            return {}
        options, is_single = moves.options, change.count == 1
        turns = is_single and isinstance(moves, Drawn)  # labels of a single sample, by new cameras
        is_turn = isinstance(moves, Drawn) and turns and moves.is_turn
        sizes = part.camera.size_for("Warp"), part.image_size
        settings = sizes, source.dtype, *options.values(), mask_fill, turns, is_turn, thread_count()
        known = self.calls.entry((), settings)
        if known is None:
            ways = self._ways(values, options, mask_fill, source.dtype if turns else None, is_turn, is_single)
            chosen = [values[name] for name in ways]
            call = call_for(sizes, source.dtype, options, chosen, [*ways.values()], self.batched) if ways else None
            names = self.calls((), settings, lambda: (list(ways), call))[0]
        else:
            names, call = known[2]
        given = [values[name] for name in names]
        moved = None if call is None else call(source, target, rotation, given)
        results: dict[str, tuple[Tensor, Tensor | None]] = {}
        for name, value, result in zip(names, given, moved or (), strict=bool(moved)):
            if result is not None:
                rows, valid = result
                results[name] = rows if rows.dtype == value.dtype else in_range(rows, value.dtype), valid
        return results

    def _ways(
        self,
        values: Mapping[str, Any],
        options: Options,
        mask_fill: float,
        dtype: torch.dtype | None,
        is_turn: bool,
        is_single: bool,
    ) -> dict[str, Sampler | Label]:
        """Return how each field moves that one call of C takes.

        dtype: of labels of a single sample that turn, or None. is_turn: whether the rotation does not mirror.
        """
        mode, padding_mode, fill = options["mode"], options["padding_mode"], options["fill"]
        ways: dict[str, Sampler | Label] = {}
        for name, kind in self.fields.items():
            value = values[name]
            if kind in ("depth", "distance") or isinstance(value, list):  # these need the positions again
                return {}
            dims = value.ndim - self.batched
            if dims > KINDS[kind].most_dims:  # frames
                continue
            if kind == "image" and len(fill) in (1, value.shape[-3]):
                ways[name] = Sampler(mode, padding_mode, fill)
            elif kind == "mask":
                ways[name] = Sampler("nearest", "zeros", (mask_fill,))
            elif (way := field_of(kind, value).way) == "pixels":
                ways |= {name: way} if is_single or value.numel() < _MANY_PIXELS else {}
            elif way is None or value.dtype != dtype or not are_numbers(value):
                continue
            elif way == "boxes" or (value.is_contiguous() and (way == "rays" or is_turn)):
                ways[name] = way
        return ways


class Batch(NamedTuple):
    """Samples as they move: their plan, the values of its fields, and their cameras."""

    plan: Plan
    values: Mapping[str, Any]  # as they came, where these are tensors; without a dim B if the plan is not `batched`
    camera: Camera
    checked: bool  # whether the values were looked at, and not their form alone

    def rows(self) -> dict[str, tuple[str, Any]]:
        """Return name -> kind and value, with a dim B."""
        return {name: (kind, self.plan.rows(self.values[name])) for name, kind in self.plan.fields.items()}
