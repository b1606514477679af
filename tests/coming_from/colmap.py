"""The rows of the page on COLMAP."""

import functools
import re

import numpy as np
import pycolmap
import torch
from torch.nn.utils import parametrize

import camtorch as ct
from camtorch.networks.parametrize import TiedFocal

from . import SIZE, close, elsewhere, equal, photograph, pixels, plane, points, row, trap, warped

HEIGHT, WIDTH = SIZE
FISHEYE = [75.0, 77.5, 80.0, 60.0, 0.02, -0.01, 0.003, -0.001]
OPENCV = [75.0, 77.5, 80.0, 60.0, -0.28, 0.1, 1e-3, -5e-4]
X, UV, HALF = points(), pixels(), torch.tensor([0, 0, 0.5, 0.5])
IN_K = torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
POSE = ct.Extrinsics(np.array([0.1, -0.2, 0.05]), np.array([0.1, 0.2, 0.3])).requires_grad_(False)
SECOND = ct.Extrinsics(np.array([0.0, 0.3, 0.0]), np.array([1.0, 0.0, 0.0])).requires_grad_(False)


def theirs(name="OPENCV", params=OPENCV):
    return pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=params, camera_id=1)


def lens(model=ct.BrownConrady, params=OPENCV):
    shifted = np.array(params) - np.array([0, 0, 0.5, 0.5] + [0.0] * (len(params) - 4))
    return model(shifted[:4], shifted[4:], image_size=SIZE).requires_grad_(False)


LENS = lens()


def moved(pose=POSE):
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation.numpy()), pose.translation.numpy())


def reconstruction(camera):
    found = pycolmap.Reconstruction()
    found.add_camera_with_trivial_rig(camera)
    found.add_image_with_trivial_frame(pycolmap.Image(name="a.jpg", camera_id=camera.camera_id, image_id=7), moved())
    return found


def rescaled():
    camera = theirs()
    camera.rescale(80, 60)
    return LENS.resize(60, 80).intrinsics + HALF, camera.params[:4]


def imaged():
    image = reconstruction(theirs()).images[7]
    yield POSE.matrix()[:3], image.cam_from_world().matrix()
    yield POSE.position, image.projection_center()
    yield LENS(POSE(X))[0][0] + 0.5, image.project_point(X[0])


def undistorted():
    bitmap = pycolmap.Bitmap.from_array(photograph())
    flat, camera = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, theirs())
    target = ct.Pinhole(np.array(camera.params) - HALF.numpy(), image_size=(camera.height, camera.width))
    return warped(ct.Warp(LENS, target.requires_grad_(False))), flat.to_array()


def posed():
    seen = LENS(POSE(X))[0]
    found = pycolmap.estimate_and_refine_absolute_pose(seen.numpy() + 0.5, X, theirs())
    ours = ct.solve_pnp(LENS, X, seen, threshold=2).extrinsics
    return ours.matrix()[:3], found["cam_from_world"].matrix(), 1e-6


equal("pycolmap", {
    "Camera.img_from_cam": lambda: [(LENS.project(X)[0] + 0.5, theirs().img_from_cam(X))],
    "Camera.cam_ray_from_img Camera.cam_from_img": lambda: [
        (LENS.unproject(UV - 0.5)[0], theirs().cam_ray_from_img(UV), 1e-7),
        (plane(LENS.unproject(UV - 0.5)[0]), theirs().cam_from_img(UV), 1e-7),
    ],
    "Camera.calibration_matrix": lambda: [(LENS.K + IN_K, theirs().calibration_matrix())],
    "Camera.rescale": lambda: [rescaled()],
    "Image.cam_from_world Image.projection_center Image.project_point": imaged,
    "Rigid3d.matrix Rigid3d.inverse": lambda: [
        (POSE.inverse().matrix()[:3], moved().inverse().matrix()),
        (POSE.compose(SECOND).matrix()[:3], (moved() * moved(SECOND)).matrix()),
    ],
    "undistort_camera": lambda: [undistorted()],
    "estimate_and_refine_absolute_pose": lambda: [posed()],
})  # fmt: skip
elsewhere("pycolmap", {
    "Reconstruction.write Reconstruction.images": "io/test_files.py::test_colmap",
    "CameraModelId.SIMPLE_PINHOLE CameraModelId.SIMPLE_RADIAL CameraModelId.SIMPLE_FISHEYE CameraModelId.FOV "
    "CameraModelId.THIN_PRISM_FISHEYE CameraModelId.RAD_TAN_THIN_PRISM_FISHEYE CameraModelId.SIMPLE_DIVISION "
    "CameraModelId.EUCM CameraModelId.EQUIRECTANGULAR": "io/test_files.py::test_each_model_of_colmap",
})  # fmt: skip


