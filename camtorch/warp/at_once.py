"""One sample, or a batch, by one call of compiled code: the lattice of a warp, images sampled on it, and pixels."""

from __future__ import annotations

import ctypes
import functools
import itertools
import math
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from camtorch.evaluate.kept import Kept
from camtorch.evaluate.known import are_free
from camtorch.native import memory, sampler
from camtorch.native.library import library
from camtorch.projection.compiled import (
    LATTICE_WORDS,
    LEFT_FROM,
    LEFT_MOST,
    LEFT_TO,
    ON_IMAGE,
    POSITIONS,
    Between,
    Lattices,
    packed_move,
    rows_of,
    run_and_follow,
)
from camtorch.projection.evaluation import compiled_of
from camtorch.projection.native_cameras import Native, entry
from camtorch.values.threads import spread, thread_count
from camtorch.warp.grid import FEWEST, MOST_KEPT, STEP, coarse, kept_probes
from camtorch.warp.panorama import goes_round
from camtorch.warp.sampling import PADDINGS, SHRINKS, SURELY, Options, Sampler

if TYPE_CHECKING:
    from camtorch.warp.warp import Warp

_HEAD, _MOVE, _JOB = 5, 22, 38  # words of the structures of C
_MOST = 4  # forms of samples that a thread keeps calls of
_FEW = 2  # tiles of an image that one thread makes alone
_EVEN = 4  # samples a thread from which on it matters little that the last ones leave some threads idle
_PIXELS = 1 << 3  # flags of what is left of pixels are times this

Sizes = tuple[tuple[int, int], tuple[int, int]]
"""(height, width) of the source's image, and of the target's."""


def between_of(warp: Warp) -> tuple[Native, Native, Tensor | None] | None:
    """Return source, target and rotation of a warp for compiled code; None where it has to go step by step."""
    source, target, rotation = warp.source, warp.target, warp.rotation
    if not warp.is_an_operator or warp.is_pinned or goes_round(source) is not None or goes_round(target) is not None:
        return None
    made = compiled_of((source, target), target.intrinsics, *(() if rotation is None else (rotation,)))
    return None if made is None else (*made[0], rotation)  # type: ignore[return-value]


def _has_lattice(size: tuple[int, int]) -> bool:
    """Whether images of a size are large enough for one, and it is not too large to be kept."""
    n, m = (math.ceil(side / STEP) for side in size)
    return min(n, m) >= FEWEST and (n + 5) * (m + 5) <= MOST_KEPT


def _result(images: Tensor, how: Sampler, size: tuple[int, int]) -> Tensor | None:
    """What samples of images (B, C, H, W) go to; None where they lie too oddly in memory, or are none."""
    result = sampler.empty(images, len(images), size)
    takes = 0 not in result.shape and sampler.takes(images.dtype, how.mode)
    return result if takes and sampler.is_quick(images, result, how.mode) else None


@functools.lru_cache(maxsize=16)
def _coarse(size: tuple[int, int], dtype: torch.dtype) -> tuple[Tensor, tuple[int, int], int]:
    """(1, N, 2): pixels that tell how far an image shrinks, how many down and across, and their step."""
    first, step = coarse(size)
    with torch.inference_mode(False):
        v, u = (torch.arange(first, side, step, dtype=dtype, device="cpu") for side in size)
        return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).view(1, -1, 2), (len(v), len(u)), step


def _surely_keeps_size(back: Between, sizes: Sizes) -> bool:
    """Whether no image shrinks so far that a `MirrorWarp` would halve it; back: from the target to the source."""
    nodes, shape, step = _coarse(sizes[1], back.dtype)
    places = back.rows(nodes, POSITIONS)[0].numpy().reshape(-1, *shape, 2)
    seen: np.ndarray[Any, Any] = np.all(abs(places) <= 1, axis=-1)
    places = places * np.array([sizes[0][1] / 2, sizes[0][0] / 2], places.dtype)
    down, across = places[:, 1:] - places[:, :-1], places[:, :, 1:] - places[:, :, :-1]
    total, count = 0.0, 0
    for steps, both in ((down, seen[:, 1:] & seen[:, :-1]), (across, seen[:, :, 1:] & seen[:, :, :-1])):
        total = total + (np.hypot(steps[..., 0], steps[..., 1]) * both).sum((1, 2))
        count = count + both.sum((1, 2))
    return bool((total < SURELY * SHRINKS * step * np.maximum(count, 1)).all())


