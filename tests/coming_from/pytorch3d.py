"""The rows of the page on PyTorch3D: by what its documentation says."""

import math

import pytest
import torch

import camtorch as ct

from . import SIZE, close, points, row, trap

HEIGHT, WIDTH = SIZE
HALF = min(SIZE) / 2
FLIP = torch.tensor([-1.0, -1.0, 1.0])
POSE = ct.Extrinsics([0.1, -0.2, 0.05], [0.1, 0.2, 0.3]).requires_grad_(False)
R, T = POSE.matrix()[None, :3, :3].mT * FLIP, POSE.translation[None] * FLIP
FOCAL, PRINCIPAL = torch.tensor([[1.2, 1.3]]), torch.tensor([[0.1, -0.2]])
POINTS = torch.from_numpy(points()).float()
RADIAL, TANGENTIAL = torch.tensor([0.02, -0.01, 0.003, -0.001, 1e-4, -1e-4]), torch.tensor([1e-3, -5e-4])
PRISM = torch.tensor([1e-3, 2e-4, 2e-3, 1e-4])


def extrinsics():
    """As on the page."""
    return ct.Extrinsics(FLIP[:, None] * R.mT, FLIP * T).requires_grad_(False)


def camera():
    centre = torch.tensor([WIDTH, HEIGHT]) / 2 - HALF * PRINCIPAL - 0.5
    return ct.Pinhole(torch.cat([HALF * FOCAL, centre], -1), image_size=SIZE).requires_grad_(False)


def view():
    """Rows times R, plus T; x left, y up."""
    return POINTS @ R[0] + T[0]


def ndc(focal=FOCAL, principal=PRINCIPAL):
    return focal * view()[:, :2] / view()[:, 2:] + principal


def screen(positions):
    """Pixels, the corner of the image at (0, 0), of NDC."""
    return torch.tensor([WIDTH, HEIGHT]) / 2 - positions * HALF


@row(
    "pytorch3d.renderer.PerspectiveCameras",
    "pytorch3d.renderer.PerspectiveCameras.transform_points_screen",
    "pytorch3d.renderer.PerspectiveCameras.transform_points_ndc",
    "pytorch3d.renderer.PerspectiveCameras.get_world_to_view_transform",
)
def perspective():
    pixels, valid = camera()(extrinsics()(POINTS[None]))
    assert valid.all()
    close(extrinsics().matrix()[0], POSE.matrix(), 1e-6)
    close(pixels[0] + 0.5, screen(ndc()), 1e-4)
    close((torch.tensor([WIDTH, HEIGHT]) / 2 - 0.5 - pixels[0]) / HALF, ndc(), 1e-5)
    close(extrinsics()(POINTS[None])[0], view() * FLIP, 1e-6)
    matrix = extrinsics().matrix()
    close(matrix[:, :3, :3].mT * FLIP, R, 1e-6)
    close(extrinsics().translation * FLIP, T, 1e-6)


@row("pytorch3d.renderer.FoVPerspectiveCameras")
def field_of_view():
    focal = 1 / math.tan(math.radians(25))
    wide = ct.Pinhole.from_fov(50, image_size=SIZE, axis="vertical").requires_grad_(False)
    close(wide(POSE(POINTS))[0] + 0.5, screen(ndc(focal, 0.0)), 1e-4)
    tall = ct.Pinhole.from_fov(50, image_size=SIZE[::-1], axis="horizontal")
    assert tall.fx.item() == pytest.approx(focal * HALF)


def documented_fisheye(points, focal, principal):
    """By the formulas of `FishEyeCameras`."""
    flat = points[:, :2] / points[:, 2:]
    r = flat.norm(dim=-1, keepdim=True)
    theta = r.atan()
    powers = torch.cat([theta ** (2 * i) for i in range(1, 7)], -1)
    xy = (1 + (powers * RADIAL).sum(-1, keepdim=True)) * theta * flat / r
    x, y = xy.unbind(-1)
    square = x * x + y * y
    (p0, p1), (s0, s1, s2, s3) = TANGENTIAL, PRISM
    u = x + (2 * x * x + square) * p0 + 2 * x * y * p1 + s0 * square + s1 * square**2
    v = y + (2 * y * y + square) * p1 + 2 * x * y * p0 + s2 * square + s3 * square**2
    return torch.stack([u, v], -1) * focal + principal


@row("pytorch3d.renderer.fisheyecameras.FishEyeCameras")
def fisheye():
    own = ct.Fisheye624([75.0, 75.0, 79.5, 59.5], torch.cat([RADIAL, TANGENTIAL, PRISM]), image_size=SIZE)
    close(own.project(POINTS)[0] + 0.5, documented_fisheye(POINTS, 75.0, torch.tensor([80.0, 60.0])), 1e-4)
    focal, principal = torch.tensor([1.2]), torch.tensor([0.1, -0.2])
    centre = torch.tensor([WIDTH, HEIGHT]) / 2 - HALF * principal - 0.5
    intrinsics = torch.cat([HALF * focal, HALF * focal, centre])
    turned = ct.Fisheye624(intrinsics, torch.cat([RADIAL, -TANGENTIAL, -PRISM]), image_size=SIZE)
    close(turned(POSE(POINTS))[0] + 0.5, screen(documented_fisheye(view(), focal, principal)), 1e-4)


@row(
    "pytorch3d.renderer.PerspectiveCameras.unproject_points", "pytorch3d.renderer.PerspectiveCameras.get_camera_center"
)
def back():
    pixels, _ = camera()(extrinsics()(POINTS[None]))
    rays, _ = camera().unproject(pixels)
    world = extrinsics().inverse()(rays / rays[..., 2:] * view()[None, :, 2:])
    close(world[0], POINTS, 1e-4)
    close(extrinsics().position[0], -T[0] @ R[0].mT, 1e-5)


def matrix(shift):
    fx, fy = (HALF * FOCAL[0]).tolist()
    cx, cy = screen(PRINCIPAL[0]).tolist()
    return torch.tensor([[fx, 0, cx - shift], [0, fy, cy - shift], [0, 0, 1]])


@row("pytorch3d.utils.opencv_from_cameras_projection", "pytorch3d.utils.cameras_from_opencv_projection")
def opencv():
    close(camera().K[0], matrix(0.5), 1e-4)
    close(ct.Pinhole.from_matrix(matrix(0.0), image_size=SIZE).K, matrix(0.0), 1e-4)


@row("pytorch3d.transforms.axis_angle_to_matrix", "pytorch3d.transforms.Transform3d.get_matrix")
@row("pytorch3d.transforms.Transform3d.compose")
def transforms():
    second = ct.Extrinsics([0.3, 0.0, 0.1], [0.0, 1.0, 0.0]).requires_grad_(False)
    rows = [pose.matrix().mT for pose in (POSE, second)]  # which multiply rows from the right
    homogeneous = torch.cat([POINTS, torch.ones(len(POINTS), 1)], 1)
    close(second.compose(POSE)(POINTS), (homogeneous @ rows[0] @ rows[1])[:, :3], 1e-5)


@trap
def mirrored_pixels():
    behind = torch.tensor([[0.1, 0.2, -1.0]])
    assert not ct.Pinhole([75.0, 75.0, 79.5, 59.5]).project(behind)[1]
    beside = torch.tensor([[1.0, 0.0, -0.2]])
    assert ct.Fisheye624([75.0, 75.0, 79.5, 59.5], torch.zeros(12)).project(beside)[1]