@row("pycolmap.Reconstruction", "pycolmap.Reconstruction.cameras")
def read(tmp_path):
    reconstruction(theirs()).write(tmp_path)
    rig = ct.load(tmp_path)
    assert list(rig.cameras) == ["1"]
    close(rig["a.jpg"].intrinsics, [75.0, 77.5, 79.5, 59.5])
    close(rig["a.jpg"].distortion, OPENCV[4:])
    close(rig.extrinsics["a.jpg"].matrix()[:3], moved().matrix())
    assert rig.extrinsics.batch.batch_shape == (1,)


@row("pycolmap.triangulate_point", "pycolmap.estimate_triangulation", slow=True)
def triangulate():
    poses = ct.Extrinsics(np.zeros(3), np.zeros(3)).requires_grad_(False), POSE
    seen = torch.stack([LENS(pose(X))[0] for pose in poses])
    found, _, valid = ct.triangulate([LENS, LENS], [*poses], seen)
    assert valid.all()
    matrices = [pose.matrix()[:3].numpy() for pose in poses]
    close(found[0], pycolmap.triangulate_point(*matrices, *plane(LENS.unproject(seen)[0]).numpy()[:, 0]), 1e-6)
    robust = pycolmap.estimate_triangulation(seen[:, 0].numpy() + 0.5, [pycolmap.Rigid3d(), moved()], [theirs()] * 2)
    close(found[0], robust["xyz"], 1e-3)


@trap
def quaternions(tmp_path):
    reconstruction(theirs()).write_text(tmp_path)
    w, x, y, z = map(float, re.search(r"^7 (.*) 1 a.jpg$", (tmp_path / "images.txt").read_text(), re.M)[1].split()[:4])
    close(moved().rotation.quat, [x, y, z, w], 1e-9)


@functools.partial(trap, slow=True)
def one_focal_length(tmp_path):
    camera = lens(params=[75.0, 75.0, 80.0, 60.0, -0.1, 0.0, 0.0, 0.0]).requires_grad_()
    parametrize.register_parametrization(camera, "intrinsics", TiedFocal())
    camera.project(X)[0][..., 0].sum().backward()
    torch.optim.SGD(camera.parameters(), 1e-4).step()
    assert camera.fx == camera.fy != 75.0
    parametrize.remove_parametrizations(camera, "intrinsics")
    with torch.no_grad():
        camera.distortion[1:] = 0.0
    ct.save(camera, tmp_path / "cameras.txt", format="colmap")
    assert " SIMPLE_RADIAL " in (tmp_path / "cameras.txt").read_text()


@trap
def past_ninety_degrees():
    beside = np.array([[np.sin(1.7), 0.0, np.cos(1.7)]])
    camera, ours = theirs("OPENCV_FISHEYE", FISHEYE), lens(ct.KannalaBrandt, FISHEYE)
    assert np.isnan(camera.img_from_cam(beside)).all()
    close(camera.img_from_cam(beside, check_cheirality=False), camera.img_from_cam(-beside))
    uv, valid = ours.project(beside)
    assert valid & (uv[0, 0] > 180)
    close(ours.unproject(uv)[0], beside)
    assert camera.cam_ray_from_img(uv.numpy() + 0.5)[0, 2] > 0.4
