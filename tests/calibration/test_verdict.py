"""What a calibration says of itself: warnings where data do not carry it, none where they do, and a verdict."""

import contextlib
import math
import re

import pytest
import torch
from boards import chessboard, opencv_left, ov_plane, seen_by

import camtorch as ct
from camtorch.calibration import calibrate
from camtorch.rotations import rotation_matrix

F64 = {"dtype": torch.float64}
SIZE = (480, 640)


def fisheye():
    return ct.KannalaBrandt(
        torch.tensor([285.0, 286, 318, 243], **F64), torch.tensor([-0.05, 0.03, -0.02, 0.004], **F64), image_size=SIZE
    )


def narrow():
    return ct.BrownConrady(
        torch.tensor([530.0, 531, 322, 236], **F64),
        torch.tensor([-0.28, 0.09, 0.001, -0.001, 0.05], **F64),
        image_size=SIZE,
    )


def found(model, corners, **options):
    return ct.calibrate(model, corners.object_points, corners.image_points, image_size=corners.image_size, **options)


def one(texts, words):
    """The only warning of those words."""
    matching = [text for text in texts if re.search(words, text)]
    assert len(matching) == 1, texts
    return matching[0]


def views(camera, rotations, translations, noise=0.15, seed=0, points=None):
    """Corners of boards at given poses."""
    board = chessboard(9, 6, 0.025) if points is None else points
    with torch.no_grad():
        pixels, valid = camera.project((board - board.mean(0)) @ rotations.mT + translations[:, None])
    generator = torch.Generator().manual_seed(seed)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=generator, **F64)
    pixels[~(valid & camera.contains(pixels))] = torch.nan
    return board, pixels


def all_over(count, tilt=0.6, seed=0, width=0.24, distance=0.4):
    """Poses all over a narrow camera's image."""
    generator = torch.Generator().manual_seed(seed)
    turns = (torch.rand(count, 3, generator=generator, **F64) - 0.5) * 2 * tilt
    side = (torch.rand(count, 2, generator=generator, **F64) - 0.5) * torch.tensor([width, 0.75 * width], **F64)
    depth = distance * (0.8 + 0.4 * torch.rand(count, 1, generator=generator, **F64))
    return rotation_matrix(turns), torch.cat((side, depth), -1)


def test_good_data_have_no_warnings():
    board, pixels = views(narrow(), *all_over(40, width=0.42))
    result = ct.calibrate("brown_conrady", board, pixels, image_size=SIZE)
    assert result.warnings == []
    assert "!" not in repr(result)
    assert result.verdict.startswith("Good for measuring in the whole image, up to 4")
    assert "It needs no more views" in result.verdict


@pytest.mark.slow
def test_a_fisheye_ends_before_its_image_does():
    corners, *_ = seen_by(fisheye(), 40, noise=0.15, near=0.1, far=0.3)
    result = found("kannala_brandt", corners)
    assert not [text for text in result.warnings if "ends inside" in text]


def test_real_corners(left):
    result = left
    assert "top left" in one(result.warnings, "Few corners")
    assert "28 degrees" in one(result.warnings, "Corners reach 2")
    assert "along its y" in one(result.warnings, "bent")
    assert "up to 31 degrees" in result.verdict
    assert "Next, hold the board in the top left" in result.verdict
    assert all(f"  ! {text}" in repr(result) for text in result.warnings)


@pytest.mark.slow
def test_a_bend_that_is_found_is_no_warning():
    bent = found("brown_conrady", opencv_left()[0], bend=True)
    assert not [text for text in bent.warnings if "bent" in text]


@pytest.mark.slow
def test_a_wide_lens_is_known_as_far_as_it_was_seen():
    result = found("kannala_brandt", ov_plane("train"))
    assert len(result.warnings) == 1
    one(result.warnings, "bent")
    degrees = int(re.search(r"Good for measuring up to (\d+) degrees", result.verdict)[1])
    assert 88 <= degrees <= 92


