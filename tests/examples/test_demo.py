import numpy as np
import pytest
import torch
from PIL import Image
from scenes import dewarping, room

from camtorch import Pinhole
from camtorch.cli.main import main


@pytest.fixture(scope="module")
def studies():
    chosen = [lens for lens in dewarping.lenses(480) if lens.title in ("Brown-Conrady", "Fisheye624")]
    return [dewarping.study(lens) for lens in chosen]


@pytest.mark.slow
def test_dewarped_is_what_the_target_would_have_seen(studies):
    for study in studies:
        assert study.warp.target.intrinsics[0] <= study.warp.source.intrinsics[0]
        assert study.valid.float().mean() > 0.9
        assert study.psnr >= 35
        assert study.shift < 0.05


@pytest.mark.slow
def test_bent_edges_become_straight(studies):
    for study in studies:
        assert study.lines >= 5
        assert study.bend_before > 2
        assert study.bend_after < 0.15


@pytest.mark.slow
def test_keypoints_move_with_the_image(studies):
    for study in studies:
        assert len(study.keypoints[0]) >= 20
        assert study.keypoint_error < 0.05


def test_a_wrong_camera_would_be_noticed():
    # the measurements must be able to fail: the same image, dewarped with another k1
    lens = next(lens for lens in dewarping.lenses(320) if lens.title == "Brown-Conrady")
    source = room.render(lens.camera, samples=2)
    wrong = lens.camera.resize(*lens.camera.image_size)
    with torch.no_grad():
        wrong.distortion[:1] *= 0.7
    bends = []
    for camera in (lens.camera, wrong):
        warp = dewarping.Dewarp(camera, fov=86, image_size=lens.size)
        view = (warp(source[None])[0], warp.target, torch.eye(3, dtype=torch.float64))
        bends.append(dewarping._bend(dewarping._edges(room.lines(), view)[0]))
    assert bends[1] > 3 * bends[0]


@pytest.mark.slow
def test_all_lenses_one_image(tmp_path, monkeypatch, capsys):
    threads = torch.get_num_threads()
    whole = dewarping.run
    monkeypatch.setattr(dewarping, "run", lambda report: whole(report, height=200, samples=2))
    assert main(["demo", "-o", str(tmp_path / "demo.png")]) == 0
    table = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in table[1:6]] == [lens.title for lens in dewarping.lenses()]
    assert len(table) == 7
    assert "demo.png" in table[6]
    with Image.open(tmp_path / "demo.png") as image:
        sheet = np.asarray(image)
    assert sheet.std() > 30
    assert torch.get_num_threads() == threads


def test_scene_is_where_it_says():
    # around every corner of the test chart opposite squares are alike and neighbours are not
    camera = Pinhole([400.0, 400, 319.5, 239.5], image_size=(480, 640)).double().requires_grad_(False)
    points = room.keypoints()
    points = points[room.visible(points) & (points[:, 2] == points[:, 2].max())]
    assert len(points) == 12
    pixels, valid = camera.project(points)
    assert valid.all()
    corners = pixels[:, None] + torch.tensor([[-3.0, -3.0], [3, -3], [3, 3], [-3, 3]], dtype=torch.float64)
    a, b, c, d = room.radiance(camera.unproject(corners)[0]).unbind(1)
    assert (a - c).abs().max() < 0.1
    assert (b - d).abs().max() < 0.1
    assert (a - b).abs().amax(-1).min() > 0.3


def test_rays_of_any_shape_and_dtype():
    rays = torch.tensor([[[0.1, 0.2, 1.0]], [[0.0, 0.0, 1.0]]], dtype=torch.float64)
    colours = room.radiance(rays)
    assert colours.shape == rays.shape
    assert ((colours >= 0) & (colours <= 1)).all()
    assert torch.equal(colours[1, 0], room.radiance(rays[1, 0]))


def test_no_rays_no_light():
    # a fold of this lens lies inside the image
    camera = dewarping.BrownConrady([100.0, 100, 79.5, 59.5], [-0.6, 0.0, 0.0, 0.0], image_size=(120, 160))
    image = room.render(camera, samples=1)
    _, valid = camera.rays()
    assert not valid.all()
    assert (image[:, ~valid] == 0).all()
    assert (image[:, 60, 80] > 0).all()
