"""Any camera as a camera of any model: exact where models are related, close where they are not, honest otherwise."""

import math
from math import radians

import pytest
import torch
from cameras import DISTINCT, GOLDEN, KEYS, drawn, each_kind, golden_camera, make, one, pixel_lattice, slow_unless
from hypothesis import given, settings
from hypothesis import strategies as st

import camtorch as ct

F64 = {"dtype": torch.float64}
SIZE = (480, 640)
ROUNDING = 1e-11  # px

AT_40 = {"max_angle": radians(40)}
FEW = {"fisheye624", "kannala_brandt", "division"}
few_models = pytest.mark.parametrize("key", slow_unless(FEW.__contains__, KEYS))


def golden(name):
    return golden_camera(GOLDEN[f"mpmath__{name}"])


def fisheye(batch=(), seed=0, **options):
    """Plausible Kannala-Brandt cameras of about 130 degrees."""
    draw = torch.rand(*batch, 8, generator=torch.Generator().manual_seed(seed), **F64) - 0.5
    intrinsics = torch.tensor([300.0, 300, 319.5, 239.5], **F64) + 20 * draw[..., :4]
    distortion = draw[..., 4:] * torch.tensor([0.1, 0.02, 0.01, 0.002])
    return ct.KannalaBrandt(intrinsics, distortion, image_size=SIZE, **options)


def pixels_apart(source, result):
    """The distances at random pixels of the image that the result speaks for, measured anew; and their share."""
    height, width = source.image_size
    draw = torch.rand(2000, 2, generator=torch.Generator().manual_seed(1), **F64)
    pixels = draw * torch.tensor([width, height], **F64) - 0.5
    with torch.no_grad():
        rays, valid = source.double().unproject(pixels)
        angle = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2])
        use = valid & (angle < result.max_angle)
        new, mapped = result.camera.project(rays[use])
    assert bool(mapped.all())
    return (new - pixels[use]).norm(dim=-1), float(use.sum() / valid.sum())


def check(source, result):
    """What holds for every conversion, good or bad."""
    numbers = result.rms, result.max_error, result.max_angle, result.valid_fraction
    parameters = torch.cat([p.detach().reshape(-1) for p in (result.camera.intrinsics, result.camera.distortion)])
    assert parameters.dtype == torch.float64
    assert bool(torch.isfinite(parameters).all())
    assert all(number.shape == source.batch_shape and not bool(number.isnan().any()) for number in numbers)
    assert (result.camera.batch_shape, result.camera.image_size) == (source.batch_shape, source.image_size)
    assert bool((result.rms <= result.max_error).all())
    assert bool(((result.valid_fraction >= 0) & (result.valid_fraction <= 1)).all())
    assert bool(((result.max_angle >= 0) & (result.max_angle <= math.pi + 1e-9)).all())
    assert "nan" not in repr(result)


@each_kind
def test_to_the_same_model_is_a_copy(key):
    source = one(key)
    result = source.convert(key)
    check(source, result)
    assert bool(result.exact)
    assert float(result.max_error) == 0
    assert torch.equal(result.camera.intrinsics, source.intrinsics)
    assert torch.equal(result.camera.distortion, source.distortion)
    assert result.camera.intrinsics is not source.intrinsics


@few_models
def test_from_and_to_every_model_as_the_numbers_say(key):
    for source, target, options in (
        (one(key), ct.KannalaBrandt, {"count": 4}),
        (ct.KannalaBrandt([300.0, 305, 321, 238], [0.02, -0.01, 0.003, -0.001], image_size=SIZE), key, AT_40),
    ):
        result = source.convert(target, **options)
        check(source, result)
        errors, share = pixels_apart(source, result)
        assert float(errors.max()) <= 1.05 * float(result.max_error) + 1e-9
        assert float(errors.square().mean().sqrt()) == pytest.approx(float(result.rms), rel=0.1, abs=1e-9)
        assert share == pytest.approx(float(result.valid_fraction), abs=0.03)
    assert float(result.max_angle) == pytest.approx(radians(40), abs=0.02)
    # what has coefficients can follow a lens, what has none cannot
    assert float(result.max_error) < (20 if one(key).distortion_names else 60)


