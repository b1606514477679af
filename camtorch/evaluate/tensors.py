"""Questions about tensors when a call begins: their values, if they may be read, and whether they learn.

What the questions of this file and of `door.py` say of a plain tensor on the CPU, of one that learns, of one that a
transform of torch.func holds, of one beside such a transform, of a dual one, and of one that is traced for a graph:

    question            plain  learns  in func  beside func  dual  traced
    is_concrete         yes    yes     no       yes          yes   no      the values can be read
    is_cheap_to_read    yes    yes     no       yes          yes   no      on the CPU, at once
    not is_unknown      yes    yes     no       no           yes   no      what is made of them may be kept
    is_eager            yes    yes     no       no           no    no      nothing watches the call at all
    may_branch_on       yes    yes     no       no           no    no      as `is_eager`, of some values
    are_free            yes    no      no       no           no    no      and autograd does not record
    are_numbers         yes    no      no       no           no    no      and no tensor is of a subclass
    are_plain           yes    no      no       no           no    no      no derivative, even under `no_grad`
    in_graph            no     yes     yes      no           yes   yes     derivatives pass, or it is traced
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from camtorch.evaluate.door import in_graph, in_transform, is_cheap_to_read, is_concrete, is_eager, is_recorded


def known_false(condition: Tensor) -> bool:
    """Whether a condition is known to fail somewhere: a traced one is not checked."""
    return is_concrete(condition) and not bool(condition.all())


def known_some(condition: Tensor) -> bool:
    """Whether a condition is known to hold somewhere: a traced one is not checked."""
    return is_concrete(condition) and bool(condition.any())


def known_true(condition: Tensor) -> bool:
    """Whether a condition is known to hold everywhere: False if finding out would take more than a quick look."""
    return is_cheap_to_read(condition) and bool(condition.all())


def may_branch_on(values: Tensor, *others: Tensor) -> bool:
    """Whether a formula may read values: to leave out what points need that are not valid, or steps that move none."""
    return is_eager(values, *others) and values.numel() > 0


def is_unknown(tensor: Tensor) -> bool:
    """Whether values cannot be read, as they are traced, or any transform of torch.func is active, also grad and vmap.

    A dual tensor of `torch.autograd.forward_ad` is not unknown.
    """
    return in_transform() or not is_concrete(tensor)


def may_write(tensor: Tensor) -> bool:
    """Whether a tensor's values may be changed in place: nothing is traced, transformed or recorded."""
    return not is_unknown(tensor) and not is_recorded()


def are_plain(*tensors: Tensor) -> bool:
    """Whether tensors are on the CPU, and neither a graph nor a transform is active."""
    return not in_transform() and all(t.is_cpu and not in_graph(t) for t in tensors)


def are_concrete(*tensors: Tensor) -> bool:
    """Whether the values of all tensors may be read."""
    return all(map(is_concrete, tensors))


def with_derivatives_of(source: Tensor, value: Tensor) -> Tensor:
    """Return `value` with the derivatives of `source`, the tensor that it was made from, if that is in a graph."""
    return source + (value - source.detach()) if in_graph(source) else value


def values_of(tensor: Tensor) -> Tensor | None:
    """Return the values in float64 in the CPU's memory, or None if they may not be read."""
    return tensor.detach().to("cpu", torch.float64) if is_concrete(tensor) else None


def are_free(*tensors: Tensor) -> bool:
    """Whether nothing records operations on tensors, which lie in the CPU's memory."""
    if not is_eager(*tensors):
        return False
    for tensor in tensors if torch.is_grad_enabled() else ():  # noqa: SIM110 (as in `is_eager`)
        if tensor.requires_grad:
            return False
    return True


def are_numbers(*tensors: Tensor) -> bool:
    """Whether nothing records operations on tensors, which are plain ones in the CPU's memory."""
    return are_free(*tensors) and _TYPES.issuperset(map(type, tensors))


def hold_numbers(tensors: Sequence[Tensor]) -> bool:
    """Whether `are_numbers`, in less time, if it is known that nothing is traced or transformed."""
    records = torch.is_grad_enabled()
    for tensor in tensors:
        if type(tensor) not in _TYPES or not tensor.is_cpu or (records and tensor.requires_grad):
            return False
    return True


_TYPES = frozenset((Tensor, nn.Parameter))


def is_kept(value: Tensor) -> bool:
    """Whether a module keeps the tensor itself: a Parameter, or a tensor of a graph. It copies other values."""
    return isinstance(value, nn.Parameter) or in_graph(value)


def as_own(value: Tensor) -> Tensor:
    """Return a tensor that `is_kept` itself, and a copy of other values."""
    return value if is_kept(value) else value.detach().clone()


def row_of(value: Tensor) -> list[float] | None:
    """Return the numbers of one short row (n,), fast; None for other tensors or if values may not be read."""
    return value.tolist() if value.ndim == 1 and value.shape[0] <= 64 and is_concrete(value) else None


def is_predicted(value: Tensor) -> bool:
    """Whether a network may have made these rows, some of them bad: they have a graph, or nothing records."""
    return value.ndim > 1 and not isinstance(value, nn.Parameter) and (in_graph(value) or not torch.is_grad_enabled())


def in_worker() -> bool:
    """Whether this process is a worker of a DataLoader: no graph can leave it."""
    return not torch.compiler.is_compiling() and get_worker_info() is not None
