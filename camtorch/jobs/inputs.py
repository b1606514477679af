"""Which files a command line means by files, patterns and folders, and where what is made of them goes."""

from __future__ import annotations

import glob
import os
import re
import stat
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

IMAGES = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"})
"""Suffixes, in lower case, of what is taken of a folder."""


@dataclass(frozen=True)
class Found:
    """A file to be read."""

    path: Path
    place: Path
    """Relative to the folder of outputs."""


@dataclass
class Inputs:
    """What was found."""

    files: list[Found] = field(default_factory=list)
    faults: list[tuple[Path, str]] = field(default_factory=list)
    """What could not be looked into, and why."""


def natural(path: Path) -> list[tuple[int, int, str]]:
    """A key to sort by that has 2 before 10."""
    parts = re.split(r"(\d+)", str(path))
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in parts]


def find(words: Sequence[str], suffixes: Collection[str], output: Path) -> Inputs:
    """Files, each once, in natural order.

    Args:
        words: files, whatever their suffix; patterns, as a quoted 'in/**/*.jpg', of files with any of the suffixes;
            folders, of which files with any of the suffixes are taken, and those of all folders in them. What begins
            with a dot is left out. Links are followed.
        suffixes: in lower case.
        output: the folder of outputs, of which nothing is taken where it lies within a folder that is read.

    Returns:
        Files with their places: below a folder that is read, or the folder before the first wildcard of a pattern, the
        tree is kept; of several words folders keep their names as well.

    Raises:
        ValueError: a word that means no file.
    """
    inputs = Inputs()
    for word in words:
        path = Path(word)
        if path.is_dir():
            place = Path(path.resolve().name) if len(words) > 1 else Path()
            found = _below(path, place, suffixes, output, inputs.faults)
        elif os.path.lexists(path) or not glob.has_magic(word):
            if not os.path.lexists(path):
                raise ValueError(f"{path}: no such file or folder")
            found = [Found(path, Path(path.name))]
        else:
            found = _matching(word, suffixes, output)
            if not found:
                raise ValueError(f"{word}: no file of a known type has such a name")
        inputs.files += found
    once = {os.path.abspath(found.path): found for found in inputs.files}
    inputs.files = sorted(once.values(), key=lambda found: natural(found.path))
    if not inputs.files and not inputs.faults:
        raise ValueError(f"{', '.join(words)}: nothing in there ends in {', '.join(sorted(suffixes))}")
    return inputs


def _below(
    root: Path, place: Path, suffixes: Collection[str], output: Path, faults: list[tuple[Path, str]]
) -> list[Found]:
    """What is in a folder, and in those in it."""
    found: list[Found] = []
    out = os.path.realpath(output)
    walk = os.walk(root, followlinks=True, onerror=lambda error: faults.append((Path(error.filename), _reason(error))))
    for name, folders, names in walk:
        folder, real = Path(name), os.path.realpath(name)
        inside = []
        for one in sorted(folders):
            target = os.path.realpath(folder / one)
            if one.startswith(".") or target == out:
                continue
            if _is_below(real, target):
                faults.append((folder / one, "a link to a folder that it lies in"))
            else:
                inside.append(one)
        folders[:] = inside
        for path in (folder / one for one in names if not one.startswith(".")):
            if path.suffix.lower() not in suffixes:
                continue
            try:
                if stat.S_ISREG(os.stat(path).st_mode):
                    found.append(Found(path, place / path.relative_to(root)))
                else:
                    faults.append((path, "not an ordinary file"))
            except OSError as error:
                faults.append((path, _reason(error)))
    return found


def _reason(error: OSError) -> str:
    return error.strerror or str(error)


def _matching(pattern: str, suffixes: Collection[str], output: Path) -> list[Found]:
    parts = Path(pattern).parts
    before = next(i for i, part in enumerate(parts) if glob.has_magic(part))
    root = Path(*parts[:before])
    out, real_root = os.path.realpath(output), os.path.realpath(root)
    inside = not _is_below(real_root, out)
    shortest: dict[str, Path] = {}  # links in a circle make paths of any length
    for path in sorted(
        map(Path, glob.glob(pattern, recursive=True)), key=lambda path: (len(path.parts), natural(path))
    ):
        real = os.path.realpath(path)
        if path.suffix.lower() in suffixes and path.is_file() and not (inside and _is_below(real, out)):
            shortest.setdefault(real, path)
    return [Found(path, path.relative_to(root)) for path in shortest.values()]


def _is_below(path: str, folder: str) -> bool:
    return path == folder or path.startswith(os.path.join(folder, ""))
