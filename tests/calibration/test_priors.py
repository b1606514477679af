"""calibrate(prior=...): what is known of a lens makes up for missing views, and does no harm where it is wrong."""

import warnings

import pytest
import torch
from boards import ov_plane, seen_by

import camtorch as ct

SIZE = (720, 1280)
TRUTH = ct.KannalaBrandt(
    torch.tensor([620.0, 621, 640, 362]).double(), torch.tensor([-0.02, 5e-3, -2e-3, 3e-4]).double(), image_size=SIZE
).requires_grad_(False)
# another copy of the lens, calibrated for images of two thirds of the size
COPY = ct.KannalaBrandt(
    torch.tensor([415.5, 416.2, 425.0, 241]).double(),
    torch.tensor([-0.021, 5.5e-3, -2e-3, 3e-4]).double(),
    image_size=(480, 853),
).requires_grad_(False)


def calibrated(views, prior=None, model="kannala_brandt", noise=0.3, seed=1, **options):
    corners, _, _ = seen_by(TRUTH, views, noise=noise, seed=seed)
    return ct.calibrate(model, *corners[:2], image_size=SIZE, prior=prior, **options)


def error_of(camera):
    """Px, root mean square over the image, of what turning the camera cannot mend."""
    lattice = torch.stack(torch.meshgrid(torch.arange(20.0, 1280, 60), torch.arange(20.0, 720, 60), indexing="xy"), -1)
    rays = TRUTH.unproject(lattice.double().reshape(-1, 2))[0]
    mine = camera.unproject(TRUTH.project(rays)[0])[0].detach()
    left, _, right = torch.linalg.svd(mine.mT @ rays)
    off = camera.project(rays @ (left @ right).mT)[0] - TRUTH.project(rays)[0]
    return float(off.detach().square().sum(-1).mean().sqrt())


@pytest.mark.slow
def test_a_prior_makes_up_for_missing_views():
    """Three views with it are better than without, and one is better than the prior itself; both on average."""

    def mean(views, prior):
        return sum(error_of(calibrated(views, prior, seed=seed).camera) for seed in range(1, 7)) / 6

    assert mean(3, COPY) < 0.75 * mean(3, None)
    assert mean(1, COPY) < 0.75 * error_of(COPY.resize(*SIZE))


def test_a_single_view_is_enough_with_a_prior():
    straight = calibrated(1, COPY)
    assert straight.converged
    assert ((straight.camera.intrinsics.detach() - TRUTH.intrinsics).abs() < 3 * straight.std[:4]).all()


def test_many_views_decide():
    alone, found = calibrated(30), calibrated(30, COPY)
    assert float(((found.camera.intrinsics - alone.camera.intrinsics).detach().abs() / alone.std[:4]).max()) < 0.5
    assert (found.std <= 1.2 * alone.std).all()


@pytest.mark.parametrize("views", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_errors_are_as_the_covariance_says(views):
    """Of lenses drawn from the prior that is claimed: focal length, centre, and noise."""
    generator, off = torch.Generator().manual_seed(0), []
    for seed in range(6):
        draw = torch.randn(3, generator=generator).double()
        lens = torch.cat((TRUTH.intrinsics[:2] * (1 + 0.01 * draw[0]), TRUTH.intrinsics[2:] + 0.002 * 1280 * draw[1:]))
        prior = ct.KannalaBrandt(lens, TRUTH.distortion, image_size=SIZE).requires_grad_(False)
        found = calibrated(views, prior, seed=seed)
        off.append((found.camera.intrinsics.detach() - TRUTH.intrinsics) / found.std[:4])
    assert 0.5 < float(torch.stack(off).square().mean().sqrt()) < 1.6


def test_a_family_is_as_narrow_as_its_members_agree():
    generator = torch.Generator().manual_seed(0)
    spread = torch.tensor([1e-3, 1e-3, 1e-3, 1e-3]).double() * TRUTH.intrinsics
    family = [
        ct.KannalaBrandt(
            TRUTH.intrinsics + spread * torch.randn(4, generator=generator).double(), TRUTH.distortion, image_size=SIZE
        ).requires_grad_(False)
        for _ in range(20)
    ]
    narrow, wide = calibrated(1, family), calibrated(1, family[0])
    assert (narrow.std[:4] < wide.std[:4]).all()
    spoilt = [*family, ct.KannalaBrandt.from_fov(150, image_size=SIZE).double().requires_grad_(False)]
    torch.testing.assert_close(calibrated(1, spoilt).std[:4], narrow.std[:4], rtol=0.5, atol=0)


def test_a_wrong_prior_gives_way_and_says_so():
    wrong = ct.KannalaBrandt.from_fov(60, image_size=SIZE).double().requires_grad_(False)
    alone = calibrated(6)
    with pytest.warns(UserWarning, match="the views contradict prior"):
        found = calibrated(6, wrong)
    torch.testing.assert_close(found.camera.intrinsics, alone.camera.intrinsics, rtol=0, atol=0.5)


def test_other_models_and_what_is_held():
    model = TRUTH.convert("double_sphere").camera
    found = calibrated(2, model)
    assert abs(float(found.camera.intrinsics.detach()[0]) - 620) < 10
    held = calibrated(3, TRUTH, fixed=("cx", "k4"))
    assert held.camera.intrinsics[2] == 640
    assert held.camera.distortion[3] == TRUTH.distortion[3]
    assert held.std[[2, 7]].tolist() == [0, 0]
    assert (calibrated(3, TRUTH, fixed="all").std == 0).all()


def test_lenses_of_the_collection():
    lenses = ct.lenses.search("GoPro HERO7 Black wide", image_size=SIZE)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "calibrate: the views contradict prior")
        for prior in (lenses[0], lenses):
            assert abs(float(calibrated(3, prior).camera.intrinsics.detach()[0]) - 620) < 15


@pytest.mark.slow
def test_three_real_views():
    """OV-plane: the error on other images by the usual triple of views is within 1.1 times that by all eighteen."""
    train, test = ov_plane("train"), ov_plane("test")

    def held_out(camera):
        return ct.calibrate(camera, *test[:2], image_size=test.image_size, fixed="all").rms

    whole = ct.calibrate("kannala_brandt", *train[:2], image_size=train.image_size).camera.detach()
    copy = whole.replace(intrinsics=whole.intrinsics * torch.tensor([1.01, 1.01, 1.003, 0.997]).double())
    ratios = {"without": [], "with": []}
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        views = train.image_points[torch.randperm(18, generator=generator)[:3]]
        for name, prior in (("without", None), ("with", copy)):
            found = ct.calibrate("kannala_brandt", train[0], views, image_size=train.image_size, prior=prior)
            ratios[name].append(held_out(found.camera) / held_out(whole))
    median = {name: sorted(of)[2] for name, of in ratios.items()}
    assert median["with"] < 1.1
    assert sum(ratios["with"]) < sum(ratios["without"])


@pytest.mark.parametrize(
    ("prior", "error", "says"),
    [
        (7, TypeError, "prior must be a camera"),
        ("camera.yml", TypeError, r"prior must be a camera, .* got str; ct.load\('camera.yml'\).camera is that of a"),
        ([TRUTH, None], TypeError, "prior must be a camera"),
        (ct.Pinhole(torch.ones(2, 4)), TypeError, "prior must be a camera"),
        ([], ValueError, "prior has no lens"),
        (ct.Pinhole.from_fov(60, image_size=(720, 720)), ValueError, "another aspect ratio"),
    ],
)
def test_bad_priors(prior, error, says):
    with pytest.raises(error, match=rf"calibrate: .*{says}"):
        calibrated(3, prior)
