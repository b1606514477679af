"""From a video of a board to a camera's file, on the command line."""

from fractions import Fraction

import cv2
import numpy as np
import pytest
from photographs import fisheye, photograph
from test_calibrate_cli import BOARD, WORDS, assert_near, calibrate, poses
from videos import write_video

import camtorch as ct
from camtorch.cli import searching

pytest.importorskip("av")


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A video in which each view rests for half a second, of whose two frames one is blurred; and the true corners."""
    views = [photograph(BOARD, fisheye(), *map(list, pose), seed=i) for i, pose in enumerate(poses(BOARD, 4))]
    images, truth = [image for image, _ in views], np.stack([pixels for _, pixels in views])
    blurred = cv2.GaussianBlur(images[0], (0, 0), 6)
    # in the third and the sixth half second nothing is sharp; in the last one the board is where it was
    again = cv2.GaussianBlur(images[1], (0, 0), 0.4)
    sharp = [images[0], images[1], blurred, images[2], images[3], blurred, again]
    shown = [frame for image in sharp for frame in (blurred, image)]
    path = tmp_path_factory.mktemp("film") / "board.mp4"
    write_video(path, range(len(shown)), images=shown, codec="libx264", tick=Fraction(1, 4), crf="10")
    return path, truth


@pytest.mark.slow
def test_sharp_frames_that_differ_are_taken(filmed, tmp_path, capsys, monkeypatch):
    path, truth = filmed
    monkeypatch.chdir(tmp_path)
    calibrate(path, *WORDS, "-o", "camera.yml")
    assert capsys.readouterr().out.startswith(
        f"{path}: of 5 sharp frames 5 show the board, and 4 of these differ\n"
        "chessboard, 9x6 inner corners, squares of 30 mm: in 4 of 4 images of 640x480, "
    )
    assert_near(ct.load("camera.yml").camera, fisheye(), 1.0)
    found = searching._search_video(path, BOARD)
    assert [image.path.name for image in found] == [f"board.mp4#t={t}" for t in ("0.250", "0.750", "1.750", "2.250")]
    for image, pixels in zip(found, truth, strict=True):
        assert np.nanmax(np.linalg.norm(image.pixels - pixels, axis=1)) < 0.5


def test_a_video_without_a_board_says_so(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_video("grey.mp4", [0], images=[np.full((64, 96), 90, np.uint8)])
    calibrate("grey.mp4", *WORDS, "-o", "camera.yml", expect=2)
    out, err = capsys.readouterr()
    assert out == "grey.mp4: of 1 sharp frames 0 show the board, and 0 of these differ\n"
    assert "grey.mp4 is left out: no board found in its frames" in err
