"""What people pass to `ct.load` first: paths of every kind, other people's files, NumPy archives."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from rigs import FILES, SAMPLES, assert_same

import camtorch as ct

K = np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]])
D = np.array([[0.3, 0.1, 0.001, -0.002, 0.05]])


@pytest.mark.parametrize("kind", [str, Path, os.fsencode])
def test_paths_of_every_kind(kind):
    assert ct.load(kind(str(FILES / "opencv_camera.yml"))).camera.image_size == (800, 1280)


@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
@pytest.mark.parametrize("start", [b"", b"\xef\xbb\xbf", b"\xef\xbb\xbf\n"])
@pytest.mark.parametrize(
    "name", [*(name for name in SAMPLES if name[-4:] != ".bin"), "nuscenes/calibrated_sensor.json"]
)
def test_what_editors_do_to_a_file_is_no_fault_of_it(name, start, end, tmp_path):
    whole = (FILES / name).read_bytes().replace(b"\r\n", b"\n")
    if whole.startswith(b"<?xml"):
        start = start.rstrip()  # XML has no empty line there
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes((start + whole).replace(b"\n", end))
    shutil.copy(FILES / "nuscenes/sensor.json", path.parent)
    assert_same(ct.load(path), ct.load(FILES / name))


def saved(path):
    ct.save(ct.Pinhole([500.0, 500, 320, 240]), path)


def test_no_path(tmp_path):
    for call, path, error, told in (
        (ct.load, {"K": K}, TypeError, "load: path must be that of a calibration file; got dict"),
        (saved, None, TypeError, "save: path must be that of a calibration file; got NoneType"),
        (ct.load, "camera\0.json", ct.CameraFileError, "path: must not have a NUL character"),
        (saved, "camera\0.json", ct.CameraFileError, "path: must not have a NUL character"),
        (ct.load, tmp_path / "nowhere.yml", FileNotFoundError, r"nowhere\.yml"),
        (ct.load, tmp_path, ct.CameraFileError, r"folder: has none of cameras\.bin, cameras\.txt, transforms\.json"),
    ):
        with pytest.raises(error, match=told) as caught:
            call(path)
        assert str(caught.value).isprintable()
    with open(FILES / "opencv_camera.yml") as file, pytest.raises(TypeError, match=r"TextIOWrapper.*file\.name"):
        ct.load(file)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize(
    "names", [("K", "D"), ("mtx", "dist"), ("camera_matrix", "dist_coeffs"), ("cameraMatrix", "distCoeffs")]
)
def test_numpy_archives(names, save, tmp_path):
    views = np.empty(2, dtype=object)
    views[:] = [np.zeros((3, 1)), np.zeros((3, 1))]
    poses = {"rvecs": views, "tvecs": np.zeros((2, 3, 1)), "objpoints": np.zeros((100, 50, 3))}
    size = {"image_width": 640, "image_height": 480}
    save(tmp_path / "calibration.npz", **dict(zip(names, (K, D), strict=True)), **poses, **size)
    camera = ct.load(tmp_path / "calibration.npz").camera
    assert type(camera) is ct.BrownConrady
    assert camera.intrinsics.tolist() == [500, 501, 320, 240]
    assert camera.distortion.tolist() == D[0].tolist()
    assert camera.image_size == (480, 640)
    assert not camera.intrinsics.requires_grad


def test_numpy_archives_of_a_fisheye(tmp_path):
    np.savez(tmp_path / "fisheye.npz", K=K, D=np.full((4, 1), 0.01), fisheye=True)
    camera = ct.load(tmp_path / "fisheye.npz").camera
    assert type(camera) is ct.KannalaBrandt
    assert torch.equal(camera.distortion, torch.full((4,), 0.01, dtype=torch.float64))


def test_sizes_without_an_order_are_refused(tmp_path):
    np.savez(tmp_path / "calibration.npz", K=K, D=D, image_size=[480, 640])
    with pytest.raises(ct.CameraFileError, match=r"image_size: 480 640 may be \(width, height\) or .*image_width"):
        ct.load(tmp_path / "calibration.npz")
