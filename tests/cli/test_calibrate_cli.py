"""From photographs on the command line to a camera's file."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from photographs import fisheye, photograph
from PIL import Image

import camtorch as ct
from camtorch.boards.boards import Chessboard
from camtorch.boards.corners import Corners, ImageCorners, read_corners, write_corners
from camtorch.cli import searching
from camtorch.cli.main import main
from camtorch.rotations import rotation_matrix

BOARD = Chessboard(9, 6, 0.03)
TILTS = [(0.1, -0.3, 0.1), (-0.5, 0.2, 0.3), (0.4, 0.5, -0.2), (0.3, -0.5, 1.2), (-0.3, -0.4, 0.0), (0.5, 0.1, -0.6)]
TILTS += [(-0.45, 0.45, 0.5), (0.05, 0.55, 0.1)]


def poses(board, count=8, seed=0):
    """Rotations and translations that put the board's middle here and there in front of a camera."""
    rng, points = np.random.default_rng(seed), board.points()
    middle = (points.min(0) + points.max(0)) / 2
    for index in range(count):
        turn = torch.tensor(TILTS[index % len(TILTS)], dtype=torch.float64) + 0.1 * torch.as_tensor(rng.normal(size=3))
        at = np.array([0.1, 0.07, 0.03]) * rng.uniform(-1, 1, 3) + (0, 0, 0.22)
        yield turn, torch.as_tensor(at - rotation_matrix(turn).numpy() @ middle)


def seen_by(camera, board, turn, shift, noise, rng):
    pixels, valid = camera.project(torch.as_tensor(board.points()) @ rotation_matrix(turn).T + shift)
    inside = (valid & camera.contains(pixels))[..., None]
    return np.where(inside, pixels.detach().numpy() + noise * rng.normal(size=pixels.shape), np.nan)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A folder of photographs of a chessboard."""
    folder = tmp_path_factory.mktemp("photographs")
    for index, (turn, shift) in enumerate(poses(BOARD, 6), 1):
        image, _ = photograph(BOARD, fisheye(), turn.tolist(), shift.tolist(), seed=index)
        Image.fromarray(image).save(folder / f"view{index}.png")
    return folder


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def calibrate(*words, expect=0):
    assert main(["calibrate", *map(str, words)]) == expect


def found_camera(path="camera.yml"):
    return ct.load(path).camera


def assert_near(camera, true, pixels):
    """Where the two see rays up to 55 degrees from the axis, as far as boards reach."""
    rays, _ = true.resize(24, 32).rays()
    rays = rays[rays[..., 2] > np.cos(np.radians(55))]
    assert (camera.project(rays)[0] - true.project(rays)[0]).norm(dim=-1).max() < pixels


def test_a_folder_of_photographs_becomes_a_camera(photographs, capsys, monkeypatch):
    for index in range(1, 5):
        Path(f"{index}.png").write_bytes((photographs / f"view{index}.png").read_bytes())
    Image.new("L", (64, 48)).save("5.png")
    Path("6.png").write_text("no image")
    Path("7.png").write_bytes((photographs / "view5.png").read_bytes()[:2000])
    with Image.open("1.png") as image:
        image.resize((480, 360)).save("8.png")
    words = "--board", "9x6", "--square", "30mm", "--model", "kannala_brandt", "--fixed", "k3,k4"
    words += "--corners", "corners.json"
    calibrate(".", "none.png", *words, "-o", "camera.yml")
    captured = capsys.readouterr()
    out = captured.out.splitlines()
    assert out[0].startswith("chessboard, 9x6 inner corners, squares of 30 mm: in 4 of 9 images of 640x480, ")
    assert out[1].startswith("kannala_brandt: rms 0.0")
    assert " px per coordinate, 4 views, " in out[1]
    assert [line.split()[0] for line in out[2:10]] == ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"]
    assert captured.out.count("held") == 2
    assert out[10].startswith("Good for ")
    assert out[-1] == "camera.yml: kannala_brandt"
    assert_near(found_camera(), fisheye(), 0.5)
    assert found_camera().image_size == (480, 640)
    assert "fisheye_model: 1" in Path("camera.yml").read_text()
    notes = captured.err.splitlines()
    for text in (
        "5.png is left out: no board found",
        "6.png is left out: not an image that Pillow can read",
        "7.png is left out: ",
        "8.png is left out: 480x360, but most images are 640x480",
        "none.png is left out: no such file",
    ):
        assert sum(text in line for line in notes) == 1, text
    # what was found is not searched for again
    monkeypatch.setattr(searching, "corners_in", None)
    for index in range(5, 9):
        Path(f"{index}.png").unlink()
    calibrate(".", *words, "-o", "again.yml")
    assert (found_camera("again.yml").intrinsics == found_camera().intrinsics).all()


@pytest.mark.slow
def test_a_square_of_another_size_changes_nothing_in_images(monkeypatch, capsys):
    monkeypatch.setattr(searching, "corners_in", None)
    write_corners(corners_of(), "corners.json")
    words = "--corners", "corners.json", "--model", "kannala_brandt", "--fixed", "k2,k3,k4", "--board", "9x6"
    calibrate(*words, "--square", 0.06, "-o", "large.json")
    assert "squares of 60 mm" in capsys.readouterr().out
    calibrate(*words, "-o", "kept.json")  # the size that is known
    assert "squares of 30 mm" in capsys.readouterr().out
    assert torch.allclose(found_camera("large.json").intrinsics, found_camera("kept.json").intrinsics, rtol=1e-6)
    # images that are gone, of which another tool says what they show
    calibrate(*(f"{i}.png" for i in range(4)), *words, "--square", 0.06, "-o", "few.json")
    assert [image.path.name for image in read_corners("corners.json").images] == [f"{i}.png" for i in range(8)]
    assert read_corners("corners.json").board == Chessboard(9, 6, 0.06)


def corners_of(board=BOARD, count=8, **more):
    """A file's worth of corners that no image was searched for."""
    camera, rng = fisheye(), np.random.default_rng(0)
    found = [seen_by(camera, board, turn, shift, 0.1, rng) for turn, shift in poses(board, count)]
    images = [ImageCorners(Path(f"{i}.png"), camera.image_size, p, view=str(i), **more) for i, p in enumerate(found)]
    return Corners(board, board.points(), images)


