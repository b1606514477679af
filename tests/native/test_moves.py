"""Laws of pixels that are moved: one call of compiled code says what unproject, turn and project say one by one."""

import math

import pytest
import torch
from cameras import KEYS, make, one, pixel_lattice

import camtorch as ct
from camtorch.native.library import native_available

pytestmark = pytest.mark.skipif(not native_available(), reason="the library is not compiled here, or turned off")

each_key = pytest.mark.parametrize("key", KEYS)
each_dtype = pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
TURN = ct.Extrinsics([0.1, -0.2, 0.05], [0, 0, 0]).matrix()[:3, :3].detach()


def sized(camera, dtype):
    camera = camera.to(dtype).requires_grad_(False)
    return camera.replace(image_size=camera.image_size or (480, 640))


def one_by_one(source, target, rotation, pixels):
    rays, has_ray = source.unproject(pixels)
    turned = rays if rotation is None else rays @ rotation.mT.to(rays.dtype)
    moved, valid = target.project(turned)
    valid = valid & has_ray
    return torch.where(valid[..., None], moved, -1.0), valid


def check(found, expected, image_size):
    (moved, valid), (there, mapped) = found, expected
    # whether a ray next to the end of a chart is seen hangs on the last bit of the turn
    assert (valid != mapped).double().mean() < 2e-3
    both = valid & mapped
    near = both & ((there - there.new_tensor(image_size[::-1]) / 2).abs().amax(-1) < 3 * max(image_size))
    eps = torch.finfo(moved.dtype).eps
    assert ((moved - there).abs().amax(-1)[near] <= 4096 * eps * max(image_size)).double().mean() > 0.99


@each_key
@each_dtype
def test_points_move_as_by_a_ray(key, dtype):
    camera, straight = sized(one(key), dtype), ct.Pinhole.from_fov(80, image_size=(200, 300)).to(dtype)
    straight = straight.requires_grad_(False)
    for source, target in ((camera, straight), (straight, camera)):
        pixels = pixel_lattice(source, 23, 31).to(dtype)
        pixels = torch.cat((pixels, pixels.new_tensor([[math.nan, 3], [math.inf, 0], [1e30, 1]])))
        for rotation in (None, TURN.to(dtype)):
            warp = ct.Warp(source, target, rotation)
            moved, valid = warp.transform_points(pixels)
            there, mapped = one_by_one(source, target, rotation, pixels)
            check((moved, valid), (there, mapped & target.contains(there)), target.image_size)


@each_key
def test_a_batch_moves_as_each_alone_and_in_any_memory(key):
    camera = sized(one(key), torch.float64)
    focal = torch.tensor([[1.0, 1, 1, 1], [1.1, 1.1, 1, 1], [0.9, 0.95, 1, 1]], dtype=torch.float64)
    cameras = camera.expand(3).replace(intrinsics=camera.intrinsics * focal).requires_grad_(False)
    straight = ct.Pinhole.from_fov(80, image_size=(200, 300)).double().requires_grad_(False)
    turns = torch.stack([torch.matrix_power(TURN, i) for i in range(len(cameras))]).double()
    warp = ct.Warp(cameras, straight, turns)
    pixels = pixel_lattice(cameras[0], 7, 9).expand(len(cameras), -1, -1)
    found = warp.transform_points(pixels)
    assert torch.equal(found[1], straight.contains(found[0]))  # what has no place is at (-1, -1)
    for rows in (pixels.contiguous(), pixels.movedim(-1, 0).contiguous().movedim(0, -1), pixels.flip(1).flip(1)):
        again = warp.transform_points(rows)
        assert all(map(torch.equal, found, again))
    for i, camera in enumerate(cameras):
        alone = ct.Warp(camera, straight, turns[i]).transform_points(pixels[i])
        assert torch.equal(alone[0], found[0][i])
        assert torch.equal(alone[1], found[1][i])


def test_a_lens_that_must_be_searched_is_whole():
    """Pixels that only brackets and damped steps find, from the middle of a map to its corners."""
    names = [key for key in KEYS if key in ("fisheye624", "brown_conrady", "thin_prism_fisheye")]
    for key in names:
        camera = sized(one(key), torch.float64)
        odd = camera.distortion.clone()
        odd[-2:] = 0.08
        strong = make(key, camera.intrinsics, odd, image_size=camera.image_size).requires_grad_(False)
        target = ct.Pinhole.from_fov(100, image_size=(160, 200)).double().requires_grad_(False)
        pixels = pixel_lattice(strong, 31, 41)
        moved = ct.Warp(strong, target, TURN.double()).transform_points(pixels)
        there, mapped = one_by_one(strong, target, TURN.double(), pixels)
        check(moved, (there, mapped & target.contains(there)), target.image_size)
