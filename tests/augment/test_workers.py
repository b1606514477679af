"""Augmentations in the workers of a DataLoader."""

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

import camtorch as ct
import camtorch.augment.numpy

SIZE = (12, 16)
COUNT = 8


def camera(dtype=torch.float32):
    # learnable, as a camera is unless somebody says otherwise
    intrinsics = torch.tensor([9.0, 9.2, 7.4, 5.6], dtype=dtype)
    return ct.KannalaBrandt(intrinsics, torch.tensor([0.02, -0.01, 0.004, -0.001], dtype=dtype), image_size=SIZE)


def augmentation(**options):
    return ct.augment.RandomCamera(yaw=8, pitch=8, roll=10, tolerance=0, **options)


class Samples(Dataset):
    """The same sample again and again."""

    def __init__(self, arrays):
        self.camera, self.augmentation = camera(), augmentation(p=0.9)
        self.transform = ct.augment.numpy.Transform(self.augmentation) if arrays else self.augmentation
        self.arrays = arrays

    def __len__(self):
        return COUNT

    def __getitem__(self, index):
        image, points = torch.linspace(0, 1, 12 * 16).reshape(1, *SIZE), torch.tensor([[7.0, 5.0], [2.0, 3.0]])
        if self.arrays:
            image, points = image[0].numpy(), points.numpy()
        out = self.transform(image=image, keypoints=points, gaze=np.float32([0, 0, -1]), camera=self.camera, id=index)
        return {**out, "threads": torch.get_num_threads()}


def batches(context, arrays=False):
    options = {"num_workers": 2, "multiprocessing_context": context, "generator": torch.Generator().manual_seed(7)}
    return list(DataLoader(Samples(arrays), batch_size=2, **options))


# with threads, Python 3.12 and later warn of every fork
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("arrays", [pytest.param(False, marks=pytest.mark.slow), True])
def test_workers_differ_and_runs_repeat(arrays):
    if "fork" not in torch.multiprocessing.get_all_start_methods():
        pytest.skip("this system cannot fork")
    runs = [batches("fork", arrays), batches("fork", arrays), *([] if arrays else [batches("spawn")])]
    for run in runs:
        assert torch.cat([batch["id"] for batch in run]).tolist() == list(range(COUNT))
        assert all((batch["threads"] == 1).all() for batch in run)  # as torch gives a worker
        for batch, first in zip(run, runs[0], strict=True):
            for name in ("image", "keypoints", "keypoints_valid", "gaze", "rotation"):
                assert torch.equal(batch[name], first[name]), name
            assert torch.equal(batch["camera"].intrinsics, first["camera"].intrinsics)
            assert tuple(batch["camera"].batch_shape) == (2,)
            assert batch["camera"].image_size == SIZE
            assert not any(t.requires_grad for t in (batch["image"], batch["camera"].intrinsics))
    turned = torch.cat([batch["rotation"] for batch in runs[0]])
    moved = turned[(turned - torch.eye(3)).abs().amax((-1, -2)) > 1e-3]
    # the first two batches are of different workers
    assert len(moved) >= COUNT - 3
    assert len(moved.flatten(1).unique(dim=0)) == len(moved)
