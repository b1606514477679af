"""`ct.losses`: angles between rays, and distances between pixels, of cameras that networks predict."""

import math

import pytest
import torch

import camtorch as ct

SIZE = (48, 64)


def cameras(dtype=torch.float64):
    numbers = [[40.0, 40.0, 31.5, 23.5], [50.0, 51.0, 30.0, 24.0]], [[0.02, -0.01], [0.0, 0.01]]
    predicted = ct.KannalaBrandt(*numbers, image_size=SIZE).to(dtype)
    target = ct.BrownConrady([44.0, 44.0, 32.0, 23.0], [-0.05, 0.01, 0.0, 0.0], image_size=SIZE).to(dtype)
    return predicted, target.requires_grad_(False)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_angles_are_exact_from_the_smallest_to_the_largest(dtype):
    angle = torch.tensor([0.0, 1e-7, 1e-4, 0.5, math.pi / 2, math.pi - 1e-3, math.pi], dtype=torch.float64)
    first = torch.tensor([0.0, 0.0, 1.0], dtype=dtype).expand(len(angle), 3)
    second = torch.stack((angle.sin(), torch.zeros_like(angle), angle.cos()), -1).to(dtype)
    found = ct.losses.angles(first, 3 * second)
    torch.testing.assert_close(found.double(), angle, rtol=1e-6, atol=4 * torch.finfo(dtype).eps)


def test_gradients_of_angles_are_finite_everywhere():
    directions = torch.tensor([[0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, -1.0]], requires_grad=True)
    others = torch.tensor([[0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 1.0]], requires_grad=True)
    ct.losses.angles(directions, others).sum().backward()
    assert bool(torch.isfinite(directions.grad).all())
    near = torch.tensor([[1e-6, 0.0, 1.0]], requires_grad=True)
    ct.losses.angles(near, torch.tensor([[0.0, 0.0, 1.0]])).sum().backward()
    torch.testing.assert_close(near.grad[0, :2], torch.tensor([1.0, 0.0]), rtol=1e-3, atol=1e-3)


def test_rays_are_compared_over_the_image():
    predicted, target = cameras()
    found, valid = ct.losses.rays(predicted, target, samples=(6, 8), reduction="none")
    assert found.shape == valid.shape == (2, 6, 8)
    pixels = 3.5 + 8 * torch.stack(torch.meshgrid(torch.arange(8), torch.arange(6), indexing="xy"), -1).double()
    seen, rays = predicted.unproject(pixels.expand(2, 6, 8, 2))[0], target.unproject(pixels)[0]
    expected = [torch.acos((a * rays).sum(-1).clamp(max=1)) for a in seen]
    torch.testing.assert_close(found, torch.stack(expected), rtol=1e-6, atol=1e-7)
    mean = ct.losses.rays(predicted, target, samples=(6, 8))
    torch.testing.assert_close(mean, found.mean())
    torch.testing.assert_close(ct.losses.rays(target, predicted, samples=(6, 8)), mean)
    whole = ct.losses.rays(predicted, target, samples=SIZE)
    assert abs(mean / whole - 1) < 0.05
    at = ct.losses.rays(predicted, target, pixels=pixels[None].flatten(1, 2), reduction="none")[0]
    torch.testing.assert_close(at, found.flatten(1))


def test_gradients_of_both_losses():
    predicted, target = cameras()

    def losses(intrinsics, distortion):
        camera = ct.KannalaBrandt(intrinsics, distortion, image_size=SIZE)
        return ct.losses.rays(camera, target, samples=3), ct.losses.reprojection(camera, target, samples=3)

    assert torch.autograd.gradcheck(losses, (predicted.intrinsics, predicted.distortion))


def test_weights_and_what_is_not_valid():
    predicted, _ = cameras()
    folded = ct.BrownConrady([30.0, 30.0, 31.5, 23.5], [-0.6, 0.0, 0.0, 0.0], image_size=SIZE).double()
    found, valid = ct.losses.rays(predicted, folded, reduction="none")
    assert 0 < valid.double().mean() < 1
    assert bool((found[~valid] == 0).all())
    torch.testing.assert_close(ct.losses.rays(predicted, folded), found.sum() / valid.sum())
    weights = torch.zeros(2, 16, 16, dtype=torch.float64)
    weights[0, 8, 8] = 5.0
    torch.testing.assert_close(ct.losses.rays(predicted, folded, weights=weights), found[0, 8, 8])
    nothing = ct.losses.rays(predicted, folded, weights=torch.zeros(1))
    nothing.backward()
    assert nothing == 0
    assert bool((predicted.intrinsics.grad == 0).all())


def test_reprojection_is_in_pixels():
    predicted, target = cameras()
    found, valid = ct.losses.reprojection(predicted, target, reduction="none")
    assert bool(valid.all())
    assert found.shape == (2, 16, 16)
    points = torch.rand(2, 20, 3, dtype=torch.float64) + torch.tensor([-0.5, -0.5, 2.0], dtype=torch.float64)
    pixels = target.project(points)[0]
    expected = (predicted.project(points)[0] - pixels).norm(dim=-1)
    torch.testing.assert_close(ct.losses.reprojection(predicted, target, points), expected.mean())
    torch.testing.assert_close(ct.losses.reprojection(predicted, pixels, points), expected.mean())
    pixels[1, 3] = torch.nan
    found, valid = ct.losses.reprojection(predicted, pixels, points, reduction="none")
    assert not valid[1, 3]
    assert valid.sum() == 39
    found.sum().backward()
    assert bool(torch.isfinite(predicted.intrinsics.grad).all())


def test_a_lost_point_costs_the_penalty_without_a_gradient():
    target = ct.BrownConrady([44.0, 44.0, 32.0, 23.0], [0.0] * 4, image_size=SIZE)
    folded = target.replace(distortion=[-1.0, 0.0, 0.0, 0.0])
    pixels = torch.cat((target.pixel_grid(4).flatten(0, 1), torch.tensor([[torch.nan, 0.0], [1.0, 1.0], [2.0, 2.0]])))
    points = torch.cat((target.unproject(pixels[:193])[0], torch.tensor([[0.0] * 3, [torch.nan] * 3]))).detach()
    share = folded.project(points[:192])[1].float().mean()
    assert 0 < share < 1
    loss, mean = (ct.losses.reprojection(folded, pixels, points, penalty=penalty) for penalty in (80, None))
    torch.testing.assert_close(loss, share * mean + 80 * (1 - share))
    torch.testing.assert_close(*(torch.autograd.grad(one, folded.distortion) for one in (loss, share * mean)))


def test_cameras_of_several_models():
    predicted, target = cameras()
    mixed = ct.Mixed([target, ct.Pinhole([40.0, 40.0, 31.5, 23.5], image_size=SIZE).double()])
    found, _ = ct.losses.rays(predicted, mixed, reduction="none")
    torch.testing.assert_close(found[0], ct.losses.rays(predicted, target, reduction="none")[0][0])
    assert ct.losses.rays(mixed, mixed) < 1e-9
