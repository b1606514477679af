"""Threads: who shares work, what comes of errors, forks and several callers, and that results do not depend on it."""

import os
import signal
import threading
import time
from collections import deque

import pytest

from camtorch import _threads
from camtorch._threads import spread


class Pieces:
    """Work of pieces that take a moment without the GIL, begun when so many threads have come."""

    def __init__(self, count, seconds=0.002, threads=1):
        self.left, self.seconds = deque(range(count)), seconds
        self.done, self.by = [], set()
        self.all_here = threading.Barrier(threads, timeout=10)

    def __call__(self):
        self.all_here.wait()
        while self.left:
            try:
                piece = self.left.popleft()
            except IndexError:
                return
            time.sleep(self.seconds)
            self.done.append(piece)
            self.by.add(threading.get_ident())


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_all_threads_share_the_work(threads):
    pieces = Pieces(20, threads=threads)
    spread(pieces, threads)
    assert sorted(pieces.done) == list(range(20))
    assert threading.get_ident() in pieces.by
    assert len(pieces.by) == threads


def test_one_thread_starts_no_other(monkeypatch):
    monkeypatch.setattr(_threads, "_pool", None)
    spread(Pieces(3, 0), 1)


def test_workers_are_kept():
    spread(Pieces(10), 3)
    before = threading.active_count()
    for _ in range(5):
        spread(Pieces(10), 3)
    assert threading.active_count() == before


def test_a_worker_that_finds_no_core_is_not_waited_for():
    busy, calls = threading.Event(), []
    pool = _threads._Pool()
    begun = threading.Event()
    blocked = _threads._Call(lambda: begun.set() or busy.wait())
    pool.send(blocked, 1)
    assert begun.wait(10)
    call = _threads._Call(lambda: calls.append(1))
    pool.send(call, 1)
    call.end()  # its only worker is at the other call
    busy.set()
    blocked.end()
    pool.send(_threads._Call((through := threading.Event()).set), 1)  # behind it in the queue
    assert through.wait(10)
    assert not calls


def test_what_has_begun_is_waited_for():
    ended, begun = [], threading.Event()
    caller = threading.get_ident()

    def work():
        if threading.get_ident() == caller:
            begun.wait(10)
            return
        begun.set()
        time.sleep(0.05)
        ended.append(1)

    spread(work, 2)
    assert ended == [1]


@pytest.mark.parametrize("where", ["caller", "worker"])
def test_an_error_reaches_the_caller(where):
    caller, begun = threading.get_ident(), threading.Event()

    def work():
        here = "caller" if threading.get_ident() == caller else "worker"
        if here == "worker":
            begun.set()
        begun.wait(10)
        if here == where:
            raise ZeroDivisionError(here)

    with pytest.raises(ZeroDivisionError, match=where):
        spread(work, 2)
    test_all_threads_share_the_work(2)


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals of threads")
def test_an_interruption_waits_for_workers():
    """They write into memory that the caller keeps alive."""
    caller, begun, ended = threading.main_thread().ident, threading.Event(), []
    if threading.get_ident() != caller:
        pytest.skip("signals reach the main thread only")

    def work():
        if threading.get_ident() == caller:
            begun.wait(10)
            return
        begun.set()
        time.sleep(0.05)  # the caller waits by now
        signal.pthread_kill(caller, signal.SIGINT)
        time.sleep(0.05)
        ended.append(1)

    with pytest.raises(KeyboardInterrupt):
        spread(work, 2)
    assert ended == [1]


def test_several_threads_call_at_once():
    everything = [Pieces(30) for _ in range(6)]
    callers = [threading.Thread(target=spread, args=(pieces, 3)) for pieces in everything]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert all(sorted(pieces.done) == list(range(30)) for pieces in everything)


def test_work_that_spreads_itself():
    inner = [Pieces(10, 0) for _ in range(4)]
    left = deque(inner)

    def work():
        while left:
            try:
                pieces = left.popleft()
            except IndexError:
                return
            spread(pieces, 2)

    spread(work, 2)
    assert all(sorted(pieces.done) == list(range(10)) for pieces in inner)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # which may leave a child without its threads
def test_a_child_has_workers_of_its_own():
    spread(Pieces(10), 2)
    child = os.fork()
    if child == 0:
        pieces = Pieces(20, threads=2)
        spread(pieces, 2)
        os._exit(0 if len(pieces.by) == 2 and sorted(pieces.done) == list(range(20)) else 1)
    assert os.waitpid(child, 0)[1] == 0
