"""Cells that cubics miss: most are smooth enough for six nodes along each axis, and few are left to the cameras."""

import pytest
import torch
from cameras import FEW_REAL, real

import camtorch as ct
from camtorch.augment import RandomCamera
from camtorch.warp import grid

TOLERANCE = 0.001


def drawn(source, like, seed, count=4):
    """Warps of a batch, to lenses that are turned and zoomed far."""
    change = RandomCamera(like, yaw=30, pitch=30, roll=40, zoom=(0.5, 2), distortion=0.1, min_filled=0)
    draw = change.draw(count, torch.Generator().manual_seed(seed))
    return change.change(source.float().requires_grad_(False).resize(240, 320), draw).parts[0].warp


def positions(warp, tolerance):
    rows = range(warp.target.image_size[0])
    lattice = grid.on_lattice(warp.source, warp.target, warp.rotation, tolerance, rows, "zeros")
    exact, mapped = grid.tabulate(warp.source, warp.target, warp.rotation)
    return lattice, exact, mapped


@pytest.mark.parametrize(("key", "name"), FEW_REAL)
@pytest.mark.parametrize("like", ["dms130", "aria"])
def test_they_keep_the_tolerance(key, name, like):
    warp = drawn(real(key)[name], like, 1)
    lattice, exact, mapped = positions(warp, TOLERANCE)
    if lattice is None:  # mostly the cameras' own
        return
    close = lattice.pixels
    assert torch.equal(close.mapped, mapped)
    half = torch.tensor(warp.source.image_size[::-1]) / 2
    on_image = mapped & (exact.abs() <= 1).all(-1)
    error = ((close.grid - exact) * half).norm(dim=-1)[on_image]
    # and what float32 leaves of positions itself
    assert error.numel() == 0 or float(error.max()) <= TOLERANCE + 1e-6 * max(warp.source.image_size)


@pytest.mark.parametrize(("like", "most"), [("dms130", 0.12), ("aria", 0.28)])
def test_few_pixels_are_the_cameras_own(like, most, monkeypatch):
    """From a pinhole camera, of which a wide lens sees the rim: a third of the cells is too curved for cubics."""
    asked, exact = [], grid._positions

    def counted(source, target, rotation, pixels):
        asked.append(pixels[..., 0].numel() * (len(target.intrinsics) if pixels.ndim == 3 else 1))
        return exact(source, target, rotation, pixels)

    monkeypatch.setattr(grid, "_positions", counted)
    source = ct.Pinhole([280.0, 280.0, 319.5, 239.5], image_size=(480, 640)).requires_grad_(False)
    change = RandomCamera(like, yaw=10, pitch=10, roll=10, min_filled=0)
    warp = change.change(source, change.draw(8, torch.Generator().manual_seed(3))).parts[0].warp
    lattice = grid.on_lattice(warp.source, warp.target, warp.rotation, TOLERANCE, range(480), "zeros")
    assert lattice is not None
    assert sum(asked[1:]) < most * 8 * 480 * 640
