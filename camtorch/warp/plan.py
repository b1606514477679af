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
    is_constant,
    is_eager,
    is_exporting,
    is_for_here,
    keeps_graph,
    records_constants,
    set_aside,
)
from camtorch.evaluate.export import with_values
from camtorch.evaluate.tensors import is_unknown
from camtorch.native.sampler import Call, maker
from camtorch.warp import compiled
from camtorch.warp.grid import Lattice, Sampling, local_scale
from camtorch.warp.pair import CameraPair, Plan
from camtorch.warp.sampling import (
    PADDINGS,
    PaddingMode,
    Pyramid,
    Sampler,
    by_torch,
    laid_as,
    prepared,
    render,
)

Route = Literal["operator", "strips", "graph", "kept"]
_MOST_KEPT = 1 << 25  # pixels of a grid; longer ones, of 256 MB in float32, are made by strips and not kept
_STRIP = 1 << 21  # pixels of such a strip


def route_of(warp: CameraPair, images: Tensor | None = None) -> Route:
    """Return the route of images, or of positions alone; `locate` and `render` choose the lattice and the sampler.

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
    if plan is None or plan.calls.result is None or not isinstance(images, Tensor):
        return None
    mode, padding = warp.mode if mode is None else mode, warp.padding_mode if padding is None else padding
    inputs = warp._inputs()
    if not is_eager(images, *inputs) or images.requires_grad:
        return None
    found = plan.calls.entry((), _form(warp, images, mode, padding))
    if found is None or not plan.is_pinned:
        learns = images.dtype.is_floating_point and keeps_graph(*inputs)
        if found is None or learns or warp._kept.entry(inputs, warp._options) is None:
            return None
    call: Call = found[2]
    return call


def _form(warp: CameraPair, images: Tensor, mode: str, padding: str) -> tuple[object, ...]:
    return images.shape, images.stride(), images.dtype, mode, padding, warp.fill


def warped(warp: CameraPair, images: Tensor, sampler: Sampler) -> Tensor:
    """Return the images of a warp; those given are checked."""
    route, given = route_of(warp, images), images
    images = lengthened(warp, images)
    if route == "operator":
        options = warp.tolerance, warp.antialias, _reach(warp, sampler.padding_mode), sampler
        return compiled.warped(images, warp._sampled, warp.target, warp.rotation, *options)
    if route == "strips":
        cameras = math.prod(warp.batch_shape)
        result = maker(images, len(images) if cameras == 1 else cameras, warp.target.size_for("Warp"))()
        kept: dict[int, Pyramid] = {}
        for rows, where in strips(warp, sampler.padding_mode):
            with torch.no_grad():
                render(images, where, *sampler, kept, result[:, :, rows])
        return result
    plan: Plan | None = warp._kept.result
    where = positions(warp, route, sampler.padding_mode)
    call = prepared(images, where, sampler)
    if call is None:
        return by_torch(images, where, sampler)
    result = call(images)
    # most warps are used once, and keep no calls
    is_kept = plan is not None and plan.positions.result is where
    if plan is not None and is_kept and images is given and sampler.fill == warp.fill:
        plan.calls((), _form(warp, images, sampler.mode, sampler.padding_mode), lambda: call)
    return result


def lengthened(warp: CameraPair, images: Tensor) -> Tensor:
    """Return the images that a warp samples: those of a whole turn go on beyond their edges."""
    return images if warp._seam is None else laid_as(images, warp._seam.around(images))


def positions(warp: CameraPair, route: Route, padding: PaddingMode = "zeros") -> Sampling | Lattice:
    """Return the positions at which target pixels sample the source's image, by the route "graph" or "kept"."""
    if route == "graph":
        if in_jit_trace():
            raise RuntimeError(
                "Warp: cameras must not learn in torch.jit.trace and torch.onnx.export(dynamo=False); got some that "
                "do. Use torch.onnx.export(dynamo=True) or torch.export; or make the map a constant by "
                "warp.requires_grad_(False) and one call before"
            )
        return warp._locate(range(warp.target.size_for("Warp")[0]), padding, 0.0)
    if records_constants() and (constant := _constant(warp, padding)):
        return constant
    reach = _reach(warp, padding)
    key = reach if warp.tolerance else "zeros"
    return _plan_of(warp).positions_for(key, lambda: _computed(warp, reach))


