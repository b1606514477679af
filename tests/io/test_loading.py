"""What people pass to `ct.load` first: paths of every kind, other people's files, NumPy archives."""

import functools
import io
import itertools
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from rigs import FILES, SAMPLES, assert_same

import camtorch as ct

K = np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]])
D = np.array([[0.3, 0.1, 0.001, -0.002, 0.05]])
(CLOSED := io.BytesIO()).close()
ENDLESS: dict = {}
ENDLESS["K"] = ENDLESS
PINHOLE = functools.partial(ct.save, ct.Pinhole([500.0, 500, 320, 240]))


@pytest.mark.parametrize("name", [*SAMPLES, "nuscenes/calibrated_sensor.json"])
def test_calibrations_from_anywhere(name, tmp_path):
    (path := tmp_path / Path(name).name).write_bytes((FILES / name).read_bytes())
    expected = ct.load(path)
    for load in (
        lambda path: ct.load(str(path)),
        lambda path: ct.load(os.fsencode(path)),
        lambda path: ct.load(io.BytesIO(path.read_bytes())),
        lambda path: ct.load(io.StringIO(path.read_text())),
        lambda path: ct.loads(path.read_bytes()),
        lambda path: ct.loads(path.read_text()),
        lambda path: ct.loads(json.loads(path.read_bytes())),
        lambda path: ct.loads(yaml.safe_load(path.read_bytes() if path.suffix != ".txt" else b"%")),
    ):
        try:
            rig = load(path)
        except (UnicodeDecodeError, json.JSONDecodeError, yaml.YAMLError):
            continue  # a binary file, or one of another syntax
        assert_same(rig, expected)


def test_an_open_file_is_read_without_the_files_next_to_it(monkeypatch):
    monkeypatch.chdir(FILES / "nuscenes")
    with open(name := "calibrated_sensor.json") as file:
        assert not ct.load(name).cameras.keys() & ct.load(file).cameras.keys()  # whose names stand in sensor.json


@pytest.mark.parametrize("name", [*(n for n in SAMPLES if n[-4:] != ".bin"), "nuscenes/calibrated_sensor.json"])
def test_what_editors_do_to_a_file_is_no_fault_of_it(name, tmp_path):
    whole, expected = (FILES / name).read_bytes().replace(b"\r\n", b"\n"), ct.load(FILES / name)
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    shutil.copy(FILES / "nuscenes/sensor.json", path.parent)
    for start, end in itertools.product((b"", b"\xef\xbb\xbf", b"\xef\xbb\xbf\n"), (b"\n", b"\r\n")):
        if whole.startswith(b"<?xml"):
            start = start.rstrip()  # XML has no empty line there
        path.write_bytes((start + whole).replace(b"\n", end))
        assert_same(ct.load(path), expected)


def test_an_editor_of_windows_does_not_change_poses_of_colmap(tmp_path):
    folder = tmp_path / "a folder of späce"
    folder.mkdir()
    poses = ["a.png", "b.png"], ct.Extrinsics([[0.1] * 3] * 2, [[0.0, 1.0, 2.0]] * 2).double()
    camera = ct.load(FILES / "opencv_camera.yml").camera
    ct.save(ct.Rig({"1": camera}, poses, images=dict.fromkeys(poses[0], "1")), folder / "cameras.txt")
    before = ct.load(folder)
    assert len(before.images) == 2
    for name in ("cameras.txt", "images.txt"):
        (folder / name).write_bytes(b"\xef\xbb\xbf" + (folder / name).read_bytes().replace(b"\n", b"\r\n"))
    assert_same(ct.load(folder), before)


