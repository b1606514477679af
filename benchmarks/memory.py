"""Memory of a call: by the allocator's account, and of the whole process.

The first sees temporaries, what a custom backward keeps anywhere, and compiled code: every allocation of torch is an
event of `torch.profiler`. It does not see OpenCV and native code; the process's peak, which Linux keeps, does.
"""

import ctypes
import gc
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from benchmarks.harness import Run
from camtorch.native import memory

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


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


def peak(run: Run) -> int | None:
    """Return the most bytes that a call adds to this process, whoever allocates; None if the system does not say."""
    if not _RESET.exists():
        return None
    for _ in range(2):
        run()
    gc.collect()
    memory.release()  # what camtorch and the C library hold for the next allocations would hide these
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
    _RESET.write_text("5")  # from here on the peak counts anew
    before = _status("VmRSS")
    result = run()
    most = _status("VmHWM")
    del result
    return most - before


def _status(name: str) -> int:
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(f"{name}:"))
    return int(line.split()[1]) * 1024