def test_advice_names_options_of_the_command(capsys):
    write_corners(corners_of(count=4), "corners.json")
    calibrate("--corners", "corners.json", "--model", "fisheye624", "-o", "camera.json")
    notes = capsys.readouterr().err
    assert "cannot be told from zero, and the data do not need that: --fixed s3 makes" in notes
    assert "fixed=" not in notes


def test_corners_of_another_tool_need_no_image(capsys):
    """Two of the files are others saved again, which are named and count once."""
    corners = corners_of(count=6)
    corners.board = None
    for i in (2, 5):
        again = corners.images[i].pixels + 0.01 * np.random.default_rng(i).normal(size=(54, 2))
        corners.images.append(replace(corners.images[i], pixels=again, path=Path(f"copy{i}.png"), view=f"copy{i}"))
    write_corners(corners, "corners.json")
    content = json.loads(Path("corners.json").read_text())
    assert content["board"] is None
    assert len(content["points"]) == 54
    assert set(content["images"][0]) == {"path", "view", "width", "height", "corners"}
    words = "--corners", "corners.json", "--model", "kannala_brandt", "--fixed", "k3,k4"
    calibrate(*words, "-o", "camera.yml")
    captured = capsys.readouterr()
    assert "in 8 of 8 images of 640x480" in captured.out
    words = "as a copy of a file does: they count once"
    assert f"shown again by views copy2.png, copy5.png, {words}" in " ".join(captured.err.split())
    assert_near(found_camera(), fisheye(), 0.5)


def two_cameras(board):
    """Corners of a pair, some views by one camera only; and right from left."""
    rng = np.random.default_rng(1)
    turn, shift = torch.tensor([0.02, -0.3, 0.05], dtype=torch.float64), torch.tensor([-0.12, 0.01, 0.02]).double()
    right = ct.KannalaBrandt([255.0, 254, 318, 242], [0.01, -0.004, 0.0, 0.0], image_size=(480, 640)).double()
    images = []
    for index, (tilt, move) in enumerate(poses(board, 10, seed=3)):
        first = rotation_matrix(tilt), move
        second = rotation_matrix(turn) @ first[0], rotation_matrix(turn) @ first[1] + shift
        for name, camera, (rotation, translation) in (("left", fisheye(), first), ("right", right, second)):
            pixels, valid = camera.project(torch.as_tensor(board.points()) @ rotation.T + translation)
            pixels = pixels.detach().numpy() + 0.1 * rng.normal(size=pixels.shape)
            pixels[~(valid & camera.contains(torch.as_tensor(pixels))).numpy()] = np.nan
            if not (name == "left" and index == 4):
                image = ImageCorners(Path(f"{name}{index}.png"), (480, 640), pixels, camera=name, view=str(index))
                images.append(image)
    return Corners(board, board.points(), images), turn, shift


