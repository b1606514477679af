"""The rows of the page on COLMAP."""

import functools

import numpy as np
import pycolmap
import torch
from torch.nn.utils import parametrize

import camtorch as ct

from . import SIZE, close, equal, photograph, pixels, points, row, same_images, trap

HEIGHT, WIDTH = SIZE
FISHEYE = [75.0, 77.5, 80.0, 60.0, 0.02, -0.01, 0.003, -0.001]
OPENCV = [75.0, 77.5, 80.0, 60.0, -0.28, 0.1, 1e-3, -5e-4]
DISTORTION = {
    "SIMPLE_RADIAL": [-0.1],
    "RADIAL": [-0.1, 0.02],
    "OPENCV": [-0.1, 0.02, 1e-3, -5e-4],
    "FULL_OPENCV": [-0.1, 0.02, 1e-3, -5e-4, 0.001, 0.01, 0.002, -0.003],
    "SIMPLE_RADIAL_FISHEYE": [0.02],
    "RADIAL_FISHEYE": [0.02, -0.01],
    "OPENCV_FISHEYE": [0.02, -0.01, 0.003, -0.001],
    "THIN_PRISM_FISHEYE": [0.02, -0.01, 1e-3, -5e-4, 0.002, -0.001, 1e-3, 2e-3],
    "RAD_TAN_THIN_PRISM_FISHEYE": [0.02, -0.01, 3e-3, -1e-3, 1e-4, -1e-4, 1e-3, -5e-4, 1e-3, 2e-4, 2e-3, 1e-4],
    "FOV": [0.8],
    "SIMPLE_DIVISION": [-0.1],
    "DIVISION": [-0.1],
    "EUCM": [0.6, 1.1],
}
CLASSES = {
    "SIMPLE_PINHOLE": (ct.Pinhole, ("SIMPLE_PINHOLE", "PINHOLE")),
    "SIMPLE_RADIAL": (ct.BrownConrady, ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")),
    "SIMPLE_FISHEYE": (
        ct.KannalaBrandt,
        ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"),
    ),
    "THIN_PRISM_FISHEYE": (ct.ThinPrismFisheye, ("THIN_PRISM_FISHEYE",)),
    "RAD_TAN_THIN_PRISM_FISHEYE": (ct.Fisheye624, ("RAD_TAN_THIN_PRISM_FISHEYE",)),
    "FOV": (ct.FOV, ("FOV",)),
    "SIMPLE_DIVISION": (ct.Division, ("SIMPLE_DIVISION", "DIVISION")),
    "EUCM": (ct.EUCM, ("EUCM",)),
    "EQUIRECTANGULAR": (ct.Equirectangular, ("EQUIRECTANGULAR",)),
}


def theirs(name="OPENCV", params=OPENCV):
    return pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=params, camera_id=1)


def lens(model=ct.BrownConrady, params=OPENCV):
    shifted = np.array(params) - np.array([0, 0, 0.5, 0.5] + [0.0] * (len(params) - 4))
    return model(shifted[:4], shifted[4:], image_size=SIZE).requires_grad_(False)


def moved():
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, -0.2, 0.05])), np.array([0.1, 0.2, 0.3]))


def pose():
    return ct.Extrinsics(np.array([0.1, -0.2, 0.05]), np.array([0.1, 0.2, 0.3])).requires_grad_(False)


def reconstruction(camera):
    found = pycolmap.Reconstruction()
    found.add_camera_with_trivial_rig(camera)
    found.add_image_with_trivial_frame(pycolmap.Image(name="a.jpg", camera_id=camera.camera_id, image_id=7), moved())
    return found


def plane(rays):
    return rays[..., :2] / rays[..., 2:]


