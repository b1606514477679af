"""What models are of each other, the constructors of some, and coefficients for which a formula does not exist."""

import math

import numpy as np
import pytest
import torch
from cameras import KEYS, RANGES, fan, one, pixel_lattice, spread

import camtorch as ct
from camtorch.cameras.numbers import check_fast, checked_numbers

INTRINSICS = torch.tensor([310.0, 315.0, 318.5, 242.25], dtype=torch.float64)


def camera(model, *coefficients, scale=1.0):
    intrinsics = INTRINSICS * torch.tensor([scale, scale, 1, 1])
    return model(intrinsics, *([torch.tensor(coefficients, dtype=torch.float64)] if coefficients else []))


def test_latlon_is_a_file_of_mrcal(tmp_path):
    path = tmp_path / "panorama.cameramodel"
    ct.save(ct.LatLon(INTRINSICS, image_size=(480, 640)), path)
    assert "LENSMODEL_LATLON" in path.read_text()
    assert type(ct.load(path).camera) is ct.LatLon


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (camera(ct.UCM, 0.6), camera(ct.EUCM, 0.6, 1.0)),
        (camera(ct.UCM, 0.6), camera(ct.DoubleSphere, 0.0, 0.6)),
        (camera(ct.UCM, 0.6), camera(ct.Mei, 1.5, 0.0, 0.0, 0.0, 0.0, scale=2.5)),
        (camera(ct.DoubleSphere, 1.5, 0.0), camera(ct.Mei, 1.5, 0.0, 0.0, 0.0, 0.0)),
        (camera(ct.Mei, 0.0, -0.1, 0.02, 1e-3, 2e-3), camera(ct.BrownConrady, -0.1, 0.02, 1e-3, 2e-3)),
        (camera(ct.UCM, 0.5), camera(ct.Stereographic, 0.0)),
        (camera(ct.UCM, 1.0), camera(ct.OrthographicFisheye, 0.0)),
        (camera(ct.UCM, 0.0), camera(ct.Pinhole)),
        (camera(ct.FOV, 0.0), camera(ct.Pinhole)),
        (camera(ct.EUCM), camera(ct.Pinhole)),
        (camera(ct.Division, 0.0), camera(ct.Pinhole)),
        (camera(ct.Division, -0.25), camera(ct.Stereographic, 0.0)),
        (camera(ct.FTheta, 0.0, 0.02, 0.0, -0.003), camera(ct.KannalaBrandt, 0.02, -0.003)),
        (camera(ct.FThetaBackward, 0.0, 0.0), camera(ct.KannalaBrandt, 0.0)),
        (camera(ct.OCamCalib, 0.0, 0.0, 0.0, -0.2, 0.0, 0.01), camera(ct.Division, -0.2, 0.01)),
        (camera(ct.FTheta, 0.1, 0.02, -0.003), camera(ct.WoodScape, 0.1, 0.02, -0.003)),
        (camera(ct.ThinPrismFisheye, 0.02, 0.01, 0, 0, 0, 0, 0, 0), camera(ct.KannalaBrandt, 0.02, 0.01)),
    ],
    ids=lambda c: type(c).__name__,
)
def test_the_same_camera(first, second):
    rays = fan(170)
    (pixels, valid), (others, other_valid) = (c.project(rays) for c in (first, second))
    assert torch.equal(valid, other_valid)
    assert valid.sum() > 100
    torch.testing.assert_close(pixels, others, rtol=1e-11, atol=1e-10)
    pixels = pixels[valid & (pixels.norm(dim=-1) < 3000)].detach()
    (rays, valid), (others, other_valid) = (c.unproject(pixels) for c in (first, second))
    assert torch.equal(valid, other_valid)
    torch.testing.assert_close(rays, others, rtol=0, atol=1e-12)


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
    assert isinstance(camera, ct.models.FThetaSheared) == (d != 0)
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


def test_the_inverse_of_an_angle_is_valid_before_it_turns_back():
    """Theta = r (1 - 0.1 r^2) ascends up to r^2 = 1 / 0.3, where it is 2 r / 3."""
    made = camera(ct.FThetaBackward, 0.0, -0.1)
    end = (1 / 0.3) ** 0.5
    r = torch.tensor([end - 1e-6, end + 1e-6], dtype=torch.float64)
    assert made.unproject(INTRINSICS[2:] + INTRINSICS[:1] * torch.stack((r, 0 * r), -1))[1].tolist() == [True, False]
    theta = torch.tensor([2 / 3 * end - 1e-12, 2 / 3 * end + 1e-12], dtype=torch.float64)
    pixels, valid = made.project(torch.stack((theta.sin(), 0 * theta, theta.cos()), -1))
    assert valid.tolist() == [True, False]
    assert pixels[0, 0].item() == pytest.approx((INTRINSICS[2] + INTRINSICS[0] * end).item(), abs=1e-2)


