"""Extrinsics in files: directions, axes, chains, and that any pose comes back."""

import json
import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rigs import FILES, POINT, SUFFIXES, assert_same, float64, load

import camtorch as ct

T = [[0.999850307569043, -0.005207406814266403, 0.016499859646724586, -0.11]]
T += [[0.005392633690220337, 0.9999227207198279, -0.011201432503970198, 0.0004]]
T += [[-0.016440254133497537, 0.011288733433323263, 0.9998011214944192, -0.0008]]


def camchain(**extra):
    lines = []
    for i, name in enumerate(("cam0", "cam1", "cam2")):
        lines += [f"{name}:", "  camera_model: pinhole", "  distortion_model: radtan"]
        lines += [f"  distortion_coeffs: [0.1, {i}.5, 0.0, 1e-3]", f"  intrinsics: [500, 501, 320.5, {240 + i}]"]
        lines += ["  resolution: [640, 480]", *(f"  {key}: {value}" for key, value in extra.get(name, {}).items())]
    return "\n".join(lines)


@pytest.mark.parametrize("key", ["T_cn_cnm1", "T_cam_imu", "T_imu_cam"])
def test_poses_of_kalibr(key):
    """From one camera to the next, or each from the IMU, or the other way round."""
    rows = [*T, [0, 0, 0, 1]]
    first = {} if key == "T_cn_cnm1" else {key: rows}
    rig = ct.loads(camchain(cam0=first, cam1={key: rows}, cam2={key: rows}))
    step, point = float64(rows), float64([*POINT, 1])
    powers = {"T_cn_cnm1": (0, 1, 2), "T_cam_imu": (1, 1, 1), "T_imu_cam": (-1, -1, -1)}[key]
    for name, power in zip(rig.cameras, powers, strict=True):
        expected = torch.linalg.matrix_power(step, power) @ point
        assert torch.allclose(rig.extrinsics[name](point[:3]), expected[:3], rtol=0, atol=1e-14)


def test_kalibr_models(tmp_path):
    path = tmp_path / "chain.yaml"
    models = {("omni", "radtan"): ("mei", 1, 4), ("eucm", "none"): ("eucm", 2, 0)}
    models |= {("ds", "none"): ("double_sphere", 2, 0), ("pinhole", "fov"): ("fov", 0, 1)}
    for (projection, lens), (model, before, after) in models.items():
        first, last = [0.5, 0.6][:before], [0.01, 0.02, 0.003, 0.004][:after]
        text = f"cam0:\n  camera_model: {projection}\n  distortion_model: {lens}\n  resolution: [640, 480]\n"
        path.write_text(f"{text}  intrinsics: {[*first, 500.0, 501.0, 320.0, 240.0]}\n  distortion_coeffs: {last}\n")
        camera = ct.load(path).camera
        assert camera.key == model
        assert camera.intrinsics.tolist() == [500, 501, 320, 240]
        assert camera.distortion.tolist() == first + last
        ct.save(camera, path, "kalibr")
        assert_same(ct.load(path), ct.Rig({"cam0": camera}))


@pytest.mark.parametrize("format", ["kalibr", "basalt"])
def test_numbered_cameras_keep_their_names_in_any_order(tmp_path, format):
    poses = {f"cam{i}": ct.Extrinsics(float64([0, 0, 0]), float64([i, 0, 0])) for i in (2, 0, 1)}
    rig = ct.Rig({n: ct.Pinhole(float64([9, 9 + int(n[3]), 6, 4]), image_size=(9, 12)) for n in poses}, poses)
    ct.save(rig, path := tmp_path / f"rig{SUFFIXES[format]}", format)
    for name, camera in (found := ct.load(path)).items():
        assert camera.fy == rig[name].fy
        assert found.extrinsics[name].translation.tolist() == pytest.approx([int(name[3]), 0, 0], abs=1e-12)


@pytest.mark.parametrize("name", ["aria_device_calibration.json", "basalt_calibration.json"])
def test_poses_of_cameras_on_a_device_are_turned_round(name):
    rig = load(name)
    if name.startswith("aria"):
        entries = json.loads((FILES / name).read_text())["CameraCalibrations"]
        where = {e["Label"]: e["T_Device_Camera"]["Translation"] for e in entries}
    else:
        entries = json.loads((FILES / name).read_text())["value0"]["T_imu_cam"]
        where = {f"cam{i}": [e["px"], e["py"], e["pz"]] for i, e in enumerate(entries)}
    for camera, position in where.items():
        assert torch.allclose(rig.extrinsics[camera].position, float64(position), rtol=0, atol=1e-15)


