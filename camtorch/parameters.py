"""The door: what users pass as parameters and points, checked and brought into shape."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

if TYPE_CHECKING:
    from typing_extensions import Self


class GeometryModule(nn.Module):
    """A module whose tensors are geometry: Parameters, or tensors of a graph, never of less than float32."""

    def hold(self, name: str, value: Tensor, shape: tuple[int, ...]) -> None:
        """Register plain values as a new Parameter of that shape, a Parameter or a tensor of a graph as it is.

        Those keep their own shape, which broadcasts to `shape`: a lens shared by a batch of cameras stays one.
        """
        wide = torch.promote_types(value.dtype, torch.float32)
        if shape[-1] == 0:  # an optimizer has nothing to learn here
            self.register_buffer(name, value.detach().expand(shape), persistent=False)
        elif isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
        elif in_graph(value):
            self.register_buffer(name, value.to(wide), persistent=False)
        else:
            self.register_parameter(name, nn.Parameter(value.detach().to(wide).expand(shape).clone()))

    def freeze_like(self, *sources: nn.Module) -> Self:
        """Leave nothing to learn where the modules that this one was made from have nothing either."""
        tensors = [t for source in sources for t in (*source.parameters(), *source.buffers())]
        if not any(t.requires_grad for t in tensors):
            for parameter in self.parameters():
                parameter.requires_grad = False
        return self

    def _apply(self, fn, recurse=True):
        # network.half() must not round a principal point to whole pixels
        def at_least_float32(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            if moved.is_floating_point() and torch.finfo(moved.dtype).bits < 32:
                return tensor.to(moved.device)
            return moved

        return super()._apply(at_least_float32, recurse)

    def __getstate__(self):
        # a tensor of a graph cannot be copied with its graph: the copy is a leaf
        state = self.__dict__.copy()
        state["_buffers"] = {
            name: b if b is None or b.is_leaf else b.detach().requires_grad_() for name, b in self._buffers.items()
        }
        return state


class Memo:
    """The last result of a computation, kept until one of its inputs changes.

    Values are compared, not versions: a change through `.data`, or by functional_call, leaves no other trace.
    Nothing is kept while the values may not be looked at. Copies and pickles begin empty.
    """

    def __init__(self):
        self._kept = None

    def __call__(self, inputs: Sequence[Tensor], options: tuple, compute: Callable[[], object]):
        """`compute()` without a graph, or its kept result; it depends on the tensors `inputs` and on `options`."""
        if not all(is_concrete(t) and not has_tangent(t) for t in inputs):
            return compute()
        if self._kept is not None:
            kept_inputs, kept_options, result = self._kept
            if options == kept_options and all(map(same, inputs, kept_inputs)):
                return result
        if in_transform():  # what a transform makes dies with it
            return compute()
        # what inference mode makes could not be used in a graph later
        with torch.inference_mode(False), torch.no_grad():
            copies = [t.detach().clone() for t in inputs]
            result = compute()
        self._kept = (copies, options, result)
        return result

    def __getstate__(self):
        return {"_kept": None}


def same(a: Tensor, b: Tensor) -> bool:
    """Whether shape, dtype, device and all values agree."""
    return a.shape == b.shape and a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)


def has_tangent(tensor: Tensor) -> bool:
    """Whether forward-mode derivatives pass through the tensor."""
    return forward_ad._current_level >= 0 and forward_ad.unpack_dual(tensor).tangent is not None


def in_transform() -> bool:
    """Whether a transform of torch.func is under way."""
    return torch._C._functorch.peek_interpreter_stack() is not None


def in_graph(tensor: Tensor) -> bool:
    """Whether derivatives, of either mode, or a transform pass through the tensor."""
    return tensor.requires_grad or not is_concrete(tensor) or has_tangent(tensor)


def is_concrete(tensor: Tensor) -> bool:
    """Whether the values may be looked at: not while a graph is traced, nor inside vmap, grad or jacfwd."""
    return not (
        torch.compiler.is_compiling() or torch._C._functorch.is_functorch_wrapped_tensor(tensor) or tensor.is_meta
    )


def may_look(tensor: Tensor) -> bool:
    """Whether the values may be looked at and that costs next to nothing, to take a shorter way with a whole block."""
    return tensor.is_cpu and is_concrete(tensor) and tensor.numel() > 0


def as_real(value, name: str, owner: str) -> Tensor:
    """A floating-point tensor of finite numbers: the tensor itself, or made of a list or an array.

    Lists and integers take torch's default dtype, arrays and tensors keep theirs.

    Raises:
        TypeError: not real numbers, or a list of tensors that require grad, whose graph would be lost.
        ValueError: NaN or infinite values.
    """
    if not isinstance(value, Tensor):
        if isinstance(value, (list, tuple)) and any(isinstance(v, Tensor) and v.requires_grad for v in value):
            raise TypeError(f"{owner}: {name} is a list of tensors that require grad; torch.stack them")
        try:
            value = torch.as_tensor(value)
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(
                f"{owner}: {name} must be numbers (a tensor, an array or a list); got {type(value).__name__}: {error}"
            ) from None
    if value.is_complex() or value.dtype == torch.bool:
        raise TypeError(f"{owner}: {name} must be real numbers; got dtype {value.dtype}")
    if not value.is_floating_point():
        value = value.to(torch.get_default_dtype())
    if is_concrete(value) and not bool(torch.isfinite(value).all()):
        raise ValueError(f"{owner}: {name} must be finite; got {value.detach().tolist()}")
    return value


def as_image_size(value, owner: str) -> tuple[int, int] | None:
    """(height, width) as two positive ints, or None.

    Raises:
        TypeError: not two integers. ValueError: one of them is not positive.
    """
    if value is None:
        return None
    try:
        if isinstance(value, (set, frozenset, dict)) or any(isinstance(side, bool) for side in value):
            raise TypeError
        height, width = (operator.index(side) for side in value)
    except (TypeError, ValueError):
        raise TypeError(f"{owner}: image_size must be two integers (height, width); got {value!r}") from None
    if height <= 0 or width <= 0:
        raise ValueError(f"{owner}: image_size must be positive (height, width); got {(height, width)}")
    return height, width


def as_whole(value, name: str, owner: str) -> int:
    """A whole number of pixels.

    Raises:
        TypeError: it is none.
    """
    try:
        return operator.index(value)
    except TypeError:
        raise TypeError(f"{owner}: {name} must be a whole number of pixels; got {value!r}") from None


def as_batch(owner: str, **shapes: Sequence[int]) -> torch.Size:
    """The batch dims, all but the last, that the named shapes broadcast to.

    Raises:
        ValueError: they do not.
    """
    try:
        return torch.broadcast_shapes(*(shape[:-1] for shape in shapes.values()))
    except RuntimeError:
        named = " and ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        raise ValueError(f"{owner}: the batch dims of {named} do not fit together") from None


def working_dtype(values: Tensor, *parameters: Tensor) -> torch.dtype:
    """The dtype to compute in: the widest of all, at least float32; integer values take the parameters' dtype."""
    dtype = torch.float32
    for tensor in (values, *parameters):
        if tensor.is_floating_point():
            dtype = torch.promote_types(dtype, tensor.dtype)
    return dtype


