"""Memory of a call by the allocator's account: every allocation of torch is an event of `torch.profiler`.

It sees temporaries, what a custom backward keeps anywhere, and compiled graphs; not OpenCV and native code.
"""

from collections.abc import Callable
from itertools import accumulate

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from benchmarks.harness import Run


def growth(run: Run, device: torch.device) -> tuple[int, int]:
    """Return bytes: the most that a call added at any moment, and what of it is left while its result is held."""
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


def kept_for_backward(forward: Callable[[Tensor], Tensor], source: Tensor) -> int:
    """Return the bytes that stay alive for the backward pass once input and result are dropped; the input counts."""

    def graph():
        leaf = torch.empty_strided(source.shape, source.stride(), dtype=source.dtype, device=source.device)
        leaf.copy_(source).requires_grad_()
        return forward(leaf).grad_fn

    return growth(graph, source.device)[1]
