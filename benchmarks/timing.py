"""Medians of contestants that take turns."""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable, Mapping

import torch

from benchmarks.options import Options, complain, progress
from benchmarks.tables import Record

Run = Callable[[], object]

# Calls shorter than this are timed several at a time: one reading of the clock would be a good part of them
_SHORTEST_SAMPLE = 2e-3


def clocked(run: Run, device: torch.device, calls: int = 1) -> float:
    """Seconds per call, including what a GPU has yet to finish."""
    wait = torch.cuda.synchronize if device.type == "cuda" else (lambda: None)
    wait()
    start = time.perf_counter()
    for _ in range(calls):
        run()
    wait()
    return (time.perf_counter() - start) / calls


def measure(case: str, operation: str, runs: Mapping[str, Run], options: Options) -> list[Record]:
    """Time contestants of one operation in turns.

    Each round calls everyone once, so that a neighbour's load, the clock frequency and the state of the allocator
    are the same for all. A contestant that raises is left out, which its table shows as "-", and is named on stderr.

    Returns:
        per contestant a "seconds", the median, and a "first call", which for a compiled one is the compilation.
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
        calls[name] = max(1, math.ceil(_SHORTEST_SAMPLE / once))
    samples = {name: [] for name in calls}
    gc.collect()
    gc.disable()
    try:
        for turn in range(options.repeats):
            progress(f"{case}, {operation}: round {turn + 1} of {options.repeats}, {len(calls)} contestants")
            for name, count in calls.items():
                samples[name].append(clocked(runs[name], options.device, count))
    finally:
        gc.enable()
    records += [Record(case, name, operation, "seconds", statistics.median(taken)) for name, taken in samples.items()]
    return records
