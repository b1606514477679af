"""`CameraHead`: whatever its numbers are, every point of the image has a ray; and they learn."""

import copy
import functools
import math
import pickle
import re

import pytest
import torch
from cameras import DISTINCT, USUAL, slow_unless

import camtorch as ct
from camtorch.rays.lattices import image_lattice

SIZE = (480, 640)
PANORAMAS = {"cylindrical", "equirectangular", "latlon", "transverse_cylindrical"}
FOV = {"orthographic_fisheye": (40, 80)}  # degrees; further out is nothing
OTHERS = {"splined"}  # which is not on its side what it is upright; heads refuse it
KEYS = sorted(set(ct.MODELS) - PANORAMAS - OTHERS)
QUICK = [key if key in DISTINCT else pytest.param(key, marks=pytest.mark.slow) for key in KEYS]


def head(key, features=16, **options):
    return copy.deepcopy(made(key, features, **options))


@functools.cache
def made(key, features, **options):
    return ct.CameraHead(features, key, **{"image_size": SIZE, "fov": FOV.get(key), **options})


def random(layer, scale, generator):
    for parameter in layer.linear.parameters():
        torch.nn.init.normal_(parameter, std=scale / math.sqrt(layer.linear.in_features + 1), generator=generator)
    return layer


def all_have_rays(camera, rows=9, columns=11) -> torch.Tensor:
    """Bool (*B): pixels over the whole image, its outer corners and edges included, have rays."""
    pixels = image_lattice(camera, rows, columns).flatten(0, 1)
    rays, valid = camera.unproject(pixels.expand(*camera.batch_shape, *pixels.shape))
    back, again = camera.project(rays)
    near = (back - pixels).norm(dim=-1) < 0.05
    return (valid & again & near).all(-1)


COUNTS = [("brown_conrady", {"count": n, "shared_focal": False, "centre": 0.3}) for n in (5, 8, 14)]
COUNTS = slow_unless(COUNTS[-1:].__contains__, COUNTS)
EACH = [pytest.param(k, {}, marks=() if k in DISTINCT - {"f_theta_backward"} else pytest.mark.slow) for k in KEYS]


@pytest.mark.parametrize(("key", "options"), EACH + COUNTS)
def test_all_numbers_give_cameras_with_a_ray_for_every_point_of_the_image_and_gradients(key, options):
    layer, generator = head(key, **options), torch.Generator().manual_seed(0)
    for size, count in ((0.3, 20), (1, 300), (5, 50), (1e3, 20), (1e5, 20), (1e6, 100), (1e9, 20), (1e30, 20)):
        numbers = size * torch.randn(count, len(layer.names), generator=generator)
        numbers = (size * numbers.sign() if count == 20 and size > 1 else numbers).requires_grad_()
        camera = layer.camera(numbers)
        assert bool(all_have_rays(camera).all())
        assert bool((camera.intrinsics[..., :2] > 0).all())
        assert camera.distortion.shape[-1] == options.get("count", camera.distortion.shape[-1])
        (gradient,) = torch.autograd.grad(camera.intrinsics.sum() + camera.distortion.sum(), numbers)
        for found in (camera.intrinsics, camera.distortion, gradient):
            assert bool(torch.isfinite(found).all())


def test_the_limits_are_near():
    # a lens bent ten times as far in the direction that a head ends in has lost corners: limits are no walls far away
    layer = head("kannala_brandt", count=1, fov=(120, 120), centre=0.0)
    number = torch.zeros(2, 2)
    number[:, 1] = torch.tensor([-1e6, 1e6])
    camera = layer.camera(number)
    assert bool(all_have_rays(camera).all())
    barrel, pincushion = camera.distortion[:, 0].tolist()
    corner = camera[0].unproject(torch.tensor([[-0.5, -0.5]]))[0]
    angle = float(torch.acos(corner[0, 2]))
    assert -1 / 3 < barrel * angle**2 < -0.9 / 3  # the fold is at -1/3
    assert pincushion * angle**2 > 1


