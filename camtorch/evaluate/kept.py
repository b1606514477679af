"""What is kept of a computation while the values that it was made of stay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from camtorch.evaluate.door import has_tangent, in_graph, in_transform, is_concrete, is_eager, outside_inference

T = TypeVar("T")


class Kept:
    """The last results of a computation, by its inputs: by their values on the CPU, by their memory elsewhere.

    On the CPU values are compared, not versions: a change through `.data`, or by functional_call, leaves no other
    trace. On another device a comparison would wait for it; there such a change is not seen. Nothing is kept while the
    values may not be looked at. Copies and pickles begin empty.
    """

    capacity: int = 1
    result: Any = None  # the one that was asked for last, of whatever inputs
    _kept: Sequence[tuple[tuple[Any, ...], list[Note], Any]] = ()  # the last one used is first

    def __init__(self, capacity: int = 1) -> None:
        if capacity != 1:
            self.capacity = capacity

    def __call__(self, inputs: Sequence[Tensor], options: tuple[Any, ...], compute: Callable[[], T]) -> T:
        """`compute()` without a graph, or its kept result; it depends on the tensors `inputs` and on `options`."""
        if inputs and not is_eager(*inputs) and not all(is_concrete(t) and not has_tangent(t) for t in inputs):
            return compute()
        if (entry := self.entry(inputs, options)) is not None:
            found: T = entry[2]
            self.result = found
            return found
        if in_transform():  # what a transform makes dies with it
            return compute()
        with torch.inference_mode(False), torch.no_grad():  # what that makes could not be used in a graph later
            notes = [note(t) for t in inputs]
            result = compute()
        self._kept, self.result = [(options, notes, result), *self._kept[: self.capacity - 1]], result
        return result

    def entry(
        self, inputs: Sequence[Tensor], options: tuple[Any, ...]
    ) -> tuple[tuple[Any, ...], list[Note], Any] | None:
        """Return what is kept of inputs whose values may be looked at: options, notes and the result."""
        known = self._kept
        for i, entry in enumerate(known):
            if options == entry[0] and all(map(same, inputs, entry[1])):
                if i:  # a list of its own: another thread may be looking at this one
                    self._kept = [entry, *known[:i], *known[i + 1 :]]
                return entry
        return None

    def renew(self, compute: Callable[[], T]) -> T:
        """`compute()`, which is the result from now on."""
        if in_transform():  # what a transform makes dies with it
            return compute()
        with outside_inference():
            self.result = result = compute()
        return result

    def copies(
        self, inputs: Sequence[Tensor], options: tuple[Any, ...], compute: Callable[[], tuple[Tensor, ...]]
    ) -> tuple[Tensor, ...]:
        """Tensors that belong to the caller: copies of those kept, or new ones where an input learns."""
        if torch.is_grad_enabled() and any(map(in_graph, inputs)):
            return compute()
        return tuple(t.clone() for t in self(inputs, options, compute))

    def __getstate__(self) -> dict[str, Any]:
        return {"capacity": self.capacity}


Mark = tuple[Any, ...]
Note = tuple[Tensor, Mark | None]
"""What tells whether a tensor is as it was: its values and None, or the tensor, whose memory stays, and its mark."""


def note(tensor: Tensor) -> Note:
    """Return what `same` compares with: values where there is no memory, as of a subclass, or no version."""
    if tensor.is_cpu or tensor.is_inference() or (tensor.numel() and not tensor.untyped_storage().data_ptr()):
        return tensor.detach().clone(), None
    return tensor.detach(), _mark(tensor)


def same(tensor: Tensor, noted: Note) -> bool:
    """Return whether shape, dtype, device and all values are as they were noted."""
    then, mark = noted
    if tensor.dtype != then.dtype or tensor.device != then.device:
        return False
    if mark is None:
        return torch.equal(tensor, then)  # of other shapes it says no
    return not tensor.is_inference() and mark == _mark(tensor)


def _mark(tensor: Tensor) -> Mark:
    # dims of one tell nothing: a camera's numbers come as (n,) and as (1, n)
    steps = [pair for pair in zip(tensor.shape, tensor.stride(), strict=True) if pair[0] != 1]
    return tensor.untyped_storage().data_ptr(), tensor.storage_offset(), tensor._version, steps
