"""Batches that workers send in memory which is used again: what comes out stays what it is."""

import copy
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset
from torch.utils.data._utils.collate import default_collate_fn_map

from camtorch.augment import collate
from camtorch.native import shared_memory

pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
LINUX = pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="memory is torch's own here")
BATCH, BATCHES = 4, 16


class Numbers(Dataset):
    """Samples that say which one they are."""

    def __len__(self):
        return BATCH * BATCHES

    def __getitem__(self, i):
        return {
            "image": np.full((160, 160, 3), i % 256, np.uint8),
            "depth": torch.full((160, 160), float(i), dtype=torch.float64),
            "keypoints": torch.full((5, 2), float(i)),
            "valid": torch.tensor([True, False]),
            "none": np.zeros((0, 3), np.float32),
            "number": i,
            "half": torch.full((2,), float(i), dtype=torch.bfloat16),
        }


def loader(collate_fn=collate, context="fork"):
    if context not in torch.multiprocessing.get_all_start_methods():
        pytest.skip(f"this system cannot {context}")
    options = {"collate_fn": collate_fn, "multiprocessing_context": context, "persistent_workers": True}
    return DataLoader(Numbers(), BATCH, num_workers=2, **options)


def check(batch, n):
    rows = torch.arange(n * BATCH, (n + 1) * BATCH)
    for name, value in batch.items():
        assert type(value) is torch.Tensor
        assert len(value) == BATCH
        if name not in ("valid", "none"):
            assert (value.double().reshape(BATCH, -1) == rows[:, None]).all(), name


def numbered(batches):
    for n, batch in enumerate(batches):
        check(batch, n)
        yield n, batch


@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_batches_that_are_kept_stay(context, every):
    batches = loader(context=context)
    for _ in range(2):
        kept = [(n, batch) for n, batch in numbered(batches) if n % every == 0]
        for n, batch in kept:
            check(batch, n)
    assert kept[0][1]["valid"].dtype == torch.bool
    assert kept[0][1]["none"].shape == (BATCH, 0, 3)
    batch = kept[0][1]["image"]
    batch += 1
    view = batch[1:, ::2]
    del batch, kept
    for _ in batches:  # a view keeps memory, too
        assert (view.flatten(1).amin(1) == torch.tensor([2, 3, 4])).all()


@LINUX
def test_memory_is_used_again():
    batches, files = loader(), set()
    for _ in range(3):
        for _ in batches:
            maps = map(str.split, Path("/proc/self/maps").read_text().splitlines())
            files |= {inode for _, _, _, _, inode, *name in maps if "/memfd:camtorch" in name}
    assert 0 < len(files) < BATCHES


def changed(samples):
    """A function of somebody's own around it."""
    batch = collate(samples)
    return {
        **batch,
        "channels first": batch["image"].permute(0, 3, 1, 2),
        "view": batch["depth"][:, 3:],
        "computed": batch["keypoints"] * 2 - batch["keypoints"],
        "deep": copy.deepcopy(batch["image"]),
        "pickled": pickle.loads(pickle.dumps(batch["image"])),
        "in place": batch["half"].unsqueeze_(-1),
    }


def kept_in_the_worker(samples, last=[]):  # noqa: B006 (which is what is tested)
    last[:] = [*last[-1:], collate(samples)]
    return last[0]


def test_what_is_made_of_a_batch_in_a_worker_arrives():
    for _, batch in numbered(loader(changed)):
        assert batch["channels first"].shape == (BATCH, 3, 160, 160)
        assert batch["in place"].shape == (BATCH, 2, 1)


def test_a_batch_that_a_worker_keeps_is_not_written_to():
    # of each of the two workers the batch before, which has been sent already once
    seen = [int(batch["image"].amin()) for batch in loader(kept_in_the_worker)]
    assert seen == [BATCH * max(n - 2, n % 2) for n in range(BATCHES)]


def forked(value, number):
    """A child that has an image, and a function: whether all of it still is a number there."""
    ask, child = os.pipe(), os.fork()
    if not child:
        os.read(ask[0], 1)
        os._exit(0 if (value == number).all() else 1)

    def answer():
        os.write(ask[1], b"?")
        return os.waitpid(child, 0)[1] == 0

    return answer


class ForkedInAWorker:
    """Of each worker's first batch a child reads at its last."""

    def __call__(self, samples):
        batch = collate(samples)
        n = int(batch["number"][0]) // BATCH
        if n < 2:
            self.answer = forked(batch["image"], torch.arange(n * BATCH, (n + 1) * BATCH)[:, None, None, None])
        return {**batch, "right": self.answer() if n >= BATCHES - 2 else None}


@LINUX
def test_what_a_child_has_of_a_batch_stays():
    batches = loader()
    first = next(iter(batches))
    answer = forked(first["image"], torch.arange(BATCH)[:, None, None, None])
    del first
    for _ in range(2):
        for _ in numbered(batches):
            pass
    assert answer()
    assert [batch["right"] for batch in loader(ForkedInAWorker())] == [None] * (BATCHES - 2) + [True] * 2


def test_another_strategy_of_torchs_is_kept(monkeypatch):
    monkeypatch.setattr(shared_memory, "get_sharing_strategy", lambda: "file_system")
    for _, batch in numbered(loader()):
        assert batch["image"].is_shared()
        assert not batch["number"].is_shared()


def test_what_arrives_can_be_saved_and_loaded(tmp_path):
    batch = next(iter(loader()))
    for value in batch["image"], batch["depth"]:
        assert value.untyped_storage().nbytes() == value.nbytes
        torch.save(value, tmp_path / "batch.pt")
        assert torch.equal(torch.load(tmp_path / "batch.pt"), value)


UNLIKE = {
    "sparse": lambda: torch.eye(3).to_sparse(),
    "compressed": lambda: torch.eye(3).to_sparse_csr(),
    "conjugate": lambda: torch.ones(3, dtype=torch.complex64).conj(),
    "quantized": lambda: torch.quantize_per_tensor(torch.ones(3), 0.1, 0, torch.quint8),
    "learns": lambda: torch.ones(3, requires_grad=True),
}


@pytest.mark.filterwarnings("ignore::UserWarning")  # torch's, of what is beta
@pytest.mark.parametrize("name", UNLIKE)
def test_what_is_more_than_its_bytes_goes_torchs_way(monkeypatch, name):
    class Odd:
        """Whose batches are made by a function of somebody's own."""

    monkeypatch.setitem(default_collate_fn_map, Odd, lambda batch, *, collate_fn_map=None: UNLIKE[name]())
    options = {"collate_fn": collate, "timeout": 30, "multiprocessing_context": "fork"}
    value = next(iter(DataLoader([Odd()] * 2, 2, num_workers=1, **options)))
    assert value.layout == UNLIKE[name]().layout
    assert value.requires_grad == (name == "learns")
