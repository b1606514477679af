"""What must hold of calibrations: the optimum from nothing, the same for all forms and orders, outliers named."""

import copy
import gzip
import math
import pickle

import pytest
import torch
from boards import opencv_left, ov_plane, seen_by
from cameras import DISTINCT, one, slow_unless
from rigs import FILES
from torch.testing import assert_close

import camtorch as ct
from camtorch.poses.rotations import rotation_matrix

LEFT, OPTIMA = opencv_left()
slow = pytest.mark.slow
exactly = {"rtol": 0.0, "atol": 0.0, "equal_nan": True}


def values(calibration):
    camera = calibration.camera
    return torch.cat((camera.intrinsics, camera.distortion), -1).detach()


def calibrate(corners, model="brown_conrady", **options):
    return ct.calibrate(model, corners.object_points, corners.image_points, image_size=corners.image_size, **options)


@pytest.mark.parametrize(("count", "part"), [(5, 1e-3), pytest.param(8, 1e-2, marks=slow)])
def test_opencvs_optimum_from_nothing(count, part, left):
    """OpenCV stops a little earlier: eight coefficients have a condition of 1e10."""
    optimum = OPTIMA[count]
    found = left if count == 5 else calibrate(LEFT, count=count)
    assert found.converged
    assert found.rms == pytest.approx(float(optimum["rms"]), abs=1e-6)
    truth = torch.cat((optimum["intrinsics"], optimum["distortion"]))
    assert bool(((values(found) - truth).abs() < part * optimum["std"]).all())
    assert_close(found.std, optimum["std"], rtol=1e-2 * 10 ** (count > 5), atol=0)
    assert found.parameter_names[:4] == ("fx", "fy", "cx", "cy")
    assert len(found.parameter_names) == 4 + count
    rotations, theirs = (rotation_matrix(t) for t in (found.extrinsics.rotation, optimum["rotations"].view(13, 3)))
    assert_close(rotations.detach(), theirs, rtol=0, atol=1e-4 if count > 5 else 1e-6)
    assert_close(found.extrinsics.translation.detach(), optimum["translations"].view(13, 3), rtol=0, atol=1e-5)


def test_numbers_agree_with_the_residuals(left):
    squares = left.residuals.square().sum()
    count = 13 * 54
    assert left.rms == pytest.approx(float((squares / count).sqrt()), rel=1e-12)
    assert left.sigma == pytest.approx(float((squares / (2 * count - 9 - 6 * 13)).sqrt()), rel=1e-12)
    assert_close(left.std, left.covariance.diagonal().sqrt(), rtol=1e-9, atol=0)
    board = LEFT.object_points.expand(13, -1, -1)
    pixels, valid = left.camera.project(left.extrinsics(board))
    assert valid.all()
    assert_close(left.residuals, (pixels - LEFT.image_points).detach(), rtol=0, atol=1e-9)
    assert left.inliers.all()


@pytest.mark.parametrize(
    ("bend", "infinity", "near"),
    [
        # drcal 0.0.0 (mrcal) on the same corners: LENSMODEL_OPENCV5, without regularisation, mean-pcam
        (None, (0.13531484, 5.85650548, 2.64013932), (0.04614336, 5.88096998, 2.65341868)),
        pytest.param(
            (2.92625783e-05, -1.75310142e-04),
            (0.13034116, 5.24030511, 2.44796354),
            (0.04433168, 5.25551759, 2.4513902),
            marks=slow,
        ),
    ],
)
def test_uncertainty_is_that_of_mrcal(bend, infinity, near, left):
    """Whose noise is the root of the mean square, which does not count the parameters."""
    found = left if bend is None else calibrate(LEFT, bend=True)
    assert found.bend == pytest.approx(bend or (0.0, 0.0), rel=1e-4)
    pixels, share = torch.tensor([(320.0, 240), (20, 20), (620, 460)]).double(), found.rms / math.sqrt(2) / found.sigma
    for distance, expected in ((math.inf, infinity), (0.5, near)):
        assert_close(share * found.uncertainty(pixels, distance), torch.tensor(expected).double(), rtol=1e-4, atol=0)