class _Calls(threading.local):
    def __init__(self) -> None:
        self.kept = Kept(_MOST)


_calls = _Calls()


def at_once(
    source: Native,
    target: Native,
    rotation: Tensor | None,
    sizes: Sizes,
    options: Options,
    values: Sequence[Tensor],
    hows: Sequence[Sampler | None],
    batched: bool = True,
) -> list[tuple[Tensor, Tensor | None]] | None:
    """Return images and pixels of samples, with a batch dim or, of a single one, without; and which pixels are valid.

    None where a lattice does not do, images shrink, lie oddly in memory, threads would idle, or something is traced.
    Values are images (B, C, H, W), masks (B, H, W) as well, and, where `hows` has None, pixels (B, *N, 2) of the
    source's image. Of a batch each thread takes whole samples.
    """
    tolerance, antialias, count = options["tolerance"], options["antialias"], values[0].shape[0]
    turns = 1 if rotation is None else rotation.numel() // 9
    if not tolerance or antialias or max(source.cameras, target.cameras, turns) != count or not are_free(*values):
        return None
    if count > 1:
        threads = thread_count()
        if source.dtype != torch.float32 or (count % threads and count < _EVEN * threads):
            return None
    if rotation is not None and (rotation.dtype != source.dtype or not rotation.is_contiguous()):
        rotation = rotation.detach().to(source.dtype).contiguous()
    forms = [(t.shape, t.stride(), t.dtype, how) for t, how in zip(values, hows, strict=True)]
    key = (sizes, source.dtype, tolerance, batched, *forms)
    call = _calls.kept((), key, lambda: _Call.of(sizes, source.dtype, tolerance, values, hows, batched))
    return None if call is None else call(source, target, rotation, values, antialias is None)


def _maker(ndim: int, image: Tensor, size: tuple[int, int], batched: bool) -> Callable[[], Tensor]:
    """What makes the place for the samples of images (B, C, H, W), which as masks may come as (B, H, W)."""
    make = sampler.maker(image, image.shape[0], size)

    def made() -> Tensor:
        result = make() if ndim == 4 else make().squeeze(1)
        return result if batched else result.squeeze(0)

    shape = made()
    if shape.nbytes >= memory.LEAST:
        return made
    return functools.partial(torch.empty_strided, shape.shape, shape.stride(), dtype=shape.dtype, device="cpu")


