"""Laws of positions from a lattice: they keep their tolerance, and lose no pixel."""

import json
from pathlib import Path

import pytest
import torch
from cameras import each_kind, make, real, turn

import camtorch as ct

TOLERANCES = (0.1, 0.01)


def check(source, target, rotation):
    """Positions on the image, or of which one is, differ by no more than the tolerance; mapped are the same."""
    exact = ct.Warp(source, target, rotation).by_pixel()
    half = torch.tensor(source.image_size[::-1]) / 2
    for tolerance in TOLERANCES:
        close = ct.Warp(source, target, rotation, tolerance=tolerance).by_pixel()
        assert torch.equal(exact.mapped, close.mapped)
        on_image = (exact.grid.abs() <= 1).all(-1) | (close.grid.abs() <= 1).all(-1)
        error = ((exact.grid - close.grid) * half).norm(dim=-1)[exact.mapped & on_image]
        assert error.numel() == 0 or error.max() <= tolerance


def check_padded(source, target, rotation, padding):
    """An image of its own positions, shown beyond its rim too, shows them within the tolerance."""
    height, width = source.image_size
    v, u = torch.meshgrid(*(torch.arange(side, dtype=torch.float32) for side in (height, width)), indexing="ij")
    image = torch.stack((u, v))[None]
    exact = ct.Warp(source, target, rotation, padding_mode=padding, tolerance=0.0)(image)
    # a corner of a reflection is not where a float32 says, and far out the less so
    rounding = 1e-3 if padding == "border" else 2e-2
    for tolerance in (10.0, 0.1, 0.01):
        close = ct.Warp(source, target, rotation, padding_mode=padding, tolerance=tolerance)
        called = ct.Warp(source, target, rotation, tolerance=tolerance)
        called(image)
        for shown in (close(image), called(image, padding_mode=padding), called.pin()(image, padding_mode=padding)):
            assert (shown - exact).norm(dim=1).max() <= tolerance + rounding


@pytest.mark.parametrize(("key", "padding"), [("division", "border"), ("brown_conrady", "reflection")])
def test_tolerances_hold_beyond_the_rim(key, padding):
    camera = next(iter(real(key).values())).float().requires_grad_(False).resize(240, 320)
    wide = ct.KannalaBrandt(torch.tensor([50.0, 50.0, 159.5, 119.5]), torch.zeros(4), image_size=(240, 320))
    rotation = turn(20.0, -10.0, 30.0)
    check_padded(camera, wide.requires_grad_(False), rotation, padding)
    check_padded(camera, wide, None, padding)


@each_kind
def test_real_lenses_keep_their_tolerance(key):
    camera = next(iter(real(key).values())).float().requires_grad_(False).resize(240, 320)
    rotation = turn(20.0, -10.0, 30.0)
    check(camera, ct.Dewarp(camera).target, None)
    check(camera, camera, rotation)
    check(ct.Dewarp(camera).target, camera, rotation)


# Pairs of cameras that were drawn, and found to be hard; in float64 where, near a fold, rounding would cost something
HARD = json.loads((Path(__file__).parents[1] / "golden" / "warps" / "hard.json").read_text())


@pytest.mark.parametrize("what", HARD)
def test_hard_warps_keep_their_tolerance(what):
    case, dtype = HARD[what], getattr(torch, HARD[what]["dtype"])
    source, target = (
        make(of["model"], *(torch.tensor(of[name], dtype=dtype) for name in ("intrinsics", "distortion")),
             image_size=of["image_size"]).requires_grad_(False)
        for of in (case["source"], case["target"])
    )  # fmt: skip
    check(source, target, None if case["rotation"] is None else torch.tensor(case["rotation"], dtype=dtype))


def test_points_of_a_pinned_warp_are_those_of_its_cameras_and_learn_with_them():
    source = ct.KannalaBrandt.from_fov(150, image_size=(256, 320))
    target = ct.Pinhole.from_fov(80, image_size=(200, 240))
    fresh, pinned = (ct.Warp(source, target) for _ in range(2))
    pixels = torch.rand(50, 2) * torch.tensor([320.0, 256.0])
    with torch.no_grad():
        results = fresh.transform_points(pixels), pinned.pin().transform_points(pixels)
    assert all(map(torch.equal, *results))
    moved, valid = pinned.transform_points(pixels)
    moved[valid].sum().backward()
    assert source.intrinsics.grad.abs().sum() > 0
