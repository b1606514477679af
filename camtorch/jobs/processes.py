"""Processes that work on tasks, one thread each, by `concurrent.futures`; and why something failed, in words."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")
_HOW = "spawn" if sys.platform == "win32" else "forkserver"
_work: Callable[[Any], Any]


def prepare(module: str) -> None:
    """Have a module imported, once for all processes to come, while this one does something else."""
    if _HOW == "forkserver":
        from multiprocessing import forkserver

        multiprocessing.set_forkserver_preload([__name__, module])
        forkserver.ensure_running()


def each(work: Callable[[T], R], tasks: Sequence[T], processes: int, module: str) -> Iterator[tuple[T, R]]:
    """Tasks with what `work` returned, as they are done; with one process in order, and here.

    On any error or interrupt processes are ended at once. `module` is what they import first.

    Raises:
        ChildProcessError: a process was killed.
    """
    if processes == 1:
        yield from ((task, work(task)) for task in tasks)
        return
    prepare(module)
    others = multiprocessing.active_children()
    # pickled here, as multiprocessing would share the memory of tensors
    context = multiprocessing.get_context(_HOW)
    executor = ProcessPoolExecutor(processes, context, _begin, (pickle.dumps(work),))
    try:
        futures = {executor.submit(_work_on, task): task for task in tasks}
        yield from ((futures[future], future.result()) for future in as_completed(futures))
    except BrokenProcessPool:
        raise ChildProcessError("a process was killed, perhaps for lack of memory") from None
    except BaseException:
        for process in set(multiprocessing.active_children()).difference(others):
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def _begin(pickled: bytes) -> None:
    """What each process does first."""
    global _work
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one decides what an interrupt means
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    _work = pickle.loads(pickled)


def _end_with_parent() -> None:
    """A parent that was killed cannot end its processes."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work_on(task: Any) -> Any:
    return _work(task)


def reason(error: Exception) -> str:
    """Why something failed, in a line."""
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
    """Whether it is that: torch has no type for it."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "allocate memory" in str(error))
