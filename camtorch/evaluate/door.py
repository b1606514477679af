"""The door: which way a call takes. Natively on a CPU where nothing is recorded, else as torch records the formula."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import NoneType
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.utils._python_dispatch import _disable_current_modes

FAKE_MODE = torch._C._TorchDispatchModeKey.FAKE
"""The key of a FakeTensorMode among the modes that are under way."""

_DENSE = torch._C._dispatch_keys(torch.empty(0, device="cpu"))
_PLAIN: int = _DENSE.raw_repr()


def has_tangent(tensor: Tensor) -> bool:
    """Whether forward-mode derivatives pass through the tensor."""
    return forward_ad._current_level >= 0 and forward_ad.unpack_dual(tensor).tangent is not None


def in_transform() -> bool:
    """Whether a transform of torch.func is under way."""
    # for dynamo what comes out is an object, and "is not None" of any object true
    return not isinstance(torch._C._functorch.peek_interpreter_stack(), NoneType)


def in_graph(tensor: Tensor) -> bool:
    """Whether derivatives, of either mode, or a transform pass through the tensor, or it is traced."""
    return tensor.requires_grad or _is_traced(tensor) or has_tangent(tensor)


def is_concrete(tensor: Tensor) -> bool:
    """Whether the values may be looked at: not while a graph is traced, nor inside vmap, grad or jacfwd.

    Nor are there any on the meta device or in a FakeTensorMode, where modules are made of shapes alone.
    """
    if _is_traced(tensor) or tensor.is_meta:
        return False
    return torch._C._get_dispatch_mode(FAKE_MODE) is None and not is_fake(tensor)


def _is_traced(tensor: Tensor) -> bool:
    return torch.compiler.is_compiling() or torch._C._functorch.is_functorch_wrapped_tensor(tensor)


def is_fake(tensor: Tensor) -> bool:
    """Whether a tensor is one of a FakeTensorMode, which has a shape and no values."""
    # not imported for its name alone: that takes a third of a second
    return type(tensor) is not Tensor and type(tensor).__name__ == "FakeTensor"


def in_memory(tensor: Tensor) -> bool:
    """Whether the values are what lies in the CPU's memory at `data_ptr`: of no subclass that has them elsewhere.

    Nor are they to be negated first, or compressed, or zero by declaration.
    """
    keys = torch._C._dispatch_keys(tensor)
    mine: int = keys.raw_repr()
    return mine == _PLAIN or (keys | _DENSE).raw_repr() == _PLAIN


def is_recorded() -> bool:
    """Whether torch's operators are recorded, or a mode changes what they do: what goes past them would be lost."""
    return in_jit_trace() or torch._C._len_torch_dispatch_stack() > 0


in_jit_trace: Callable[[], bool] = torch.jit.is_tracing  # type: ignore[attr-defined]
"""Whether torch.jit.trace is at work."""

is_exporting: Callable[[], bool] = torch.compiler.is_exporting
"""Whether what is traced shall run elsewhere, where there are no operators of our own."""


def records_constants() -> bool:
    """Whether a program is exported into which values go as constants: not while dynamo traces it."""
    return is_exporting() and not torch.compiler.is_dynamo_compiling()


def is_for_here() -> bool:
    """Whether what is traced is compiled for this machine."""
    return torch.compiler.is_compiling() and not is_exporting()


def keeps_graph(*tensors: Tensor) -> bool:
    """Whether derivatives by any of the tensors are to be recorded: not in a file for another runtime."""
    if torch.is_grad_enabled():
        for tensor in tensors:
            if tensor.requires_grad:
                return not (is_exporting() and torch.onnx.is_in_onnx_export())
    return False


def is_constant(module: nn.Module) -> bool:
    """Whether a module is exported whose tensors are its own, not given, and do not learn: their values are known."""
    if not records_constants():
        return False
    for part in module.modules():
        own = part.__dict__.get("_own", {})
        for name, tensor in (*part._parameters.items(), *part._buffers.items()):
            known = own.get(name)
            if tensor is None or tensor is known:
                continue
            if known is None or not is_fake(tensor) or is_fake(known) or keeps_graph(tensor):
                return False
            mode: Any = getattr(tensor, "fake_mode", None)
            if mode.from_tensor(known, static_shapes=True) is not tensor:
                return False
    return True


