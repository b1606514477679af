"""Which labels are still on the image, where each framework's users look for it."""

import copy
import pickle

import kornia.augmentation as K  # noqa: N812
import torch
from cameras import SIZE, fisheye

import camtorch as ct
import camtorch.augment.kornia

POINTS = torch.tensor([[31.5, 23.5], [2.0, 2.0], [30.0, 20.0], [-30.0, 5.0]])


def narrow(**options):
    none = dict.fromkeys(("focal", "centre", "crop"))
    return ct.augment.RandomCamera("pinhole", fov=60, yaw=0, pitch=0, roll=0, min_filled=0, **none, **options)


def test_kornia_has_the_flags_of_the_keypoints_it_moved():
    aug = ct.augment.kornia.CameraAugmentation(narrow(), fisheye())
    assert aug.keypoints_valid is None
    seq = K.AugmentationSequential(aug, data_keys=["input", "keypoints"])
    _, moved = seq(torch.rand(2, 1, *SIZE), POINTS.expand(2, -1, -1))
    assert aug.keypoints_valid.tolist() == [[True, False, True, False]] * 2
    assert torch.equal(aug.keypoints_valid, aug.last.points(POINTS.expand(2, -1, -1))[1])
    assert moved.shape == (2, 4, 2)
    skipped = ct.augment.kornia.CameraAugmentation(narrow(), fisheye(), p=0.0)
    K.AugmentationSequential(skipped, data_keys=["input", "keypoints"])(torch.rand(1, 1, *SIZE), POINTS[None])
    assert skipped.keypoints_valid.tolist() == [[True, True, True, False]]  # where they are
    for again in (copy.deepcopy(aug), pickle.loads(pickle.dumps(aug))):
        assert torch.equal(again.keypoints_valid, aug.keypoints_valid)


def turned_away():
    """Two augmentations with their cameras: the second would find again what the first one lost."""
    away = ct.augment.RandomCamera("pinhole", fov=60, yaw=(150, 150), pitch=0, roll=0, min_filled=0, distortion=None)
    pinhole = ct.Pinhole([55.0, 55.0, 31.5, 23.5], image_size=SIZE).requires_grad_(False)
    rolled = ct.augment.RandomMount(yaw=0, pitch=0, roll=(180, 180))
    return (away, fisheye()), (rolled, pinhole.crop(-2, -2, *SIZE))


def test_what_one_augmentation_lost_the_next_ones_do_not_find():
    both = [ct.augment.kornia.CameraAugmentation(*one) for one in turned_away()]
    seq = K.AugmentationSequential(*both, data_keys=["input", "keypoints"])
    _, moved = seq(torch.rand(1, 1, *SIZE), POINTS[None, :1])
    assert moved.tolist() == [[[-1, -1]]]
    assert not any(aug.keypoints_valid.any() for aug in both)


def sample(tv):
    boxes = torch.tensor([[25.0, 18, 38, 29], [0, 0, 4, 4]])
    target = {
        "keypoints": tv.KeyPoints(POINTS.clone(), canvas_size=SIZE),
        "boxes": tv.BoundingBoxes(boxes, format=tv.BoundingBoxFormat.XYXY, canvas_size=SIZE),
        "labels": torch.tensor([3, 4]),
    }
    return tv.Image(torch.rand(3, *SIZE)), target


def test_torchvision_puts_flags_beside_their_points(vision):
    front_end, tv = vision
    transform = front_end.Transform(narrow(), fisheye(), valid=True)
    _, target = transform(*sample(tv))
    assert list(target) == ["keypoints", "boxes", "labels", "keypoints_valid", "boxes_valid"]
    assert target["keypoints_valid"].tolist() == [True, False, True, False]
    assert target["boxes_valid"].tolist() == [True, False]
    assert type(target["keypoints_valid"]) is torch.Tensor
    assert target["labels"].tolist() == [3, 4]
    # without being asked, nothing is added
    _, plain = front_end.Transform(narrow(), fisheye())(*sample(tv))
    assert list(plain) == ["keypoints", "boxes", "labels"]


def test_torchvision_s_flags_go_on_through_chains(vision):
    front_end, tv = vision
    image, target = sample(tv)
    target["keypoints_valid"] = torch.tensor([0, 1, 2, 2])  # COCO's, of somebody who sees less
    _, target = front_end.Transform(narrow(), fisheye(), valid=True)(image, target)
    assert target["keypoints_valid"].tolist() == [False, False, True, False]
    skipped = front_end.Transform(narrow(p=0), fisheye(), valid=True)(*sample(tv))[1]
    assert skipped["keypoints_valid"].tolist() == [True, True, True, False]
    first, second = (front_end.Transform(*one, valid=True) for one in turned_away())
    _, lost = second(*first(*sample(tv)))
    for name in ("keypoints", "boxes"):
        assert (lost[name].as_subclass(torch.Tensor)[0] == -1).all()
        assert not lost[f"{name}_valid"].any()