def test_uncertainty_takes_any_shape_of_pixels(left):
    grid = torch.stack(torch.meshgrid(torch.arange(0, 640, 40), torch.arange(0, 480, 40), indexing="xy"), -1)
    whole, distances = left.uncertainty(grid), torch.full((12, 16), math.inf)
    assert whole.shape == (12, 16)
    assert torch.equal(whole[3, 5], left.uncertainty((200, 120)))
    assert left.uncertainty(torch.zeros(0, 2)).shape == (0,)
    distances[3, 5] = 0.3
    mixed = left.uncertainty(grid.float(), distances)
    assert mixed[3, 5] == left.uncertainty((200, 120), 0.3) != whole[3, 5]
    assert mixed[0, 0] == whole[0, 0]
    assert torch.equal(whole.isnan(), ~left.camera.unproject(grid.double())[1])
    for pixels, distance, words in (
        ((1.0, 2.0, 3.0), 1.0, r"pixels must be \(\.\.\., 2\); got shape \(3,\)"),
        ((1.0, 2.0), 0.0, "distance must be positive"),
        ((1.0, 2.0), math.nan, "distance must be positive"),
    ):
        with pytest.raises(ValueError, match=words):
            left.uncertainty(pixels, distance)


def test_results_are_without_a_graph_but_go_on_learning(left):
    for value in (left.residuals, left.inliers, left.covariance, left.std, left.uncertainty([[320.0, 240.0]])):
        assert not value.requires_grad
    camera, extrinsics = copy.deepcopy((left.camera, left.extrinsics))
    points = extrinsics(LEFT.object_points.expand(13, -1, -1))
    (camera.project(points)[0] - LEFT.image_points).square().mean().backward()
    parameters = [*camera.parameters(), *extrinsics.parameters()]
    assert len(parameters) == 4
    assert all(p.grad.isfinite().all() for p in parameters)
    # at the optimum the gradient vanishes
    assert bool((camera.intrinsics.grad.abs() * left.std[:4] < 1e-6).all())
    assert bool((camera.distortion.grad.abs() * left.std[4:] < 1e-6).all())


@slow
@pytest.mark.parametrize("of", ["views", "corners"])
def test_orders_and_frames_do_not_matter(of, left):
    """The corners of the file are rounded to float32's nine digits."""
    points, pixels, draw = LEFT.object_points, LEFT.image_points, torch.Generator().manual_seed(1)
    views, corners = torch.arange(13), torch.arange(54)
    if of == "views":
        views = torch.randperm(13, generator=draw)
    else:  # in millimetres, turned, and far from the origin
        corners = torch.randperm(54, generator=draw)
        turn = rotation_matrix(torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64))
        points = 1000 * points @ turn.mT + torch.tensor([2000.0, -500.0, 900.0])
    found = calibrate(LEFT._replace(object_points=points[corners], image_points=pixels[views][:, corners]))
    assert bool(((values(found) - values(left)).abs() < 1e-4 * left.std).all())
    assert_close(found.residuals, left.residuals[views][:, corners], rtol=0, atol=1e-4)


@slow
def test_corners_may_be_missing(left):
    pixels = LEFT.image_points.clone()
    hidden = torch.rand(13, 54, generator=torch.Generator().manual_seed(3)) < 0.3
    pixels[hidden] = torch.nan
    found = ct.calibrate("brown_conrady", LEFT.object_points, pixels, image_size=LEFT.image_size)
    assert_close(found.residuals.isnan().any(-1), hidden)
    assert not found.inliers[hidden].any()
    assert found.inliers[~hidden].all()
    # what is hidden carries no information, so that the other corners' optimum lies within the noise
    assert bool(((values(found) - values(left)).abs() < 3 * found.std).all())
    ragged = [points[~missing] for points, missing in zip(LEFT.object_points.expand(13, -1, -1), hidden, strict=True)]
    seen = [view[~missing] for view, missing in zip(LEFT.image_points, hidden, strict=True)]
    listed = ct.calibrate("brown_conrady", ragged, seen, image_size=LEFT.image_size)
    assert bool(((values(listed) - values(found)).abs() < 1e-6 * found.std).all())
    assert [tuple(t.shape) for t in listed.residuals] == [tuple(t.shape) for t in seen]