@pytest.mark.parametrize(
    ("call", "given", "error", "says"),
    [
        (ct.load, {"K": K}, TypeError, r"load: path must be that of a .* file; got a dict\. Write ct\.loads$"),
        (ct.load, '{"camtorch": 1}', ValueError, r"^load: path .* got its content\. Write ct\.loads\(content\)$"),
        (ct.load, (FILES / "opencv_camera.yml").read_text(), ValueError, r"got its content\. Write ct\.loads"),
        (ct.load, (FILES / "cameras.bin").read_bytes(), ValueError, r"got its content\. Write ct\.loads"),
        (ct.load, CLOSED, ct.CameraFileError, r"BytesIO: content: must be readable; got .*closed file\. Open it"),
        (ct.load, "camera\0.json", ct.CameraFileError, "path: must have no NUL character"),
        (ct.load, FILES / "nowhere.yml", FileNotFoundError, r"nowhere\.yml"),
        (ct.load, FILES / "nuscenes", ct.CameraFileError, r"transforms.json; got none\. Name its file"),
        (ct.load, io.BytesIO(b"x: 1"), ct.CameraFileError, r"^load: BytesIO: content: keys .* got 'x'\. OpenCV's"),
        (ct.load, io.BytesIO(), ct.CameraFileError, r"BytesIO: content: must not be empty; .* Call file.seek\(0"),
        (ct.load, io.BytesIO(b" " * (1 << 25)), ct.CameraFileError, "load: BytesIO: size: must be at most 16 MiB"),
        (ct.loads, str(FILES / "opencv_camera.yml"), ValueError, r"content must .* its path. Write ct\.load\('"),
        (ct.loads, FILES / "opencv_camera.yml", TypeError, r"bytes or a dict; got PosixPath.*\. ct\.load reads files$"),
        (ct.loads, "", ct.CameraFileError, "^loads: content: must not be empty"),
        (ct.loads, "\ud800", ct.CameraFileError, "^loads: content: must be readable; got UnicodeEncodeError"),
        (ct.loads, {"K": [[10**400, 0, 1], [0, 1, 1], [0, 0, 1]]}, ct.CameraFileError, r"K\[0\]\[0\]: .* got inf"),
        (ct.Camera.from_dict, {"model": "pinhole", "intrinsics": [10**400] * 4}, ct.CameraFileError, "must be finite"),
        (ct.loads, ENDLESS, ct.CameraFileError, "^loads: content: .*RecursionError"),
        (ct.loads, {"K": K, "D": [0.1]}, ct.CameraFileError, r"^loads: D: BrownConrady must have coefficients"),
        (PINHOLE, None, TypeError, "save: path must be that of a calibration file; got NoneType"),
        (PINHOLE, "camera\0.json", ct.CameraFileError, "path: must have no NUL character"),
    ],
)
def test_what_is_no_calibration(call, given, error, says):
    with pytest.raises(error, match=says) as caught:
        call(given)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("mode", ["r", "a", "ab"])
def test_a_file_that_is_open_in_another_mode(mode, tmp_path):
    path = shutil.copy(FILES / "cameras.bin", tmp_path)
    says = r"^load: .*cameras\.bin: content: must be readable; got .*(decode|read).*\. Open it with 'rb'$"
    with open(path, mode) as file, pytest.raises(ct.CameraFileError, match=says):
        ct.load(file)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("names", ["K D", "mtx dist", "camera_matrix dist_coeffs", "cameraMatrix distCoeffs"])
def test_numpy_archives(names, save, tmp_path):
    views = np.empty(2, dtype=object)
    views[:] = [np.zeros((3, 1)), np.zeros((3, 1))]
    poses = {"rvecs": views, "tvecs": np.zeros((2, 3, 1)), "objpoints": np.zeros((100, 50, 3))}
    size = {"image_width": 640, "image_height": 480}
    save(tmp_path / "calibration.npz", **dict(zip(names.split(), (K, D), strict=True)), **poses, **size)
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
    with pytest.raises(ct.CameraFileError, match=r"image_size: .* got 480 640, \(width, height\) or .*image_width"):
        ct.load(tmp_path / "calibration.npz")
