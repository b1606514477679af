"""Processes that work on tasks, one thread each: a process that dies takes its task along, and nothing else."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import types
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing import connection, forkserver, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, NoReturn, TypeVar

T = TypeVar("T")

_PATIENCE = 10.0  # seconds that processes have to leave things in order when all is broken off
_SHORT = 0.5  # seconds of a task that leave no process waiting for the next one
_END = object()
_HOW = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"

Tell = Callable[[Any], None]
"""What a task is worked on with: what it is told reaches `receive` as "told"."""


def prepare(modules: Sequence[str]) -> None:
    """Have these modules imported, once for all processes of pools to come, while this one does something else."""
    if _HOW == "forkserver":
        multiprocessing.set_forkserver_preload([__name__, *modules])
        resource_tracker.ensure_running()  # which as it starts lets signals through again
        # what imports them would say where an interrupt found it
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            with _without_main():
                forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _without_main() -> Iterator[None]:
    """New processes do not run the script of this one, which they do not need, and which may start processes itself."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def run(
    work: Callable[[T, Tell], Any],
    tasks: Iterable[T],
    receive: Callable[[T, str, Any], None],
    *,
    processes: int,
) -> None:
    """Work on tasks.

    Args:
        work: is pickled, and called with a task and a function to tell of it; what it keeps, it keeps in its process.
        tasks: are pickled, and taken as processes get free.
        receive: is called here, with a task and one of
            "told", what `work` has told: any number of times;
            "done", what it returned: in the end; or else
            "failed", why, in words: it raised, or its process died.
        processes: how many; with one, the work is done here, by one thread as well.

    Raises:
        RuntimeError: processes die as they start. What `receive` and `tasks` raise, or an interrupt: processes then
            leave their tasks in order.
    """
    if processes > 1:
        with _Pool(work, processes) as pool:
            pool.run(iter(tasks), receive)
        return
    import torch  # not before: `prepare` is called so early that both processes import it at the same time

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for task in tasks:
            receive(task, *attempt(work, task, lambda what, task=task: receive(task, "told", what)))  # type: ignore[misc]
    finally:
        torch.set_num_threads(threads)


def attempt(work: Callable[[T, Tell], Any], task: T, tell: Tell) -> tuple[str, Any]:
    """("done", what the work returned), or ("failed", why it raised)."""
    try:
        return "done", work(task, tell)
    except Exception as error:
        return "failed", reason(error)


def reason(error: Exception) -> str:
    """Why something failed, in a line."""
    if isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    elif isinstance(error, MemoryError) or "allocate memory" in str(error):
        text = f"out of memory: {error}" if str(error) else "out of memory"
    elif isinstance(error, (ValueError, OSError, ImportError)) and str(error):
        text = str(error)
    else:
        text = f"{type(error).__name__}: {error}"
    return " ".join(text.split())


@dataclass(eq=False)
class _Worker:
    """A process, the end of the pipe to it, and the tasks that it has: one it is at, and one that waits."""

    process: BaseProcess
    pipe: Connection
    tasks: deque[Any] = field(default_factory=deque)
    room: int = 0
    """For how many tasks: it is ready if there is any."""
    begin: float = 0.0
    """When it began the first one."""

    def take(self, task: Any) -> None:
        """Give it one more."""
        if not self.tasks:
            self.begin = time.monotonic()
        self.tasks.append(task)
        with contextlib.suppress(OSError):  # it is dead, as will be found
            self.pipe.send_bytes(pickle.dumps(task))

    def next(self) -> None:
        """It is through with its first task."""
        now = time.monotonic()
        self.tasks.popleft()
        # of long ones none waits for one process while another has nothing to do
        self.room, self.begin = (2 if now < self.begin + _SHORT else 1), now


class _Pool:
    def __init__(self, work: Callable[[T, Tell], Any], count: int):
        # not by multiprocessing itself, which would share the memory of tensors
        self._work, self._count = pickle.dumps(work), count
        prepare([type(work).__module__])
        self._context = multiprocessing.get_context(_HOW)
        self._workers: list[_Worker] = []
        self._returned: list[Any] = []
        """Tasks that waited for a process which died."""

    def __enter__(self) -> _Pool:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for worker in self._workers:
            worker.pipe.close()  # which ends a process that waits
            if kind is not None and worker.process.is_alive():
                worker.process.terminate()
        for worker in self._workers:
            worker.process.join(_PATIENCE)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()

    def _start(self) -> None:
        here, there = self._context.Pipe()
        with there:
            arguments = there, self._work, os.getcwd()
            process = self._context.Process(target=_serve, args=arguments, daemon=True)  # type: ignore[attr-defined]
            with _without_main():
                process.start()
        self._workers.append(_Worker(process, here))

    def run(self, tasks: Iterator[Any], receive: Callable[[Any, str, Any], None]) -> None:
        more = True
        while True:
            more = more or bool(self._returned)
            while more and len(self._workers) < self._count:
                self._start()
            for worker in self._workers:
                while more and len(worker.tasks) < worker.room:
                    task = self._returned.pop() if self._returned else next(tasks, _END)
                    if task is _END:
                        more = False
                    else:
                        worker.take(task)
            if not more and not any(worker.tasks for worker in self._workers):
                return
            for ready in connection.wait([worker.pipe for worker in self._workers]):
                self._hear(next(worker for worker in self._workers if worker.pipe is ready), receive)

    def _hear(self, worker: _Worker, receive: Callable[[Any, str, Any], None]) -> None:
        try:
            kind, what = pickle.loads(worker.pipe.recv_bytes())
        except (EOFError, OSError):
            self._bury(worker, receive)
            return
        if kind == "ready":
            worker.room = 1
            return
        if kind == "broken":
            raise RuntimeError(f"a process could not begin its work: {what}")
        task = worker.tasks[0]
        if kind != "told":
            worker.next()
        receive(task, kind, what)

    def _bury(self, worker: _Worker, receive: Callable[[Any, str, Any], None]) -> None:
        self._workers.remove(worker)
        worker.pipe.close()
        worker.process.join()
        code = worker.process.exitcode or 0
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
        if not worker.room:
            raise RuntimeError(f"a process {how} before it began its work; is memory short?")
        if worker.tasks:
            task, *rest = worker.tasks
            self._returned += rest
            receive(task, "failed", f"the process at work on it {how}")


def _serve(pipe: Connection, pickled: bytes, folder: str) -> None:
    """What a process does."""
    import torch  # see `run`

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal: who started it says what becomes of it
    signal.signal(signal.SIGTERM, _leave)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_die_with, args=(parent.sentinel,), daemon=True).start()

    def send(kind: str, what: Any) -> None:
        pipe.send_bytes(pickle.dumps((kind, what)))

    with contextlib.suppress(EOFError, ConnectionError):  # who started it wants no more
        try:
            os.chdir(folder)
            torch.set_num_threads(1)
            work = pickle.loads(pickled)
        except Exception as error:
            send("broken", reason(error))
            return
        send("ready", None)
        while True:
            task = pickle.loads(pipe.recv_bytes())
            send(*attempt(work, task, lambda what: send("told", what)))


def _leave(number: int, frame: object) -> NoReturn:
    raise SystemExit(128 + number)


def _die_with(sentinel: int) -> None:
    """Of who dies by kill -9, nobody else would know."""
    connection.wait([sentinel])
    os._exit(1)
