"""The splined lens: mrcal's formula in NumPy, its edge, its grids, and any camera as one."""

import copy
import pickle

import numpy as np
import pytest
import torch

import camtorch as ct

GRIDS = [(3, 11, 8, 200), (2, 11, 8, 200), (3, 4, 4, 90), (2, 3, 4, 90), (2, 9, 5, 120)]


def drawn(order, columns, rows, fov_x, dtype=torch.float64, size=0.02):
    generator = torch.Generator().manual_seed(columns)
    model = ct.Splined.with_grid(order=order, columns=columns, rows=rows, fov_x=fov_x)
    k = size * torch.randn(2 * columns * rows, generator=generator, dtype=torch.float64)
    return model(torch.tensor([500.0, 510, 320, 240], dtype=dtype), k.to(dtype), image_size=(480, 640))


def weights(position, count, order):
    """mrcal.c: the first control point, and the weights of those that have a part."""
    if order == 3:
        cell = min(max(int(np.floor(position)), 1), count - 3)
        x = position - cell
        return cell - 1, [(1 - x) ** 3, 3 * x**3 - 6 * x**2 + 4, -3 * x**3 + 3 * x**2 + 3 * x + 1, x**3], 6
    cell = min(max(int(np.round(position)), 1), count - 2)
    x = position - cell
    return cell - 1, [4 * x * x - 4 * x + 1, 6 - 8 * x * x, 4 * x * x + 4 * x + 1], 8


def reference(camera, point):
    x, y, z = point
    rho = np.hypot(x, y)
    u = 2 * np.tan(np.arctan2(rho, z) / 2) * np.array([x, y]) / rho
    shape = camera.columns, camera.rows
    per_u = (shape[0] - camera.order) / (4 * np.tan(np.radians(camera.fov_x) / 4))
    controls = camera.distortion.detach().numpy().reshape(shape[1], shape[0], 2)
    at = [(w * per_u + (count - 1) / 2, count) for w, count in zip(u, shape, strict=True)]
    (i, across, n), (j, down, m) = (weights(*place, camera.order) for place in at)
    patch = controls[j : j + len(down), i : i + len(across)]
    du = np.einsum("j,i,jic->c", down, across, patch) / (n * m)
    focal, centre = camera.intrinsics.detach().numpy().reshape(2, 2)
    return focal * (u + du) + centre


def on_surface(camera, count=9, reach=1.0):
    """Rays on a lattice over the surface, its edge included for a reach of 1."""
    edge = 2 * np.tan(np.radians(camera.fov_x) / 4)
    tall = edge * (camera.rows - camera.order) / (camera.columns - camera.order)
    a, b = np.meshgrid(np.linspace(-edge, edge, count) * reach, np.linspace(-tall, tall, count) * reach)
    t = (a * a + b * b) / 4
    return torch.tensor(np.stack((a, b, 1 - t), -1).reshape(-1, 3))


@pytest.mark.parametrize("grid", GRIDS)
def test_pixels_are_those_of_the_formula_up_to_the_edge_and_behind_the_camera(grid):
    camera = drawn(*grid)
    rays = on_surface(camera, 8)
    pixels, valid = camera.project(rays)
    assert valid.all()
    formula = torch.tensor(np.array([reference(camera, p) for p in rays.numpy()]))
    torch.testing.assert_close(pixels.detach(), formula, rtol=0, atol=1e-9)
    expected = torch.nn.functional.normalize(rays, dim=-1)
    for unproject in (camera.unproject, torch.func.vmap(camera.unproject)):  # native, and the formula
        back, found = unproject(pixels)
        assert found.all()
        assert torch.linalg.cross(back, expected).norm(dim=-1).max() < 1e-12


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("grid", GRIDS)
def test_past_the_edge_nothing_is_valid(grid, dtype):
    camera = drawn(*grid, dtype=dtype)
    beyond = on_surface(camera, 7, 1.01).to(dtype).view(7, 7, 3)
    rim = torch.ones(7, 7, dtype=torch.bool)
    rim[1:-1, 1:-1] = False
    pixels, valid = camera.project(beyond)
    assert torch.equal(valid, ~rim)
    assert (pixels[rim] == -1).all()
    formula = torch.func.vmap(lambda rays: camera.project(rays)[1])(beyond)
    assert torch.equal(formula, valid)
    ideal = type(camera)(camera.intrinsics.detach(), torch.zeros_like(camera.distortion))
    inside, _ = ideal.project(on_surface(camera, 7).to(dtype).view(7, 7, 3))
    moved = (inside - ideal.intrinsics[2:]) * 1.01 + ideal.intrinsics[2:]
    assert torch.equal(ideal.unproject(moved)[1], ~rim)


def test_an_explanation_tells_the_edge_from_a_fold():
    flat = ct.Splined([100, 100, 50, 50], [0.0] * ct.Splined.default_count)
    (line,) = flat.explain([[10.0, 0.0, 1.0]])
    assert line == "beyond the edge of the surface at 80.00 degrees: 84.29 degrees from the optical axis"
    folded = flat.distortion.detach().reshape(8, 10, 2).clone()
    folded[:, 7:] -= 1.0  # columns from the eighth on are drawn back
    (line,) = ct.Splined(flat.intrinsics, folded.flatten()).explain([[10.0, 0.0, 1.0]])
    assert line.startswith("beyond the fold at ")


