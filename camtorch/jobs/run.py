"""A job: items are made by processes, a manifest keeps account, and a report says what became of them."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from camtorch.io.hashing import hash_of
from camtorch.io.writing import all_left_over
from camtorch.jobs import pool
from camtorch.jobs.items import Item, Json, Work, real_paths
from camtorch.jobs.manifest import Manifest, Terms


@dataclass
class Report:
    """What became of items."""

    made: int = 0
    kept: int = 0
    """Those that were as they would be made anew."""
    failed: list[tuple[str, str]] = field(default_factory=list)
    """Names, and why; in the order of items."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """What was noted, and of which items."""
    results: dict[Item, Json] = field(default_factory=dict)
    """What `Work` returned, now or then."""


@dataclass
class Progress:
    """How far a job is, in units of `Item.size`."""

    total: float
    done: float = 0.0
    """What was kept among it."""
    kept: float = 0.0


def run(
    items: Sequence[Item],
    work: Work,
    manifest: Manifest,
    *,
    processes: int = 1,
    resume: bool = False,
    force: bool = False,
    watch: Callable[[Progress], None] | None = None,
) -> Report:
    """Have items made.

    Args:
        items: see `items.check`.
        work: makes one; see there.
        manifest: open.
        processes: how many work; with one it is this one.
        resume: keep what the manifest knows, where inputs, settings and outputs are those it says; make anew what else
            the job had begun.
        force: overwrite what the job did not begin.
        watch: is told how far it is, whenever that changes.

    Raises:
        FileExistsError: outputs exist, and neither `resume` nor `force`. As `pool.run`.
    """
    there = [path for item in items for path in item.outputs if os.path.lexists(path)]
    if there and not (resume or force):
        more = f", and {len(there) - 1} more of {sum(len(item.outputs) for item in items)}" if len(there) > 1 else ""
        raise FileExistsError(f"{there[0]}: exists already{more}")
    for path in all_left_over(real_paths(path for item in items for path in item.outputs)):
        _unlink(path)
    report, progress = Report(), Progress(sum(item.size for item in items))
    parts: dict[Item, float] = {}
    failed: dict[Item, str] = {}

    def tasks() -> Iterator[_Task]:
        for item in items:
            history = manifest.history(item)
            if not history.begun:
                if not force and any(map(os.path.lexists, item.outputs)):
                    fail(item, f"{item.outputs[0]} exists already, and is not of this job")
                    continue
                manifest.begin(item)
            yield _Task(item, history.records if resume else [])

    def receive(task: _Task, kind: str, what: Json) -> None:
        item = task.item
        if kind == "failed":
            fail(item, what.removeprefix(item.name).lstrip(": "))
        elif kind == "done":
            record, is_new = what
            report.results[item] = record["result"]
            if is_new:
                manifest.made(record)
                report.made += 1
            else:
                report.kept += 1
                progress.kept += item.size
            advance(item, item.size)
        elif isinstance(what, str):
            report.notes.setdefault(what.removeprefix(item.name).lstrip(": "), []).append(item.name)
        else:
            advance(item, min(what, item.size))

    def fail(item: Item, reason: str) -> None:
        failed[item] = reason
        manifest.failed(item, reason)
        # by a process that died
        for path in all_left_over(real_paths(item.outputs)):
            _unlink(path)
        advance(item, item.size)

    def advance(item: Item, done: float) -> None:
        progress.done += done - parts.get(item, 0.0)
        parts[item] = done
        if watch is not None:
            watch(progress)

    pool.run(_Attempt(work, manifest.terms), tasks(), receive, processes=processes)
    report.failed = [(item.name, failed[item]) for item in items if item in failed]
    report.results = {item: report.results[item] for item in items if item in report.results}
    return report


def pending(items: Iterable[Item], manifest: Manifest, *, resume: bool = False) -> Iterator[Item]:
    """Those items that `run` would make, of a manifest that need not be open; nothing is written."""
    manifest.read()
    for item in items:
        records = manifest.history(item).records if resume else []
        if not records or manifest.terms.standing(item, records, _hashes(item)) is None:
            yield item


@dataclass(frozen=True)
class _Task:
    item: Item
    records: list[dict[str, Json]]
    """By which it may be as it should already."""


@dataclass(frozen=True)
class _Attempt:
    """What processes do with a task."""

    work: Work
    terms: Terms

    def __call__(self, task: _Task, tell: pool.Tell) -> tuple[dict[str, Json], bool]:
        item = task.item
        hashes = _hashes(item)
        record = self.terms.standing(item, task.records, hashes)
        if record is not None:
            return record, False
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            result = self.work(item, _Teller(tell))
        for text in dict.fromkeys(str(warning.message) for warning in caught):
            tell(text)
        return self.terms.record(item, hashes, result), True


@dataclass(frozen=True)
class _Teller:
    """A `Listener`."""

    tell: pool.Tell

    def note(self, text: str) -> None:
        self.tell(text)

    def done(self, size: float) -> None:
        self.tell(float(size))


def _hashes(item: Item) -> dict[str, str]:
    return {str(path): hash_of(path) for path in item.inputs}


def _unlink(path: str) -> None:
    with contextlib.suppress(OSError):
        os.unlink(path)
