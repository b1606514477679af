"""Forms of the formula that torch's compilers handle best: planes, masks, kept values, classes by their names."""

import importlib
from collections.abc import Callable
from typing import Any, TypeVar, cast

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from camtorch.evaluate.door import in_transform, is_eager, is_for_here, keeps_graph, refuse_jit_trace

Result = TypeVar("Result")


@torch.library.custom_op("camtorch::transposed", mutates_args=())
def _transposed(points: Tensor, to_planes: bool) -> Tensor:
    if not to_planes:
        return torch.stack(points.unbind(0), -1)
    planes = points.new_empty(points.shape[-1], *points.shape[:-1])
    for plane, interleaved in zip(planes, points.unbind(-1), strict=True):
        torch.sub(interleaved, 0, out=plane)  # takes half the time of a copy, and gives the same bits
    return planes


@_transposed.register_fake
def _(points: Tensor, to_planes: bool) -> Tensor:
    size = points.shape
    return points.new_empty((size[-1], *size[:-1]) if to_planes else (*size[1:], size[0]))


def _note_way(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.to_planes = inputs[1]


_transposed.register_autograd(lambda ctx, g: (_transposed(g, not ctx.to_planes), None), setup_context=_note_way)


def to_planes(rows: Tensor) -> tuple[Tensor, ...]:
    """Return rows (C, N, size) as planes (C, N). Compiled graphs on CPUs read interleaved planes one by one."""
    interleaved = is_for_here() and rows.device.type == "cpu" and rows.stride(-2) != 1
    interleaved = interleaved and not in_transform()  # the operator has no forward mode
    return (_transposed(rows, True) if interleaved else rows.movedim(-1, 0)).unbind(0)


@torch.library.custom_op("camtorch::positive", mutates_args=())
def _positive(mask: Tensor) -> Tensor:
    return mask > 0


@_positive.register_fake
def _(mask: Tensor) -> Tensor:
    return torch.empty_like(mask, dtype=torch.bool)


def positive(mask: Tensor) -> Tensor:
    """Return the mask as bool. Compiled graphs on CPUs write bools one by one: ten times slower than this detour."""
    compiled = is_for_here() and mask.device.type == "cpu"
    return _positive(mask.detach()) if compiled else mask > 0


def as_kept(plane: Tensor) -> Tensor:
    """Return the plane in a form that inductor computes once, even if it is used twice.

    Inductor repeats other expressions at each use, exponentially often with the depth; a strided view gets memory.
    """
    return torch.as_strided(plane, plane.shape, plane.stride()) if is_for_here() else plane


def power_of_two(size: Tensor) -> Tensor:
    """Return the largest power of two that is not above `size`: dividing by it costs no bit."""
    if torch.compiler.is_compiling():  # inductor does not vectorise the reading of bits
        return size
    if in_transform():  # torch.vmap cannot read bits before torch 2.11
        return size / torch.frexp(size).mantissa / 2
    refuse_jit_trace()  # which takes no view of another dtype
    exponent, integer = (0x7F800000, torch.int32) if size.dtype == torch.float32 else (0x7FF << 52, torch.int64)
    return (size.view(integer) & exponent).view(size.dtype)


def order_of(*inputs: Tensor) -> int:
    """Return up to which order derivatives of a formula must be exact: 0 if nothing learns, and that is known."""
    is_compiling = torch.compiler.is_compiling()
    is_known = (is_compiling and not in_transform()) or is_eager(*inputs)
    if is_known and not keeps_graph(*inputs):
        return 0
    return 1 if is_compiling else 2  # torch.compile records no derivatives of derivatives


def without_keeping(function: Callable[..., Result], *inputs: Tensor) -> Result:
    """Return `function(*inputs)`; in compiled graphs only the inputs are kept, and backward computes it again."""
    if torch.compiler.is_compiling() and torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
        return cast("Result", checkpoint(function, *inputs, use_reentrant=False, preserve_rng_state=False))
    return function(*inputs)


class Registry(dict[str, Any]):
    """What saved programs name: an unknown name imports its module, as a program may be loaded before."""

    def __missing__(self, name: str) -> Any:
        importlib.import_module(name.rpartition(".")[0])
        if name not in self:
            raise KeyError(name)
        return self[name]


CLASSES = Registry()  # all classes of cameras and of radial factors, by name


def register(entry: type) -> str:
    """Register a class and return its name, with a number if another class has that name already."""
    wanted = name = f"{entry.__module__}.{entry.__qualname__}"
    count = 2
    while name in CLASSES:
        name, count = f"{wanted}#{count}", count + 1
    CLASSES[name] = entry
    return name
