"""A rectified pair as a file of OpenCV."""

import math
from pathlib import Path

import numpy as np
import pytest

import camtorch as ct

LENS = ct.BrownConrady([500.0, 505, 320, 240], [-0.2, 0.05, 0.001, -0.001, 0.0], image_size=(480, 640))


def pair(first=([0.0] * 3, [0.0] * 3)):
    poses = {"left": ct.Extrinsics(*first), "right": ct.Extrinsics([0.02, -0.05, 0.01], [-0.12, 0.005, 0.004])}
    return ct.Rig({"left": LENS, "right": LENS}, poses).double().requires_grad_(False)


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
