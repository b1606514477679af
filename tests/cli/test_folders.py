"""`camtorch dewarp` on folders."""

import contextlib
import os
import random
import signal
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from command_line import MATRIX, command, opened, refused
from PIL import Image

from camtorch.boards.finding import IMAGES
from camtorch.cli import processes, targets

TRIALS = int(os.environ.get("CAMTORCH_TRIALS", "1"))
WORDS = ["dewarp", "in", "--camera", "camera.yml", "-o", "out/"]


@pytest.fixture
def folder(folder):
    write_images({"1.png": "RGB", "2.jpg": "RGB", "deep/1.png": "L", "deep/er/3.tif": "I;16", "deep/4.webp": "RGBA"})
    return folder


def write_images(modes, seed=0):
    generator = np.random.default_rng(seed)
    exif = Image.Exif()
    exif[0x0112] = 6
    for name, mode in modes.items():
        path = Path("in", name)
        path.parent.mkdir(parents=True, exist_ok=True)
        channels, kind = {"L": ((), np.uint8), "I;16": ((), np.uint16)}.get(mode, ((len(mode),), np.uint8))
        image = Image.fromarray(generator.integers(0, np.iinfo(kind).max + 1, (64, 96, *channels), dtype=kind))
        image.save(path, **({"exif": exif} if path.suffix == ".jpg" else {"lossless": True}))


