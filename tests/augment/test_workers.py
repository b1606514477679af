"""Augmentations in the workers of a DataLoader, and batches of samples that hold cameras."""

import numpy as np
import pytest
import torch
from cameras import fisheye
from torch.utils.data import DataLoader, Dataset

import camtorch as ct
import camtorch.augment.numpy

SIZE, SMALL, COUNT = (12, 16), (24, 32), 8


def augmentation(**options):
    return ct.augment.RandomCamera(yaw=8, pitch=8, roll=10, tolerance=0, **options)


class Samples(Dataset):
    """The same sample again and again."""

    def __init__(self, arrays):
        self.camera, self.augmentation = fisheye(SIZE, 0.56).requires_grad_(), augmentation(p=0.9)
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


PINHOLE = ct.Pinhole([20.0, 20.0, 15.5, 11.5], image_size=SMALL).requires_grad_(False)
FISHEYE = ct.KannalaBrandt([18.0, 18.0, 15.5, 11.5], [0.01, 0.0, 0.0, 0.0], image_size=SMALL).requires_grad_(False)


class Faces(Dataset):
    """Samples of as many faces as their number says, by two kinds of camera."""

    def __init__(self, cameras):
        self.cameras = cameras

    def __len__(self):
        return len(self.cameras)

    def __getitem__(self, i):
        points, boxes = torch.full((i, 2), 10.0), np.full((i + 1, 4), 8.0, np.float32)
        return {"image": torch.ones(3, *SMALL), "keypoints": points, "boxes": boxes, "camera": self.cameras[i], "id": i}


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("cameras", [[PINHOLE] * 3, [PINHOLE, FISHEYE, PINHOLE]])
def test_what_a_loader_collates_can_be_augmented(cameras, workers):
    context = "fork" if workers else None
    if workers and context not in torch.multiprocessing.get_all_start_methods():
        pytest.skip("this system cannot fork")
    options = {"collate_fn": ct.augment.collate, "num_workers": workers, "multiprocessing_context": context}
    (batch,) = DataLoader(Faces(cameras), batch_size=3, **options)
    assert batch["image"].shape == (3, 3, *SMALL)
    assert [points.shape for points in batch["keypoints"]] == [(0, 2), (1, 2), (2, 2)]
    assert [boxes.shape for boxes in batch["boxes"]] == [(1, 4), (2, 4), (3, 4)]
    assert batch["id"].tolist() == [0, 1, 2]
    if len(set(cameras)) == 1:
        assert tuple(batch["camera"].batch_shape) == (3,)
    else:
        assert isinstance(batch["camera"], ct.Mixed)
        assert [type(camera) for camera in batch["camera"]] == [type(camera) for camera in cameras]
    out = ct.augment.RandomMount(yaw=1, pitch=1, roll=1)(batch)
    assert [valid.tolist() for valid in out["keypoints_valid"]] == [[], [True], [True, True]]


def test_nests_and_cameras_alone():
    batch = ct.augment.collate([(1.5, {"camera": PINHOLE, "name": "a"}), (2.5, {"camera": PINHOLE, "name": "b"})])
    assert batch[0].tolist() == [1.5, 2.5]
    assert batch[1]["name"] == ["a", "b"]
    assert tuple(ct.augment.collate([PINHOLE, PINHOLE]).batch_shape) == (2,)
    assert isinstance(ct.augment.collate([PINHOLE, FISHEYE]), ct.Mixed)
    with pytest.raises(TypeError, match="default_collate: batch must contain"):
        ct.augment.collate([object(), object()])
