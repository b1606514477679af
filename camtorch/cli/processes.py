"""Processes that make files, one thread each, and the outcome of each file."""

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from camtorch.cli.terminal import reason

Pair: TypeAlias = tuple[Path, Path]  # the source file and the target file
Work: TypeAlias = Callable[[Path, Path], Any]  # makes a file, whole or not at all
_HOW = "spawn" if sys.platform == "win32" else "forkserver"
_work: Work


@dataclass
class Outcome:
    """Outcome of a pair."""

    found: Any = None  # what the work returned
    failure: str = ""  # reason why no file was made, or empty
    notes: list[str] = field(default_factory=list)


def prepare(module: str) -> None:
    """Start to import a module once for all later processes; this process does not wait for it."""
    if _HOW == "forkserver":
        from multiprocessing import forkserver

        multiprocessing.set_forkserver_preload([__name__, module])
        # the server inherits the mask: this process handles interrupts; the server would print a traceback
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def each(work: Work, pairs: Sequence[Pair], count: int, done: Callable[[], object]) -> list[Outcome]:
    """Return the outcomes of pairs by `count` processes; 1 means this process. `done` is called after each pair.

    Processes end at once after an error or an interrupt; a killed process raises ChildProcessError.
    """
    if count == 1:
        outcomes = []
        for pair in pairs:
            outcomes.append(_attempt(pair, work))
            done()
        return outcomes
    # pickled here because multiprocessing would share the memory of tensors
    executor = ProcessPoolExecutor(count, multiprocessing.get_context(_HOW), _begin, (pickle.dumps(work),))
    try:
        futures = [executor.submit(_attempt, pair) for pair in pairs]
        for _ in as_completed(futures):
            done()
        return [future.result() for future in futures]
    except BrokenProcessPool:
        raise ChildProcessError("a process was killed, perhaps for lack of memory") from None
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def _begin(pickled: bytes) -> None:
    global _work
    import torch

    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:  # it may be killed and unable to end its processes
        parent.join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles interrupts
    signal.signal(signal.SIGTERM, _end)
    threading.Thread(target=end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    _work = pickle.loads(pickled)


def _end(*_: object) -> None:
    # the executor may catch the exit, and wait for a lock that a killed process holds
    signal.alarm(2)
    sys.exit(1)  # removes the partial file


def _attempt(pair: Pair, work: Work | None = None) -> Outcome:
    """Make a file by `work`, default this process's own, and return its outcome."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            found = (work or _work)(*pair)
        except SystemExit:  # after which the executor would continue
            os._exit(1)
        except Exception as error:
            return Outcome(failure=reason(error))
    return Outcome(found, notes=list(dict.fromkeys(str(warning.message) for warning in caught)))