CLOSE = [
    (lambda: golden("kannala_brandt__auto_190deg_a"), "fisheye624", {}, ROUNDING),
    (lambda: golden("kannala_brandt__auto_190deg_a"), "brown_conrady", {"count": 8, "max_angle": radians(75)}, 0.1),
    (lambda: make("brown_conrady", torch.tensor([500.0, 500, 320, 240]), torch.tensor([-0.1, 0.02, 0, 0]),
                  image_size=SIZE), "kannala_brandt", {}, 0.01),
    (lambda: golden("brown_conrady__d5_dms_ir_62deg").crop(300, 700, 200, 300).hflip(), "fisheye624", {}, 0.1),
    (lambda: golden("brown_conrady__d4_smartphone_tele"), "fisheye62", {}, 0.1),
    (lambda: golden("pinhole__smartphone_main"), "kannala_brandt", {}, 0.01),
    (lambda: golden("kannala_brandt__dms_130deg_a"), "brown_conrady", {"count": 8}, 1.0),
    (lambda: golden("fisheye624__aria_slam_left_online"), "fisheye62", {}, 0.5),
    (lambda: make("double_sphere", torch.tensor([350.0, 350, 320, 240]), torch.tensor([-0.2, 0.59]),
                  image_size=SIZE), "kannala_brandt", {}, 0.1),
    (lambda: one("woodscape"), "kannala_brandt", {}, 0.1),
    (lambda: golden("fisheye624__aria_slam_left_online").convert("kannala_brandt").camera, "tabulated", {}, 0.1),
    (lambda: golden("kannala_brandt__tumvi_cam0"), "double_sphere", {"max_angle": radians(90)}, 1.0),
    (lambda: one("ucm"), "mei", {}, 0.1),
    # two minima: a search whose damping falls faster ends in that of 0.35 px
    (lambda: one("kannala_brandt"), "double_sphere", {}, 0.3),
]  # fmt: skip


@pytest.mark.parametrize(("make_source", "target", "options", "limit"), slow_unless(CLOSE[::6].__contains__, CLOSE))
def test_close_conversions(make_source, target, options, limit):
    source = make_source()
    result = source.convert(target, **options)
    check(source, result)
    assert float(result.max_error) <= limit
    assert float(result.valid_fraction) > 0.999 or "max_angle" in options


@pytest.mark.parametrize("p", slow_unless({1e-6}.__contains__, [1e-6, 1e-3]))
def test_a_table_of_a_lens_that_is_nearly_radial(p):
    """The fewer pixels determine a node, the less may what is not radial pull at it."""
    lens = torch.tensor([-0.1, 0, p, -p, 0], **F64)
    source = make("brown_conrady", torch.tensor([450.0, 450, 319.5, 239.5], **F64), lens, image_size=SIZE)
    result = source.convert("tabulated")
    check(source, result)
    assert float(result.max_error) < 1e-4 + 1500 * p
    assert float(result.valid_fraction) == 1


def test_special_cases_are_padded_and_come_back_bit_by_bit():
    source = golden("kannala_brandt__auto_190deg_a")
    for names in (("fisheye62",), ("fisheye62", "fisheye624")):
        camera = source
        for name in names:
            result = camera.convert(name)
            assert bool(result.exact)
            assert float(result.max_error) < ROUNDING
            assert float(result.valid_fraction) == 1
            camera = result.camera
        assert torch.equal(camera.distortion[:4], source.distortion)
        assert not bool(camera.distortion[4:].any())
        back = camera.convert("kannala_brandt", count=4)
        assert bool(back.exact)
        assert torch.equal(back.camera.intrinsics, source.intrinsics)
        assert torch.equal(back.camera.distortion, source.distortion)


def test_what_would_be_lost_is_fitted_row_by_row():
    k = torch.zeros(3, 12, **F64)
    k[:, 0] = 0.02
    k[1, 8] = 1e-3
    source = ct.Fisheye624(torch.tensor([300.0, 300, 320, 240], **F64).expand(3, 4), k, image_size=SIZE)
    result = source.convert(ct.Fisheye62)
    assert result.exact.tolist() == [True, False, True]
    assert result.max_error[[0, 2]].tolist() == [0, 0]
    assert 0 < float(result.max_error[1]) < 0.6
    assert "at worst" in repr(result)


def test_a_related_model_gets_as_many_coefficients_as_it_needs():
    aria = golden("fisheye624__aria_slam_left_online")
    assert aria.convert("kannala_brandt").camera.distortion.shape == (6,)
    assert aria.convert("kannala_brandt", count=4).camera.distortion.shape == (4,)
    assert golden("pinhole__dms_ir_62deg").convert("kannala_brandt").camera.distortion.shape == (4,)
    long = ct.KannalaBrandt([300.0, 300, 320, 240], [0.01] * 6 + [0.0] * 4, image_size=SIZE)
    assert bool(long.convert("fisheye62").exact)
    longer = ct.KannalaBrandt([300.0, 300, 320, 240], [0.01] * 6 + [0.001] * 4, image_size=SIZE)
    assert not bool(longer.convert("fisheye62").exact)


