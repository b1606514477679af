"""NVIDIA's f-theta against its formulas in NumPy."""

import numpy as np
import pytest
import torch
from cameras import fan

import camtorch as ct


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
