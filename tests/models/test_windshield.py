"""Windshields, and cameras behind them: the formula, its inverse, and all that a camera goes through."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from cameras import fan, one, pixel_lattice
from torch.autograd import gradcheck, gradgradcheck

import camtorch as ct

# of the size of real ones: a tenth of a degree, and a third order upright
HORIZONTAL = [1.2e-3, 1.0021, -8e-4, 6e-4, 3e-3, -9e-4]
VERTICAL = [-4e-3, 5e-4, 9e-3, 1e-3, 0.9962, 2e-3, -4e-3, 7e-3, 1e-3, 3e-3]
KEYS = ("pinhole", "kannala_brandt", "fisheye624", "double_sphere", "cahvor", "f_theta_backward_sheared")
each_model = pytest.mark.parametrize("key", KEYS)


def shield():
    return ct.Windshield(*(np.array(polynomial) for polynomial in (HORIZONTAL, VERTICAL)))


def polynomial(c, phi, theta):
    """As nvidia-ncore has it: of each power of theta a polynomial of phi, one shorter than the one before."""
    order, total, start = round((math.sqrt(8 * len(c) + 1) - 3) / 2), 0.0, 0
    for j in range(order + 1):
        total = total + sum(c[start + i] * phi**i for i in range(order + 1 - j)) * theta**j
        start += order + 1 - j
    return total


def bent(rays):
    rays = rays.numpy() / np.linalg.norm(rays.numpy(), axis=-1, keepdims=True)
    phi, theta = np.arcsin(rays[:, 0]), np.arcsin(rays[:, 1])
    x, y = np.sin(polynomial(HORIZONTAL, phi, theta)), np.sin(polynomial(VERTICAL, phi, theta))
    return torch.from_numpy(np.stack((x, y, np.sqrt(1 - x * x - y * y)), -1))


def test_it_is_the_formula_and_back():
    rays = fan(60)
    there = shield()(3.0 * rays)
    torch.testing.assert_close(there.detach(), bent(rays), rtol=0, atol=1e-14)
    torch.testing.assert_close(shield().inverse(there).detach(), rays, rtol=0, atol=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("orders", [(0, 1), (1, 0), (2, 1), (4, 3), (3, 5), (6, 2), (7, 8)], ids=str)
def test_cameras_are_behind_polynomials_of_any_order(orders, dtype):
    """Natively those of few orders have loops of their own."""
    generator = torch.Generator().manual_seed(0)
    parts = []
    for order, linear in zip(orders, (1, orders[1] + 1), strict=True):
        c = 1e-3 * torch.randn((order + 1) * (order + 2) // 2, generator=generator, dtype=torch.float64)
        if order:
            c[linear] += 1
        parts.append(c.to(dtype))
    camera, glass = one("kannala_brandt").detach().clone().to(dtype), ct.Windshield(*parts)
    seen, rays, eps = camera.behind(glass).detach(), fan(60).to(dtype), torch.finfo(dtype).eps
    pixels, valid = seen.project(rays)
    expected, known = camera.project(glass(rays))
    if 0 in orders:  # of one number nothing depends on the ray
        assert not valid.any()
        return
    assert valid.all()
    assert known.all()
    torch.testing.assert_close(pixels, expected.detach(), rtol=0, atol=4e3 * eps)
    back, found = seen.unproject(pixels)
    assert found.all()
    assert (back - rays).norm(dim=-1).max() < 64 * eps


def test_derivatives_of_both_directions():
    inputs = tuple(t.detach().requires_grad_() for t in (fan(50)[::97].clone(), *shield().parameters()))
    for way in (ct.Windshield.forward, ct.Windshield.inverse):
        assert gradcheck(lambda rays, h, v, way=way: way(ct.Windshield(h, v), rays), inputs)
        assert gradgradcheck(lambda rays, h, v, way=way: way(ct.Windshield(h, v), rays), inputs, fast_mode=True)


def test_rays_are_finite_always():
    bad = [
        [0, 0, 0],
        [math.nan, 0, 1],
        [0, math.inf, 1],
        [1, 0, 0],
        [0, -1, 0],
        [0, 0, -1],
        [1e30, 1e30, 1],
        [1, 1, -1],
    ]
    for way in (shield(), shield().inverse, ct.Windshield([0.0, 3.0, 0.0], [0.5, 0.0, 0.0])):
        rays = torch.tensor(bad, dtype=torch.float64, requires_grad=True)
        found = way(rays)
        assert found.isfinite().all()
        torch.testing.assert_close(found.norm(dim=-1), torch.ones(len(bad), dtype=torch.float64))
        found.sum().backward()
        assert rays.grad.isfinite().all()


@each_model
def test_a_camera_behind_projects_what_the_shield_makes_of_rays(key):
    camera, rays = one(key), fan(50)
    behind = camera.behind(shield())
    pixels, valid = behind.project(rays)
    expected, known = camera.project(bent(rays))
    assert torch.equal(valid, known)
    torch.testing.assert_close(pixels[valid], expected[known], rtol=0, atol=1e-9)
    pixels = pixel_lattice(camera)
    rays, valid = behind.unproject(pixels)
    again, reachable = behind.project(rays)
    assert valid.double().mean() > 0.5
    assert reachable[valid].all()
    torch.testing.assert_close(again[valid], pixels[valid], rtol=0, atol=1e-8)


@each_model
def test_behind_and_beside_there_is_nothing(key):
    behind = one(key).behind(shield())
    rays = torch.tensor([[0, 0, -1], [1, 0, -1e-3], [0, 1, 0], [1, 1, -1]], dtype=torch.float64, requires_grad=True)
    pixels, valid = behind.project(rays)
    assert not valid.any()
    pixels.sum().backward()
    assert (rays.grad == 0).all()
    # the shield turns over, where cos(2 phi) changes its sign
    folded = ct.Windshield([0.0, 1.0, -1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    rays = torch.tensor([[math.sin(a), 0, math.cos(a)] for a in (0.3, 0.49, 0.51, 0.7)], dtype=torch.float64)
    camera = ct.KannalaBrandt([300.0, 300, 320, 240], image_size=(480, 640)).behind(folded)
    assert camera.project(rays)[1].tolist() == [True, True, False, False]


@each_model
def test_derivatives_of_cameras_behind(key):
    camera = one(key).behind(shield())
    kind, points = type(camera), (fan(30)[[100, 400, 700]] * 1.7).requires_grad_()
    parameters = tuple(t.detach().clone().requires_grad_() for t in (camera.intrinsics, camera.distortion))
    assert gradcheck(lambda p, i, k: kind(i, k).project(p)[0], (points, *parameters), atol=1e-4, fast_mode=True)
    pixels = (camera.project(points)[0] / 1000).detach().requires_grad_()
    assert gradcheck(lambda q, i, k: kind(i, k).unproject(q * 1000)[0], (pixels, *parameters), fast_mode=True)


def test_gradients_reach_camera_and_shield():
    camera, glass = (
        ct.KannalaBrandt([300.0, 300, 320, 240], image_size=(480, 640)),
        ct.Windshield([0.0, 1, 0], [0.0, 0, 1]),
    )
    for _ in range(2):
        camera.behind(glass).project(torch.rand(4, 3))[0].sum().backward()
    for parameter in (*camera.parameters(), *glass.parameters()):
        assert parameter.grad.abs().sum() > 0
    frozen = camera.requires_grad_(False).behind(glass.requires_grad_(False))
    assert not any(p.requires_grad for p in frozen.parameters())


@each_model
def test_it_is_a_camera_like_any_other(key, tmp_path):
    bare = one(key).requires_grad_(False)
    camera = bare.behind(shield().requires_grad_(False))
    assert type(camera) is type(one(key).behind(shield()))
    assert isinstance(camera, type(bare))
    ct.save(camera, tmp_path / "camera.json")
    copies = [pickle.loads(pickle.dumps(camera)), copy.deepcopy(camera), ct.load(tmp_path / "camera.json").camera]
    copies[1].load_state_dict(camera.state_dict())
    for other in copies:
        assert type(other) is type(camera)
        assert torch.equal(other.distortion, camera.distortion)
        assert other.image_size == camera.image_size
    rays = fan(40)[::50]
    expected = camera.project(rays)[0]
    both = ct.Mixed([bare, camera]).project(torch.stack((rays, rays)))[0]
    torch.testing.assert_close(both[1], expected, rtol=0, atol=0)
    height, width = camera.image_size
    mirrored = camera.hflip().project(rays * torch.tensor([-1.0, 1, 1]))[0]
    torch.testing.assert_close(width - 1 - mirrored[:, 0], expected[:, 0], rtol=0, atol=1e-9)
    mirrored = camera.vflip().project(rays * torch.tensor([1, -1.0, 1]))[0]
    torch.testing.assert_close(height - 1 - mirrored[:, 1], expected[:, 1], rtol=0, atol=1e-9)
    small = camera.resize(24, 32)
    warped = ct.Warp(small, ct.Pinhole([30.0, 30, 15.5, 11.5], image_size=(24, 32)).double())
    assert warped(torch.rand(1, 3, 24, 32, dtype=torch.float64)).isfinite().all()
    with pytest.raises(ct.CameraFileError, match=":windshield=6,10"):
        ct.save(camera, tmp_path / "camera.yml", "opencv")


def test_on_its_side():
    camera = ct.KannalaBrandt(np.array([300.0, 310, 320, 240]), image_size=(480, 640))
    camera, rays = (
        camera.behind(ct.Windshield(np.array(HORIZONTAL), np.array(VERTICAL[:3] + VERTICAL[4:6] + [0.0]))),
        fan(40),
    )
    pixels = camera.project(rays)[0].detach()
    turned = camera.rot90().project(torch.stack((rays[:, 1], -rays[:, 0], rays[:, 2]), -1))[0].detach()
    torch.testing.assert_close(turned, torch.stack((pixels[:, 1], 639 - pixels[:, 0]), -1), rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match="quarter turn"):
        one("kannala_brandt").behind(shield()).rot90()
