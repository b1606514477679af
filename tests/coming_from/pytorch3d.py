"""The rows of the page on PyTorch3D: by what its documentation says."""

import math

import torch

import camtorch as ct

from . import SIZE, equal, plane, points

HEIGHT, WIDTH = SIZE
HALF, WHOLE = min(SIZE) / 2, torch.tensor([WIDTH, HEIGHT])
FLIP = torch.tensor([-1.0, -1.0, 1.0])
POSE = ct.Extrinsics([0.1, -0.2, 0.05], [0.1, 0.2, 0.3]).requires_grad_(False)
R, T = POSE.matrix()[None, :3, :3].mT * FLIP, POSE.translation[None] * FLIP
FOCAL, PRINCIPAL = torch.tensor([[1.2, 1.3]]), torch.tensor([[0.1, -0.2]])
POINTS = torch.from_numpy(points()).float()
RADIAL, TANGENTIAL = torch.tensor([0.02, -0.01, 0.003, -0.001, 1e-4, -1e-4]), torch.tensor([1e-3, -5e-4])
PRISM = torch.tensor([1e-3, 2e-4, 2e-3, 1e-4])
# as on the page
EXTRINSICS = ct.Extrinsics(FLIP[:, None] * R.mT, FLIP * T).requires_grad_(False)
CENTRE = WHOLE / 2 - HALF * PRINCIPAL - 0.5
CAMERA = ct.Pinhole(torch.cat([HALF * FOCAL, CENTRE], -1), image_size=SIZE).requires_grad_(False)
VIEW = POINTS @ R[0] + T[0]  # rows times R, plus T; x left, y up
PIXELS, _ = CAMERA(EXTRINSICS(POINTS[None]))


def screen(positions):
    """Pixels, the corner of the image at (0, 0), of NDC."""
    return WHOLE / 2 - positions * HALF


def ndc(focal=FOCAL, principal=PRINCIPAL):
    return focal * plane(VIEW) + principal


def documented_fisheye(points, focal, principal):
    """By the formulas of `FishEyeCameras`."""
    flat = plane(points)
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


def fisheyes():
    """Of itself, and in the axes of the renderer."""
    own = ct.Fisheye624([75.0, 75.0, 79.5, 59.5], torch.cat([RADIAL, TANGENTIAL, PRISM]), image_size=SIZE)
    yield own.project(POINTS)[0] + 0.5, documented_fisheye(POINTS, 75.0, torch.tensor([80.0, 60.0])), 1e-4
    intrinsics = torch.cat([torch.full((2,), HALF * 1.2), CENTRE[0]])
    turned = ct.Fisheye624(intrinsics, torch.cat([RADIAL, -TANGENTIAL, -PRISM]), image_size=SIZE)
    yield turned(POSE(POINTS))[0] + 0.5, screen(documented_fisheye(VIEW, 1.2, PRINCIPAL[0])), 1e-4


def fields_of_view():
    focal = 1 / math.tan(math.radians(25))
    wide = ct.Pinhole.from_fov(50, image_size=SIZE, axis="vertical")
    yield wide(POSE(POINTS))[0] + 0.5, screen(ndc(focal, 0.0)), 1e-4
    yield ct.Pinhole.from_fov(50, image_size=SIZE[::-1], axis="horizontal").fx, torch.tensor(focal * HALF), 1e-4


equal("pytorch3d.renderer", {
    "PerspectiveCameras PerspectiveCameras.transform_points_screen PerspectiveCameras.transform_points_ndc "
    "PerspectiveCameras.get_world_to_view_transform": lambda: [
        (EXTRINSICS.matrix()[0], POSE.matrix(), 1e-6),
        (PIXELS[0] + 0.5, screen(ndc()), 1e-4),
        ((WHOLE / 2 - 0.5 - PIXELS[0]) / HALF, ndc(), 1e-5),
        (EXTRINSICS(POINTS[None])[0], VIEW * FLIP, 1e-6),
        (EXTRINSICS.matrix()[:, :3, :3].mT * FLIP, R, 1e-6),
        (EXTRINSICS.translation * FLIP, T, 1e-6),
    ],
    "FoVPerspectiveCameras": fields_of_view,
    "fisheyecameras.FishEyeCameras": fisheyes,
    "PerspectiveCameras.unproject_points PerspectiveCameras.get_camera_center": lambda: [
        (EXTRINSICS.inverse()(
            torch.nn.functional.pad(plane(CAMERA.unproject(PIXELS)[0]), (0, 1), value=1.0) * VIEW[None, :, 2:]
        )[0], POINTS, 1e-4),
        (EXTRINSICS.position[0], -T[0] @ R[0].mT, 1e-5),
    ],
})  # fmt: skip