@pytest.mark.slow
@pytest.mark.parametrize(("target", "options"), [("brown_conrady", {"max_angle": 0.8, "count": 5}), ("latlon", {})])
def test_a_batch_is_its_rows_one_by_one(target, options):
    source = fisheye((4, 8))
    together = source.convert(target, **options)
    check(source, together)
    for i, j in ((0, 0), (0, 7), (1, 5), (2, 2), (3, 7)):
        row = ct.KannalaBrandt(source.intrinsics[i, j].detach(), source.distortion[i, j].detach(), image_size=SIZE)
        alone = row.convert(target, **options)
        for name in ("rms", "max_error", "max_angle", "valid_fraction"):
            torch.testing.assert_close(getattr(together, name)[i, j], getattr(alone, name), rtol=1e-7, atol=1e-9)
        for whole, part in zip(together.camera[i, j].tensors, alone.camera.tensors, strict=True):
            torch.testing.assert_close(whole, part, rtol=1e-7, atol=1e-8)


@pytest.mark.filterwarnings("ignore:.*became unusable")
def test_a_row_that_is_no_camera_leaves_the_others_alone():
    source = fisheye((3,))
    before = source.convert("brown_conrady", max_angle=0.8)
    with torch.no_grad():
        source.intrinsics[1, 0] = math.nan
    after = source.convert("brown_conrady", max_angle=0.8)
    assert bool(torch.isfinite(after.camera.intrinsics).all() & torch.isfinite(after.camera.distortion).all())
    assert float(after.max_error[1]) == float(after.rms[1]) == math.inf
    assert float(after.valid_fraction[1]) == float(after.max_angle[1]) == 0
    torch.testing.assert_close(after.camera.distortion[[0, 2]], before.camera.distortion[[0, 2]], rtol=1e-7, atol=1e-8)


@pytest.mark.slow
def test_more_coefficients_where_they_are_worth_it():
    wide = golden("kannala_brandt__dms_130deg_a")
    assert wide.convert("brown_conrady").camera.distortion.shape == (8,)
    pair = ct.KannalaBrandt(
        torch.stack((wide.intrinsics.detach(), torch.tensor([900.0, 900, 640, 400], **F64))),
        torch.stack((wide.distortion.detach(), torch.zeros(4, **F64))),
        image_size=wide.image_size,
    )
    few = pair.convert("brown_conrady", max_angle=radians(30))
    both = pair.convert("brown_conrady")
    assert few.camera.distortion.shape == (2, 5)
    assert both.camera.distortion.shape == (2, 8)


def test_a_bad_conversion_says_so():
    source = golden("kannala_brandt__auto_190deg_a")
    result = source.convert(ct.Pinhole)
    check(source, result)
    assert float(result.max_error) > 100
    assert float(result.max_angle) < radians(90)
    assert float(result.valid_fraction) < 0.9
    narrow = source.convert(ct.Pinhole, max_angle=radians(20))
    assert float(narrow.max_error) < 10
    assert float(narrow.max_angle) == pytest.approx(radians(20), abs=1e-3)
    assert 0 < float(narrow.valid_fraction) < 0.1


def test_without_an_image_all_rays_count():
    source = ct.KannalaBrandt([300.0, 300, 320, 240], [0.02, -0.01, 0.003, -0.001])
    result = source.convert("fisheye624")
    assert result.camera.image_size is None
    assert "of the rays" in repr(result)
    wide = ct.Pinhole([300.0, 300, 320, 240]).convert("kannala_brandt", max_angle=radians(50))
    assert float(wide.max_angle) == pytest.approx(radians(50), abs=1e-6)
    assert float(wide.max_error) < 0.05
    sized = source.convert("fisheye624", image_size=(100, 200))
    assert sized.camera.image_size == (100, 200)


