"""A law of all front ends: a sample comes out as its tensors do, whatever the augmentation."""

import contextlib
import importlib

import numpy as np
import PIL.Image
import pytest
import torch
from torchvision_stand_in import torchvision_of

import camtorch as ct
import camtorch.augment.numpy
from camtorch.augment import BoxCrop, Compose, HorizontalFlip, Pad, RandomCamera, RandomMount, RandomResizedCrop

SIZE = (96, 130)
EDITS = {
    "mirrored and padded": lambda: Compose([HorizontalFlip(p=1.0, landmarks=[(0, 1)]), Pad((1, 2, 3, 4))]),
    "a part": lambda: Compose([RandomResizedCrop((64, 80), scale=(0.3, 0.6)), HorizontalFlip()], fill=9),
}
AUGMENTATIONS = {
    "mount": lambda: RandomMount(zoom=0.2, padding_mode="border"),
    "filled": lambda: RandomMount(min_filled=0.9, p=0.7),
    "another lens": lambda: RandomCamera("dms60", image_size=(90, 120), min_filled=0),
    "a chain": lambda: Compose([RandomMount(), RandomCamera("dms60", image_size=(64, 70), min_filled=0)], mask_fill=3),
    "a box": lambda: BoxCrop((70, 64), yaw=4, zoom=(0.9, 1.1)),
    **EDITS,
}


def camera():
    lens = [-0.2, 0.05, 1e-3, -1e-3]
    return ct.BrownConrady([130.0, 130, 64.5, 47.5], lens, image_size=SIZE).requires_grad_(False)


def by_tensors(augment, lens, sample, **options):
    image, mask, keypoints, boxes = (torch.from_numpy(value) for value in sample)
    fields = {"image": image.permute(2, 0, 1), "mask": mask, "keypoints": keypoints, "boxes": boxes}
    out = augment(fields | ({} if lens is None else {"camera": lens}), **options)
    return out["image"].permute(1, 2, 0), out["mask"], out["keypoints"], out["boxes"]


def by_arrays(augment, lens, sample, _):
    image, mask, keypoints, boxes = sample
    out = ct.augment.numpy.Transform(augment, lens)(image=image, mask=mask, keypoints=keypoints, bboxes=boxes)
    assert ("camera" in out) == (lens is not None)
    return (out["image"], out["mask"], out["keypoints"], out["bboxes"]), {}


def by_torchvision(augment, lens, sample, tv):
    image, mask, keypoints, boxes = (torch.from_numpy(value) for value in sample)
    planes = tv.Image(image.permute(2, 0, 1))
    given = {"again": planes, "image": planes, "mask": tv.Mask(mask), "shown": PIL.Image.fromarray(sample[0])}
    given["points"] = tv.KeyPoints(keypoints, canvas_size=SIZE)
    given["boxes"] = tv.BoundingBoxes(boxes + 0.5, format=tv.BoundingBoxFormat.XYXY, canvas_size=SIZE)
    out = importlib.import_module("camtorch.augment.torchvision").Transform(augment, lens)(given)
    assert out["again"].data_ptr() != out["image"].data_ptr()
    assert torch.equal(out["again"], out["image"])
    assert tuple(out["points"].canvas_size) == tuple(out["image"].shape[1:])
    moved = out["image"].permute(1, 2, 0)
    np.testing.assert_array_equal(np.asarray(out["shown"]), moved.numpy())
    return (moved, out["mask"], out["points"], out["boxes"].as_subclass(torch.Tensor) - 0.5), {}


def by_albumentations(augment, lens, sample, _):
    A = pytest.importorskip("albumentations", reason="albumentations is not installed")  # noqa: N806
    one = importlib.import_module("camtorch.augment.albumentations").Transform(augment, lens)
    kinds = {"bbox_params": A.BboxParams("pascal_voc"), "keypoint_params": A.KeypointParams("xy", None, False)}
    image, mask, keypoints, boxes = sample
    out = A.Compose([one], **kinds)(image=image, mask=mask, keypoints=keypoints, bboxes=boxes + 0.5)
    assert ("camera" in out) == (lens is not None)
    draw = {name: torch.tensor(value, dtype=torch.float64) for name, value in one.params["draw"].items()}
    return (out["image"], out["mask"], out["keypoints"], None), {"draw": draw}


FRONT_ENDS = {
    "arrays": (by_arrays, None),
    "torchvision": (by_torchvision, "real"),
    "its stand-in": (by_torchvision, "stand-in"),
    "albumentations": (by_albumentations, None),
}


@pytest.mark.parametrize("name", [*AUGMENTATIONS, *(f"{name}, no camera" for name in EDITS)])
@pytest.mark.parametrize("front_end", FRONT_ENDS)
def test_a_sample_moves_as_its_tensors_do(front_end, name, monkeypatch):
    augment, lens = AUGMENTATIONS[name.split(",")[0]](), None if "no camera" in name else camera()
    random = np.random.default_rng(0)
    image = random.integers(256, size=(*SIZE, 3), dtype=np.uint8)
    mask, keypoints = random.integers(9, size=SIZE, dtype=np.uint8), random.uniform(2, 90, (9, 2)).astype(np.float32)
    sample = image, mask, keypoints, np.array([[40.0, 30, 90, 80]], np.float32)
    move, kind = FRONT_ENDS[front_end]
    torch.manual_seed(3)
    with torchvision_of(kind, monkeypatch) if kind else contextlib.nullcontext() as tv_tensors:
        moved, draw = move(augment, lens, sample, tv_tensors)
    torch.manual_seed(3)
    for i, (one, other) in enumerate(zip(moved, by_tensors(augment, lens, sample, **draw), strict=True)):
        if one is not None:
            assert one.shape == other.shape
            assert torch.as_tensor(one).dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-3 * (i > 1))
