"""Rolling shutters: undone and put on as rows are rendered one by one, there and back, with gradients."""

from functools import partial

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from cameras import slow_unless
from scenes import room
from scenes.exposure import expose

import camtorch as ct

RATES, READOUT = (0.8, 2.5, 1.6), 0.03


def fisheye(size=(240, 320), fov=120.0, dtype=torch.float64):
    lens = [0.02, -0.01, 0.003, -0.001]
    return ct.KannalaBrandt.from_fov(fov, image_size=size, distortion=lens).to(dtype).requires_grad_(False)


def shutter(dtype=torch.float64, rates=RATES, readout=READOUT, **options):
    return ct.RollingShutter(torch.tensor(readout, dtype=dtype), torch.tensor(rates, dtype=dtype), **options)


def turns(times, rates):
    """(N, 3, 3): frame at time 0 from the camera's at each time, which turns at constant rates."""
    x, y, z = rates
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(torch.from_numpy(times)[:, None, None] * skew).numpy()


def moments(size, direction):
    """Times at which the lines of an image are read, in order of their coordinate."""
    count = size[0] if direction in ("down", "up") else size[1]
    times = READOUT * ((np.arange(count) + 0.5) / count - 0.5)
    return times if direction in ("down", "right") else -times


def psnr(a, b, where):
    return float(-10 * torch.log10(((a - b)[where.expand_as(a)] ** 2).mean()))


ONE_IS_QUICK = slow_unless("down".__eq__, ["down", "left"])


@pytest.mark.parametrize("direction", ONE_IS_QUICK)
def test_a_room_rendered_row_by_row(direction):
    camera, rates = fisheye(fov=40), (0.4, 1.5, 0.8)
    matrix = torch.from_numpy(turns(moments(camera.image_size, direction), rates)).float()
    matrix = matrix[:, None] if direction in ("down", "up") else matrix[None]
    rolled = expose(camera, lambda rays: room.radiance((matrix @ rays[..., None])[..., 0]), samples=4)
    still = room.render(camera, samples=4)
    undo = ct.ShutterWarp(camera, camera, shutter=shutter(rates=rates, direction=direction), mode="bicubic")
    put_on = undo.inverse()
    for warp, before, after in ((undo, rolled, still), (put_on, still, rolled)):
        # of half the resolution: what resampling costs at edges one pixel wide is not asked here
        made, wanted, first = (F.avg_pool2d(image[None], 2) for image in (warp(before[None])[0], after, before))
        where = F.avg_pool2d(warp.valid_mask().float(), 2) == 1
        assert where.float().mean() > 0.9
        assert psnr(made, wanted, where) > 40
        assert psnr(first, wanted, where) < 25


@pytest.mark.parametrize("direction", ["down", "left"])
def test_points_are_where_their_own_row_sees_them(direction):
    """By NumPy: each line of the image sees every point somewhere; where that is on the line itself, the point is."""
    camera = fisheye(fov=90)
    points = room.keypoints().numpy()
    points = points[points[:, 2] > 1.5]
    times = moments(camera.image_size, direction)
    axis = 1 if direction in ("down", "up") else 0
    found = []
    for point in points:
        track = camera.project(torch.from_numpy(np.einsum("nji,j->ni", turns(times, RATES), point)))[0].numpy()
        ahead = track[:, axis] - np.arange(len(times))
        i = int(np.argmax(np.diff(np.sign(ahead)) != 0))
        share = ahead[i] / (ahead[i] - ahead[i + 1])
        crosses = ahead[i] * ahead[i + 1] <= 0
        found.append(track[i] + share * (track[i + 1] - track[i]) if crosses else [np.nan, np.nan])
    expected = torch.from_numpy(np.array(found))
    still, seen = camera.project(torch.from_numpy(points))
    warp = ct.ShutterWarp(camera, camera, target_shutter=shutter(direction=direction))
    moved, valid = warp.transform_points(still)
    use = valid & seen & camera.contains(expected)
    assert use.sum() > 15
    assert (moved - expected)[use].abs().max() < 1e-3  # of lines between which the track is taken for straight
    assert (moved - still)[use].abs().max() > 3
    back, valid = warp.inverse().transform_points(expected)
    assert (back - still)[use & valid].abs().max() < 1e-3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["shutter", "target_shutter"])
