"""How everything is measured and shown: contestants take turns, and a table names who takes part."""

import argparse
import gc
import importlib
import math
import os
import platform
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import torch
from torch import Tensor

import camtorch
from camtorch.native import library

Run = Callable[[], object]
progress = partial(print, file=sys.stderr, flush=True)  # what is being measured
OURS, OPENCV, KORNIA = "camtorch", "OpenCV", "kornia"
OPENCV_MAPS = "OpenCV, float map", "OpenCV, fixed-point map"
WITHOUT_LIBRARY = "camtorch without its library"
NAMES = {"kannala_brandt": "Kannala-Brandt", "brown_conrady": "Brown-Conrady", "fisheye624": "Fisheye624"}
"""Models as rows of tables call them, where that is not the key."""


def _optional(name: str) -> Any:
    """Return a module, or None if it is not installed, or its binary is of another torch."""
    try:
        return importlib.import_module(name)
    except (ImportError, RuntimeError):
        return None


A, dc, kornia_rs = map(_optional, ("albumentations", "deltacamera", "kornia_rs"))
v2, tv = map(_optional, ("torchvision.transforms.v2", "torchvision.tv_tensors"))

_SHORTEST = 2e-3  # seconds: shorter calls are timed several at a time, as reading the clock takes a part of them
_FEWEST = 3  # rounds
_PEERS = ("kornia", "kornia_rs", "deltacamera", "albumentations", "albumentationsx", "torchvision")


class Options(argparse.Namespace):
    """One run: what `python -m benchmarks --help` lists."""

    device: torch.device

    def chosen(self, keys: tuple[str, ...]) -> tuple[str, ...]:
        """Return those of a subject's models that were asked for."""
        return tuple(key for key in keys if not self.model or key in self.model)


class Figure(NamedTuple):
    """What a contestant takes in one row: the median of its rounds, the fastest of them and the slowest."""

    median: float
    least: float | None = None
    most: float | None = None

    def times(self, factor: float) -> "Figure":
        """Return the figure in another unit."""
        return Figure(*(value and value * factor for value in self))


class Row(NamedTuple):
    """One row of a table."""

    table: str
    name: str
    figures: Mapping[str, Figure]  # none if the row was not asked for


Figures = Mapping[str, Figure]


