"""The way of a call: native code on a CPU if nothing traces or transforms the call, else the formula in torch."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import NoneType
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch._functorch.pyfunctorch import temporarily_clear_interpreter_stack
from torch.autograd import forward_ad
from torch.utils import _pytree
from torch.utils._python_dispatch import _disable_current_modes
from torch.utils.data._utils.collate import collate, default_collate_fn_map

FAKE_MODE = torch._C._TorchDispatchModeKey.FAKE  # the key of a FakeTensorMode among the active modes
NO_TORCH_FUNCTION: Any = torch._C._disabled_torch_function_impl
"""The `__torch_function__` of a class of tensors whose operators return plain tensors."""
pytree = _pytree  # trees, with the paths of their leaves
TORCH_LIBRARY: str = torch._C.__file__
"""The shared library of torch, which has the functions of OpenMP and MKL that it uses."""
COLLATE_FUNCTIONS: dict[Any, Callable[..., Any]] = default_collate_fn_map
"""The functions of `default_collate` by the types of their parts; it uses those that are added."""
collate_by: Callable[..., Any] = collate  # `default_collate` with other functions, `collate_fn_map`

_DENSE = torch._C._dispatch_keys(torch.empty(0, device="cpu"))
_DENSE_KEYS: int = _DENSE.raw_repr()


def has_tangent(tensor: Tensor) -> bool:
    """Whether forward-mode derivatives pass through the tensor."""
    return forward_ad._current_level >= 0 and forward_ad.unpack_dual(tensor).tangent is not None


def in_transform() -> bool:
    """Whether a transform of torch.func is active."""
    # dynamo takes the result for an object, of which "is not None" is always true
    return not isinstance(torch._C._functorch.peek_interpreter_stack(), NoneType)


@contextmanager
def outside_transforms() -> Iterator[None]:
    """Suspend transforms of torch.func in here, for values that none maps or differentiates; not in traced code."""
    with temporarily_clear_interpreter_stack():
        yield


def without_derivatives(tensor: Tensor) -> Tensor:
    """Return the values of a tensor for `outside_transforms`: what grad, jacrev and jacfwd made of it is taken off."""
    while torch._C._functorch.is_gradtrackingtensor(tensor):
        tensor = torch._C._functorch.get_unwrapped(tensor)
    return tensor


def in_graph(tensor: Tensor) -> bool:
    """Whether derivatives, of either mode, or a transform pass through the tensor, or it is traced."""
    return tensor.requires_grad or _is_traced(tensor) or has_tangent(tensor)


def is_concrete(tensor: Tensor) -> bool:
    """Whether the values may be read: not while a graph is traced, nor inside vmap, grad or jacfwd.

    There are none on the meta device or in a FakeTensorMode, where modules are made of shapes alone.
    """
    if _is_traced(tensor) or tensor.is_meta:
        return False
    return torch._C._get_dispatch_mode(FAKE_MODE) is None and not is_fake(tensor)


def _is_traced(tensor: Tensor) -> bool:
    return torch.compiler.is_compiling() or torch._C._functorch.is_functorch_wrapped_tensor(tensor)


def is_fake(tensor: Tensor) -> bool:
    """Whether a tensor is one of a FakeTensorMode, which has a shape and no values."""
    # the class is not imported to compare its name: that takes a third of a second
    return type(tensor) is not Tensor and type(tensor).__name__ == "FakeTensor"


def in_memory(tensor: Tensor) -> bool:
    """Whether the values lie in the CPU's memory at `data_ptr`: not those of a subclass that has them elsewhere.

    Nor do they if they are to be negated first, or compressed, or zero by declaration.
    """
    keys = torch._C._dispatch_keys(tensor)
    mine: int = keys.raw_repr()
    return mine == _DENSE_KEYS or (keys | _DENSE).raw_repr() == _DENSE_KEYS


def is_recorded() -> bool:
    """Whether torch's operators are recorded or changed by a mode, so that a call past them would be lost."""
    return in_jit_trace() or torch._C._len_torch_dispatch_stack() > 0


in_jit_trace: Callable[[], bool] = torch.jit.is_tracing  # type: ignore[attr-defined]
"""Whether torch.jit.trace is running."""


