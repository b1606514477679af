"""Work that a caller shares with the workers of a pool, and work that torch must not split among its own threads."""

from __future__ import annotations

import atexit
import ctypes
import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from queue import SimpleQueue
from typing import ParamSpec, TypeVar

import torch

from camtorch.evaluate.door import TORCH_LIBRARY, in_jit_trace

P = ParamSpec("P")
R = TypeVar("R")


def spread(work: Callable[[], object], threads: int) -> None:
    """Run `work` on up to `threads` threads at once: on this one, and on waiting workers.

    Each run takes piece after piece of a shared task, mostly without the GIL. A worker that found no core before this
    thread's own run ends does not begin any more. The first exception of any run is raised after all runs have ended.
    """
    if threads <= 1 or sys.is_finalizing():  # a new thread would never begin
        work()
        return
    runs: list[_Run] = []
    with suppress(RuntimeError):  # the process can have no more threads; from Python 3.12 on, not at its end
        runs.extend(_begin(work) for _ in range(threads - 1))
    try:
        work()
    finally:
        # also if it is interrupted: workers still write into memory that the caller's frame keeps alive
        begun, interruption = [run for run in runs if not run.take_back()], None
        while begun:
            try:
                for run in begun:
                    with run.ending:
                        pass
                break
            except BaseException as error:
                interruption = interruption or error
        if interruption is not None:
            raise interruption
    for run in begun:
        if run.error is not None:
            raise run.error


_idle: list[SimpleQueue[_Run | None]] = []  # the queue of each idle worker


class _Run:
    """A run of some work on a worker, unless the thread that asked for it takes it back before it begins."""

    def __init__(self, work: Callable[[], object], worker: SimpleQueue[_Run | None]):
        self.work, self.worker, self.ticket, self.ending = work, worker, threading.Lock(), threading.Lock()
        self.error: BaseException | None = None
        self.ending.acquire()

    def take_back(self) -> bool:
        """Take the run back if its worker has not begun it, and free the worker; return whether it was taken back."""
        taken = self.ticket.acquire(blocking=False)
        if taken:
            _idle.append(self.worker)
        return taken

    def __call__(self) -> None:
        if self.ticket.acquire(blocking=False):
            try:
                self.work()
            except BaseException as error:
                self.error = error
            _idle.append(self.worker)  # before the waiting thread wakes up, which may have more to do
            self.ending.release()


def _begin(work: Callable[[], object]) -> _Run:
    """Begin work on the worker that became idle last, or on a new one."""
    try:
        worker = _idle.pop()
    except IndexError:
        worker = SimpleQueue()
        thread = threading.Thread(target=_serve, args=(worker,), name="camtorch", daemon=True)
        thread.start()
        _started.append((thread, worker))
    run = _Run(work, worker)
    worker.put(run)
    return run


_started: list[tuple[threading.Thread, SimpleQueue[_Run | None]]] = []


def _serve(worker: SimpleQueue[_Run | None]) -> None:
    for run in iter(worker.get, None):
        run()
        del run  # frees the tensors that it worked on, while the thread waits


@atexit.register
def _end() -> None:
    """End the workers: one that waits for the GIL at exit is unwound, through torch's frames too, which aborts."""
    for _, worker in _started:
        worker.put(None)
    for thread, _ in _started:
        thread.join(1)


def _forked() -> None:
    """Forget the threads: the child of a fork has none of them."""
    _idle.clear()
    _started.clear()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_forked)


# Each of torch's operations is split among threads and waits until all have done their part: for milliseconds, if
# another process has the core of one. A chain of a hundred operations waits a hundred times. So such chains
# run on one thread, or on several that each do a part of their own.


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function whose operations are not split on the CPU, so that its results are always the same."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling() or _limits is None or _mine.threads:
            return function(*args, **kwargs)
        threads = torch.get_num_threads()
        if threads == 1 or in_jit_trace():
            return function(*args, **kwargs)
        _mine.threads = threads
        openmp, mkl = _limits  # torch.set_num_threads reaches other threads as well
        openmp(1)
        of_mkl = mkl(1)  # MKL splits what torch has not split
        try:
            return function(*args, **kwargs)
        finally:
            openmp(_mine.threads)
            mkl(of_mkl)
            _mine.threads = 0

    return call


def thread_count() -> int:
    """Return `torch.get_num_threads()`, but within an `on_one_thread` function the number outside of it."""
    return _mine.threads or torch.get_num_threads()


class _Mine(threading.local):
    threads = 0  # before and after the function `on_one_thread`; 0 outside of one


def _find_limits() -> tuple[Callable[[int], object], Callable[[int], int]] | None:
    """Return the functions that set the calling thread's number of threads in OpenMP, and in MKL if it is used."""
    if sys.platform == "win32":
        return None
    torch_library = ctypes.CDLL(TORCH_LIBRARY)
    openmp = getattr(torch_library, "omp_set_num_threads", None)
    return None if openmp is None else (openmp, getattr(torch_library, "MKL_Set_Num_Threads_Local", int))


_limits = _find_limits()
_mine = _Mine()