@pytest.mark.slow
def test_corners_in_the_middle():
    board, pixels = views(narrow(), *all_over(20, width=0.02, distance=0.8))
    result = ct.calibrate("brown_conrady", board, pixels, image_size=SIZE)
    assert "the top left" in one(result.warnings, "Few corners or none")
    one(result.warnings, "beyond what was seen the lens is a guess")
    assert "up to 1" in result.verdict
    assert "Next, hold the board in " in result.verdict


@pytest.mark.slow
def test_parallel_boards():
    board, pixels = views(narrow(), *all_over(15, tilt=0.1), noise=0.5)
    result = ct.calibrate("brown_conrady", board, pixels, image_size=SIZE, fixed=("k3",))
    text = one(result.warnings, "All boards are parallel to within .* known to .* % only")
    assert "Tilt the board" in text
    assert "Tilt the board" in result.verdict


@pytest.mark.slow
def test_a_principal_point_that_is_loose():
    rotations, translations = all_over(8, tilt=0.15)
    board, pixels = views(narrow(), rotations, translations, noise=0.5)
    result = ct.calibrate("brown_conrady", board, pixels, image_size=SIZE)
    assert 'fixed=("cx", "cy")' in one(result.warnings, "The principal point is known to")


@pytest.mark.slow
def test_coefficients_that_are_not_needed():
    plain = ct.BrownConrady(torch.tensor([530.0, 531, 322, 236], **F64), image_size=SIZE)
    board, pixels = views(plain, *all_over(20))
    result = ct.calibrate("brown_conrady", board, pixels, image_size=SIZE)
    names = one(result.warnings, "cannot be told from zero")
    assert "k3" in names
    fixed = tuple(re.findall(r'"(\w+)"', names))
    assert not [
        t for t in ct.calibrate("brown_conrady", board, pixels, image_size=SIZE, fixed=fixed).warnings if "k3" in t
    ]


@pytest.mark.slow
def test_a_model_that_is_not_that_of_the_lens():
    board, pixels = views(narrow(), *all_over(25))
    text = one(ct.calibrate("pinhole", board, pixels, image_size=SIZE).warnings, "The residuals have a pattern")
    assert "brown_conrady" in text
    strong = ct.BrownConrady(
        torch.tensor([400.0, 401, 322, 236], **F64),
        torch.tensor([-0.3, 0.08, 0.001, -0.001, 0.02, 0.3, -0.05, 0.01], **F64),
        image_size=SIZE,
    )
    board, pixels = views(strong, *all_over(40, width=0.4), noise=0.03)
    text = one(ct.calibrate("brown_conrady", board, pixels, image_size=SIZE).warnings, "does not quite fit")
    assert "count=8" in text


@pytest.mark.slow
def test_a_bent_board():
    board = chessboard(9, 6, 0.025)
    x, y = ((board - board.mean(0)) / (board - board.mean(0)).amax(0).clamp(min=1e-9))[:, :2].unbind(-1)
    bulge = torch.stack((0 * x, 0 * x, 5e-4 * (1 - x * x) - 2e-4 * (1 - y * y)), -1)
    _, pixels = views(narrow(), *all_over(20), points=board + bulge)
    result = ct.calibrate("brown_conrady", board, pixels, image_size=SIZE)
    shares = r"by ([\d.]+) % of its length along its x and ([\d.]+) % along its y"
    found = [float(share) for share in re.findall(shares, one(result.warnings, "bent"))[0]]
    # by the linear problem
    assert found == pytest.approx([100 * 5e-4 / (8 * 0.025), 100 * 2e-4 / (5 * 0.025)], rel=0.3)


