"""A rig is a module, and a mapping of names to cameras."""

import copy
import pickle

import pytest
import torch

import camtorch as ct

NAMES = ["cam0", "front.left", "images/a.b/0001.jpg", "", "forward", "batch", "50%", "50%25", "2E", "rotation", "ö"]


def camera(focal=300.0):
    return ct.KannalaBrandt([focal, focal, 319.5, 239.5], [0.01, 0.0, 0.0, 0.0], image_size=(480, 640))


def rig_of(names, **options):
    poses = {name: ct.Extrinsics([0.0, 0.0, 0.1 * i], [float(i), 0.0, 0.0]) for i, name in enumerate(names)}
    return ct.Rig({name: camera(300.0 + i) for i, name in enumerate(names)}, poses, **options)


def posed_images(count=5):
    names = [f"images/{i:06d}.jpg" for i in range(count)]
    poses = torch.arange(6.0 * count, dtype=torch.float64).view(2, count, 3) / (6 * count)
    return ct.Rig({"1": camera()}, (names, ct.Extrinsics(*poses)), images=dict.fromkeys(names, "1"))


def test_it_is_a_mapping_of_names():
    rig = rig_of(NAMES)
    assert list(rig) == list(rig.keys()) == list(rig.cameras) == list(rig.extrinsics) == NAMES
    assert len(rig) == len(NAMES)
    assert dict(rig) == dict(rig.items()) == dict(rig.cameras)
    for i, name in enumerate(NAMES):
        assert name in rig
        assert rig[name] is rig.cameras[name]
        assert rig[name].intrinsics[0] == 300 + i
        assert rig.extrinsics[name].translation[0] == i
    assert "cam1" not in rig
    with pytest.raises(KeyError, match="cam1"):
        rig["cam1"]
    assert rig.extrinsics.get("cam1") is None


@pytest.mark.parametrize("make", [lambda: rig_of(NAMES), posed_images], ids=["cameras", "images"])
def test_it_is_a_module(make):
    rig, other = make(), make()
    assert not any(p.requires_grad for p in rig.requires_grad_(False).parameters())
    assert not any(p.requires_grad for name in rig.extrinsics for p in rig.extrinsics[name].parameters())
    assert all(p.dtype == torch.float64 for p in rig.double().parameters())
    with torch.no_grad():
        for p in other.parameters():
            p.mul_(1.25)
    rig.load_state_dict(other.state_dict())
    for name in rig:
        assert torch.equal(rig[name].intrinsics, other[name].intrinsics.double())
    for name in rig.extrinsics:
        assert torch.equal(rig.extrinsics[name].rotation, other.extrinsics[name].rotation.double())


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda r: pickle.loads(pickle.dumps(r))], ids=["deepcopy", "pickle"])
@pytest.mark.parametrize("make", [lambda: rig_of(NAMES), posed_images], ids=["cameras", "images"])
def test_copies(make, copied):
    rig = make()
    again = copied(rig)
    assert repr(again) == repr(rig)
    assert list(again.extrinsics) == list(rig.extrinsics)
    assert again.images == rig.images
    with torch.no_grad():
        for p in again.parameters():
            p.zero_()
    assert all(rig[name].intrinsics[0] >= 300 for name in rig)
    assert rig.extrinsics[list(rig.extrinsics)[-1]].rotation.any()


def test_mappings_may_be_changed_and_copies_stay():
    rig = posed_images()
    same = ct.Rig(rig.cameras, rig.extrinsics, images=rig.images)
    first, second = list(rig.extrinsics)[:2]
    rig.extrinsics[first] = rig.extrinsics[second]
    rig.cameras["1"] = camera(200.0)
    assert next(iter(rig.extrinsics)) == first
    assert torch.equal(rig.extrinsics[first].rotation, same.extrinsics[second].rotation)
    assert not torch.equal(rig.extrinsics[first].rotation, same.extrinsics[first].rotation)
    assert rig.camera.intrinsics[0] == 200
    assert same.camera.intrinsics[0] == 300
    del rig.extrinsics[second]
    assert second not in rig.extrinsics
    assert second in same.extrinsics
    with pytest.raises(TypeError, match="Camera; got 'a': int"):
        rig.cameras["a"] = 1


