"""Threads: who shares work, and what comes of errors and of several callers."""

import contextlib
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from cameras import one

import camtorch as ct
from camtorch.values import threads as _threads
from camtorch.values.threads import spread


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


def test_workers_are_kept():
    spread(Pieces(10), 3)
    before = threading.active_count()
    for _ in range(5):
        spread(Pieces(10), 3)
        spread(int, 3)  # which ends before most workers begin
    assert threading.active_count() == before


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals of threads")
@pytest.mark.parametrize("interrupted", [False, True])
def test_what_has_begun_is_waited_for(interrupted):
    """Workers write into memory that the caller keeps alive."""
    caller, ended = threading.main_thread().ident, []
    if threading.get_ident() != caller:
        pytest.skip("signals reach the main thread only")

    def of_worker():
        time.sleep(0.05)  # the caller waits by now
        if interrupted:
            signal.pthread_kill(caller, signal.SIGINT)
            time.sleep(0.05)
        ended.append(1)

    usual = signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background ignores it
    try:
        with pytest.raises(KeyboardInterrupt) if interrupted else contextlib.nullcontext():
            spread(work_of_two(nothing, of_worker), 2)
    finally:
        signal.signal(signal.SIGINT, usual)
    assert ended == [1]


def work_of_two(of_caller, of_worker):
    """Work of two threads: each does its part once the worker has begun."""
    caller, begun = threading.get_ident(), threading.Event()

    def work():
        if threading.get_ident() == caller:
            begun.wait(10)
            of_caller()
        else:
            begun.set()
            of_worker()

    return work


def fail():
    raise ZeroDivisionError


def nothing():
    pass


@pytest.mark.parametrize("parts", [(fail, nothing), (nothing, fail)], ids=["caller", "worker"])
def test_an_error_reaches_the_caller(parts):
    with pytest.raises(ZeroDivisionError):
        spread(work_of_two(*parts), 2)
    test_all_threads_share_the_work(2)


def test_work_that_spreads_itself():
    inner = [Pieces(10, 0) for _ in range(4)]
    left = deque(inner)

    def work():
        while left:
            with contextlib.suppress(IndexError):
                spread(left.popleft(), 2)

    spread(work, 2)
    assert all(sorted(pieces.done) == list(range(10)) for pieces in inner)


@contextlib.contextmanager
def torch_threads(count):
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    yield
    torch.set_num_threads(before)


@pytest.mark.skipif(_threads._limits is None, reason="torch's threads are not OpenMP's")
def test_this_thread_alone_is_limited_and_to_the_end_of_the_function():
    seen = []

    def look():
        seen.append((torch.get_num_threads(), _threads.thread_count()))

    inner = _threads.on_one_thread(look)

    @_threads.on_one_thread
    def outer():
        inner()
        look()
        other = threading.Thread(target=look)
        other.start()
        other.join()
        raise ZeroDivisionError

    with torch_threads(3):
        for _ in range(2):
            with pytest.raises(ZeroDivisionError):
                outer()
            look()
    assert seen == 2 * [(1, 3), (1, 3), (3, 3), (3, 3)]


def test_several_threads_use_one_camera():
    camera = one("fisheye624").float()
    points = torch.randn(50_000, 3, generator=torch.Generator().manual_seed(0))
    expected = ct.Fisheye624(camera.intrinsics.detach(), camera.distortion.detach()).project(points)
    with ThreadPoolExecutor(4) as callers:
        for results in callers.map(camera.project, [points] * 4):
            assert all(torch.equal(a, b) for a, b in zip(results, expected, strict=True))


@pytest.mark.slow
def test_threads_end_before_the_interpreter():
    code = """
import atexit, threading

@atexit.register  # so that it is called after camtorch's
def check():
    names = [thread.name for thread in threading.enumerate()]
    print("worked" if worked else "alone", names)

from camtorch.values.threads import spread
worked, both = [], threading.Barrier(2)
spread(lambda: worked.append(both.wait(20)), 2)
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "worked ['MainThread']\n"
