"""Every format: what the files say, and that it comes back."""

import numpy as np
import pytest
import torch
from rigs import MANIFEST, POINT, SAMPLES, SUFFIXES, assert_same, float64, load

import camtorch as ct


@pytest.mark.parametrize("name", SAMPLES)
def test_a_calibration_is_a_measurement(name):
    rig = load(name)
    for module in (*rig.cameras.values(), *rig.extrinsics.values()):
        assert all(not p.requires_grad and p.dtype == torch.float64 for p in module.parameters())
        assert not any(t.requires_grad for t in module.buffers())
    for camera in rig.cameras.values():
        pixels, _ = camera.project(float64(POINT))
        assert not pixels.requires_grad
        pixels, _ = camera.requires_grad_().project(float64(POINT))
        pixels.sum().backward()
        assert camera.intrinsics.grad is not None


@pytest.mark.parametrize("name", SAMPLES)
def test_what_was_loaded_is_written_as_any_format_that_holds_it(name, tmp_path):
    rig = load(name)
    for format in SUFFIXES:
        (folder := tmp_path / format).mkdir()
        check_written(rig, format, folder / (name if format == rig.format else f"cameras{SUFFIXES[format]}"))


def check_written(rig, format, path):
    try:
        ct.save(rig, path, format)
    except ct.CameraFileError as error:
        assert str(error).startswith(f"{path}: ")  # noqa: PT017 (which error is not the point: see the test below)
        assert not path.exists()
        return
    first = ct.load(path)
    assert first.format == format
    if format == rig.format:
        assert_same(first, rig)
    point = float64(POINT)
    for before, after in zip(rig.cameras.values(), first.cameras.values(), strict=True):
        assert torch.allclose(before.project(point)[0], after.project(point)[0], rtol=0, atol=1e-9)
    for before, after in zip(rig.extrinsics.values(), first.extrinsics.values(), strict=False):
        assert torch.allclose(before(point), after(point), rtol=0, atol=1e-14)
    ct.save(first, path, format)
    assert_same(first, ct.load(path))


CASES = [
    (name, label, camera)
    for name, entry in MANIFEST.items()
    if "cameras" in entry["expected"]
    for label, camera in entry["expected"]["cameras"].items()
]