@row("pycolmap.Reconstruction", "pycolmap.Reconstruction.cameras", "pycolmap.Reconstruction.images")
def read(tmp_path):
    reconstruction(theirs()).write(tmp_path)
    rig = ct.load(tmp_path)
    assert list(rig.cameras) == ["1"]
    close(rig["a.jpg"].intrinsics, [75.0, 77.5, 79.5, 59.5])
    close(rig["a.jpg"].distortion, OPENCV[4:])
    close(rig.extrinsics["a.jpg"].matrix()[:3], moved().matrix())
    assert rig.extrinsics.batch.batch_shape == (1,)


@row("pycolmap.Reconstruction.write")
def write(tmp_path):
    rig = ct.Rig({"1": lens()}, {"a.jpg": pose()}, images={"a.jpg": "1"})
    (tmp_path / "binary").mkdir()
    for path in (tmp_path / "text", tmp_path / "binary" / "cameras.bin"):
        ct.save(rig, path, format="colmap")
        found = pycolmap.Reconstruction(path if path.is_dir() else path.parent)
        close(found.cameras[1].params, OPENCV)
        (image,) = found.images.values()
        close(image.cam_from_world().matrix(), moved().matrix())


HALF = torch.tensor([0, 0, 0.5, 0.5])
IN_K = torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
POINT = torch.from_numpy(points()[0])


def turned():
    """Another pose, theirs and ours."""
    turn, shift = np.array([0.0, 0.3, 0.0]), np.array([1.0, 0.0, 0.0])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(turn), shift), ct.Extrinsics(turn, shift).requires_grad_(False)


def rescaled():
    camera = theirs()
    camera.rescale(80, 60)
    return camera.params[:4]


def image():
    return reconstruction(theirs()).images[7]


def rays():
    return lens().unproject(torch.from_numpy(pixels() - 0.5))[0]


_of = "pycolmap.Image"
equal({
    "pycolmap.Camera.img_from_cam": lambda: (
        (lens().project(torch.from_numpy(points()))[0] + 0.5, theirs().img_from_cam(points())), 1e-9
    ),
    "pycolmap.Camera.cam_ray_from_img pycolmap.Camera.cam_from_img": lambda: (
        (rays(), theirs().cam_ray_from_img(pixels())), (plane(rays()), theirs().cam_from_img(pixels())), 1e-7
    ),
    "pycolmap.Camera.calibration_matrix": lambda: ((lens().K + IN_K, theirs().calibration_matrix()), 1e-9),
    "pycolmap.Camera.rescale": lambda: ((lens().resize(60, 80).intrinsics + HALF, rescaled()), 1e-9),
    f"{_of}.cam_from_world {_of}.projection_center {_of}.project_point": lambda: (
        (pose().matrix()[:3], image().cam_from_world().matrix()),
        (pose().position, image().projection_center()),
        (lens()(pose()(POINT))[0] + 0.5, image().project_point(points()[0])),
        1e-9,
    ),
    "pycolmap.Rigid3d.matrix pycolmap.Rigid3d.inverse": lambda: (
        (pose().inverse().matrix()[:3], moved().inverse().matrix()),
        (pose().compose(turned()[1]).matrix()[:3], (moved() * turned()[0]).matrix()),
        1e-9,
    ),
})  # fmt: skip


@row("pycolmap.undistort_camera")
def undistort():
    bitmap = pycolmap.Bitmap.from_array(photograph())
    flat, camera = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, theirs())
    fx, fy, cx, cy = camera.params
    target = ct.Pinhole([fx, fy, cx - 0.5, cy - 0.5], image_size=(camera.height, camera.width)).requires_grad_(False)
    image = torch.from_numpy(photograph()).permute(2, 0, 1)[None]
    ours = ct.Warp(lens().float(), target)(image)[0].permute(1, 2, 0).numpy()
    same_images(ours, flat.to_array())


