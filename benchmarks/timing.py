"""Medians and minima of contestants that take turns."""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import cv2
import torch

from benchmarks.options import Options, complain, progress
from benchmarks.tables import Record

Run = Callable[[], object]

# Calls shorter than this are timed several at a time: one reading of the clock would be a good part of them
_SHORTEST_SAMPLE = 2e-3
_FEWEST = 3  # rounds


def clocked(run: Run, device: torch.device, calls: int = 1) -> float:
    """Seconds per call, including what a GPU has yet to finish."""
    wait = torch.cuda.synchronize if device.type == "cuda" else (lambda: None)
    wait()
    start = time.perf_counter()
    for _ in range(calls):
        run()
    wait()
    return (time.perf_counter() - start) / calls


def measure(
    case: str, operation: str, runs: Mapping[str, Run], options: Options, *, shortest: float = _SHORTEST_SAMPLE
) -> list[Record]:
    """Time contestants of one operation in turns.

    Each round calls everyone once, so that a neighbour's load, the clock frequency and the state of the allocator
    are the same for all. Each contestant has an equal share of `options.seconds`; who has used it up sits out the
    rounds that are left, after three at least. A contestant that raises is left out, which its table shows as "-", and
    is named on stderr.

    Args:
        case: of the records.
        operation: of the records.
        runs: by contestant, what is timed.
        options: the rounds, and the time for them.
        shortest: seconds; calls that are shorter are timed several at a time.

    Returns:
        per contestant "seconds", the median; "fastest", the minimum; and a "first call", which for a compiled one
        is the compilation.
    """
    records, calls = [], {}
    for name, run in runs.items():
        progress(f"{case}, {operation}: first call of {name}")
        try:
            first = clocked(run, options.device)
            once = clocked(run, options.device)
        except Exception as error:
            complain(f"{case}, {operation}: {name} failed: {type(error).__name__}: {str(error).splitlines()[:1]}")
            continue
        records.append(Record(case, name, operation, "first call", first))
        calls[name] = max(1, math.ceil(shortest / once))
    samples: dict[str, list[float]] = {name: [] for name in calls}
    share = options.seconds / max(len(calls), 1)
    gc.collect()
    gc.disable()
    try:
        for turn in range(options.repeats):
            progress(f"{case}, {operation}: round {turn + 1} of {options.repeats}, {len(calls)} contestants")
            # there and back: what one leaves in the caches serves the next
            for name, count in list(calls.items())[:: 1 if turn % 2 == 0 else -1]:
                if turn < _FEWEST or count * sum(samples[name]) < share:
                    samples[name].append(clocked(runs[name], options.device, count))
    finally:
        gc.enable()
    for name, taken in samples.items():
        records += summary(case, name, operation, taken)
    return records


def summary(case: str, contestant: str, operation: str, taken: Sequence[float]) -> list[Record]:
    """Of the seconds that the rounds took: "seconds", the median, and "fastest", the minimum."""
    found = (("seconds", statistics.median(taken)), ("fastest", min(taken)))
    return [Record(case, contestant, operation, quantity, value) for quantity, value in found]


@contextmanager
def threads(count: int) -> Iterator[None]:
    """As many threads for torch, camtorch with it, and OpenCV; then as many as before."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    _set_threads(count, count)
    try:
        yield
    finally:
        _set_threads(*before)


def _set_threads(of_torch: int, of_opencv: int) -> None:
    torch.set_num_threads(of_torch)
    cv2.setNumThreads(of_opencv)