@pytest.mark.parametrize("key", QUICK)
def test_it_starts_as_its_prior(key):
    layer = head(key)
    prior = layer.prior
    camera = layer(torch.randn(3, 16))
    assert torch.equal(camera.intrinsics, prior.intrinsics.expand(3, 4))
    assert torch.equal(camera.distortion, prior.distortion.expand_as(camera.distortion))
    least, most = (math.radians(angle) for angle in FOV.get(key, (40, 120)))
    assert least < prior.field_of_view[0] < most
    torch.testing.assert_close(prior.intrinsics[2:], torch.tensor([319.5, 239.5]))
    if key == "pinhole":  # the geometric mean of both ends
        ends = [320 / math.tan(math.radians(angle / 2)) for angle in (120, 40)]
        assert prior.fx.item() == pytest.approx(math.sqrt(math.prod(ends)), rel=1e-6)
        found = layer.camera(torch.tensor([[-1e6, 0.0, 0.0], [1e6, 0.0, 0.0]])).fx.tolist()
        assert sorted(found) == pytest.approx(ends, rel=1e-5)


CAMERAS = [
    ct.BrownConrady([520.0, 524.0, 317.0, 244.0], [-0.28, 0.07, 0.001, -0.0002, 0.01], image_size=SIZE),
    ct.KannalaBrandt([280.0, 280.0, 318.0, 236.0], [-0.012, 0.03, -0.02, 0.004], image_size=SIZE),
    ct.EUCM([300.0, 301.0, 321.0, 240.0], [0.6, 1.1], image_size=SIZE),
]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.key)
def test_a_given_camera_is_the_prior(camera):
    layer = ct.CameraHead(4, camera)
    assert layer.image_size == SIZE
    torch.testing.assert_close(layer.prior.intrinsics, camera.intrinsics.detach(), rtol=1e-6, atol=0)
    torch.testing.assert_close(layer.prior.distortion, camera.distortion.detach(), rtol=1e-6, atol=0)
    generator = torch.Generator().manual_seed(0)
    near = random(layer, 0.1, generator)(torch.randn(20, 4, generator=generator))
    assert bool(all_have_rays(near).all())
    assert (near.fy / near.fx - camera.fy / camera.fx).abs().max() < 1e-5
    assert (near.fx / camera.fx).log().abs().max() < 0.2


@pytest.mark.parametrize("fov", [(60, 100), (100, 140)])
def test_a_camera_at_an_end_of_the_range_is_the_prior(fov):
    camera = ct.Pinhole.from_fov(100, image_size=SIZE)
    layer = ct.CameraHead(4, camera, fov=fov)
    torch.testing.assert_close(layer.camera(torch.zeros(len(layer.names))).fov[0], camera.fov[0], rtol=1e-4, atol=0)
    made = layer(torch.randn(5, 4))
    made.fx.sum().backward()
    assert all(values.isfinite().all() for values in (made.intrinsics, layer.linear.weight.grad))


def test_one_moves_the_rim_by_a_tenth():
    for key in ("brown_conrady", "fisheye624", "ucm"):
        layer = head(key).double()
        edge = layer.prior.unproject(torch.tensor([[-64.5, -48.5]], dtype=torch.float64))[0]  # the farthest corner
        for i, name in enumerate(layer.names[3:], 3):
            number = torch.zeros(2, len(layer.names), dtype=torch.float64)
            number[:, i] = torch.tensor([-1e-3, 1e-3])
            lens = layer.camera(number)
            plane = type(lens)(lens.intrinsics.new_tensor([1.0, 1, 0, 0]).expand(2, 4), lens.distortion)
            before, after = plane.project(edge.expand(2, 1, 3))[0]
            moved = ((after - before) / 2e-3).norm() / after.norm()
            most = 0.01 if name[0] in "ps" else 0.1
            assert 0.3 * most < moved < 1.05 * most, name


