"""The images that a command line names by files, patterns and folders; and which of several cameras belong together."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from camtorch.jobs.inputs import IMAGES, natural


def gather(words: Iterable[str]) -> list[Path]:
    """Images, each once, in natural order.

    Args:
        words: files, folders (their images, not those of folders in them), or patterns, as a quoted 'left*.jpg'.

    Raises:
        ValueError: a word that means no image.
    """
    found: dict[str, Path] = {}
    for word in words:
        path = Path(word)
        if path.is_dir():
            paths = [p for p in path.iterdir() if p.suffix.lower() in IMAGES and p.is_file()]
            if not paths:
                raise ValueError(f"{word}: a folder without images")
        elif os.path.lexists(word) or not glob.has_magic(word):
            paths = [path]
        else:
            paths = [p for p in map(Path, glob.glob(word, recursive=True)) if p.is_file()]
            if not paths:
                raise ValueError(f"{word}: no file has such a name")
        found |= {os.path.abspath(p): p for p in paths}
    return sorted(found.values(), key=natural)


def together(cameras: Mapping[str, Sequence[Path]], how: str | None) -> tuple[dict[str, dict[str, Path]], str]:
    """Which images of several cameras were taken together.

    Args:
        cameras: their images in order, by the cameras' names.
        how: "name", "order", or None for what fits: names that are the same, else the last number in them, else the
            order.

    Returns:
        Views, camera -> image of each, by a name of the view; and how they were found, in words.

    Raises:
        ValueError: other numbers of images where they are matched by their order, or no name in common.
    """
    for words, key in (("file name", lambda path: path.stem), ("number in the file name", _last_number)):
        keyed = {name: {key(path): path for path in paths} for name, paths in cameras.items()}
        whole = all(None not in of and len(of) == len(cameras[name]) for name, of in keyed.items())
        sets = [set(of) for of in keyed.values()]
        seen_twice = {view for i, one in enumerate(sets) for other in sets[:i] for view in one & other}
        if how != "order" and whole and 2 * len(seen_twice) >= min(map(len, sets)) and seen_twice:
            views: dict[str, dict[str, Path]] = {}
            for name, of in keyed.items():
                for view, path in of.items():
                    views.setdefault(str(view), {})[name] = path
            return dict(sorted(views.items(), key=lambda item: natural(Path(item[0])))), f"by the {words}"
    counts = {name: len(paths) for name, paths in cameras.items()}
    if how == "name":
        raise ValueError(f"the images of {', '.join(cameras)} have no names in common; --match order takes their order")
    if len(set(counts.values())) > 1:
        shown = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise ValueError(
            f"{shown}: images are matched by their order, so as many of each are needed; or names that are the same, "
            "or have the same number last, in images that were taken together"
        )
    rows = zip(*cameras.values(), strict=True)
    return {str(i): dict(zip(cameras, row, strict=True)) for i, row in enumerate(rows)}, "by their order"


def _last_number(path: Path) -> str | None:
    numbers = re.findall(r"\d+", path.stem)
    return numbers[-1].lstrip("0") or "0" if numbers else None