def test_fixed_coefficients():
    found = calibrate(LEFT._replace(image_points=LEFT.image_points[:5]), fixed=("cx", "k3", "p1"))
    named = dict(zip(found.parameter_names, zip(values(found).tolist(), found.std.tolist(), strict=True), strict=True))
    assert named["k3"] == (0.0, 0.0)
    assert named["p1"] == (0.0, 0.0)
    assert named["cx"] == (319.5, 0.0)  # the middle of the image, whose first pixel is at 0
    assert all(std > 0 for name, (_, std) in named.items() if name not in ("cx", "k3", "p1"))


def test_what_is_held_or_frozen_at_its_best_value_changes_no_other(left):
    for model, options, names in (
        ("brown_conrady", {"start": left.camera, "fixed": ("k1",)}, ["k1"]),
        (copy.deepcopy(left.camera).freeze("cx", "k1"), {}, ["cx", "k1"]),
        (left.camera, {"fixed": "all"}, list(left.parameter_names)),
    ):
        held = calibrate(LEFT, model, **options)
        assert bool(((values(held) - values(left)).abs() < 1e-4 * left.std).all())
        assert [name for name, std in zip(held.parameter_names, held.std.tolist(), strict=True) if std == 0] == names
        assert bool((held.std <= left.std * (1 + 1e-6)).all())
        assert held.rms == pytest.approx(left.rms, abs=1e-9)
        assert_close(held.extrinsics.translation, left.extrinsics.translation, rtol=0, atol=1e-6)
        assert ("frozen=(cx, k1)" in repr(held.camera)) == (not options)
    assert_close(values(held), values(left), **exactly)


@pytest.mark.parametrize("loss", [pytest.param("huber", marks=slow), "cauchy"])
def test_gross_outliers(loss, left):
    """One corner in ten is 5 to 60 px off."""
    wrong = torch.zeros(13 * 54, dtype=torch.bool)
    wrong[torch.randperm(13 * 54)[:70]] = True
    wrong = wrong.view(13, 54)
    angle = 2 * math.pi * torch.rand(13, 54)
    length = 5 + 55 * torch.rand(13, 54)
    pixels = LEFT.image_points + (wrong * length)[..., None] * torch.stack((angle.cos(), angle.sin()), -1)
    found = calibrate(LEFT._replace(image_points=pixels), loss=loss, loss_scale=0.3)
    assert bool(((values(found) - values(left)).abs() < 3 * left.std).all())
    assert float((~found.inliers[wrong]).double().mean()) >= 0.99
    assert float(found.inliers[~wrong].double().mean()) >= 0.98
    # their noise is no part of sigma
    assert found.sigma < 1.3 * left.sigma


@slow
@pytest.mark.parametrize(
    ("model", "trained", "tested"),
    [
        (ct.KannalaBrandt, 0.4816, 0.4747),
        ("eucm", 0.49141, 1.01 * 0.49141),
        # the grid was chosen by two-fold cross-validation over the training views; it beats kannala_brandt
        (ct.Splined.with_grid(columns=12, rows=11, fov_x=200), 0.427, 0.43),
    ],
)
def test_fisheyes_past_their_plane(model, trained, tested):
    """OV-plane, rays to 93 degrees: as good as the least squares that are known, and on images that it never saw."""
    train, test = ov_plane("train"), ov_plane("test")
    is_surface = not isinstance(model, str) and model.smoothness() is not None
    start = {"start": calibrate(train, model="kannala_brandt").camera} if is_surface else {}
    found = calibrate(train, model=model, **start)
    assert found.converged
    assert found.rms <= trained
    poses = calibrate(test, model=found.camera, fixed="all")
    assert poses.rms <= tested
    _, rms, valid = ct.solve_pnp(found.camera, test.object_points.expand(7, -1, -1), test.image_points)
    assert valid.all()
    seen = (~test.image_points.isnan().any(-1)).sum(-1)
    assert float(((rms.detach().square() * seen).sum() / seen.sum()).sqrt()) == pytest.approx(poses.rms, rel=1e-6)