@pytest.mark.slow
def test_a_pair_becomes_a_rig(capsys):
    corners, turn, shift = two_cameras(BOARD)
    write_corners(corners, "corners.json")
    words = "--corners", "corners.json", "--square", "30mm", "--model", "kannala_brandt", "-o", "rig.yml"
    calibrate(*words, "--report", "report.html")
    assert "right3.png" in Path("report.html").read_text()
    captured = capsys.readouterr()
    assert "left: chessboard" in captured.out
    assert "in 9 of 9 images of 640x480" in captured.out
    rig = ct.load("rig.yml")
    assert list(rig.cameras) == ["left", "right"]
    mount = rig.extrinsics["right"].compose(rig.extrinsics["left"].inverse())
    assert (mount.rotation - turn).abs().max() < 2e-3
    assert (mount.translation - shift).abs().max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("turned", [(), (1, 5)])
def test_a_symmetric_board_is_read_alike_by_all_cameras(turned, capsys):
    corners, turn, shift = two_cameras(Chessboard(8, 6, 0.03))
    for image in corners.images:
        if image.camera == "right" and int(image.view) in turned:
            image.pixels = image.pixels[::-1]
    write_corners(corners, "corners.json")
    words = "--corners", "corners.json", "--model", "kannala_brandt", "-o", "rig.yml"
    calibrate(*words, expect=2 if turned else 0)
    assert "this board looks the same after a turn" in capsys.readouterr().err
    if not turned:
        rig = ct.load("rig.yml")
        mount = rig.extrinsics["right"].compose(rig.extrinsics["left"].inverse())
        assert (mount.rotation - turn).abs().max() < 2e-3
        assert (mount.translation - shift).abs().max() < 1e-3


@pytest.mark.parametrize(
    ("left", "right", "views"),
    [
        (["l/1.png", "l/2.png"], ["r/2.png", "r/3.png", "r/1.png"], ["1", "2", "3"]),
        (["left01.png", "left02.png"], ["right2.png"], ["1", "2"]),
        (["left7.png", "left9.png"], ["right1.png", "right2.png"], ["0", "1"]),
        (["left7.png"], ["right1.png", "right2.png"], None),
    ],
)
def test_images_taken_together(left, right, views):
    cameras = {"left": list(map(Path, left)), "right": list(map(Path, right))}
    if views is None:
        with pytest.raises(ValueError, match="1 of left, 2 of right: images that were taken together have"):
            searching.together(cameras)
        return
    found = searching.together(cameras)
    assert list(found) == views
    assert sum(map(len, found.values())) == len(left) + len(right)


@pytest.mark.slow
def test_models_that_the_file_cannot_hold_are_not_tried(capsys, monkeypatch):
    from camtorch.calibration import selection

    monkeypatch.setattr(selection, "CANDIDATES", (("pinhole", 0), ("kannala_brandt", 1), ("double_sphere", 2)))
    write_corners(corners_of(count=5), "corners.json")
    calibrate("--corners", "corners.json", "-o", "camera.yml")
    captured = capsys.readouterr()
    assert "double_sphere" not in captured.out
    assert "camera.yml cannot hold double_sphere with 2, which were not tried; a .json can" in captured.err
    assert "  taken" in captured.out
    assert found_camera().key == "kannala_brandt"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("a.png --board 9x6", "a board was found in 0 of 1 images, and 3 are needed"),
        ("--corners corners.json --model splined", "splined learns a surface over a lens that is known"),
        ("--corners corners.json --model kannala_brandt --fixed q", "fixed names 'q'; KannalaBrandt has fx, fy"),
    ],
)
def test_what_cannot_be_calibrated(capsys, words, text):
    Image.new("L", (64, 48)).save("a.png")
    write_corners(corners_of(count=3), "corners.json")
    calibrate(*words.split(), expect=2)
    assert text in capsys.readouterr().err.splitlines()[-1]
    assert not Path("camera.json").exists()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda c: c.pop("camtorch_corners"), "no file of corners, which begin with"),
        (lambda c: c.pop("images"), "images: 'images' is missing"),
        (lambda c: c.update(board={"type": "moon"}), "board: a board's type must be one of"),
        (lambda c: c.update(board=None, points=[[1, 2]]), "points: must be rows of 3 finite numbers"),
        (lambda c: c["images"][1].update(corners=[[54, 1, 2]]), "images[1]: corners must begin with the number of a"),
        (lambda c: c["images"][1].update(corners=[[1, 1, 2]] * 2), "images[1]: a point appears twice"),
        (lambda c: c["images"][0].pop("width"), "images[0]: width and height of the image are missing"),
        (lambda c: c["images"][0].pop("path"), "images[0]: 'path' is missing"),
        (lambda c: c["images"][0].update(corners=3), "images[0]: "),
        (lambda c: c.update(images=[3]), "images[0]: "),
    ],
)
def test_damaged_files_of_corners(capsys, change, text):
    write_corners(corners_of(count=3), "corners.json")
    content = json.loads(Path("corners.json").read_text())
    change(content)
    Path("corners.json").write_text(json.dumps(content))
    calibrate("--corners", "corners.json", expect=2)
    assert f"corners.json: {text}" in capsys.readouterr().err
