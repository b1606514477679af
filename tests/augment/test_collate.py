"""Batches of samples that hold cameras."""

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

import camtorch as ct
from camtorch.augment import RandomMount, collate

SIZE = (24, 32)
PINHOLE = ct.Pinhole([20.0, 20.0, 15.5, 11.5], image_size=SIZE).requires_grad_(False)
FISHEYE = ct.KannalaBrandt([18.0, 18.0, 15.5, 11.5], [0.01, 0.0, 0.0, 0.0], image_size=SIZE).requires_grad_(False)


class Faces(Dataset):
    """Samples of as many faces as their number says, by two kinds of camera."""

    def __init__(self, cameras):
        self.cameras = cameras

    def __len__(self):
        return len(self.cameras)

    def __getitem__(self, i):
        points, boxes = torch.full((i, 2), 10.0), np.full((i + 1, 4), 8.0, np.float32)
        return {"image": torch.ones(3, *SIZE), "keypoints": points, "boxes": boxes, "camera": self.cameras[i], "id": i}


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("cameras", [[PINHOLE] * 3, [PINHOLE, FISHEYE, PINHOLE]])
def test_what_a_loader_collates_can_be_augmented(cameras, workers):
    context = "fork" if workers else None
    if workers and context not in torch.multiprocessing.get_all_start_methods():
        pytest.skip("this system cannot fork")
    loader = DataLoader(
        Faces(cameras), batch_size=3, collate_fn=collate, num_workers=workers, multiprocessing_context=context
    )
    (batch,) = loader
    assert batch["image"].shape == (3, 3, *SIZE)
    assert [points.shape for points in batch["keypoints"]] == [(0, 2), (1, 2), (2, 2)]
    assert [boxes.shape for boxes in batch["boxes"]] == [(1, 4), (2, 4), (3, 4)]
    assert batch["id"].tolist() == [0, 1, 2]
    if len(set(cameras)) == 1:
        assert tuple(batch["camera"].batch_shape) == (3,)
    else:
        assert isinstance(batch["camera"], ct.Mixed)
        assert [type(camera) for camera in batch["camera"]] == [type(camera) for camera in cameras]
    out = RandomMount(yaw=1, pitch=1, roll=1)(batch)
    assert [valid.tolist() for valid in out["keypoints_valid"]] == [[], [True], [True, True]]


def test_nests_and_cameras_alone():
    batch = collate([(1.5, {"camera": PINHOLE, "name": "a"}), (2.5, {"camera": PINHOLE, "name": "b"})])
    assert batch[0].tolist() == [1.5, 2.5]
    assert batch[1]["name"] == ["a", "b"]
    assert tuple(collate([PINHOLE, PINHOLE]).batch_shape) == (2,)
    assert isinstance(collate([PINHOLE, FISHEYE]), ct.Mixed)
    with pytest.raises(TypeError, match="default_collate: batch must contain"):
        collate([object(), object()])
