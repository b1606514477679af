"""What the command says on stderr: notes, errors, and how far a long work is."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable


def say(text: str) -> None:
    """One line, whatever the text: what would steer a terminal, as names of files may, is spelt out."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(text.split()))
    print("camtorch:", line, file=sys.stderr, flush=True)


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


class Bar:
    """How far a job is: on a terminal a bar with the rate and the time left, in a file a line now and then.

    Args:
        what: what goes on.
        unit: what is counted, in the plural.
    """

    def __init__(self, what: str, unit: str):
        self._what, self._unit = what, unit
        self._is_terminal = sys.stderr.isatty()
        self._begin = time.monotonic()
        self._next = self._begin + (_SOON if self._is_terminal else _SELDOM)
        self._width = 0

    def show(self, done: float, total: float, kept: float = 0.0) -> None:
        """Say it, if it is time to.

        Args:
            done: how many.
            total: of how many.
            kept: of those done, which took no time.
        """
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + (_OFTEN if self._is_terminal else _SELDOM)
        rate = (done - kept) / max(now - self._begin, 1e-9)
        left = f", {_duration((total - done) / rate)} left" if rate > 0 else ""
        text = f"{int(done)} of {int(total)} {self._unit}, {rate:.3g}/s{left}"
        if not self._is_terminal:
            say(f"{self._what}: {text}")
            return
        part = done / max(total, 1)
        filled = int(part * _BAR)
        line = f"{self._what} [{'=' * filled}{' ' * (_BAR - filled)}] {100 * part:3.0f} %, {text}"
        line = line[: shutil.get_terminal_size().columns - 1]
        print("\r" + line.ljust(self._width), end="", file=sys.stderr, flush=True)
        self._width = len(line)

    def close(self) -> None:
        """Take it off the terminal."""
        if self._width:
            print("\r" + " " * self._width + "\r", end="", file=sys.stderr, flush=True)
            self._width = 0


_SOON, _OFTEN, _SELDOM = 0.5, 0.1, 30.0  # seconds
_BAR = 20  # characters


def _duration(seconds: float) -> str:
    """14 s, 3 min, 2.1 h."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    if seconds < 3600:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
