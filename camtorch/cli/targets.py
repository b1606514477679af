"""Where results go: what could not be written after the work is refused before it."""

from __future__ import annotations

import os
from pathlib import Path


def check(path: Path, *, force: bool, inputs: tuple[Path | None, ...] = ()) -> None:
    """Refuse, by a ValueError, a path that no file can be written to: one of the inputs, also by a link; one that
    exists, unless `force` is given; one without a folder to write to, or to make it in.
    """
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; name a file in it")
    for given in inputs:
        if given is not None and path.exists() and given.exists() and path.samefile(given):
            raise ValueError(f"{path}: would overwrite {given}, which is read; name another file")
    if os.path.lexists(path) and not force:
        raise ValueError(f"{path}: exists already; --force overwrites it")
    folder = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
    if not folder.is_dir():
        raise ValueError(f"{path}: {folder} is no folder")
    if not os.access(folder, os.W_OK):
        raise ValueError(f"{path}: the folder {folder} cannot be written to")
