"""Memory of the whole process at the peak of a warp, whoever allocates it: `python -m benchmarks.footprint`.

The system's account, in a process of its own, so that nothing that was freed before can serve a call unseen. It covers
what torch's allocator does not see: OpenCV, and native code. Where the system keeps no such account (it is Linux's),
nothing is measured.
"""

from __future__ import annotations

import ctypes
import gc
import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks.image_peers import CACHED, CLONE, DELTACAMERA, FRESH, Task, contestants
from benchmarks.options import Options, complain, progress
from benchmarks.tables import Record
from benchmarks.timing import Run
from camtorch.native import memory

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_ROOT = Path(__file__).resolve().parents[1]
_PATIENCE = 120.0  # seconds


def measured(tasks: Iterable[Task], options: Options) -> list[Record]:
    """The peaks of warps of tasks, in sizes of their results, of everyone's cached and fresh maps."""
    if options.device.type != "cpu" or not _RESET.exists():
        return []
    progress("memory at the peak of warps")
    asked = [_packed(task) for task in tasks]
    order = json.dumps({"threads": options.threads, "tasks": asked})
    command = [sys.executable, "-m", "benchmarks.footprint"]
    try:
        done = subprocess.run(
            command, input=order, capture_output=True, text=True, cwd=_ROOT, timeout=_PATIENCE, check=True
        )
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        complain(f"memory at the peak of warps: failed: {error}\n{error.stderr or ''}")
        return []
    return [Record(*row) for row in json.loads(done.stdout)]


def _packed(task: Task) -> list:
    return [task.key, task.batch, task.channels, task.size, str(task.dtype).removeprefix("torch."), task.last]


def main() -> None:
    """Measure what stdin asks for, and write records to stdout."""
    order = json.load(sys.stdin)
    torch.set_num_threads(order["threads"])
    cv2.setNumThreads(order["threads"])
    records: list[tuple] = []
    for key, batch, channels, size, dtype, last in order["tasks"]:
        task = Task(key, batch, channels, tuple(size), getattr(torch, dtype), torch.device("cpu"), last)
        records += [
            (task.name, who, operation, "peak", peak(operations[operation]))
            for who, operations in contestants(task).items()
            for operation in (CACHED, FRESH)
            if operation in operations and who not in (CLONE, DELTACAMERA)
        ]
    json.dump(records, sys.stdout)


def peak(run: Run) -> float:
    """The most that a call adds to the memory of this process, in sizes of its result; what it keeps was there."""
    for _ in range(2):
        run()
    gc.collect()
    _trim()
    _RESET.write_text("5")  # the peak is what there is now
    before = _status("VmRSS")
    result = run()
    most = _status("VmHWM")
    return (most - before) / _size(result)


def _size(result: Tensor | list[np.ndarray]) -> int:
    return sum(part.nbytes for part in ([result] if isinstance(result, Tensor) else result))


def _status(name: str) -> int:
    """Bytes."""
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(f"{name}:"))
    return int(line.split()[1]) * 1024


def _trim() -> None:
    """Have camtorch and the C library give back what they hold for the next allocations: those would be no new ones."""
    memory.release()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


if __name__ == "__main__":
    main()
