"""Planes: what pinholes make of them is a homography, and for every camera a point of the plane lands where it is."""

import math
from functools import partial

import pytest
import torch
from cameras import fisheye

import camtorch as ct
from camtorch.poses.rotations import rotation_matrix

TURN, SHIFT = torch.tensor([0.05, -0.1, 0.03]).double(), torch.tensor([0.2, -0.1, 0.15]).double()
NORMAL, DISTANCE = torch.tensor([0.1, 0.3, 1.0]).double(), 2.5
wide = partial(fisheye, focal=0.3, dtype=torch.float64)


def pinholes():
    source = ct.Pinhole([90.0, 95, 62, 50], image_size=(100, 120)).double().requires_grad_(False)
    target = ct.Pinhole([70.0, 72, 55, 41], image_size=(80, 110)).double().requires_grad_(False)
    return source, target


def pose():
    return ct.Extrinsics(TURN, SHIFT).requires_grad_(False)


def above_ground(height=2.0, pitch=35.0):
    """Camera from ground: it looks along y, and down by an angle."""
    level = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()
    down = rotation_matrix(torch.tensor([math.radians(pitch), 0, 0]).double())
    rotation = down @ level
    place = torch.tensor([0.5, -1.0, height]).double()
    return ct.Extrinsics.from_matrix(rotation, -rotation @ place).requires_grad_(False)


def test_of_pinholes_it_is_the_homography():
    source, target = pinholes()
    warp = ct.PlaneWarp(source, target, pose(), NORMAL, DISTANCE)
    homography = source.K @ (rotation_matrix(TURN) + SHIFT[:, None] * NORMAL / DISTANCE) @ torch.linalg.inv(target.K)
    pixels = target.pixel_grid()
    rows = torch.cat((pixels, torch.ones_like(pixels[..., :1])), -1) @ homography.mT
    expected = rows[..., :2] / rows[..., 2:]
    grid = warp.grid()[0]
    seen = ((grid + 1) * torch.tensor([120.0, 100.0]).double() - 1) / 2
    torch.testing.assert_close(seen, expected, rtol=0, atol=1e-6)
    inside = source.contains(expected)
    assert inside.double().mean() > 0.2
    back, valid = warp.transform_points(expected[inside])
    assert valid.all()
    torch.testing.assert_close(back, pixels[inside], rtol=0, atol=1e-6)


def test_between_other_cameras_it_is_of_the_same_plane():
    source, target = pinholes()
    warp, pixels = ct.PlaneWarp(source, target, pose(), NORMAL, DISTANCE), target.pixel_grid()
    moved = warp.between(wide((100, 120)), target, None, mode="nearest")
    expected = ct.PlaneWarp(wide((100, 120)), target, pose(), NORMAL, DISTANCE)
    assert (type(moved), moved.mode, moved.fill) == (ct.PlaneWarp, "nearest", (0.0,))
    assert torch.equal(moved.move(pixels, back=True)[0], expected.move(pixels, back=True)[0])
    eye = ct.BirdsEye(wide((100, 120)), above_ground(), x=(-2, 3), y=(0, 4), resolution=0.1)
    pixels = torch.rand(9, 2, generator=torch.Generator().manual_seed(0)).double() * 100
    both = (each.transform_points(pixels) for each in (eye, eye.between(eye.source, eye.target, None)))
    for one, other in zip(*both, strict=True):
        torch.testing.assert_close(one, other)
    with pytest.raises(ValueError, match="PlaneWarp: rotation must be None"):
        warp.between(source, target, torch.eye(3).double())


def test_beyond_the_horizon_nothing_is_valid():
    source, target = wide((480, 640)), wide((60, 80))
    floor = ct.PlaneWarp(source, target, pose(), (0.0, 1.0, 0.0), 1.5)
    rays, has_ray = target.rays()
    mask = floor.valid_mask()[0, 0]
    below = has_ray & (rays[..., 1] > 1e-6)
    seen, mapped = source.project(pose()(rays * 1.5 / torch.where(below, rays[..., 1:2].squeeze(-1), 1.0)[..., None]))
    assert torch.equal(mask, below & mapped & source.contains(seen))
    assert 0.1 < mask.double().mean() < 0.6
    images = torch.rand(1, 3, 480, 640).double()
    assert (floor(images)[0, :, ~below] == 0).all()
    sky, valid = floor.transform_points(torch.tensor([[319.5, 20.0]]).double())
    assert not valid.any()
    assert sky.tolist() == [[-1, -1]]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_chessboard_on_the_floor_lies_on_its_grid(dtype):
    camera, extrinsics = wide((1080, 1440)), above_ground()
    eye = ct.BirdsEye(camera.to(dtype), extrinsics.to(dtype), x=(-2, 3), y=(0, 4), resolution=0.01)
    assert (eye.target.image_size, eye.grid_points.shape) == ((400, 500), (400, 500, 2))
    for at, place in ((0, [-1.995, 3.995]), (-1, [2.995, 0.005])):
        torch.testing.assert_close(eye.grid_points[at, at].double(), torch.tensor(place).double(), rtol=0, atol=1e-5)
    corners = torch.cartesian_prod(torch.arange(-1.5, 2.6, 0.25), torch.arange(0.5, 3.6, 0.25)).to(dtype)
    ground = torch.nn.functional.pad(corners, (0, 1))
    pixels, seen = camera.project(extrinsics(ground))
    assert seen.all()
    moved, valid = eye.transform_points(pixels)
    assert valid.all()
    torch.testing.assert_close(moved, eye.from_ground(corners), rtol=0, atol=1e-2 if dtype == torch.float32 else 1e-7)
    torch.testing.assert_close(eye.to_ground(moved), corners, rtol=0, atol=1e-4)


def test_the_image_from_above_is_what_lies_there():
    camera, extrinsics = wide((1080, 1440)), above_ground()

    def scene(points):
        return 0.5 + 0.25 * (torch.sin(3 * points[..., 0]) + torch.cos(4 * points[..., 1]))

    rays, valid = camera.rays()
    rotation, place = extrinsics.matrix()[:3, :3], extrinsics.position
    rays = rays @ rotation
    hits = valid & (rays[..., 2] < -1e-3)
    ground = place[:2] - rays[..., :2] * (place[2] / torch.where(hits, rays[..., 2], -1.0))[..., None]
    image = torch.where(hits, scene(ground), 0.0)[None, None]
    eye = ct.BirdsEye(camera, extrinsics, x=(-2, 3), y=(0, 4), resolution=0.02)
    assert eye.valid_mask().all()
    torch.testing.assert_close(eye(image)[0, 0], scene(eye.grid_points), rtol=0, atol=2e-3)
