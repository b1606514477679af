"""Whether a tensor has values that may be looked at, and what is recorded of it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import forward_ad

FAKE_MODE = torch._C._TorchDispatchModeKey.FAKE
"""The key of a FakeTensorMode among the modes that are under way."""

_DENSE = torch._C._dispatch_keys(torch.empty(0, device="cpu"))


def has_tangent(tensor: Tensor) -> bool:
    """Whether forward-mode derivatives pass through the tensor."""
    return forward_ad._current_level >= 0 and forward_ad.unpack_dual(tensor).tangent is not None


def in_transform() -> bool:
    """Whether a transform of torch.func is under way."""
    return torch._C._functorch.peek_interpreter_stack() is not None


def in_graph(tensor: Tensor) -> bool:
    """Whether derivatives, of either mode, or a transform pass through the tensor, or it is traced."""
    return tensor.requires_grad or _is_traced(tensor) or has_tangent(tensor)


def is_concrete(tensor: Tensor) -> bool:
    """Whether the values may be looked at: not while a graph is traced, nor inside vmap, grad or jacfwd.

    Nor are there any on the meta device or in a FakeTensorMode, where modules are made of shapes alone.
    """
    return not (_is_traced(tensor) or tensor.is_meta or _is_fake(tensor))


def _is_traced(tensor: Tensor) -> bool:
    return torch.compiler.is_compiling() or torch._C._functorch.is_functorch_wrapped_tensor(tensor)


def _is_fake(tensor: Tensor) -> bool:
    if torch._C._get_dispatch_mode(FAKE_MODE) is not None:
        return True
    # not imported for its name alone: that takes a third of a second
    return type(tensor) is not Tensor and type(tensor).__name__ == "FakeTensor"


def in_memory(tensor: Tensor) -> bool:
    """Whether the values are what lies in the CPU's memory at `data_ptr`: of no subclass that has them elsewhere.

    Nor are they to be negated first, or compressed, or zero by declaration.
    """
    mine: int = (torch._C._dispatch_keys(tensor) | _DENSE).raw_repr()
    return mine == _DENSE.raw_repr()


def is_recorded() -> bool:
    """Whether torch's operators are recorded, or a mode changes what they do: what goes past them would be lost."""
    return torch.jit.is_tracing() or torch._C._len_torch_dispatch_stack() > 0


def may_look(tensor: Tensor) -> bool:
    """Whether the values may be looked at and that costs next to nothing, to take a shorter way with a whole block."""
    return tensor.is_cpu and is_concrete(tensor) and tensor.numel() > 0


def register(registry: dict[str, type], entry: type) -> str:
    """Put a class into a registry under its full name: operators, which take no classes, find it by that.

    A class of the same name, made by a function that was called again, gets a name of its own.
    """
    wanted = name = f"{entry.__module__}.{entry.__qualname__}"
    count = 2
    while name in registry:
        name, count = f"{wanted}#{count}", count + 1
    registry[name] = entry
    return name
