"""One call of C for a sample: its images, masks, pixels, boxes, rays and poses. For a batch images and pixels."""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from camtorch.evaluate.kept import Kept
from camtorch.native import memory, structs
from camtorch.native.library import loaded
from camtorch.native.sampler import describe, is_quick, maker, takes, tiles_of
from camtorch.projection.evaluation import compiled_of
from camtorch.projection.native_calls import Lattices, NativeMove, run_and_follow
from camtorch.projection.native_cameras import Native
from camtorch.values.threads import spread, thread_count
from camtorch.warp.grid import FEWEST, MOST_KEPT, coarse, kept_probes
from camtorch.warp.panorama import goes_round
from camtorch.warp.plan import CameraPair
from camtorch.warp.sampling import PADDINGS, SHRINKS, SURELY, Options, Sampler

Label = Literal["pixels", "boxes", "rays", "columns", "pose", "rotation vectors"]
"""What moves beside images: pixels, boxes, directions and points of the camera frame, or columns of such in a matrix,
of which those of a pose begin with a rotation; or rotation vectors."""
Sizes = tuple[tuple[int, int], tuple[int, int]]  # (height, width) of the source's image, and of the target's

_FORMS = {"pose": structs.POSE, "rotation vectors": structs.ROTATION_VECTORS}  # others are rays
_FEW = 2  # tiles: an image of no more is made by one thread
_EVEN = 4  # samples a thread: with as many, threads that idle at the end matter little
_PIXELS = 1 << structs.LEFT_BITS  # C multiplies flags about pixels by this, to tell them from those about the lattice


def natives_of(warp: CameraPair) -> tuple[Native, Native, Tensor | None] | None:
    """Return source, target and rotation of a warp for native code; None if it has to go step by step."""
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
    """Return the call of native code that moves all that samples of a form hold; a thread keeps the last ones.

    None if no lattice serves, images shrink or have unusual strides, or threads would idle: each takes whole samples.

    Args:
        sizes: of both images.
        dtype: of the cameras' numbers.
        options: of the warp.
        values: on the CPU and without a graph: images (B, C, H, W), masks (B, H, W) as well, and labels.
        hows: what values are. Labels are pixels (B, *N, 2) of the source's image; of a single sample boxes too, and, in
            the dtype of the cameras, rays and rotation vectors (*N, 3) and columns (3 or 4, N) that turn.
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


def _surely_keeps_size(back: NativeMove, sizes: Sizes) -> bool:
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
    decides: bool  # whether images that shrink are antialiased, which this call does not do
    batched: bool
    count: int
    values: Sequence[Tensor]
    hows: Sequence[Sampler | Label]

    def images(self, value: Tensor) -> Tensor:
        """Return an image or a mask as (B, C, H, W)."""
        value = value if self.batched else value.unsqueeze(0)
        return value if value.ndim == 4 else value.unsqueeze(1)

    def takes(self, value: Tensor, how: Sampler | Label) -> bool:
        """Whether a call takes a value: not images without pixels, or with strides that are slow to read."""
        if not isinstance(how, Sampler):
            return torch.promote_types(value.dtype, self.dtype) == self.dtype
        image = self.images(value)
        result = maker(image, self.count, self.sizes[1])()
        return 0 not in result.shape and takes(image.dtype, how.mode) and is_quick(image, result, how.mode)

    def maker(self, value: Tensor) -> Callable[[], Tensor]:
        """Return a function that makes an empty tensor for the result of an image or a mask."""
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
        """Return the call; None if a lattice would be too small or too large, or a value does not fit."""
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
        # the structure of each value, and whether C reads the value itself, not a copy
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
                is_matrix = how in ("columns", "pose")
                slot.strides[:], slot.count = ((1, width), width) if is_matrix else ((3, 1), value.numel() // 3)
                slot.is_double, slot.form = dtype == torch.float64, _FORMS.get(how, structs.RAYS)
            self._slots.append((slot, value.dtype == dtype and value.is_contiguous()))
        call.lattices = self._lattices.struct
        self._back = call.lattices.move
        if count > 1:  # C samples images as soon as their lattice is made
            call.lattices.jobs, call.lattices.job_count = call.jobs, call.job_count
        else:
            self._back.next = None  # one thread makes the lattice, and needs no counter of those made
        self._doubtful = [i for i, how in enumerate(form.hows) if how in ("boxes", "pose", "rotation vectors")]
        self._dtype, self._count = dtype, count
        ways = zip(form.values, form.hows, strict=True)
        self._decides = form.decides and any(
            isinstance(how, Sampler) and how.mode != "nearest" and value.dtype != torch.bool for value, how in ways
        )

    def __call__(
        self, source: Native, target: Native, rotation: Tensor | None, values: Sequence[Tensor]
    ) -> list[tuple[Tensor, Tensor | None] | None] | None:
        """Move `values` of the form from one camera to another; also return which pixels and boxes are valid.

        None if the call does not serve. Those of boxes, poses and rotation vectors alone are None if some take more
        than their outline, or are none.
        """
        dtype = self._dtype
        if rotation is not None and (rotation.dtype != dtype or not rotation.is_contiguous()):
            rotation = rotation.detach().to(dtype).contiguous()
        if self._decides:
            turns = None if rotation is None else rotation.mT
            if not _surely_keeps_size(NativeMove(target, source, turns, self._sizes[0], False), self._sizes):
                return None
        call, turn = self._call, None if rotation is None else rotation.data_ptr()
        by_camera = 9 if rotation is not None and rotation.ndim > 2 and len(rotation) > 1 else 0
        target.add_table()
        if call.move_count:
            source.add_table()
        back = self._back
        back.from_, back.to, back.turns, back.turn_strides[0] = target.pointer, source.pointer, turn, by_camera
        results, _alive = self._filled_in(source, target, turn, by_camera, values)
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
            if self._follow(flags, source, target) == structs.LEFT_LABELS:
                for i in self._doubtful:
                    results[i] = None
                break
        if not is_whole:
            for job in self._jobs:
                job.next = 0
                spread(functools.partial(native.camtorch_sample, job), min(threads, self._tiles))
        return results

    def _filled_in(
        self, source: Native, target: Native, turn: int | None, by_camera: int, values: Sequence[Tensor]
    ) -> tuple[list[tuple[Tensor, Tensor | None] | None], list[Tensor]]:
        """Have the call read values and write results; return these, and what has to live as long as the call."""
        results: list[tuple[Tensor, Tensor | None] | None] = []
        given, makers, dtype = [], iter(self._makers), self._dtype
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
        return results, given

    def _follow(self, flags: int, source: Native, target: Native) -> int:
        """Compute limits that the call lacked: of cameras for the lattice, or for pixels, whose flags it returns."""
        left, (start, end) = (flags, (target, source)) if flags < _PIXELS else (flags // _PIXELS, (source, target))
        if left & structs.LEFT_FROM:
            start.follow()
        if left & structs.LEFT_TO:
            end.follow()
        if flags < _PIXELS:
            return 0
        self._call.job_count = 0  # the images are made
        return left
