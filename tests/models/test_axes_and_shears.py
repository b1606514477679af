"""CAHVOR, CAHVORE and NVIDIA's f-theta against their formulas in NumPy, and the numbers that files give."""

import numpy as np
import pytest
import torch
from cameras import fan, one

import camtorch as ct


def cahvor(p, numbers, linearity=None):
    """The formula of mrcal's documentation; with a linearity, that of CAHVORE for e = 0."""
    fx, fy, cx, cy, a, b, r0, r1, r2 = numbers
    o = np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)])
    w = (p @ o)[:, None]
    u = p - w * o
    length = np.linalg.norm(u, axis=-1, keepdims=True)
    if linearity is None:
        chi, forward = np.sqrt((p * p).sum(-1, keepdims=True) / w**2 - 1), w
    else:
        theta = np.arctan2(length, w)
        chi = {1: np.tan, 0: lambda t: t, -1: np.sin}[int(np.sign(linearity))]((linearity or 1) * theta) / (
            linearity or 1
        )
        forward = length / chi
    x = (1 + r0 + r1 * chi**2 + r2 * chi**4) * u + forward * o
    return torch.from_numpy(x[:, :2] / x[:, 2:] * [fx, fy] + [cx, cy])


NUMBERS = [1761.18, 1761.25, 1965.71, 1087.52, 0.02, -0.03, 0.003, 0.04, -0.01]


@pytest.mark.parametrize("linearity", [None, 1.0, 0.34, 1e-9, 0.0, -0.5])
def test_cahvor_and_cahvore(linearity):
    kind = ct.CAHVOR if linearity is None else ct.CAHVORE
    numbers = np.array(NUMBERS + ([] if linearity is None else [linearity]))
    camera, rays = kind(numbers[:4], numbers[4:], image_size=(2200, 4000)), fan(45)
    pixels, valid = camera.project(rays)
    assert valid.all()
    torch.testing.assert_close(pixels.detach(), cahvor(rays.numpy(), NUMBERS, linearity), rtol=0, atol=1e-9)
    back, valid = camera.unproject(pixels)
    assert valid.all()
    torch.testing.assert_close(back.detach(), rays, rtol=0, atol=1e-12)


def test_cahvore_is_once_differentiable_at_linearity_0():
    rays = fan(45)[::31]
    for size in (0.0, 1e-12, 1e-6, 1e-3):
        for sign in (-1, 1):
            k = torch.tensor([*NUMBERS[4:], sign * size], dtype=torch.float64, requires_grad=True)
            camera = ct.CAHVORE(torch.tensor(NUMBERS[:4], dtype=torch.float64), k)
            (by_k,) = torch.autograd.grad(camera.project(rays)[0].sum(), k)
            step = 1e-4
            two = [
                ct.CAHVORE(torch.tensor(NUMBERS[:4]).double(), k.detach() + k.new_tensor([0] * 5 + [s]))
                for s in (step, -step)
            ]
            expected = (two[0].project(rays)[0].sum() - two[1].project(rays)[0].sum()).item() / (2 * step)
            assert by_k[-1].item() == pytest.approx(expected, abs=20.0 if size < step else 2.0)
            assert by_k[-1].abs() < 1e7 * max(size, 1e-12)


@pytest.mark.parametrize("cde", [(1.0000840425491333, -2.8e-5, -7.3e-5), (1.1, -0.1, 0.2), (0.9, 0.0, 0.0)])
def test_f_theta_is_nvidias_formula(cde):
    centre, pixels = np.array([1909.309, 1103.279]), np.array([3139.486, 164.573, -442.129, 259.583, 153.666])
    camera = ct.FTheta.from_polynomial(centre, pixels, linear_cde=cde, image_size=(2168, 3848))
    rays = fan(38)[24:]
    c, d, e = cde
    rho = rays[:, :2].norm(dim=-1, keepdim=True)
    theta = torch.atan2(rho, rays[:, 2:])
    flat = sum(k * theta**i for i, k in enumerate(pixels, 1)) * rays[:, :2] / rho
    expected = flat @ torch.tensor([[c, d], [e, 1]], dtype=torch.float64).T + torch.from_numpy(centre)
    found, valid = camera.project(rays)
    assert valid.all()
    assert isinstance(camera, ct.FThetaSheared) == (d != 0)
    torch.testing.assert_close(found.detach(), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("cde", [(1.0, 0.0, 0.0), (1.1, -0.1, 0.2)])
def test_f_theta_backward_is_nvidias_formula(cde):
    centre, angles = np.array([1904.948, 1090.516]), np.array([5.3809e-4, -1.2021e-9, 4.5657e-12, -5.5811e-16])
    camera = ct.FThetaBackward.from_polynomial(centre, angles, linear_cde=np.array(cde), image_size=(2168, 3848))
    pixels = torch.tensor([[100.0, 200.0], [3000.0, 50.0], [1900.0, 2000.0], [3700.0, 2100.0]], dtype=torch.float64)
    rays, valid = camera.unproject(pixels)
    c, d, e = cde
    flat = np.linalg.solve([[c, d], [e, 1]], (pixels.numpy() - centre).T).T
    radius = np.linalg.norm(flat, axis=-1, keepdims=True)
    theta = sum(k * radius**i for i, k in enumerate(angles, 1))
    assert valid.all()
    expected = torch.from_numpy(np.concatenate((np.sin(theta) * flat / radius, np.cos(theta)), -1))
    torch.testing.assert_close(rays.detach(), expected, rtol=0, atol=1e-12)


def test_a_cahvore_that_is_not_central_is_refused(tmp_path):
    path = tmp_path / "camera.cameramodel"
    ct.save(one("cahvore"), path)
    assert torch.equal(ct.load(path).camera.distortion, one("cahvore").distortion)
    text = path.read_text()
    for old, new, message in (
        ("0.0, 0.0, 0.0,]", "0.0, 0.1, 0.0,]", "e0, e1, e2 = .*do not pass one point"),
        ("=0.34", "=", "no finite number"),
        ("_linearity=0.34", "", "is not known here; known are"),
    ):
        assert old in text
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(ct.CameraFileError, match=message):
            ct.load(path)
