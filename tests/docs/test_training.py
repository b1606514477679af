"""The training of the guide: two ranks see what one process sees, and a killed run ends as one that was not."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "training.md"
# Counts what the network learns, dies once where it is told to, and keeps all samples.
WATCH = """
import os, signal, sys, torch, train

kill_at = int(sys.argv[1])
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
train.main()
"""


def run(folder, ranks, kill_at=0):
    """Run the guide's training in a folder; rank 1 dies at a step."""
    command = [sys.executable]
    if ranks > 1:
        command += ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}"]
    environment = {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    done = subprocess.run(
        [*command, "watch.py", str(kill_at)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ | environment,
    )
    assert (done.returncode != 0) == ("exitcode: -9" in done.stderr) == (kill_at > 0), done.stderr


def trained(folder, ranks, kill_at=0):
    """The weights that a run ends with, and all samples that it saw."""
    (folder / "seen").mkdir(parents=True)
    (code,) = re.findall(r"```python\n(# train\.py\n.*?)```", PAGE.read_text(), re.S)
    (folder / "train.py").write_text(code)
    (folder / "watch.py").write_text(WATCH)
    if kill_at:
        run(folder, ranks, kill_at)
        state = torch.load(folder / "checkpoint.pt", weights_only=True)
        assert (state["epoch"], state["done"]) == (1, 3)
    run(folder, ranks)
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
    _, samples = trained(tmp_path / "alone", 1)
    assert len(samples) == 64
    whole, seen = trained(tmp_path / "whole", 2)
    # in the last step of the second epoch, after a checkpoint of the step before it
    killed, again = trained(tmp_path / "killed", 2, kill_at=8)
    for others in (seen, again):
        assert others.keys() == samples.keys()
        for name, sample in samples.items():
            for field, value in sample.items():
                assert torch.equal(others[name][field], value), (name, field)
    assert not torch.equal(samples["0-5"]["image"], samples["1-5"]["image"])
    assert all(torch.equal(killed[name], weights) for name, weights in whole.items())
