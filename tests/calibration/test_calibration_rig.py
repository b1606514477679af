"""Rigs: cameras that see the same boards, some of them, are found with where they are and how sure that is."""

import math

import pytest
import torch
from boards import chessboard

import camtorch as ct
from camtorch.poses.rotations import rotation_matrix, rotation_vector

NOISE = 0.2
BOARD = chessboard(9, 6, 0.05)
PAIR = {"left": "kannala_brandt", "right": "brown_conrady"}
MODELS = {**PAIR, "side": "double_sphere"}


def the_rig():
    """Three cameras of three models and sizes, and their poses, camera from left."""
    cameras = {
        "left": ct.KannalaBrandt([300.0, 301, 320, 240], [0.02, -0.01, 0.003, -0.001], image_size=(480, 640)),
        "right": ct.BrownConrady([500.0, 500, 400, 300], [-0.2, 0.05, 0.001, -0.0005, 0.0], image_size=(600, 800)),
        "side": ct.DoubleSphere([280.0, 280, 320, 250], [-0.2, 0.6], image_size=(500, 640)),
    }
    turns = torch.tensor([[0, 0, 0], [0, 0.1, 0.02], [0.02, -0.9, 0]], dtype=torch.float64)
    shifts = torch.tensor([[0, 0, 0], [-0.2, 0, 0.01], [0.3, 0.02, 0.2]], dtype=torch.float64)
    return {name: camera.double().requires_grad_(False) for name, camera in cameras.items()}, turns, shifts


