"""The room measured by two fisheyes, and the car park seen from above by four: what was rendered comes back."""

import math

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import car_park, room, stereo, surround
from scenes.exposure import expose
from scenes.walls import soft

import camtorch as ct
from camtorch.cli.main import main

SQUARE = 0.25


@pytest.fixture(scope="module")
def pair():
    return stereo.pair(800, 4)


@pytest.mark.slow
@pytest.mark.parametrize(("projection", "fov"), [("perspective", (120.0, 120.0)), ("latlon", (150.0, 160.0))])
def test_the_room_is_measured(pair, projection, fov):
    pytest.importorskip("cv2")
    study = stereo.study(pair, projection, fov)
    assert study.share > 0.85
    assert study.median < 0.01
    # the measurement must be able to fail: a baseline that is 3 % off
    wrong = ct.Extrinsics(pair.extrinsics.rotation.detach(), 1.03 * pair.extrinsics.translation.detach())
    other = stereo.Pair(pair.camera, wrong.requires_grad_(False), pair.images, pair.place, pair.rotation)
    assert stereo.study(other, projection, fov).median > 0.015


def test_the_room_from_another_place():
    camera = ct.Pinhole([60.0, 60, 39.5, 29.5], image_size=(60, 80)).double().requires_grad_(False)
    rays, _ = camera.rays()
    ahead = (0.1, 0.05, 0.4)
    far = room.distances(rays, ahead)
    points = torch.tensor(ahead) + far[..., None] * rays
    seen = far.isfinite()
    assert 0.8 < seen.double().mean() < 1  # not the window
    # what both places see is as far as it is
    also = seen & room.visible(points)
    assert also.double().mean() > 0.7
    direct = room.distances(torch.nn.functional.normalize(points, dim=-1))
    again = direct.isfinite() & also
    off = (direct - points.norm(dim=-1))[again].abs()
    assert (off < 4e-3).double().mean() > 0.999  # but for rays that graze an edge


@pytest.mark.slow
def test_a_chessboard_on_the_floor_is_found_on_its_grid():
    cv2 = pytest.importorskip("cv2")
    camera = car_park.rig((1080, 1440), 190)["front"]
    pose = car_park._looking(0, 35, torch.tensor([0.3, -1.2, 1.6], dtype=torch.float64))
    place = pose.position.float()

    def chessboard(rays):
        # far off the axis, up to 90 degrees from it at the board's side
        far = place[2] / (-rays[..., 2]).clamp(min=1e-3)
        x, y = place[0] + far * rays[..., 0], place[1] + far * rays[..., 1]
        cells = [torch.sin(math.pi * c / SQUARE) for c in (x, y)]
        board = soft(x, -1.25, 1.25, 1e-3) * soft(y, 0.0, 2.0, 1e-3)
        shade = 0.5 + 0.4 * torch.tanh(300 * cells[0] * cells[1]) * board + 0.4 * (1 - board)
        return shade[..., None].expand(*shade.shape, 3)

    image = expose(camera, chessboard, pose.matrix()[:3, :3], samples=8)
    eye = ct.BirdsEye(camera, pose, x=(-1.7, 1.7), y=(-0.4, 2.4), resolution=0.01)
    above = (255 * eye(image[None])[0, 0]).round().byte().numpy()
    steps = [SQUARE * torch.arange(n, dtype=torch.float64) for n in (9, 7)]
    corners = torch.cartesian_prod(steps[0] - 1.0, steps[1] + SQUARE)
    truth = eye.from_ground(corners)
    start = (truth + 0.6 * torch.sin(torch.arange(126.0)).view(63, 2)).numpy().astype(np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    found = cv2.cornerSubPix(above, start.reshape(-1, 1, 2).copy(), (6, 6), (-1, -1), stop)[:, 0]
    assert np.linalg.norm(found - truth.numpy(), axis=1).max() < 0.2


@pytest.mark.slow
def test_the_car_park_comes_back():
    lines = []
    study = surround.run(lines.append, size=(400, 640), resolution=0.05, samples=2)
    assert len(lines) == 1
    assert study.valid.double().mean() > 0.95
    assert study.error < 6
    shifted = study.truth.roll(2, 1)
    assert (shifted - study.above)[:, study.valid].square().mean() > (study.truth - study.above)[
        :, study.valid
    ].square().mean()
    assert np.asarray(surround.drawing(study)).std() > 30


@pytest.mark.slow
def test_one_image_of_the_pair(tmp_path, monkeypatch, capsys):
    pytest.importorskip("cv2")
    whole = stereo.run
    monkeypatch.setattr(stereo, "run", lambda report: whole(report, size=240, samples=1))
    assert main(["demo", "stereo", "-o", str(tmp_path / "pair.png")]) == 0
    table = capsys.readouterr().out.splitlines()
    assert [line.split(",")[0] for line in table[1:3]] == ["latlon", "perspective"]
    with Image.open(tmp_path / "pair.png") as image:
        assert np.asarray(image).std() > 30
