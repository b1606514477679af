"""`camtorch dewarp` on folders."""

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

TRIALS = int(os.environ.get("CAMTORCH_TRIALS", "1"))
WORDS = ["dewarp", "in", "--camera", "camera.yml", "-o", "out/"]


@pytest.fixture
def folder(folder):
    """Images of one camera in folders."""
    write_images({"1.png": "RGB", "2.jpg": "RGB", "deep/1.png": "L", "deep/er/3.tif": "I;16", "deep/4.webp": "RGBA"})
    return folder


def write_images(modes, seed=0):
    generator = np.random.default_rng(seed)
    for name, mode in modes.items():
        path = Path("in", name)
        path.parent.mkdir(parents=True, exist_ok=True)
        if mode == "I;16":
            image = Image.fromarray(generator.integers(0, 65536, (64, 96)).astype(np.uint16))
        else:
            channels = {"L": ()}.get(mode, (len(mode),))
            image = Image.fromarray(generator.integers(0, 256, (64, 96, *channels), dtype=np.uint8))
        exif = Image.Exif()
        exif[0x0112] = 6
        image.save(path, **({"exif": exif} if path.suffix == ".jpg" else {"lossless": True}))


def outputs(place="out"):
    """What is in all files but the accounts."""
    files = [path for path in Path(place).rglob("*") if path.is_file() and not path.name.startswith(".camtorch")]
    return {str(path.relative_to(place)): path.read_bytes() for path in files}


