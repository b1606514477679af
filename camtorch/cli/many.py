"""Commands on many files: what the options of `many_files` mean, and what is said of what became of the files."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from camtorch.cli.terminal import bar, note, say
from camtorch.jobs.items import Item, Shard, Work
from camtorch.jobs.run import Account, Report, hashes_of, run


def output_folder(text: str | Path | None) -> Path:
    """Where files go, by what -o says."""
    if text is None:
        raise ValueError("into which folder? -o OUT/ names it, for several images or a folder of them")
    path = Path(text)
    if os.path.lexists(path) and not path.is_dir():
        raise ValueError(f"{path}: is no folder, which -o names for several images or a folder of them")
    return path


def shard_of(arguments: argparse.Namespace) -> Shard:
    """The part of all files that this process has."""
    return arguments.shard or Shard.of_environment()


def carry_out(
    items: Sequence[Item],
    work: Work,
    account: Account,
    arguments: argparse.Namespace,
    told: Callable[[Report], str] = lambda report: "",
) -> int:
    """Have the items of this shard made, and say what became of them: notes and failures on stderr, numbers on stdout.

    What `told` adds of what was made begins with a comma, if it is anything.

    Returns:
        The exit status: 0, or 1 where anything failed.
    """
    shard = account.shard
    if arguments.dry_run:
        known = [item for item in items if arguments.resume and account.standing(item, None)]
        kept = {item for item in known if account.standing(item, hashes_of(item))}
        todo = [item for item in items if item not in kept]
        for item in todo:
            line = f"{item.name} -> {', '.join(map(str, item.outputs))}"
            print(line.encode(errors="backslashreplace").decode())  # names of files may be no text
        print(f"{len(todo)} to be made, {len(kept)} there already")
        return 0
    part = "" if shard.count == 1 else f", shard {shard.rank + 1} of {shard.count}"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    processes = min(arguments.jobs or max(cores // shard.local, 1), max(len(items), 1))
    options = {"processes": processes, "resume": arguments.resume, "force": arguments.force}
    try:
        with bar(f"{arguments.command}{part}", len(items), "files") as shown:
            report = run(items, work, account, **options, done=shown.update)
    except FileExistsError as error:
        raise ValueError(f"{error}; --resume goes on where a run was broken off, --force overwrites") from None
    except ChildProcessError as error:
        raise ValueError(f"{error}; --resume goes on where it was broken off, --jobs 1 needs the least") from None
    for text, names in report.notes.items():
        note(f"{names[0]} {text}" if len(names) == 1 else f"{names[0]} and {len(names) - 1} more: {text}")
    for name, why in report.failed.items():
        say(f"error: {name}: {why}")
    parts = [f"{report.made} of {len(items)} files made{told(report)}"]
    parts += [f"{report.kept} were there already"] if report.kept else []
    parts += [f"{len(report.failed)} failed"] if report.failed else []
    print(f"{account.folder}{part}: {'; '.join(parts)}")
    return 1 if report.failed else 0
