"""Cameras are values: replaced, detached, cloned, indexed, expanded, put together, for every model."""

import numpy as np
import pytest
import torch
from cameras import KEYS, each_kind, one

import camtorch as ct

SIZE = (60, 80)


def camera_of(key, dtype=torch.float32, learns=True):
    return one(key).to(dtype).replace(image_size=SIZE).requires_grad_(learns)


def numbers(camera):
    return torch.cat([t.expand(*camera.batch_shape, t.shape[-1]) for t in (camera.intrinsics, camera.distortion)], -1)


MADE = {
    "replace": lambda camera: camera.replace(image_size=SIZE),
    "clone": lambda camera: camera.clone(),
    "expand": lambda camera: camera.expand(2),
    "index": lambda camera: camera.expand(3)[1],
    "cat": lambda camera: ct.cat([camera, camera]),
    "detach": lambda camera: camera.detach(),
}


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("way", MADE)
@each_kind
def test_what_is_made_of_a_camera_has_its_numbers_and_learns_where_it_does(key, way, learns):
    camera = camera_of(key, torch.float64, learns)
    made = MADE[way](camera)
    assert type(made) is type(camera)
    assert made.image_size == SIZE
    assert made.distortion_names == camera.distortion_names
    assert made.intrinsics.dtype == torch.float64
    assert torch.equal(numbers(made), numbers(camera).expand_as(numbers(made)))
    assert made.intrinsics.requires_grad == (learns and way != "detach")
    if made.intrinsics.requires_grad:
        made.intrinsics.sum().backward()
        assert torch.equal(camera.intrinsics.grad, torch.full((4,), float(made.batch_shape.numel())).double())
    points = torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64)
    seen = made.project(points.expand(*made.batch_shape, 3))[0]
    assert torch.equal(seen, camera.project(points)[0].expand_as(seen))


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("key", KEYS)
def test_numbers_are_replaced(key, learns):
    camera = camera_of(key, torch.float64, learns)
    new = camera.replace(intrinsics=[30.0, 31.0, 40.0, 28.0], distortion=camera.distortion.tolist())
    assert new.intrinsics.tolist() == [30.0, 31.0, 40.0, 28.0]
    assert new.intrinsics.dtype == torch.float64
    assert new.intrinsics.requires_grad == learns
    assert torch.equal(new.distortion, camera.distortion)
    batch = camera.replace(intrinsics=torch.ones(3, 4, dtype=torch.float64))
    assert batch.batch_shape == (3,)
    predicted = torch.full((2, 4), 30.0, dtype=torch.float64, requires_grad=True) * 2
    assert camera.replace(predicted).intrinsics is predicted
    assert camera.replace(predicted).distortion is camera.distortion


def test_a_copy_is_its_own_and_what_is_shared_is_not():
    camera = camera_of("brown_conrady", learns=False)
    clone, shared = camera.clone(), camera.detach()
    camera.intrinsics.data[0] = 33.0
    assert clone.fx != 33.0
    assert shared.fx == 33.0
    assert camera.replace(distortion=[0.1, 0.0, 0.0, 0.0, 0.2]).distortion_names[-1] == "k3"


def test_a_mixed_batch_is_a_value():
    members = [camera_of("pinhole"), camera_of("mei", learns=False)]
    mixed = ct.cat(members)
    for made in (mixed.clone(), mixed.detach(), mixed.replace(image_size=(6, 8)), mixed.expand(2), ct.cat([mixed])):
        assert isinstance(made, ct.Mixed)
        assert torch.equal(made.intrinsics, mixed.intrinsics)
        assert [type(one) for one in made] == [type(one) for one in members]
    assert mixed.replace(image_size=(6, 8))[1].image_size == (6, 8)
    assert not mixed.detach().intrinsics.requires_grad
    assert torch.equal(mixed.replace(torch.ones(2, 4)).intrinsics, torch.ones(2, 4))
    mixed.clone().intrinsics.sum().backward()
    assert torch.equal(members[0].intrinsics.grad, torch.ones(4))
    assert ct.cat([mixed, members[0]]).batch_shape == (3,)
    assert mixed[:1].expand(4).batch_shape == (4,)


