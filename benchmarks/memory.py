"""Memory by the allocator's own account.

Every allocation and release of torch within a call is a memory event of `torch.profiler`; their running sum is
the memory that the call added. This sees temporaries, what a custom backward keeps anywhere, and compiled code. It
does not see inputs that existed before the call, nor OpenCV, which does not allocate through torch.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile


def growth(run: Callable[[], object], device: torch.device) -> tuple[int, int]:
    """Bytes: the most that a call added at any moment, and what of it is left while its result is held."""
    activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * (device.type == "cuda")
    with profile(activities=activities, profile_memory=True) as profiler:
        held = run()
    events = [
        (event.start_ns(), event.nbytes())
        for event in profiler.profiler.kineto_results.events()
        if event.name() == "[memory]" and event.device_type().name == device.type.upper()
    ]
    del held
    sums = list(accumulate((size for _, size in sorted(events, key=lambda e: e[0])), initial=0))
    return max(sums), sums[-1]


def kept_for_backward(forward: Callable[[Tensor], Tensor], source: Tensor, device: torch.device) -> int:
    """Bytes that stay alive for the backward pass once the caller has dropped both input and result.

    The input is made within, so that it counts, like everything else that the graph holds on to.
    """

    def graph():
        leaf = torch.empty_strided(source.shape, source.stride(), dtype=source.dtype, device=device)
        leaf.copy_(source).requires_grad_()
        return forward(leaf).grad_fn

    return growth(graph, device)[1]
