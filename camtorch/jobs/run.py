"""A job: items are made by processes, a manifest keeps account, and a report says what became of them."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from camtorch.io.hashing import hash_of
from camtorch.io.writing import all_left_over
from camtorch.jobs import pool
from camtorch.jobs.items import Item, Json, Listener, Work
from camtorch.jobs.manifest import Manifest


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
    """What `Work` returned, now or then; in the order of items."""


def run(
    items: Sequence[Item],
    work: Work,
    manifest: Manifest,
    *,
    processes: int = 1,
    resume: bool = False,
    force: bool = False,
    watch: Callable[[float, float], None] = lambda done, kept: None,
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
        watch: is told how much of the items' sizes is done, and how much of that was kept, whenever that changes.

    Raises:
        FileExistsError: outputs exist, and neither `resume` nor `force`. As `pool.run`.
    """
    there = [path for item in items for path in item.outputs if os.path.lexists(path)]
    if there and not (resume or force):
        more = f", and {len(there) - 1} more of {sum(len(item.outputs) for item in items)}" if len(there) > 1 else ""
        raise FileExistsError(f"{there[0]}: exists already{more}")
    report = Report()
    failed: dict[Item, str] = {}
    done = kept = 0.0

    def add(part: float) -> None:
        nonlocal done
        done += part
        watch(done, kept)

    def tasks() -> Iterator[_Task]:
        for item in items:
            if not manifest.has_begun(item):
                if not force and any(map(os.path.lexists, item.outputs)):
                    failed[item] = f"{item.outputs[0]} exists already, and is not of this job"
                    add(item.size)
                    continue
                manifest.begin(item)
            yield _Task(item, manifest.records(item) if resume else [])

    _remove_left_over(items)
    try:
        attempt = _Attempt(work, manifest.settings)
        with contextlib.closing(pool.run(attempt, tasks(), processes, add)) as outcomes:
            for (item, _), outcome in outcomes:
                for text in outcome.notes:
                    report.notes.setdefault(text.removeprefix(item.name).lstrip(": "), []).append(item.name)
                if outcome.record is None:
                    failed[item] = outcome.failure.removeprefix(item.name).lstrip(": ")
                    continue
                report.results[item] = outcome.record["result"]
                if outcome.is_new:
                    manifest.made(item, outcome.record)
                    report.made += 1
                else:
                    report.kept += 1
                    kept += item.size
                    watch(done, kept)
    except BaseException:
        _remove_left_over(items)
        raise
    report.failed = [(item.name, failed[item]) for item in items if item in failed]
    report.results = {item: report.results[item] for item in items if item in report.results}
    return report


def pending(items: Iterable[Item], manifest: Manifest, *, resume: bool = False) -> Iterator[Item]:
    """Those items that `run` would make, of a manifest that need not be open; nothing is written."""
    manifest.read()
    for item in items:
        records = manifest.records(item) if resume else []
        if not records or _standing(item, records, _terms(item, manifest.settings)) is None:
            yield item


class _Task(NamedTuple):
    item: Item
    records: list[dict[str, Json]]
    """By which it may be as it should already."""

    def __str__(self) -> str:
        return self.item.name


@dataclass
class _Outcome:
    record: dict[str, Json] | None = None
    """For the manifest."""
    is_new: bool = True
    failure: str = ""
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Attempt:
    """What processes do with a task."""

    work: Work
    settings: str

    def __call__(self, task: _Task, add: Callable[[float], None]) -> _Outcome:
        item, outcome, done = task.item, _Outcome(), 0.0

        def advance(to: float) -> None:
            nonlocal done
            add(min(to, item.size) - done)
            done = min(to, item.size)

        try:
            terms = _terms(item, self.settings)
            outcome.record = _standing(item, task.records, terms)
            outcome.is_new = outcome.record is None
            if outcome.record is None:
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always", UserWarning)
                    result = self.work(item, Listener(outcome.notes.append, advance))
                outcome.notes += dict.fromkeys(str(warning.message) for warning in caught)
                outcome.record = {**terms, "hashes": list(map(hash_of, item.outputs)), "result": result}
        except Exception as error:
            outcome.failure = pool.reason(error)
        advance(item.size)
        return outcome


def _terms(item: Item, settings: str) -> dict[str, Json]:
    """All that an item's outputs depend on."""
    return {"inputs": list(map(hash_of, item.inputs)), "variant": item.variant, "settings": settings}


def _standing(item: Item, records: Sequence[dict[str, Json]], terms: dict[str, Json]) -> dict[str, Json] | None:
    """The record by which all outputs are there as they would be made anew, or None."""
    fitting = [record for record in records if {**record, **terms} == record]
    if not fitting or not all(path.is_file() for path in item.outputs):
        return None
    hashes = list(map(hash_of, item.outputs))
    return next((record for record in fitting if record.get("hashes") == hashes), None)


def _remove_left_over(items: Iterable[Item]) -> None:
    """Remove the halves of files that a process which was killed left beside outputs."""
    for path in all_left_over(os.path.realpath(path) for item in items for path in item.outputs):
        with contextlib.suppress(OSError):
            os.unlink(path)