def test_a_pose_is_a_value():
    pose = ct.Extrinsics([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])
    assert torch.equal(pose.expand(2, 3).matrix(), pose.matrix().expand(2, 3, 4, 4))
    assert not pose.detach().rotation.requires_grad
    assert pose.clone().rotation.requires_grad
    poses = ct.Extrinsics(torch.rand(4, 3), torch.rand(3))
    assert len(poses) == 4
    for index in (2, slice(1, 3)):
        torch.testing.assert_close(poses[index].matrix(), poses.matrix()[index])
    assert [p.batch_shape for p in poses] == [()] * 4


CAMERA = camera_of("kannala_brandt")


def test_numbers_are_replaced_by_those_of_another_order_with_a_warning_and_of_narrow_dtypes():
    with pytest.warns(UserWarning, match="both focal lengths come first"):
        CAMERA.replace([50.0, 39.5, 51.0, 29.5])
    assert CAMERA.replace(CAMERA.intrinsics.detach().half()).intrinsics.dtype == torch.float32
    assert CAMERA.replace(distortion=CAMERA.distortion.detach().bfloat16()).distortion.dtype == torch.float32


@pytest.mark.parametrize("camera", [CAMERA, ct.Mixed([CAMERA])], ids=["single", "mixed"])
def test_it_expands_to_any_whole_number_and_a_clone_made_at_inference_joins_a_graph(camera):
    for count in (4, np.int64(4), torch.tensor(4)):
        assert camera.expand(count).batch_shape == camera.expand((count,)).batch_shape == (4,)
    with torch.inference_mode():
        clone = camera.clone()
    points = torch.tensor([[0.1, 0.2, 1.0]]).requires_grad_()
    clone.project(points)[0].sum().backward()
    assert points.grad.any()
    assert not clone.intrinsics.requires_grad


def test_a_mixed_batch_keeps_precision_and_what_is_fixed():
    learning, pinhole = camera_of("kannala_brandt", torch.float64, True), camera_of("pinhole", torch.float64, True)
    numbers = [[30.1, 31.0, 31.5, 23.5]] * 3
    made = ct.Mixed([learning.detach(), learning, pinhole]).replace(numbers)
    assert made.intrinsics.tolist() == numbers
    assert [camera.intrinsics.requires_grad for camera in made] == [False, True, True]


def test_what_is_made_without_a_graph_is_fixed():
    batch = ct.Pinhole([[30.0, 31.0, 31.5, 23.5]] * 2, image_size=SIZE)
    with torch.no_grad():
        for made in (batch.expand(3, 2), batch[0], batch.clone()):
            assert isinstance(made.intrinsics, torch.nn.Parameter)
            assert not made.intrinsics.requires_grad
    leaf = torch.arange(30.0, 38.0)[:4].requires_grad_()
    ct.Pinhole(leaf, image_size=SIZE).crop(1, 2, 20, 30).project(torch.ones(3))[0].sum().backward()
    assert leaf.grad.any()


@pytest.mark.parametrize("p", [0.0, 0.5, 1.0])
def test_cameras_of_a_list_have_the_widest_dtype_and_their_own_gradients(p):
    learning, other = camera_of("kannala_brandt", torch.float32, True), camera_of("brown_conrady", torch.float64, True)
    cameras = [learning, learning.detach(), other]
    sample = {"camera": cameras, "image": [torch.rand(1, *SIZE)] * 3}
    torch.manual_seed(0)
    found = ct.augment.RandomCamera(yaw=10, p=p, min_filled=0)(sample)["camera"]
    assert {made.intrinsics.dtype for made in found} == {torch.float64}
    sum(made.intrinsics.sum() for made in found).backward()
    assert [camera.intrinsics.grad is not None for camera in cameras] == [True, False, True]
