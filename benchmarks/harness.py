"""How everything is measured and shown: contestants take turns, and a table names who takes part."""

import argparse
import gc
import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path
from typing import NamedTuple

import cv2
import torch

import camtorch
from camtorch.native import library

Run = Callable[[], object]
OURS, OPENCV, KORNIA = "camtorch", "OpenCV", "kornia"
NAMES = {"kannala_brandt": "Kannala-Brandt", "brown_conrady": "Brown-Conrady", "fisheye624": "Fisheye624"}
"""Models as rows of tables call them, where that is not the key."""

_SHORTEST = 2e-3  # seconds: shorter calls are timed several at a time, as reading the clock takes a part of them
_FEWEST = 3  # rounds


class Options(argparse.Namespace):
    """One run: what `python -m benchmarks --help` lists."""

    device: torch.device

    def chosen(self, keys: tuple[str, ...]) -> tuple[str, ...]:
        """Return those of a subject's models that were asked for."""
        return tuple(key for key in keys if not self.model or key in self.model)


class Figure(NamedTuple):
    """What a contestant takes in one row; the spread is the distance of the quartiles over the median."""

    median: float
    spread: float | None = None


class Row(NamedTuple):
    """One row of a table."""

    table: str
    name: str
    figures: Mapping[str, Figure]


@dataclass(frozen=True)
class Table:
    """Who is shown, and how: for each heading the best of its contestants, times `scale`.

    Headings in `alone` have no "(1.5x)" beside the figure; None stands for all. `rate` means that more is better.
    """

    name: str
    title: str
    columns: Mapping[str, tuple[str, ...]]
    scale: float = 1e3
    alone: tuple[str, ...] | None = ()
    rate: bool = False

    def markdown(self, rows: Mapping[str, Mapping[str, Figure]], *, spread: bool = False) -> str:
        """Return the table; (1.5x) means 1.5 times camtorch's time. With `spread` as ±."""
        lines = [f"| {self.title} | {' | '.join(self.columns)} |", "|---|" + "---:|" * len(self.columns)]
        for name, figures in rows.items():
            cells = [self._cell(heading, figures, spread) for heading in self.columns]
            lines.append(f"| {name} | {' | '.join(cells)} |")
        return "\n".join(lines)

    def _cell(self, heading: str, figures: Mapping[str, Figure], spread: bool) -> str:
        found = [figures[who] for who in self.columns[heading] if who in figures]
        if not found:
            return "-"
        best = (max if self.rate else min)(found)
        text = digits(best.median * self.scale)
        if spread and best.spread is not None:
            text += f" ±{best.spread:.0%}"
        if heading == OURS or self.alone is None or heading in self.alone or OURS not in figures:
            return text
        ratio = best.median / figures[OURS].median
        return f"{text} ({f'{ratio:.0f}' if ratio >= 9.95 else f'{ratio:.1f}'}x)"


def digits(value: float) -> str:
    """Return two digits, and whole numbers from ten on."""
    if value == 0 or value >= 9.95:
        return f"{value:.0f}"
    return f"{value:.1f}" if value >= 0.095 else f"{value:.2f}" if value >= 0.005 else f"{value:.1e}"


def measure(table: str, name: str, runs: Mapping[str, Run], options: Options, *, shortest: float = _SHORTEST) -> Row:
    """Time the contestants of one row in turns.

    Each round calls everyone, there and back, so that a neighbour's load, the clock frequency and the caches are the
    same for all. Each has an equal share of `options.seconds`; who has used it up sits out the rounds that are left,
    after three at least. Who raises is left out, and named on stderr. Calls shorter than `shortest` are timed several
    at a time.
    """
    calls = {}
    for who, run in runs.items():
        progress(f"{table}: {name}: first call of {who}")
        try:
            run()
            calls[who] = max(1, math.ceil(shortest / clocked(run, options.device)))
        except Exception as error:
            progress(f"{name}: {who} failed: {type(error).__name__}: {str(error).splitlines()[:1]}")
    rounds: dict[str, list[float]] = {who: [] for who in calls}
    share = options.seconds / max(len(calls), 1)
    gc.collect()
    gc.disable()
    try:
        for turn in range(options.repeats):
            progress(f"{table}: {name}: round {turn + 1} of {options.repeats}, {len(calls)} contestants")
            for who in list(calls)[:: 1 if turn % 2 == 0 else -1]:
                if turn < _FEWEST or calls[who] * sum(rounds[who]) < share:
                    rounds[who].append(clocked(runs[who], options.device, calls[who]))
    finally:
        gc.enable()
    return Row(table, name, {who: figure(taken) for who, taken in rounds.items()})


def clocked(run: Run, device: torch.device | None = None, calls: int = 1) -> float:
    """Return the seconds of a call, including what a GPU has yet to finish."""
    wait = torch.cuda.synchronize if device is not None and device.type == "cuda" else (lambda: None)
    wait()
    start = time.perf_counter()
    for _ in range(calls):
        run()
    wait()
    return (time.perf_counter() - start) / calls


def figure(rounds: list[float]) -> Figure:
    """Return the median and the spread of the rounds."""
    median = statistics.median(rounds)
    low, _, high = statistics.quantiles(rounds, n=4, method="inclusive") if len(rounds) > 1 else (median,) * 3
    return Figure(median, (high - low) / median)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Set the threads of torch, camtorch with it, and OpenCV; then as many as before."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


def progress(text: str) -> None:
    """Write to stderr what is being measured."""
    print(text, file=sys.stderr, flush=True)


def machine(device: torch.device) -> dict[str, str | int]:
    """Return what has to be known to compare figures with another run's; call it after the threads are set."""
    facts: dict[str, str | int] = {
        "cpu": _cpu(),
        "cores": os.cpu_count() or 1,
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "camtorch": camtorch.__version__,
        "library": library.state(),
        "OpenCV": cv2.__version__,
    }
    installed = {one.name: one.version for one in distributions()}
    facts |= {name: installed.get(name, "not installed") for name in ("kornia", "deltacamera", "albumentations")}
    return facts | ({"gpu": torch.cuda.get_device_name(device)} if device.type == "cuda" else {})


def _cpu() -> str:
    """Return the processor's name, family and model: a virtual machine may hide the name."""
    listing = Path("/proc/cpuinfo")
    if not listing.exists():
        return platform.processor() or platform.machine()
    pairs = (line.split(":", 1) for line in listing.read_text().splitlines() if ":" in line)
    facts = {name.strip(): fact.strip() for name, fact in pairs}
    name = facts.get("model name", platform.machine())
    family, model = (facts.get(part, "?") for part in ("cpu family", "model"))
    return f"{name} (family {family}, model {model}; {torch.backends.cpu.get_cpu_capability()})"
