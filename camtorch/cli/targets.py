"""Where results go: what could not be written after the work is refused before it."""

from __future__ import annotations

import os
from pathlib import Path


def check(path: Path, *, force: bool, inputs: tuple[Path | None, ...] = ()) -> None:
    """Refuse a path that no file can be written to.

    Args:
        path: where a file is to go.
        force: whether it may take the place of another file.
        inputs: what is read, which it may not overwrite in any case.

    Raises:
        ValueError: the file is one of the inputs, also by a link; it exists and `force` is not given; there is no
            folder to write to, nor one to make it in.
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
