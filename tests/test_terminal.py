"""What the command says on stderr."""

import sys

import pytest

from camtorch.cli import terminal


class Terminal:
    """A stream that is one, and keeps what it is told."""

    def __init__(self, tty):
        self.tty, self.text = tty, ""

    def isatty(self):
        return self.tty

    def write(self, text):
        self.text += text

    def flush(self):
        pass


@pytest.fixture
def clock(monkeypatch):
    """The time in seconds, in a list of one."""
    now = [0.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    return now


def told(monkeypatch, clock, *, tty, seconds):
    stream = Terminal(tty)
    monkeypatch.setattr(sys, "stderr", stream)
    show = terminal.progress("dewarping")
    for part in (0.25, 0.5, 1.0):
        clock[0] += seconds
        show(part)
    return stream.text


def test_long_work_shows_how_far_it_is_and_leaves_nothing(monkeypatch, clock):
    text = told(monkeypatch, clock, tty=True, seconds=5)
    assert text.startswith("\rdewarping: 25 %\rdewarping: 50 %\r")
    # what a terminal shows in the end: blanks over all that stood there
    *_, last, end = text.split("\r")
    assert last == " " * len("dewarping: 100 %")
    assert end == ""


def test_short_work_and_files_show_nothing(monkeypatch, clock):
    assert told(monkeypatch, clock, tty=True, seconds=0.1) == ""
    assert told(monkeypatch, clock, tty=False, seconds=5) == ""


def test_messages_are_one_line(capsys):
    terminal.note("what\n  pillow said")
    assert capsys.readouterr().err == "camtorch: note: what pillow said\n"
