"""`camtorch birdseye`: the ground in its scale, by a pose of a file or by height and pitch."""

import math
import shutil

import numpy as np
import pytest
import torch
from command_line import command
from PIL import Image

import camtorch as ct

RANGES = ["--x", "-2", "2", "--y", "0.5", "4.5", "--resolution", "0.02"]
HEIGHT, PITCH = 1.5, 35.0


def lens():
    camera = ct.KannalaBrandt([80.0, 80, 119.5, 89.5], [0.01, 0.0, 0.0, 0.0], image_size=(180, 240))
    return camera.double().requires_grad_(False)


def pose():
    """Camera from ground, of one that looks along y and down."""
    down = ct.Extrinsics([math.radians(90 + PITCH), 0.0, 0.0], [0.0] * 3).double()
    rotation = down.matrix()[:3, :3]
    return ct.Extrinsics.from_matrix(rotation, -rotation @ torch.tensor([0, 0, HEIGHT]).double())


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A floor of squares of half a unit, seen by a fisheye."""
    folder, camera, extrinsics = tmp_path_factory.mktemp("floor"), lens(), pose()
    fine = camera.resize(720, 960)
    rays = fine.unproject(fine.pixel_grid())[0] @ extrinsics.matrix()[:3, :3]
    far = -HEIGHT / rays[..., 2].clamp(max=-1e-6)
    x, y = (far[..., None] * rays)[..., :2].unbind(-1)
    squares = (((2 * x).floor() + (2 * y).floor()) % 2 == 0) & (rays[..., 2] < -1e-3)
    image = torch.nn.functional.avg_pool2d(255.0 * squares[None, None], 4)[0, 0]
    Image.fromarray(image.round().byte().numpy()).save(folder / "floor.png")
    ct.save(camera, folder / "camera.json")
    ct.save(ct.Rig({"front": camera}, {"front": extrinsics}), folder / "posed.json")
    return folder


@pytest.fixture
def folder(seen, tmp_path, monkeypatch):
    for path in seen.iterdir():
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def birdseye(*words):
    command("birdseye", "floor.png", *words)


def test_squares_of_the_floor_are_squares_of_its_size(folder, capsys):
    birdseye("--camera", "posed.json", *RANGES, "-o", "above.png")
    birdseye("--camera", "camera.json", "--height", HEIGHT, "--pitch", PITCH, *RANGES, "-o", "same.png")
    out = capsys.readouterr().out.splitlines()
    assert out[0] == (
        "above.png: the ground from above, x -2 to 2 and y 0.5 to 4.5 at 0.02 a pixel, 200x200, by kannala_brandt, "
        "1.5 above; 100.0 % of it is filled"
    )
    above, same = (np.array(Image.open(f"{name}.png")).astype(float) for name in ("above", "same"))
    assert np.abs(above - same).max() <= 1
    # columns go along x, rows from the largest y to the smallest
    x = -2 + 0.02 * (np.arange(200) + 0.5)
    y = 4.5 - 0.02 * (np.arange(200) + 0.5)
    cells = np.floor(2 * x)[None] + np.floor(2 * y)[:, None]
    truth = 255 * (cells % 2 == 0)
    inner = (np.abs((2 * x) % 1 - 0.5) < 0.35)[None] & (np.abs((2 * y) % 1 - 0.5) < 0.35)[:, None]
    near = inner & (y < 2.5)[:, None]
    assert np.abs(above - truth)[near].max() < 60
    assert np.abs(above - truth)[near].mean() < 5


def test_a_pitch_is_down(folder):
    # straight down: the middle of the image is the origin, which lies below the camera
    small = ["--x", "-0.1", "0.1", "--y", "-0.1", "0.1", "--resolution", "0.2"]
    birdseye("--camera", "camera.json", "--height", 1, "--pitch", 90, *small, "-o", "origin.png")
    middle = np.array(Image.open("floor.png")).astype(float)[89:91, 119:121].mean()
    assert np.array(Image.open("origin.png"))[0, 0] == pytest.approx(middle, abs=1)