@pytest.mark.slow
def test_outliers_and_bad_views():
    board, pixels = views(narrow(), *all_over(10))
    generator = torch.Generator().manual_seed(1)
    pixels[3, 10:20] += 20 * torch.rand(10, 2, generator=generator, **F64)
    pixels[7, 5] += 30
    result = ct.calibrate("brown_conrady", board, pixels, image_size=SIZE)
    text = one(result.warnings, "corners are outliers")
    assert "of them in view 3" in text
    assert 'loss="huber"' in text
    assert "3" in one(result.warnings, r"fits? worse than the others")
    robust = ct.calibrate("brown_conrady", board, pixels, image_size=SIZE, loss="cauchy", loss_scale=0.5)
    text = one(robust.warnings, "11 of .* corners are outliers")
    assert "loss=" not in text


def test_pixels_are_written_without_exponents():
    from camtorch.calibration.verdict import _px

    assert [_px(value) for value in (0.0512, 9.94, 99.4, 99.6, 512.3)] == [
        "0.051 px",
        "9.9 px",
        "99 px",
        "100 px",
        "512 px",
    ]


@pytest.mark.slow
def test_noise_that_is_no_noise():
    board, pixels = views(narrow(), *all_over(20), noise=3.0)
    one(ct.calibrate("brown_conrady", board, pixels, image_size=SIZE).warnings, "What is left is 3 px per coordinate")


def test_a_search_that_did_not_end(monkeypatch):
    board, pixels = views(narrow(), *all_over(5))
    monkeypatch.setattr(calibrate, "STEPS", 0)
    with pytest.warns(UserWarning, match="did not end at an optimum"):
        result = ct.calibrate("brown_conrady", board, pixels, image_size=SIZE)
    one(result.warnings, "do not use this camera")
    assert "do not use this camera" in result.verdict
    assert "NOT CONVERGED" in repr(result)


@pytest.mark.parametrize(
    ("key", "tilt", "distance"),
    [("pinhole", 0.5, 0.4), pytest.param("brown_conrady", 0.3, 0.4, marks=pytest.mark.slow)],
)
def test_a_single_view_of_a_plane(key, tilt, distance):
    board, pixels = views(
        narrow(),
        rotation_matrix(torch.tensor([[tilt, tilt / 2, 0.0]], **F64)),
        torch.tensor([[0.0, 0, distance]], **F64),
    )
    with pytest.raises(
        ValueError, match=r"a single view of this board leaves .* undetermined\. Take 10 to 20 views"
    ) as raised:
        ct.calibrate(key, board, pixels, image_size=SIZE)
    # what it says can be done
    fixed = re.findall(r'"(\w+)"', str(raised.value))
    result = ct.calibrate(key, board, pixels, image_size=SIZE, fixed=fixed)
    one(result.warnings, "Only 1 view")


@pytest.mark.parametrize(
    ("count", "noise"),
    [
        (1, 0.0),
        pytest.param(6, 0.2, marks=pytest.mark.slow),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((1, 0.2), (2, 0.0), (2, 0.2), (6, 0.0))),
    ],
)
def test_planes_across_the_axis(count, noise):
    """However many, they leave the focal length of a pinhole open; without noise too, where sigma tells nothing."""
    rotations, translations = all_over(6, tilt=0.0)
    pinhole = ct.Pinhole(torch.tensor([530.0, 530, 320, 240], **F64), image_size=SIZE)
    board, pixels = views(pinhole, rotations, translations, noise)
    views_leave = "a single view of this board leaves" if count == 1 else f"these {count} views leave"
    with pytest.raises(ValueError, match=rf"{views_leave} fx\b.* undetermined"):
        ct.calibrate("pinhole", board, pixels[:count], image_size=SIZE)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["equal", "in another order", "saved again"])
