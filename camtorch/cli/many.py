"""Commands on many files: what the options of `add_jobs` mean, and what is said of what became of the files."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from camtorch.cli.terminal import bar, note, say
from camtorch.jobs import run
from camtorch.jobs.items import Item, Work
from camtorch.jobs.manifest import Manifest
from camtorch.jobs.run import Report


def output_folder(text: str | None) -> Path:
    """Where files go, by what -o says."""
    if text is None:
        raise ValueError("into which folder? -o OUT/ names it, for several images or a folder of them")
    path = Path(text)
    if os.path.lexists(path) and not path.is_dir():
        raise ValueError(f"{path}: is no folder, which -o names for several images or a folder of them")
    return path


def carry_out(
    items: Sequence[Item],
    faults: Sequence[tuple[Path, str]],
    work: Work,
    manifest: Manifest,
    arguments: argparse.Namespace,
    *,
    doing: str,
    units: str,
    told: Callable[[Report], str] = lambda report: "",
) -> int:
    """Have items made, and say what became of them: notes and failures on stderr, numbers on stdout.

    Items and the manifest, which is not yet open, are those of this shard; faults are what the first shard reports
    beside. `doing` is what goes on, as "dewarping", `units` are those of `Item.size`; what `told` adds of what was made
    begins with a comma, if it is anything.

    Returns:
        The exit status: 0, or 1 where anything failed.
    """
    shard = manifest.shard
    faults = faults if shard.rank == 0 else []
    if arguments.dry_run:
        return _dry_run(items, faults, manifest, arguments.resume)
    part = "" if shard.count == 1 else f", shard {shard.rank + 1} of {shard.count}"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        with manifest, bar(doing + part, sum(item.size for item in items), units) as shown:
            report = run.run(
                items,
                work,
                manifest,
                processes=min(arguments.jobs or max(cores // shard.local, 1), max(len(items), 1)),
                resume=arguments.resume,
                force=arguments.force,
                add=shown.update,
            )
    except FileExistsError as error:
        raise ValueError(f"{error}; --resume goes on where it was broken off, --force overwrites") from None
    except ChildProcessError as error:
        raise ValueError(f"{error}; --resume goes on where it was broken off, --jobs 1 needs the least") from None
    for text, names in report.notes.items():
        note(f"{names[0]} {text}" if len(names) == 1 else f"{names[0]} and {len(names) - 1} more: {text}")
    failed = [*((str(path), why) for path, why in faults), *report.failed]
    for name, why in failed:
        say(f"error: {name}: {why}")
    parts = [f"{report.made} of {len(items) + len(faults)} files made{told(report)}"]
    parts += [f"{report.kept} were there already"] if report.kept else []
    parts += [f"{len(failed)} failed"] if failed else []
    print(f"{manifest.folder}{part}: {'; '.join(parts)}")
    return 1 if failed else 0


def _dry_run(items: Sequence[Item], faults: Sequence[tuple[Path, str]], manifest: Manifest, resume: bool) -> int:
    todo = list(run.pending(items, manifest, resume=resume))
    for item in todo:
        line = f"{item.name} -> {', '.join(map(str, item.outputs))}"
        print(line.encode(errors="backslashreplace").decode())  # names of files may be no text
    for path, why in faults:
        say(f"error: {path}: {why}")
    print(f"{len(todo)} to be made, {len(items) - len(todo)} there already")
    return 1 if faults else 0
