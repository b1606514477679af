"""What an augmentation hands out belongs to the caller: editing it in place changes nothing else."""

import copy

import pytest
import torch
from cameras import pinhole
from test_augment import sample as every_field

import camtorch as ct
from camtorch.augment import FaceNormalizer, RandomCamera, RandomLens, RandomMount
from camtorch.augment.sample import Single

SIZE, COUNT = (60, 80), 3


def camera(count=None):
    one = pinhole(SIZE, 60.0)
    return one if count is None else one.replace(intrinsics=one.intrinsics.repeat(count, 1)).requires_grad_(False)


def sample(own):
    masks = {"keypoints_valid": torch.ones(COUNT, 7), "image_valid": torch.ones(COUNT, 1, *SIZE)}
    fields = {name: value for name, value in every_field(COUNT, own).items() if name not in ("label", "name")}
    return fields | {name: value.bool() for name, value in masks.items()}


def tensors(values):
    """Name -> tensor, of the fields and of their cameras."""
    found = {}
    for name, value in values.items():
        for i, one in enumerate(value if isinstance(value, list) else [value]):
            if isinstance(one, ct.Camera):
                found |= {f"{name}{i}.intrinsics": one.intrinsics, f"{name}{i}.distortion": one.distortion}
            elif isinstance(one, torch.Tensor):
                found[f"{name}{i}"] = one
    return found


AUGMENTATIONS = {
    "mount": RandomMount(valid_mask=True),
    "lens": RandomLens("kannala_brandt", fov=60, valid_mask=True),
    "one map": RandomCamera("webcam", same_on_batch=True, valid_mask=True, min_filled=0.9),
    "nothing": RandomMount(p=0, valid_mask=True),
    "some": RandomMount(p=0.5, valid_mask=True),
    "still": RandomMount(yaw=0, pitch=0, roll=0, valid_mask=True),
    "face": FaceNormalizer(focal=40, distance=1.0, image_size=SIZE, valid_mask=True),
}


@pytest.mark.parametrize(
    ("name", "own", "alone"),
    [
        (name, own, alone)
        for name in AUGMENTATIONS
        for own, alone in (("one", False), ("one", True), ("batch", False), ("list", False))
        if (name, own) != ("face", "list")
    ],
)
def test_everything_that_comes_out_can_be_edited_in_place(name, own, alone):
    augmentation = AUGMENTATIONS[name]
    cameras = {"one": camera(), "batch": camera(COUNT), "list": [camera() for _ in range(COUNT)]}[own]
    given = sample(cameras)
    if alone:
        given = {k: v if k == "camera" else v[0] for k, v in given.items()}
    before = copy.deepcopy(given)
    out = augmentation(given)
    label = {"keypoints": out["keypoints"].clone()}
    back = {} if name == "face" else augmentation.inverse(label)
    with torch.no_grad():
        for field, tensor in tensors(out).items():
            rest = {other: t.clone() for other, t in tensors(out).items() if other != field}
            tensor.zero_()  # an expanded view refuses
            if tensor.numel() > 1 and tensor.ndim and len(tensor) > 1:
                tensor[0] = 1
                assert not tensor[1:].any(), f"{field} is one row for all"
            for other, was in rest.items():
                assert torch.equal(tensors(out)[other], was), f"{other} moved with {field}"
    for field, tensor in tensors(given).items():
        if not field.startswith("source"):
            assert torch.equal(tensor, tensors(before)[field]), f"{field} of the given sample"
    if back:
        assert torch.equal(augmentation.inverse(label)["keypoints"], back["keypoints"])


def test_a_single_sample_stays_single_and_the_callers():
    """With keywords too; `FaceNormalizer.inverse` takes fields out of a copy."""
    faces = Single(keypoints=30 * torch.rand(2, 7, 2))  # of two faces
    out = AUGMENTATIONS["mount"](faces, camera=camera(), gaze=torch.rand(3))
    assert (out["rotation"].shape, list(faces)) == ((3, 3), ["keypoints"])
    pose = torch.cat((torch.eye(3), torch.tensor([[0.0], [0], [1]])), 1)
    given = Single(AUGMENTATIONS["face"](head_pose=pose, camera=camera()))
    names = list(given)
    AUGMENTATIONS["face"].inverse(given)
    assert list(given) == names


@pytest.mark.parametrize("lead", [(), (COUNT,)], ids=["one", "batch"])
@pytest.mark.parametrize("kind", [RandomMount, RandomLens, RandomCamera])
def test_a_copy_of_a_change_moves_as_the_change_does(kind, lead):
    augment = kind(camera=camera(), min_filled=0.9)
    fields = {"image": torch.rand(*lead, 3, *SIZE), "keypoints": 40 * torch.rand(*lead, 5, 2)}
    moved = augment(fields)
    twin = copy.deepcopy(augment.last)
    for change, given in ((twin, fields), (copy.deepcopy(twin), fields), (twin.inverse(), moved)):
        wanted = augment.moved_by(augment.last if given is fields else augment.last.inverse(), given)
        found = augment.moved_by(change, given)
        assert all(torch.equal(found[name], wanted[name]) for name in fields)