def test_copies_of_views_count_once(how):
    board, pixels = views(narrow(), *all_over(5))
    pixels[2, 7] = torch.nan
    alone = ct.calibrate("pinhole", board, pixels[:4], image_size=SIZE)
    again = pixels[:4].clone()
    if how == "saved again":
        again += 0.01 * torch.randn(again.shape, generator=torch.Generator().manual_seed(5), **F64)
    order = torch.arange(len(board)).flip(0) if how == "in another order" else torch.arange(len(board))
    image_points = [*pixels[:4], *again[:, order]]
    object_points = [board] * 4 + [board[order]] * len(again)
    said = contextlib.nullcontext() if how == "saved again" else pytest.warns(UserWarning, match="in views 4, 5, 6, 7")
    with said:
        result = ct.calibrate("pinhole", object_points, image_points, image_size=SIZE)
    assert result.copies == tuple(range(4, 8))
    # saved again they widen what all views say alike
    torch.testing.assert_close(result.std, alone.std, rtol=0.05 if how == "saved again" else 1e-9, atol=0)
    one(result.warnings, "Views 4, 5, 6, 7.* show another view again.* count once")
    assert "Take 10 to 20" in one(result.warnings, "Only 4 views")
    if how != "saved again":
        assert result.views == (0, 1, 2, 3)
        assert result.residuals[4].isnan().all()


@pytest.mark.slow
def test_photographs_from_a_tripod_are_no_copies():
    rotations, translations = all_over(4)
    board, pixels = views(narrow(), rotations.repeat(5, 1, 1), translations.repeat(5, 1))
    result = ct.calibrate("pinhole", board, pixels, image_size=SIZE)
    assert result.copies == ()
    assert not [text for text in result.warnings if "again" in text]


@pytest.mark.slow
def test_a_view_whose_corners_are_in_another_order():
    board, pixels = views(narrow(), *all_over(12))
    pixels[5] = pixels[5, torch.randperm(54, generator=torch.Generator().manual_seed(0))]
    result = ct.calibrate("brown_conrady", board, pixels, image_size=SIZE, loss="huber")
    text = one(result.warnings, "Nearly all corners of view 5 are outliers")
    assert "numbered in another order" in text
    assert "less certain" in text


@pytest.mark.slow
@pytest.mark.parametrize(("xi", "alpha", "focal"), [(-0.18, 0.59, 200.0), (0.3, 0.6, 317.0)])
def test_double_spheres_have_twins(xi, alpha, focal):
    lens = ct.DoubleSphere(
        torch.tensor([focal, focal, 320, 240], **F64), torch.tensor([xi, alpha], **F64), image_size=SIZE
    )
    corners, *_ = seen_by(lens, 12, noise=0.2)
    result = found("double_sphere", corners)
    optima = [result.spread.parameters[0].tolist(), *result.twins]
    assert min(optimum[4] for optimum in optima) < -0.1
    assert max(optimum[4] for optimum in optima) > 0.2
    text = one(result.warnings, "The parameters are not known, though projections are")
    assert all(f"fx {optimum[0]:.4g}, xi {optimum[4]:.4g}" in text for optimum in optima)
    if xi > 0:  # corners without noise tell them apart
        assert found("double_sphere", seen_by(lens, 12)[0]).twins == ()
        assert found("eucm", corners).twins == ()


@pytest.mark.slow
def test_a_rig_says_it_of_each_camera():
    rotations, translations = all_over(4)
    board, left = views(narrow(), rotations, translations)
    _, right = views(narrow(), rotations, translations - torch.tensor([0.05, 0, 0], **F64), seed=1)
    result = ct.calibrate_rig(
        dict.fromkeys(("left", "right"), "brown_conrady"),
        board,
        {"left": left, "right": right},
        image_sizes=dict.fromkeys(("left", "right"), SIZE),
    )
    assert [text.split(":")[0] for text in result.warnings if "Only 4 views" in text] == ["left", "right"]


@pytest.mark.slow
def test_every_model_has_a_verdict():
    corners, _ = opencv_left()
    for key in ("eucm", "division"):
        result = found(key, corners)
        assert math.isfinite(result.sigma)
        assert result.verdict.endswith(".")
        assert "nan" not in " ".join((result.verdict, *result.warnings))
