"""How far out lenses are followed: as far as is asked, and no pixel that has a ray lies outside of an outline."""

import math

import pytest
import torch
from cameras import drawn, one, real, slow_unless
from hypothesis import given, settings
from hypothesis import strategies as st

import camtorch as ct
from camtorch.projection import solve
from camtorch.projection.fold import AZIMUTHS, azimuth
from camtorch.projection.ops import domain_of

PLANAR = ("brown_conrady", "fisheye62", "fisheye624", "thin_prism_fisheye", "mei")


def domain(camera):
    k = camera.distortion.detach().reshape(-1, camera.distortion.shape[-1])
    return domain_of(type(camera)._model, k, type(camera).optics)


def rim(camera, phi):
    """The last valid ray on each azimuth, by a lattice and bisection, and others up to there."""

    def rays(theta):
        return torch.stack((theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos() + 0 * phi), -1)

    theta = torch.linspace(1e-3, math.pi - 1e-3, 200, dtype=torch.float64)
    pixels, valid = camera.project(rays(theta[:, None]))
    last = valid.long().cumprod(0).sum(0)
    low, high = theta[(last - 1).clamp(min=0)], theta[last.clamp(max=len(theta) - 1)]
    for _ in range(40):
        middle = (low + high) / 2
        good = camera.project(rays(middle))[1]
        low, high = torch.where(good, middle, low), torch.where(good, high, middle)
    outermost, good = camera.project(rays(low))
    return torch.cat((pixels[valid], outermost[good]))


def assert_encloses(camera, phi):
    lenses = domain(camera)
    if lenses.lens.is_radial or not lenses.lens.stages:
        return
    outline = lenses.azimuths.outline(torch.tensor([0]))
    p, q = ((rim(camera, phi) - camera.intrinsics[2:]) / camera.intrinsics[:2]).unbind(-1)
    assert (torch.hypot(p, q) <= outline.furthest[0, azimuth(p, q)]).all(), camera


@pytest.mark.parametrize("key", slow_unless("fisheye624".__eq__, PLANAR))
def test_no_pixel_that_has_a_ray_lies_outside_of_the_outline(key):
    @settings(max_examples=10)
    @given(st.booleans().flatmap(lambda wild: drawn(key, wild)), st.integers(0, 1000))
    def law(camera, seed):
        phi = torch.rand(300, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 * math.pi
        assert_encloses(camera.requires_grad_(False), phi)

    law()


@pytest.mark.parametrize("key", slow_unless("fisheye624".__eq__, PLANAR))
def test_the_outline_of_real_cameras_is_tight(key):
    for camera in real(key).values():
        camera.requires_grad_(False)
        phi = torch.linspace(0, 2 * math.pi, 1001, dtype=torch.float64)
        assert_encloses(camera, phi)
        outline = domain(camera).azimuths.outline(torch.tensor([0])) if not domain(camera).lens.is_radial else None
        if outline is not None and bool((outline.furthest < 1e3).all()):
            p, q = ((rim(camera, phi) - camera.intrinsics[2:]) / camera.intrinsics[:2]).unbind(-1)
            share = torch.hypot(p, q) / outline.furthest[0, azimuth(p, q)]
            assert share[-900:].median() > 0.97


def test_pixels_without_a_ray_are_not_searched_for(monkeypatch):
    """A mirror's image is a disc: of what lies outside of it only a rim of a hundredth is looked into."""
    camera = one("mei").requires_grad_(False)
    counts = []
    searched = solve._Search.__call__
    monkeypatch.setattr(solve._Search, "__call__", lambda self, u, v: counts.append(len(u)) or searched(self, u, v))
    valid = camera.rays()[1]
    without = int((~valid).sum())
    assert without > 0.1 * valid.numel()
    assert sum(counts) < 0.25 * without


@pytest.mark.parametrize("key", ["fisheye624", "fisheye62", "mei", "brown_conrady"])
def test_only_the_azimuths_that_are_asked_for_are_followed(key):
    camera, count = one(key), 50
    distortion = camera.distortion.detach().repeat(count, 1) * torch.linspace(0.9, 1, count).unsqueeze(-1).double()
    batch = ct.MODELS[key](camera.intrinsics.detach().repeat(count, 1), distortion)
    points = torch.tensor([0.1, -0.2, 1.0]).double().repeat(count, 5, 1)
    points[3, 1] = torch.tensor([3.0, 1.0, 0.1])
    pixels, valid = batch.project(points)
    followed = ~domain(batch).azimuths._lost.isnan()
    assert followed[3].sum() in (0, 2)
    assert followed.sum() == followed[3].sum()
    # and say the same as all of them
    alone = ct.MODELS[key](camera.intrinsics.detach(), distortion[3])
    limits2 = domain(alone).limits2[0]
    (some,) = followed[3].nonzero(as_tuple=True)
    if len(some):
        first = some[0] if int(some[1]) == int(some[0]) + 1 else some[1]
        torch.testing.assert_close(domain(batch).azimuths._limits2[3, first], limits2[first])
    assert len(limits2) == AZIMUTHS
    theirs, their_valid = alone.project(points[3])
    assert torch.equal(valid[3], their_valid)
    torch.testing.assert_close(pixels[3], theirs)