def test_the_new_camera_learns_as_the_old_one_did():
    learning = fisheye()
    result = learning.convert("brown_conrady", max_angle=0.6)
    assert all(isinstance(p, torch.nn.Parameter) and p.requires_grad for p in result.camera.parameters())
    assert result.rms.requires_grad is False
    frozen = learning.requires_grad_(False).convert("brown_conrady", max_angle=0.6).camera
    assert not any(p.requires_grad for p in frozen.parameters())
    predicted = 300 * torch.ones(4, requires_grad=True)
    result = ct.KannalaBrandt(predicted, torch.zeros(4), image_size=SIZE).convert("fisheye62")
    assert bool(result.exact)
    assert result.camera.intrinsics.is_leaf
    half = fisheye().float().convert("fisheye62")
    assert half.camera.intrinsics.dtype == torch.float64
    assert bool(half.exact)


@pytest.mark.parametrize(
    ("arguments", "options", "error", "text"),
    [
        (("fisheye63",), {}, ValueError, r"one of brown_conrady.*\(did you mean 'fisheye62'\?\)"),
        ((torch.nn.Linear,), {}, TypeError, "model must be a camera model"),
        ((ct.Camera,), {}, TypeError, "model must be a camera model"),
        (("brown_conrady",), {"count": 6}, ValueError, "n = 4, 5, 8, 12 or 14 .*; got 6"),
        (("brown_conrady",), {"count": -1}, ValueError, "count must fit .*; got -1"),
        (("pinhole",), {"count": 1}, ValueError, "count must fit .*; got 1"),
        (("pinhole",), {"max_angle": 0.0}, ValueError, "max_angle must be positive"),
        (("pinhole",), {"max_angle": 60.0}, ValueError, "radians, up to pi; got 60"),
        (("Pinhole",), {}, ValueError, "did you mean 'pinhole'"),
        (("pinhole-equi",), {}, ValueError, "did you mean 'kannala_brandt'"),  # as Kalibr calls it
        (("pinhole",), {"max_angle": math.nan}, ValueError, "max_angle must be positive"),
        (("pinhole",), {"tolerance": 0.0}, ValueError, "tolerance must be positive"),
        (("pinhole",), {"image_size": (0, 3)}, ValueError, "image_size must be positive"),
    ],
)
def test_the_door(arguments, options, error, text):
    with pytest.raises(error, match=text):
        fisheye().convert(*arguments, **options)


def largest(source, result, rows=481, columns=641):
    """The largest distance on a lattice far finer than the one that a conversion looks at, and on the rim."""
    angle = float(result.max_angle)
    rays, valid = source.unproject(pixel_lattice(source.pad(0, 1, 0, 1), rows, columns) - 0.5)
    phi = torch.linspace(0, 2 * math.pi, 1441, **F64)
    rim = torch.stack((math.sin(angle) * phi.cos(), math.sin(angle) * phi.sin(), torch.full_like(phi, math.cos(angle))))
    pixels, there = source.project(rim.mT)
    valid = valid & (torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2]) <= angle)
    rays = torch.cat((rays[valid], rim.mT[there & source.contains(pixels)]))
    (old, _), (new, mapped) = source.project(rays), result.camera.project(rays)
    # between the nodes there may be a hole that none of them fell into
    return float(torch.where(mapped, (new - old).norm(dim=-1), 0.0).max())


@pytest.mark.parametrize("key", slow_unless("fisheye624".__eq__, sorted(DISTINCT)))
@given(data=st.data())
@settings(max_examples=2)
def test_nothing_between_the_nodes_of_drawn_cameras_is_worse(key, data):
    source = data.draw(drawn(key, wild=data.draw(st.booleans()))).requires_grad_(False)
    angle = data.draw(st.sampled_from([None, 0.3, 0.7, 1.2]))
    result = source.convert(data.draw(st.sampled_from(KEYS)), max_angle=angle)
    check(source, result)
    # what no lens of the other model comes near changes more between the nodes: 1 % of 218 px has been seen
    margin = 1.005 if float(result.max_error) < 50 else 1.02
    if bool(torch.isfinite(result.max_error)):
        assert largest(source, result) <= margin * float(result.max_error) + 1e-9


@pytest.mark.parametrize("key", slow_unless({"brown_conrady"}.__contains__, ["brown_conrady", "division"]))
def test_conversion_in_inference_mode(key):
    """Derivatives of the one go backward, of the other forward."""
    camera = ct.KannalaBrandt([280.0, 280.0, 319.5, 239.5], [0.02, -0.01, 0.003, -0.001], image_size=(480, 640))
    options = {"count": 4, "max_angle": 0.8}
    known = camera.convert(key, **options)
    with torch.inference_mode():
        torch.testing.assert_close(camera.convert(key, **options).camera.distortion, known.camera.distortion)