@contextmanager
def set_aside() -> Iterator[None]:
    """Nothing is traced in here: what is made of values becomes a constant of the graph that is being recorded."""
    flags = {name: getattr(torch.compiler, name, False) for name in ("_is_compiling_flag", "_is_exporting_flag")}
    recording = torch._C._get_tracing_state()  # of torch.jit.trace
    with torch._C.DisableTorchFunction(), _disable_current_modes(), torch.no_grad():
        try:
            torch._C._set_tracing_state(None)  # type: ignore[attr-defined]
            for name in flags:
                setattr(torch.compiler, name, False)
            yield
        finally:
            torch._C._set_tracing_state(recording)  # type: ignore[attr-defined]
            for name, flag in flags.items():
                setattr(torch.compiler, name, flag)


def outside_inference() -> AbstractContextManager[None]:
    """Have tensors made in here serve a graph later, as those of inference mode could not; without a graph as yet."""
    if torch.compiler.is_compiling() or not torch.is_inference_mode_enabled():
        return nullcontext()
    return _outside_inference()


@contextmanager
def _outside_inference() -> Iterator[None]:
    with torch.inference_mode(False), torch.no_grad():
        yield


def converted(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """The tensor in a dtype; what becomes a constant of an exported program is converted before it is one."""
    if not records_constants() or is_fake(tensor):
        return tensor.to(dtype)
    with set_aside():
        return tensor.to(dtype)


def is_eager(*tensors: Tensor) -> bool:
    """Whether nothing is traced, transformed or recorded, and all values are what lies in the CPU's memory."""
    # asked often, and in one place: each function more would take as long as what it asks
    if (
        torch.compiler.is_compiling()
        or torch._C._functorch.peek_interpreter_stack() is not None
        or torch._C._get_tracing_state() is not None
        or torch._C._len_torch_dispatch_stack() > 0
        or forward_ad._current_level >= 0
    ):
        return False
    keys_of = torch._C._dispatch_keys
    for tensor in tensors:  # noqa: SIM110 (a generator takes half as long again)
        if keys_of(tensor).raw_repr() != _PLAIN and not in_memory(tensor):
            return False
    return True


def may_look(tensor: Tensor) -> bool:
    """Whether the values may be looked at and that costs next to nothing, to take a shorter way with a whole block."""
    return tensor.is_cpu and is_concrete(tensor) and 0 not in tensor.shape


class Way(NamedTuple):
    """How a call is evaluated."""

    is_native: bool
    """By compiled code, if that has the model."""
    learns: bool
    """Whether derivatives are recorded of what is compiled."""
    is_known: bool
    """Whether the values of the parameters may be looked at, so that what is made of them is kept."""
    order: int
    """Of the derivatives that the recorded formula must have exactly."""
    is_constant: bool = False
    """Whether the module is a constant of the program that is exported."""


_NATIVE, _LEARNING = Way(True, False, True, 2), Way(True, True, True, 2)


def way_of(module: nn.Module, values: Tensor, *parameters: Tensor) -> Way:
    """Return the way of a module's call with values and parameters; a RuntimeError where torch could record none."""
    # asked once a call, and in one place: each function more would take as long as what it asks
    is_plain = not (
        torch.compiler.is_compiling()
        or torch._C._functorch.peek_interpreter_stack() is not None
        or forward_ad._current_level >= 0
        or torch._C._get_dispatch_mode(FAKE_MODE) is not None
    )
    learns = False
    for tensor in (values, *parameters):
        is_plain = is_plain and ((type(tensor) is Tensor and not tensor.is_meta) or is_concrete(tensor))
        learns = learns or tensor.requires_grad
    if is_plain:
        if in_jit_trace() and torch.onnx.is_in_onnx_export():
            raise RuntimeError(
                f"{type(module).__name__}: torch.onnx.export(dynamo=False) cannot record a camera; dynamo=True can. "
                "What a frozen camera or warp keeps is a constant: camera.rays() and warp(images), with "
                "requires_grad_(False) and called once before the export"
            )
        if in_memory(values) and not in_jit_trace() and torch._C._len_torch_dispatch_stack() == 0:
            return _LEARNING if learns and torch.is_grad_enabled() else _NATIVE
    is_known = all(is_concrete(t) and not has_tangent(t) for t in parameters)
    # what is compiled has no derivatives of derivatives
    return Way(False, False, is_known, 1 if torch.compiler.is_compiling() else 2, is_constant(module))


def is_native(values: Tensor) -> bool:
    """Return whether compiled code may read values, of a call in which nothing is under way."""
    return in_memory(values) and not is_recorded()