@pytest.mark.parametrize("key", slow_unless(DISTINCT.__contains__, sorted(USUAL - PANORAMAS - OTHERS - {"pinhole"})))
def test_gradients_are_those_of_what_it_computes(key):
    layer = head(key, shared_focal=False).double()
    numbers = torch.randn(2, len(layer.names), dtype=torch.float64)
    step = 1e-5 * torch.randn(numbers.shape, dtype=torch.float64)

    def outputs(x):
        camera = layer.camera(x)
        return torch.cat((camera.intrinsics / 300, (camera.distortion - layer.prior.distortion) / size), -1)

    size = 1.0
    with torch.no_grad():
        size = (layer.camera(numbers).distortion - layer.prior.distortion).abs().clamp(min=1e-12)
        numeric = (outputs(numbers + step) - outputs(numbers - step)) / 2
    found = outputs(learns := numbers.clone().requires_grad_())
    for i, change in enumerate(numeric.unbind(-1)):
        (gradient,) = torch.autograd.grad(found[:, i].sum(), learns, retain_graph=True)
        torch.testing.assert_close((gradient * step).sum(-1), change, rtol=1e-4, atol=1e-9)


def test_gradients_do_not_vanish_far_out():
    layer = head("brown_conrady", fixed=("cx", "cy", "k2", "k3", "p1", "p2"))
    numbers = torch.tensor([[4.0, 4.0], [-4.0, -4.0]], requires_grad=True)
    camera = layer.camera(numbers)
    (camera.fx.log().sum() + camera.distortion[:, 0].sum()).backward()
    assert (numbers.grad.abs() > 1e-3).all()


def test_fixed_names_and_counts():
    layer = head("fisheye624", fixed=("cx", "cy", "p0", "p1", "s0", "s1", "s2", "s3"), shared_focal=False)
    assert layer.names == ("focal", "aspect", "k0", "k1", "k2", "k3", "k4", "k5")
    camera = random(layer, 1.0, torch.Generator().manual_seed(0))(torch.randn(5, 16))
    assert bool((camera.distortion[:, 6:] == 0).all())
    assert bool((camera.cx == 319.5).all())
    assert (camera.fy / camera.fx - 1).abs().max() > 0.01
    assert head("kannala_brandt", count=2, fixed="cy").names == ("focal", "cx", "k1", "k2")
    assert head("division", count=3).camera(torch.zeros(6)).distortion.shape == (3,)
    assert "omega" in head("fov").names  # which at 0 would change nothing
    assert set(head("eucm").names) > {"alpha", "beta"}
    assert not [name for name in head("tabulated").names if name.startswith("theta")]


