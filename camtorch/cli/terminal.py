"""Lines on stderr: notes, errors with their reasons, and progress by tqdm."""

import sys
from typing import Any


def say(text: str) -> None:
    """Print any text in one line; control characters, as in names of files, are escaped."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(text.split()))
    print("camtorch:", line, file=sys.stderr, flush=True)


def note(text: object) -> None:
    """Print a note, after which the work continues."""
    say(f"note: {text}")


def reason(error: Exception) -> str:
    """Return the reason of a failure in one line."""
    if lacks_memory(error):
        text = f"out of memory: {error}"
    elif isinstance(error, OSError) and error.strerror:
        name = error.filename2 or error.filename  # the file that another one could not replace
        text = f"{name}: {error.strerror}" if name else error.strerror
    elif isinstance(error, (ValueError, OSError, ImportError)) and str(error):
        text = str(error)
    else:
        text = f"{type(error).__name__}: {error}"
    return " ".join(text.split())


def lacks_memory(error: Exception) -> bool:
    """Whether memory ran out; torch has no type of its own for this."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "allocate memory" in str(error))


def bar(what: str, total: float | None, unit: str = "", **options: Any) -> Any:
    """Return a tqdm bar for longer work; a file or a pipe gets a line twice a minute. Close it after use."""
    from tqdm import tqdm  # type: ignore[import-untyped]  # late: `--help` does not need it

    delay, interval = (0.5, 0.1) if sys.stderr.isatty() else (30.0, 30.0)  # seconds
    common = {"leave": False, "smoothing": 0, "file": sys.stderr, "delay": delay, "mininterval": interval}
    return tqdm(desc=what, total=total, unit=f" {unit}", **common | options)
