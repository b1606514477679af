"""From photographs on the command line to a camera's file."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from photographs import fisheye, photograph
from PIL import Image

import camtorch as ct
from camtorch.boards.boards import AprilGrid, Chessboard
from camtorch.boards.corners import Corners, ImageCorners, read_corners, write_corners
from camtorch.boards.finding import gather
from camtorch.boards.turns import agreeing, reordered, turns_of
from camtorch.calibration.selection import select
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
        "none.png is left out: No such file or directory",
    ):
        assert sum(text in line for line in notes) == 1, text
    # what was found is not searched for again, also where it is called and lies otherwise, in any order
    monkeypatch.setattr(searching, "detect", None)
    Path("other").mkdir()
    for index in range(1, 5):
        Path(f"{index}.png").rename(f"other/{9 - index}.png")
    images = {"": gather(["other/[0-9].png"])}
    again = searching.found_corners(images, None, Path("corners.json"), None, measured=False, force=False)
    assert [image.path.name for image in again.images] == ["5.png", "6.png", "7.png", "8.png"]
    assert all(image.seen > 40 for image in again.images)


@pytest.mark.slow
def test_a_square_of_another_size_changes_nothing_in_images(monkeypatch, capsys):
    monkeypatch.setattr(searching, "detect", None)
    write_corners(corners_of(), "corners.json")
    words = "--corners", "corners.json", "--model", "kannala_brandt", "--fixed", "k2,k3,k4", "--board", "9x6"
    calibrate(*words, "--square", 0.06, "-o", "large.json")
    assert "squares of 60 mm" in capsys.readouterr().out
    calibrate(*words, "-o", "kept.json")  # the size that is known
    assert "squares of 30 mm" in capsys.readouterr().out
    assert torch.allclose(found_camera("large.json").intrinsics, found_camera("kept.json").intrinsics, rtol=1e-6)
    corners = searching.found_corners(
        {"": [Path("0.png")]}, Chessboard(9, 6, 0.06), Path("corners.json"), None, measured=True, force=False
    )
    assert corners.board == read_corners("corners.json").board == Chessboard(9, 6, 0.06)
    assert corners.images[0].seen > 20  # though there is no such image
    assert [image.path.name for image in read_corners("corners.json").images] == [f"{i}.png" for i in range(8)]


def corners_of(board=BOARD, count=8, **more):
    """A file's worth of corners that no image was searched for."""
    camera, rng = fisheye(), np.random.default_rng(0)
    found = [seen_by(camera, board, turn, shift, 0.1, rng) for turn, shift in poses(board, count)]
    images = [ImageCorners(Path(f"{i}.png"), camera.image_size, p, view=str(i), **more) for i, p in enumerate(found)]
    return Corners(board, board.points(), images)


def test_no_focal_length_is_held(capsys):
    write_corners(corners_of(count=3), "corners.json")
    calibrate("--corners", "corners.json", "--fixed", "fx,k3", expect=2)
    assert "--fixed: no focal length is known to be held" in capsys.readouterr().err


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


@pytest.mark.slow
def test_a_report_is_written_into_a_new_folder(capsys):
    write_corners(corners_of(count=5), "corners.json")
    words = "--corners", "corners.json", "--model", "kannala_brandt", "--fixed", "k3,k4"
    calibrate(*words, "-o", "camera.yml", "--report", "folder/report.html")
    assert capsys.readouterr().out.endswith("camera.yml: kannala_brandt\nfolder/report.html: the report\n")
    assert "4.png" in Path("folder/report.html").read_text()


def test_corners_are_read_as_they_were_written():
    corners = corners_of(board=AprilGrid(4, 3, 0.05), hash="abc")
    corners.images[2].pixels[:] = np.nan
    corners.images[2].reason = "no board found"
    write_corners(corners, "corners.json")
    again = read_corners("corners.json")
    assert again.board == corners.board
    for one, other in zip(again.images, corners.images, strict=True):
        assert np.array_equal(one.pixels, other.pixels, equal_nan=True)
        assert (one.reason, one.hash, one.view, one.image_size) == (other.reason, other.hash, other.view, (480, 640))
        assert one.path.resolve() == other.path.resolve()


