"""What is refused is so in one line that names it, before anything is written."""

import contextlib
import io
import shutil
import sys
import time
from pathlib import Path

import pytest
import torch
from command_line import FILES, LEVEL, opened, refused, write_photograph
from rigs import tables

import camtorch as ct
from camtorch.cli import terminal
from camtorch.cli.main import main


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    write_photograph(folder)
    (folder / "bad.yml").write_text("K: [1, 2]")
    (folder / "bare.yml").write_text(LEVEL)
    (folder / "cut.png").write_bytes((folder / "in.png").read_bytes()[:3000])
    (folder / "images").mkdir()
    (folder / "empty").mkdir()
    shutil.copy(folder / "in.png", folder / "images")
    (folder / "film.mkv").write_bytes(b"no video")
    opened(folder / "in.png").convert("RGBA").save(folder / "alpha.png")
    lens = ct.KannalaBrandt([28.0, 28, 47, 32], [0.0] * 4, image_size=(64, 96)).double().requires_grad_(False)
    ct.save(ct.KannalaBrandt(torch.tensor([[28.0, 28, 47, 32]] * 2), torch.zeros(2, 4)), folder / "batch.json")
    poses = {"left": ct.Extrinsics([0.0] * 3, [0.0] * 3), "right": ct.Extrinsics([0.0] * 3, [-0.25, 0.0, 0.0])}
    ct.save(ct.Rig({"left": lens, "right": lens}, poses), folder / "rig.json")
    return folder


@pytest.mark.parametrize(("group", "rows"), tables(Path(__file__).with_name("errors.txt")))
def test_errors_are_one_line_and_leave_nothing(files, monkeypatch, capsys, group, rows):
    monkeypatch.chdir(files)
    before = {path: path.read_bytes() for path in files.rglob("*.*")}
    for words, text in rows:
        words = words.replace("FILES", str(FILES)).replace(r"\0", "\0").split(" ") if words else []
        assert text in refused(capsys, *words), words
        assert {path: path.read_bytes() for path in files.rglob("*.*")} == before, words


@pytest.mark.parametrize(
    ("module", "words", "text"),
    [
        ("matplotlib", "show camera.yml -o out.png", "pip install -e '.[plot]' in a checkout"),
        ("av", "dewarp in.png film.mkv --camera camera.yml -o out/", "pip install -e '.[video]' in a checkout"),
    ],
)
def test_a_package_that_lacks_is_named(files, monkeypatch, capsys, module, words, text):
    monkeypatch.chdir(files)
    monkeypatch.setitem(sys.modules, module, None)
    before = sorted(files.iterdir())
    assert text in refused(capsys, *words.split())
    assert sorted(files.iterdir()) == before


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.slow
@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_work_of_more_than_a_moment_shows_how_far_it_is_and_leaves_nothing(monkeypatch, stream):
    stderr = stream()
    monkeypatch.setattr(sys, "stderr", stderr)
    with terminal.bar("dewarping", 100, "images") as bar:
        time.sleep(0.6)  # in a file nothing is shown before 30 seconds
        bar.update(10)
    for text in ("dewarping:  10%|", "10/100", " images/s"):
        assert (text in stderr.getvalue()) == stderr.isatty()
    assert not stderr.getvalue().split("\r")[-1].strip()


def test_the_file_that_cannot_be_replaced_is_named():
    error = PermissionError(13, "Access is denied", ".0f.part", 5, "camera.yml")  # as of Windows, if it is open
    assert terminal.reason(error) == "camera.yml: Access is denied"


@pytest.mark.parametrize("console", [("cp1252", "strict"), ("cp437", "strict"), ("ascii", "surrogateescape")])
def test_a_console_without_utf8_shows_what_each_command_prints(tmp_path, monkeypatch, console):
    monkeypatch.chdir(tmp_path)
    write_photograph(tmp_path)
    Path("小 kamera.yml").write_bytes(Path("camera.yml").read_bytes())
    for words in (
        "show 小*kamera.yml --html 小.html",
        "convert 小*kamera.yml -o 小.json",
        "dewarp in.png --camera 小*kamera.yml -o 小.png",
        "map 小*kamera.yml -o 小.npz",
        "lenses 小蚁 -n 1 -o 小蚁.json",
        "dewarp --help",
        "--version",
    ):
        printed = io.BytesIO()
        stream = io.TextIOWrapper(printed, console[0], console[1])
        monkeypatch.setattr(sys, "stdout", stream)
        with contextlib.suppress(SystemExit):
            assert main([word.replace("*", " ") for word in words.split()]) == 0, words
        stream.flush()
        assert printed.getvalue(), words
        assert (b"\\u5c0f" in printed.getvalue()) == ("小" in words), printed.getvalue()


def test_messages_are_one_line_and_do_not_steer_the_terminal(capsys):
    terminal.note("what\n  pillow said")
    terminal.say("error: \x1b[2J\u202egone\n.jpg: späce 日本")
    assert capsys.readouterr().err == (
        "camtorch: note: what pillow said\n" + r"camtorch: error: \x1b[2J\u202egone .jpg: späce 日本" + "\n"
    )
