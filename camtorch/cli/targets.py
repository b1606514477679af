"""Input and output files of a command: output files that cannot be written are refused before the work."""

import glob
import os
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import takewhile
from pathlib import Path

from camtorch.boards.finding import natural
from camtorch.cli.processes import Pair


def check(path: Path, *, force: bool, inputs: tuple[Path | None, ...] = ()) -> None:
    """Raise a ValueError if a file cannot be written, is an input (also by a link), or exists and `force` is false."""
    if path.is_dir():
        raise ValueError(f"{path}: must be a file; got a folder. Name a file in it")
    for given in inputs:
        if given is not None and path.exists() and given.exists() and path.samefile(given):
            raise ValueError(f"{path}: would overwrite {given}, which is read. Name another file")
    if os.path.lexists(path) and not force:
        raise ValueError(f"{path}: exists already; --force overwrites it")
    folder = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
    if not (folder.is_dir() and os.access(folder, os.W_OK)):
        raise ValueError(f"{path}: {folder} must be a folder that can be written; got another")


def folder(text: str | None, suffixes: Collection[str]) -> Path:
    """Return the folder of -o, for files of these suffixes."""
    if text is None:
        raise ValueError("-o must be given. Write -o OUT/ for several images, -o out.png for one, and --camera FILE")
    path = Path(text)
    if os.path.lexists(path) and not path.is_dir():
        raise ValueError(f"{path}: -o must be a folder for several images or a folder of them; got a file")
    if path.suffix.lower() in suffixes and not path.exists() and not text.endswith(("/", os.sep)):
        raise ValueError(f"{path}: -o must be a folder for several files; got a file name. Write -o OUT/")
    return path


def find(words: Sequence[str], suffixes: Collection[str], output: Path) -> list[tuple[Path, Path]]:
    """Return the files that words mean, each once, in natural order, and their places in the folder of outputs.

    Words are files of any suffix; quoted patterns, as 'in/**/*.jpg'; and folders, whose tree is kept, in a folder of
    their name if there are several words. Names that begin with a dot, links to folders in a folder, and the folder of
    outputs itself, are skipped.
    """
    files: dict[str, tuple[Path, Path]] = {}
    out = os.path.realpath(output)
    for word in words:
        root, place = Path(word), Path()
        if root.is_dir():
            place, paths = Path(root.resolve().name) if len(words) > 1 else place, _below(root)
        elif os.path.lexists(root):
            files[os.path.realpath(root)] = root, Path(root.name)
            continue
        elif glob.has_magic(word):
            # links in a circle make paths of any length to the same file: the shortest path comes last and wins
            paths = iter(sorted(map(Path, glob.iglob(word, recursive=True)), key=lambda one: -len(one.parts)))
            root = Path(*takewhile(lambda part: not glob.has_magic(part), root.parts))
        else:
            raise ValueError(f"{word}: no such file or folder")
        apart = _is_below(os.path.realpath(root), out)
        # a link to a missing file is kept, so that an error names it; a pipe is not
        found = {
            os.path.realpath(one): (one, place / one.relative_to(root))
            for one in paths
            if one.suffix.lower() in suffixes
            and (one.is_file() or not os.path.exists(one))
            and (apart or not _is_below(os.path.realpath(one), out))
        }
        if not found:
            raise ValueError(f"{word}: must hold files that end in {', '.join(sorted(suffixes))}; got none")
        files |= found
    return sorted(files.values(), key=lambda found: natural(found[0]))


def _below(root: Path) -> Iterator[Path]:
    """Yield the files in a folder and its subfolders."""

    def refuse(error: OSError) -> None:
        raise error

    for name, folders, names in os.walk(root, onerror=refuse):
        folders[:] = [one for one in folders if not one.startswith(".")]
        yield from (Path(name, one) for one in names if not one.startswith("."))


def _is_below(path: str, folder: str) -> bool:
    return path == folder or path.startswith(os.path.join(folder, ""))


def _key(path: Path) -> str:
    """Return the same text for all names of a file; Windows and macOS do not distinguish a.png from A.png."""
    name = os.path.realpath(path)
    return name.casefold() if sys.platform in ("win32", "darwin") else name


def to_make(pairs: Sequence[Pair], others: Iterable[Path], *, resume: bool, force: bool) -> list[Pair]:
    """Return the pairs whose files must be made; with `resume` existing files are left out.

    An empty file, as after a loss of power, is made again. It raises a ValueError if files would overwrite each other
    or a file that is read, also one of `others`; or if a file exists already.
    """
    read = {_key(path): path for path in (*(source for source, _ in pairs), *others)}
    written: dict[str, Path] = {}
    for source, target in pairs:
        place = _key(target)
        if place in written:
            raise ValueError(f"{written[place]} and {source} would both be written to {target}")
        if place in read:
            raise ValueError(f"{target}: would overwrite {read[place]}, which is read. Name another folder")
        written[place] = source
    if resume:
        return [(source, target) for source, target in pairs if not (target.is_file() and target.stat().st_size)]
    there = [target for _, target in pairs if os.path.lexists(target)]
    if there and not force:
        more = f", and {len(there) - 1} more of {len(pairs)}" if len(there) > 1 else ""
        hint = "--resume continues the run, --force overwrites"
        raise ValueError(f"{there[0]}: exists already{more}; {hint}")
    return list(pairs)
