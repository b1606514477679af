"""One sample by one call of compiled code: the lattice of a warp, images sampled on it, and pixels that move along."""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from camtorch._evaluation import compiled_of
from camtorch._threads import spread, thread_count
from camtorch._tracing import is_eager
from camtorch.native import sampler
from camtorch.native.library import library
from camtorch.projection import compiled
from camtorch.projection.compiled import LEFT_FROM, LEFT_MOST, LEFT_TO, Native
from camtorch.warp.grid import FEWEST, MOST_KEPT, STEP, kept_probes
from camtorch.warp.panorama import seam_of
from camtorch.warp.sampling import SHRINKS, SURELY, Options, Sampler

if TYPE_CHECKING:
    from camtorch.warp.warp import Warp

_HEAD, _LATTICE, _MOVE, _JOB = 5, 46, 22, 38  # words of the structures of C
_MOST = 4  # forms of samples that a thread keeps calls of
_FEW = 2  # tiles of an image that one thread makes alone
_ALIGNED = 64
_PIXELS = 1 << 3  # flags of what is left of pixels are times this


def between_of(warp: Warp) -> tuple[Native, Native, Tensor | None] | None:
    """Source, target and rotation of a warp for compiled code; None where it has to go step by step.

    That is where its positions are kept, exact, antialiased throughout, in a graph, traced, of a batch, a seam or a
    shutter.
    """
    source, target, rotation = warp.source, warp.target, warp.rotation
    if not warp.is_an_operator or warp._pinned is not None or warp.batch_shape:
        return None
    if not warp.tolerance or warp.antialias or warp.shutter is not None or warp.target_shutter is not None:
        return None
    if seam_of(source) is not None or seam_of(target) is not None:
        return None
    made = compiled_of((source, target), target.intrinsics, *(() if rotation is None else (rotation,)))
    return None if made is None else (*made[0], rotation)  # type: ignore[return-value]


class Work(NamedTuple):
    """What a warp is to do for one sample."""

    images: Sequence[tuple[Tensor, Sampler]]
    """(1, C, H, W) each, and how they are sampled."""
    pixels: Sequence[Tensor]
    """(1, N, 2) each, of the source's image, to be moved to the target's."""


class Made(NamedTuple):
    """What comes of it: (1, C, h, w) each; and pixels (1, N, 2), valid (1, N), as of `Warp.transform_points`."""

    images: list[Tensor]
    pixels: list[tuple[Tensor, Tensor]]


class _Calls(threading.local):
    def __init__(self) -> None:
        self.kept: dict[object, _Call] = {}


_calls = _Calls()


def at_once(
    source: Native,
    target: Native,
    rotation: Tensor | None,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    options: Options,
    work: Work,
) -> Made | None:
    """The images of a sample and its pixels.

    None where a lattice does not do, images shrink, lie too oddly in memory, or something is in a graph or traced.

    Args:
        source: the camera of the images, single.
        target: that of the images to make.
        rotation: (3, 3), `ray_target = R ray_source`, or None.
        sizes: (height, width) of the source's image, and of the target's.
        options: of a `Warp` whose tolerance is positive, or of a `MirrorWarp` that decides where to antialias.
        work: what is to be made.
    """
    tolerance = options["tolerance"]
    if not tolerance or options["antialias"]:
        return None
    tensors = [image for image, _ in work.images] + list(work.pixels)
    if not is_eager(*tensors) or (torch.is_grad_enabled() and any(t.requires_grad for t in tensors)):
        return None
    if any(t.dtype != source.dtype for t in work.pixels):
        if any(torch.promote_types(t.dtype, source.dtype) != source.dtype for t in work.pixels):
            return None
        work = Work(work.images, [t.to(source.dtype) for t in work.pixels])
    if rotation is not None and (rotation.dtype != source.dtype or not rotation.is_contiguous()):
        rotation = rotation.detach().to(source.dtype).contiguous()
    forms = [(image.shape[1], image.stride(), image.dtype, how) for image, how in work.images]
    key = (sizes, source.dtype, tolerance, *forms, *((t.shape[1], t.stride()) for t in work.pixels))
    call = _calls.kept.pop(key, None) or _Call.of(sizes, source.dtype, tolerance, work)
    if call is None:
        return None
    _calls.kept[key] = call  # the last one
    while len(_calls.kept) > _MOST:
        del _calls.kept[next(iter(_calls.kept))]
    return call(source, target, rotation, work, options["antialias"] is None)


