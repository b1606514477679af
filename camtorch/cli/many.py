"""Commands on many files: what the options of `add_jobs` mean, and how it is told what became of the files."""

from __future__ import annotations

import argparse
import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from camtorch.cli.terminal import bar, note, say
from camtorch.jobs import run
from camtorch.jobs.items import Item, Json, Shard, Work
from camtorch.jobs.manifest import Manifest
from camtorch.jobs.run import Report


def output_folder(text: str | None) -> Path:
    """Where files go.

    Args:
        text: what -o says.

    Raises:
        ValueError: nothing, or what is no folder.
    """
    if text is None:
        raise ValueError("into which folder? -o OUT/ names it, for several images or a folder of them")
    path = Path(text)
    if os.path.lexists(path) and not path.is_dir():
        raise ValueError(f"{path}: is no folder, which -o names for several images or a folder of them")
    return path


def shard_of(arguments: argparse.Namespace) -> Shard:
    """Which part of the files this process makes: what --shard says, or else torchrun or srun.

    Raises:
        ValueError: see `Shard.of_environment`.
    """
    shard: Shard = arguments.shard or Shard.of_environment()
    return shard


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
) -> tuple[int, Report | None]:
    """Have items made, and say what became of them: notes and failures on stderr, numbers on stdout.

    Args:
        items: of this shard.
        faults: what there is to report beside.
        work: makes one.
        manifest: of this shard; not yet open.
        arguments: with `jobs`, `resume`, `shard`, `dry_run` and `force`.
        doing: what goes on, as "dewarping".
        units: of `Item.size`, in the plural.
        told: what more is to be said of what was made; if anything, it begins with a comma.

    Returns:
        The exit status: 0, or 1 where anything failed; and the report, None after a dry run.

    Raises:
        ValueError: outputs exist, and it is not said what is to become of them.
    """
    if arguments.dry_run:
        return _dry_run(items, faults, manifest, arguments.resume), None
    shard = manifest.shard
    part = "" if shard.count == 1 else f", shard {shard.rank + 1} of {shard.count}"
    try:
        with manifest, bar(doing + part, int(sum(item.size for item in items)), units) as shown:

            def watch(done: float, kept: float) -> None:
                shown.initial = int(kept)  # which took no time
                shown.update(int(done) - shown.n)

            report = run.run(
                items,
                work,
                manifest,
                processes=min(arguments.jobs or _cores(shard), max(len(items), 1)),
                resume=arguments.resume,
                force=arguments.force,
                watch=watch,
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
    if report.kept:
        parts.append(f"{report.kept} were there already")
    if failed:
        parts.append(f"{len(failed)} failed")
    print(f"{manifest.folder}{part}: {'; '.join(parts)}")
    unmarked = "" if arguments.shard else Shard.unmarked()
    if unmarked:  # the command says warnings last
        warnings.warn(
            f"{unmarked} is set, but not by torchrun or srun, and was not heeded: all files were asked for; --shard "
            "1/4 makes the first of four parts",
            stacklevel=2,
        )
    return (1 if failed else 0), report


def _dry_run(items: Sequence[Item], faults: Sequence[tuple[Path, str]], manifest: Manifest, resume: bool) -> int:
    count = 0
    for item in run.pending(items, manifest, resume=resume):
        line = f"{item.name} -> {', '.join(map(str, item.outputs))}"
        print(line.encode(errors="backslashreplace").decode())  # names of files may be no text
        count += 1
    for path, why in faults:
        say(f"error: {path}: {why}")
    print(f"{count} to be made, {len(items) - count} there already")
    return 1 if faults else 0


def _cores(shard: Shard) -> int:
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(own // shard.local, 1)


def same(results: Sequence[Json]) -> Json | None:
    """The one result of all, if there is one."""
    return results[0] if results and all(result == results[0] for result in results) else None
