"""What we write, read by the tools themselves; each test runs where its tool is installed."""

import numpy as np
import pytest
import torch
from rigs import POINT, float64, load

import camtorch as ct

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