def test_grids_are_models_of_their_own_wherever_models_go(tmp_path):
    model = ct.Splined.with_grid(order=2, columns=9, rows=5, fov_x=120)
    assert model is ct.Splined.with_grid(columns=9, rows=5, fov_x=120.0, order=2)
    assert ct.Splined.with_grid(columns=10, rows=8, fov_x=160) is ct.Splined is ct.MODELS["splined"]
    camera = drawn(2, 9, 5, 120)
    for other in (pickle.loads(pickle.dumps(camera)), copy.deepcopy(camera), camera.resize(240, 320)):
        assert type(other) is model
    torch.save(camera, tmp_path / "camera.pt")
    assert type(torch.load(tmp_path / "camera.pt", weights_only=False)) is model
    for name in ("camera.json", "camera.cameramodel"):
        ct.save(camera, tmp_path / name)
        (loaded,) = ct.load(tmp_path / name).cameras.values()
        assert type(loaded) is model
        assert torch.equal(loaded.distortion, camera.distortion)
        assert torch.equal(loaded.intrinsics, camera.intrinsics)
    mixed = ct.Mixed([camera, ct.Pinhole(camera.intrinsics.detach(), image_size=(480, 640))])
    assert mixed.project(torch.tensor([[[0.1, 0.2, 1.0]]] * 2, dtype=torch.float64))[1].all()
    assert type(camera.convert("splined:order=3,columns=12,rows=9,fov_x=120").camera).columns == 12


def test_grids_that_are_none_are_refused(tmp_path):
    path = tmp_path / "camera.cameramodel"
    ct.save(drawn(2, 9, 5, 120), path)
    text = path.read_text()
    for name in ("order=4_Nx=9_Ny=5_fov_x_deg=120", "order=3_Nx=2_Ny=5_fov_x_deg=120"):
        path.write_text(text.replace("order=2_Nx=9_Ny=5_fov_x_deg=120", name))
        with pytest.raises(ct.CameraFileError, match="lensmodel"):
            ct.load(path)
    grid = "order=3,columns=16,rows=11,fov_x=120"
    for key in (f"splined:{grid}:{grid}", f"pinhole:{grid}"):
        with pytest.raises(ValueError, match="got the variant 'order=3"):
            ct.Pinhole([500, 500, 320, 240]).convert(key)


def test_any_lens_becomes_one():
    lens = ct.KannalaBrandt([300, 300, 310, 230], [0.03, -0.01, 0.002, -0.0005], image_size=(480, 640)).double()
    found = lens.convert("splined")
    assert found.max_error < 0.02
    assert found.valid_fraction == 1
    fine = lens.convert(ct.Splined.with_grid(columns=20, rows=16, fov_x=150))
    assert fine.rms < 1e-3  # the largest error is at the corner, on the rim of the surface


def test_a_surface_goes_behind_any_lens_at_any_place():
    """Its Jacobian, bounds and the native code, away from the origin and with cells that are not square."""
    from camtorch.optics import Lens, Planar, Polynomial, Surface

    class Bent(ct.KannalaBrandt):
        @staticmethod
        def optics(k):
            chart, _ = ct.KannalaBrandt.optics(k[:2])
            surface = Surface(k[2:], 6, 5, cells=(1.5, 1.7), centre=(0.1, -0.2))
            return chart, Lens(Planar(Polynomial(k[:2])), surface)

        @classmethod
        def names_of(cls, count):
            return tuple(f"c{i}" for i in range(count)) if count == 62 else None

    k = 0.02 * torch.randn(62, dtype=torch.float64)
    camera = Bent(torch.tensor([300.0, 300, 320, 240], dtype=torch.float64), k, image_size=(480, 640))
    pixels = camera.pixel_grid(32).double().reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    assert valid.any()
    again, _ = camera.project(rays)
    torch.testing.assert_close(again[valid], pixels[valid], rtol=0, atol=1e-9)
    formula = torch.func.vmap(lambda p: camera.unproject(p)[0])
    torch.testing.assert_close(formula(pixels)[valid], rays[valid], rtol=0, atol=1e-12)
    assert torch.autograd.gradcheck(
        lambda p, w: Bent(w[:4], w[4:]).project(p)[0],
        (rays[valid][::9].detach().requires_grad_(), torch.cat((camera.intrinsics, k)).detach().requires_grad_()),
    )


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_fold_at_the_rim_leaves_the_rest(order, dtype):
    model = ct.Splined.with_grid(order=order, columns=12, rows=9, fov_x=150)
    k = 0.01 * torch.randn(9, 12, 2, generator=torch.Generator().manual_seed(order), dtype=torch.float64)
    k[-1, :, 1] -= 1.0  # the last row falls back
    camera = model([280.0, 285, 319.5, 239.5], k.flatten(), image_size=(480, 640)).to(dtype).requires_grad_(False)
    pixels = camera.pixel_grid()[::5, ::5].reshape(-1, 2) * 1.15 - 30
    rays, valid = camera.unproject(pixels)
    again, seen = camera.project(rays)
    assert seen[valid].all()
    assert (again - pixels)[valid].abs().max() < 16 * torch.finfo(dtype).eps * 700
    assert 0.5 < valid.double().mean() < 0.95  # the fold lies within the image
