"""Laws of Warp's options: filling, shrinking without false patterns, and maps within a tolerance."""

import math

import pytest
import torch
from cameras import pinhole, turn

import camtorch as ct

SIZE = (120, 160)


def zone_plate(side=512):
    """(1, 1, side, side): rings whose frequency grows evenly, to that of the pixels at the middle of the edges."""
    at = torch.arange(side, dtype=torch.float64) - (side - 1) / 2
    return (0.5 + 0.5 * torch.cos(math.pi * (at[:, None] ** 2 + at**2) / side)).float()[None, None]


def alias_energy(image, shrunk_by):
    """The energy of what differs from grey where the rings are too fine for the small image."""
    side = image.shape[-1]
    at = (torch.arange(side, dtype=torch.float64) - (side - 1) / 2) / (side / 2)  # 1: the frequency of the large pixels
    radius = (at[:, None] ** 2 + at**2).sqrt()
    too_fine = (radius > 1.3 / shrunk_by) & (radius < 1)
    return (image[0, 0][too_fine] - 0.5).square().mean()


@pytest.mark.parametrize(("factor", "mode"), [(2, "bilinear"), (4, "bicubic"), (5.5, "bilinear")])
def test_a_shrunk_zone_plate_shows_no_false_rings(factor, mode):
    plate = zone_plate()
    camera = pinhole((512, 512), 500.0)
    small = camera.resize(round(512 / factor), round(512 / factor))
    plain, smooth = (ct.Warp(camera, small, mode=mode, antialias=on)(plate) for on in (False, True))
    assert alias_energy(smooth, factor) < 0.05 * alias_energy(plain, factor)
    # and the rings that fit stay: half of them lose less than half of their contrast
    side = small.image_size[0]
    at = (torch.arange(side, dtype=torch.float64) - (side - 1) / 2) / (side / 2)
    coarse = (at[:, None] ** 2 + at**2).sqrt() < 0.4 / factor
    assert smooth[0, 0][coarse].std() > 0.5 * plain[0, 0][coarse].std()


def test_antialias_follows_the_local_scale():
    """Where nothing shrinks, nothing is smoothed; masks and single colours stay."""
    camera = pinhole(SIZE, 140.0)
    target = ct.KannalaBrandt([150.0, 150, 79.5, 59.5], [-0.25, 0.0, 0.0, 0.0], image_size=SIZE).requires_grad_(False)
    plain, smooth = (ct.Warp(camera, target, antialias=on) for on in (False, True))
    noise = torch.rand(1, 2, *SIZE)
    scale = smooth.by_pixel().scale
    seen = smooth.valid_mask().expand(-1, 2, -1, -1)
    grows = (scale <= 1).unsqueeze(1) & seen
    shrinks = (scale > 1.3).unsqueeze(1) & seen
    assert grows.any()
    assert shrinks.any()
    # but for the rim, where coverage is taken apart; two ways to positions of up to 160 pixels in float32
    torch.testing.assert_close(plain(noise)[grows], smooth(noise)[grows], atol=2e-5, rtol=0)
    assert smooth(noise)[shrinks].var() < 0.9 * plain(noise)[shrinks].var()
    labels = (noise * 9).long()
    assert torch.equal(plain(labels, mode="nearest"), smooth(labels, mode="nearest"))
    ones = torch.ones(1, 1, *SIZE, dtype=torch.uint8) * 200
    inner = torch.nn.functional.max_pool2d((~smooth.valid_mask()).float(), 9, 1, 4) == 0
    assert (smooth(ones)[inner] == 200).all()


@pytest.mark.parametrize("mode", ["bilinear", "nearest", "bicubic"])
def test_fill_takes_the_place_of_black(mode):
    camera, rotation = pinhole(SIZE, 140.0), turn(25, 10, 30)
    image = torch.rand(1, 3, *SIZE)
    black, filled = (ct.Warp(camera, camera, rotation, mode=mode, fill=fill) for fill in (0.0, (0.2, 0.4, 0.6)))
    value = torch.tensor([0.2, 0.4, 0.6])[:, None, None]
    # filling is warping what differs from the value
    torch.testing.assert_close(filled(image), black(image - value) + value, atol=1e-5, rtol=0)
    whole = ct.Warp(camera, camera, rotation, mode=mode, fill=128)(torch.full((1, 1, *SIZE), 128, dtype=torch.uint8))
    assert (whole == 128).all()
    assert torch.equal(black(image, fill=0.5), ct.Warp(camera, camera, rotation, mode=mode, fill=0.5)(image))


