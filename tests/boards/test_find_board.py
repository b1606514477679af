"""`ct.find_board`: images in any form to what `ct.calibrate` takes."""

import numpy as np
import pytest
import torch
from photographs import fisheye, photograph
from PIL import Image

import camtorch as ct
from camtorch.boards.boards import Chessboard

BOARD = Chessboard(9, 6, 0.03)
POSES = (
    ((0.1, -0.3, 0.1), (-0.12, -0.1, 0.25)),
    ((-0.3, 0.2, 0.0), (-0.1, -0.08, 0.3)),
    ((0.2, 0.3, -0.1), (-0.15, -0.05, 0.28)),
)


@pytest.fixture(scope="module")
def views():
    return [photograph(BOARD, fisheye(), *pose) for pose in POSES]


def test_paths_and_arrays_give_the_same_and_calibrate(views, tmp_path):
    for i, (image, _) in enumerate(views):
        Image.fromarray(image).save(tmp_path / f"view{i}.png")
    Image.fromarray(np.full((480, 640), 90, np.uint8)).save(tmp_path / "view3.png")
    with pytest.warns(UserWarning, match=r"1 of 4 images are left out: .*view3.png \(no board found\)"):
        found = ct.find_board(str(tmp_path / "*.png"), "9x6", square=0.03)
    assert [name[-9:] for name in found.names] == ["view0.png", "view1.png", "view2.png"]
    assert found.image_size == (480, 640)
    for points, pixels, (_, true) in zip(found.object_points, found.image_points, views, strict=True):
        np.testing.assert_allclose(points, BOARD.points())
        assert np.nanmax(np.abs(pixels - true)) < 0.6
    calibration = ct.calibrate(
        fisheye(), found.object_points, found.image_points, image_size=found.image_size, fixed="all"
    )
    assert calibration.rms < 0.6


@pytest.mark.parametrize(
    "form",
    [
        lambda image: image,
        lambda image: np.stack([image] * 3, -1),
        lambda image: [torch.from_numpy(image)[None]],
        lambda image: [Image.fromarray(image).convert("RGB")],
        lambda image: torch.from_numpy(image)[None, None].float() / 255,
        lambda image: image.astype(np.uint16) * 257,
    ],
)
def test_one_image_in_any_form(views, form):
    image, true = views[0]
    found = ct.find_board(form(image), (9, 6), square=0.03)
    assert found.names == ["image 0"]
    assert np.nanmax(np.abs(found.image_points[0] - true)) < 0.6


@pytest.mark.parametrize(
    ("images", "board", "error", "message"),
    [
        (np.zeros((80, 80), np.uint8), "9by6", ValueError, "charuco 5x7"),
        (np.zeros((80, 80), np.uint8), "9x6", ValueError, "in none of 1 images: image 0: no board found"),
        (np.zeros((80, 80)), "9x6", ValueError, "in none of 1 images"),
        (np.full((80, 80), 200.0), "9x6", ValueError, "from 0 to 1; got up to 200"),
        (np.zeros((80, 80), np.int32), "9x6", ValueError, "uint8 or uint16"),
        ("nowhere/*.jpg", "9x6", ValueError, "no file has such a name"),
        ("nowhere.jpg", "9x6", ValueError, "no such file"),
        ([], "9x6", ValueError, "no images"),
        ([5], "9x6", TypeError, r"images\[0\]"),
    ],
)
def test_what_is_no_image_and_no_board_is_refused(images, board, error, message):
    with pytest.raises(error, match=message):
        ct.find_board(images, board)