@pytest.mark.slow
def test_a_wrong_size_of_the_board_is_named(photographs, capsys):
    calibrate(photographs / "view1.png", "--board", "10x7", "-o", "camera.yml", expect=2)
    error = capsys.readouterr().err.splitlines()[-1]
    assert "a board was found in 0 of 1 images, and 3 are needed" in error
    assert "shows one of 9x6 inner corners: --board 9x6" in error
    corners = corners_of(Chessboard(8, 5, 0.03), count=1)  # in one image a part of the board was taken for the whole
    missed = ImageCorners(photographs / "view1.png", (480, 640), np.full((40, 2), np.nan), "no board found")
    with pytest.raises(ValueError, match=r"in 1 of 2 images.* shows one of 9x6 inner corners: --board 9x6"):
        searching.usable_views(replace(corners, images=[*corners.images, missed]))


@pytest.mark.slow
def test_the_size_that_is_named_calibrates(photographs, capsys):
    """Of some photographs the board that was asked for would be found a part smaller, too: the whole is named."""
    calibrate(photographs, "--board", "8x5", "-o", "camera.json", expect=2)
    named = re.search(r"view\d.png and \d more show one of \d+x\d+ .* --board (\S+)$", capsys.readouterr().err.strip())
    assert named[1] == "9x6"
    calibrate(photographs, "--board", named[1], "--model", "kannala_brandt", "--fixed", "k3,k4", "-o", "camera.json")
    assert "no --square is given: distances are in sides of a square" in capsys.readouterr().err


@pytest.mark.parametrize("package", ["matplotlib", "jinja2"])
def test_what_a_report_needs_is_asked_before_the_work(package, capsys, monkeypatch):
    write_corners(corners_of(), "corners.json")
    monkeypatch.setitem(sys.modules, package, None)
    words = "--corners", "corners.json", "--report", "report.html", "-o", "camera.yml"
    calibrate(*words, expect=2)
    captured = capsys.readouterr()
    assert "pip install 'camtorch[plot]'" in captured.err
    assert captured.out == ""
    assert sorted(path.name for path in Path().iterdir()) == ["corners.json"]


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
    board, rng = Chessboard(7, 7, 0.03), np.random.default_rng(5)
    corners, turn, shift = two_cameras(board)
    for image in corners.images:  # as a detector may begin anywhere
        image.pixels = reordered(board, image.pixels[None], [int(rng.integers(board.symmetries))])[0]
    write_corners(corners, "corners.json")
    words = "--corners", "corners.json", "--square", "30mm", "--model", "kannala_brandt", "-o", "rig.yml"
    calibrate(*words, "--report", "report.html")
    assert "right3.png" in Path("report.html").read_text()
    captured = capsys.readouterr()
    assert "left: chessboard" in captured.out
    assert "in 9 of 9 images of 640x480" in captured.out
    assert "this board looks the same after a turn" in captured.err
    rig = ct.load("rig.yml")
    assert list(rig.cameras) == ["left", "right"]
    mount = rig.extrinsics["right"].compose(rig.extrinsics["left"].inverse())
    assert (mount.rotation - turn).abs().max() < 2e-3
    assert (mount.translation - shift).abs().max() < 1e-3


def test_turns_of_boards():
    for board in (Chessboard(9, 6), Chessboard(7, 5), Chessboard(6, 6), Chessboard(5, 5)):
        turns = turns_of(board)
        assert len(turns) == board.symmetries
        for order, matrix in turns:
            moved = board.points() @ matrix[:3, :3].T + matrix[:3, 3]
            assert np.allclose(moved, board.points()[order])


def test_cameras_agree_on_the_turns_of_a_board():
    board, rng = Chessboard(6, 6, 0.03), np.random.default_rng(0)

    def random_pose(reach):
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix(torch.as_tensor(reach * rng.normal(size=3))).numpy()
        pose[:3, 3] = 0.3 * rng.normal(size=3)
        return pose

    mounts = {"a": np.eye(4), "b": random_pose(0.3), "c": random_pose(1.0)}
    matrices = [matrix for _, matrix in turns_of(board)]
    poses, truth = {}, {}
    for name, views in (("a", range(6)), ("b", range(3, 12)), ("c", range(8, 14))):
        truth[name] = {view: int(rng.integers(4)) for view in views}
    boards = {view: random_pose(0.5) for view in range(14)}
    for name, turns in truth.items():
        poses[name] = {view: mounts[name] @ boards[view] @ np.linalg.inv(matrices[t]) for view, t in turns.items()}
    found = agreeing(board, poses)
    for view in range(14):
        seen = [name for name in poses if view in poses[name]]
        # each by the turn that makes its board the true one, or all by one turn more
        assert len({(found[name][view] - truth[name][view]) % 4 for name in seen}) == 1


