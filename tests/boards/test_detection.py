"""Boards in images: what is found is where it is, and numbered as it is."""

import cv2
import numpy as np
import pytest
from photographs import fisheye, photograph

from camtorch.boards import detection
from camtorch.boards.boards import AprilGrid, Charuco, Chessboard, board_of
from camtorch.boards.detection import detect

BOARDS = [Chessboard(9, 6, 0.03), Charuco(9, 7, 0.03, 0.022, "4X4_50"), AprilGrid(5, 4, 0.05)]
BOARDS += [Charuco(8, 6, 0.035, 0.026, "6X6_250", legacy=True), AprilGrid(4, 4, 0.06, 0.25, border=1)]


def named(board):
    return f"{board.kind}-{board.columns}x{board.rows}"


@pytest.mark.parametrize("board", BOARDS, ids=named)
@pytest.mark.parametrize(
    "pose",
    [
        pytest.param(((0.1, -0.3, 0.1), (-0.12, -0.1, 0.25)), id="upright"),
        pytest.param(((-0.5, 0.2, 2.9), (0.16, 0.1, 0.3)), id="turned", marks=pytest.mark.slow),
    ],
)
def test_points_are_found_where_they_are(board, pose):
    image, truth = photograph(board, fisheye(), *pose)
    found = detect(board, image)
    assert found.reason == ""
    seen = np.isfinite(found.pixels).all(-1)
    assert seen.mean() >= 0.9
    errors = np.linalg.norm(found.pixels - truth, axis=-1)[seen]
    assert np.sqrt((errors**2).mean()) < 0.15
    assert errors.max() < 0.6


@pytest.mark.parametrize("board", BOARDS[1:3], ids=named)
def test_a_part_of_a_board_with_markers_is_enough(board):
    image, truth = photograph(board, fisheye(), (0.1, -0.3, 0.1), (-0.12, -0.1, 0.25))
    image[:, 330:] = 128
    pixels = detect(board, image).pixels
    seen = np.isfinite(pixels[:, 0])
    assert 0.2 < seen.mean() < 0.8
    assert np.linalg.norm(pixels - truth, axis=-1)[seen].max() < 0.6


def test_chessboards_keep_their_order_however_they_are_turned():
    board = BOARDS[0]
    assert not board.is_symmetric
    for roll in (0.3, 0.3 + np.pi):
        middle = 0.12 * np.array([np.cos(roll), np.sin(roll)]) - 0.075 * np.array([-np.sin(roll), np.cos(roll)])
        image, truth = photograph(board, fisheye(), (0.0, 0, roll), (*-middle, 0.3))
        assert np.abs(detect(board, image).pixels - truth).max() < 0.6


@pytest.mark.parametrize(
    ("columns", "rows"), [(6, 6), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((7, 5), (5, 5)))]
)
def test_ambiguous_chessboards_begin_near_the_top_left(columns, rows):
    board = Chessboard(columns, rows, 0.03)
    assert board.is_symmetric
    for roll in (0.2, -0.3):
        image, truth = photograph(board, fisheye(), (0.1, 0.1, roll), (-0.09, -0.06, 0.3))
        assert np.abs(detect(board, image).pixels - truth).max() < 0.6
        if columns != rows:
            turned = detect(board, image[::-1, ::-1].copy()).pixels  # the half turn of an image is that of its order
            assert np.abs((639, 479) - turned[::-1] - truth).max() < 0.6


