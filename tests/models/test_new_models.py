"""What the author of a model may rely on: a formula alone makes a stage or a factor; what cannot work says so."""

import math

import pytest
import torch
from cameras import fan, slow_unless
from torch.autograd import gradcheck, gradgradcheck

import camtorch as ct
from camtorch.optics import Equidistant, Inverted, Lens, Perspective, Planar, Polynomial, RadialFactor, Stage
from camtorch.optics.radial import RadiusPolynomial


class Wave(Stage):
    """A stage that states nothing but its formula."""

    def __init__(self, c, d):
        self.parameters = (c, d)

    def __call__(self, a, b):
        c, d = self.parameters
        return a + c * torch.sin(2 * b) * a, b + d * torch.sin(a) * b + c * a * a


class Shear(Stage):
    """Far from the identity, and linear."""

    def __init__(self, c, d, e):
        self.parameters = (c, d, e)

    def __call__(self, a, b):
        c, d, e = self.parameters
        return c * a + d * b, e * a + b


class Growth(RadialFactor):
    """A factor that states nothing but its formula; it turns back at t = -1 / (2 c)."""

    def __call__(self, t):
        (c,) = self.parameters
        return torch.exp(c * t)


class Waved(ct.Camera):
    distortion_names = ("k1", "k2", "c", "d")

    @staticmethod
    def optics(k):
        return Equidistant(), Lens(Planar(Polynomial(k[:2])), Wave(*k[2:]))


class WavedAlone(ct.Camera):
    distortion_names = ("c", "d")

    @staticmethod
    def optics(k):
        return Perspective(), Lens(Wave(*k))


class Grown(ct.Camera):
    distortion_names = ("c",)

    @staticmethod
    def optics(k):
        return Equidistant(), Lens(Planar(Growth(k)))


class Backwards(ct.Camera):
    """From the pixel to the angle, and a sensor that is not square: as `OCamCalib`."""

    distortion_names = ("k1", "k2", "c", "d", "e")

    @staticmethod
    def optics(k):
        return Inverted(RadiusPolynomial, k[:2]), Lens(Shear(*k[2:]))


class BackwardsGrown(ct.Camera):
    distortion_names = ("c",)

    @staticmethod
    def optics(k):
        return Inverted(Growth, k), Lens()


CAMERAS = {Waved: (0.03, -0.01, 0.02, -0.03), WavedAlone: (0.05, -0.03), Grown: (-0.08,)}
CAMERAS |= {Backwards: (-0.05, 0.02, 0.8, 0.03, -0.02), BackwardsGrown: (0.04,)}
every_camera = pytest.mark.parametrize("model", CAMERAS)


def camera_of(model, dtype=torch.float64):
    intrinsics = torch.tensor([300.0, 310.0, 318.5, 242.25], dtype=dtype)
    return model(intrinsics, torch.tensor(CAMERAS[model], dtype=dtype), image_size=(480, 640))


@every_camera
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_stated_formula_there_and_back(model, dtype):
    camera, rays = camera_of(model, dtype), fan(50).to(dtype)
    eps = torch.finfo(dtype).eps
    chart, lens = model.optics(torch.tensor(CAMERAS[model], dtype=dtype).unbind())
    a, b = chart.to_plane(*rays.unbind(-1))
    for stage in lens.stages:
        if isinstance(stage, Planar):
            factor = stage.radial(a * a + b * b)
            a, b = a * factor, b * factor
        else:
            a, b = stage(a, b)
    pixels, valid = camera.project(rays)
    assert valid.all()
    expected = camera.intrinsics[:2] * torch.stack((a, b), -1) + camera.intrinsics[2:]
    torch.testing.assert_close(pixels, expected, rtol=5000 * eps, atol=1e4 * eps)
    again, valid = camera.unproject(pixels)
    assert valid.all()
    torch.testing.assert_close(again, rays, rtol=0, atol=500 * eps)
    grid = camera.pixel_grid()[::20, ::20]
    rays, valid = camera.unproject(grid)
    assert valid.float().mean() > 0.5
    torch.testing.assert_close(camera.project(rays)[0][valid], grid[valid], rtol=0, atol=1e4 * eps)


@pytest.mark.parametrize("model", slow_unless({Waved}.__contains__, list(CAMERAS)))
def test_derivatives(model):
    camera = camera_of(model)
    leaves = [p.detach().clone().requires_grad_() for p in camera.parameters()]
    points = (fan(50, 2, 2)[2:] * 1.7).requires_grad_()
    pixels = camera.project(points)[0].detach().requires_grad_()
    for method, values in (("project", points), ("unproject", pixels)):

        def call(p, *q, method=method):
            return getattr(model(*q), method)(p)[0]

        assert gradcheck(call, (values, *leaves), atol=1e-4)
        assert gradgradcheck(call, (values, *leaves), atol=1e-4, fast_mode=True)


FOLDED = {Waved: ((-0.1, -0.03, 0.2, -0.1), 80), WavedAlone: ((0.4, -0.3), 60), Grown: ((-0.4,), 80)}  # and degrees


