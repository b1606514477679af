"""Processes that work on tasks, one thread each, by `concurrent.futures`."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import Any, TypeVar

T = TypeVar("T")
Work = Callable[[T, Callable[[int], object]], Any]
"""What is done with a task; the function that it gets as well adds to what is done."""

_HOW = "spawn" if sys.platform == "win32" else "forkserver"


def prepare(module: str) -> None:
    """Have a module imported, once for all processes of pools to come, while this one does something else."""
    if _HOW == "forkserver":
        from multiprocessing import forkserver, resource_tracker

        multiprocessing.set_forkserver_preload([__name__, module])
        resource_tracker.ensure_running()  # which lets signals through again as it starts
        # an interrupt during these imports would print a traceback
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run(
    work: Work[T], tasks: Iterable[T], processes: int, add: Callable[[int], object]
) -> Generator[tuple[T, Any], None, None]:
    """Tasks with what `work` returned, as they are done; with one process here, by one thread as well.

    `work` is pickled once for each process, and must not raise; tasks are pickled, and taken as processes get free;
    `add` is called here with what was done since it was called last.

    Raises:
        ChildProcessError: a process was killed. What `tasks` raise, or an interrupt: processes are then ended at once.
    """
    if processes > 1:
        yield from _run_in_processes(work, iter(tasks), processes, add)
        return
    import torch  # not before: `prepare` is called so early that both processes import it at the same time

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for task in tasks:
            yield task, work(task, add)
    finally:
        torch.set_num_threads(threads)


def _run_in_processes(
    work: Work[T], tasks: Iterator[T], processes: int, add: Callable[[int], object]
) -> Generator[tuple[T, Any], None, None]:
    prepare(type(work).__module__)
    context = multiprocessing.get_context(_HOW)
    done, seen = context.Value("q", 0), 0
    others = multiprocessing.active_children()
    # pickled here, as multiprocessing would share the memory of tensors
    executor = ProcessPoolExecutor(processes, context, _begin, (pickle.dumps(work), done))
    at_work: dict[Future[Any], T] = {}
    try:
        while True:
            for task in islice(tasks, 2 * processes - len(at_work)):
                at_work[executor.submit(_work_on, task)] = task
            if not at_work:
                return
            finished = wait(at_work, timeout=0.1, return_when=FIRST_COMPLETED).done
            before, seen = seen, done.value
            add(seen - before)
            for future in finished:
                result = future.result()
                yield at_work.pop(future), result
    except BrokenProcessPool:
        names = ", ".join(map(str, at_work.values()))
        raise ChildProcessError(f"a process was killed, perhaps for lack of memory; at work were {names}") from None
    finally:
        executor.shutdown(wait=not at_work, cancel_futures=True)
        for process in set(multiprocessing.active_children()).difference(others):  # those of a work that is broken off
            process.terminate()
            process.join()


_work: Work[Any]
_done: Any


def _begin(pickled: bytes, done: Any) -> None:
    """What each process does first."""
    global _work, _done
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one decides what an interrupt means
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    _work, _done = pickle.loads(pickled), done


def _end_with_parent() -> None:
    """A parent that was killed cannot end its processes."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work_on(task: Any) -> Any:
    def add(part: int) -> None:
        with _done.get_lock():
            _done.value += part

    return _work(task, add)


def reason(error: Exception) -> str:
    """Why something failed, in a line."""
    if lacks_memory(error):
        text = f"out of memory: {error}" if str(error) else "out of memory"
    elif isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    elif isinstance(error, (ValueError, OSError, ImportError)) and str(error):
        text = str(error)
    else:
        text = f"{type(error).__name__}: {error}"
    return " ".join(text.split())


def lacks_memory(error: Exception) -> bool:
    """Whether it is that: neither torch nor the loader of shared libraries has a type for it."""
    words = {RuntimeError: "allocate memory", ImportError: "failed to map segment", OSError: "allocate memory"}
    return isinstance(error, MemoryError) or any(isinstance(error, t) and w in str(error) for t, w in words.items())
