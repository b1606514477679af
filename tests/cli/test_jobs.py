"""Many files at once: which are meant, which part is whose, and processes that die."""

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
from camtorch.jobs.run import Account, run


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


# -- inputs


@pytest.fixture
def tree():
    """Files in folders, and a function that says which of them are found, and their places."""
    for name in ("in/10.jpg", "in/2.JPG", "in/deep/1.png", "in/deep/notes.txt", "in/.hidden.jpg", "in/.git/3.jpg"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(name)

    def found(*words, output="out"):
        return {str(path): str(place) for path, place in inputs.find(words, inputs.IMAGES, Path(output))}

    return found


def test_files_are_found_with_their_places(tree):
    everything = {"in/2.JPG": "2.JPG", "in/10.jpg": "10.jpg", "in/deep/1.png": "deep/1.png"}  # 2 before 10
    for words, expected in (
        (["in"], everything),
        (["in/deep", "in/2.JPG", "in/2.JPG"], {"in/2.JPG": "2.JPG", "in/deep/1.png": "deep/1.png"}),
        (["in/**/*"], everything),
        (["in/d*/*"], {"in/deep/1.png": "deep/1.png"}),
    ):
        assert list(tree(*words).items()) == list(expected.items())
    Path("in/[1].jpg").write_text("the name of a file, not a pattern")
    assert tree("in/[1].jpg") == {"in/[1].jpg": "[1].jpg"}
    Path("in/empty").mkdir()
    for word in ("in/*gif", "in/empty"):
        with pytest.raises(ValueError, match=r"no file in there ends in .bmp"):
            tree(word)
    Path("in/out").mkdir()
    Path("in/out/2.JPG").write_text("made")
    for word in ("in", "in/**/*", "."):
        assert not any("out" in name for name in tree(word, output="in/out"))
    assert tree("in/out", output="in/out") == {"in/out/2.JPG": "2.JPG"}  # and is refused by `items.check`


def test_links(tree):
    Path("elsewhere").mkdir()
    Path("elsewhere/5.jpg").touch()
    for name, target in (("there", "../elsewhere"), ("deep/up", ".."), ("me.jpg", "me.jpg"), ("gone.jpg", "no.jpg")):
        Path("in", name).symlink_to(target)
    os.mkfifo("in/pipe.jpg")
    # a link to nothing is taken, so that it is told of; a circle shows nothing new
    lost = {"in/gone.jpg", "in/me.jpg"}
    assert tree("in").keys() == {"in/2.JPG", "in/10.jpg", "in/deep/1.png", "in/there/5.jpg", *lost}
    assert tree("in/**/*.jpg").keys() == {"in/10.jpg", "in/there/5.jpg", *lost}


# -- shards

TORCHRUN, SRUN = {"TORCHELASTIC_RUN_ID": "none"}, {"SLURM_JOB_ID": "7", "SLURM_STEP_ID": "0"}


@pytest.mark.parametrize(
    ("values", "shard"),
    [
        ({}, Shard()),
        ({"RANK": "0", "WORLD_SIZE": "4"}, Shard()),  # left over in a shell
        (TORCHRUN | {"RANK": "1", "WORLD_SIZE": "3", "LOCAL_WORLD_SIZE": "2"}, Shard(1, 3, 2)),
        ({"SLURM_JOB_ID": "7", "SLURM_PROCID": "0", "SLURM_NTASKS": "4"}, Shard()),  # a script that sbatch runs
        (SRUN | {"SLURM_PROCID": "2", "SLURM_NTASKS": "4", "RANK": "0", "WORLD_SIZE": "2"}, Shard(2, 4)),
        (TORCHRUN | SRUN | {"RANK": "0", "WORLD_SIZE": "2", "SLURM_PROCID": "3", "SLURM_NTASKS": "4"}, Shard(0, 2)),
        *((TORCHRUN | numbers, None) for numbers in (
            {}, {"WORLD_SIZE": "2"}, {"RANK": "2", "WORLD_SIZE": "2"}, {"RANK": "-1", "WORLD_SIZE": "2"},
        )),
    ],
)  # fmt: skip
def test_shards(monkeypatch, values, shard):
    for name in os.environ:
        if name.startswith(("SLURM", "TORCHELASTIC")) or name.endswith(("RANK", "WORLD_SIZE")):
            monkeypatch.delenv(name)
    for name, value in values.items():
        monkeypatch.setenv(name, value)
    if shard is None:
        with pytest.raises(ValueError, match="which shard"):
            Shard.of_environment()
        return
    assert Shard.of_environment() == shard
    parts = [Shard(rank, shard.count).of(range(5)) for rank in range(shard.count)]
    assert sorted(number for part in parts for number in part) == list(range(5))


# -- jobs


def jobs_of(texts):
    """Items whose inputs say that, in order of their names."""
    Path("in").mkdir(exist_ok=True)
    made = []
    for name, text in sorted(texts.items()):
        Path("in", name).write_text(text)
        made.append(Item((Path("in", name),), (Path("out", name), Path("out/more", name))))
    return made


def carried_out(todo, **options):
    return run(todo, Doubling(), Account(Path("out"), "doubling", 0, Shard()), **options)


def contents():
    """Of all files but the accounts."""
    files = [path for path in Path("out").rglob("*") if path.is_file() and not path.name.startswith(".camtorch")]
    return {str(path.relative_to("out")): path.read_text() for path in files}


def left_over(todo):
    return all_left_over([os.path.realpath(path) for item in todo for path in item.outputs])


def started(texts, **options):
    """A process of its own that works on them, when it has come to one that says "wait"."""
    code = (
        "from copying import *; from test_jobs import *; import signal; "
        "signal.signal(signal.SIGINT, signal.default_int_handler); "  # what runs in the background ignores it
        f"carried_out(jobs_of({texts}), **{options})"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=subprocess.PIPE, text=True,
                               start_new_session=True)  # fmt: skip
    while not Path("out/waiting").exists():
        assert process.poll() is None
        time.sleep(0.01)
    return process


def test_where_no_job_has_begun_nothing_is_gone_on_from():
    todo = jobs_of({"a": "1", "b": "2"})
    Path("out").mkdir()
    Path("out/a").write_text("mine")
    for resume in (False, True):
        with pytest.raises(FileExistsError, match="out/a: exists already"):
            carried_out(todo, resume=resume)
        assert contents() == {"a": "mine"}
    assert carried_out(todo, force=True).made == 2
    assert Path("out/a").read_text() == "11"
    (account,) = Path("out").glob(".camtorch*")  # lines of nobody's do no harm
    account.write_bytes(account.read_bytes() + b'\n[1]\n{"outputs": [[1]], "result": 1}\n{"outputs": ["a"]}\n\xff\n"')
    assert carried_out(todo, resume=True).kept == 2


@pytest.mark.slow
def test_processes_make_what_one_makes_and_go_on_where_one_was_killed():
    texts = {f"{i:02}": "1" for i in range(20)} | {"04": "fail", "05": "note", "03": "die"}
    todo = jobs_of(texts)
    with pytest.raises(ChildProcessError, match="a process was killed"):
        carried_out(todo, processes=2)
    assert left_over(todo) == []
    Path("in/03").write_text("1")
    parts = []
    report = carried_out(todo, processes=2, resume=True, done=lambda: parts.append(1))
    assert (report.failed, report.made + report.kept) == ({"in/04": "it says so"}, 19)
    assert report.notes in ({"is a note": ["in/05"]}, {})  # where it was made before
    assert len(parts) == 20
    assert contents().keys() == {f"{place}{name}" for name in texts if name != "04" for place in ("", "more/")}


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_processes_end_with_who_started_them(number):
    process = started({"a": "wait", "b": "wait", "c": "3"}, processes=2)
    time.sleep(0.5)
    process.send_signal(number)
    _, error = process.communicate(timeout=15)
    with contextlib.suppress(ProcessLookupError):
        for _ in range(300):  # until nobody of them is there
            os.killpg(process.pid, 0)
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGKILL)
        pytest.fail("processes that stay")
    if number == signal.SIGINT:  # what an interrupt leaves is in order
        assert contents() == {"waiting": ""}
        assert "KeyboardInterrupt" in error
