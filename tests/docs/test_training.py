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
        port = str(free.getsockname()[1])
    os.environ |= {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
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
    """The weights that training ends with, and all samples that it saw."""
    seen = {}
    for path in sorted((folder / "seen").iterdir()):
        try:
            sample = torch.load(path, weights_only=True)
        except (RuntimeError, EOFError):  # what a process was writing when it died
            continue
        again = seen.setdefault(path.name.partition(".")[0], sample)
        assert all(torch.equal(again[field], sample[field]) for field in sample), path.name
    return torch.load(folder / "network.pt", weights_only=True), seen


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform != "linux" or not (torch.distributed.is_available() and torch.distributed.is_gloo_available()),
    reason="needs gloo, and signals",
)
def test_two_ranks_and_a_killed_run_train_as_one_process(tmp_path):
    (code,) = re.findall(r"```python\n(# train\.py\n.*?)```", PAGE.read_text(), re.S)
    (tmp_path / "train.py").write_text(code)
    (tmp_path / "watch.py").write_text(WATCH)
    for name in ("whole", "killed"):
        (tmp_path / name / "seen").mkdir(parents=True)
    environment = {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    # in the last step of the second epoch, after a checkpoint of the step before it
    command = [sys.executable, "watch.py", "whole:0", "killed:8", "killed:0"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=240, env=os.environ | environment
    )
    whole, first, second = done.stdout.splitlines()
    assert (whole, second) == ("0 0", "0 0"), done.stderr
    assert first.endswith(" -9"), done.stderr
    state = torch.load(tmp_path / "killed" / "at_death.pt", weights_only=True)
    assert (state["epoch"], state["done"]) == (1, 3)

    space = {"__name__": "train"}
    exec(code, space)
    data, samples = space["Faces"](), {}
    for epoch in range(2):
        data.augment.set_epoch(epoch)
        samples |= {f"{epoch}-{index}": data[index] for index in range(len(data))}
    weights, seen = results(tmp_path / "whole")
    after, again = results(tmp_path / "killed")
    for others in (seen, again):
        assert others.keys() == samples.keys()
        for name, sample in samples.items():
            for field, value in sample.items():
                assert torch.equal(others[name][field], value), (name, field)
    assert not torch.equal(samples["0-5"]["image"], samples["1-5"]["image"])
    assert all(torch.equal(after[name], value) for name, value in weights.items())
