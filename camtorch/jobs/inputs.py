"""Which files a command line means by files, patterns and folders, where what is made of them goes; and hashes."""

from __future__ import annotations

import glob
import hashlib
import os
import re
from collections.abc import Collection, Iterator, Sequence
from itertools import takewhile
from pathlib import Path

IMAGES = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"})
"""Suffixes, in lower case, of what is taken of a folder, and of what is written."""


def natural(path: Path) -> list[tuple[int, int, str]]:
    """A key to sort by that has 2 before 10."""
    parts = re.split(r"(\d+)", str(path))
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in parts]


def find(words: Sequence[str], suffixes: Collection[str], output: Path) -> list[tuple[Path, Path]]:
    """Files, each once, in natural order, and their places relative to the folder of outputs.

    Words are files, whatever their suffix; patterns, as a quoted 'in/**/*.jpg'; and folders, with all folders in them,
    of which the tree is kept; of several words folders keep their names as well. What begins with a dot is left out,
    and what is in the folder of outputs, where that lies within a folder that is read. Links are followed.

    Raises:
        ValueError: a word that means no file. OSError: a folder that cannot be looked into.
    """
    files: dict[str, tuple[Path, Path]] = {}
    out = os.path.realpath(output)
    for word in words:
        path, place = Path(word), Path()
        if os.path.lexists(path) and not path.is_dir():
            files[os.path.realpath(path)] = path, Path(path.name)
            continue
        if path.is_dir():
            root, place = path, Path(path.resolve().name) if len(words) > 1 else place
            paths = _below(path)
        elif glob.has_magic(word):
            root = Path(*takewhile(lambda part: not glob.has_magic(part), path.parts))
            # links in a circle make paths of any length to the same file
            paths = iter(sorted(map(Path, glob.iglob(word, recursive=True)), key=lambda one: -len(one.parts)))
        else:
            raise ValueError(f"{path}: no such file or folder")
        apart = _is_below(os.path.realpath(root), out)
        # a link to nothing is taken, so that it is told of; what is neither a file nor that, as a pipe, is not
        found = {
            os.path.realpath(one): (one, place / one.relative_to(root))
            for one in paths
            if one.suffix.lower() in suffixes
            and (one.is_file() or not os.path.exists(one))
            and (apart or not _is_below(os.path.realpath(one), out))
        }
        if not found:
            raise ValueError(f"{word}: no file in there ends in {', '.join(sorted(suffixes))}")
        files |= found
    return sorted(files.values(), key=lambda found: natural(found[0]))


def _below(root: Path) -> Iterator[Path]:
    """What is in a folder, and in those in it; a link to a folder that it lies in shows nothing new."""

    def refuse(error: OSError) -> None:
        raise error

    for name, folders, names in os.walk(root, followlinks=True, onerror=refuse):
        real = os.path.realpath(name)
        folders[:] = [
            one
            for one in folders
            if not one.startswith(".") and not _is_below(real, os.path.realpath(os.path.join(name, one)))
        ]
        yield from (Path(name, one) for one in names if not one.startswith("."))


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
