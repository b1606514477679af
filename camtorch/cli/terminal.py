"""What the command says on stderr: notes, errors, and by tqdm how far a long work is."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any


def say(text: str) -> None:
    """One line, whatever the text: what would steer a terminal, as names of files may, is spelt out."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(text.split()))
    print("camtorch:", line, file=sys.stderr, flush=True)


def note(text: object) -> None:
    """What the user should know though the work goes on."""
    say(f"note: {text}")


@contextlib.contextmanager
def shown(what: str) -> Iterator[None]:
    """Say on a terminal what goes on, while it does."""
    is_terminal = sys.stderr.isatty()
    if is_terminal:
        print(f"camtorch: {what}", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        if is_terminal:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)  # the line is gone


def bar(what: str, total: float | None, unit: str = "", **options: Any) -> Any:
    """A tqdm bar for work that takes more than a moment; a file or a pipe gets one twice a minute. Close it."""
    from tqdm import tqdm  # type: ignore[import-untyped]  # not before: `--help` does without

    delay, interval = (0.5, 0.1) if sys.stderr.isatty() else (30.0, 30.0)  # seconds
    common = {"leave": False, "smoothing": 0, "file": sys.stderr, "delay": delay, "mininterval": interval}
    return tqdm(desc=what, total=total, unit=f" {unit}", **common | options)


@contextlib.contextmanager
def progress(what: str) -> Iterator[Callable[[float], None]]:
    """A function that shows a done part, from 0 to 1."""
    with bar(what, 1.0, bar_format="{desc}: {percentage:3.0f} %|{bar}| {remaining} left") as shown:
        yield lambda part: shown.update(part - shown.n)
