"""How a warp samples images: the route is found once for a form of call, and kept while its cameras stay."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

import torch
from torch import Tensor

from camtorch.evaluate.door import (
    in_graph,
    in_jit_trace,
    in_transform,
    is_constant,
    is_eager,
    is_exporting,
    is_for_here,
    keeps_graph,
    set_aside,
)
from camtorch.evaluate.export import with_values
from camtorch.evaluate.known import is_unknown
from camtorch.native.sampler import Call, empty
from camtorch.warp import compiled
from camtorch.warp.grid import Lattice, Sampling, scaled
from camtorch.warp.pair import CameraPair, Plan
from camtorch.warp.sampling import PADDINGS, PaddingMode, Pyramid, Sampler, by_torch, laid_as, prepared, render

Route = Literal["operator", "strips", "graph", "kept"]

_MOST_KEPT = 1 << 25  # pixels of a grid; longer ones, of 256 MB in float32, are made by strips and not kept
_STRIP = 1 << 21  # pixels of such a strip


def route_of(warp: CameraPair, images: Tensor | None = None) -> Route:
    """The route of images, or of positions alone; the lattice and the sampler are chosen by `locate` and `render`.

    * "operator": compiled code calls one operator, and traces nothing of it;
    * "strips": the grid would be too long for memory, and is made part by part;
    * "graph": something learns, so that positions are computed anew with their graph;
    * "kept": positions without a graph, pinned or kept until an input changes.
    """
    learns = not warp.is_pinned and keeps_graph(*warp._inputs())
    if images is not None:
        learns = learns and images.dtype.is_floating_point
        if not learns and _is_operator(warp) and compiled.takes(images, warp._inputs()):
            return "operator"
    if not learns and _is_long(warp) and (images is None or not in_graph(images)):
        return "strips"
    return "graph" if learns else "kept"


def ready(warp: CameraPair, images: object, mode: str | None, padding: str | None) -> Call | None:
    """Return the call that an earlier one has left for images of this form, if nothing has changed since."""
    plan: Plan | None = warp._kept.result
    if plan is None or not plan.calls or not isinstance(images, Tensor):
        return None
    mode, padding = warp.mode if mode is None else mode, warp.padding_mode if padding is None else padding
    inputs = warp._inputs()
    if (
        not is_eager(images, *inputs)
        or images.requires_grad
        or not isinstance(mode, str)
        or not isinstance(padding, str)
    ):
        return None
    call = plan.calls.get(_form(warp, images, mode, padding))
    if call is None or plan.is_pinned:
        return call
    if images.dtype.is_floating_point and keeps_graph(*inputs):
        return None
    return call if warp._kept.is_of(inputs, warp._options) else None


def _form(warp: CameraPair, images: Tensor, mode: str, padding: str) -> tuple[object, ...]:
    return images.shape, images.stride(), images.dtype, mode, padding, warp.fill


def warped(warp: CameraPair, images: Tensor, sampler: Sampler) -> Tensor:
    """The images of a warp; those given are checked."""
    route, given = route_of(warp, images), images
    images = lengthened(warp, images)
    if route == "operator":
        options = warp.tolerance, warp.antialias, _reach(warp, sampler.padding_mode), sampler
        return compiled.warped(images, warp._sampled, warp.target, warp.rotation, *options)
    if route == "strips":
        cameras = math.prod(warp.batch_shape)
        result = empty(images, len(images) if cameras == 1 else cameras, warp.target._size_for("Warp"))
        kept: dict[int, Pyramid] = {}
        for rows, where in strips(warp, sampler.padding_mode):
            with torch.no_grad():
                render(images, where, *sampler, kept, result[:, :, rows])
        return result
    where = positions(warp, route, sampler.padding_mode)
    call = prepared(images, where, sampler)
    if call is None:
        return by_torch(images, where, sampler)
    plan: Plan | None = warp._kept.result
    if (
        plan is not None
        and images is given
        and sampler.fill == warp.fill
        and any(where is kept for kept in plan.positions.values())
    ):
        plan.keep(_form(warp, images, sampler.mode, sampler.padding_mode), call)
    return call(images)


def lengthened(warp: CameraPair, images: Tensor) -> Tensor:
    """Return the images that a warp samples: those of a whole turn go on beyond their edges."""
    return images if warp._seam is None else laid_as(images, warp._seam.around(images))


def positions(warp: CameraPair, route: Route, padding: PaddingMode = "zeros") -> Sampling | Lattice:
    """Where all pixels of the target sample the source's image, by the route "graph" or "kept"."""
    if route == "graph":
        if in_jit_trace():
            raise RuntimeError(
                "Warp: torch.jit.trace and torch.onnx.export(dynamo=False) cannot record cameras that learn; "
                "torch.onnx.export(dynamo=True) and torch.export can. Or warp.requires_grad_(False), and one call "
                "before, make its map a constant"
            )
        return warp._locate(range(warp.target._size_for("Warp")[0]), padding, 0.0)
    if is_exporting() and not torch.compiler.is_dynamo_compiling() and (constant := _constant(warp, padding)):
        return constant
    reach = _reach(warp, padding)
    return _plan_of(warp).positions_for(reach if warp.tolerance else "zeros", lambda: _computed(warp, reach))