def test_images_come_in_natural_order():
    for name in ("a10.png", "a9.jpg", "a1.PNG", "notes.txt"):
        Path(name).touch()
    Path("folder").mkdir()
    assert [str(path) for path in gather(["."])] == ["a1.PNG", "a9.jpg", "a10.png"]
    assert [str(path) for path in gather(["a?.*", "a10.png", "a9.jpg"])] == ["a1.PNG", "a9.jpg", "a10.png"]
    Path("[1].png").touch()
    assert gather(["[1].png"]) == [Path("[1].png")]


@pytest.mark.parametrize(
    ("left", "right", "how", "views"),
    [
        (["l/1.png", "l/2.png"], ["r/2.png", "r/3.png", "r/1.png"], "by the file name", ["1", "2", "3"]),
        (["left01.png", "left02.png"], ["right2.png"], "by the number in the file name", ["1", "2"]),
        (["left7.png", "left9.png"], ["right1.png", "right2.png"], "by their order", ["0", "1"]),
    ],
)
def test_images_taken_together(left, right, how, views):
    cameras = {"left": list(map(Path, left)), "right": list(map(Path, right))}
    found, words = searching.together(cameras, None)
    assert words == how
    assert list(found) == views
    assert sum(map(len, found.values())) == len(left) + len(right)


def test_images_that_cannot_be_matched():
    cameras = {"left": [Path("left7.png")], "right": [Path("right1.png"), Path("right2.png")]}
    for how, text in (
        (None, "1 of left, 2 of right: images are matched by their order"),
        ("name", "no names in common"),
    ):
        with pytest.raises(ValueError, match=text):
            searching.together(cameras, how)
    cameras = {"left": [Path("l/1.png"), Path("l/2.png")], "right": [Path("r/2.png"), Path("r/3.png")]}
    assert searching.together(cameras, "order")[0]["0"] == {"left": Path("l/1.png"), "right": Path("r/2.png")}


@pytest.mark.slow
def test_the_model_is_taken_that_predicts_best():
    corners = corners_of()
    pixels = np.stack([image.pixels for image in corners.images])
    candidates = [("pinhole", 0), ("kannala_brandt", 4), ("kannala_brandt", 6)]
    chosen = select(corners.points, pixels, image_size=(480, 640), candidates=candidates)
    assert chosen.best.calibration.camera.distortion.shape == (4,)
    assert chosen.best.calibration.rms < 0.15
    lines = chosen.lines()
    assert [line.split()[0] for line in lines[1:4]] == [key for key, _ in candidates]
    assert [line.endswith("taken") for line in lines[1:4]] == [False, True, False]
    least, fits, more = (trial.held_out for trial in chosen.trials)
    assert least > 3 * fits
    assert more >= 0.99 * fits


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


def test_what_is_said_to_python_is_said_in_options():
    from camtorch.cli.calibrate import _in_options

    names = ["a/left1.jpg", "a/left2.jpg", "a/left3.jpg"]
    for text, expected in (
        ('fixed=("p2", "k3") makes the rest more certain', "--fixed p2,k3 makes the rest more certain"),
        ('hold it with fixed=("cx",)', "hold it with --fixed cx"),
        ('with count=8 coefficients: loss="huber" keeps', "with --count 8 coefficients: --loss huber keeps"),
        ("bend=True finds its shape", "--bend finds its shape"),
        ("Views 0, 2 and 3 more fit worse", "Views left1.jpg, left3.jpg and 3 more fit worse"),
        ("5 of them in view 1. Look at the views", "5 of them in view left2.jpg. Look at the views"),
        ("Only 3 views: take 10", "Only 3 views: take 10"),
    ):
        assert _in_options(text, names) == expected
