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

from camtorch.evaluate.known import are_free
from camtorch.native import memory, sampler
from camtorch.native.library import library
from camtorch.projection import compiled
from camtorch.projection.compiled import LEFT_FROM, LEFT_MOST, LEFT_TO, POSITIONS, Between
from camtorch.projection.evaluation import compiled_of
from camtorch.projection.native_cameras import Native
from camtorch.values.threads import spread, thread_count
from camtorch.warp.grid import FEWEST, MOST_KEPT, STEP, coarse, kept_probes
from camtorch.warp.moving import between
from camtorch.warp.panorama import goes_round
from camtorch.warp.sampling import PADDINGS, SHRINKS, SURELY, Options, Sampler

if TYPE_CHECKING:
    from camtorch.warp.warp import Warp

_HEAD, _LATTICE, _MOVE, _JOB = 5, 46, 22, 38  # words of the structures of C
_MOST = 4  # forms of samples that a thread keeps calls of
_FEW = 2  # tiles of an image that one thread makes alone
_EVEN = 4  # samples a thread from which on it matters little that the last ones leave some threads idle
_ALIGNED = 64
_PIXELS = 1 << 3  # flags of what is left of pixels are times this

Sizes = tuple[tuple[int, int], tuple[int, int]]
"""(height, width) of the source's image, and of the target's."""


def _is_used_once(warp: Warp) -> bool:
    """Whether its positions come from a lattice that nobody keeps, of cameras that stand still and do not go round."""
    if not warp.is_an_operator or warp.is_pinned or not warp.tolerance or warp.antialias:
        return False
    return goes_round(warp.source) is None and goes_round(warp.target) is None


def between_of(warp: Warp) -> tuple[Native, Native, Tensor | None] | None:
    """Return source, target and rotation of a single warp for compiled code; None where it has to go step by step."""
    source, target, rotation = warp.source, warp.target, warp.rotation
    if warp.batch_shape or not _is_used_once(warp):
        return None
    made = compiled_of((source, target), target.intrinsics, *(() if rotation is None else (rotation,)))
    return None if made is None else (*made[0], rotation)  # type: ignore[return-value]


def _has_lattice(size: tuple[int, int]) -> bool:
    """Whether images of a size are large enough for one, and it is not too large to be kept."""
    n, m = (math.ceil(side / STEP) for side in size)
    return min(n, m) >= FEWEST and (n + 5) * (m + 5) <= MOST_KEPT


def _result(image: Tensor, how: Sampler, count: int, size: tuple[int, int]) -> Tensor | None:
    """What (count, C, h, w) samples of an image go to; None where they lie too oddly in memory, or are none."""
    result = sampler.empty(image, count, size)
    takes = 0 not in result.shape and sampler.takes(image.dtype, how.mode)
    return result if takes and sampler.is_quick(image, result, how.mode) else None


def _job(image: Tensor, result: Tensor, how: Sampler, on_lattice: tuple[int, ...]) -> tuple[bytes, object]:
    fill = how.fill * image.shape[1] if len(how.fill) == 1 else how.fill
    return sampler.packed(image, result, how.mode, how.padding_mode, fill, (0,) * 8 + on_lattice)


def _smooth(images: Sequence[tuple[Tensor, Sampler]]) -> bool:
    """Whether a warp that decides for itself might halve one of them."""
    return any(how.mode != "nearest" and image.dtype != torch.bool for image, how in images)


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


