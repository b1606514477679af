"""What stands between two cameras of a rig, whatever file it came from."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from rigs import float64, load

import camtorch as ct

LENS = ct.BrownConrady([500.0, 505, 320, 240], [-0.2, 0.05, 0.001, -0.001, 0.0], image_size=(480, 640))


def pair(first=([0.0] * 3, [0.0] * 3)):
    poses = {"left": ct.Extrinsics(*first), "right": ct.Extrinsics([0.02, -0.05, 0.01], [-0.12, 0.005, 0.004])}
    return ct.Rig({"left": LENS, "right": LENS}, poses).double().requires_grad_(False)


def test_a_file_with_two_cameras_gives_a_pair_to_rectify(tmp_path):
    rig = pair(([0.3, 0.1, -0.2], [0.5, -0.4, 0.1]))
    ct.save(rig, tmp_path / "rig.json")
    again = ct.load(tmp_path / "rig.json")
    left, right = again
    found = again.between(left, right)
    first, second = (rig.extrinsics[name].matrix() for name in rig)
    torch.testing.assert_close(found.matrix(), second @ first.inverse(), rtol=0, atol=1e-14)
    rectified = ct.rectify(again[left], again[right], found)
    assert rectified.baseline.item() == pytest.approx(found.translation.norm().item(), rel=1e-14)


def test_of_a_file_of_opencv_it_is_what_stands_there():
    rig = load("opencv_stereo.yml")
    found = rig.between("1", "2")
    assert found.translation.tolist() == [-0.0832, 0.0009, 0.0004]
    torch.testing.assert_close(found.rotation, rig.extrinsics["2"].rotation, rtol=0, atol=1e-16)
    back = rig.between("2", "1")
    torch.testing.assert_close(back.matrix(), found.inverse().matrix(), rtol=0, atol=1e-15)


def test_posed_images_have_what_stands_between_them():
    rig = load("nerfstudio_transforms.json")
    one, other = list(rig.extrinsics)[:2]
    points = float64([[0.1, -0.2, 1.0], [2.0, 1.0, 5.0]])
    moved = rig.between(one, other)(rig.extrinsics[one](points))
    torch.testing.assert_close(moved, rig.extrinsics[other](points))


@pytest.mark.parametrize("keys", [("R", "T"), ("om", "T"), ("rvec", "tvec")])
def test_opencv_pairs_are_posed_by_matrices_and_by_vectors(keys, tmp_path):
    turn, shift = float64([0.02, -0.05, 0.01]), [-0.12, 0.005, 0.004]
    pose = ct.Extrinsics(turn, float64(shift))
    rotation = pose.matrix()[:3, :3].flatten().tolist() if keys[0] == "R" else turn.tolist()
    lens = "[500, 0, 320, 0, 500, 240, 0, 0, 1]"
    (tmp_path / "pair.yml").write_text(f"M1: {lens}\nM2: {lens}\n{keys[0]}: {rotation}\n{keys[1]}: {shift}\n")
    found = ct.load(tmp_path / "pair.yml").between("1", "2")
    torch.testing.assert_close(found.matrix(), pose.matrix(), rtol=0, atol=1e-15)


def test_gradients_reach_the_poses_of_the_rig():
    rig = pair(([0.3, 0.1, -0.2], [0.5, -0.4, 0.1])).requires_grad_(True)
    rectification = ct.rectify(rig["left"], rig["right"], rig.between("left", "right"))
    rectification.baseline.backward()
    for pose in rig.extrinsics.values():
        assert pose.translation.grad.norm() > 0
    assert rig.extrinsics["left"].rotation.grad.norm() > 0


@pytest.mark.parametrize(
    ("names", "text"),
    [
        (("left", "middle"), "no camera and no image is called 'middle'"),
        (("left", "right"), "'right' has no pose in rig.extrinsics; there is 'left'"),
    ],
)
def test_what_is_missing_is_said(names, text):
    rig = pair()
    del rig.extrinsics["right"]
    with pytest.raises(ValueError, match=text):
        rig.between(*names)


@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml"])
def test_opencv_reads_the_matrices_of_a_rectified_pair(suffix, tmp_path):
    cv2 = pytest.importorskip("cv2")
    rig = pair()
    found = ct.rectify(rig["left"], rig["right"], rig.between("left", "right"), image_size=(400, 600))
    path = tmp_path / f"pair{suffix}"
    found.save(path)
    storage = cv2.FileStorage(str(path), cv2.FileStorage_READ)
    expected = {name: value.numpy() for name, value in found.opencv().items()}
    pose = rig.extrinsics["right"].matrix().numpy()
    expected |= {"R": pose[:3, :3], "T": pose[:3, 3:]}
    for name, value in expected.items():
        np.testing.assert_allclose(storage.getNode(name).mat(), value, rtol=1e-14, atol=1e-15, err_msg=name)
    assert (storage.getNode("image_width").real(), storage.getNode("image_height").real()) == (600, 400)
    storage.release()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_matrices_of_opencv_are_of_perspective_pairs(tmp_path):
    rig = pair()
    found = ct.rectify(rig["left"], rig["right"], rig.between("left", "right"), projection="latlon")
    with pytest.raises(ValueError, match=r"Rectification.opencv: .* this is latlon"):
        found.save(tmp_path / "pair.yml")
    found = ct.rectify(rig["left"], rig["right"], rig.between("left", "right"))
    with pytest.raises(ValueError, match=r"pair.txt: .*\.yml, \.json or \.xml"):
        found.save(tmp_path / "pair.txt")
    assert not list(Path(tmp_path).iterdir())
    assert math.isfinite(found.baseline)
