"""A job: items are made by processes, an account says of what, and a report what became of them.

The account is a file of JSON lines in the folder of outputs, `.camtorch-JOB.jsonl`, and one for each shard. A line says
of what an item was made: hashes of its inputs, its variant, and a hash of the settings. Outputs appear whole, and
before their line; so an item whose line fits is as it would be made anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from camtorch.io.writing import all_left_over
from camtorch.jobs.inputs import hash_of
from camtorch.jobs.items import Item, Json, Shard, Work
from camtorch.jobs.processes import each, reason


class Account:
    """What a kind of job has made in a folder, that of its outputs, by all shards.

    `settings` are all that outputs depend on beside their inputs, JSON.
    """

    folder: Path
    shard: Shard
    has_begun: bool

    def __init__(self, folder: Path, job: str, settings: Json, shard: Shard):
        self.folder, self.shard, self._job = folder, shard, job
        self._settings = hashlib.blake2b(json.dumps(settings, sort_keys=True).encode(), digest_size=16).hexdigest()
        of = "" if shard.count == 1 else f"-{shard.rank}-of-{shard.count}"
        self._path, self._size = folder / f".camtorch-{job}{of}.jsonl", -1
        self.read()

    def read(self) -> bool:
        """Take up what all shards have said so far, of whatever number they were; is there more than before?"""
        self._records: dict[tuple[str, ...], list[dict[str, Json]]] = {}
        files = [path.read_bytes() for path in sorted(self.folder.glob(f".camtorch-{self._job}*.jsonl"))]
        size, self._size, self.has_begun = self._size, sum(map(len, files)), bool(files)
        for text in (text for content in files for text in content.splitlines()):
            with contextlib.suppress(ValueError, TypeError, AttributeError):  # cut off by a crash
                record = json.loads(text)
                if record.keys() >= {"outputs", "result"}:
                    self._records.setdefault(tuple(record["outputs"]), []).append(record)
        return self._size > size

    def add(self, record: dict[str, Json] | None = None) -> None:
        """Say what was made; nothing at all says that the job has begun."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with self._path.open("ab") as file:
            file.write(b"\n" + json.dumps(record).encode() if record else b"")

    def standing(self, item: Item, inputs: list[str] | None) -> dict[str, Json] | None:
        """The line by which an item's outputs are there as they would be made anew, of inputs with these hashes, or of
        any; or None.
        """
        records = self._records.get(self._names(item), [])
        if not records or not all(path.is_file() for path in item.outputs):
            return None
        terms = self.record(item, inputs)
        return next((record for record in reversed(records) if {**record, **terms} == record), None)

    def record(self, item: Item, inputs: list[str] | None) -> dict[str, Json]:
        """A line for an item whose outputs are there."""
        terms = {} if inputs is None else {"inputs": inputs}
        return terms | {
            "outputs": [*self._names(item)],
            "variant": item.variant,
            "settings": self._settings,
            "sizes": [path.stat().st_size for path in item.outputs],  # which a loss of power may have changed
        }

    def _names(self, item: Item) -> tuple[str, ...]:
        return tuple(path.relative_to(self.folder).as_posix() for path in item.outputs)


def hashes_of(item: Item) -> list[str]:
    """Of its inputs."""
    return list(map(hash_of, item.inputs))


@dataclass
class Report:
    """What became of items."""

    made: int = 0
    kept: int = 0
    """Those that were as they would be made anew."""
    failed: dict[str, str] = field(default_factory=dict)
    """Names, and why."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """What was noted, and of which items."""
    results: list[Json] = field(default_factory=list)
    """What `Work` returned, now or then."""


def run(
    items: Sequence[Item],
    work: Work,
    account: Account,
    *,
    processes: int = 1,
    resume: bool = False,
    force: bool = False,
    done: Callable[[], object] = lambda: None,
) -> Report:
    """Have items made.

    With `resume`, what the account knows is kept, where inputs and settings are those it says, and all else is made;
    with `force` everything is. `done` is called for each item. One of `processes` is this one.

    Raises:
        FileExistsError: outputs exist, and neither `force`, nor `resume` where the job had begun.
        ChildProcessError: a process was killed.
    """
    there = [path for item in items for path in item.outputs if os.path.lexists(path)]
    if there and not force and not (resume and account.has_begun):
        more = f", and {len(there) - 1} more of {sum(len(item.outputs) for item in items)}" if len(there) > 1 else ""
        raise FileExistsError(f"{there[0]}: exists already{more}")
    account.add()
    _remove_left_over(items)
    report, failed, attempt = Report(), dict[str, str](), _Attempt(work, account, resume)
    try:
        for item, outcome in each(attempt, items, processes, type(work).__module__):
            for text in outcome.notes:
                report.notes.setdefault(text.removeprefix(item.name).lstrip(": "), []).append(item.name)
            if outcome.record is None:
                failed[item.name] = outcome.failure.removeprefix(item.name).lstrip(": ")
            else:
                report.results.append(outcome.record["result"])
                report.made, report.kept = report.made + outcome.is_new, report.kept + (not outcome.is_new)
                if outcome.is_new:
                    account.add(outcome.record)
            done()
    finally:
        _remove_left_over(items)
    report.failed = {item.name: failed[item.name] for item in items if item.name in failed}
    return report


def _remove_left_over(items: Iterable[Item]) -> None:
    """Remove the halves of files that a process which was killed left beside outputs."""
    for path in all_left_over(os.path.realpath(path) for item in items for path in item.outputs):
        with contextlib.suppress(OSError):
            os.unlink(path)


@dataclass
class _Outcome:
    record: dict[str, Json] | None = None
    """For the account; None of what failed."""
    is_new: bool = True
    failure: str = ""
    notes: list[str] = field(default_factory=list)


@dataclass
class _Attempt:
    """What is done with an item, wherever."""

    work: Work
    account: Account
    resume: bool

    def __call__(self, item: Item) -> _Outcome:
        outcome = _Outcome()
        try:
            inputs = hashes_of(item)
            known = self.account.standing(item, inputs) if self.resume else None
            if known is not None:
                return _Outcome(known, is_new=False)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", UserWarning)
                result = self.work(item)
            outcome.notes = list(dict.fromkeys(str(warning.message) for warning in caught))
            outcome.record = {**self.account.record(item, inputs), "result": result}
        except Exception as error:
            outcome.failure = reason(error)
        return outcome
