"""Many files at once: what is found, what is kept, what is made anew, and processes that die."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from copying import Doubling

from camtorch.io.writing import all_left_over
from camtorch.jobs import inputs
from camtorch.jobs.items import Item, Shard
from camtorch.jobs.manifest import Manifest
from camtorch.jobs.run import pending, run


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with files in folders."""
    monkeypatch.chdir(tmp_path)
    for name in ("in/10.jpg", "in/2.JPG", "in/deep/1.png", "in/deep/notes.txt", "in/.hidden.jpg", "in/.git/3.jpg"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(name)
    return tmp_path


def found(*words, output="out"):
    files, faults = inputs.find(words, inputs.IMAGES, Path(output))
    return {str(one.path): str(one.place) for one in files}, dict(faults)


# -- inputs


def test_files_are_found_with_their_places(folder):
    for words, expected in (
        (["in"], {"in/2.JPG": "2.JPG", "in/10.jpg": "10.jpg", "in/deep/1.png": "deep/1.png"}),  # 2 before 10
        (["in/deep", "in/2.JPG", "in/2.JPG"], {"in/2.JPG": "2.JPG", "in/deep/1.png": "deep/1.png"}),
        (["in/**/*"], {"in/2.JPG": "2.JPG", "in/10.jpg": "10.jpg", "in/deep/1.png": "deep/1.png"}),
        (["in/d*/*"], {"in/deep/1.png": "deep/1.png"}),
    ):
        files, faults = found(*words)
        assert (list(files.items()), faults) == (list(expected.items()), {})
    Path("in/[1].jpg").write_text("the name of a file, not a pattern")
    assert found("in/[1].jpg")[0] == {"in/[1].jpg": "[1].jpg"}
    Path("in/empty").mkdir()
    for word, text in (("in/.*gif", "no file of a known type"), ("in/empty", "nothing in there ends in .bmp")):
        with pytest.raises(ValueError, match=text):
            found(word.replace(".*", "*"))


def test_outputs_are_not_read_again(folder):
    Path("in/out").mkdir()
    Path("in/out/2.JPG").write_text("made")
    for word in ("in", "in/**/*", "."):
        assert not any("out" in name for name in found(word, output="in/out")[0])
    assert found("in/out", output="in/out")[0] == {"in/out/2.JPG": "2.JPG"}  # and is refused by `items.check`


def test_links(folder):
    Path("elsewhere").mkdir()
    Path("elsewhere/5.jpg").touch()
    Path("in/there").symlink_to("../elsewhere")
    Path("in/deep/up").symlink_to("..")
    Path("in/me.jpg").symlink_to("me.jpg")
    Path("in/gone.jpg").symlink_to("nowhere.jpg")
    Path("in/gone.txt").symlink_to("nowhere.txt")
    os.mkfifo("in/pipe.jpg")
    # a link to nothing is taken, so that it is told of; a circle shows nothing new
    lost = {"in/gone.jpg", "in/me.jpg"}
    assert found("in")[0].keys() == {"in/2.JPG", "in/10.jpg", "in/deep/1.png", "in/there/5.jpg", *lost}
    assert found("in/**/*.jpg")[0].keys() == {"in/10.jpg", "in/there/5.jpg", *lost}


# -- shards

TORCHRUN, SRUN = {"TORCHELASTIC_RUN_ID": "none"}, {"SLURM_JOB_ID": "7", "SLURM_STEP_ID": "0"}


@pytest.fixture
def environment(monkeypatch):
    """Sets what tells processes their shards, and nothing else of that."""

    def set_to(values):
        for name in [name for name in os.environ if name.startswith(("SLURM", "TORCHELASTIC"))]:
            monkeypatch.delenv(name)
        for name in ("RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE"):
            monkeypatch.delenv(name, raising=False)
        for name, value in values.items():
            monkeypatch.setenv(name, value)

    return set_to


@pytest.mark.parametrize(
    ("values", "shard", "left_over"),
    [
        ({}, Shard(), ""),
        ({"RANK": "0", "WORLD_SIZE": "1"}, Shard(), ""),
        ({"RANK": "0", "WORLD_SIZE": "4"}, Shard(), "RANK=0 WORLD_SIZE=4"),
        ({"RANK": "3"}, Shard(), "RANK=3 WORLD_SIZE="),
        (TORCHRUN | {"RANK": "1", "WORLD_SIZE": "3", "LOCAL_WORLD_SIZE": "2"}, Shard(1, 3, 2), ""),
        ({"SLURM_JOB_ID": "7", "SLURM_PROCID": "0", "SLURM_NTASKS": "4"}, Shard(), ""),  # a script that sbatch runs
        (SRUN | {"SLURM_PROCID": "2", "SLURM_NTASKS": "4", "RANK": "0", "WORLD_SIZE": "2"}, Shard(2, 4), ""),
        (TORCHRUN | SRUN | {"RANK": "0", "WORLD_SIZE": "2", "SLURM_PROCID": "3", "SLURM_NTASKS": "4"}, Shard(0, 2), ""),
    ],
)
def test_shards(environment, values, shard, left_over):
    environment(values)
    with pytest.warns(UserWarning, match=left_over) if left_over else contextlib.nullcontext():
        assert Shard.of_environment() == shard
    parts = [Shard(rank, shard.count).of(range(5)) for rank in range(shard.count)]
    assert sorted(number for part in parts for number in part) == list(range(5))


def test_shards_that_are_none(environment):
    for numbers in ({}, {"WORLD_SIZE": "2"}, {"RANK": "2", "WORLD_SIZE": "2"}, {"RANK": "-1", "WORLD_SIZE": "2"}):
        environment(TORCHRUN | numbers)
        with pytest.raises(ValueError, match="which shard"):
            Shard.of_environment()


# -- jobs


def jobs_of(texts):
    """Items whose inputs say that, in order of their names."""
    Path("in").mkdir(exist_ok=True)
    made = []
    for name, text in sorted(texts.items()):
        Path("in", name).write_text(text)
        made.append(Item((Path("in", name),), (Path("out", name), Path("out/more", name))))
    return made


def carried_out(todo, *, settings=0, shard=None, **options):
    with Manifest(Path("out"), "doubling", settings, shard) as manifest:
        return run(todo, Doubling(), manifest, **options)


def contents():
    """Of all files but the accounts."""
    files = [path for path in Path("out").rglob("*") if path.is_file() and not path.name.startswith(".camtorch")]
    return {str(path.relative_to("out")): path.read_text() for path in files}


@pytest.fixture
def empty(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("change", ["input", "settings", "variant", "output", "gone", "account"])
def test_what_has_changed_is_made_anew(empty, change):
    todo = jobs_of({"a": "1", "b": "2"})
    carried_out(todo)
    settings = 0
    if change == "input":
        Path("in/a").write_text("9")
    elif change == "settings":
        settings = {"other": 1.5}
    elif change == "variant":
        todo[0] = Item(todo[0].inputs, todo[0].outputs, variant="seed 7")
    elif change == "output":
        Path("out/more/a").write_text("1?")
    elif change == "gone":
        Path("out/a").unlink()
    else:  # cut off in the middle of what it says of b, as by a crash
        (account,) = Path("out").glob(".camtorch*")
        account.write_bytes(account.read_bytes()[:-40])
    with Manifest(Path("out"), "doubling", settings) as manifest:
        again = [item.name for item in pending(todo, manifest, resume=True)]
    assert again == {"settings": ["in/a", "in/b"], "account": ["in/b"]}.get(change, ["in/a"])
    report = carried_out(todo, settings=settings, resume=True)
    assert (report.made, report.kept) == (len(again), 2 - len(again))
    first = {"input": "99", "variant": "11seed 7"}.get(change, "11")
    assert contents() == {"a": first, "more/a": first, "b": "22", "more/b": "22"}
    assert carried_out(todo, settings=settings, resume=True).kept == 2


def test_what_is_not_of_the_job_is_not_overwritten(empty):
    todo = jobs_of({"a": "1", "b": "2"})
    Path("out").mkdir()
    Path("out/a").write_text("mine")
    for _ in range(2):  # nor is it later
        report = carried_out(todo, resume=True)
        assert report.failed == [("in/a", "out/a exists already, and is not of this job")]
        assert Path("out/a").read_text() == "mine"
    assert carried_out(todo, resume=True, force=True).made == 1
    assert Path("out/a").read_text() == "11"


def test_nobody_does_the_same_at_the_same_time(empty):
    with Manifest(Path("out"), "doubling", 0):
        with pytest.raises(BlockingIOError, match="another process does this right now"):
            carried_out([])
        with Manifest(Path("out"), "doubling", 0, Shard(0, 2)), Manifest(Path("out"), "other", 0):
            pass


@pytest.mark.slow
def test_what_a_crash_left_is_removed(empty):
    todo = jobs_of({"a" * 30 + "1": "1", "a" * 30 + "2": "wait"})
    code = (
        "from copying import *; from test_jobs import *; "
        "carried_out(jobs_of({'a' * 30 + '1': '1', 'a' * 30 + '2': 'wait'}))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    try:
        while not Path("out/waiting").exists():
            assert process.poll() is None
            time.sleep(0.01)
    finally:
        process.kill()
        process.wait()
    Path("out/waiting").unlink()
    outputs = [os.path.realpath(path) for item in todo for path in item.outputs]
    assert len(all_left_over(outputs)) == 1
    assert all_left_over(outputs[:2]) == []  # another name that begins alike
    Path("in", "a" * 30 + "2").write_text("2")
    report = carried_out(todo, resume=True)
    assert (report.made, report.kept) == (1, 1)
    assert all_left_over(outputs) == []
    assert len(contents()) == 4


@pytest.mark.slow
def test_processes_make_what_one_makes(empty):
    texts = {f"{i:02}": "1" for i in range(20)} | {"04": "fail", "05": "note"}
    todo = jobs_of(texts)
    seen = []
    report = carried_out(todo, processes=2, add=seen.append)
    assert report.failed == [("in/04", "it says so")]
    assert report.made == 19
    assert report.notes == {"is a note": ["in/05"]}
    assert (min(seen) >= 0, sum(seen)) == (True, 20)
    expected = {f"{place}{name}" for name, text in texts.items() if text != "fail" for place in ("", "more/")}
    assert contents().keys() == expected


@pytest.mark.slow
def test_a_process_that_is_killed_ends_the_job_which_goes_on_later(empty):
    todo = jobs_of({f"{i:02}": "1" for i in range(20)} | {"03": "die"})
    with pytest.raises(ChildProcessError, match=r"a process was killed, .*; at work were .*in/03"):
        carried_out(todo, processes=2)
    outputs = [os.path.realpath(path) for item in todo for path in item.outputs]
    assert all_left_over(outputs) == []
    Path("in/03").write_text("1")
    report = carried_out(todo, processes=2, resume=True)
    assert (report.failed, report.made + report.kept) == ([], 20)
    assert len(contents()) == 40


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_processes_end_with_who_started_them(empty, number):
    code = (
        "from copying import *; from test_jobs import *; import multiprocessing as m, signal; "
        "signal.signal(signal.SIGINT, signal.default_int_handler); "  # what runs in the background ignores it
        "carried_out(jobs_of({'a': 'wait', 'b': 'wait', 'c': '3'}), processes=2)"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=subprocess.PIPE, text=True,
                               start_new_session=True)  # fmt: skip
    try:
        while not Path("out/waiting").exists():
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(0.5)
        process.send_signal(number)
        process.wait(15)
    finally:
        process.kill()
    begin = time.monotonic()
    while time.monotonic() < begin + 15:  # until nobody of them is there
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            break
        time.sleep(0.05)
    else:
        os.killpg(process.pid, signal.SIGKILL)
        pytest.fail("processes that stay")
    assert contents() == {"waiting": ""} or number == signal.SIGKILL  # what an interrupt leaves is in order
    if number == signal.SIGINT:
        assert "KeyboardInterrupt" in process.stderr.read()
    process.stderr.close()
