"""Values on devices other than the CPU: those known on the CPU as well, for which nobody waits, and what is sent."""

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from camtorch.evaluate.door import keeps_graph, outside_inference
from camtorch.evaluate.kept import mark
from camtorch.evaluate.tensors import is_unknown

_ALIGNMENT_BYTES = 16  # where the numbers of any dtype may begin
_MOST_TENSORS = 64

_known: dict[tuple[Any, ...], tuple[Tensor, Tensor]] = {}
"""Mark of a tensor, which edits in place change -> the tensor, so that its memory stays, and its values on the CPU."""


def may_read(*tensors: Tensor) -> bool:
    """Whether tensors are numbers that nobody learns, traces or may change without a trace."""
    return not (keeps_graph(*tensors) or any(is_unknown(t) or t.is_inference() for t in tensors))


def on_cpu(*tensors: Tensor, may_wait: bool = False) -> list[Tensor] | None:
    """Return values of tensors that may be looked at, if they are known on the CPU, or if one `may_wait` for them.

    None on the CPU, and of tensors of inference mode, whose edits leave no trace.
    """
    if any(t.is_cpu or t.is_inference() for t in tensors):
        return None
    pairs = [_known.get(_key(t)) for t in tensors]
    unknown = [t.detach() for t, pair in zip(tensors, pairs, strict=True) if pair is None]
    if unknown and not may_wait:
        return None
    values = [pair[1] for pair in pairs if pair is not None]
    if unknown:
        with outside_inference():
            numbers = torch.cat([t.reshape(-1).view(torch.uint8) for t in unknown]).cpu()
        parts = iter(numbers.split([t.nbytes for t in unknown]))
        values = [
            remember(t, next(parts).clone().view(t.dtype)) if pair is None else pair[1]
            for t, pair in zip(tensors, pairs, strict=True)
        ]
    return [value.view(t.shape) for t, value in zip(tensors, values, strict=True)]


def remember(tensor: Tensor, values: Tensor) -> Tensor:
    """Have `on_cpu` find the values of a tensor, on the CPU, without asking its device."""
    if not (tensor.is_cpu or tensor.is_inference()):
        _known[_key(tensor)] = tensor.detach(), values.detach().contiguous()
    while len(_known) > _MOST_TENSORS:
        _known.pop(next(iter(_known)), None)
    return values


def _key(tensor: Tensor) -> tuple[Any, ...]:
    return tensor.dtype, tensor.device, *mark(tensor)


def sent(tensors: Sequence[Tensor], device: torch.device) -> list[Tensor]:
    """Return tensors of the CPU on another device: by one copy, for which nobody waits."""
    starts = [0, *accumulate(-(-t.nbytes // _ALIGNMENT_BYTES) * _ALIGNMENT_BYTES for t in tensors)]
    places = [slice(start, start + t.nbytes) for start, t in zip(starts, tensors, strict=False)]
    with outside_inference():
        # copies from other memory wait for what the device has still to do
        room = torch.empty(starts[-1], dtype=torch.uint8, device="cpu", pin_memory=device.type == "cuda")
        for tensor, place in zip(tensors, places, strict=True):
            room[place].view(tensor.dtype).view(tensor.shape).copy_(tensor.detach())
        there = room.to(device, non_blocking=room.is_pinned())
        return [there[place].view(t.dtype).view(t.shape) for t, place in zip(tensors, places, strict=True)]
