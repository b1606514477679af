"""Depth: points of pixels, and images of other cameras at other places by a depth map."""

import math
from functools import partial

import pytest
import torch
from cameras import fisheye

import camtorch as ct

SIZE = (12, 16)
lens = partial(fisheye, SIZE, dtype=torch.float64)


def pinhole(size=(10, 14)):
    return ct.BrownConrady([15.0, 14, 6, 5], [-0.1, 0.02, 0, 0, 0], image_size=size).double().requires_grad_(False)


def pose(turn=(0.03, -0.1, 0.05), shift=(0.1, -0.05, 0.08)):
    return ct.Extrinsics(turn, shift).double().requires_grad_(False)


def smooth(*shape, seed=0):
    values = torch.rand(*shape, generator=torch.Generator().manual_seed(seed)).double()
    return torch.nn.functional.avg_pool2d(values, 3, 1, 1)


def depths(*shape, seed=1):
    return 1 + 2 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed)).double()


def by_torch(images, depth, source, target, extrinsics, kind):
    """The same by the definition, and torch's own sampling."""
    rays, found = target.unproject(target.pixel_grid())
    points = rays * depth[:, 0, ..., None] / (rays[..., 2:] if kind == "z" else 1)
    usable = found & (depth[:, 0] > 0) & (rays[..., 2] > 0 if kind == "z" else True)
    seen, mapped = source.project(extrinsics(points))
    usable &= mapped
    grid = (2 * seen + 1) / torch.tensor(source.image_size[::-1]) - 1
    result = torch.nn.functional.grid_sample(images, torch.where(usable[..., None], grid, -9.0), align_corners=False)
    return result, usable & source.contains(seen)


@pytest.mark.parametrize(("kind", "wide"), [("z", True), ("distance", False)])
def test_it_is_what_torch_samples_where_points_are_seen(kind, wide):
    source, target = (pinhole(), lens()) if wide else (lens(), pinhole())
    images, depth = smooth(2, 3, *source.image_size), depths(2, 1, *target.image_size)
    depth[0, 0, 3, 4], depth[1, 0, 2, 2] = -1.0, math.nan
    result, valid = ct.Reproject(source, target, pose())(images, depth, kind)
    expected, mask = by_torch(images, depth, source, target, pose(), kind)
    torch.testing.assert_close(result, expected, rtol=0, atol=1e-9)
    assert torch.equal(valid[:, 0], mask)
    assert 0.05 < valid.double().mean() < 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_identity_gives_the_image_back_to_the_bit(dtype):
    camera = fisheye((120, 161), dtype=dtype)
    stays = ct.Reproject(camera, camera, pose((0, 0, 0), (0, 0, 0)).to(dtype))
    images = torch.rand(2, 3, 120, 161, dtype=dtype)
    result, valid = stays(images, depths(1, 1, 120, 161).to(dtype), "distance")
    assert valid.all()
    assert torch.equal(result, images)


def test_a_sweep_is_its_planes_one_by_one():
    moved = ct.Reproject(pinhole(), lens(), pose())
    images = smooth(2, 5, 10, 14)
    planes = torch.linspace(1, 8, 7).double().view(1, 7, 1, 1).expand(1, 7, *SIZE)
    volume, valid = moved(images, planes, "distance")
    assert volume.shape == (2, 5, 7, *SIZE)
    assert valid.shape == (2, 1, 7, *SIZE)
    for i in range(7):
        one, here = moved(images, planes[:, i : i + 1], "distance")
        torch.testing.assert_close(volume[:, :, i], one, rtol=0, atol=1e-12)
        assert torch.equal(valid[:, :, i], here)


@pytest.mark.parametrize("kind", ["z", "distance"])
def test_backprojected_points_are_seen_at_their_pixels(kind):
    camera = lens()
    depth = depths(3, 1, *SIZE)
    depth[0, 0, 0, 0], depth[1, 0, 5, 5], depth[2, 0, 6, 6] = 0.0, math.nan, math.inf
    points, valid = camera.backproject(depth, kind)
    assert points.shape == (3, *SIZE, 3)
    assert points.isfinite().all()
    pixels, _ = camera.project(points[valid])
    torch.testing.assert_close(pixels, camera.pixel_grid().expand(3, -1, -1, -1)[valid], rtol=0, atol=1e-9)
    found = points[..., 2] if kind == "z" else points.norm(dim=-1)
    torch.testing.assert_close(found[valid], depth[:, 0][valid])
    assert not valid[0, 0, 0]
    assert not valid[1, 5, 5]
    assert not valid[2, 6, 6]
    one, _ = camera.backproject(depth[1, 0], kind)
    torch.testing.assert_close(one, points[1])
