"""Laws of positions from a lattice: they keep their tolerance, and lose no pixel."""

import copy
import itertools
import json
import math
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from cameras import RARE_ARE_SLOW, each_kind, make, needs_library, one, real, turn

import camtorch as ct
from camtorch.native import sampler
from camtorch.native.library import native_available
from camtorch.native.structs import CELL_CUBIC, CELL_EMPTY, CELL_QUINTIC
from camtorch.warp import cells, grid
from camtorch.warp.camera_pair import CameraPair
from camtorch.warp.lattice import Lattice

TOLERANCES = (0.1, 0.01)


@pytest.fixture(params=["compiled", "torch"])
def way(request, monkeypatch):
    """The lattice as native code lays it, and as torch does where there is none."""
    if request.param == "compiled" and not native_available():
        pytest.skip("there is no compiled library")
    if request.param == "torch":
        monkeypatch.setattr(cells, "native_available", lambda: False)
        monkeypatch.setattr(CameraPair, "native_positions", lambda _: None)


def check(source, target, rotation):
    """Positions on the image, or of which one is, differ by no more than the tolerance; mapped are the same."""
    exact = ct.Warp(source, target, rotation).by_pixel()
    half = torch.tensor(source.image_size[::-1]) / 2
    learning = source.clone().requires_grad_()
    alone = ct.Warp(learning, target, rotation, tolerance=0).by_pixel()
    for tolerance, given in itertools.product(TOLERANCES, (source, learning)):
        close = ct.Warp(given, target, rotation, tolerance=tolerance).by_pixel()
        assert close.grid.requires_grad == (given is learning)
        assert torch.equal((alone if given is learning else exact).mapped, close.mapped)
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


@needs_library
@pytest.mark.parametrize("key", RARE_ARE_SLOW)
def test_torch_doubts_the_cells_that_compiled_code_doubts(key, monkeypatch):
    """Cell by cell, and so the positions: of cells that are settled, of limits, of the rim, of far outside."""
    camera = next(iter(real(key).values())).float().requires_grad_(False).resize(240, 317)
    target, rotation = ct.Dewarp(camera).target, turn(20.0, -10.0, 30.0)
    compared = []

    by_torch = cells.classify

    def both(*given):
        found = by_torch(*given)
        assert torch.equal(found, sampler.classify(*given))
        compared.append(found)
        return found

    for pair in ((camera, target), (target, camera), (camera, camera)):
        for padding, tolerance in (("zeros", 1e-3), ("border", 1e-3), ("reflection", 0.1)):
            given = CameraPair(*pair, rotation), range(240), tolerance, padding
            compiled = grid.on_lattice(*given)
            with monkeypatch.context() as patch:
                patch.setattr(cells, "native_available", lambda: False)
                patch.setattr(CameraPair, "native_positions", lambda _: None)
                patch.setattr(cells, "classify", both)
                patch.setattr(cells, "are_smooth", lambda *_: False)
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


def check_numbers(camera, source, target, rotation=None):
    """Those of the camera's numbers, by noise in every pixel, are those of exact positions."""
    found, noise = [], torch.randn(1, *target.image_size, 2, generator=torch.Generator().manual_seed(0))
    for tolerance in (0.0, None):
        where = ct.Warp(source, target, rotation, tolerance=tolerance).by_pixel()
        shown = where.mapped & (where.grid.detach().abs() <= 1).all(-1)
        learning = [t for t in camera.tensors if t.requires_grad]
        found.append(torch.autograd.grad((where.grid * noise)[shown].sum(), learning))
    for exact, close in zip(*found, strict=True):
        assert (exact - close).norm() <= 3e-3 * exact.norm()  # polynomials in the angle have a kink on the axis


def check_both_ways(camera):
    camera = camera.float().resize(120, 160).requires_grad_()
    other = ct.Pinhole(torch.tensor([70.0, 72.0, 80.3, 59.1]), image_size=(120, 160)).requires_grad_(False)
    check_numbers(camera, camera, other)
    check_numbers(camera, other, camera)


