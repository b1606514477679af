"""How a warp samples images: the route is found once for a form of call, and kept while its cameras stay."""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
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
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.known import is_unknown
from camtorch.native import memory, structs
from camtorch.native.library import loaded
from camtorch.native.sampler import Call, describe, is_quick, maker, takes, tiles_of
from camtorch.projection.compiled import Between, Lattices, run_and_follow
from camtorch.projection.evaluation import compiled_of
from camtorch.projection.native_cameras import Native
from camtorch.values.threads import spread, thread_count
from camtorch.warp import compiled
from camtorch.warp.grid import FEWEST, MOST_KEPT, Lattice, Sampling, coarse, kept_probes, local_scale
from camtorch.warp.pair import CameraPair, Plan
from camtorch.warp.panorama import goes_round
from camtorch.warp.sampling import (
    PADDINGS,
    SHRINKS,
    SURELY,
    Options,
    PaddingMode,
    Pyramid,
    Sampler,
    by_torch,
    laid_as,
    prepared,
    render,
)

Route = Literal["operator", "strips", "graph", "kept"]
Label = Literal["pixels", "boxes", "rays", "columns", "pose"]
"""What moves beside images: pixels, boxes, directions and points of the camera frame, or columns of such in a matrix,
of which those of a pose begin with a rotation."""
Sizes = tuple[tuple[int, int], tuple[int, int]]  # (height, width) of the source's image, and of the target's

_MOST_KEPT = 1 << 25  # pixels of a grid; longer ones, of 256 MB in float32, are made by strips and not kept
_STRIP = 1 << 21  # pixels of such a strip
_FEW = 2  # tiles of an image that one thread makes alone
_EVEN = 4  # samples a thread from which on it matters little that the last ones leave some threads idle
_PIXELS = 1 << structs.LEFT_BITS  # flags of what is left of pixels are times this


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


# -- samples: images, pixels and vectors by one call of compiled code


def between_of(warp: CameraPair) -> tuple[Native, Native, Tensor | None] | None:
    """Return source, target and rotation of a warp for compiled code; None where it has to go step by step."""
    source, target, rotation = warp.source, warp.target, warp.rotation
    if not warp.is_an_operator or warp.is_pinned or goes_round(source) is not None or goes_round(target) is not None:
        return None
    made = compiled_of((source, target), target.intrinsics, *(() if rotation is None else (rotation,)))
    return None if made is None else (*made[0], rotation)  # type: ignore[return-value]


def call_for(
    sizes: Sizes,
    dtype: torch.dtype,
    options: Options,
    values: Sequence[Tensor],
    hows: Sequence[Sampler | Label],
    batched: bool,
) -> SampleCall | None:
    """Return the call of compiled code that moves all that samples of a form hold; a thread keeps the last ones.

    None where a lattice does not do, images shrink or lie oddly in memory, or threads would idle: of a batch each takes
    whole samples.

    Args:
        sizes: of both images.
        dtype: of the cameras' numbers.
        options: of the warp.
        values: on the CPU and without a graph: images (B, C, H, W), masks (B, H, W) as well, and labels.
        hows: what values are. Labels are pixels (B, *N, 2) of the source's image; of a single sample boxes too, and, in
            the dtype of the cameras, rays (*N, 3) and columns (3 or 4, N) that turn.
        batched: whether there is a dim B.
    """
    tolerance, antialias, count = options["tolerance"], options["antialias"], len(values[0]) if batched else 1
    if not tolerance or antialias:
        return None
    if count > 1:
        threads = thread_count()
        if dtype != torch.float32 or (count % threads and count < _EVEN * threads):
            return None
    given = sizes, dtype, tolerance, antialias is None, batched
    forms = [(t.shape, t.stride(), t.dtype, how) for t, how in zip(values, hows, strict=True)]
    calls: Kept = _calls.__dict__.setdefault("kept", Kept(4))
    return calls((), (*given, *forms), lambda: SampleCall.of(SampleForm(*given, count, values, hows)))


_calls = threading.local()  # a thread keeps calls of its last four forms, which have memory of their own


@functools.lru_cache(maxsize=16)
def _coarse(size: tuple[int, int], dtype: torch.dtype) -> tuple[Tensor, tuple[int, int], int]:
    """Return pixels (1, N, 2) that show how far an image shrinks, their numbers down and across, and their step."""
    first, step = coarse(size)
    with torch.inference_mode(False):
        v, u = (torch.arange(first, side, step, dtype=dtype, device="cpu") for side in size)
        return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).view(1, -1, 2), (len(v), len(u)), step