def as_values(values, name: str, owner: str, device: torch.device | None = None) -> Tensor:
    """A tensor of real numbers, NaN and infinity among them, of what is one or can be made one.

    Raises:
        TypeError: it cannot.
    """
    if not isinstance(values, Tensor):
        try:
            values = torch.as_tensor(values, device=device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(f"{owner}: {name} must be a tensor; got {type(values).__name__}: {error}") from None
    if values.is_complex() or values.dtype == torch.bool:
        raise TypeError(f"{owner}: {name} must be real numbers; got dtype {values.dtype}")
    return values


def as_rows(
    values, name: str, size: int, batch: torch.Size, parameters: Sequence[Tensor], owner: str
) -> tuple[Tensor, torch.Size, Callable[[Tensor], Tensor]]:
    """Bring (*B, *N, size) into rows (C, N, size), one for each camera.

    Returns the rows, in the dtype to compute in; the batch dims that C counts; and a function that gives results their
    shape back: planes (C, N) become (*B, *N), and planes (count, C, N) become a view (*B, *N, count).

    Raises:
        TypeError: not real numbers. ValueError: the shape does not fit `batch`.
    """
    values = as_values(values, name, owner, parameters[0].device)
    takes = f"{name} must be (*B, *N, {size}) with batch dims *B = {tuple(batch)}"
    if values.ndim == 0 or values.shape[-1] != size:
        raise ValueError(f"{owner}: {takes}; got shape {tuple(values.shape)}")
    lead, rest = values.shape[: len(batch)], values.shape[len(batch) : -1]
    try:
        if len(lead) < len(batch) or values.ndim <= len(batch):
            raise RuntimeError
        lead = lead if lead == batch else torch.broadcast_shapes(lead, batch)
    except RuntimeError:
        raise ValueError(f"{owner}: {takes}; got shape {tuple(values.shape)}") from None
    rows = values.to(working_dtype(values, *parameters))
    if rows.shape[: len(lead)] != lead:
        rows = rows.expand(*lead, *rest, size)
    rows = rows.reshape(math.prod(lead), math.prod(rest), size)

    def restore(planes: Tensor) -> Tensor:
        if planes.ndim == 2:
            return planes.reshape((*lead, *rest))
        return planes.reshape((len(planes), *lead, *rest)).movedim(0, -1)

    return rows, lead, restore


def columns(parameters: Tensor) -> tuple[Tensor, ...]:
    """(*B, n) -> n tensors (*B, 1), or (1,), that broadcast against planes."""
    return parameters.unsqueeze(-1).unbind(-2)