def test_woodscape_from_its_numbers():
    k = [339.749, -31.988, 48.275, -7.201]
    made = ct.WoodScape.from_woodscape(torch.tensor(k).double(), (3.942, -3.093), image_size=(966, 1280))
    published = one("woodscape")
    torch.testing.assert_close(made.intrinsics, published.intrinsics)
    torch.testing.assert_close(made.distortion, published.distortion)


BREAKS = [(ct.EUCM, (0.5, 0.0)), (ct.DoubleSphere, (-1.0, 0.5)), (ct.Mei, (-1.5, *[0.0] * 4)), (ct.FOV, (math.pi,))]


@pytest.mark.filterwarnings("ignore:.*became unusable")
@pytest.mark.parametrize(("model", "coefficients"), BREAKS)
def test_coefficients_without_a_formula(model, coefficients):
    """Refused at the door; where learning ended there, all is invalid, and finite."""
    with pytest.raises(ValueError, match=f"must have {model.defined_text}; got"):
        camera(model, *coefficients)
    learnt = model(INTRINSICS)
    with torch.no_grad():
        learnt.distortion.copy_(torch.tensor(coefficients))
    for method, values in (("project", fan(60)), ("unproject", pixel_lattice(spread("pinhole")))):
        result, valid = getattr(learnt, method)(values)
        assert not valid.any()
        gradients = torch.autograd.grad(result.sum(), list(learnt.parameters()))
        assert all((g == 0).all() for g in gradients)


@pytest.mark.parametrize(("xi", "alpha"), [(1.0, 0.5), (1.01, 0.6), (1.1, 0.55), (1.5, 0.5), (0.999, 0.6), (2.0, 0.6)])
def test_a_double_sphere_from_outside_of_the_sphere(xi, alpha):
    """Far out the line of a pixel meets the sphere only behind the shifted centre."""
    made = camera(ct.DoubleSphere, xi, alpha)
    steps = torch.linspace(-5000, 5000, 501, dtype=torch.float64)
    pixels = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1)
    rays, valid = made.unproject(pixels)
    again, reachable = made.project(rays)
    assert reachable[valid].all()
    assert 100 < valid.sum() < valid.numel()
    torch.testing.assert_close(again[valid], pixels[valid], rtol=0, atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_powers_that_overflow_are_not_valid(dtype):
    for made in (
        ct.Stereographic(INTRINSICS.to(dtype), torch.full((20,), 0.01, dtype=dtype)),
        ct.KannalaBrandt(INTRINSICS.to(dtype), torch.full((40,), 0.01, dtype=dtype)),
        ct.FTheta(INTRINSICS.to(dtype), torch.full((100,), 0.01, dtype=dtype)),
    ):
        theta = math.pi - torch.logspace(-9, 0, 200, dtype=torch.float64)
        points = torch.stack((theta.sin(), 0 * theta, theta.cos()), -1).to(dtype).requires_grad_()
        pixels, _ = made.project(points)
        assert pixels.isfinite().all()
        gradients = torch.autograd.grad(pixels.sum(), (points, *made.parameters()))
        assert all(g.isfinite().all() for g in gradients), type(made)


def test_the_angles_of_a_table_do_not_learn():
    made = spread("tabulated")
    made.project(fan(60))[0].sum().backward()
    angles, radii = made.distortion.grad.chunk(2)
    assert not angles.any()
    assert radii.all()


@pytest.mark.parametrize("key", KEYS)
def test_the_laws_have_numbers_to_try_a_model_on(key):
    if one(key).distortion_names:
        assert key in RANGES, "tests/cameras.py says in RANGES how far its coefficients go"


@pytest.mark.parametrize("batch", [(), (1,), (8,)])
def test_numbers_that_are_right_at_a_glance_are_those_that_are_checked(batch):
    numbers, k = torch.tensor([200.0, 210, 60, 50]).expand(*batch, 4), torch.zeros(*batch, 5)
    given = ct.BrownConrady, numbers, k, (100, 120)
    fast, slow = check_fast(*given), checked_numbers(*given)
    assert fast is not None
    assert all(map(torch.equal, fast[:2], slow[:2]))
    assert fast[2:] == slow[2:]
    wrong = numbers.clone()
    wrong.view(-1, 4)[-1, 0] = -1
    assert check_fast(ct.BrownConrady, wrong, k, (100, 120)) is None
    with torch.no_grad():  # a batch that a network may have predicted is not checked
        assert (check_fast(ct.BrownConrady, numbers, k, (100, 120)) is None) == bool(batch)