@dataclass(frozen=True)
class Table:
    """Who is shown, and how: times `scale`, and as OpenCV the better of its two kinds of maps.

    Columns in `alone` do not compete; None stands for all. A `rate` is shown as so many in a second.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    scale: float = 1e3
    alone: tuple[str, ...] | None = ()
    rate: bool = False

    def markdown(self, runs: Sequence[Mapping[str, Figures]], *, spread: bool = False) -> str:
        """Return a table of the rows of runs side by side, and who is the fastest; with `spread` from min to max."""
        rows = {name: [run.get(name, {}) for run in runs] for run in runs for name in run}
        columns = (OURS, WITHOUT_LIBRARY, *self.columns[1:])
        headings = [who for who in columns if any(_best(who, figures) for row in rows.values() for figures in row)]
        title = headings if self.alone is None else [*headings, "fastest"]
        lines = [f"| {self.title} | {' | '.join(title)} |", "|---|" + "---:|" * len(title)]
        for name, row in rows.items():
            once = {WITHOUT_LIBRARY: row[-1:]}  # whose runs joined the last
            cells = [joined(self._cell(who, figures, spread) for figures in once.get(who, row)) for who in headings]
            if self.alone is not None:
                cells.append(joined(map(self.fastest, row)))
            lines.append(f"| {name} | {' | '.join(cells)} |")
        return "\n".join(lines)

    def rival(self, figures: Figures, ours: str = OURS) -> tuple[str, float] | None:
        """Return the fastest of the others, and how many times the time of camtorch it takes."""
        if self.alone is None or ours not in figures:
            return None
        peers = [who for who in self.columns if who not in (OURS, *self.alone)]
        found = [(best.median, who) for who in peers if (best := _best(who, figures))]
        return (min(found)[1], min(found)[0] / figures[ours].median) if found else None

    def fastest(self, figures: Figures, ours: str = OURS) -> str:
        """Return who is ahead, and of whom: of camtorch, or camtorch of the next."""
        if not (found := self.rival(figures, ours)):
            return ""
        who, ratio = found
        return f"camtorch {times(ratio)}" if ratio >= 1 else f"**{who} {times(1 / ratio)}**"

    def _cell(self, who: str, figures: Figures, spread: bool) -> str:
        if not (best := _best(who, figures)):
            return ""
        shown = [1 / value if self.rate else value * self.scale for value in best if value is not None]
        text, *ends = (digits(value) for value in shown)
        return f"{text} ({ends[-1 if self.rate else 0]}-{ends[0 if self.rate else -1]})" if spread and ends else text


def _best(who: str, figures: Figures) -> Figure | None:
    those = (who, *OPENCV_MAPS) if who == OPENCV else (who,)
    return min((figures[one] for one in those if one in figures), default=None)


def times(ratio: float) -> str:
    """Return a ratio, exact to a percent if it is small."""
    return f"{ratio:.0f}x" if ratio >= 9.95 else f"{ratio:.2f}x" if ratio < 1.045 else f"{ratio:.1f}x"


def joined(cells: Iterable[str]) -> str:
    """Return the cells of several runs as one, and a name that begins all of them once."""
    one, *more = [cell or "-" for cell in cells]
    name = "" if one.startswith("**") else one.rpartition(" ")[0] + " "
    same = [other.removeprefix(name) for other in more]
    return " / ".join([one, *same]) if {one, *more} != {"-"} else "-"


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
    runs = {WITHOUT_LIBRARY: runs[OURS]} if options.no_library else runs
    runs = runs if re.search(options.rows, name) else {}
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
            for who in list(calls)[:: 1 if turn % 2 == 0 else -1]:
                if turn < _FEWEST or calls[who] * sum(rounds[who]) < share:
                    rounds[who].append(clocked(runs[who], options.device, calls[who]))
    finally:
        gc.enable()
    return Row(table, name, {who: Figure(statistics.median(r), min(r), max(r)) for who, r in rounds.items()})


def step(forward: Callable[..., Tensor], *leaves: Tensor) -> Run:
    """Return what goes forward and backward, to all leaves; the gradient has the result's layout, as a loss's has."""
    leaves = tuple(leaf if leaf.requires_grad else leaf.clone().requires_grad_() for leaf in leaves)
    gradient = torch.ones_like(forward(*leaves))
    return lambda: torch.autograd.grad(forward(*leaves), leaves, gradient)


def clocked(run: Run, device: torch.device | None = None, calls: int = 1) -> float:
    """Return the seconds of a call, including what a GPU has yet to finish."""
    wait = torch.cuda.synchronize if device is not None and device.type == "cuda" else (lambda: None)
    wait()
    start = time.perf_counter()
    for _ in range(calls):
        run()
    wait()
    return (time.perf_counter() - start) / calls


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


def threaded(table: str, name: str, runs: Mapping[str, Run], options: Options, most: int) -> Iterator[Row]:
    """Measure with one thread, then with as many as there may be."""
    for count in sorted({1, most}):
        with threads(count):
            yield measure(table, f"{name}, {count} thread{'s' * (count > 1)}", runs, options)


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
    facts |= {one.name: one.version for one in distributions() if one.name in _PEERS}
    return facts | ({"gpu": torch.cuda.get_device_name(device)} if device.type == "cuda" else {})


def _cpu() -> str:
    """Return the processor's name, family and model: a virtual machine may hide the name."""
    listing = Path("/proc/cpuinfo")
    facts = dict(re.findall(r"^([\w ]+?)\s*: (.+)", listing.read_text(), re.M)) if listing.exists() else {}
    name = facts.get("model name", platform.processor() or platform.machine())
    family, model = (facts.get(part, "?") for part in ("cpu family", "model"))
    return f"{name} (family {family}, model {model}; {torch.backends.cpu.get_cpu_capability()})"
