"""What the command says on stderr: notes, errors, and how far a long work is."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable


def say(text: str) -> None:
    """One line, whatever the text."""
    print("camtorch:", " ".join(text.split()), file=sys.stderr, flush=True)


def note(text: object) -> None:
    """What the user should know though the work goes on."""
    say(f"note: {text}")


def progress(what: str) -> Callable[[float], None]:
    """A function that shows a done part, from 0 to 1, on a terminal, if the work takes more than a moment.

    The line is gone when the part is 1.
    """
    begin, shown = time.monotonic(), False

    def show(part: float) -> None:
        nonlocal shown
        if part < 1 and time.monotonic() > begin + 1:
            shown = True
            print(f"\r{what}: {100 * part:.0f} %", end="", file=sys.stderr, flush=True)
        elif part >= 1 and shown:
            print("\r" + " " * (len(what) + 7) + "\r", end="", file=sys.stderr, flush=True)

    return show if sys.stderr.isatty() else lambda part: None