def test_without_a_readout_it_is_the_plain_warp(name, dtype):
    camera, straight = fisheye(dtype=dtype), ct.Pinhole.from_fov(80, image_size=(200, 300)).to(dtype)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.2, 0.1], [0.2, 0, -0.3], [-0.1, 0.3, 0]], dtype=dtype))
    image = torch.rand(2, 3, 240, 320, dtype=dtype)
    plain, warp = (
        kind(camera, straight.requires_grad_(False), turn, **options)
        for kind, options in ((ct.Warp, {}), (ct.ShutterWarp, {name: shutter(dtype, readout=0.0)}))
    )
    # the turn is rounded alike or not, a few times: some hundred pixels from the centre
    close = partial(torch.testing.assert_close, rtol=0, atol=4096 * torch.finfo(dtype).eps)
    close(plain(image), warp(image))
    close(plain.grid(), warp.grid())
    assert (plain.valid_mask() != warp.valid_mask()).sum() <= 4
    pixels = torch.rand(50, 2, dtype=dtype) * 240
    close(plain.transform_points(pixels)[0], warp.transform_points(pixels)[0])


def test_both_shutters_one_lens_for_another():
    camera, other = fisheye(), ct.Pinhole.from_fov(80, image_size=(240, 320)).double().requires_grad_(False)
    down, up = shutter(), shutter(direction="up", rates=(1.0, -2.0, 0.5))
    warp = ct.ShutterWarp(camera, other, shutter=down, target_shutter=up)
    pixels = torch.tensor([[150.0, 60.0], [200.0, 140.0]], dtype=torch.float64)
    between = ct.ShutterWarp(camera, other, shutter=down).transform_points(pixels)[0]
    expected = ct.ShutterWarp(other, other, target_shutter=up).transform_points(between)[0]
    moved, valid = warp.transform_points(pixels)
    assert valid.all()
    assert torch.allclose(moved, expected, atol=1e-9)
    assert torch.allclose(warp.inverse().transform_points(moved)[0], pixels, atol=1e-9)
    _, valid = warp.transform_boxes(torch.tensor([[100.0, 50.0, 180.0, 160.0]], dtype=torch.float64))
    assert valid.all()
    assert torch.equal(warp.transform_rays(torch.eye(3, dtype=torch.float64)), torch.eye(3, dtype=torch.float64))


def test_a_scene_that_overtakes_the_rows_is_invalid_and_finite():
    camera = fisheye((60, 80))
    warp = ct.ShutterWarp(camera, camera, target_shutter=shutter(rates=(60.0, 0.0, 0.0), readout=0.1))
    rates = torch.tensor([60.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    learned = ct.ShutterWarp(camera, camera, target_shutter=ct.RollingShutter(0.1, rates))
    pixels = camera.pixel_grid()
    for each in (warp, learned):
        moved, valid = each.transform_points(pixels)
        assert not valid.all()
        back, seen = each.inverse().transform_points(moved)
        assert (back - pixels)[valid & seen].abs().max() < 1e-3  # of a pixel, as far as the time is searched for
        assert torch.isfinite(moved).all()
        assert torch.isfinite(each.grid()).all()
    moved.sum().backward()
    assert torch.isfinite(rates.grad).all()


def test_a_lattice_has_the_derivatives_of_a_learning_camera_behind_a_shutter():
    v, u = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    image = (torch.sin(u / 15) * torch.cos(v / 14))[None, None].double()
    found = []
    for tolerance in (1e-3, 0.0):
        camera = fisheye().requires_grad_(True)
        warp = ct.ShutterWarp(camera, fisheye(), shutter=shutter(), tolerance=tolerance)
        warp(image).square().sum().backward()
        found.append(torch.cat([number.grad for number in camera.parameters()]))
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-5 * float(found[1].abs().max()))


def test_states_of_0_3_load():
    made = shutter()
    state = made.state_dict()
    assert sorted(state) == ["rates", "readout"]
    other = shutter(rates=(0.0, 0.0, 0.0))
    other.load_state_dict({**state, "exposure": torch.tensor(0.0)})
    assert torch.equal(other.rates, made.rates)