# their parameters can be exchanged for others: a turn about the axis of a panorama for its principal point
FREE_TO_TURN = {"cylindrical", "equirectangular", "latlon", "transverse_cylindrical", "ocamcalib", "tabulated"}


FORMS = [(key, "float32") for key in sorted(DISTINCT | {"cylindrical", "tabulated"})]
FORMS += [("kannala_brandt", "float64"), ("kannala_brandt", "float32 poses")]


@pytest.mark.parametrize(("key", "form"), slow_unless(FORMS[-1].__eq__, FORMS))
def test_corners_without_noise_have_an_optimum(key, form):
    """Whatever their last bits: where rounding hides what is left to gain, the search has ended."""
    lens = one(key)
    corners, rotations, translations = seen_by(lens, 10, columns=7, rows=6, square=0.03, seed=3)
    pixels, dtype = corners.image_points, torch.float32 if form == "float32" else torch.float64
    if form == "float32 poses":  # their rotations are none to the last digits, and no camera fits them exactly
        points = corners.object_points @ rotations.float().double().mT + translations[:, None]
        pixels = torch.where(pixels.isnan(), torch.nan, lens.project(points)[0].detach())
    ulps = torch.randint(-2, 3, pixels.shape, generator=torch.Generator().manual_seed(0))
    pixels = (pixels.to(dtype) * (1 + ulps * torch.finfo(dtype).eps)).to(dtype)
    corners = corners._replace(image_points=pixels)
    found = calibrate(corners, model=key, count=lens.distortion.shape[-1] or None)
    assert found.converged
    # four last bits, or what single precision does to a rotation
    largest = float(pixels[~pixels.isnan()].abs().amax())
    assert found.rms < 4 * torch.finfo(torch.float64 if form == "float64" else torch.float32).eps * largest + 1e-11
    if key not in FREE_TO_TURN:
        truth = torch.cat((lens.intrinsics, lens.distortion)).detach()
        # no noise has a spread, and what float32 does to a rotation is the same for all corners of a view
        precise = {"float64": 1e-9, "float32": 1e-9, "float32 poses": 2e-6}[form] * truth.abs().amax()
        assert bool(((values(found) - truth).abs() <= precise + 6 * found.std).all())
    said = " ".join(found.warnings)
    assert not any(words in said for words in ("did not end", "pattern", "worse than", "outlier", "does not quite fit"))


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"count": 3}, ValueError, "got 3"),
        ({"model": "kannala_brandt", "count": 10**9}, ValueError, "got 1000000000"),
        ({"fixed": ("k9",)}, ValueError, "k9"),
        ({"fixed": ("fx",)}, ValueError, "start"),
        ({"fixed": None}, TypeError, "fixed must be names"),
        ({"fixed": {"cx": 320.0}}, TypeError, "fixed must be names"),
        ({"loss": "tukey"}, ValueError, "tukey"),
        ({"loss": "huber", "loss_scale": 0.0}, ValueError, "loss_scale"),
        ({"loss": "huber", "loss_scale": "1"}, TypeError, "loss_scale must be a number"),
        ({"bend": "no"}, TypeError, "bend must be True or False"),
        ({"start": ct.KannalaBrandt([500.0, 500.0, 320.0, 240.0])}, ValueError, "start must be one BrownConrady.*Kan"),
        ({"start": "camera.yml"}, TypeError, "start must be a camera; got str; ct.load"),
        ({"model": ct.Pinhole(torch.ones(2, 4))}, ValueError, r"start must be one Pinhole.*batch_shape=\(2,\)"),
    ],
)
def test_bad_arguments(changes, error, words):
    given = {"model": "brown_conrady", "object_points": LEFT.object_points, "image_points": LEFT.image_points}
    given |= {"image_size": LEFT.image_size, **changes}
    with pytest.raises(error, match=rf"^calibrate:? .*{words}"):
        ct.calibrate(given.pop("model"), given.pop("object_points"), given.pop("image_points"), **given)


