"""What a calibration says of itself: warnings where data do not carry it, none where they do, and a verdict."""

import re

import pytest
import torch
from boards import chessboard, ov_plane, seen_by
from cameras import slow_unless

import camtorch as ct
from camtorch.calibration import calibrate
from camtorch.poses.rotations import rotation_matrix

F64 = {"dtype": torch.float64}
SIZE = (480, 640)


def lens(kind, intrinsics, *distortion):
    return kind(torch.tensor(intrinsics, **F64), torch.tensor(distortion, **F64), image_size=SIZE)


NARROW = lens(ct.BrownConrady, (530.0, 531, 322, 236), -0.28, 0.09, 0.001, -0.001, 0.05)
FISHEYE = lens(ct.KannalaBrandt, (285.0, 286, 318, 243), -0.05, 0.03, -0.02, 0.004)


def found(model, corners, **options):
    """The calibration of (object points, image points, image size if it is another one)."""
    return ct.calibrate(model, *corners[:2], image_size=corners[2] if len(corners) > 2 else SIZE, **options)


def one(texts, words):
    matching = [text for text in texts if re.search(words, text)]
    assert len(matching) == 1, texts
    return matching[0]


def views(camera, rotations, translations, noise=0.15):
    board = chessboard(9, 6, 0.025)
    with torch.no_grad():
        pixels, valid = camera.project((board - board.mean(0)) @ rotations.mT + translations[:, None])
    pixels = pixels + noise * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0), **F64)
    pixels[~(valid & camera.contains(pixels))] = torch.nan
    return board, pixels


def all_over(count, tilt=0.6, width=0.24, distance=0.4):
    generator = torch.Generator().manual_seed(0)
    turns = (torch.rand(count, 3, generator=generator, **F64) - 0.5) * 2 * tilt
    side = (torch.rand(count, 2, generator=generator, **F64) - 0.5) * torch.tensor([width, 0.75 * width], **F64)
    depth = distance * (0.8 + 0.4 * torch.rand(count, 1, generator=generator, **F64))
    return rotation_matrix(turns), torch.cat((side, depth), -1)


def test_good_data_have_no_warnings():
    result = found("brown_conrady", views(NARROW, *all_over(40, width=0.42)))
    assert result.warnings == []
    assert "!" not in repr(result)
    assert re.match(r"Good for measuring up to 4\d degrees from the optical axis, 100 % of the image", result.verdict)
    assert "Four times as many views" in result.verdict


def test_real_corners(left):
    assert "bottom left, the top left" in one(left.warnings, "28 degrees; .* 41 degrees. The lens is a guess in")
    assert "up to 31 degrees" in left.verdict
    assert "Next, hold the board in the bottom left, the top left and" in left.verdict
    assert all(f"  ! {text}" in repr(left) for text in left.warnings)
    assert repr(left).endswith(left.verdict)


@pytest.mark.slow
def test_what_is_well_is_no_warning():
    corners, *_ = seen_by(FISHEYE, 40, noise=0.15, near=0.1, far=0.3)
    assert not [text for text in found("kannala_brandt", corners).warnings if "the lens ends" in text]
    wide = found("kannala_brandt", ov_plane("train"))
    assert wide.warnings == []
    assert 88 <= int(re.search(r"Good for measuring up to (\d+) degrees", wide.verdict)[1]) <= 92


