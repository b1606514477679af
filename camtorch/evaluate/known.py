"""What is known of tensors when a call begins: their values, if they may be looked at, and whether they learn."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from camtorch.evaluate.door import in_graph, in_transform, is_concrete, is_eager, is_recorded, keeps_graph, may_look


def known_false(condition: Tensor) -> bool:
    """Return whether a condition is known to fail somewhere: what is traced is not checked."""
    return is_concrete(condition) and not bool(condition.all())


def known_true(condition: Tensor) -> bool:
    """Return whether a condition is known to hold everywhere: False if that would take more than a quick look."""
    return may_look(condition) and bool(condition.all())


def is_unknown(tensor: Tensor) -> bool:
    """Return whether values may not be looked at: traced, or within a transform, whose derivatives go forward."""
    return in_transform() or not is_concrete(tensor)


def may_write(tensor: Tensor) -> bool:
    """Return whether a tensor's values may be changed in place: nothing is traced, transformed or recorded."""
    return not is_unknown(tensor) and not is_recorded()


def are_plain(*tensors: Tensor) -> bool:
    """Return whether tensors are the CPU's, and neither a graph nor a transform is at work."""
    return not in_transform() and all(t.is_cpu and not in_graph(t) for t in tensors)


def are_known(*tensors: Tensor) -> bool:
    """Return whether the values of all tensors may be looked at."""
    return all(map(is_concrete, tensors))


def with_derivatives_of(source: Tensor, value: Tensor) -> Tensor:
    """Return a value whose derivatives are those of the tensor that it was made from, if that is in a graph."""
    return source + (value - source.detach()) if in_graph(source) else value


def values_of(tensor: Tensor) -> Tensor | None:
    """The values in float64 in the CPU's memory; None where they may not be looked at."""
    return tensor.detach().to("cpu", torch.float64) if is_concrete(tensor) else None


def are_free(*tensors: Tensor) -> bool:
    """Return whether nothing records what is computed of tensors, which lie in the CPU's memory."""
    return is_eager(*tensors) and not keeps_graph(*tensors)


def are_numbers(*tensors: Tensor) -> bool:
    """Whether nothing records what is computed of tensors, which lie in the CPU's memory and may be looked at."""
    return are_free(*tensors) and _PLAIN.issuperset(map(type, tensors))


_PLAIN = frozenset((Tensor, nn.Parameter))


def is_kept(value: Tensor) -> bool:
    """Whether a module keeps the tensor itself: a Parameter, or a tensor of a graph. Of other values it has a copy."""
    return isinstance(value, nn.Parameter) or in_graph(value)


def as_own(value: Tensor) -> Tensor:
    """A tensor that `is_kept` as it is, of other values a copy."""
    return value if is_kept(value) else value.detach().clone()


def row_of(value: Tensor) -> list[float] | None:
    """The numbers of a single short row (n,) that may be looked at: less time than one operator of torch takes."""
    return value.tolist() if value.ndim == 1 and value.shape[0] <= 64 and is_concrete(value) else None


def is_predicted(value: Tensor) -> bool:
    """Whether a network may have made these rows of a batch, of which some may be bad: a graph, or nothing records."""
    return value.ndim > 1 and not isinstance(value, nn.Parameter) and (in_graph(value) or not torch.is_grad_enabled())


def in_worker() -> bool:
    """Return whether this process is a worker of a DataLoader: no graph can leave it."""
    return not torch.compiler.is_compiling() and get_worker_info() is not None