def seen(views=24, noise=NOISE):
    """Corners by the name of a camera, NaN where one does not see the board, and the poses of the boards."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64) - 0.5

    cameras, turns, shifts = the_rig()
    rotations = rotation_matrix(1.2 * draw(views, 3))
    away = torch.cat((1.6 * draw(views, 1) + 0.1, 0.5 * draw(views, 1), torch.ones(views, 1)), -1)
    translations = away * (1 + draw(views, 1)) - rotations @ BOARD.mean(0)
    pixels = {}
    for i, (name, camera) in enumerate(cameras.items()):
        points = (BOARD @ rotations.mT + translations[:, None]) @ rotation_matrix(turns[i]).mT + shifts[i]
        found, valid = camera.project(points)
        valid = valid & camera.contains(found)
        valid = valid & (valid.sum(-1, keepdim=True) >= 12)
        found = found + noise * torch.randn(found.shape, generator=generator, dtype=torch.float64)
        pixels[name] = torch.where(valid[..., None], found, torch.nan)
    return pixels, rotations, translations


def calibrated(pixels, models=MODELS, **options):
    sizes = {name: camera.image_size for name, camera in the_rig()[0].items() if name in models}
    return ct.calibrate_rig(models, BOARD, {name: pixels[name] for name in models}, image_sizes=sizes, **options)


@pytest.mark.slow
def test_cameras_and_poses_are_found_within_their_sigma():
    pixels, rotations, translations = seen()
    found = calibrated(pixels)
    cameras, turns, shifts = the_rig()
    assert found.converged
    assert found.sigma == pytest.approx(NOISE, rel=0.05)
    assert list(found.rig) == list(cameras)
    off = []
    for i, (name, camera) in enumerate(cameras.items()):
        near = torch.cat((found.rig[name].intrinsics, found.rig[name].distortion)).detach()
        off.append((near - torch.cat((camera.intrinsics, camera.distortion))) / found.std[name])
        if i:
            pose = found.rig.extrinsics[name]
            turn = rotation_vector(rotation_matrix(pose.rotation.detach()) @ rotation_matrix(turns[i]).mT)
            off.append(torch.cat((turn, pose.translation.detach() - shifts[i])) / found.mount_std[name])
    off = torch.cat(off)
    assert float(off.abs().max()) < 4
    assert 0.5 < float(off.square().mean().sqrt()) < 1.5
    for name, camera in found.cameras.items():  # each sees its corners through its own poses
        projected, _ = camera.camera.project(camera.extrinsics(BOARD.expand(24, -1, -1)))
        off = torch.where(torch.isnan(pixels[name]), torch.nan, projected - pixels[name]).detach()
        torch.testing.assert_close(off, found.residuals[name], equal_nan=True, atol=1e-8, rtol=0)
    # a board far away is tilted by a fifth of a pixel more or less
    torch.testing.assert_close(rotation_matrix(found.boards.rotation.detach()), rotations, atol=0.02, rtol=0)
    torch.testing.assert_close(found.boards.translation.detach(), translations, atol=0.01, rtol=0)


@pytest.mark.parametrize("noise", [0.0, pytest.param(1e-9, marks=pytest.mark.slow)])
def test_exact_corners_give_the_exact_rig(noise):
    """A little more than rounding, too, where the last steps gain less than it does to the cost."""
    pixels, rotations, _ = seen(views=10, noise=noise)
    found = calibrated(pixels, PAIR)
    assert found.converged
    assert found.rms < 1e-8
    for name in PAIR:
        camera = the_rig()[0][name]
        torch.testing.assert_close(found.rig[name].intrinsics.detach(), camera.intrinsics, rtol=1e-8, atol=1e-6)
    torch.testing.assert_close(rotation_matrix(found.boards.rotation.detach()), rotations, atol=1e-9, rtol=0)


@pytest.mark.slow
def test_views_of_different_moments_are_asked_about():
    pixels = seen(views=10)[0]
    with pytest.warns(UserWarning, match="all cameras took each view at the same moment"):
        assert not calibrated(pixels | {"right": pixels["right"].roll(1, 0)}, PAIR).converged


@pytest.mark.slow
def test_cameras_that_are_linked_by_a_third_one():
    pixels, _, _ = seen(views=10)
    pixels["right"][:5] = math.nan
    pixels["side"][5:] = math.nan
    found = calibrated(pixels)
    assert found.converged
    _, _, shifts = the_rig()
    torch.testing.assert_close(found.rig.extrinsics["side"].translation.detach(), shifts[2], atol=5e-3, rtol=0)


@pytest.mark.slow
def test_a_camera_that_is_held_stays_as_it_is():
    pixels, _, _ = seen(views=12)
    known = the_rig()[0]["left"]
    found = calibrated(pixels, {**PAIR, "left": known}, fixed={"left": "all", "right": ("cx",)})
    torch.testing.assert_close(found.rig["left"].intrinsics.detach(), known.intrinsics, rtol=0, atol=0)
    assert float(found.std["left"].abs().max()) == 0
    assert found.rig["right"].cx.item() == 399.5  # the middle
    assert float(found.std["right"][2]) == 0 < float(found.std["right"][3])


@pytest.mark.slow
def test_one_camera_is_a_rig_as_well():
    pixels, _, _ = seen(views=8)
    alone = ct.calibrate("kannala_brandt", BOARD, pixels["left"], image_size=(480, 640))
    found = calibrated(pixels, {"left": "kannala_brandt"})
    torch.testing.assert_close(found.rig["left"].intrinsics, alone.camera.intrinsics, rtol=1e-9, atol=0)
    torch.testing.assert_close(found.std["left"], alone.std, rtol=1e-6, atol=0)


def test_names_that_no_camera_has_are_refused():
    with pytest.raises(ValueError, match=r"^calibrate_rig: names must be those of cameras, .*; got 'middle'"):
        calibrated(seen(views=6)[0], PAIR, fixed={"middle": "all"})


@pytest.mark.slow
def test_views_are_copies_where_all_cameras_saw_the_same():
    pixels, *_ = seen(views=6)
    again = {name: torch.cat((p, p[:3])) for name, p in pixels.items()}
    noise = torch.randn(54, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    again["right"][7] += 0.3 * noise
    found = calibrated(again, PAIR)
    assert {copy for camera in found.cameras.values() for copy in camera.copies} == {6, 8}
    assert any("Copies of other views" in text for text in found.warnings)


@pytest.mark.slow
def test_a_single_view_names_the_camera_that_it_leaves_open():
    pixels, _, _ = seen(12)
    view = int((~pixels["right"].isnan().any(-1)).sum(-1).argmax())
    others = torch.arange(12) != view
    pixels["right"][others] = torch.nan
    models = {"left": "kannala_brandt", "right": "pinhole"}
    with pytest.raises(ValueError, match=r"^calibrate_rig: right: views must determine .*; got a single view"):
        calibrated(pixels, models=models)