@pytest.mark.parametrize("key", RARE_ARE_SLOW)
@pytest.mark.usefixtures("way")
def test_gradients_are_those_of_exact_positions(key):
    check_both_ways(one(key))


@pytest.mark.usefixtures("way")
def test_gradients_of_pieces_narrower_than_cells_are_exact():
    """A piece bends what it shapes also where all of them together are smooth."""
    angles = torch.linspace(0.0, 1.3, 65)[1:]
    numbers, size = torch.tensor([280.0, 288.0, 320.3, 239.1]), (480, 640)
    table = ct.Tabulated(numbers, torch.cat((angles, angles)), image_size=size)
    surface = ct.Splined.with_grid(columns=30, rows=20, fov_x=100)(numbers, image_size=size)
    pinhole = ct.Pinhole(numbers, image_size=size).requires_grad_(False)
    for camera in (table, surface, ct.Mixed([table, surface])):
        check_numbers(learning := camera.resize(*size).requires_grad_(), learning, pinhole)


@pytest.mark.usefixtures("way")
def test_gradients_of_a_whole_turn_are_exact_where_it_begins_again():
    """Positions go on there, derivatives by the focal length do not."""
    focal = 256 / math.tau
    camera = ct.Cylindrical(torch.tensor([focal, focal, 127.5, 63.5]), image_size=(128, 256))
    check_numbers(camera, copy.deepcopy(camera).requires_grad_(False), camera, turn(12.0, -7.0, 20.0))


@pytest.mark.parametrize("learns", [True, False])
@pytest.mark.usefixtures("way")
def test_no_cameras_make_no_images(learns):
    none = ct.Pinhole(torch.zeros(0, 4), image_size=(80, 96)).requires_grad_(learns)
    target = ct.Pinhole(torch.tensor([85.0, 86.0, 60.0, 50.0]), image_size=(96, 112)).requires_grad_(False)
    assert ct.Warp(none, target)(torch.zeros(0, 3, 80, 96)).shape == (0, 3, 96, 112)


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


def learned(source, target, rotation, dtype, tolerance=None):
    """The gradients of a smooth image's warp to the image, the cameras and the rotation."""
    source, target = (camera.clone().to(dtype).requires_grad_() for camera in (source, target))
    rotation = None if rotation is None else rotation.to(dtype).requires_grad_()
    generator = torch.Generator().manual_seed(0)
    image, weights = (torch.rand(1, 1, side, side, generator=generator, dtype=torch.float64) for side in (24, 40))
    image = F.interpolate(image, source.image_size, mode="bicubic").to(dtype).requires_grad_()
    warp = ct.Warp(source, target, rotation, mode="bicubic", tolerance=tolerance)
    loss = (warp(image) * F.interpolate(weights, target.image_size, mode="bicubic").to(dtype)).sum()
    leaves = [p for p in (image, *source.parameters(), *target.parameters(), rotation) if p is not None]
    return torch.autograd.grad(loss, [leaf for leaf in leaves if leaf.requires_grad], allow_unused=True)


def check_gradients(*warp):
    true = [g for g in learned(*warp, torch.float64, 0.0) if g is not None]
    for dtype, tolerance in ((torch.float32, None), (torch.float64, 1e-3)):
        rounded, given = (
            [(g.double() - t).norm() / t.norm() for g, t in zip(found, true, strict=True)]
            for found in ([g for g in learned(*warp, dtype, at) if g is not None] for at in (0.0, tolerance))
        )
        for least, error in zip(rounded, given, strict=True):
            assert error <= 2 * least + 5e-5