def test_nerfstudio_axes():
    """A camera without rotation there looks along -z of the world, with y up."""
    rig = load("nerfstudio_transforms.json")
    assert list(rig.cameras) == ["camera"]
    pose = rig.extrinsics["images/frame_00002.jpg"]
    assert torch.allclose(pose(float64([0.1, 0.2, -1.0])), float64([0.1, -0.2, 1.0]), rtol=0, atol=1e-15)
    matrix = float64(json.loads((FILES / "nerfstudio_transforms.json").read_text())["frames"][0]["transform_matrix"])
    seen = torch.linalg.inv(matrix) @ float64([0.3, 0.4, -5.0, 1.0])
    pose = rig.extrinsics["images/frame_00001.jpg"]
    assert torch.allclose(pose(float64([0.3, 0.4, -5.0])), seen[:3] * float64([1, -1, -1]), rtol=0, atol=1e-14)
    assert rig.camera_of("images/frame_00001.jpg") is rig.camera


def test_nerfstudio_camera_of_each_frame(tmp_path):
    path, rows = tmp_path / "transforms.json", [*T, [0, 0, 0, 1]]
    size = {"fl_y": 501, "cx": 320, "cy": 240, "w": 640, "h": 480, "k1": 0.1, "k2": 0, "p1": 0, "p2": 0.01}
    frames = [{"file_path": f"{i}.png", "transform_matrix": rows, "fl_x": 500 + i, **size} for i in range(2)]
    rig = ct.loads({"camera_model": "OPENCV", "frames": frames})
    assert {name: camera.intrinsics[0].item() for name, camera in rig.cameras.items()} == {"0.png": 500, "1.png": 501}
    ct.save(rig, path)
    assert_same(ct.load(path), rig)
    with pytest.raises(ct.CameraFileError, match="fl_x: must be that of all frames"):
        ct.loads({"camera_model": "OPENCV", "fl_x": 400, "frames": frames})


def test_models_of_instant_ngp():
    text = {"camera_angle_x": 1.2, "w": 640, "h": 480, "frames": []}
    for more, kind in (
        ({}, ct.Pinhole),
        ({"camera_model": "PINHOLE", "k1": 0, "p2": 0}, ct.Pinhole),
        ({"camera_model": "PINHOLE", "k1": 0.1}, ct.BrownConrady),
        ({"k1": 0.1}, ct.BrownConrady),
        ({"k1": 0.1, "is_fisheye": True}, ct.KannalaBrandt),
    ):
        assert type(ct.loads(text | more).camera) is kind
    with pytest.raises(ct.CameraFileError, match=r"k4: must be 0, as Nerfstudio"):
        ct.loads(text | {"k1": 0.1, "k4": 0.1})