def outputs(place="out"):
    return {str(path.relative_to(place)): path.read_bytes() for path in Path(place).rglob("[!.]*") if path.is_file()}


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """Files in folders, and a function that returns which of them are found, and their places."""
    monkeypatch.chdir(tmp_path)
    for name in ("in/10.jpg", "in/2.JPG", "in/deep/1.png", "in/deep/notes.txt", "in/.hidden.jpg", "in/.git/3.jpg"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(name)

    def found(*words, output="out"):
        return {str(path): str(place) for path, place in targets.find(words, IMAGES, Path(output))}

    return found


def test_files_are_found_with_their_places(tree):
    everything = {"in/2.JPG": "2.JPG", "in/10.jpg": "10.jpg", "in/deep/1.png": "deep/1.png"}  # 2 before 10
    few = {"in/2.JPG": "2.JPG", "in/deep/1.png": "deep/1.png"}
    for words, expected in (("in", everything), ("in/deep in/2.JPG in/2.JPG", few), ("in/**/*", everything)):
        assert list(tree(*words.split()).items()) == list(expected.items())
    assert tree("in/d*/*") == {"in/deep/1.png": "deep/1.png"}
    Path("in/[1].jpg").write_text("the name of a file, not a pattern")
    assert tree("in/[1].jpg") == {"in/[1].jpg": "[1].jpg"}
    Path("in/empty").mkdir()
    for word in ("in/*gif", "in/empty"):
        with pytest.raises(ValueError, match=r"must hold files that end in .bmp"):
            tree(word)
    Path("in/out").mkdir()
    Path("in/out/2.JPG").write_text("made")
    for word in ("in", "in/**/*", "."):
        assert not any("out" in name for name in tree(word, output="in/out"))
    assert tree("in/out", output="in/out") == {"in/out/2.JPG": "2.JPG"}  # and is refused, as it would be overwritten


def test_links(tree):
    Path("elsewhere").mkdir()
    Path("elsewhere/5.jpg").touch()
    for name, target in (("there", "../elsewhere"), ("deep/up", ".."), ("me.jpg", "me.jpg"), ("gone.jpg", "no.jpg")):
        Path("in", name).symlink_to(target)
    os.mkfifo("in/pipe.jpg")
    lost = {"in/gone.jpg", "in/me.jpg"}  # links to nothing are taken, so that an error names them
    assert tree("in").keys() == {"in/2.JPG", "in/10.jpg", "in/deep/1.png", *lost}
    assert tree("in/**/*.jpg").keys() == {"in/10.jpg", "in/there/5.jpg", *lost}


def test_a_folder_is_dewarped_as_its_images_one_by_one(folder, capsys):
    command(*WORDS, "--jobs", 1, "--fov", 90)
    printed = capsys.readouterr()
    assert printed.err == ""
    assert printed.out == (
        "out: 5 of 5 files made, kannala_brandt dewarped to perspective, 90.0 degrees wide, 96x64, fx 48 fy 48 cx 47.5 "
        "cy 31.5; 100.0 % of it is filled\n"
    )
    made = outputs()
    assert made.keys() == {"1.png", "2.jpg", "deep/1.png", "deep/er/3.tif", "deep/4.webp"}
    for name in made:
        command("dewarp", f"in/{name}", "--camera", "camera.yml", "--fov", 90, "-o", f"single/{name}")
    assert outputs("single") == made
    assert opened("out/2.jpg").getexif()[0x0112] == 6
    assert opened("out/deep/er/3.tif").mode == "I;16"
    command("dewarp", "in/1.png", "--camera", "camera.yml", "--fov", 90, "-o", "one/")
    assert outputs("one") == {"1.png": made["1.png"]}


def test_what_there_is_already(folder, capsys):
    command(*WORDS, "--jobs", 1)
    before = outputs()
    Path("in/cut.png").write_text("no image")  # is not looked at before what exists is refused
    assert "out/1.png: exists already, and 4 more of 6; --resume continues the run" in refused(capsys, *WORDS)
    Path("in/cut.png").unlink()
    Path("in/1.png").rename("in/9.png")
    Path("out/2.jpg").write_bytes(b"")  # after a loss of power
    Path("out/deep/1.png").unlink()
    Path("out/deep/4.webp").write_bytes(b"mine")
    command(*WORDS, "--jobs", 1, "--resume")
    printed = capsys.readouterr().out
    assert "out: 3 of 5 files made, kannala" in printed
    assert printed.endswith("; 2 were there already\n")
    assert outputs() == before | {"9.png": before["1.png"], "deep/4.webp": b"mine"}
    command(*WORDS, "--jobs", 1, "--resume")
    assert capsys.readouterr().out == "out: 0 of 5 files made; 5 were there already\n"
    command(*WORDS, "--jobs", 1, "--force")
    assert outputs() == before | {"9.png": before["1.png"]}


def test_hostile_files_are_a_line_each(folder, capsys, monkeypatch):
    command(*WORDS, "--jobs", 1)
    before = outputs()
    photo = Path("in/1.png").read_bytes()
    Path("in/cut.png").write_bytes(photo[: len(photo) // 2])
    Path("in/words.jpg").write_text("no image")
    Path("in/nothing.png").touch()
    Image.new("L", (96, 65)).save("in/large.png")
    header = b"IHDR" + struct.pack(">2I", 20000, 20000) + photo[24:29]
    Path("in/bomb.png").write_bytes(photo[:12] + header + struct.pack(">I", zlib.crc32(header)) + photo[33:])
    Image.new("L", (1, 1)).save("in/small.png")
    Path("in/deep/circle").symlink_to("..", target_is_directory=True)
    Path("in/more").symlink_to("../..", target_is_directory=True)
    Path("in/me.png").symlink_to("me.png")
    Path("in/locked.png").write_bytes(photo)
    Path("in/locked.png").chmod(0)
    locked = not os.access("in/locked.png", os.R_OK)  # not from root
    capsys.readouterr()
    command(*WORDS, "--jobs", 1, "--force", expect=1)
    printed = capsys.readouterr()
    expected = [
        "in/me.png: Too many levels of symbolic links",
        "in/bomb.png: Image size (400000000 pixels) exceeds limit",
        "in/cut.png: ",
        "in/large.png: must be 96x64, as the camera in camera.yml; got 96x65.",
        *(["in/locked.png: Permission denied"] if locked else []),
        "in/nothing.png: cannot identify image file",
        "in/small.png: must be 96x64, as the camera in camera.yml; got 1x1.",
        "in/words.jpg: cannot identify image file",
    ]
    lines = printed.err.splitlines()
    assert len(lines) == len(expected)
    for line, text in zip(sorted(lines), sorted(expected), strict=True):
        assert line.startswith(f"camtorch: error: {text}")
    assert f"; {len(expected)} failed\n" in printed.out
    made = outputs()
    assert {name: made[name] for name in before} == before
    assert made.keys() - before.keys() == (set() if locked else {"locked.png"})


def test_a_camera_without_size_is_of_the_first_image(folder, capsys):
    Path("bare.yml").write_text(MATRIX)
    Image.new("L", (48, 32)).save("in/half.png")
    Path("in/0.png").write_text("no image")
    words = ["dewarp", "in", "--camera", "bare.yml", "--model", "kannala_brandt", "-o", "out", "--jobs", 1]
    command(*words, expect=1)
    printed = capsys.readouterr().err
    assert "note: bare.yml states no image size; taken to be for 96x64, as in/1.png is\n" in printed
    assert "in/half.png: must be 96x64, as the camera in bare.yml; got 48x32. --rescale" in printed
    command(*words, "--rescale", "--force", expect=1)
    assert opened("out/half.png").size == (48, 32)
    assert capsys.readouterr().out == "out: 6 of 7 files made; 1 failed\n"  # images of two sizes are not all alike


def test_notes_are_printed_once(folder, capsys):
    for name in "ab":
        frames = [Image.new("RGB", (96, 64), colour) for colour in ("red", "blue")]
        frames[0].save(f"in/{name}.tif", save_all=True, append_images=frames[1:])
    command(*WORDS, "--jobs", 1)
    assert capsys.readouterr().err == "camtorch: note: in/a.tif and 1 more: only the first of 2 images is read\n"


def test_other_suffixes(folder, capsys):
    command(*WORDS, "--jobs", 1, "--suffix", ".png")
    assert outputs().keys() == {"1.png", "2.png", "deep/1.png", "deep/er/3.png", "deep/4.png"}
    Path("in/1.jpg").write_bytes(Path("in/2.jpg").read_bytes())
    text = refused(capsys, *WORDS, "--force", "--suffix", ".png")
    assert "in/1.jpg and in/1.png would both be written to out/1.png" in text


def started(*words, **options):
    """A command in a process group of its own."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-m", "camtorch", *map(str, words)]
    return subprocess.Popen(words, env=environment, start_new_session=True, **options)


def group_has_ended(number):
    for _ in range(1200):  # the first process of a machine may be slow to reap
        try:
            os.killpg(number, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    os.killpg(number, signal.SIGKILL)
    return False


@pytest.mark.slow
@pytest.mark.parametrize("how", ["forkserver", "spawn"])
def test_processes_make_the_same(folder, capsys, monkeypatch, how):
    monkeypatch.setattr(processes, "_HOW", how)
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)  # which Windows and macOS lack
    Path("in/words.jpg").write_text("no image")
    for place, jobs in (("one", ["--jobs", 1]), ("another földer", [])):
        command(*WORDS[:-1], place, *jobs, expect=1)
        assert capsys.readouterr().err.startswith("camtorch: error: in/words.jpg: cannot identify image file")
    assert outputs("one") == outputs("another földer")


@pytest.mark.parametrize(("system", "same"), [("linux", False), ("win32", True), ("darwin", True)])
def test_names_that_differ_in_case_are_one_file_on_windows_and_macos(tmp_path, monkeypatch, system, same):
    monkeypatch.setattr(sys, "platform", system)
    pairs = [(tmp_path / name, tmp_path / "out" / f"{name[0]}.png") for name in ("a.jpg", "A.bmp")]
    with pytest.raises(ValueError, match="would both be written to") if same else contextlib.nullcontext():
        assert targets.to_make(pairs, [], resume=False, force=False) == pairs


@pytest.mark.slow
def test_killed_at_any_moment_and_resumed(folder):
    write_images({f"{i}.png": "RGB" for i in range(10, 26)})
    begin = time.monotonic()
    assert started(*WORDS[:-1], "whole", "--jobs", 2, stdout=subprocess.DEVNULL).wait() == 0
    took, whole = time.monotonic() - begin, outputs("whole")
    assert len(whole) == 21
    generator = random.Random(7)
    for trial in range(TRIALS):
        place = str(trial)
        for everyone in (False, True):  # the second time as it is resumed; without the others, these end as well
            process = started(*WORDS[:-1], place, "--jobs", 2, "--resume", stdout=subprocess.DEVNULL)
            time.sleep(generator.uniform(0.5, 1.05) * took)
            os.killpg(process.pid, signal.SIGKILL) if everyone else process.kill()
            process.wait()
            assert group_has_ended(process.pid)
        process = started(*WORDS[:-1], place, "--jobs", 2, "--resume", stderr=subprocess.PIPE, text=True)
        assert (process.communicate()[1], process.returncode) == ("", 0)
        assert outputs(place) == whole


@pytest.mark.slow
@pytest.mark.parametrize("who", ["all", "one"])
def test_a_run_that_is_broken_off_is_one_line(folder, who):
    """By an interrupt, or because a process is killed."""
    write_images({f"{i}.png": "RGB" for i in range(10, 400)})
    process = started(*WORDS, "--jobs", 2, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    while len(list(Path("out").glob("*"))) < 9:
        assert process.poll() is None
        time.sleep(0.01)
    if who == "all":
        process.send_signal(signal.SIGINT)
    else:
        others = [int(found.name) for found in Path("/proc").glob("[0-9]*")]
        os.kill(max(one for one in others if os.getpgid(one) == process.pid), signal.SIGKILL)
    killed = "error: a process was killed, perhaps for lack of memory. --resume continues the run"
    printed = {"all": "interrupted\n", "one": killed}
    out, error = process.communicate(timeout=30)
    assert (out, error.count("\n")) == ("", 1)
    assert error.startswith(f"camtorch: {printed[who]}")
    assert process.returncode == {"all": 130, "one": 2}[who]
    assert group_has_ended(process.pid)
    assert len(outputs()) < 390
    assert who == "one" or not list(Path("out").rglob(".*.part"))
