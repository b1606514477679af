"""The training of the guide: two ranks see what one process sees, and a killed run ends as one that was not."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "training.md"
# Trains on two ranks in each folder that is named with the step at which rank 1 dies, or 0; says how both ended, and
# keeps all samples. The ranks are forks, so that torch is imported once.
WATCH = """
import os, shutil, signal, socket, sys, torch, train

step, load, count = torch.optim.Adam.step, train.Faces.__getitem__, 0

def counted(self, *arguments):
    global count
    count += 1
    if count == kill_at and os.environ["RANK"] == "1":
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self, *arguments)

def kept(self, index):
    sample = load(self, index)
    torch.save(sample, f"seen/{self.augment.epoch}-{index}.{os.getpid()}.pt")
    return sample

torch.optim.Adam.step, train.Faces.__getitem__ = counted, kept
start = os.getcwd()
for words in sys.argv[1:]:
    folder, kill_at = words.split(":")
    kill_at, ranks = int(kill_at), []
    os.chdir(os.path.join(start, folder))
    with socket.create_server(("127.0.0.1", 0)) as free:
        os.environ |= {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
    for rank in "01":
        os.environ["RANK"] = rank
        ranks.append(os.fork())
        if not ranks[-1]:
            train.main()
            os._exit(0)
    print(*(os.waitstatus_to_exitcode(os.waitpid(rank, 0)[1]) for rank in ranks), flush=True)
    if kill_at:
        shutil.copy("checkpoint.pt", "at_death.pt")
"""


def results(folder):
    """The weights that training ends with, and all samples that it saw; those seen again are the same."""
    seen = {}
    for path in (folder / "seen").iterdir():
        try:
            sample = torch.load(path, weights_only=True)
        except (RuntimeError, EOFError):  # what a process was writing when it died
            continue
        same(sample, seen.setdefault(path.name.partition(".")[0], sample))
    return torch.load(folder / "network.pt", weights_only=True), seen


def same(*pair):
    torch.testing.assert_close(*pair, rtol=0, atol=0)


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform != "linux" or not (torch.distributed.is_available() and torch.distributed.is_gloo_available()),
    reason="needs gloo, and signals",
)
def test_two_ranks_and_a_killed_run_train_as_one_process(tmp_path):
    (code,) = re.findall(r"```python\n(# train\.py\n.*?)```", PAGE.read_text(), re.S)
    (tmp_path / "train.py").write_text(code)
    for name in ("whole", "killed"):
        (tmp_path / name / "seen").mkdir(parents=True)
    environment = {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    # in the last step of the second epoch, after a checkpoint of the step before it
    command = [sys.executable, "-c", WATCH, "whole:0", "killed:8", "killed:0"]
    options = {"capture_output": True, "text": True, "timeout": 240, "env": os.environ | environment}
    done = subprocess.run(command, cwd=tmp_path, **options)
    whole, first, second = done.stdout.splitlines()
    assert (whole, first[-3:], second) == ("0 0", " -9", "0 0"), done.stderr
    state = torch.load(tmp_path / "killed" / "at_death.pt", weights_only=True)
    assert (state["epoch"], state["done"]) == (1, 3)

    space = {"__name__": "train"}
    exec(code, space)
    data, samples = space["Faces"](), {}
    for epoch in range(2):
        data.augment.set_epoch(epoch)
        samples |= {f"{epoch}-{index}": data[index] for index in range(len(data))}
    assert not torch.equal(samples["0-5"]["image"], samples["1-5"]["image"])
    (weights, seen), (after, again) = (results(tmp_path / name) for name in ("whole", "killed"))
    same([seen, again, after], [samples, samples, weights])
