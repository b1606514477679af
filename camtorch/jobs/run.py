"""A job: items are made by processes, a manifest keeps account, and a report says what became of them."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from camtorch.io.writing import all_left_over
from camtorch.jobs import pool
from camtorch.jobs.inputs import hash_of
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
    results: list[Json] = field(default_factory=list)
    """What `Work` returned, now or then."""


def run(
    items: Sequence[Item],
    work: Work,
    manifest: Manifest,
    *,
    processes: int = 1,
    resume: bool = False,
    force: bool = False,
    add: Callable[[int], object] = lambda part: None,
) -> Report:
    """Have items made.

    With `resume`, what the manifest knows is kept, where inputs, settings and outputs are those it says, and what else
    the job had begun is made anew; with `force` also what it did not begin is overwritten. `add` is told how much more
    of the items' sizes is done. With one of `processes` it is this one that works.

    Raises:
        FileExistsError: outputs exist, and neither `resume` nor `force`. As `pool.run`.
    """
    there = [path for item in items for path in item.outputs if os.path.lexists(path)]
    if there and not (resume or force):
        more = f", and {len(there) - 1} more of {sum(len(item.outputs) for item in items)}" if len(there) > 1 else ""
        raise FileExistsError(f"{there[0]}: exists already{more}")
    report, failed = Report(), dict[Item, str]()

    def tasks() -> Iterator[_Task]:
        for item in items:
            if not manifest.has_begun(item):
                if not force and any(map(os.path.lexists, item.outputs)):
                    failed[item] = f"{item.outputs[0]} exists already, and is not of this job"
                    add(item.size)
                    continue
                manifest.begin(item)
            yield _Task(item, manifest.records(item) if resume else [])

    def plain(item: Item, text: str) -> str:
        return text.removeprefix(item.name).lstrip(": ")

    _remove_left_over(items)
    try:
        attempt = _Attempt(work, manifest.settings)
        with contextlib.closing(pool.run(attempt, tasks(), processes, add)) as outcomes:
            for (item, _), (record, is_new, failure, notes) in outcomes:
                for text in notes:
                    report.notes.setdefault(plain(item, text), []).append(item.name)
                if record is None:
                    failed[item] = plain(item, failure)
                    continue
                report.results.append(record["result"])
                report.made, report.kept = report.made + is_new, report.kept + (not is_new)
                if is_new:
                    manifest.made(item, record)
    except BaseException:
        _remove_left_over(items)
        raise
    report.failed = [(item.name, failed[item]) for item in items if item in failed]
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
    """By which its outputs may be as they should already."""

    def __str__(self) -> str:
        return self.item.name


class _Outcome(NamedTuple):
    record: dict[str, Json] | None
    """For the manifest; None of what failed."""
    is_new: bool
    failure: str
    notes: list[str]


@dataclass(frozen=True)
class _Attempt:
    """What processes do with a task."""

    work: Work
    settings: str

    def __call__(self, task: _Task, add: Callable[[int], object]) -> _Outcome:
        (item, records), notes, done = task, list[str](), 0

        def advance(to: int) -> None:
            nonlocal done
            add(min(to, item.size) - done)
            done = min(to, item.size)

        try:
            terms = _terms(item, self.settings)
            known = _standing(item, records, terms)
            if known is not None:
                return _Outcome(known, False, "", notes)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", UserWarning)
                result = self.work(item, Listener(notes.append, advance))
            notes += dict.fromkeys(str(warning.message) for warning in caught)
            return _Outcome({**terms, "hashes": list(map(hash_of, item.outputs)), "result": result}, True, "", notes)
        except Exception as error:
            return _Outcome(None, False, pool.reason(error), notes)
        finally:
            advance(item.size)


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