def test_pixels_without_a_ray_take_the_fill_in_every_padding_mode():
    behind = ct.KannalaBrandt([40.0, 40, 79.5, 59.5], image_size=SIZE).requires_grad_(False)
    for padding_mode in ("zeros", "border", "reflection"):
        options = {"padding_mode": padding_mode, "fill": 7.0}
        warp = ct.Warp(pinhole(SIZE, 140.0), behind, turn(60, 0, 0), **options)
        without = ~warp.by_pixel().mapped[0]
        assert without.any()
        for tolerance in (0.001, 0.0):  # from a lattice, and from positions of all pixels
            made = warp if tolerance else ct.Warp(warp.source, warp.target, warp.rotation, tolerance=0.0, **options)
            assert (made(torch.rand(1, 1, *SIZE))[0, 0][without] == 7).all()


@pytest.mark.parametrize("small", [False, True])
def test_a_lattice_is_used_and_small_images_do_without(small):
    cameras = [pinhole(SIZE, focal, torch.float64) for focal in (140.0, 120.0)]
    cameras = [camera.resize(16, 20) for camera in cameras] if small else cameras
    rotation = turn(10, 5, 20, dtype=torch.float64)
    exact, close = (ct.Warp(*cameras, rotation, tolerance=t).grid() for t in (0.0, 0.1))
    assert torch.equal(exact, close) == small


def test_a_lattice_does_not_mind_how_torch_multiplies_matrices():
    camera, target = pinhole(SIZE, 140.0), pinhole(SIZE, 120.0)
    plain = ct.Warp(camera, target, turn(10, 5, 20), tolerance=0.01).grid()
    before = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision("medium")
        with torch.autocast("cpu", dtype=torch.bfloat16):
            coarse = ct.Warp(camera, target, turn(10, 5, 20), tolerance=0.01).grid()
    finally:
        torch.set_float32_matmul_precision(before)
    torch.testing.assert_close(coarse, plain, atol=1e-6, rtol=0)


def test_options_reach_the_inverse_and_dewarp():
    options = {"mode": "bicubic", "padding_mode": "border", "fill": (0.5,), "antialias": True, "tolerance": 0.01}
    warp = ct.Dewarp(pinhole(SIZE, 140.0), **options)
    assert warp.options == options == warp.inverse().options


@pytest.mark.parametrize(("padding", "errors"), [("border", (2e-4, 1e-3, 1e-3)), ("reflection", (2e-4, 0.04, 0.2))])
def test_far_outside_positions_are_as_exact_as_the_limits_say(padding, errors):
    """On the image, and up to 3,000 and 10,000 pixels outside; compiled and recorded."""
    images = torch.rand(1, 3, 240, 320, generator=torch.Generator().manual_seed(0))
    middle = [159.5, 119.5]
    pinhole = ct.Pinhole([200.0, 200.0, *middle], image_size=(240, 320))
    fisheye = ct.KannalaBrandt([100.0, 100.0, *middle], [0.02, -0.01, 3e-3, -1e-3], image_size=(240, 320))

    def warped(images, dtype, learns=False):
        cameras = (camera.clone().to(dtype).requires_grad_(learns) for camera in (pinhole, fisheye))
        return ct.Warp(*cameras, padding_mode=padding, tolerance=0.0)(images).detach().double()

    grid = ct.Warp(pinhole.clone().double(), fisheye.clone().double()).grid().detach().reshape(240, 320, 2)
    outside = ((grid.abs() - 1) * torch.tensor([160.0, 120.0])).amax(-1).expand(1, 3, -1, -1)
    exact = warped(images.double(), torch.float64)
    for learns in (False, True):
        away = (warped(images, torch.float32, learns) - exact).abs()
        for distance, error in zip((0, 3000, 10_000), errors, strict=True):
            assert away[outside < distance].max() < error
    assert (warped(images, torch.float64) - warped(images, torch.float64, True)).abs().max() < 2e-5