def _surely_keeps_size(back: Between, sizes: Sizes) -> bool:
    """Whether no image shrinks so far that a `MirrorWarp` would halve it; back: from the target to the source."""
    nodes, shape, step = _coarse(sizes[1], back.dtype)
    places = back.rows(nodes, structs.POSITIONS)[0].numpy().reshape(-1, *shape, 2)
    seen: np.ndarray[Any, Any] = np.all(abs(places) <= 1, axis=-1)
    places = places * np.array([sizes[0][1] / 2, sizes[0][0] / 2], places.dtype)
    down, across = places[:, 1:] - places[:, :-1], places[:, :, 1:] - places[:, :, :-1]
    total, count = 0.0, 0
    for steps, both in ((down, seen[:, 1:] & seen[:, :-1]), (across, seen[:, :, 1:] & seen[:, :, :-1])):
        total = total + (np.hypot(steps[..., 0], steps[..., 1]) * both).sum((1, 2))
        count = count + both.sum((1, 2))
    return bool((total < SURELY * SHRINKS * step * np.maximum(count, 1)).all())


@dataclass
class SampleForm:
    """The common form of samples that one call serves; see `call_for`."""

    sizes: Sizes
    dtype: torch.dtype
    tolerance: float
    decides: bool  # whether images that shrink go another way
    batched: bool
    count: int
    values: Sequence[Tensor]
    hows: Sequence[Sampler | Label]

    def images(self, value: Tensor) -> Tensor:
        """Return an image or a mask as (B, C, H, W)."""
        value = value if self.batched else value.unsqueeze(0)
        return value if value.ndim == 4 else value.unsqueeze(1)

    def takes(self, value: Tensor, how: Sampler | Label) -> bool:
        """Whether a call takes a value: images that lie too oddly in memory, or are none, go another way."""
        if not isinstance(how, Sampler):
            return torch.promote_types(value.dtype, self.dtype) == self.dtype
        image = self.images(value)
        result = maker(image, self.count, self.sizes[1])()
        return 0 not in result.shape and takes(image.dtype, how.mode) and is_quick(image, result, how.mode)

    def maker(self, value: Tensor) -> Callable[[], Tensor]:
        """Return what makes the place for samples of an image or a mask."""
        make, is_image = maker(self.images(value), self.count, self.sizes[1]), value.ndim == 3 + self.batched

        def made() -> Tensor:
            result = make() if is_image else make().squeeze(1)
            return result if self.batched else result.squeeze(0)

        like = made()
        if like.nbytes >= memory.LEAST:
            return made
        return functools.partial(torch.empty_strided, like.shape, like.stride(), dtype=like.dtype, device="cpu")