def batch_at_once(warp: Warp, images: Sequence[tuple[Tensor, Sampler]]) -> list[Tensor] | None:
    """Return images (B, C, H, W) of a warp of B cameras that is used once: each thread takes whole samples.

    None where lattices do not do, images lie oddly in memory or shrink, threads would idle, or something is traced.
    """
    tensors = [image for image, _ in images]
    if not images or not are_free(*tensors):
        return None
    cameras, threads = math.prod(warp.batch_shape), thread_count()
    if cameras < 2 or (cameras % threads and cameras < _EVEN * threads):
        return None
    if not _is_used_once(warp) or warp.target.intrinsics.dtype != torch.float32:
        return None
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*tensors, *warp._inputs())):
        return None
    sizes, rotation = (warp.source._size_for("Warp"), warp.target._size_for("Warp")), warp.rotation
    found = [_result(image, how, cameras, sizes[1]) for image, how in images]
    results = [result for result in found if result is not None]
    if len(results) < len(images) or not _has_lattice(sizes[1]):
        return None
    back = between(warp.target, warp.source, None if rotation is None else rotation.mT, warp.target.intrinsics)
    if back is None or back.cameras != cameras:
        return None
    if warp._decides and _smooth(images) and not _surely_keeps_size(back, sizes):
        return None
    kept: list[object] = []  # what jobs point to

    def jobs(on_lattice: tuple[int, ...]) -> list[bytes]:
        pairs = zip(images, results, strict=True)
        packed = [_job(image, result, how, on_lattice) for (image, how), result in pairs]
        kept.extend(holds for _, holds in packed)
        return [job for job, _ in packed]

    padding = PADDINGS[max(PADDINGS.index(how.padding_mode) for _, how in images)]
    probes = kept_probes(range(sizes[1][0]), sizes[1][1], torch.float32)
    made = back.lattices(probes, sizes[1], 0, warp.tolerance, padding, jobs)
    return None if made is None else results


class _Calls(threading.local):
    def __init__(self) -> None:
        self.kept: dict[object, _Call] = {}


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
    """Return the images of a sample and its pixels, with a batch dim of one or without; and which pixels are valid.

    None where a lattice does not do, images shrink, lie oddly in memory, or something is traced. Values are images (1,
    C, H, W), masks (1, H, W) as well, and, where `hows` has None, pixels (1, *N, 2) of the source's image.
    """
    tolerance, antialias = options["tolerance"], options["antialias"]
    if not tolerance or antialias or not are_free(*values):
        return None
    if rotation is not None and (rotation.dtype != source.dtype or not rotation.is_contiguous()):
        rotation = rotation.detach().to(source.dtype).contiguous()
    forms = [(t.shape, t.stride(), t.dtype, how) for t, how in zip(values, hows, strict=True)]
    key = (sizes, source.dtype, tolerance, batched, *forms)
    call = _calls.kept.pop(key, None) or _Call.of(sizes, source.dtype, tolerance, values, hows, batched)
    if call is None:
        return None
    _calls.kept[key] = call  # the last one
    while len(_calls.kept) > _MOST:
        del _calls.kept[next(iter(_calls.kept))]
    return call(source, target, rotation, values, antialias is None)


