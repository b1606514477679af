"""What people pass to `ct.load` first: paths of every kind, other people's files, NumPy archives."""

import io
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from rigs import FILES, SAMPLES, assert_same

import camtorch as ct

K = np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]])
D = np.array([[0.3, 0.1, 0.001, -0.002, 0.05]])


# -- paths


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


def test_no_path(tmp_path):
    with pytest.raises(TypeError, match="load: path must be that of a calibration file; got dict"):
        ct.load({"K": K})
    with open(FILES / "opencv_camera.yml") as file, pytest.raises(TypeError, match=r"TextIOWrapper.*file\.name"):
        ct.load(file)
    with pytest.raises(TypeError, match="save: path must be that of a calibration file; got NoneType"):
        ct.save(ct.Pinhole([500.0, 500, 320, 240]), None)
    for call in (ct.load, lambda path: ct.save(ct.Pinhole([500.0, 500, 320, 240]), path)):
        with pytest.raises(ct.CameraFileError, match=r"path: a NUL character") as caught:
            call("camera\0.json")
        assert str(caught.value).isprintable()
    with pytest.raises(FileNotFoundError, match=r"nowhere\.yml"):
        ct.load(tmp_path / "nowhere.yml")
    with pytest.raises(ct.CameraFileError, match=r"folder: has none of cameras\.bin, cameras\.txt, transforms\.json"):
        ct.load(tmp_path)


# -- other people's files


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "content: the file is empty"),
        (pickle.dumps({"K": K, "D": D}), "byte 0: a pickle, which could run any code: not read. .*numpy.savez"),
        (b"\x93NUMPY\x01\0", "byte 0: a single array; save both by numpy.savez"),
        (b"\x89PNG\r\n\x1a\n", "byte 0: an image, where a file of a calibration is wanted"),
        (b"\xff\xd8\xff\xe0", "byte 0: an image"),
        (b"\x89HDF\r\n\x1a\n", "byte 0: a file of HDF5 or MATLAB"),
        (b"\xfe\xfd\xfc", "byte 0: not text"),
        (b"{'K': [500, 0, 320, 0, 500, 240, 0, 0]}", "K: a camera matrix has 3 x 3 numbers"),
    ],
)
def test_what_is_no_calibration_is_said(content, reason, tmp_path):
    (tmp_path / "calibration.p").write_bytes(content)
    with pytest.raises(ct.CameraFileError, match=rf"calibration\.p: {reason}"):
        ct.load(tmp_path / "calibration.p")


# -- NumPy archives


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
    with pytest.raises(
        ct.CameraFileError, match=r"image_size: 480 640 may be \(width, height\) or .* save image_width"
    ):
        ct.load(tmp_path / "calibration.npz")


def archive(**files):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in files.items():
            file.writestr(name.replace("__", "."), data)
    return content.getvalue()


def array(shape, data=b"", descr="<f8"):
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {"descr": descr, "fortran_order": False, "shape": shape})
    return content.getvalue() + data


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (archive(data__pkl=b"x"), "content: no format that is known here has the keys 'data.pkl'"),
        (archive(K__npy=b"x"), "K: is neither an OpenCV matrix nor a list of numbers"),
        (archive(K__npy=array((1 << 40,))), "K: is neither"),
        (archive(K__npy=array((3, 3), bytes(8))), "K: is neither"),
        (archive(K__npy=array((9,), b"." * 72, "|O")), "K: is neither"),
        (archive(K__npy=array((1 << 20,), bytes(8 << 20))), "K: is neither"),
        (archive(K__npy=array((3, 3), bytes(72)))[:-30], "content: no archive of NumPy's"),
        (archive(**{f"a{i}__npy": array((1,), bytes(8)) for i in range(1001)}), "content: .* more than 1000 arrays"),
    ],
)
def test_archives_of_something_else(content, reason, tmp_path):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ct.CameraFileError, match=rf"a\.npz: {reason}"):
        ct.load(tmp_path / "a.npz")