class _Call:
    """`Together` of geometry.h, with all that samples of one form have in common."""

    @classmethod
    def of(
        cls, sizes: tuple[tuple[int, int], tuple[int, int]], dtype: torch.dtype, tolerance: float, work: Work
    ) -> _Call | None:
        n, m = (math.ceil(side / STEP) for side in sizes[1])
        if min(n, m) < FEWEST or (n + 5) * (m + 5) > MOST_KEPT:
            return None
        for image, how in work.images:
            result = sampler.empty(image, 1, sizes[1])
            if 0 in result.shape or not sampler.takes(image.dtype, how.mode):
                return None
            if not sampler.is_quick(image, result, how.mode):
                return None
        return cls(sizes, dtype, tolerance, work)

    def __init__(
        self, sizes: tuple[tuple[int, int], tuple[int, int]], dtype: torch.dtype, tolerance: float, work: Work
    ):
        source_size, size = sizes
        images, pixels = work
        n, m = (math.ceil(side / STEP) for side in size)
        probes = kept_probes(range(size[0]), size[1], dtype)
        count, nodes, wide = probes.shape[1], (n + 5) * (m + 5), dtype.itemsize
        is_double = dtype == torch.float64
        parts = [2 * count * wide, 4 * n * m, count, 128 * n * m * wide, 8 * nodes * is_double]
        parts += [4 * sampler.SCRATCH * (m + 8), 8]
        places = [-(-part // _ALIGNED) * _ALIGNED for part in parts]
        with torch.inference_mode(False):
            memory = torch.empty(sum(places), dtype=torch.uint8, device="cpu")
        at, cells, valid, exact, narrow, scratch, used = accumulate(places[:-1], initial=memory.data_ptr())
        jobs, kept = [], []
        plane = 64 * n * m * (2 if is_double else 1)
        on_lattice = narrow if is_double else at, 0, nodes if is_double else count, cells, 0, n, m, exact, plane
        for image, how in images:
            fill = how.fill * image.shape[1] if len(how.fill) == 1 else how.fill
            result = sampler.empty(image, 1, size)
            job, holds = sampler.packed(image, result, how.mode, how.padding_mode, fill, (0,) * 8 + on_lattice)
            jobs.append(job)
            kept.append(holds)
        reach = max((sampler.PADDINGS[how.padding_mode] for _, how in images), default=0)
        rows = compiled.rows_of(probes)
        move = [0, 0, 0, 0, 1, 3, 1, compiled.POSITIONS, *source_size, *rows]
        move += [at, 2 * count, 1, count, valid, count, count, 0]
        asked = at, 2 * count, count, valid, count, valid + nodes, count, 1, n, m, *size, *source_size, tolerance
        lattice = compiled.packed_lattices(
            *move, *asked, reach, cells, scratch, 0, narrow if is_double else 0, exact, used, 0, 0
        )
        moves = [
            compiled.packed_move(
                *(0, 0, 0, 0, 3, 1, 1, compiled.ON_IMAGE, *size),
                *compiled.rows_of(given),
                *(0, 0, 2, 1, 0, given.shape[1], max(given.shape[1], 1), 0),
            )
            for given in pixels
        ]
        start = 8 * (_HEAD + _LATTICE)
        text = bytes(8 * _HEAD) + lattice + b"".join(moves) + b"".join(jobs)
        assert len(text) == start + 8 * (_MOVE * len(moves) + _JOB * len(jobs))
        self._words = (ctypes.c_int64 * (len(text) // 8)).from_buffer_copy(text)
        self._first_move, self._first_job = _HEAD + _LATTICE, _HEAD + _LATTICE + _MOVE * len(moves)
        here = ctypes.addressof(self._words)
        self._words[:_HEAD] = [here + 8 * self._first_job, len(jobs), 1, here + start, len(moves)]
        self._tiles = max((sampler.tiles_of(sampler.empty(image, 1, size)) for image, _ in images), default=1)
        self._size, self._pixels, self._dtype = size, size[0] * size[1], dtype
        self._kept = memory, probes, kept  # what the words point to
        positions = memory[: parts[0]].view(dtype).view(2, count)[:, :nodes].view(2, n + 5, m + 5)
        self._seen = positions[:, ::4, ::4].numpy()
        self._half = np.array([source_size[1] / 2, source_size[0] / 2])[:, None, None]
        self._may_shrink = any(how.mode != "nearest" and image.dtype != torch.bool for image, how in images)

    def __call__(
        self, source: Native, target: Native, rotation: Tensor | None, work: Work, decides: bool
    ) -> Made | None:
        words, turns = self._words, 0 if rotation is None else rotation.data_ptr()
        target.add_tables(self._pixels if work.images else 0)  # as `Between.lattices` does it
        if work.pixels:
            source.add_tables(0)
        words[_HEAD], words[_HEAD + 1], words[_HEAD + 2] = target.pointer, source.pointer, turns
        made = Made([], [])
        at = self._first_move
        for given in work.pixels:
            moved = torch.empty(1, given.shape[1], 2, dtype=self._dtype, device="cpu")
            valid = torch.empty(1, given.shape[1], dtype=torch.bool, device="cpu")
            words[at], words[at + 1], words[at + 2] = source.pointer, target.pointer, turns
            words[at + 10], words[at + 14], words[at + 18] = given.data_ptr(), moved.data_ptr(), valid.data_ptr()
            made.pixels.append((moved, valid))
            at += _MOVE
        for image, _ in work.images:
            result = sampler.empty(image, 1, self._size)
            words[at], words[at + 1] = image.data_ptr(), result.data_ptr()
            made.images.append(result)
            at += _JOB
        native, threads = library(), min(thread_count(), self._tiles)
        assert native is not None  # or nobody has a `Native`
        looks = decides and self._may_shrink
        words[2] = is_whole = not looks and (threads == 1 or self._tiles <= _FEW)
        words[1] = len(work.images)
        while flags := native.camtorch_together(words):
            if flags & LEFT_MOST:
                return None
            # of the lattice, else of the pixels, which go the other way
            left, (start, end) = (flags, (target, source)) if flags < _PIXELS else (flags // _PIXELS, (source, target))
            if left & LEFT_FROM:
                start.follow()
            if left & LEFT_TO:
                end.follow()
            if flags >= _PIXELS:  # the images are made
                words[1] = 0
        if looks and not self._keeps_size():
            return None
        if not is_whole:
            for i in range(len(work.images)):
                job = words[self._first_job + i * _JOB : self._first_job + (i + 1) * _JOB]
                run = (ctypes.c_int64 * _JOB)(*job)
                run[_JOB - 1] = 0
                spread(lambda: native.camtorch_sample(run), threads)  # noqa: B023 (which is called at once)
        return made

    def _keeps_size(self) -> bool:
        """Whether images surely shrink by less than a `MirrorWarp` halves them for, of steps that rounding adds up."""
        seen = np.all(abs(self._seen) <= 1, 0)
        positions = self._seen * self._half
        down, right = positions[:, 1:] - positions[:, :-1], positions[:, :, 1:] - positions[:, :, :-1]
        both = seen[1:] & seen[:-1], seen[:, 1:] & seen[:, :-1]
        steps = [np.hypot(*step)[pair] for step, pair in zip((down, right), both, strict=True)]
        total, count = (sum(numbers) for numbers in zip(*((step.sum(), step.size) for step in steps), strict=True))
        return bool(total < SURELY * SHRINKS * 4 * STEP * max(count, 1))