def _maker(ndim: int, image: Tensor, size: tuple[int, int], batched: bool) -> Callable[[], Tensor]:
    """What makes the place for the samples of an image (1, C, H, W), which as a mask may come as (1, H, W)."""
    like = torch.empty_strided(image.shape, image.stride(), dtype=image.dtype, device="meta")

    def made() -> Tensor:
        result = sampler.empty(like, 1, size)
        result = result if ndim == 4 else result.squeeze(1)
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
                pixels.append(value.to(dtype).reshape(1, -1, 2))
                makers.append(None)
                continue
            image = value if value.ndim == 4 else value.unsqueeze(1)
            if _result(image, how, 1, sizes[1]) is None:
                return None
            images.append((image, how))
            makers.append(_maker(value.ndim, image, sizes[1], batched))
        return cls(sizes, dtype, tolerance, images, pixels, makers, batched)

    def __init__(
        self,
        sizes: Sizes,
        dtype: torch.dtype,
        tolerance: float,
        images: Sequence[tuple[Tensor, Sampler]],
        pixels: Sequence[Tensor],
        makers: Sequence[Callable[[], Tensor] | None],
        batched: bool,
    ):
        source_size, size = sizes
        n, m = (math.ceil(side / STEP) for side in size)
        probes = kept_probes(range(size[0]), size[1], dtype)
        count, nodes, wide = probes.shape[1], (n + 5) * (m + 5), dtype.itemsize
        is_double = dtype == torch.float64
        parts = [2 * count * wide, 4 * n * m, count, 128 * n * m * wide, 8 * nodes * is_double]
        parts += [4 * sampler.SCRATCH * (m + 8), 8]
        places = [-(-part // _ALIGNED) * _ALIGNED for part in parts]
        with torch.inference_mode(False):
            room = torch.empty(sum(places), dtype=torch.uint8, device="cpu")
        at, cells, valid, exact, narrow, scratch, used = itertools.accumulate(places[:-1], initial=room.data_ptr())
        jobs, kept = [], []
        plane = 64 * n * m * (2 if is_double else 1)
        on_lattice = narrow if is_double else at, 0, nodes if is_double else count, cells, 0, n, m, exact, plane
        for image, how in images:
            job, holds = _job(image, sampler.empty(image, 1, size), how, on_lattice)
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
        first_move, self._first_job = _HEAD + _LATTICE, _HEAD + _LATTICE + _MOVE * len(moves)
        here = ctypes.addressof(self._words)
        self._words[:_HEAD] = [here + 8 * self._first_job, len(jobs), 1, here + start, len(moves)]
        self._moves, self._jobs = bool(moves), len(jobs)
        # where the pointers to each value go, and what makes the results of images
        to_moves, to_jobs = itertools.count(first_move, _MOVE), itertools.count(self._first_job, _JOB)
        self._slots = [(next(to_moves if make is None else to_jobs), make) for make in makers]
        self._tiles = max((sampler.tiles_of(sampler.empty(image, 1, size)) for image, _ in images), default=1)
        self._sizes, self._dtype, self._lead = sizes, dtype, 0 if batched else 1
        self._kept = room, probes, kept  # what the words point to
        self._may_shrink = _smooth(images)

    def __call__(
        self, source: Native, target: Native, rotation: Tensor | None, values: Sequence[Tensor], decides: bool
    ) -> list[tuple[Tensor, Tensor | None]] | None:
        if decides and self._may_shrink:
            turns = None if rotation is None else rotation.mT
            if not _surely_keeps_size(Between(target, source, turns, self._sizes[0], False), self._sizes):
                return None
        words, turn = self._words, 0 if rotation is None else rotation.data_ptr()
        target.add_table()
        if self._moves:
            source.add_table()
        words[_HEAD], words[_HEAD + 1], words[_HEAD + 2] = target.pointer, source.pointer, turn
        results: list[tuple[Tensor, Tensor | None]] = []
        given = []  # pixels in the dtype of the cameras, for as long as the call
        for value, (at, make) in zip(values, self._slots, strict=True):
            if make is None:
                shape = value.shape[self._lead :]
                if value.dtype != self._dtype or value.ndim != 3:
                    value = value.to(self._dtype).reshape(1, -1, 2)
                    given.append(value)
                result = torch.empty(shape, dtype=self._dtype, device="cpu")
                valid = torch.empty(shape[:-1], dtype=torch.bool, device="cpu")
                words[at], words[at + 1], words[at + 2] = source.pointer, target.pointer, turn
                words[at + 10], words[at + 14], words[at + 18] = value.data_ptr(), result.data_ptr(), valid.data_ptr()
                results.append((result, valid))
            else:
                result = make()
                words[at], words[at + 1] = value.data_ptr(), result.data_ptr()
                results.append((result, None))
        native, threads = library(), min(thread_count(), self._tiles)
        assert native is not None  # or nobody has a `Native`
        words[2] = is_whole = threads == 1 or self._tiles <= _FEW
        words[1] = self._jobs
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
                spread(lambda: native.camtorch_sample(run), threads)  # noqa: B023 (which is called at once)
        return results
