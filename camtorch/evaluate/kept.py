"""Results of computations, kept while the values of their inputs stay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from camtorch.evaluate.door import has_tangent, in_transform, is_concrete, is_eager, outside_inference

T = TypeVar("T")


class Entry(NamedTuple):
    """A result that is kept, and what it was computed from."""

    key: tuple[Any, ...]
    notes: list[Note]
    result: Any


class Kept:
    """The last results of a computation, by the values of its inputs on the CPU, by their memory elsewhere.

    On the CPU values are compared, not versions: a change through `.data`, or by functional_call, leaves no other
    trace. On another device a comparison would wait for it; there such a change is not seen. Nothing is kept while the
    values may not be read. Copies and pickles begin empty.
    """

    capacity: int = 1
    result: Any = None  # the one that was returned last, for any inputs
    _kept: Sequence[Entry] = ()  # the last one used is first

    def __init__(self, capacity: int = 1) -> None:
        self.capacity = capacity

    def __call__(self, inputs: Sequence[Tensor], key: tuple[Any, ...], compute: Callable[[], T]) -> T:
        """Return `compute()` without a graph, or its kept result; it depends on the tensors `inputs` and on `key`."""
        if inputs and not is_eager(*inputs) and not all(is_concrete(t) and not has_tangent(t) for t in inputs):
            return compute()
        result: T = self.get(inputs, key, compute)
        return result

    def get(
        self, inputs: Sequence[Tensor], key: tuple[Any, ...], compute: Callable[..., Any] | None = None, *arguments: Any
    ) -> Any:
        """Return what is kept for inputs whose values may be read, else `compute(*arguments)`, which is kept then.

        Without `compute` None if nothing is kept.
        """
        known = self._kept
        for i, entry in enumerate(known):
            if key == entry.key and all(map(same, inputs, entry.notes)):
                if i:  # a new list, as another thread may be reading this one
                    self._kept = [entry, *known[:i], *known[i + 1 :]]
                self.result = result = entry.result
                return result
        if compute is None:
            return None
        if in_transform():  # a transform's tensors die with it
            return compute(*arguments)
        with torch.inference_mode(False), torch.no_grad():  # a graph cannot use tensors of inference mode
            notes = [note(t) for t in inputs]
            result = compute(*arguments)
        self._kept, self.result = [Entry(key, notes, result), *self._kept[: self.capacity - 1]], result
        return result

    def unless_learning(self, inputs: Sequence[Tensor], key: tuple[Any, ...], compute: Callable[[], T]) -> T:
        """Return `compute()` with its graph if an input learns, else as the call does."""
        learns = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
        return compute() if learns else self(inputs, key, compute)

    def renew(self, compute: Callable[[], T]) -> T:
        """Return `compute()`, which is the result from now on."""
        if in_transform():  # a transform's tensors die with it
            return compute()
        with outside_inference():
            self.result = result = compute()
        return result

    def __getstate__(self) -> dict[str, Any]:
        return {"capacity": self.capacity}


Note = tuple[Tensor, tuple[Any, ...] | None]
"""A record of a tensor, to know it by: its values and None, or the tensor, whose memory stays, and its mark."""


def note(tensor: Tensor) -> Note:
    """Return the note that `same` compares with: values on the CPU, or if a tensor has no memory or no version."""
    if tensor.is_cpu or tensor.is_inference() or (tensor.numel() and not tensor.untyped_storage().data_ptr()):
        return tensor.detach().clone(), None
    return tensor.detach(), mark(tensor)


def same(tensor: Tensor, noted: Note) -> bool:
    """Whether shape, dtype, device and all values are as they were noted."""
    then = noted[0]
    if tensor.dtype != then.dtype or tensor.device != then.device:
        return False
    if noted[1] is None:
        return torch.equal(tensor, then)  # False if the shapes differ
    return not tensor.is_inference() and noted[1] == mark(tensor)


def mark(tensor: Tensor) -> tuple[Any, ...]:
    """Return the place of a tensor's values in its device's memory, and how often they were changed in place."""
    # dims of size one differ without a reason: a camera's numbers come as (n,) and as (1, n)
    steps = tuple(pair for pair in zip(tensor.shape, tensor.stride(), strict=True) if pair[0] != 1)
    return tensor.untyped_storage().data_ptr(), tensor.storage_offset(), tensor._version, steps
