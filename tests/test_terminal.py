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


def bar(monkeypatch, clock, *, tty, seconds, steps=((10, 0), (30, 10), (100, 10))):
    stream = Terminal(tty)
    monkeypatch.setattr(sys, "stderr", stream)
    shown = terminal.Bar("dewarping", "images")
    for done, kept in steps:
        clock[0] += seconds
        shown.show(done, 100, kept)
    shown.close()
    return stream.text


def test_a_bar_has_the_rate_and_the_time_left(monkeypatch, clock):
    text = bar(monkeypatch, clock, tty=True, seconds=2)
    _, first, second, third, blank, end = text.split("\r")
    assert first == "dewarping [==                  ]  10 %, 10 of 100 images, 5/s, 18 s left"
    # what was done before counts for nothing
    assert second.startswith("dewarping [======              ]  30 %, 30 of 100 images, 5/s, 14 s left")
    assert third.startswith("dewarping [====================] 100 %, 100 of 100 images, 15/s, 0 s left")
    assert blank.isspace()
    assert end == ""


def test_a_bar_in_a_file_is_a_line_now_and_then(monkeypatch, clock):
    assert bar(monkeypatch, clock, tty=False, seconds=20) == (
        "camtorch: dewarping: 30 of 100 images, 0.5/s, 2 min left\n"
    )
    assert bar(monkeypatch, clock, tty=True, seconds=0.1) == ""


def test_a_bar_fits_its_terminal(monkeypatch, clock):
    monkeypatch.setenv("COLUMNS", "40")
    assert max(map(len, bar(monkeypatch, clock, tty=True, seconds=9999).split("\r"))) == 39


def test_names_do_not_steer_the_terminal(capsys):
    terminal.say("error: \x1b[2J\u202egone\n.jpg: späce 日本")
    assert capsys.readouterr().err == r"camtorch: error: \x1b[2J\u202egone .jpg: späce 日本" + "\n"
