"""Processes that keep cores busy, and end with whoever started them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from types import TracebackType

# It spins from "1" to "0", waits from "0" to "1", and ends with its input: however its parent ended, that has ended too
_SPIN = """
import os, select
while order := os.read(0, 1):
    while order == b"1" and not select.select([0], [], [], 0)[0]:
        for _ in range(20_000):
            pass
"""
_SETTLED = 0.2  # seconds until the scheduler has spread processes over the cores
_PATIENCE = 5.0


class Busy:
    """So many processes of the usual priority, idle until told: `with Busy(2) as busy: busy.spin(1)`.

    They are gone when the block is left, by an exception or Ctrl-C too, and when this process is killed.
    """

    def __init__(self, count: int):
        self.count = count
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Busy:
        try:
            for _ in range(self.count):
                self._processes.append(
                    subprocess.Popen(
                        [sys.executable, "-I", "-S", "-c", _SPIN],
                        stdin=subprocess.PIPE,
                        stdout=subprocess.DEVNULL,
                        bufsize=0,
                        start_new_session=True,  # Ctrl-C is for this process alone
                    )
                )
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    @property
    def ids(self) -> list[int]:
        """Of the processes."""
        return [process.pid for process in self._processes]

    def spin(self, count: int) -> None:
        """Have so many of them busy from now on, and the others idle."""
        for i, process in enumerate(self._processes):
            if process.stdin is None or process.poll() is not None:
                raise RuntimeError(f"Busy: process {process.pid} ended by itself")
            process.stdin.write(b"1" if i < count else b"0")
        time.sleep(_SETTLED)

    def _end(self) -> None:
        for process in self._processes:
            if process.stdin is not None:
                process.stdin.close()
            process.kill()
        for process in self._processes:
            process.wait(_PATIENCE)
        self._processes = []


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
