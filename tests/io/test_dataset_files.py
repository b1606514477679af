"""Files of data sets and of photogrammetry: poses and pixels by published formulas, and what is refused."""

import json
import math

import numpy as np
import pytest
from rigs import FILES, float64, load, tables

import camtorch as ct

POINT = np.array([0.3, -0.2, 1.5])


def rotation_of(w, x, y, z):
    w, x, y, z = np.array([w, x, y, z]) / np.linalg.norm([w, x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def seen(rig, name, point):
    """A point of the rig's or the world's frame in the frame of a camera or an image."""
    return rig.extrinsics[name](float64(point)).numpy()


def changed(name, *changes):
    text = (FILES / name).read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    return text


def test_woodscape_is_vehicle_from_camera():
    rig, given = load("woodscape.json"), json.loads((FILES / "woodscape.json").read_text())["extrinsic"]
    x, y, z, w = given["quaternion"]
    vehicle = rotation_of(w, x, y, z) @ POINT + given["translation"]
    assert np.allclose(seen(rig, "FV", vehicle), POINT, atol=1e-12)
    angle = math.atan2(math.hypot(*POINT[:2]), POINT[2])
    radius = 339.749 * angle - 31.988 * angle**2 + 48.275 * angle**3 - 7.201 * angle**4
    centre = np.array([1280, 966]) / 2 + (3.942, -3.093) - 0.5
    expected = centre + radius * POINT[:2] / math.hypot(*POINT[:2])
    assert np.allclose(rig.camera.project(float64(POINT))[0].numpy(), expected, atol=1e-10)


def metashape_pixel(point, f, cx, cy, b1, k, p1, p2, size, fisheye):
    """Of Metashape's manual, appendix C; the first pixel's centre is (0.5, 0.5)."""
    x, y = point[:2] / point[2]
    if fisheye:
        r = math.hypot(x, y)
        x, y = np.array([x, y]) * math.atan(r) / r
    r2 = x * x + y * y
    radial = 1 + sum(value * r2 ** (i + 1) for i, value in enumerate(k))
    a = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    b = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    return np.array([size[0] * 0.5 + cx + a * f + a * b1, size[1] * 0.5 + cy + b * f])


def test_pixels_of_metashape():
    rig = load("metashape_cameras.xml")
    frame = (3705.4728792737214, 11.6738523909, -27.7497969199, 0.5262024073)
    lens = (-0.0919367147, -0.0762807468, 0.1162639394), -0.0003134847, 0.0001164035
    expected = metashape_pixel(POINT, *frame, *lens, (5280, 3956), fisheye=False)
    found = rig["000001-01_00001.JPG"].project(float64(POINT))[0].numpy() + 0.5
    assert np.allclose(found, expected, atol=1e-9)
    lens = (0.0499776, 0.00096095, -0.00013138), 8.29386e-05, -0.000224424
    expected = metashape_pixel(POINT, 2300.09046, 48.6187, 52.6176, 0.0, *lens, (5312, 3553), fisheye=True)
    assert np.allclose(rig["fisheye.jpg"].project(float64(POINT))[0].numpy() + 0.5, expected, atol=1e-9)


@pytest.mark.parametrize("where", ["component", "chunk", "nowhere"])
def test_poses_of_metashape_are_in_the_world_that_its_transform_says(where):
    rotation = "0.8710699454 0.3070967021 -0.3833128821 -0.4909742007 0.5658364395 -0.6623997719 0.0134716110"
    text = (FILES / "metashape_cameras.xml").read_text()
    assert rotation in text
    start, end = text.index("    <components"), text.index("    <cameras")
    transform = text[text.index("        <transform>") : text.index("</transform>") + len("</transform>")]
    if where != "component":
        text = text[:start] + (transform if where == "chunk" else "") + text[end:]
    rig = ct.loads(text)
    assert list(rig.extrinsics) == ["000001-01_00001.JPG", "fisheye.jpg"]
    assert set(rig.cameras) == {"M3M (12.29mm)", "ONE R"}
    chunk = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ POINT + (0.5, -0.25, 2)
    world, scale = chunk, 1.0
    if where != "nowhere":
        values = [*rotation.split(), 0.7651932691, 0.6436596744]
        matrix, scale = np.array(values, float).reshape(3, 3), 0.12354192447331316
        world = scale * matrix @ chunk + (-0.249936, -0.425683, 0.402921)
    # 1e-9: to so many digits the rotation of the file is one
    assert np.allclose(seen(rig, "fisheye.jpg", world), POINT * scale, atol=1e-9)


def test_sensors_and_images_of_metashape_that_are_called_the_same_get_their_ids():
    same = ('label="ONE R"', 'label="M3M (12.29mm)"'), ('label="fisheye.jpg"', 'label="000001-01_00001.JPG"')
    rig = ct.loads(changed("metashape_cameras.xml", *same))
    assert rig.images == {"000001-01_00001.JPG 0": "M3M (12.29mm) 0", "000001-01_00001.JPG 1": "M3M (12.29mm) 1"}
    with_text = ct.loads(changed("metashape_cameras.xml", ('"adjusted">', '"adjusted">x')))
    assert str(with_text) == str(load("metashape_cameras.xml"))


@pytest.mark.parametrize(
    ("name", "old", "new", "reason"), [(name, *row) for name, rows in tables(FILES / "refused.txt") for row in rows]
)
def test_what_is_refused(name, old, new, reason):
    with pytest.raises(ct.CameraFileError, match=reason):
        ct.loads(changed(name, (old, new)))


@pytest.mark.parametrize(("kind", "lens", "core"), [
    ("PINHOLE", "k1: 0.1, k2: 0.2, p1: 0.3, p2: 0.4", "fx: 5, fy: 6, cx: 7, cy: 8"),
    ("KANNALA_BRANDT", "", "k2: 0.1, k3: 0.2, k4: 0.3, k5: 0.4, mu: 5, mv: 6, u0: 7, v0: 8"),
])  # fmt: skip
def test_other_models_of_camodocal(kind, lens, core):
    head = f"model_type: {kind}\ncamera_name: a\nimage_width: 640\nimage_height: 480\n"
    camera = ct.loads(f"{head}distortion_parameters: {{{lens}}}\nprojection_parameters: {{{core}}}\n")["a"]
    assert camera.key == {"PINHOLE": "brown_conrady"}.get(kind, kind.lower())
    assert (camera.intrinsics.tolist(), camera.distortion.tolist()) == ([5, 6, 7, 8], [0.1, 0.2, 0.3, 0.4])


def test_nuscenes_is_ego_from_sensor():
    rig = ct.load(FILES / "nuscenes" / "calibrated_sensor.json")
    assert rig.format == "nuscenes"
    assert list(rig.cameras) == list(rig.extrinsics) == ["CAM_FRONT", "CAM_BACK"]  # and no lidar
    assert rig["CAM_BACK"].intrinsics.tolist() == [809.2209905677063] * 2 + [829.2196003259838, 481.77842384512485]
    rotation = rotation_of(0.4998015430569128, -0.5030316162024876, 0.4997798114386805, -0.49737083824542755)
    ego = rotation @ POINT + (1.70079118954, 0.0159456324149, 1.51095763913)
    assert np.allclose(seen(rig, "CAM_FRONT", ego), POINT, atol=1e-12)


def test_tables_of_nuscenes_without_channels_or_with_several_drives(tmp_path):
    table = json.loads((FILES / "nuscenes" / "calibrated_sensor.json").read_text())
    tokens = ["1d31c729b073425e8e0202c5c6e66ee1", "6f3ea2e3f4bf4ae5b3ff2bc9d9b4b0a1"]
    assert list(ct.loads(table).cameras) == tokens
    (tmp_path / "sensor.json").write_text((FILES / "nuscenes" / "sensor.json").read_text())
    again = {**table[0], "token": "another drive", "camera_distortion": [-0.3, 0.1, 1e-3, 2e-3, 0.01, 0.0]}
    (tmp_path / "calibrated_sensor.json").write_text(json.dumps([*table, again]))
    rig = ct.load(tmp_path / "calibrated_sensor.json")
    assert list(rig.cameras) == [tokens[0], "CAM_BACK", "another drive"]
    assert rig["another drive"].distortion.tolist() == [-0.3, 0.1, 1e-3, 2e-3, 0.01]
    for broken, reason in (
        ({"rotation": [1, 1, 0, 0]}, r"\[2\]: a quaternion must have length 1; got 1.41"),
        ({"camera_distortion": [0, 0, 0, 0, 0, 0.1]}, r"\[2\].camera_distortion: a sixth coefficient"),
        ({"token": tokens[0]}, r"\[2\].token: must be unique; got"),
        ({"camera_intrinsic": [[1, 2], [3, 4]]}, r"\[2\].camera_intrinsic: a camera matrix must have 3 x 3"),
    ):
        with pytest.raises(ct.CameraFileError, match=reason):
            ct.loads([table[0], table[1], {**again, **broken}])