def test_a_folder_is_dewarped_as_its_images_one_by_one(folder, capsys):
    command(*WORDS, "--jobs", 1, "--fov", 90)
    told = capsys.readouterr()
    assert told.err == ""
    assert told.out == (
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


def test_what_there_is_already(folder, capsys):
    assert refused(capsys, *WORDS[:-1], "new.png").endswith("-o OUT/ names a folder\n")
    command(*WORDS, "--dry-run")
    assert "in/1.png -> out/1.png\n" in (told := capsys.readouterr().out)
    assert told.endswith("5 to be made, 0 there already\n")
    assert not Path("out").exists()
    command(*WORDS, "--jobs", 1)
    before = outputs()
    assert "out/1.png: exists already, and 4 more of 5; --resume goes on" in refused(capsys, *WORDS)
    Path("in/1.png").rename("in/9.png")
    Path("out/2.jpg").write_bytes(b"")
    Path("out/deep/1.png").unlink()
    Path("in/deep/4.webp").write_bytes(Path("in/2.jpg").read_bytes())
    command(*WORDS, "--dry-run", "--resume")
    changed = [("2.jpg", "2.jpg"), ("9.png", "9.png"), ("deep/1.png", "deep/1.png"), ("deep/4.webp", "deep/4.webp")]
    lines = "".join(f"in/{old} -> out/{new}\n" for old, new in changed)
    assert capsys.readouterr().out == f"{lines}4 to be made, 1 there already\n"
    command(*WORDS, "--jobs", 1, "--resume")
    assert "out: 4 of 5 files made, kannala" in (told := capsys.readouterr().out)
    assert told.endswith("; 1 were there already\n")
    after = outputs()
    assert after == before | {"9.png": before["1.png"], "deep/4.webp": after["deep/4.webp"]}
    assert after["deep/4.webp"] != before["deep/4.webp"]
    (account,) = Path("out").glob(".camtorch*")
    account.write_bytes(account.read_bytes()[:-40])  # cut off in the middle of the last line, as by a crash
    command(*WORDS, "--jobs", 1, "--resume")
    assert "out: 1 of 5 files made" in capsys.readouterr().out
    command(*WORDS, "--jobs", 1, "--resume", "--projection", "cylindrical")
    assert "out: 5 of 5 files made, kannala_brandt dewarped to cylindrical" in capsys.readouterr().out
    command(*WORDS, "--jobs", 1, "--force")
    assert outputs() == after


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
    told = capsys.readouterr()
    expected = [
        "in/me.png: Too many levels of symbolic links",
        "in/bomb.png: more than 179 million pixels, which are not read",
        "in/cut.png: ",
        "in/large.png: is 96x65, but the camera in camera.yml is for 96x64; ",
        *(["in/locked.png: Permission denied"] if locked else []),
        "in/nothing.png: not an image that Pillow can read",
        "in/small.png: is 1x1, but the camera in camera.yml is for 96x64; ",
        "in/words.jpg: not an image that Pillow can read",
    ]
    lines = told.err.splitlines()
    assert len(lines) == len(expected)
    for line, text in zip(sorted(lines), sorted(expected), strict=True):
        assert line.startswith(f"camtorch: error: {text}")
    assert f"; {len(expected)} failed\n" in told.out
    made = outputs()
    assert {name: made[name] for name in before} == before
    assert made.keys() - before.keys() == (set() if locked else {"locked.png"})
    command(*WORDS, "--dry-run", "--resume")
    assert capsys.readouterr().out.endswith(f"{len(expected)} to be made, {len(made)} there already\n")


def test_two_shards_are_one_run(folder, capsys, monkeypatch):
    write_images({f"more/{i}.png": "RGB" for i in range(4)})
    command(*WORDS, "--jobs", 1)
    whole = outputs()
    capsys.readouterr()
    for names in (("RANK", "WORLD_SIZE", "TORCHELASTIC_RUN_ID"), ()):
        place = names[0].lower() if names else "option"
        for rank in (0, 1):
            for name, value in zip(names, (rank, 2, 0), strict=False):
                monkeypatch.setenv(name, str(value))
            shard = [] if names else ["--shard", f"{rank + 1}/2"]
            command(*WORDS[:-1], place, "--jobs", 1, *shard)
        assert outputs(place) == whole
        told = capsys.readouterr()
        assert f"{place}, shard 2 of 2: 4 of 4 files made" in told.out
        assert told.err == ""
        for name in names:
            monkeypatch.delenv(name)
        command(*WORDS[:-1], place, "--jobs", 1, "--resume")
        assert "0 of 9 files made" in capsys.readouterr().out


def test_a_camera_without_size_is_of_the_first_image(folder, capsys):
    Path("bare.yml").write_text(MATRIX)
    Image.new("L", (48, 32)).save("in/half.png")
    Path("in/0.png").write_text("no image")
    words = ["dewarp", "in", "--camera", "bare.yml", "--model", "kannala_brandt", "-o", "out", "--jobs", 1]
    command(*words, expect=1)
    told = capsys.readouterr().err
    assert "note: bare.yml states no image size; taken to be for 96x64, as in/1.png is\n" in told
    assert "in/half.png: is 48x32, but the camera in bare.yml is for 96x64; --rescale" in told
    command(*words, "--rescale", "--resume", expect=1)
    assert opened("out/half.png").size == (48, 32)
    assert "; 1 failed\n" in capsys.readouterr().out  # images of two sizes are not all alike


def test_notes_are_said_once(folder, capsys):
    for name in "ab":
        frames = [Image.new("RGB", (96, 64), colour) for colour in ("red", "blue")]
        frames[0].save(f"in/{name}.tif", save_all=True, append_images=frames[1:])
    command(*WORDS, "--jobs", 1)
    assert capsys.readouterr().err == "camtorch: note: in/a.tif and 1 more: holds 2 images; only the first is taken\n"


def test_other_suffixes(folder, capsys):
    command(*WORDS, "--jobs", 1, "--suffix", ".png")
    assert outputs().keys() == {"1.png", "2.png", "deep/1.png", "deep/er/3.png", "deep/4.png"}
    Path("in/1.jpg").write_bytes(Path("in/2.jpg").read_bytes())
    text = refused(capsys, *WORDS, "--force", "--suffix", ".png")
    assert "in/1.jpg and in/1.png would both be written to out/1.png" in text


def test_one_image_into_a_folder(folder, capsys):
    command("dewarp", "in/1.png", "--camera", "camera.yml", "-o", "out/")
    assert outputs().keys() == {"1.png"}
    command("dewarp", "in/1.png", "--camera", "camera.yml", "-o", "new.png", "--dry-run")
    assert capsys.readouterr().out.endswith("in/1.png -> new.png\n")
    assert not Path("new.png").exists()


@pytest.mark.slow
def test_processes_make_the_same(folder):
    command(*WORDS, "--jobs", 1)
    command(*WORDS[:-1], "other", "--jobs", 2)
    assert outputs("other") == outputs()


@pytest.mark.slow
def test_killed_at_any_moment_and_gone_on(folder):
    write_images({f"{i}.png": "RGB" for i in range(10, 26)})
    words = [sys.executable, "-m", "camtorch", *WORDS[:-1]]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    begin = time.monotonic()
    subprocess.run([*words, "whole", "--jobs", "2"], check=True, capture_output=True, env=environment)
    took, whole = time.monotonic() - begin, outputs("whole")
    assert len(whole) == 21
    generator = random.Random(7)
    for trial in range(TRIALS):
        place = f"{trial}"
        for everyone in (False, True) if TRIALS > 1 else (True,):  # it is broken off as it goes on as well
            going_on = ["--resume"] if Path(place).exists() else []
            process = subprocess.Popen(
                [*words, place, "--jobs", "2", *going_on],
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment, start_new_session=True,
            )  # fmt: skip
            time.sleep(generator.uniform(0.5, 1.05) * took)
            if everyone:
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
            process.wait()
        done = subprocess.run(
            [*words, place, "--jobs", "2", "--resume"], capture_output=True, env=environment, text=True
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert outputs(place) == whole