def seen_by(camera, step=37):
    """Its pixels and rays, NaN where there are none."""
    pixels = camera.pixel_grid()[::step, ::step].detach()
    rays, valid = camera.unproject(pixels)
    return pixels, torch.where(valid[..., None], rays.detach(), torch.nan)


# the angles of a table are its own
OWN = {"tabulated"}


@pytest.mark.parametrize("key", slow_unless(DISTINCT.__contains__, [key for key in KEYS if key not in OWN]))
def test_a_camera_is_found_by_its_rays(key):
    camera = one(key).requires_grad_(False)
    if camera.image_size is None:
        camera = type(camera)(camera.intrinsics, camera.distortion, image_size=(480, 640)).double()
    pixels, rays = seen_by(camera)
    found = ct.fit(key, pixels, rays * 2, image_size=camera.image_size, count=camera.distortion.shape[-1])
    assert float(found.rms) < 1e-3


def test_a_batch_of_rays_makes_a_batch_of_cameras():
    cameras = [ct.KannalaBrandt([300.0 + 9 * i, 310, 320, 240], [0.02, -0.01], image_size=SIZE) for i in range(3)]
    pixels, rays = zip(*(seen_by(camera.double()) for camera in cameras), strict=True)
    found = ct.fit(ct.KannalaBrandt, pixels[0], torch.stack(rays))
    assert found.camera.batch_shape == (3,) == found.rms.shape
    for i, camera in enumerate(cameras):
        torch.testing.assert_close(found.camera.intrinsics[i], camera.intrinsics, rtol=1e-6, atol=1e-6)


def test_weights_leave_out_what_is_wrong():
    camera = ct.KannalaBrandt([300.0, 310, 320, 240], [0.02, -0.01, 0, 0], image_size=(480, 640)).double()
    pixels, rays = seen_by(camera)
    weights = torch.ones(rays.shape[:-1])
    weights[:5] = 0
    rays[:5] = rays[:5].flip(1)
    found = ct.fit("kannala_brandt", pixels, rays, weights=weights)
    torch.testing.assert_close(found.camera.intrinsics, camera.intrinsics, rtol=1e-6, atol=1e-6)
    assert float(found.max_error) < 1e-5
    assert float(ct.fit("kannala_brandt", pixels, rays).rms) > 1


def test_the_noise_of_a_network_averages_out():
    # low-resolution rays in float32, each off by half a degree, some far off and known to be so
    camera = ct.KannalaBrandt.from_fov(120, image_size=(480, 640)).requires_grad_(False)
    pixels = camera.pixel_grid(stride=8)
    truth = camera.unproject(pixels)[0]
    rays = truth + radians(0.5) * torch.randn(60, 80, 3)
    confidence = torch.rand(60, 80)
    rays[:10, :10], confidence[:10, :10] = torch.tensor([0.0, 0.0, 1.0]), 0.0
    found = ct.fit("kannala_brandt", pixels, rays, weights=confidence, image_size=(480, 640), fixed=("k3", "k4"))
    again, valid = found.camera.unproject(pixels.double())
    off = torch.rad2deg(2 * torch.asin((again - truth.double()).norm(dim=-1) / 2))
    assert valid.all()
    assert off.max() < 0.15
    assert off.mean() < 0.05  # of 0.6 degrees a ray


def test_learning_rays_of_float32_arrays():
    camera = ct.Pinhole([300.0, 310, 320, 240], image_size=(480, 640))
    pixels, rays = seen_by(camera)
    found = ct.fit("pinhole", pixels.numpy(), rays.clone().requires_grad_(), image_size=(480, 640)).camera
    torch.testing.assert_close(found.intrinsics.float(), camera.intrinsics, rtol=1e-5, atol=1e-3)
    assert found.intrinsics.requires_grad
    assert found.image_size == (480, 640)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p, r: (p, r[..., :2]), "rays"),
        (lambda p, r: (p[:2], r), "pixels must be"),
        (lambda p, r: (p, -r), "OpenGL"),
        (lambda p, r: (p[0, :3], r[0, :3]), "at least 4 finite"),
        (lambda p, r: (p[0, :0], r[0, :0]), "at least 4 finite"),
        (lambda p, r: (p, torch.full_like(r, math.nan)), "at least 4 finite"),
    ],
)
def test_what_cannot_be_fitted_is_said(change, words):
    camera = ct.Pinhole([300.0, 310, 320, 240], image_size=(480, 640)).double()
    with pytest.raises(ValueError, match=words):
        ct.fit("pinhole", *change(*seen_by(camera)))
