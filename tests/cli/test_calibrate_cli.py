"""From photographs on the command line to a camera's file."""

import functools
import re
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from command_line import command
from photographs import fisheye, photograph
from PIL import Image
from videos import write_video

import camtorch as ct
from camtorch.boards.boards import Chessboard
from camtorch.calibration import selection
from camtorch.cli import searching
from camtorch.poses.rotations import rotation_matrix

BOARD = Chessboard(9, 6, 0.03)
WORDS = ("--board", "9x6", "--square", "30mm", "--model", "kannala_brandt", "--fixed", "k3,k4")
TILTS = [(0.1, -0.3, 0.1), (-0.5, 0.2, 0.3), (0.4, 0.5, -0.2), (0.3, -0.5, 1.2), (-0.3, -0.4, 0.0), (0.5, 0.1, -0.6)]
TURN, SHIFT = torch.tensor([0.02, -0.3, 0.05], dtype=torch.float64), torch.tensor([-0.12, 0.01, 0.02]).double()


def poses(board, count=6, seed=0):
    """Rotations and translations that put the board's middle here and there in front of a camera."""
    rng, middle = np.random.default_rng(seed), board.points().mean(0)
    for index in range(count):
        turn = torch.tensor(TILTS[index % len(TILTS)], dtype=torch.float64) + 0.1 * torch.as_tensor(rng.normal(size=3))
        at = np.array([0.1, 0.07, 0.03]) * rng.uniform(-1, 1, 3) + (0, 0, 0.22)
        yield turn, torch.as_tensor(at - rotation_matrix(turn).numpy() @ middle)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A folder of photographs of a chessboard: 1.png to 6.png by a fisheye, right/1.png to right/4.png by another."""
    folder = tmp_path_factory.mktemp("photographs")
    (folder / "right").mkdir()
    right = ct.KannalaBrandt([255.0, 254, 318, 242], [0.01, -0.004, 0.0, 0.0], image_size=(480, 640)).double()
    second = ct.Extrinsics(TURN, SHIFT)
    for i, (turn, shift) in enumerate(poses(BOARD), 1):
        image, _ = photograph(BOARD, fisheye(), turn.tolist(), shift.tolist(), seed=i)
        Image.fromarray(image).save(folder / f"{i}.png", compress_level=1)
        if i < 5:
            pose = second.compose(ct.Extrinsics(turn, shift))
            of_right = pose.rotation.tolist(), pose.translation.tolist()
            image, _ = photograph(BOARD, right.requires_grad_(False), *of_right, seed=10 + i)
            Image.fromarray(image).save(folder / "right" / f"{i}.png", compress_level=1)
    return folder


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


calibrate = functools.partial(command, "calibrate")


def assert_near(camera, true, pixels):
    """The two see rays alike up to 55 degrees from the axis, as far as boards reach."""
    rays, _ = true.resize(24, 32).rays()
    rays = rays[rays[..., 2] > np.cos(np.radians(55))]
    assert (camera.project(rays)[0] - true.project(rays)[0]).norm(dim=-1).max() < pixels


def test_a_folder_of_photographs_becomes_a_camera(photographs, capsys):
    for index in range(1, 5):
        Path(f"{index}.png").write_bytes((photographs / f"{index}.png").read_bytes())
    Image.new("L", (64, 48)).save("5.png")
    Path("6.png").write_text("no image")
    Path("7.png").write_bytes((photographs / "5.png").read_bytes()[:2000])
    with Image.open("1.png") as image:
        image.resize((480, 360)).save("8.png", compress_level=1)
    Path("9.png").write_bytes(Path("3.png").read_bytes())
    calibrate(".", "none.png", *WORDS, "-o", "camera.yml")
    captured = capsys.readouterr()
    out = captured.out.splitlines()
    assert out[0].startswith("chessboard, 9x6 inner corners, squares of 30 mm: in 5 of 10 images of 640x480, ")
    assert out[1].startswith("Calibration(KannalaBrandt: rms 0.0")
    assert [line.split()[0] for line in out[2:10]] == ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"]
    assert captured.out.count("held") == 2
    assert "fixed=" not in captured.out
    assert "Copies of other views, or nearly so, are view 9.png" in captured.out
    assert out[-2].strip().startswith("Good for ")
    assert out[-1] == "camera.yml: kannala_brandt"
    assert_near(ct.load("camera.yml").camera, fisheye(), 0.5)
    assert "fisheye_model: 1" in Path("camera.yml").read_text()
    left_out = dict(re.findall(r"note: (.*) is left out: (.*)\n", captured.err))
    assert "truncated" in left_out.pop("7.png")
    assert "cannot identify image file" in left_out.pop("6.png")
    assert left_out == {
        "5.png": "no board found",
        "8.png": "480x360, but most images are 640x480",
        "none.png": "No such file or directory",
    }


@pytest.mark.slow
def test_a_pair_becomes_a_rig(photographs, capsys):
    """One view is seen by the left camera alone."""
    lefts = [photographs / f"{i}.png" for i in range(1, 6)]
    calibrate("--left", *lefts, "--right", photographs / "right", *WORDS, "-o", "rig.yml")
    out = capsys.readouterr().out
    assert "5 views of left, right\nleft: chessboard" in out
    assert "in 4 of 4 images of 640x480" in out
    rig = ct.load("rig.yml")
    assert list(rig.cameras) == ["left", "right"]
    mount = rig.extrinsics["right"].compose(rig.extrinsics["left"].inverse())
    assert (mount.rotation - TURN).abs().max() < 2e-3
    assert (mount.translation - SHIFT).abs().max() < 1e-3


@pytest.mark.parametrize(
    ("left", "right", "views"),
    [
        ("l/1.png l/2.png", "r/2.png r/3.png r/1.png", ["1", "2", "3"]),
        ("left01.png left02.png", "right2.png", ["1", "2"]),
        ("left7.png left9.png", "right1.png right2.png", ["0", "1"]),
    ],
)
def test_images_taken_together(left, right, views):
    cameras = {"left": list(map(Path, left.split())), "right": list(map(Path, right.split()))}
    found = searching.take_together(cameras)
    assert list(found) == views
    assert sum(map(len, found.values())) == sum(map(len, cameras.values()))


def test_images_that_nothing_pairs():
    with pytest.raises(ValueError, match=r"images taken together must have .* got 1 of left, 2 of right"):
        searching.take_together({"left": [Path("left7.png")], "right": [Path("right1.png"), Path("right2.png")]})


@pytest.mark.slow
def test_models_that_the_file_cannot_hold_are_not_tried(photographs, capsys, monkeypatch):
    monkeypatch.setattr(selection, "CANDIDATES", (("pinhole", 0), ("kannala_brandt", 4), ("double_sphere", 2)))
    calibrate(photographs, "--board", "9x6", "-o", "camera.yml")
    captured = capsys.readouterr()
    assert "double_sphere" not in captured.out
    assert "camera.yml cannot hold double_sphere with 2, which were not tried; a .json can" in captured.err
    assert "no --square is given: distances are in sides of a square" in captured.err
    assert "  taken" in captured.out
    assert ct.load("camera.yml").camera.key == "kannala_brandt"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("a.png", "must be found in 3 images, better 20; got 0 of 1"),
        ("a.png --model splined", "--model must need no known lens; got splined"),
        pytest.param("PHOTOS --model mei --fixed q", "fixed must name parameters of Mei, fx", marks=pytest.mark.slow),
    ],
)
def test_what_cannot_be_calibrated(photographs, capsys, words, text):
    Image.new("L", (64, 48)).save("a.png")
    calibrate(*words.replace("PHOTOS", str(photographs)).split(), "--board", "9x6", expect=2)
    assert text in capsys.readouterr().err.splitlines()[-1]
    assert not Path("camera.json").exists()


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A video in which each view rests for half a second, of whose two frames one is blurred; and the true corners."""
    pytest.importorskip("av")
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
def test_sharp_frames_that_differ_are_taken(filmed, capsys):
    path, truth = filmed
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


def test_a_video_without_a_board_says_so(capsys):
    pytest.importorskip("av")
    write_video("grey.mp4", [0], images=[np.full((64, 96), 90, np.uint8)])
    calibrate("grey.mp4", *WORDS, "-o", "camera.yml", expect=2)
    out, err = capsys.readouterr()
    assert out == "grey.mp4: of 1 sharp frames 0 show the board, and 0 of these differ\n"
    assert "grey.mp4 is left out: no board found in its frames" in err