def _plan_of(warp: CameraPair) -> Plan:
    if warp.is_pinned:
        pinned: Plan = warp._kept.result
        return pinned
    plan = warp._kept(warp._inputs(), warp._options, Plan)
    plan.is_kept = plan is warp._kept.result
    return plan


def by_pixel(warp: CameraPair) -> Sampling:
    """The positions of all pixels, one by one."""
    where = positions(warp, "graph" if route_of(warp) == "graph" else "kept")
    return where.pixels if isinstance(where, Lattice) else where


def _computed(warp: CameraPair, reach: PaddingMode) -> Sampling | Lattice:
    """The positions of all pixels, without a graph, which serve a padding."""
    if not (_is_operator(warp) and warp.tolerance and warp.target.intrinsics.is_cpu):
        return warp._locate(range(warp.target._size_for("Warp")[0]), reach, warp.tolerance)
    grid, mapped = compiled.positions(warp._sampled, warp.target, warp.rotation, warp.tolerance, reach)
    if warp.antialias:
        return scaled(warp._sampled, grid, mapped)
    return Sampling(grid, mapped, None)


def strips(
    warp: CameraPair, padding: PaddingMode = "zeros", count: int | None = None
) -> Iterator[tuple[slice, Sampling | Lattice]]:
    """Rows of the target, `count` at a time, and where they sample the source's image."""
    height, width = warp.target._size_for("Warp")
    step = count or max(_STRIP // (max(math.prod(warp.batch_shape), 1) * width), 1)
    for top in range(0, height, step):
        rows = range(top, min(top + step, height))
        with torch.no_grad():
            where = warp._locate(rows, _reach(warp, padding), warp.tolerance)
        yield slice(rows.start, rows.stop), where


def in_strips(
    warp: CameraPair, images: Tensor, count: int | None, sampler: Sampler
) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """See `Warp.strips`."""
    kept: dict[int, Pyramid] = {}
    images = lengthened(warp, images)
    for rows, where in strips(warp, sampler.padding_mode, count):
        with torch.no_grad():
            part, valid = render(images, where, *sampler, kept), _on_image(warp, where)
        yield rows, part, valid


@torch.no_grad()
def valid_mask(warp: CameraPair) -> Tensor:
    """See `Warp.valid_mask`."""
    if route_of(warp) == "strips":
        return torch.cat([_on_image(warp, where) for _, where in strips(warp)], 2)
    return _on_image(warp, positions(warp, "kept"))


def _on_image(warp: CameraPair, where: Sampling | Lattice) -> Tensor:
    """(B or 1, 1, h, W') bool: whether the source maps pixels onto its image."""
    where = where.pixels if isinstance(where, Lattice) else where
    grid, source = where.grid.detach(), warp._sampled
    pixels = (grid + 1) * grid.new_tensor(source._size_for("Warp")[::-1]) / 2 - 0.5
    return (where.mapped & source.contains(pixels)).unsqueeze(1)


def pin(warp: CameraPair) -> None:
    """Have a warp keep its positions from now on, with their graph, if they are to be kept at all."""
    # what a transform makes dies with it; what inference mode makes could not be used in a graph later; the operator
    # of compiled code keeps its own
    if _is_operator(warp) and compiled.takes(warp.target.intrinsics.detach(), warp._inputs()):
        return
    if in_transform() or torch.is_inference_mode_enabled():
        return
    if keeps_graph(*warp._inputs()):
        where = positions(warp, "graph")
    else:
        where = positions(warp, "kept") if is_exporting() else _computed(warp, warp.padding_mode)
    warp._kept.renew(lambda: Plan(where, warp.padding_mode))


def _reach(warp: CameraPair, padding: PaddingMode) -> PaddingMode:
    """The padding that positions are for which serve the warp's own, and this one."""
    # of equal words compilers know no max by a key
    return PADDINGS[max(PADDINGS.index(warp.padding_mode), PADDINGS.index(padding))]


def _is_operator(warp: CameraPair) -> bool:
    """Whether code is compiled that calls this warp as one; it knows cameras of one model."""
    return is_for_here() and warp.is_an_operator and not (warp.source.is_mixed or warp.target.is_mixed)


def _is_long(warp: CameraPair) -> bool:
    """Whether the grid is not to be made at once, nor kept."""
    # compared first, sizes that a program leaves open would be bounded in it
    if warp.is_pinned or torch.compiler.is_compiling():
        return False
    if math.prod((*warp.batch_shape, *warp.target._size_for("Warp"))) <= _MOST_KEPT:
        return False
    return all(t.is_cpu and not is_unknown(t) for t in warp._inputs())


def _constant(warp: CameraPair, padding: PaddingMode) -> Sampling | None:
    """The positions as a constant of an exported program, unless they depend on what it is given."""
    if not warp.is_pinned and not is_constant(warp):
        return None
    with set_aside() if warp.is_pinned else with_values(warp):

        def own() -> Sampling:
            where = positions(warp, "kept", padding)
            where = where.pixels if isinstance(where, Lattice) else where
            grid, mapped = (t.detach().clone(memory_format=torch.contiguous_format) for t in where[:2])
            return where._replace(grid=grid, mapped=mapped)

        plan = _plan_of(warp)
        return own() if plan.is_pinned else plan.positions_for(f"constant {_reach(warp, padding)}", own)
