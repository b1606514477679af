"""Which files a command line means by files, patterns and folders, where what is made of them goes; and hashes."""

from __future__ import annotations

import glob
import hashlib
import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

IMAGES = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"})
"""Suffixes, in lower case, of what is taken of a folder."""


@dataclass(frozen=True)
class Found:
    """A file to be read."""

    path: Path
    place: Path
    """Relative to the folder of outputs."""


def natural(path: Path) -> list[tuple[int, int, str]]:
    """A key to sort by that has 2 before 10."""
    parts = re.split(r"(\d+)", str(path))
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in parts]


def find(words: Sequence[str], suffixes: Collection[str], output: Path) -> tuple[list[Found], list[tuple[Path, str]]]:
    """Files, each once, in natural order.

    Words are files, whatever their suffix; patterns, as a quoted 'in/**/*.jpg'; and folders, with all folders in them.
    What begins with a dot is left out, and what is in the folder of outputs, where that lies within a folder that is
    read. Links are followed.

    Returns:
        Files with their places: below a folder that is read, or the folder before the first wildcard of a pattern, the
        tree is kept; of several words folders keep their names as well. And folders that could not be looked into, and
        why.

    Raises:
        ValueError: a word that means no file.
    """
    files: list[Found] = []
    faults: list[tuple[Path, str]] = []
    for word in words:
        path, place = Path(word), Path()
        if path.is_dir():
            root, place = path, Path(path.resolve().name) if len(words) > 1 else place
            paths = list(_below(path, output, lambda e: faults.append((Path(e.filename), e.strerror or ""))))
        elif os.path.lexists(path):
            files.append(Found(path, Path(path.name)))
            continue
        elif glob.has_magic(word):
            root = Path(*takewhile(lambda part: not glob.has_magic(part), path.parts))
            paths = _matching(word, root, output)
        else:
            raise ValueError(f"{path}: no such file or folder")
        # a link to nothing is taken, so that it is told of; what is neither a file nor that, as a pipe, is not
        found = [p for p in paths if p.suffix.lower() in suffixes and (p.is_file() or not os.path.exists(p))]
        if not found and root is not path:
            raise ValueError(f"{word}: no file of a known type has such a name")
        files += [Found(path, place / path.relative_to(root)) for path in found]
    once = {os.path.abspath(found.path): found for found in files}
    files = sorted(once.values(), key=lambda found: natural(found.path))
    if not files and not faults:
        raise ValueError(f"{', '.join(words)}: nothing in there ends in {', '.join(sorted(suffixes))}")
    return files, faults


def _below(root: Path, output: Path, failed: Callable[[OSError], object]) -> Iterator[Path]:
    """What is in a folder, and in those in it; a link to a folder that it lies in shows nothing new."""
    out = os.path.realpath(output)
    for name, folders, names in os.walk(root, followlinks=True, onerror=failed):
        real = os.path.realpath(name)
        targets = {one: os.path.realpath(os.path.join(name, one)) for one in folders if not one.startswith(".")}
        folders[:] = [one for one, target in targets.items() if target != out and not _is_below(real, target)]
        yield from (Path(name, one) for one in names if not one.startswith("."))


def _matching(pattern: str, root: Path, output: Path) -> list[Path]:
    out = os.path.realpath(output)
    inside = not _is_below(os.path.realpath(root), out)
    shortest: dict[str, Path] = {}  # links in a circle make paths of any length
    for path in sorted(map(Path, glob.glob(pattern, recursive=True)), key=lambda path: len(path.parts)):
        real = os.path.realpath(path)
        if not (inside and _is_below(real, out)):
            shortest.setdefault(real, path)
    return list(shortest.values())


def _is_below(path: str, folder: str) -> bool:
    return path == folder or path.startswith(os.path.join(folder, ""))


def hash_of(path: str | os.PathLike[str]) -> str:
    """BLAKE2b of what is in a file, 16 bytes, hexadecimal.

    Raises:
        OSError: it cannot be read.
    """
    found = hashlib.blake2b(digest_size=16)
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            found.update(block)
    return found.hexdigest()
