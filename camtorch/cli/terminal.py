"""Lines on stderr: notes, errors with their reasons, and progress by tqdm."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any


def say(text: str) -> None:
    """Print one line, whatever the text; characters that would steer a terminal, as names of files may, are escaped."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(text.split()))
    print("camtorch:", line, file=sys.stderr, flush=True)


def note(text: object) -> None:
    """Print what the user should know though the work goes on."""
    say(f"note: {text}")


def reason(error: Exception) -> str:
    """Return why something failed, in a line."""
    if lacks_memory(error):
        text = f"out of memory: {error}"
    elif isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    elif isinstance(error, (ValueError, OSError, ImportError)) and str(error):
        text = str(error)
    else:
        text = f"{type(error).__name__}: {error}"
    return " ".join(text.split())


def lacks_memory(error: Exception) -> bool:
    """Whether memory ran out, for which torch has no type of its own."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "allocate memory" in str(error))


def bar(what: str, total: float | None, unit: str = "", **options: Any) -> Any:
    """Return a tqdm bar for work that takes more than a moment; a file or a pipe gets one twice a minute. Close it."""
    from tqdm import tqdm  # type: ignore[import-untyped]  # not before: `--help` does without

    delay, interval = (0.5, 0.1) if sys.stderr.isatty() else (30.0, 30.0)  # seconds
    common = {"leave": False, "smoothing": 0, "file": sys.stderr, "delay": delay, "mininterval": interval}
    return tqdm(desc=what, total=total, unit=f" {unit}", **common | options)


@contextlib.contextmanager
def progress(what: str) -> Iterator[Callable[[float], None]]:
    """Yield a function that shows the part that is done, from 0 to 1."""
    with bar(what, 1.0, bar_format="{desc}: {percentage:3.0f} %|{bar}| {remaining} left") as shown:
        yield lambda part: shown.update(part - shown.n)
