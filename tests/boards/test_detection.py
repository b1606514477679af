"""Boards in images: what is found is where it is, and numbered as it is."""

import cv2
import numpy as np
import pytest
from photographs import fisheye, photograph
from PIL import Image

import camtorch as ct
from camtorch.boards import detection
from camtorch.boards.boards import AprilGrid, Charuco, Chessboard
from camtorch.boards.detection import detect

BOARDS = [Chessboard(9, 6, 0.03), Charuco(9, 7, 0.03, 0.022, "4X4_50"), AprilGrid(5, 4, 0.05)]
BOARDS += [Charuco(8, 6, 0.035, 0.024, "6X6_250", legacy=True), AprilGrid(4, 4, 0.06, 0.25, border=1)]
POSE = (0.1, -0.3, 0.1), (-0.12, -0.1, 0.25)


def named(board):
    return f"{board.kind}-{board.columns}x{board.rows}"


def errors(board, image, truth, *, least=0.9, most=1.0):
    """Pixels (N,) of the points that are seen, of which there is this part at least."""
    pixels, reason = detect(board, image)
    assert reason == ""
    seen = np.isfinite(pixels[:, 0])
    assert least <= seen.mean() <= most
    return np.linalg.norm(pixels - truth, axis=-1)[seen]


@pytest.mark.parametrize("board", BOARDS, ids=named)
@pytest.mark.parametrize("pose", [POSE, pytest.param(((-0.5, 0.2, 2.9), (0.16, 0.1, 0.3)), marks=pytest.mark.slow)])
def test_points_are_found_where_they_are(board, pose):
    off = errors(board, *photograph(board, fisheye(), *pose))
    assert np.sqrt((off**2).mean()) < 0.15
    assert off.max() < 0.6


@pytest.mark.parametrize("board", BOARDS[1:3], ids=named)
def test_a_part_of_a_board_with_markers_is_enough(board):
    image, truth = photograph(board, fisheye(), *POSE)
    image[:, 330:] = 128
    assert errors(board, image, truth, least=0.2, most=0.8).max() < 0.6


@pytest.mark.parametrize("columns", [9, 6, *(pytest.param(n, marks=pytest.mark.slow) for n in (5, 8))])
def test_chessboards_keep_their_order_however_they_are_turned(columns):
    """If colours tell no order, the first corner is the one nearest to the image's top left."""
    board = Chessboard(columns, 6 if columns != 5 else 5, 0.02)
    assert board.is_symmetric == (columns != 9)
    middle = board.points().mean(0)[:2]
    for roll in (0.2, 0.3 + np.pi) if columns == 9 else (0.2, -0.3):
        turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
        image, truth = photograph(board, fisheye(), (0.0, 0.0, roll), (*(-turn @ middle), 0.22))
        assert errors(board, image, truth, least=1.0).max() < 0.6