@slow
def test_contexts_of_torch(left):
    """Tensors that are made inside lie where those lie that came in."""
    with torch.device("meta"):
        found = calibrate(LEFT)
        assert str(found) == str(left)
    with torch.inference_mode():
        assert str(calibrate(LEFT)) == str(left)
    assert_close(values(found), values(left), **exactly)


@pytest.mark.parametrize("fov_x", [92, pytest.param(60, marks=slow)])
def test_a_surface_is_learnt_to_the_noise_and_one_that_ends_before_the_corners_says_so(fov_x):
    """Less than a cell before them, and far."""
    noise, draw = 0.1, torch.Generator().manual_seed(1)
    model = ct.Splined.with_grid(columns=8, rows=7, fov_x=100)
    bumps = 0.01 * torch.randn(model.default_count, generator=draw, dtype=torch.float64)
    true = model(torch.tensor([300.0, 300, 319.5, 199.5], dtype=torch.float64), bumps, image_size=(400, 640))
    (board, seen, _), turns, shifts = seen_by(true, 14, noise=noise, columns=11, rows=8, square=0.03, far=0.3)
    points = board @ turns.mT + shifts[:, None]
    _, valid = true.project(points * torch.tensor([1.06, 1.06, 1.0]))  # as the found one may stand a little askew
    seen[~valid] = torch.nan

    def learnt(kind):
        start = first.convert(kind).camera
        return ct.calibrate(kind, board, seen, image_size=(400, 640), start=start)

    first = ct.calibrate("kannala_brandt", board, seen, image_size=(400, 640)).camera
    found = learnt(model)
    assert found.converged
    assert 0.9 * noise < found.sigma < 1.15 * noise
    with pytest.warns(UserWarning, match=r"(\d+) corners have no pixel"):
        short = learnt(ct.Splined.with_grid(columns=8, rows=7, fov_x=fov_x))
    assert not short.converged
    _, valid = short.camera.project(short.extrinsics(board[None].expand(14, -1, -1)))
    lost = seen.isfinite().all(-1) & ~valid
    assert any(f"{lost.sum()} corners have no pixel" in text for text in short.warnings)
    assert short.adjusted.converged or fov_x == 60
    assert short.residuals[lost].isnan().all()


@pytest.mark.parametrize("order", [pytest.param(2, marks=slow), 3])
def test_a_surface_is_learnt_in_the_frame_of_its_start(order):
    """A surface can do what turns of the camera do; boards turned with it by up to 15 degrees."""
    lens = ct.KannalaBrandt([300.0, 302, 319.5, 199.5], [0.02, -0.01, 0, 0], image_size=(400, 640)).double()
    corners, rotations, _ = seen_by(lens, 18, noise=0.1)
    found = calibrate(corners, model=ct.Splined.with_grid(columns=11, rows=9, fov_x=150, order=order), start=lens)
    assert found.converged
    turned = (found.extrinsics.matrix()[:, :3, :3].detach() @ rotations.mT).mean(0)
    assert_close(turned, torch.eye(3).double(), rtol=0, atol=2e-3)


def test_pickles_of_0_5_0_are_loaded():
    loaded = pickle.loads(gzip.decompress((FILES / "calibrations_0.5.0.pickle.gz").read_bytes()))

    def seen_by(result):
        points, pixels, seen = result.observations
        return points[0], torch.where(seen[..., None], pixels, torch.nan)

    one, rig = loaded["calibrate"], loaded["calibrate_rig"]
    points, pixels = seen_by(one)
    again = ct.calibrate("pinhole", points, pixels, image_size=one.image_size)
    assert_close(one.camera.intrinsics, again.camera.intrinsics)
    assert_close(one.residuals, again.residuals, equal_nan=True)
    assert one.warnings == again.warnings
    image_points = {name: seen_by(result)[1] for name, result in rig.cameras.items()}
    sizes = {name: result.image_size for name, result in rig.cameras.items()}
    rig_again = ct.calibrate_rig(dict.fromkeys(sizes, "pinhole"), points, image_points, image_sizes=sizes)
    assert_close(rig.std, rig_again.std)
    assert rig.warnings == rig_again.warnings
