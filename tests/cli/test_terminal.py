"""What the command prints on stderr."""

import io
import sys
import time

import pytest

from camtorch.cli import terminal


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.slow
@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_work_of_more_than_a_moment_shows_how_far_it_is_and_leaves_nothing(monkeypatch, stream):
    stderr = stream()
    monkeypatch.setattr(sys, "stderr", stderr)
    with terminal.progress("searching") as show, terminal.bar("dewarping", 100, "images") as bar:
        time.sleep(0.6)  # in a file nothing is shown before 30 seconds
        show(0.25)
        bar.update(10)
    for text in ("searching:  25 %|", "dewarping:  10%|", "10/100", " images/s"):
        assert (text in stderr.getvalue()) == stderr.isatty()
    assert not stderr.getvalue().split("\r")[-1].strip()


def test_messages_are_one_line_and_do_not_steer_the_terminal(capsys):
    terminal.note("what\n  pillow said")
    terminal.say("error: \x1b[2J\u202egone\n.jpg: späce 日本")
    assert capsys.readouterr().err == (
        "camtorch: note: what pillow said\n" + r"camtorch: error: \x1b[2J\u202egone .jpg: späce 日本" + "\n"
    )