@pytest.mark.parametrize("model", FOLDED)
def test_valid_up_to_the_fold(model):
    """What a determinant by another way says along each azimuth."""
    coefficients, end = FOLDED[model]
    camera = model(torch.tensor([300.0, 300, 0, 0]).double(), torch.tensor(coefficients).double())
    rays = fan(end, 200, 16)
    chart, lens = model.optics(camera.distortion.detach().unbind())
    a, b = chart.to_plane(*rays.unbind(-1))

    def jacobian(point):
        a, b = point.unbind()
        return torch.stack(lens(a[None], b[None])).squeeze(-1)

    found = torch.func.vmap(torch.func.jacrev(jacobian))(torch.stack((a, b), -1))
    trace = found.diagonal(dim1=-1, dim2=-2).sum(-1)
    regular = torch.minimum(torch.linalg.det(found), trace).view(200, 16)
    before = (regular > 0).long().cumprod(0).bool()
    near = regular.abs() < 0.05
    valid = camera.project(rays)[1].view(200, 16)
    assert not before.all()
    assert torch.equal(valid | near, before | near)
    pixels, valid = camera.project(rays)
    again, found = camera.unproject(pixels)
    far = valid & ~near.flatten()
    assert found[far].all()
    torch.testing.assert_close(again[far], rays[far], rtol=0, atol=1e-9)


@every_camera
def test_without_a_graph_in_transforms_and_compiled(model):
    camera, rays = camera_of(model), fan(50)
    for method, values in (("project", rays), ("unproject", camera.project(rays)[0].detach())):
        call = getattr(camera, method)
        expected = call(values)[0].detach()
        for context in (torch.no_grad(), torch.inference_mode()):
            with context:
                torch.testing.assert_close(getattr(camera_of(model), method)(values)[0], expected)
        mapped = torch.func.vmap(lambda v, call=call: call(v)[0])(values)
        torch.testing.assert_close(mapped.detach(), expected, rtol=1e-9, atol=1e-9)
        found = torch.func.jacrev(lambda v, call=call: call(v)[0])(values[100])
        expected = torch.autograd.functional.jacobian(lambda v, call=call: call(v)[0], values[100])
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    if model is Waved:
        compiled = torch.compile(camera, backend="eager", fullgraph=True)
        torch.testing.assert_close(compiled(rays)[0], camera.project(rays)[0], rtol=1e-9, atol=1e-9)


def test_no_pixel_is_the_end_of_a_chart():
    """A chart that is looked up ends where its angle ceases to ascend, and no further out."""
    camera = Backwards([100.0, 100, 64, 64], [-0.3, 0.0, 0.9, 0.0, 0.0], image_size=(128, 128)).double()
    end = 1 / 0.6  # of theta = r - 0.3 r^2
    steps = torch.linspace(0, 2.5, 501, dtype=torch.float64)
    for turn in (0.0, 0.7, 2.0, 4.0):
        across = torch.tensor([0.9 * math.cos(turn), math.sin(turn)], dtype=torch.float64)
        pixels = 64 + 100 * steps[:, None] * across
        rays, valid = camera.unproject(pixels)
        assert torch.equal(valid, steps < end)
        again, back = camera.project(rays[valid])
        assert back.all()
        torch.testing.assert_close(again, pixels[valid], rtol=0, atol=1e-5)


@pytest.fixture
def models():
    kept = dict(ct.MODELS)
    yield ct.MODELS
    ct.MODELS.clear()
    ct.MODELS.update(kept)


@pytest.mark.parametrize("name", ["optics", "defined"])
def test_formulas_depend_on_nothing_but_the_coefficients(name, models):
    with pytest.raises(TypeError, match=f"Bound: {name} must be a @staticmethod"):
        type("Bound", (ct.Pinhole,), {name: lambda self, k: None, "key": "bound"})
    assert "bound" not in models


def test_a_taken_key_is_refused(models):
    with pytest.raises(ValueError, match=r"Mine: key must .* got 'kannala_brandt', .* of camtorch\..*KannalaBrandt"):
        type("Mine", (ct.KannalaBrandt,), {"key": "kannala_brandt"})
    assert models["kannala_brandt"] is ct.KannalaBrandt


def test_a_class_that_is_defined_again_takes_its_own_place(models):
    first, second = (type("Again", (ct.Pinhole,), {"key": "again", "__module__": "__main__"}) for _ in range(2))
    assert models["again"] is second
    points = torch.tensor([[0.5, 0.2, 1.0]])
    torch.testing.assert_close(first([9.0, 9, 1, 1])(points), second([9.0, 9, 1, 1])(points))


def test_a_class_without_a_key_is_not_taken_for_its_parent(tmp_path, models):
    class Folded(ct.KannalaBrandt):
        @staticmethod
        def optics(k):
            return ct.KannalaBrandt.optics([2 * c for c in k])

    camera = Folded([300.0, 300, 320, 240], [0.1, 0.0, 0.0, 0.0], image_size=(480, 640))
    assert Folded.key == ""
    assert "" not in models
    for format, name in (("camtorch", "a.json"), ("opencv", "a.yaml"), ("kalibr", "b.yaml"), ("colmap", "cameras.txt")):
        with pytest.raises(TypeError, match="camera must be of a model with a key; got Folded"):
            ct.save(camera, tmp_path / name, format=format)
    assert not list(tmp_path.iterdir())