class _Call:
    """`Together` of geometry.h, with all that samples of one form have in common."""

    @classmethod
    def of(
        cls,
        sizes: Sizes,
        dtype: torch.dtype,
        tolerance: float,
        values: Sequence[Tensor],
        hows: Sequence[Sampler | None],
        batched: bool,
    ) -> _Call | None:
        if not _has_lattice(sizes[1]):
            return None
        images, pixels = [], []
        makers: list[Callable[[], Tensor] | None] = []
        for value, how in zip(values, hows, strict=True):
            if how is None:
                if torch.promote_types(value.dtype, dtype) != dtype:
                    return None
                pixels.append(value.to(dtype).reshape(len(value), -1, 2))
                makers.append(None)
                continue
            image = value if value.ndim == 4 else value.unsqueeze(1)
            if _result(image, how, sizes[1]) is None:
                return None
            images.append((image, how))
            makers.append(_maker(value.ndim, image, sizes[1], batched))
        return cls(sizes, dtype, tolerance, images, pixels, makers, batched, len(values[0]))

    def __init__(
        self,
        sizes: Sizes,
        dtype: torch.dtype,
        tolerance: float,
        images: Sequence[tuple[Tensor, Sampler]],
        pixels: Sequence[Tensor],
        makers: Sequence[Callable[[], Tensor] | None],
        batched: bool,
        count: int,
    ):
        probes = kept_probes(range(sizes[1][0]), sizes[1][1], dtype)
        padding = PADDINGS[max((PADDINGS.index(how.padding_mode) for _, how in images), default=0)]
        with torch.inference_mode(False):
            self._lattices = Lattices(probes, sizes[1], sizes[0], tolerance, padding, count)
        jobs, kept = [], []
        for image, how in images:
            fill = how.fill * image.shape[1] if len(how.fill) == 1 else how.fill
            result = sampler.empty(image, count, sizes[1])
            places = (0,) * 8 + self._lattices.places
            job, holds = sampler.packed(image, result, how.mode, how.padding_mode, fill, places)
            jobs.append(job)
            kept.append(holds)
        moves = []
        for given in pixels:
            many = given.shape[1]
            rows = *rows_of(given), 0, 2 * many, 2, 1, 0, many, max(many, 1), 0
            moves.append(packed_move(0, 0, 0, 0, 3, 1, count, ON_IMAGE, *sizes[1], *rows))
        text = bytes(8 * _HEAD) + bytes(self._lattices.words) + b"".join(moves) + b"".join(jobs)
        self._words = (ctypes.c_int64 * (len(text) // 8)).from_buffer_copy(text)
        first_move = _HEAD + LATTICE_WORDS
        self._first_job = first_move + _MOVE * len(moves)
        assert len(self._words) == self._first_job + _JOB * len(jobs)
        here = ctypes.addressof(self._words)
        of_jobs = here + 8 * self._first_job, len(jobs)
        self._words[:_HEAD] = [*of_jobs, 1, here + 8 * first_move, len(moves)]
        if count > 1:  # each as soon as its lattice is there
            self._words[first_move - 2 : first_move] = of_jobs
        else:
            self._words[_HEAD + _MOVE - 1] = 0  # one thread makes the lattice, and needs no counter of those made
        # where the pointers to each value go, and what makes the results of images
        to_moves, to_jobs = itertools.count(first_move, _MOVE), itertools.count(self._first_job, _JOB)
        self._slots = [(next(to_moves if make is None else to_jobs), make) for make in makers]
        self._tiles = max((sampler.tiles_of(sampler.empty(image, 1, sizes[1])) for image, _ in images), default=1)
        self._sizes, self._dtype, self._lead, self._count = sizes, dtype, 0 if batched else 1, count
        self._moves, self._jobs, self._kept = bool(moves), len(jobs), kept
        self._may_shrink = any(how.mode != "nearest" and image.dtype != torch.bool for image, how in images)

    def __call__(
        self, source: Native, target: Native, rotation: Tensor | None, values: Sequence[Tensor], decides: bool
    ) -> list[tuple[Tensor, Tensor | None]] | None:
        if decides and self._may_shrink:
            turns = None if rotation is None else rotation.mT
            if not _surely_keeps_size(Between(target, source, turns, self._sizes[0], False), self._sizes):
                return None
        words, turn = self._words, 0 if rotation is None else rotation.data_ptr()
        by_camera = 9 if rotation is not None and rotation.numel() > 9 else 0
        target.add_table()
        if self._moves:
            source.add_table()
        words[_HEAD : _HEAD + 4] = [target.pointer, source.pointer, turn, by_camera]
        results: list[tuple[Tensor, Tensor | None]] = []
        given = []  # pixels in the dtype of the cameras, for as long as the call
        for value, (at, make) in zip(values, self._slots, strict=True):
            if make is None:
                shape = value.shape[self._lead :]
                if value.dtype != self._dtype or value.ndim != 3:
                    value = value.to(self._dtype).reshape(self._count, -1, 2)
                    given.append(value)
                result = torch.empty(shape, dtype=self._dtype, device="cpu")
                valid = torch.empty(shape[:-1], dtype=torch.bool, device="cpu")
                words[at : at + 4] = [source.pointer, target.pointer, turn, by_camera]
                words[at + 10], words[at + 14], words[at + 18] = value.data_ptr(), result.data_ptr(), valid.data_ptr()
                results.append((result, valid))
            else:
                result = make()
                words[at], words[at + 1] = value.data_ptr(), result.data_ptr()
                results.append((result, None))
        native, threads, jobs = library(), thread_count(), self._jobs
        assert native is not None  # or nobody has a `Native`
        if self._count > 1 and jobs:
            call, threads, counters = ctypes.byref(words, 8 * _HEAD), min(threads, self._count), self._lattices.counters
            if run_and_follow(entry("camtorch_lattices", ctypes.c_int64), call, threads, counters, target, source):
                return None
            jobs = 0  # the images are made
        words[1] = jobs
        words[2] = is_whole = threads == 1 or self._tiles <= _FEW or not jobs
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
        if not is_whole:
            for i in range(self._jobs):
                job = words[self._first_job + i * _JOB : self._first_job + (i + 1) * _JOB]
                run = (ctypes.c_int64 * _JOB)(*job)
                run[_JOB - 1] = 0
                spread(lambda: native.camtorch_sample(run), min(threads, self._tiles))  # noqa: B023 (called at once)
        return results