@pytest.mark.parametrize(("name", "label", "expected"), CASES)
def test_values_of_the_manifest(name, label, expected):
    """Intrinsics in the file's convention, and the size as width and height."""
    found, shift = load(name).cameras[label], MANIFEST[name]["pixel_centre"]
    fx, fy, cx, cy = expected["intrinsics"]
    assert found.key == expected["model"]
    assert found.intrinsics.tolist() == [fx, fy, cx - shift, cy - shift]
    assert found.distortion.tolist() == expected["distortion"]
    assert found.image_size == tuple(expected["image_size"][::-1])
    if reference := MANIFEST[name].get("check_pixel_of_point_0p1_m0p2_1"):
        pixel = found.project(float64(POINT))[0] + shift
        assert torch.allclose(pixel, float64(reference[label]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("suffix", ["txt", "bin"])
@pytest.mark.parametrize("entry", MANIFEST["cameras.txt"]["expected"], ids=lambda entry: entry["model"])
def test_each_model_of_colmap(entry, suffix, tmp_path):
    path, name, values = tmp_path / f"cameras.{suffix}", entry["model"], entry["params"]
    (tmp_path / "one.txt").write_text(f"7 {name} {entry['width']} {entry['height']} {' '.join(map(repr, values))}\n")
    key, fx, fy, cx, cy, *distortion = entry["ours"]  # but for the half pixel
    rest = (float64(distortion),) if distortion else ()
    core, size = float64([fx, fy, cx - 0.5, cy - 0.5]), (entry["height"], entry["width"])
    expected = ct.MODELS[key](core, *rest, image_size=size)
    rig = ct.load(tmp_path / "one.txt")
    ct.save(rig, path)
    assert_same(rig, ct.Rig({"7": expected}))
    assert_same(ct.load(path), rig)
    if suffix == "txt":
        assert path.read_text().splitlines()[-1].split()[1] == name


# -- what we write, read by the tools themselves

PLACED = ct.Extrinsics(float64([0.3, -0.2, 0.1]), float64([0.5, 0.25, -1.0]))


def cameras():
    """One camera of each model and number of coefficients that COLMAP or OpenCV has too."""
    core, size = [500.0, 501.0, 320.25, 240.5], {"image_size": (480, 640)}
    for key, distortion in (
        ("pinhole", []),
        ("brown_conrady", [-0.3, 0, 0, 0]),
        ("brown_conrady", [-0.3, 0.1, 0, 0]),
        ("brown_conrady", [-0.3, 0.1, 1e-3, 2e-3]),
        ("brown_conrady", [-0.3, 0.1, 1e-3, 2e-3, 0.01]),
        ("brown_conrady", [-0.3, 0.1, 1e-3, 2e-3, 0.01, 0.02, 0.03, 0.04]),
        ("kannala_brandt", [0.1]),
        ("kannala_brandt", [0.1, -0.02]),
        ("kannala_brandt", [0.1, -0.02, 3e-3, 1e-5]),
        ("fisheye624", [0.1, -0.02, 3e-3, 1e-5, 1e-6, 1e-7, 1e-3, 2e-3, 1e-4, 2e-4, 3e-4, 4e-4]),
        ("fov", [0.9]),
        ("eucm", [0.6, 1.1]),
        ("division", [-0.2]),
        ("thin_prism_fisheye", [0.1, -0.02, 1e-3, 2e-3, 3e-3, 1e-5, 1e-4, 2e-4]),
    ):
        for fy in (500.0, 501.0):
            arguments = (float64(distortion),) if distortion else ()
            yield ct.MODELS[key](float64([core[0], fy, *core[2:]]), *arguments, **size)


@pytest.mark.parametrize("suffix", ["yml", "json", "xml"])
def test_opencv(suffix, tmp_path):
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is not installed")
    path = tmp_path / f"camera.{suffix}"
    for camera in cameras():
        fisheye = camera.key == "kannala_brandt"
        if camera.key not in ("pinhole", "brown_conrady", "kannala_brandt"):
            continue
        ct.save(camera, path, "opencv")
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        K, D = (storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))  # noqa: N806
        assert (storage.getNode("fisheye_model").real() == 1) == fisheye
        assert storage.getNode("image_width").real() == 640
        project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
        points = np.array([[POINT]]) if fisheye else np.array([POINT])
        pixel = project(points, np.zeros(3), np.zeros(3), K, np.zeros(4) if D is None else D)[0].ravel()
        assert np.allclose(pixel, camera.project(float64(POINT))[0].tolist(), rtol=0, atol=1e-9)
    ct.save(load("opencv_stereo.yml"), path)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    pose = load("opencv_stereo.yml").extrinsics["2"].matrix().detach().numpy()
    assert np.allclose(storage.getNode("R").mat(), pose[:3, :3], rtol=0, atol=1e-15)
    assert np.allclose(storage.getNode("T").mat().ravel(), pose[:3, 3], rtol=0, atol=1e-15)


@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_colmap(suffix, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    named = {str(i): camera for i, camera in enumerate(cameras(), 3)}
    poses = {f"{name}.jpg": PLACED for name in named}
    ct.save(ct.Rig(named, poses, images={f"{name}.jpg": name for name in named}), tmp_path / f"cameras.{suffix}")
    reconstruction = pycolmap.Reconstruction(str(tmp_path))
    assert {str(i) for i in reconstruction.cameras} == set(named)
    for image in reconstruction.images.values():
        world = PLACED.inverse()(float64(POINT)).detach().numpy()
        pixel = reconstruction.cameras[image.camera_id].img_from_cam(image.cam_from_world() * world)
        ours = named[str(image.camera_id)].project(float64(POINT))[0] + 0.5
        assert image.name == f"{image.camera_id}.jpg"
        assert np.allclose(pixel, ours.tolist(), rtol=0, atol=1e-8)
    first = ct.load(tmp_path)
    getattr(reconstruction, "write_text" if suffix == "txt" else "write_binary")(str(tmp_path))
    for name, camera in ct.load(tmp_path).cameras.items():
        assert torch.equal(camera.intrinsics, first.cameras[name].intrinsics)
        assert torch.equal(camera.distortion, first.cameras[name].distortion)


def test_aria(tmp_path):
    calibration = pytest.importorskip("projectaria_tools.core.calibration", reason="projectaria-tools is not installed")
    path = tmp_path / "device.json"
    rig = load("aria_device_calibration.json")
    rig.cameras["linear"] = ct.Pinhole(float64([500, 501, 320, 240]), image_size=(480, 640))
    rig.extrinsics["linear"] = PLACED
    ct.save(rig, path)
    device = calibration.device_calibration_from_json(str(path))
    for name, camera in rig.cameras.items():
        theirs = device.get_camera_calib(name)
        assert np.allclose(theirs.project(np.array(POINT)), camera.project(float64(POINT))[0].tolist(), atol=1e-9)
        pose = theirs.get_transform_device_camera().inverse().to_matrix()
        assert np.allclose(pose, rig.extrinsics[name].matrix().tolist(), rtol=0, atol=1e-14)
        assert tuple(theirs.get_image_size()) == camera.image_size[::-1]
