"""Lenses of lensfun's database: where lensfun itself has their pixels."""

import numpy as np
import pytest
import torch

import camtorch as ct

lensfunpy = pytest.importorskip("lensfunpy")


@pytest.fixture(scope="module")
def nikkor():
    database = lensfunpy.Database()
    (camera, *_) = database.find_cameras("NIKON CORPORATION", "NIKON D3S")
    (lens, *_) = database.find_lenses(camera, "Nikon", "Nikkor 28mm f/2.8D AF")
    return camera, lens


def test_pixels_are_those_of_the_formula(nikkor):
    camera, lens = nikkor
    a, b, c = lens.interpolate_distortion(28.0).terms
    found = ct.lenses.from_lensfun(camera, lens, 28, image_size=(4000, 6000))
    focal = 28 * np.hypot(6000, 4000) / np.hypot(36, 24)
    plane = np.random.default_rng(0).uniform(-0.45, 0.45, (100, 2))
    r = np.hypot(*plane.T) * focal / 2000
    expected = (2999.5, 1999.5) + plane * focal * (a * r**3 + b * r**2 + c * r + 1 - a - b - c)[:, None]
    pixels, valid = found.project(torch.tensor(np.c_[plane, np.ones(100)]))
    assert valid.all()
    assert np.abs(pixels.numpy() - expected).max() < 2e-3  # a spline: odd powers have no second derivative on the axis
    assert found.unproject(torch.tensor([[0.0, 0.0], [5999.0, 3999.0]], dtype=torch.float64))[1].all()
    assert not found.intrinsics.requires_grad
    assert found.convert("brown_conrady", count=8).max_error < 0.3


def test_pixels_are_those_of_lensfun(nikkor):
    camera, lens = nikkor
    found = ct.lenses.from_lensfun(camera, lens, 28, image_size=(400, 600))
    modifier = lensfunpy.Modifier(lens, camera.crop_factor, 600, 400)
    modifier.initialize(28.0, 8.0, scale=1.0, flags=lensfunpy.ModifyFlags.DISTORTION)
    expected = modifier.apply_geometry_distortion()[::40, ::40].astype(float)
    focal = 28 * np.hypot(600, 400) / np.hypot(36, 24)
    u, v = np.meshgrid(np.arange(0, 600, 40) - 299.5, np.arange(0, 400, 40) - 199.5)
    rays = np.stack([u / focal, v / focal, np.ones_like(u)], -1)
    pixels, valid = found.project(torch.tensor(rays))
    # lensfun computes with reciprocals of half a float's digits, and with the sides less one
    assert np.abs(pixels.numpy() - expected)[valid.numpy()].max() < 0.12
    assert valid.float().mean() > 0.9


def test_types_and_models_that_are_not_known(nikkor):
    camera, lens = nikkor
    with pytest.raises(ValueError, match=r"focal_length be > 0; got \(400, 600\), 0"):
        ct.lenses.from_lensfun(camera, lens, 0, image_size=(400, 600))
    panoramas = [one for one in lensfunpy.Database().lenses if one.type.name == "PANORAMIC"]
    with pytest.raises(ValueError, match=r"lens must have distortion and angles in lensfun; got .*panoramic"):
        ct.lenses.from_lensfun(camera, panoramas[0], panoramas[0].min_focal, image_size=(400, 600))