@pytest.mark.slow
def test_deep_and_large_images():
    board = BOARDS[0]
    image, truth = photograph(board, fisheye(), *POSE)
    assert np.abs(detect(board, 40 * image.astype(np.uint16))[0] - detect(board, image)[0]).max() < 0.1
    large = cv2.resize(image, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    assert np.abs((detect(board, large)[0] + 0.5) / 4 - 0.5 - truth).max() < 0.6


@pytest.mark.parametrize("board", BOARDS[:3], ids=named)
def test_what_is_no_board_or_too_little_of_one_has_a_reason(board):
    noise = np.random.default_rng(0).integers(0, 256, (120, 160), dtype=np.uint8)
    for image in (noise[:60, :80], np.zeros_like(noise)):
        pixels, reason = detect(board, image)
        assert reason == "no board found"
        assert np.isnan(pixels).all()
        assert pixels.shape == (len(board.points()), 2)
    if isinstance(board, Charuco):
        image, truth = photograph(board, fisheye(), (0.0, 0, 0), POSE[1])
        row = int(truth.reshape(6, 8, 2)[2, :, 1].mean())
        image[: row - 40], image[row + 40 :] = 128, 128
        assert "on one line" in detect(board, image)[1]
        image[:, 260:] = 128
        assert detect(board, image)[1].startswith("only ")


def test_noisy_and_blurred_chessboards_are_found_no_worse_than_by_their_sectors():
    board = BOARDS[0]
    image, truth = photograph(board, fisheye(), *POSE, noise=0)
    assert np.sqrt((errors(board, image, truth) ** 2).mean()) < 0.06  # half of what the sectors alone give
    noise = np.random.default_rng(0).normal(0, 20, image.shape)
    noisy = np.clip(cv2.GaussianBlur(image, (0, 0), 2.0) + noise, 0, 255).astype(np.uint8)
    assert np.sqrt((errors(board, noisy, truth) ** 2).mean()) < 0.35  # gradients alone: 0.6


def test_corners_that_opencv_puts_beside_their_rows_are_mended(monkeypatch):
    board, rng, found_by = BOARDS[0], np.random.default_rng(0), cv2.findChessboardCornersSB
    image, truth = photograph(board, fisheye(), *POSE)

    def off(*arguments, **options):
        found, corners = found_by(*arguments, **options)
        corners.reshape(-1, 2)[[0, 30, 53]] += 9 * rng.choice((-1, 1), (3, 2))
        return found, corners

    monkeypatch.setattr(cv2, "findChessboardCornersSB", off)
    assert errors(board, image, truth, least=53 / 54).max() < 0.2


def test_opencv_4_has_corners_of_charuco_half_a_pixel_off():
    image, truth = photograph(BOARDS[1], fisheye(), *POSE)
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
    assert errors(board, whole, 2400 * points + 39.5, least=1.0).max() < 1


def test_tags_that_are_no_part_of_the_board_are_left_out():
    board = BOARDS[2]
    image, truth = photograph(board, fisheye(), *POSE)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    cv2.fillConvexPoly(image, np.rint(truth[board.corners_of(7)]).astype(np.int32), 255)
    image[380:460, 20:100] = 255
    image[390:450, 30:90] = dictionary.generateImageMarker(7, 60, borderBits=2)
    assert np.isnan(detect(board, image)[0][board.corners_of(7)]).all()
    assert errors(board, image, truth, least=0.8).max() < 0.6


@pytest.mark.parametrize("board", BOARDS, ids=named)
def test_points_are_row_by_row_as_opencv_has_them(board):
    if isinstance(board, Charuco):
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        theirs = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
        assert np.allclose(theirs.getChessboardCorners(), board.points(), atol=1e-7)
    x, y, z = board.points().T
    assert np.array_equal(np.lexsort((x.round(9), y.round(9))), np.arange(len(x)))
    assert not z.any()


@pytest.mark.parametrize(
    ("words", "options", "text"),
    [
        ("2x6", {}, "a board must have at least 3x3 inner corners; got Chessboard.columns=2, rows=6"),
        ("9x6", {"square": float("nan")}, "positive, finite lengths"),
        ("9x6", {"spacing": 0.3}, "chessboard options must be none; got spacing"),
        ("charuco 5x7", {"square": 0.02, "marker": 0.03}, "markers smaller than its squares"),
        ("aprilgrid 6x6", {"spacing": 0}, "spacing above 0, at most 2"),
        ("aprilgrid 6x6", {"border": 0}, "1, 2 or 3 cells"),
        ("circles 6x6", {}, "one of chessboard, charuco, aprilgrid; got 'circles'"),
        ("charuco 5x7", {"dictionary": "x"}, "dictionary must be one of 4x4_100"),
    ],
)
def test_bad_boards(words, options, text):
    with pytest.raises(ValueError, match=text):
        ct.find_board(np.zeros((80, 80), np.uint8), words, **options)


# -- images in any form to what `ct.calibrate` takes

CHESSBOARD = Chessboard(9, 6, 0.03)
POSES = [POSE, ((-0.3, 0.2, 0.0), (-0.1, -0.08, 0.3)), ((0.2, 0.3, -0.1), (-0.15, -0.05, 0.28))]


@pytest.fixture(scope="module")
def views():
    return [photograph(CHESSBOARD, fisheye(), *pose) for pose in POSES]


def test_paths_and_arrays_give_the_same_and_calibrate(views, tmp_path):
    for i, (image, _) in enumerate(views):
        Image.fromarray(image).save(tmp_path / f"view{i}.png", compress_level=1)
    Image.fromarray(np.full((480, 640), 90, np.uint8)).save(tmp_path / "view3.png")
    with pytest.warns(UserWarning, match=r"1 of 4 images are left out: .*view3.png \(no board found\)"):
        found = ct.find_board(str(tmp_path / "*.png"), "9x6", square=0.03)
    assert [name[-9:] for name in found.names] == ["view0.png", "view1.png", "view2.png"]
    assert found.image_size == (480, 640)
    for points, pixels, (_, true) in zip(found.object_points, found.image_points, views, strict=True):
        np.testing.assert_allclose(points, CHESSBOARD.points())
        assert np.nanmax(np.abs(pixels - true)) < 0.6
    options = {"image_size": found.image_size, "fixed": "all"}
    calibration = ct.calibrate(fisheye(), found.object_points, found.image_points, **options)
    assert calibration.rms < 0.6


SMALL = fisheye().resize(240, 320)


@pytest.mark.parametrize(
    "form",
    [
        lambda image: image,
        lambda image: np.stack([image] * 3, -1),
        lambda image: [image[..., None]],
        lambda image: [Image.fromarray(image).convert("RGB")],
        lambda image: image[None],
        lambda image: image.astype(np.uint16) * 257,
    ],
)
def test_one_image_in_any_form(form):
    image, true = photograph(CHESSBOARD, SMALL, *POSES[0])
    found = ct.find_board(form(image), (9, 6), square=0.03)
    assert found.names == ["image 0"]
    assert np.nanmax(np.abs(found.image_points[0] - true)) < 0.6


@pytest.mark.parametrize(
    ("images", "board", "error", "message"),
    [
        (np.zeros((80, 80), np.uint8), "9by6", ValueError, "charuco 5x7"),
        (np.zeros((80, 80), np.uint8), "9x6", ValueError, "got 1 without. image 0: no board found"),
        (np.zeros((80, 80)), "9x6", ValueError, "uint8 or uint16, .*; got float64"),
        ("nowhere/*.jpg", "9x6", ValueError, "the pattern must match files; got none"),
        ("nowhere.jpg", "9x6", ValueError, "No such file"),
        ([], "9x6", ValueError, "must not be empty"),
        ([5], "9x6", TypeError, r"images\[0\]"),
    ],
)
def test_what_is_no_image_and_no_board_is_refused(images, board, error, message):
    with pytest.raises(error, match=message):
        ct.find_board(images, board)
