"""Batches by one call of compiled code: each thread takes a sample, from its lattice to the last of its pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from camtorch._threads import thread_count
from camtorch._tracing import is_eager
from camtorch.native import sampler
from camtorch.warp.at_once import Made
from camtorch.warp.grid import FEWEST, MOST_KEPT, STEP, kept_probes
from camtorch.warp.moving import between
from camtorch.warp.sampling import PADDINGS, Sampler

if TYPE_CHECKING:
    from camtorch.warp.warp import Warp

_EVEN = 4  # samples a thread from which on it matters little that the last ones leave some threads idle


def batch_at_once(warp: Warp, images: Sequence[tuple[Tensor, Sampler]]) -> Made | None:
    """Images (B, C, H, W) of a warp of B cameras that is used once.

    None where lattices do not do, images lie too oddly in memory, there are too few samples for the threads, or
    something is in a graph or traced.

    Args:
        warp: from each sample's camera to another one.
        images: and how they are sampled.
    """
    tensors = [image for image, _ in images]
    if not images or not is_eager(*tensors):
        return None
    cameras, threads = math.prod(warp.batch_shape), thread_count()
    if cameras < 2 or (cameras % threads and cameras < _EVEN * threads):
        return None
    if not warp.is_an_operator or warp._decides or warp._pinned is not None or not warp.tolerance or warp.antialias:
        return None
    if warp.shutter is not None or warp.target_shutter is not None or warp.target.intrinsics.dtype != torch.float32:
        return None
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*tensors, *warp._inputs())):
        return None
    size, rotation = warp.target._size_for("Warp"), warp.rotation
    n, m = (math.ceil(side / STEP) for side in size)
    if min(n, m) < FEWEST or (n + 5) * (m + 5) > MOST_KEPT:
        return None
    results = [sampler.empty(image, cameras, size) for image in tensors]
    for (image, how), result in zip(images, results, strict=True):
        if 0 in result.shape or not sampler.takes(image.dtype, how.mode):
            return None
        if not sampler.is_quick(image, result, how.mode):
            return None
    back = between(warp.target, warp.source, None if rotation is None else rotation.mT, warp.target.intrinsics)
    if back is None or back.cameras != cameras:
        return None
    kept = []  # what jobs point to

    def jobs(on_lattice: tuple[int, ...]) -> list[bytes]:
        packed = []
        for (image, how), result in zip(images, results, strict=True):
            fill = how.fill * image.shape[1] if len(how.fill) == 1 else how.fill
            job, holds = sampler.packed(image, result, how.mode, how.padding_mode, fill, (0,) * 8 + on_lattice)
            packed.append(job)
            kept.append(holds)
        return packed

    padding = PADDINGS[max(PADDINGS.index(how.padding_mode) for _, how in images)]
    probes = kept_probes(range(size[0]), size[1], torch.float32)
    if back.lattices(probes, size, 0, warp.tolerance, padding, jobs) is None:
        return None
    return Made(results, [])
