"""Work that threads share: a caller with the workers of a pool; and work that torch shall not split among its own."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")

_MOST_THREADS = 256
_pool: ThreadPoolExecutor


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
    futures: list[Future[object]] = []
    with suppress(RuntimeError):  # no more threads for this process, or the interpreter is about to end
        futures += (_pool.submit(work) for _ in range(threads - 1))
    try:
        work()
    finally:
        # workers still write into memory that the caller's frame keeps alive, also where this one is interrupted
        begun, interruption = [future for future in futures if not future.cancel()], None
        while begun:
            try:
                wait(begun)
                break
            except BaseException as error:
                interruption = interruption or error
        if interruption is not None:
            raise interruption
    for future in begun:
        future.result()


def _new_pool() -> None:
    """Also in the child of a fork, which has none of the threads."""
    global _pool
    _pool = ThreadPoolExecutor(_MOST_THREADS, "camtorch")


_new_pool()
if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_new_pool)


# -- the threads of torch
#
# Each of its operations is split among them and waits until all have done their part: for milliseconds, where another
# process has the core of one. To a chain of a hundred operations that happens a hundred times. So such chains run on
# one thread, or on several that each do a part of their own.

_in_jit_trace: Callable[[], bool] = torch.jit.is_tracing  # type: ignore[attr-defined]


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Leave the operations of a function undivided on the CPU; so their results are always the same."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling() or _in_jit_trace() or _limits is None or _mine.threads:
            return function(*args, **kwargs)
        threads = torch.get_num_threads()
        if threads == 1:
            return function(*args, **kwargs)
        _mine.threads = threads
        openmp, mkl = _limits  # torch.set_num_threads reaches other threads as well
        openmp(1)
        of_mkl = mkl(1)  # which splits what torch has not split
        try:
            return function(*args, **kwargs)
        finally:
            openmp(_mine.threads)
            mkl(of_mkl)
            _mine.threads = 0

    return call


def thread_count() -> int:
    """Of torch on this thread: `torch.get_num_threads()`, also in a function that leaves operations undivided."""
    return _mine.threads or torch.get_num_threads()


class _Mine(threading.local):
    threads = 0
    """Among how many threads operations are split before and after the function `on_one_thread`; 0 in none."""


def _find_limits() -> tuple[Callable[[int], object], Callable[[int], int]] | None:
    """How OpenMP, and MKL where it is used, are told among how many threads to split the work of the calling one."""
    if sys.platform == "win32":
        return None
    torch_library = ctypes.CDLL(torch._C.__file__)
    openmp = getattr(torch_library, "omp_set_num_threads", None)
    return None if openmp is None else (openmp, getattr(torch_library, "MKL_Set_Num_Threads_Local", int))


_limits = _find_limits()
_mine = _Mine()
