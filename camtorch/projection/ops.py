"""What a traced graph does not look into: tables of a lens, and the search for what is left open by Newton's method.

As operators of their own they keep compiled graphs small, and look at values inside vmap as well.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from camtorch.evaluate.regime import in_transform, is_for_here, keeps_graph
from camtorch.optics.radial_inverse import TABLE_WIDTH
from camtorch.projection.domain import Domain, domain_of
from camtorch.projection.fold import AZIMUTHS
from camtorch.projection.solve import search
from camtorch.values.arguments import columns
from camtorch.values.registry import CLASSES

Result = TypeVar("Result")


def _domain(model: str, k: Tensor) -> Domain:
    return domain_of(model, k, CLASSES[model].optics)


@torch.library.custom_op("camtorch::tables", mutates_args=())
def tables(model: str, k: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`Domain.inner2`, `limits2` and `table` of coefficients (C, n); without columns where the lens needs none."""
    domain = _domain(model, k)
    empty = k.new_empty(len(k), 0)
    # clones: who gets them may write into them
    return (
        domain.inner2.clone(),
        empty if domain.lens.is_radial else domain.limits2.clone(),
        domain.table.clone() if domain.lens.radial else empty.clone(),
    )


@tables.register_fake
def _(model: str, k: Tensor) -> tuple[Tensor, ...]:
    lens = CLASSES[model].optics(columns(k))[1]
    widths = 1, 0 if lens.is_radial else AZIMUTHS, TABLE_WIDTH if lens.radial else 0
    return tuple(k.new_empty(len(k), width) for width in widths)


@torch.library.custom_op("camtorch::search_", mutates_args=("a", "b", "solved"))
def search_in_place(
    model: str, k: Tensor, u: Tensor, v: Tensor, a: Tensor, b: Tensor, solved: Tensor, possible: Tensor
) -> None:
    """Write into (a, b, solved) of `Found` what `search` finds of the points (C, N) not solved, but possible."""
    if not solved.numel() or bool(solved.amin() > 0):
        return
    camera, point = (~(solved > 0) & (possible > 0)).nonzero(as_tuple=True)
    if len(camera):
        found_a, found_b, found = search(_domain(model, k), camera, u[camera, point], v[camera, point])
        a[camera, point], b[camera, point] = found_a, found_b
        solved[camera, point] = torch.where(found, 1.0, -1.0).to(solved.dtype)


@torch.library.custom_op("camtorch::search", mutates_args=())
def search_open(
    model: str, k: Tensor, u: Tensor, v: Tensor, a: Tensor, b: Tensor, solved: Tensor, possible: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`search_in_place` into copies: vmap has no rule for what writes."""
    results = a.clone(), b.clone(), solved.clone()
    search_in_place(model, k, u, v, *results, possible)
    return results


@search_in_place.register_fake
def _(*_: Any) -> None:
    pass


@search_open.register_fake
def _(model: str, *planes: Tensor) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(plane) for plane in planes[3:6])


@tables.register_vmap
def _(info: Any, in_dims: tuple[Any, ...], model: str, k: Tensor) -> Any:
    k = k.movedim(in_dims[1], 0)
    return tuple(r.unflatten(0, k.shape[:2]) for r in tables(model, k.flatten(0, 1))), (0, 0, 0)


@search_open.register_vmap
def _(info: Any, in_dims: tuple[Any, ...], model: str, k: Tensor, *planes: Tensor) -> Any:
    # what is mapped joins the cameras, or the points where the cameras are not mapped
    cameras = in_dims[1] is not None
    rows = []
    for plane, dim in zip(planes, in_dims[2:], strict=True):
        plane = plane.expand(info.batch_size, *plane.shape) if dim is None else plane.movedim(dim, 0)
        rows.append(plane if cameras else plane.movedim(0, 1))
    joined = 0 if cameras else 1
    shape = rows[0].shape[joined : joined + 2]
    k = k.movedim(in_dims[1], 0).flatten(0, 1) if cameras else k
    results = search_open(model, k, *(plane.flatten(joined, joined + 1) for plane in rows))
    return tuple(r.unflatten(joined, shape) for r in results), (joined,) * 3


@torch.library.custom_op("camtorch::transposed", mutates_args=())
def _transposed(points: Tensor, to_planes: bool) -> Tensor:
    if not to_planes:
        return torch.stack(points.unbind(0), -1)
    planes = points.new_empty(points.shape[-1], *points.shape[:-1])
    for plane, interleaved in zip(planes, points.unbind(-1), strict=True):
        torch.sub(interleaved, 0, out=plane)  # twice as fast as a copy, and bit for bit the same
    return planes


@_transposed.register_fake
def _(points: Tensor, to_planes: bool) -> Tensor:
    size = points.shape
    return points.new_empty((size[-1], *size[:-1]) if to_planes else (*size[1:], size[0]))


def _note_way(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.to_planes = inputs[1]


_transposed.register_autograd(
    lambda ctx, cotangent: (_transposed(cotangent, not ctx.to_planes), None), setup_context=_note_way
)


def to_planes(rows: Tensor) -> tuple[Tensor, ...]:
    """(C, N, size) as planes (C, N). Compiled code for CPUs reads interleaved planes one by one."""
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
    """The mask as bool. Compiled code for CPUs writes bools one by one: ten times slower than this detour."""
    compiled = is_for_here() and mask.device.type == "cpu"
    return _positive(mask.detach()) if compiled else mask > 0


def as_kept(plane: Tensor) -> Tensor:
    """The plane, for inductor to compute once: it repeats the whole expression of what is used twice while it compiles.

    That grows exponentially with the depth. Of views by strides it knows that they need a place in memory.
    """
    return torch.as_strided(plane, plane.shape, plane.stride()) if is_for_here() else plane


def power_of_two(size: Tensor) -> Tensor:
    """The largest one not above: to divide by it costs no bit."""
    if torch.compiler.is_compiling():  # which leaves its vectors for bits
        return size
    if in_transform():  # torch.vmap looks at no bits before torch 2.11
        return size / torch.frexp(size).mantissa / 2
    exponent, integer = (0x7F800000, torch.int32) if size.dtype == torch.float32 else (0x7FF << 52, torch.int64)
    return (size.view(integer) & exponent).view(size.dtype)


def order_of(order: int, *inputs: Tensor) -> int:
    """Of the derivatives that a recorded inverse has to have: compiled code that does not learn needs none."""
    compiled = torch.compiler.is_compiling() and not in_transform()
    return 0 if compiled and not keeps_graph(*inputs) else order


def without_keeping(function: Callable[..., Result], *inputs: Tensor) -> Result:
    """`function(*inputs)`; where that is compiled, backward computes it again from the inputs, which alone are kept."""
    if torch.compiler.is_compiling() and torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
        result: Result = checkpoint(function, *inputs, use_reentrant=False, preserve_rng_state=False)
        return result
    return function(*inputs)