@row("pycolmap.estimate_and_refine_absolute_pose")
def absolute_pose():
    seen = lens()(pose()(torch.from_numpy(points())))[0]
    found = pycolmap.estimate_and_refine_absolute_pose(seen.numpy() + 0.5, points(), theirs())
    ours, _, valid = ct.solve_pnp(lens(), points(), seen, threshold=2)
    assert valid
    close(ours.matrix()[:3], found["cam_from_world"].matrix(), 1e-6)


@row("pycolmap.triangulate_point", "pycolmap.estimate_triangulation", slow=True)
def triangulate():
    here = ct.Extrinsics(np.zeros(3), np.zeros(3)).requires_grad_(False)
    world = torch.from_numpy(points(20))
    seen = torch.stack([lens()(pose)[0] for pose in (here(world), pose()(world))])
    found, _, valid = ct.triangulate([lens(), lens()], [here, pose()], seen)
    assert valid.all()
    flat = plane(lens().unproject(seen)[0]).numpy()
    matrices = [one.matrix()[:3].numpy() for one in (here, pose())]
    close(found[0], pycolmap.triangulate_point(*matrices, *flat[:, 0]), 1e-6)
    robust = pycolmap.estimate_triangulation(seen[:, 0].numpy() + 0.5, [pycolmap.Rigid3d(), moved()], [theirs()] * 2)
    close(found[0], robust["xyz"], 1e-3)


def model(first):
    def check(tmp_path):
        kind, names = CLASSES[first]
        for name in names:
            focal = [75.0] if name.startswith(("SIMPLE", "RADIAL")) else [75.0, 77.5]
            params = [*focal, 80.0, 60.0, *DISTORTION.get(name, [])]
            camera = theirs(name, [WIDTH, HEIGHT] if name == "EQUIRECTANGULAR" else params)
            (tmp_path / name).mkdir()
            reconstruction(camera).write(tmp_path / name)
            ours = ct.load(tmp_path / name)["a.jpg"]
            assert type(ours) is kind
            close(ours.project(torch.from_numpy(points()))[0] + 0.5, camera.img_from_cam(points()), 1e-6)

    return check


for _first in CLASSES:
    row(f"pycolmap.CameraModelId.{_first}")(model(_first))


@trap
def quaternions(tmp_path):
    reconstruction(theirs()).write_text(tmp_path)
    line = next(line for line in (tmp_path / "images.txt").read_text().splitlines() if line.endswith("a.jpg"))
    w, x, y, z = map(float, line.split()[1:5])
    close(moved().rotation.quat, [x, y, z, w], 1e-9)


@functools.partial(trap, slow=True)
def one_focal_length(tmp_path):
    camera = lens(params=[75.0, 75.0, 80.0, 60.0, -0.1, 0.0, 0.0, 0.0]).requires_grad_()
    parametrize.register_parametrization(camera, "intrinsics", ct.TiedFocal())
    camera.project(torch.from_numpy(points()))[0][..., 0].sum().backward()
    torch.optim.SGD(camera.parameters(), 1e-4).step()
    assert camera.fx == camera.fy != 75.0
    parametrize.remove_parametrizations(camera, "intrinsics")
    with torch.no_grad():
        camera.distortion[1:] = 0.0
    ct.save(camera, tmp_path / "cameras.txt", format="colmap")
    assert " SIMPLE_RADIAL " in (tmp_path / "cameras.txt").read_text()


@trap
def past_ninety_degrees():
    angle = 1.7
    beside = np.array([[np.sin(angle), 0.0, np.cos(angle)]])
    camera, ours = theirs("OPENCV_FISHEYE", FISHEYE), lens(ct.KannalaBrandt, FISHEYE)
    assert np.isnan(camera.img_from_cam(beside)).all()
    close(camera.img_from_cam(beside, check_cheirality=False), camera.img_from_cam(-beside))
    uv, valid = ours.project(torch.from_numpy(beside))
    assert valid
    assert uv[0, 0] > 180
    close(ours.unproject(uv)[0], beside)
    assert camera.cam_ray_from_img(uv.numpy() + 0.5)[0, 2] > 0.4