MIDDLE = ["The lens is a guess in the .*left"]
PARALLEL = ["All boards are parallel to within .*Tilt the board"]
NOT_CARRIED = {
    "corners in the middle": (0.15, {"count": 20, "width": 0.02, "distance": 0.8}, MIDDLE, "up to 1.*Next, hold"),
    "parallel boards": (0.5, {"count": 15, "tilt": 0.1}, PARALLEL, "Tilt the board"),
    "another model": (0.15, {"count": 25}, ["The residuals have a pattern.*brown_conrady"], ""),
    "noise that is no noise": (3.0, {"count": 20}, ["Residuals are 3 px per coordinate"], ""),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", NOT_CARRIED)
def test_what_the_data_do_not_carry(what):
    noise, where, warnings, verdict = NOT_CARRIED[what]
    fixed = ("k3",) if what == "parallel boards" else ()
    model = "pinhole" if what == "another model" else "brown_conrady"
    result = found(model, views(NARROW, *all_over(**where), noise=noise), fixed=fixed)
    for words in warnings:
        one(result.warnings, words)
    assert re.search(verdict, result.verdict)


@pytest.mark.slow
def test_outliers_and_bad_views():
    board, pixels = views(NARROW, *all_over(10))
    pixels[3, 10:20] += 20 * torch.rand(10, 2, **F64)
    pixels[7, 5] += 30
    result = found("brown_conrady", (board, pixels))
    one(result.warnings, 'corners are outliers.* of them in view 3.*loss="cauchy" keeps them')
    one(result.warnings, "The rms of view.* is usual")
    robust = found("brown_conrady", (board, pixels), loss="cauchy", loss_scale=0.5)
    assert "loss=" not in one(robust.warnings, "11 of .* corners are outliers")
    robust = found("brown_conrady", (board, pixels), loss="huber", loss_scale=0.5)
    one(robust.warnings, 'corners are .*loss="huber" results spread up to 1.6 times .*loss="cauchy" they do not')


def test_a_search_that_did_not_end(monkeypatch):
    monkeypatch.setattr(calibrate, "STEPS", 0)
    with pytest.warns(UserWarning, match="did not end at an optimum"):
        result = found("brown_conrady", views(NARROW, *all_over(3)))
    one(result.warnings, "Do not use this camera")
    assert "Do not use this camera" in result.verdict
    assert "NOT CONVERGED" in repr(result)


@pytest.mark.parametrize(
    ("key", "tilt"), slow_unless(("pinhole", 0.5).__eq__, [("pinhole", 0.5), ("brown_conrady", 0.3)])
)
def test_a_single_view_of_a_plane(key, tilt):
    rotation = rotation_matrix(torch.tensor([[tilt, tilt / 2, 0.0]], **F64))
    corners = views(NARROW, rotation, torch.tensor([[0.0, 0, 0.4]], **F64))
    words = r"views must determine the camera; got a single view of this board\. Take 10 to 20 views"
    with pytest.raises(ValueError, match=words) as raised:
        found(key, corners)
    # what it says can be done
    result = found(key, corners, fixed=re.findall(r"'(\w+)'", str(raised.value)))
    one(result.warnings, r"Few views \(1\)")


@pytest.mark.parametrize(("count", "noise"), slow_unless((1, 0.0).__eq__, [(1, 0.0), (2, 0.0), (6, 0.2)]))
def test_planes_across_the_axis(count, noise):
    """However many, they leave the focal length of a pinhole open; without noise too, where sigma tells nothing."""
    pinhole = ct.Pinhole(torch.tensor([530.0, 530, 320, 240], **F64), image_size=SIZE)
    board, pixels = views(pinhole, *all_over(6, tilt=0.0), noise)
    got = "a single view" if count == 1 else f"{count} views"
    with pytest.raises(ValueError, match=f"views must determine the camera; got {got}"):
        found("pinhole", (board, pixels[:count]))


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_copies_of_views_count_once(noise):
    """They widen the uncertainties as if they were missing."""
    board, pixels = views(NARROW, *all_over(5))
    pixels[2, 7] = torch.nan
    alone = ct.calibrate("pinhole", board, pixels[:4], image_size=SIZE)
    again = pixels[:4] + noise * torch.randn(pixels[:4].shape, generator=torch.Generator().manual_seed(5), **F64)
    result = ct.calibrate("pinhole", board, torch.cat((pixels[:4], again)), image_size=SIZE)
    assert len(result.copies) == 4
    assert {copy % 4 for copy in result.copies} == {0, 1, 2, 3}
    torch.testing.assert_close(result.std, alone.std, rtol=0.05, atol=0)
    one(result.warnings, "Copies .*, are views .* count once")
    assert "Take 10 to 20" in one(result.warnings, r"Few views \(4\)")


@pytest.mark.slow
def test_photographs_from_a_tripod_are_no_copies():
    rotations, translations = all_over(4)
    result = found("pinhole", views(NARROW, rotations.repeat(5, 1, 1), translations.repeat(5, 1)))
    assert result.copies == ()
    assert not [text for text in result.warnings if "again" in text]