@each_kind
def test_warps_that_learn_have_the_gradients_of_exact_ones(key):
    camera = next(iter(real(key).values())).float().requires_grad_(False).resize(168, 224)  # 21 x 28 cells
    straight = ct.Dewarp(camera).target
    check_gradients(camera, straight, None)
    check_gradients(straight, camera, turn(5.0, -10.0, 30.0))


def test_a_mixed_batch_and_a_panorama_learn_as_exact_ones():
    target = ct.Pinhole.from_fov(100, image_size=(120, 160))
    lenses = [ct.KannalaBrandt.from_fov(120, image_size=(160, 320)), ct.Mei.from_fov(120, image_size=(160, 320))]
    check_gradients(ct.Mixed(lenses), target, turn(40.0))
    panorama = ct.Equirectangular([320 / 2 / math.pi] * 2 + [30.0, 79.5], image_size=(160, 320))
    check_gradients(panorama, target, turn(160.0, 30.0))


@pytest.mark.parametrize(("most", "some"), [(CELL_CUBIC, CELL_QUINTIC), (CELL_QUINTIC, CELL_CUBIC)])
def test_pixels_of_a_lattice_and_their_transpose_are_those_of_torch(most, some):
    for size in ((16, 24), (77, 601)):
        n, m = (-(-side // 8) for side in size)
        nodes, cells = torch.randn(2, 2, n + 5, m + 5), torch.full((2, n, m), most).int()
        cells[0, 0, 1], cells[0, 1, 0], cells[1, -1, -1], cells[:, -1, 0] = CELL_EMPTY, 0, 1, some
        exact = torch.randn(2, 2, 8, 8)
        exact[:, 0, :3] = torch.nan
        cotangent, found = torch.randn(2, *size, 2), []
        for dtype in (torch.float32, torch.float64):
            leaves = nodes.to(dtype).requires_grad_(), exact.to(dtype).requires_grad_()
            where = Lattice(leaves[0], cells, leaves[1], size).pixels
            by_nodes, by_exact = torch.autograd.grad(where.grid, leaves, cotangent.to(dtype))
            found.append((where.grid, where.mapped, by_nodes, by_exact[~exact.isnan()]))
        for compiled, recorded in zip(*found, strict=True):
            torch.testing.assert_close(compiled, recorded.to(compiled.dtype), rtol=1e-4, atol=1e-4)


def test_second_derivatives_of_warps_that_learn_are_those_of_the_lattice():
    numbers = [torch.tensor(n).double().requires_grad_() for n in ([40.0, 41, 39, 31], [0.02, -0.01, 0.003, -0.001])]
    target = ct.Pinhole(torch.tensor([60.0, 60, 39.5, 31.5]), image_size=(64, 80)).requires_grad_(False)

    def grid(*numbers):
        source = ct.KannalaBrandt(*numbers, image_size=(64, 80))
        return ct.Warp(source, target.to(numbers[0].dtype), tolerance=0.01).grid()[:, ::7, ::7].sin()

    assert torch.autograd.gradcheck(grid, numbers, atol=1e-4, fast_mode=True)
    assert torch.autograd.gradgradcheck(grid, numbers, atol=1e-4, fast_mode=True)
    single = [n.detach().float().requires_grad_() for n in numbers]
    for of, dtype in ((single, torch.float32), (numbers, torch.float64)):
        first = torch.autograd.grad(grid(*of).sum(), of, create_graph=True)
        second = torch.autograd.grad(sum(g.square().sum() for g in first), of)
        if dtype == torch.float32:
            rough = second
    for r, s in zip(rough, second, strict=True):
        assert (r - s).norm() <= 1e-3 * s.norm()


@needs_library
def test_gradients_of_positions_may_lie_in_any_order_in_memory():
    cells, by = torch.full((1, 3, 4), CELL_CUBIC, dtype=torch.int32), torch.rand(2, 1, 24, 32).movedim(0, -1)
    assert torch.equal(sampler.lay_vjp(by, cells, 0)[0], sampler.lay_vjp(by.contiguous(), cells, 0)[0])