@pytest.mark.slow
def test_deep_and_large_images():
    board = BOARDS[0]
    image, truth = photograph(board, fisheye(), (0.1, -0.3, 0.1), (-0.12, -0.1, 0.25))
    plain = detect(board, image).pixels
    assert np.abs(detect(board, 40 * image.astype(np.uint16)).pixels - plain).max() < 0.1
    large = cv2.resize(image, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    assert np.abs((detect(board, large).pixels + 0.5) / 4 - 0.5 - truth).max() < 0.6


@pytest.mark.parametrize("board", BOARDS[:3], ids=named)
def test_nothing_is_found_where_nothing_is(board):
    noise = np.random.default_rng(0).integers(0, 256, (120, 160), dtype=np.uint8)
    for image in (noise[:60, :80], np.zeros_like(noise)):
        found = detect(board, image)
        assert found.reason == "no board found"
        assert np.isnan(found.pixels).all()
        assert found.pixels.shape == (len(board.points()), 2)


def test_noisy_and_blurred_chessboards_are_found_no_worse_than_by_their_sectors():
    board = BOARDS[0]
    image, truth = photograph(board, fisheye(), (0.1, -0.3, 0.1), (-0.12, -0.1, 0.25), noise=0)
    sharp = detect(board, image).pixels
    assert np.sqrt(((sharp - truth) ** 2).sum(-1).mean()) < 0.06  # half of what the sectors alone give
    noise = np.random.default_rng(0).normal(0, 20, image.shape)
    noisy = np.clip(cv2.GaussianBlur(image, (0, 0), 2.0) + noise, 0, 255).astype(np.uint8)
    # gradients alone: 0.6
    assert np.sqrt(((detect(board, noisy).pixels - truth) ** 2).sum(-1).mean()) < 0.35


def test_corners_that_opencv_puts_beside_their_rows_are_mended(monkeypatch):
    board, rng, found_by = BOARDS[0], np.random.default_rng(0), cv2.findChessboardCornersSB
    image, truth = photograph(board, fisheye(), (0.1, -0.3, 0.1), (-0.12, -0.1, 0.25))

    def off(*arguments, **options):
        found, corners = found_by(*arguments, **options)
        corners.reshape(-1, 2)[[0, 30, 53]] += 9 * rng.choice((-1, 1), (3, 2))
        return found, corners

    monkeypatch.setattr(cv2, "findChessboardCornersSB", off)
    pixels = detect(board, image).pixels
    seen = np.isfinite(pixels[:, 0])
    assert seen.sum() >= 53
    assert np.abs(pixels - truth)[seen].max() < 0.2


def test_too_little_of_a_board_has_a_reason():
    board = BOARDS[1]
    image, truth = photograph(board, fisheye(), (0.0, 0, 0), (-0.12, -0.1, 0.25))
    row = truth.reshape(6, 8, 2)[2, :, 1].mean()
    image[: int(row) - 40], image[int(row) + 40 :] = 128, 128
    assert "on one line" in detect(board, image).reason
    image[:, 260:] = 128
    assert detect(board, image).reason.startswith("only ")


def test_opencv_4_has_corners_of_charuco_half_a_pixel_off():
    image, truth = photograph(BOARDS[1], fisheye(), (0.1, -0.3, 0.1), (-0.12, -0.1, 0.25))
    corners = truth + np.random.default_rng(0).normal(0, 0.1, truth.shape)
    for off in (0, 0.5):
        assert np.allclose(detection._from_centres(cv2, image, corners + off), corners)


def test_tags_may_be_turned_on_their_board():
    board = BOARDS[2]
    whole, points = np.full((900, 900), 255, np.uint8), board.points()[:, :2]
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for tag in range(20):
        x, y = np.rint(2400 * points[board.corners_of(tag)[0]]).astype(int) + 40
        whole[y : y + 120, x : x + 120] = np.rot90(dictionary.generateImageMarker(tag, 120, borderBits=2))
    pixels = detect(board, whole).pixels
    assert np.abs(pixels - (2400 * points + 39.5)).max() < 1


def test_tags_that_are_no_part_of_the_board_are_left_out():
    board = BOARDS[2]
    image, truth = photograph(board, fisheye(), (0.1, -0.3, 0.1), (-0.12, -0.1, 0.25))
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners = truth[list(board.corners_of(7))]
    cv2.fillConvexPoly(image, np.rint(corners).astype(np.int32), 255)
    image[380:460, 20:100] = 255
    image[390:450, 30:90] = dictionary.generateImageMarker(7, 60, borderBits=2)
    pixels = detect(board, image).pixels
    assert np.isnan(pixels[list(board.corners_of(7))]).all()
    seen = np.isfinite(pixels[:, 0])
    assert seen.mean() > 0.8
    assert np.linalg.norm(pixels - truth, axis=-1)[seen].max() < 0.6


@pytest.mark.parametrize("board", BOARDS, ids=named)
def test_boards_are_made_again_of_their_options(board):
    assert board_of(board.options()) == board
    assert len(board.points()) == board.grid[0] * board.grid[1]
    if board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        theirs = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
        assert np.allclose(theirs.getChessboardCorners(), board.points(), atol=1e-7)
    rows = board.points().reshape(*board.grid, 3)
    assert (np.diff(rows[..., 0], axis=1) > 0).all()
    assert (np.diff(rows[..., 1], axis=0) > 0).all()


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Chessboard(2, 6), "at least 3x3 inner corners are needed; got 2x6"),
        (lambda: Chessboard(9, 6, 0.0), "must be positive"),
        (lambda: Chessboard(9, 6, float("nan")), "must be positive"),
        (lambda: AprilGrid(6, 6, 0.03, spacing=0), "above 0 and at most 2; got 0"),
        (lambda: AprilGrid(6, 6, 0.03, border=0), "1, 2 or 3 cells; got 0"),
        (lambda: board_of({"type": "circles"}), "one of chessboard, charuco, aprilgrid; got 'circles'"),
    ],
)
def test_bad_boards(make, text):
    with pytest.raises(ValueError, match=text):
        make()
