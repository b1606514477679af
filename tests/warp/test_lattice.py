"""Laws of positions from a lattice: they keep their tolerance, and lose no pixel."""

import json
from pathlib import Path

import pytest
import torch
from cameras import RARE_ARE_SLOW, each_kind, make, real, turn

import camtorch as ct
from camtorch.native import sampler
from camtorch.native.library import native_available
from camtorch.warp import cells, grid

TOLERANCES = (0.1, 0.01)


@pytest.fixture(params=["compiled", "torch"])
def way(request, monkeypatch):
    """The lattice as compiled code lays it, and as torch does where there is none."""
    if request.param == "compiled" and not native_available():
        pytest.skip("there is no compiled library")
    if request.param == "torch":
        monkeypatch.setattr(grid, "native_available", lambda: False)
        monkeypatch.setattr(grid, "_native", lambda *_: None)


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
@pytest.mark.usefixtures("way")
def test_tolerances_hold_beyond_the_rim(key, padding):
    camera = next(iter(real(key).values())).float().requires_grad_(False).resize(240, 320)
    wide = ct.KannalaBrandt(torch.tensor([50.0, 50.0, 159.5, 119.5]), torch.zeros(4), image_size=(240, 320))
    rotation = turn(20.0, -10.0, 30.0)
    check_padded(camera, wide.requires_grad_(False), rotation, padding)
    check_padded(camera, wide, None, padding)


@pytest.mark.skipif(not native_available(), reason="there is no compiled library")
@pytest.mark.parametrize("key", RARE_ARE_SLOW)
def test_torch_doubts_the_cells_that_compiled_code_doubts(key, monkeypatch):
    """Cell by cell, and so the positions: of cells that are settled, of limits, of the rim, of far outside."""
    camera = next(iter(real(key).values())).float().requires_grad_(False).resize(240, 317)
    target, rotation = ct.Dewarp(camera).target, turn(20.0, -10.0, 30.0)
    compared = []

    def both(*given):
        found = cells.classify(*given)
        assert torch.equal(found, sampler.classify(*given))
        compared.append(found)
        return found

    for pair in ((camera, target), (target, camera), (camera, camera)):
        for padding, tolerance in (("zeros", 1e-3), ("border", 1e-3), ("reflection", 0.1)):
            given = *pair, rotation, tolerance, range(240), padding
            compiled = grid.on_lattice(*given)
            with monkeypatch.context() as patch:
                patch.setattr(grid, "native_available", lambda: False)
                patch.setattr(grid, "_native", lambda *_: None)
                patch.setattr(grid, "classify", both)
                laid = grid.on_lattice(*given)
            if compiled is not None and laid is not None:
                assert torch.equal(compiled.pixels.mapped, laid.pixels.mapped)
    assert len(compared) == 9


@each_kind
@pytest.mark.usefixtures("way")
def test_real_lenses_keep_their_tolerance(key):
    camera = next(iter(real(key).values())).float().requires_grad_(False).resize(240, 320)
    rotation = turn(20.0, -10.0, 30.0)
    check(camera, ct.Dewarp(camera).target, None)
    check(camera, camera, rotation)
    check(ct.Dewarp(camera).target, camera, rotation)


# Pairs of cameras that were drawn, and found to be hard; in float64 where, near a fold, rounding would cost something
HARD = json.loads((Path(__file__).parents[1] / "golden" / "warps" / "hard.json").read_text())


@pytest.mark.parametrize("what", HARD)
@pytest.mark.usefixtures("way")
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