def test_it_is_a_module_like_others(tmp_path):
    layer = random(head("brown_conrady", 8), 0.5, torch.Generator().manual_seed(0))
    features = torch.randn(2, 3, 8)
    camera = layer(features)
    assert tuple(camera.batch_shape) == (2, 3)
    assert camera.image_size == SIZE
    single = layer(features[0, 0])
    torch.testing.assert_close(single.intrinsics, camera.intrinsics[0, 0])
    other = head("brown_conrady", 8)
    assert set(layer.state_dict()) == {"linear.weight", "linear.bias"}
    other.load_state_dict(layer.state_dict())
    for again in (other, copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
        assert torch.equal(again(features).distortion, camera.distortion)
    with torch.no_grad():
        assert not layer(features).intrinsics.requires_grad
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(layer(features).intrinsics, camera.intrinsics)
    half = copy.deepcopy(layer).half()
    assert half(features).intrinsics.dtype == torch.float32
    assert "numbers=(focal cx cy k1 k2 p1 p2 k3)" in repr(layer)


def test_rows_are_independent_and_a_bad_one_is_alone():
    layer = random(head("kannala_brandt", 8), 1.0, torch.Generator().manual_seed(0))
    features = torch.randn(4, 8, generator=torch.Generator().manual_seed(1))
    whole = layer(features)
    # a product of matrices rounds by its size, and float32 keeps 1e-7 of numbers from which others are taken
    torch.testing.assert_close(layer(features[2:3]).distortion, whole.distortion[2:3], rtol=1e-5, atol=1e-9)
    features[1, 0] = torch.nan
    assert all_have_rays(layer(features)).tolist() == [True, False, True, True]
    assert bool(all_have_rays(layer(1e30 * features[2:].flip(0))).all())


REFUSED = [
    ("pinhole", {"image_size": None}, "image_size=(height, width)"),
    ("equirectangular", {}, "panorama"),
    ("pinhole", {"fov": (120, 40)}, "must be degrees, "),
    ("pinhole", {"fov": (90, 190)}, "must have rays for the corners"),
    ("orthographic_fisheye", {"fov": None}, "Use a narrower fov"),
    ("pinhole", {"fixed": "fx"}, "fov=(90, 90)"),
    ("pinhole", {"centre": 0.7}, "below 0.5"),
    (CAMERAS[0], {"image_size": (48, 64)}, "that of the camera, (480, 640)"),
    (CAMERAS[0], {"fov": (20, 30)}, "must contain that"),
    (ct.KannalaBrandt([200.0, 200, 320, 240], [-0.2, 0, 0, 0], image_size=SIZE), {}, "or another model"),
    ("pinhole", {"fov": 90}, "as (40, 120); got 90"),
]


@pytest.mark.parametrize(("model", "options", "said"), REFUSED)
def test_what_is_refused(model, options, said):
    error = TypeError if options == {"fov": 90} else ValueError
    with pytest.raises(error, match=f"CameraHead.*{re.escape(said)}"):
        ct.CameraHead(16, model, **{"image_size": None if isinstance(model, ct.Camera) else SIZE, **options})


def test_features_of_another_size_are_refused():
    layer = head("pinhole")
    with pytest.raises(ValueError, match=r"features must be \(\*B, 16\); got shape \(2, 8\)"):
        layer(torch.zeros(2, 8))
    with pytest.raises(ValueError, match=r"numbers must be \(\*B, 3\), focal, cx, cy"):
        layer.camera(torch.zeros(2, 8))


@pytest.mark.parametrize("model", ["pinhole", "kannala_brandt"])
def test_heads_of_no_features_and_on_the_meta_device(model):
    head = ct.CameraHead(8, model, image_size=SIZE)
    assert head(torch.randn(0, 8)).batch_shape == (0,)
    assert head.to("meta")(torch.randn(2, 8, device="meta")).batch_shape == (2,)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["pinhole", "brown_conrady"])
def test_heads_export_with_any_number_of_rows(model):
    class Numbers(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.head = ct.CameraHead(8, model, image_size=SIZE)

        def forward(self, features):
            return self.head(features).intrinsics

    module, rows = Numbers(), {0: torch.export.Dim("rows", min=2)}
    program = torch.export.export(module, (torch.randn(4, 8),), dynamic_shapes=(rows,)).module()
    features = torch.randn(5, 8)
    torch.testing.assert_close(program(features), module(features))


@pytest.mark.slow
def test_the_error_of_an_export_to_onnx_says_what_exports():
    pytest.importorskip("onnxscript")
    head = ct.CameraHead(4, "brown_conrady", image_size=(48, 64)).eval()
    with pytest.raises(Exception, match=r"'pinhole' in torch.onnx.export; got BrownConrady. Export.*up to head.linear"):
        torch.onnx.export(head, (torch.zeros(2, 4),), dynamo=True, verbose=False)


def test_the_centre_moves_by_parts_of_its_own_side_and_in_full_precision():
    layer = head("pinhole", centre=0.1)
    far = layer.camera(torch.tensor([0.0, torch.inf, torch.inf]))
    torch.testing.assert_close(far.intrinsics[2:] - layer.prior.intrinsics[2:], torch.tensor([64.0, 48.0]))
    layer = random(layer, 1.0, torch.Generator().manual_seed(0))
    features = torch.randn(4, 16, generator=torch.Generator().manual_seed(1))
    with torch.autocast("cpu", torch.bfloat16):
        mixed = layer(features)
    assert torch.equal(mixed.intrinsics, layer.camera(layer.linear(features)).intrinsics)
