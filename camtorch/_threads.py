"""Work that threads share: a caller with the workers of a pool, and the threads of torch where they have free cores."""

from __future__ import annotations

import ctypes
import math
import os
import sys
import threading
import time
from collections.abc import Callable
from functools import wraps
from queue import SimpleQueue
from threading import Lock, Thread
from typing import ParamSpec, TypeVar

import torch

from camtorch._tracing import in_jit_trace

P = ParamSpec("P")
R = TypeVar("R")


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


# -- the threads of torch
#
# Each of its operations is split among them and waits until all have done their part: for milliseconds, where another
# process has the core of one. To a chain of a hundred operations that happens a hundred times.

ALONE = (1 << 15) - 1
"""Elements up to which it is not worth while to split an operation."""
EVEN = 3 * 4 * 2 * 16
"""Multiples of so many elements are split between pairs of vectors, up to 64 bytes wide, by one to four threads."""
_GLANCE = 1e-3  # seconds for which a look at the cores holds
_SPIN = 1e-3  # seconds for which threads certainly go on running after an operation
_LONGEST = 0.5  # seconds
_CORES = os.cpu_count() or 1


def as_cores_are_free(function: Callable[P, R]) -> Callable[P, R]:
    """Let torch split the operations of a function, on the CPU, only where its threads have cores to run on.

    That is looked at when it begins, and wherever it calls `split`. Results shall not depend on it: a single sum over
    more than `ALONE` elements has to be `undivided`, and for atan2 there is `optics.special.atan2`. What autograd sums
    does depend on it, as it does on the number of torch's threads.
    """

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling() or in_jit_trace():  # its sizes are tensors
            return function(*args, **kwargs)
        if _mine.threads:  # of a function that called this one, and goes on as before
            was_alone = _mine.is_alone
            try:
                return function(*args, **kwargs)
            finally:
                _mine.set_alone(was_alone)
        _mine.threads = torch.get_num_threads() if _limits is not None else 1
        try:
            split()
            return function(*args, **kwargs)
        finally:
            if _mine.was_split:
                _crowd.last_together = time.perf_counter()
            _mine.set_alone(False)
            _mine.threads, _mine.was_split = 0, False

    return call


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Leave the operations of a function undivided on the CPU: many small ones, whose results are always the same."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling() or in_jit_trace() or _limits is None or _mine.stays_alone:
            return function(*args, **kwargs)
        threads, was_alone = _mine.threads, _mine.is_alone
        _mine.threads, _mine.stays_alone = threads or torch.get_num_threads(), True
        try:
            _mine.set_alone(True)
            return function(*args, **kwargs)
        finally:
            _mine.set_alone(was_alone)
            _mine.threads, _mine.stays_alone = threads, False

    return call


def split(elements: int | None = None) -> None:
    """Whether the next operations are to be split. elements: of each of them, if that is known."""
    if _mine.threads > 1 and not _mine.stays_alone:
        small = elements is not None and elements <= ALONE
        _mine.set_alone(small or _crowd.meets(_mine.threads, _mine.was_split))
        _mine.was_split = elements is not None and not _mine.is_alone


def thread_count() -> int:
    """Of torch on this thread: `torch.get_num_threads()`, also while a function that goes by free cores has but one."""
    return max(_mine.threads, torch.get_num_threads())


def is_split() -> bool:
    """Whether operations on large tensors are split, in a function that goes by free cores."""
    return _mine.threads > 1 and not _mine.is_alone


def undivided(operation: Callable[[], R]) -> R:
    """The result of an operation that is not split: a single sum, which would be rounded otherwise."""
    if not is_split():
        return operation()
    _mine.set_alone(True)
    try:
        return operation()
    finally:
        _mine.set_alone(False)


class _Mine(threading.local):
    """Among how many threads the operations of this thread are split, while a function goes by free cores."""

    threads = 0
    """Before and after it; 0 where there is none."""
    is_alone = False
    was_split = False
    """Whether the last operations were."""
    stays_alone = False
    """Whether that is so to the end of a function."""
    _of_mkl = 0

    def set_alone(self, alone: bool) -> None:
        """Split them, or not."""
        if alone != self.is_alone:
            assert _limits is not None  # there is but one thread otherwise
            # not torch.set_num_threads: that reaches other threads as well
            openmp, mkl = _limits
            self.is_alone = alone
            openmp(1 if alone else self.threads)
            if mkl is not None:  # which splits what torch has not split
                self._of_mkl = mkl(1 if alone else self._of_mkl)


class _Crowd:
    """Whether more threads, of all processes, want to run than there are cores.

    Torch's own are among them while they are at work, and for a moment after, so that a look taken then tells what is
    there beside them. Who computes alone does not know whether there is room for them as well, unless he is the only
    one. So after a crowd they stay away for a while, twice as long if there was one again as soon as they were back.
    """

    def __init__(self) -> None:
        self.is_here = False
        self.last_together = -math.inf
        """When torch's threads were last at work."""
        self._pause = _GLANCE
        self._next_look = self._doubt_ends = -math.inf

    def meets(self, threads: int, together: bool) -> bool:
        """Whether so many threads of torch would be in it. together: whether they have just been at work."""
        now = time.perf_counter()
        if together:
            self.last_together = now
        if now < self._next_look:
            return self.is_here
        wanting, room = _wanting(), max(_CORES, threads)
        beside_them = now < self.last_together + _SPIN
        if wanting > room:
            if beside_them:
                self._doubt_ends, self._pause = now + self._pause, min(2 * self._pause, _LONGEST)
            self.is_here = True
        elif wanting - 1 + threads <= room or now >= self._doubt_ends:
            if beside_them:
                self._pause = _GLANCE
            self.is_here = False
        self._next_look = now + _GLANCE
        return self.is_here


def _wanting() -> int:
    """How many threads of all processes run or want to; 0 where there is nobody to ask."""
    try:
        file = os.open("/proc/loadavg", os.O_RDONLY)
    except OSError:
        return 0
    try:
        return int(os.read(file, 64).split()[3].partition(b"/")[0])
    finally:
        os.close(file)


def _find_limits() -> tuple[Callable[[int], object], Callable[[int], int] | None] | None:
    """How OpenMP, and MKL where it is used, are told among how many threads to split the work of the calling one."""
    if sys.platform == "win32":
        return None
    of_torch = ctypes.CDLL(torch._C.__file__)
    threads = torch.get_num_threads()
    for library in (ctypes.CDLL(None), of_torch):  # what was loaded before torch may take its place
        openmp = getattr(library, "omp_set_num_threads", None)
        if openmp is None:
            continue
        openmp(threads + 1)
        is_it = torch.get_num_threads() == threads + 1
        openmp(threads)
        if is_it:
            return openmp, getattr(of_torch, "MKL_Set_Num_Threads_Local", None)
    return None


_limits = _find_limits()
_mine = _Mine()
_crowd = _Crowd()