def test_colmap_points_are_not_lost(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    images = "# list\n1 1 0 0 0 0 0 0 1 a.jpg\n10.5 11.5 -1\n2 1 0 0 0 0 0 1 1 b.jpg\n\n"
    (tmp_path / "images.txt").write_text(images)
    rig = ct.load(tmp_path)
    assert list(rig.extrinsics) == ["a.jpg", "b.jpg"]
    with pytest.raises(ct.CameraFileError, match="must hold no points, which would be lost"):
        ct.save(rig, tmp_path / "cameras.txt")
    # nor would other cameras get the poses of these images
    with pytest.raises(ct.CameraFileError, match=r"extrinsics: must be given, as .*images.txt has poses of images"):
        ct.save(ct.Rig({"1": rig.camera}), tmp_path / "cameras.txt")


@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_a_folder_of_colmap(suffix, tmp_path):
    rig = load("nerfstudio_transforms.json")
    folder = tmp_path / "sparse" / "0"
    folder.parent.mkdir()
    if suffix == "bin":
        folder.mkdir()
        ct.save(rig, folder / "cameras.bin")
    ct.save(rig, f"{folder}/", "colmap")
    assert {path.name for path in folder.iterdir()} == {f"{n}.{suffix}" for n in ("cameras", "images", "points3D")}
    again = ct.load(folder)
    assert list(again.extrinsics) == list(rig.extrinsics)
    ct.save(again, folder)
    assert_same(ct.load(folder), again)
    with pytest.raises(ValueError, match="path must be a file for basalt"):
        ct.save(again.camera, folder, "basalt")


def test_poses_of_colmap_stay_together(tmp_path):
    rig = load("nerfstudio_transforms.json")
    with pytest.raises(ct.CameraFileError, match=r"Call the file cameras.txt, or name a folder"):
        ct.save(rig, tmp_path / "left.txt", "colmap")
    ct.save(rig, tmp_path, "colmap")
    (tmp_path / "frames.txt").write_text("")
    moved = ct.load(tmp_path)
    name = next(iter(moved.extrinsics))
    moved.extrinsics[name] = ct.Extrinsics(float64([0.1, 0, 0]), float64([0, 0, 0]))
    with pytest.raises(ct.CameraFileError, match=r"must agree with frames.txt"):
        ct.save(moved, tmp_path)
    ct.save(ct.Rig({"1": rig.camera}), tmp_path / "alone.txt", "colmap")
    assert not ct.load(tmp_path / "alone.txt").extrinsics


@pytest.mark.parametrize(("keys", "focal"), [
    ({"camera_angle_x": 1.0, "camera_angle_y": 0.5}, (320 / math.tan(0.5), 240 / math.tan(0.25))),
    ({"camera_angle_x": 1.2}, (320 / math.tan(0.6), 320 / math.tan(0.6))),
    ({"camera_angle_y": 0.5}, (240 / math.tan(0.25), 240 / math.tan(0.25))),
    ({"fl_x": 500, "camera_angle_y": 0.5}, (500.0, 240 / math.tan(0.25))),
    ({"x_fov": 57.29577951308232, "y_fov": 28.64788975654116}, (320 / math.tan(0.5), 240 / math.tan(0.25))),
])  # fmt: skip
def test_angles_of_nerfstudio(keys, focal):
    camera = ct.loads({"w": 640, "h": 480, "frames": [], **keys}).camera
    assert camera.intrinsics.tolist() == pytest.approx([*focal, 319.5, 239.5], rel=1e-12)
    for side in ({"w": 640}, {"h": 480}):  # one alone is no size
        camera = ct.loads({**side, "fl_x": 500, "cx": 320, "cy": 240, "frames": []}).camera
        assert (camera.image_size, camera.intrinsics.tolist()) == (None, [500, 500, 319.5, 239.5])


HOLDING = {"camtorch", "kalibr", "colmap", "nerfstudio", "aria", "basalt"}
"""Formats of several cameras at any places."""
rotations = st.lists(st.floats(-3, 3), min_size=3, max_size=3) | st.permutations([0.0, 0.0, math.pi])
vectors = st.tuples(rotations, st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3))


@settings(max_examples=2, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(first=st.one_of(st.just(([0.0] * 3,) * 2), vectors), second=vectors)
def test_any_poses_survive(first, second, tmp_path):
    camera = ct.Pinhole(float64([500, 501, 320, 240]), image_size=(480, 640))
    one, two = (ct.Extrinsics(float64(r), float64(t)) for r, t in (first, second))
    still = not any((*first[0], *first[1]))
    both = {"cam0": one, "cam1": two}, HOLDING | ({"opencv"} if still else set())
    for poses, holding in (({"cam0": two}, HOLDING | {"mrcal"}), both):
        rig = ct.Rig(dict.fromkeys(poses, camera), poses)
        for format, suffix in SUFFIXES.items():
            path = tmp_path / f"{len(poses)}{format}" / f"cameras{suffix}"
            path.parent.mkdir(exist_ok=True)
            try:
                ct.save(rig, path, format)
            except ct.CameraFileError:
                assert format not in holding
                continue
            found = ct.load(path)
            if not found.extrinsics and not any((*second[0], *second[1])):  # which is none
                continue
            assert format in holding
            limit = 1e-15 * (16 + 4 * math.hypot(*first[1], *second[1]))  # of a chain two poses are multiplied
            for name, pose in zip(found.extrinsics, poses.values(), strict=True):
                assert torch.allclose(found.extrinsics[name].matrix(), pose.matrix(), rtol=0, atol=limit)
            ct.save(found, path, format)
            assert_same(ct.load(path), found, limit)