def refuse_jit_trace() -> None:
    """Raise a RuntimeError while torch.jit.trace is running."""
    # before it runs a module, it reads all properties
    if in_jit_trace() or torch.jit._trace._trace_module_map is not None:
        raise RuntimeError(
            "camtorch: cameras must not project in torch.jit.trace; got a call that does. Use torch.export.export("
            "module, inputs), or torch.onnx.export(module, inputs, dynamo=True). Frozen warps of images can be traced"
        )


is_exporting: Callable[[], bool] = torch.compiler.is_exporting
"""Whether the traced program is for another runtime, which has no operators of our own."""


def records_constants() -> bool:
    """Whether values become constants of an exported program: not while dynamo traces it."""
    return is_exporting() and not torch.compiler.is_dynamo_compiling()


def is_for_here() -> bool:
    """Whether the traced program is compiled for this machine."""
    return torch.compiler.is_compiling() and not is_exporting()


def keeps_graph(*tensors: Tensor) -> bool:
    """Whether derivatives by any of the tensors are to be recorded: not in a file for another runtime."""
    if torch.is_grad_enabled():
        for tensor in tensors:
            if tensor.requires_grad:
                return not (is_exporting() and torch.onnx.is_in_onnx_export())
    return False


def is_constant(module: nn.Module) -> bool:
    """Whether an exported module's tensors are its own and do not learn, so that their values are known."""
    if not records_constants():
        return False
    for part in module.modules():
        own = part.__dict__.get("_untraced", {})
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
    """Suspend tracing in here: results become constants of the graph that is being recorded."""
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
    """Make tensors in here without a graph, but, unlike those of inference mode, so that a graph can use them later."""
    if torch.compiler.is_compiling() or not torch.is_inference_mode_enabled():
        return nullcontext()
    return _outside_inference()


@contextmanager
def _outside_inference() -> Iterator[None]:
    with torch.inference_mode(False), torch.no_grad():
        yield


def converted(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the tensor in `dtype`; a constant of an exported program is converted before it is recorded."""
    if not records_constants() or is_fake(tensor):
        return tensor.to(dtype)
    with set_aside():
        return tensor.to(dtype)


def is_eager(*tensors: Tensor) -> bool:
    """Whether nothing is traced, transformed or recorded, and all values lie in the CPU's memory."""
    # called often, so all in one place: each further function would take as long as its question
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
        if keys_of(tensor).raw_repr() != _DENSE_KEYS and not in_memory(tensor):
            return False
    return True


def is_cheap_to_read(tensor: Tensor) -> bool:
    """Whether the values may be read and that costs next to nothing, to take a shorter way with a whole block."""
    return tensor.is_cpu and is_concrete(tensor) and 0 not in tensor.shape


class WayOfCall(NamedTuple):
    """The way in which a call is evaluated."""

    is_native: bool  # native code evaluates the call, if it has the model
    learns: bool  # autograd records the native call, with its derivatives
    is_known: bool  # the values of the parameters may be read, so that results made of them are kept


_NATIVE, _LEARNING = WayOfCall(True, False, True), WayOfCall(True, True, True)


def way_of(owner: str, values: Tensor, *parameters: Tensor) -> WayOfCall:
    """Return the way of a call with values and parameters; raise a RuntimeError if torch can record none."""
    # called once a call, so all in one place: each further function would take as long as its question
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
                f"{owner}: dynamo must be True in torch.onnx.export of a camera; got False. "
                "Results that a frozen camera or warp keeps are constants: camera.rays() and warp(images), with "
                "requires_grad_(False) and called once before the export"
            )
        if in_memory(values) and not in_jit_trace() and torch._C._len_torch_dispatch_stack() == 0:
            return _LEARNING if learns and torch.is_grad_enabled() else _NATIVE
    return WayOfCall(False, False, all(is_concrete(t) and not has_tangent(t) for t in parameters))


def while_loop(condition: Callable[..., Any], body: Callable[..., Any], state: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the state after a loop, which is recorded as one."""
    # torch does not import it at first
    from torch._higher_order_ops.while_loop import while_loop as loop

    return cast("tuple[Any, ...]", loop(condition, body, state))