def _plan_of(warp: CameraPair) -> Plan:
    pinned: Plan = warp._kept.result
    return pinned if warp.is_pinned else warp._kept(warp._inputs(), warp._options, Plan)


def by_pixel(warp: CameraPair) -> Sampling:
    """Return the positions of all pixels, one by one."""
    return positions(warp, "graph" if route_of(warp) == "graph" else "kept").pixels


def _computed(warp: CameraPair, reach: PaddingMode) -> Sampling | Lattice:
    """Return the positions of all pixels, without a graph, which serve a padding."""
    if warp.tolerance and not warp.antialias and (host := warp.host) is not None:
        return positions(host, "kept", reach).on(warp.target.intrinsics.device)
    if not (_is_operator(warp) and warp.tolerance and warp.target.intrinsics.is_cpu):
        return warp._locate(range(warp.target.size_for("Warp")[0]), reach, warp.tolerance)
    planes, mapped = compiled.positions(warp._sampled, warp.target, warp.rotation, warp.tolerance, reach)
    grid = planes.movedim(1, -1)
    return Sampling(grid, mapped, local_scale(grid, mapped, warp._sampled) if warp.antialias else None)


def strips(
    warp: CameraPair, padding: PaddingMode = "zeros", count: int | None = None
) -> Iterator[tuple[slice, Sampling | Lattice]]:
    """Yield rows of the target, `count` at a time, and their positions on the source's image."""
    height, width = warp.target.size_for("Warp")
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
            part, valid = render(images, where, *sampler, kept), on_image(warp, where)
        yield rows, part, valid


def on_image(warp: CameraPair, where: Sampling | Lattice) -> Tensor:
    """Whether the source maps pixels onto its image, (B or 1, 1, h, W')."""
    grid, source = where.pixels.grid.detach(), warp._sampled
    pixels = (grid + 1) * grid.new_tensor(source.size_for("Warp")[::-1]) / 2 - 0.5
    return (where.pixels.mapped & source.contains(pixels)).unsqueeze(1)


def pin(warp: CameraPair) -> None:
    """Have a warp keep its positions from now on, with their graph, if they are to be kept at all."""
    # the operator of compiled code keeps its own; what inference mode makes could not be used in a graph later
    is_operator = _is_operator(warp) and compiled.takes(warp.target.intrinsics.detach(), warp._inputs())
    if warp.is_pinned or is_operator or torch.is_inference_mode_enabled():
        return
    if keeps_graph(*warp._inputs()):
        where = positions(warp, "graph")
    else:
        where = positions(warp, "kept") if is_exporting() else _computed(warp, warp.padding_mode)
    warp._kept.renew(lambda: Plan(where, warp.padding_mode))


def _reach(warp: CameraPair, padding: PaddingMode) -> PaddingMode:
    """Return the padding of positions that serve the warp's own padding and this one."""
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
    if math.prod((*warp.batch_shape, *warp.target.size_for("Warp"))) <= _MOST_KEPT:
        return False
    return all(t.is_cpu and not is_unknown(t) for t in warp._inputs())


def _constant(warp: CameraPair, padding: PaddingMode) -> Sampling | Lattice | None:
    """Return the positions as a constant of an exported program; None if they depend on its inputs."""
    if not warp.is_pinned and not is_constant(warp):
        return None
    with set_aside() if warp.is_pinned else with_values(warp):

        def own() -> Sampling:
            where = positions(warp, "kept", padding).pixels
            grid, mapped = (t.detach().clone(memory_format=torch.contiguous_format) for t in where[:2])
            return where._replace(grid=grid, mapped=mapped)

        plan = _plan_of(warp)
        return own() if plan.is_pinned else plan.positions_for(f"constant {_reach(warp, padding)}", own)