def test_a_row_is_the_batch_s():
    rig = posed_images()
    pose = rig.extrinsics["images/000002.jpg"]
    assert pose.batch_shape == ()
    pose(torch.ones(3)).sum().backward()
    assert rig.extrinsics.batch.rotation.grad[2].any()
    assert not rig.extrinsics.batch.rotation.grad[[0, 1, 3, 4]].any()
    rig.requires_grad_(False)
    rig.extrinsics["images/000002.jpg"].translation[0] = 7.0
    assert rig.extrinsics.batch.translation[2, 0] == 7
    assert rig.extrinsics["images/000002.jpg"].translation[0] == 7


def test_which_camera_is_meant():
    rig = rig_of(["left", "right"])
    assert "left: KannalaBrandt 640x480 (300, 300," in repr(rig)
    for call, told in (
        (lambda: rig.camera, r"must be one for rig.camera.* Take rig\[name\]"),
        (lambda: rig.camera_of("x"), "that of a camera or an image.* got 'x'"),
        (lambda: ct.Rig({"a": camera()}, images={"i": "b"}), r"camera of 'i' must be one of \['a'\]; got 'b'"),
        (lambda: rig.between("left", "middle"), "that of a camera or an image.* got 'middle'"),
        (lambda: ct.Rig(rig.cameras).between("left", "right"), "must have a pose, as none have; got 'left'"),
    ):
        with pytest.raises(ValueError, match=told):
            call()


def test_who_takes_it_for_a_camera_is_told_where_those_are():
    camera = ct.Pinhole.from_fov(70, image_size=(480, 640))
    one, two = ct.Rig({"left": camera}), ct.Rig({"left": camera, "right": camera})
    for name in ("project", "K", "intrinsics", "image_size"):
        with pytest.raises(AttributeError, match=rf"{name} must be a camera; .* whose only camera is its \.camera"):
            getattr(one, name)
        assert not hasattr(two, name)
    with pytest.raises(AttributeError, match="no attribute 'unknown'"):
        one.unknown  # noqa: B018
    for call, told in (
        (lambda: ct.Dewarp(one), r"Dewarp: camera must be a Camera; got Rig, whose only camera is its \.camera"),
        (lambda: ct.solve_pnp(two, [], []), r"got Rig, whose cameras are rig\['left'\], rig\['right'\]$"),
        (lambda: ct.Dewarp(ct.Rig({})), "got Rig, which has no camera"),
        (lambda: ct.Dewarp("camera.yml"), r"got str; ct\.load\('camera\.yml'\)\.camera loads the camera of a file"),
        (lambda: ct.augment.RandomMount(camera="pinhole"), "got str$"),
    ):
        with pytest.raises(TypeError, match=told):
            call()


LENS = ct.BrownConrady([500.0, 505, 320, 240], [-0.2, 0.05, 0.001, -0.001, 0.0], image_size=(480, 640))


def test_a_file_with_two_cameras_gives_a_pair_to_rectify_whose_poses_learn(tmp_path):
    poses = [[0.3, 0.1, -0.2], [0.5, -0.4, 0.1]], [[0.02, -0.05, 0.01], [-0.12, 0.005, 0.004]]
    left, right = (ct.Extrinsics(*pose) for pose in poses)
    rig = ct.Rig({"left": LENS, "right": LENS}, {"left": left, "right": right}).double()
    ct.save(rig, tmp_path / "rig.json")
    again = ct.load(tmp_path / "rig.json")
    found = again.between("left", "right")
    first, second = (rig.extrinsics[name].matrix() for name in rig)
    torch.testing.assert_close(found.matrix(), second @ first.inverse(), rtol=0, atol=1e-14)
    rectified = ct.rectify(again["left"], again["right"], found)
    assert rectified.baseline.item() == pytest.approx(found.translation.norm().item(), rel=1e-14)
    ct.rectify(LENS, LENS, rig.between("left", "right")).baseline.backward()
    for pose in rig.extrinsics.values():
        assert pose.translation.grad.norm() > 0
    assert rig.extrinsics["left"].rotation.grad.norm() > 0