class SampleCall:
    """`Together` of geometry.h, with all that samples of one form have in common."""

    @classmethod
    def of(cls, form: SampleForm) -> SampleCall | None:
        """Return the call, or None where it does not do."""
        n, m = (math.ceil(side / structs.STEP) for side in form.sizes[1])
        if min(n, m) < FEWEST or (n + 5) * (m + 5) > MOST_KEPT:  # too small for a lattice, or too large to be kept
            return None
        return cls(form) if all(map(form.takes, form.values, form.hows)) else None

    def __init__(self, form: SampleForm):
        sizes, dtype, count, self._sizes = form.sizes, form.dtype, form.count, form.sizes
        samplers = [how for how in form.hows if isinstance(how, Sampler)]
        probes = kept_probes(range(sizes[1][0]), sizes[1][1], dtype)
        padding = PADDINGS[max((PADDINGS.index(how.padding_mode) for how in samplers), default=0)]
        with torch.inference_mode(False):
            self._lattices = Lattices(probes, sizes[1], sizes[0], form.tolerance, padding, count)
        images, moving = len(samplers), sum(how in ("pixels", "boxes") for how in form.hows)
        self._jobs, pixels = (structs.Job * images)(), (structs.Move * moving)()
        vectors = (structs.Turned * (len(form.hows) - images - moving))()
        call = self._call = structs.Together(job_count=images, move_count=moving, turned_count=len(vectors))
        call.jobs, call.moves, call.turned = (call.keep(array) for array in (self._jobs, pixels, vectors))
        jobs, moves, turns = iter(self._jobs), iter(pixels), iter(vectors)
        # the structure of each value, and whether it goes in as it is
        self._slots = list[tuple[structs.Job | structs.Move | structs.Turned, bool]]()
        self._makers = list[Callable[[], Tensor]]()  # of images
        self._tiles = 1
        for value, how in zip(form.values, form.hows, strict=True):
            slot: structs.Job | structs.Move | structs.Turned
            if isinstance(how, Sampler):
                slot = job = next(jobs)
                image = form.images(value)
                result = maker(image, count, sizes[1])()
                fill = how.fill * image.shape[1] if len(how.fill) == 1 else how.fill
                describe(job, image, result, how.mode, how.padding_mode, fill)
                self._lattices.lay(job)
                self._tiles = max(self._tiles, tiles_of(result[:1]))
                self._makers.append(form.maker(value))
            elif how in ("pixels", "boxes"):
                slot, each = next(moves), 2 if how == "pixels" else 4
                many = value.numel() // (each * count) if count else 0
                slot.turn_strides[:], slot.cameras, (slot.height, slot.width) = (0, 3, 1), count, sizes[1]
                slot.form = structs.ON_IMAGE if how == "pixels" else structs.BOXES
                slot.count, slot.tile = many, max(many, 1)
                slot.row_strides[:] = slot.result_strides[:] = each * many, each, 1
            else:
                slot, width = next(turns), value.shape[-1]
                slot.strides[:], slot.count = ((3, 1), value.numel() // 3) if how == "rays" else ((1, width), width)
                slot.is_double, slot.is_pose = dtype == torch.float64, how == "pose"
            self._slots.append((slot, value.dtype == dtype and value.is_contiguous()))
        call.lattices = self._lattices.struct
        self._back = call.lattices.move
        if count > 1:  # each as soon as its lattice is there
            call.lattices.jobs, call.lattices.job_count = call.jobs, call.job_count
        else:
            self._back.next = None  # one thread makes the lattice, and needs no counter of those made
        self._doubtful = [i for i, how in enumerate(form.hows) if how in ("boxes", "pose")]
        self._dtype, self._count = dtype, count
        self.keeps_dtypes: bool = all(
            isinstance(how, Sampler) or value.dtype == dtype for value, how in zip(form.values, form.hows, strict=True)
        )
        """Whether all results are of the dtypes of the values."""
        ways = zip(form.values, form.hows, strict=True)
        self._decides = form.decides and any(
            isinstance(how, Sampler) and how.mode != "nearest" and value.dtype != torch.bool for value, how in ways
        )

    def __call__(
        self, source: Native, target: Native, rotation: Tensor | None, values: Sequence[Tensor]
    ) -> list[tuple[Tensor, Tensor | None] | None] | None:
        """Move `values` of the form from one camera to another; also return which pixels and boxes are valid.

        None if the call does not serve. Those of boxes and poses alone are None if some take more than their outline,
        or are none.
        """
        dtype = self._dtype
        if rotation is not None and (rotation.dtype != dtype or not rotation.is_contiguous()):
            rotation = rotation.detach().to(dtype).contiguous()
        if self._decides:
            turns = None if rotation is None else rotation.mT
            if not _surely_keeps_size(Between(target, source, turns, self._sizes[0], False), self._sizes):
                return None
        call, turn = self._call, None if rotation is None else rotation.data_ptr()
        by_camera = 9 if rotation is not None and rotation.ndim > 2 and len(rotation) > 1 else 0
        target.add_table()
        if call.move_count:
            source.add_table()
        back = self._back
        back.from_, back.to, back.turns, back.turn_strides[0] = target.pointer, source.pointer, turn, by_camera
        results: list[tuple[Tensor, Tensor | None] | None] = []
        given, makers = [], iter(self._makers)  # pixels in the cameras' dtype, without gaps, for as long as the call
        for value, (slot, is_plain) in zip(values, self._slots, strict=True):
            valid = None
            if isinstance(slot, structs.Job):
                result = next(makers)()
                slot.source, slot.result = value.data_ptr(), result.data_ptr()
            elif isinstance(slot, structs.Turned):
                result = value.clone()
                slot.turn, slot.rows, slot.results = turn, value.data_ptr(), result.data_ptr()
            else:
                if not is_plain:
                    value = value.to(dtype).contiguous()
                    given.append(value)
                result = torch.empty(value.shape, dtype=dtype, device="cpu")
                valid = torch.empty(value.shape[:-1], dtype=torch.bool, device="cpu")
                slot.from_, slot.to, slot.turns, slot.turn_strides[0] = source.pointer, target.pointer, turn, by_camera
                slot.rows, slot.results, slot.valid = value.data_ptr(), result.data_ptr(), valid.data_ptr()
            results.append((result, valid))
        native, threads, jobs = loaded(), thread_count(), len(self._jobs)
        if self._count > 1 and jobs:
            run, counters = native.camtorch_lattices, self._lattices.counters
            if run_and_follow(run, call.lattices, self._count, counters, target, source):
                return None
            jobs = 0  # the images are made
        is_whole = threads == 1 or self._tiles <= _FEW or not jobs
        call.job_count, call.is_whole = jobs, is_whole
        while flags := native.camtorch_together(call):
            if flags & structs.LEFT_MOST:
                return None
            # of the lattice, else of the pixels, which go the other way
            left, (start, end) = (flags, (target, source)) if flags < _PIXELS else (flags // _PIXELS, (source, target))
            if left & structs.LEFT_FROM:
                start.follow()
            if left & structs.LEFT_TO:
                end.follow()
            if flags >= _PIXELS:  # the images are made
                call.job_count = 0
                if left == structs.LEFT_LABELS:
                    for i in self._doubtful:
                        results[i] = None
                    break
        if not is_whole:
            for job in self._jobs:
                job.next = 0
                spread(functools.partial(native.camtorch_sample, job), min(threads, self._tiles))
        return results
