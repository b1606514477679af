"""Work that a few threads share: the caller, and workers of a pool that come to it while it lasts."""

from __future__ import annotations

import os
from collections.abc import Callable
from queue import SimpleQueue
from threading import Lock, Thread


def spread(work: Callable[[], object], threads: int) -> None:
    """Run the same function on several threads at once: on this one, and on workers of the pool.

    The function takes what there is to do from somewhere, piece by piece, until nothing is left. Most of its time it
    must not hold the GIL, and in a worker it finds the state of torch that a new thread has.

    Who is needed for nothing is not waited for: a worker that has not begun when this thread's own run ends, because it
    found no core, does not begin any more.

    Args:
        work: called once on each thread.
        threads: how many at most, this one included.

    Raises:
        BaseException: the first one that any run raised, after all have ended.
    """
    if threads <= 1:
        work()
        return
    call = _Call(work)
    try:
        _pool.send(call, threads - 1)
        work()
    finally:
        call.end()
    if call.error is not None:
        raise call.error


class _Call:
    """A function that workers come to run, until the caller's own run has ended."""

    def __init__(self, work: Callable[[], object]):
        self.work = work
        self.error: BaseException | None = None
        self._lock, self._idle = Lock(), Lock()  # the latter is held while workers are at it
        self._running, self._ended = 0, False

    def join(self) -> None:
        """By a worker."""
        with self._lock:
            if self._ended:
                return
            if not self._running:
                self._idle.acquire()
            self._running += 1
        try:
            self.work()
        except BaseException as error:  # the caller's to deal with
            self.error = self.error or error
        with self._lock:
            self._running -= 1
            if not self._running:
                self._idle.release()

    def end(self) -> None:
        """By the caller: nobody begins any more, and those who did are waited for."""
        interruption = None
        while True:
            try:
                with self._lock:
                    self._ended = True
                with self._idle:
                    break
            except BaseException as error:  # workers still write into memory that the caller's frame keeps alive
                interruption = interruption or error
        if interruption is not None:
            raise interruption


class _Pool:
    """Threads that wait for calls: as many as were ever wanted at once."""

    def __init__(self) -> None:
        self._calls: SimpleQueue[_Call] = SimpleQueue()
        self._workers: list[Thread] = []
        self._lock = Lock()

    def send(self, call: _Call, workers: int) -> None:
        """Let so many workers come to a call, each as soon as it is free."""
        with self._lock:
            while len(self._workers) < workers:
                worker = Thread(target=self._serve, name=f"camtorch-{len(self._workers) + 1}", daemon=True)
                try:
                    worker.start()
                except RuntimeError:  # no more threads for this process, or the interpreter is about to end
                    break
                self._workers.append(worker)
            workers = min(workers, len(self._workers))
        for _ in range(workers):
            self._calls.put(call)

    def _serve(self) -> None:
        while True:
            self._calls.get().join()


_pool = _Pool()


def _forget() -> None:
    """In the child of a fork, which has none of the threads."""
    global _pool
    _pool = _Pool()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_forget)
