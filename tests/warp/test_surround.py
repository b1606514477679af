"""Several cameras in one image, and one wide image as several pinhole ones: seamless, and back again."""

import math
from functools import cache

import pytest
import torch

import camtorch as ct
from camtorch.rotations import rotation_matrix

LEVEL = torch.tensor(
    [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]
).double()  # camera from a rig whose z points up: it looks along y


def wide(size=(360, 480), degrees=190):
    height, width = size
    focal = width / 2 / math.radians(degrees / 2)
    camera = ct.KannalaBrandt([focal, focal, (width - 1) / 2, (height - 1) / 2], [0.01, 0, 0, 0], image_size=size)
    return camera.double().requires_grad_(False)


def about(axis, degrees):
    return rotation_matrix(torch.tensor(axis).double() * math.radians(degrees))


def car(pitch=30.0):
    """Four wide cameras around a car: front, right, back and left."""
    places = {
        "front": (0.0, 2, 0.7, 0),
        "right": (1.0, 0, 1, -90),
        "back": (0.0, -2, 0.9, 180),
        "left": (-1.0, 0, 1, 90),
    }
    extrinsics = {}
    for name, (x, y, z, yaw) in places.items():
        rotation = about([1.0, 0, 0], pitch) @ LEVEL @ about([0, 0, 1.0], -yaw)
        shift = -rotation @ torch.tensor([x, y, z]).double()
        extrinsics[name] = ct.Extrinsics.from_matrix(rotation, shift).requires_grad_(False)
    return ct.Rig({name: wide() for name in places}, extrinsics)


def floor(points):
    return 0.5 + 0.2 * (torch.sin(1.5 * points[..., 0]) + torch.cos(2 * points[..., 1]))


def sky(rays):
    return 0.5 + 0.4 * torch.sin(4 * rays).prod(-1)


def of_floor(camera, extrinsics):
    rays, valid = camera.rays()
    matrix = extrinsics.matrix()
    rays, place = rays @ matrix[:3, :3], extrinsics.position
    hits = valid & (rays[..., 2] < -1e-3)
    points = place[:2] - rays[..., :2] * (place[2] / torch.where(hits, rays[..., 2], -1.0))[..., None]
    return torch.where(hits, floor(points), 0.0)[None, None]


@pytest.mark.parametrize("dtype", [torch.float64, torch.uint8])
def test_four_cameras_from_above_have_no_seams(dtype):
    rig = car()
    around = ct.surround(rig, x=(-4, 4), y=(-5, 5), resolution=0.04)
    images = {name: of_floor(camera, rig.extrinsics[name]) for name, camera in rig.items()}
    if dtype == torch.uint8:
        images = {name: (255 * image).round().to(dtype) for name, image in images.items()}
    result, valid = around(images)
    assert result.dtype == dtype
    points = around.warp("front").grid_points
    assert valid[0, 0].double().mean() > 0.95
    scale = 255 if dtype == torch.uint8 else 1
    error = (result.double() / scale - floor(points)).abs()[valid]
    # a grey level, where a floor far away is enlarged too
    assert float(error.quantile(0.99)) < 1 / 255
    for handed in around.weights().values():  # belongs to the caller
        handed.zero_()
    weights = torch.stack(list(around.weights().values()))
    torch.testing.assert_close(weights.sum(0)[valid], torch.ones_like(weights.sum(0)[valid]))
    assert (weights.sum(0)[~valid] == 0).all()
    # but for corners at which the fields of view of two cameras only just meet
    jump = (weights[..., 1:, :] - weights[..., :-1, :]).abs()[:, valid[..., 1:, :] & valid[..., :-1, :]]
    assert float((jump > 0.2).double().mean()) < 1e-3


@pytest.mark.parametrize("distance", [math.inf, 30.0])
def test_a_panorama_is_what_lies_around(distance):
    rig = car(pitch=0)
    target = ct.Equirectangular([100.0, 100, 313.5, 156.5], image_size=(314, 628)).double().requires_grad_(False)
    target = target.resize(157, 314)
    # the panorama looks along its own z: turned so that this is the rig's y
    turned = {
        name: ct.Extrinsics.from_matrix(pose.matrix()[:3, :3] @ LEVEL.mT, pose.translation)
        for name, pose in rig.extrinsics.items()
    }
    rig = ct.Rig(dict(rig.items()), {name: pose.requires_grad_(False) for name, pose in turned.items()})
    around = ct.surround(rig, target, distance=distance)
    images = []
    for name, camera in rig.items():
        rays, _ = camera.rays()
        pose = rig.extrinsics[name]
        rays = rays @ pose.matrix()[:3, :3]
        if math.isfinite(distance):
            along = (rays * pose.position).sum(-1, keepdim=True)
            inside = along.square() + distance**2 - pose.position.square().sum()
            rays = torch.nn.functional.normalize(pose.position + rays * (inside.sqrt() - along), dim=-1)
        images.append(sky(rays)[None, None])
    result, valid = around(images)
    rays, _ = target.rays()
    assert valid.double().mean() > 0.7
    torch.testing.assert_close(result[valid], sky(rays)[None, None][valid], rtol=0, atol=0.02)


def test_a_wide_image_goes_to_a_cube_and_back():
    camera = wide((480, 640))
    rays, valid = camera.rays()
    image = torch.stack([sky(rays), sky(rays.flip(-1)), sky(-rays)])[None]
    faces = ct.views.cube(camera)
    assert faces.names == ("front", "right", "back", "left", "up", "down")
    made = faces(image)
    assert made.shape == (1, 6, 3, *faces.view.image_size)
    again, shown = faces.back(made)
    assert torch.equal(shown[0, 0], valid)
    # at the rim of the image a face has no neighbours to interpolate between
    inner = (camera.pixel_grid() - camera.pixel_grid().mean((0, 1))).norm(dim=-1) < 230
    noise = (again - image)[..., inner].square().mean()
    assert 10 * math.log10(1 / float(noise)) > 40
    pixel, seen = faces.warps[1].transform_points(camera.project(torch.tensor([[1.0, 0.1, 0.2]]).double())[0])
    assert seen.all()
    torch.testing.assert_close(pixel, faces.view.project(torch.tensor([[-0.2, 0.1, 1.0]]).double())[0])


def test_a_ring_of_views_and_back():
    camera = wide((480, 640), 170)
    rays, _ = camera.rays()
    image = sky(rays)[None, None]
    views = ct.views.ring(camera, 3)
    assert len(views) == 3
    again, shown = views.back(views(image))
    middle = torch.zeros_like(shown)
    middle[..., 200:280, 20:-20] = True
    assert shown[middle].all()
    assert (again - image)[middle].abs().max() < 0.01
    labels = (255 * views(image)).round().to(torch.uint8)
    assert views.back(labels)[0].dtype == torch.uint8


@cache
def wholes(mode="nearest"):
    """What makes one image of several: their count, their size, how, and the weights of each (N, H, W)."""
    camera, rig = wide((120, 160)), car()
    views = ct.views.cube(camera, mode=mode), ct.views.ring(camera, 3, mode=mode)
    made = [(len(v), v.view.image_size, v.back, v.weights()) for v in views]
    around = ct.surround(rig, x=(-4, 4), y=(-5, 5), resolution=0.1, mode=mode)
    weights = torch.stack(list(around.weights().values()))[:, 0, 0]
    return [*made, (4, (360, 480), lambda images: around(images.unbind(1)), weights)]


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int32, torch.uint64, torch.int64, torch.float32])
def test_the_label_of_the_heaviest_view_wins(dtype):
    for count, size, back, weights in wholes():
        if dtype == torch.bool:
            labels = [i % 2 == 0 for i in range(count)]
        else:  # in 64 bits neighbours that are one float64
            top = torch.iinfo(dtype).max if not dtype.is_floating_point else 2**24
            labels = [top - i for i in range(count)]
        of_each = torch.stack([torch.full((1, 1, *size), label, dtype=dtype) for label in labels], 1)
        result, valid = back(of_each)
        assert result.dtype == dtype
        expected = torch.tensor(labels, dtype=dtype)[weights.argmax(0)]
        assert torch.equal(result[valid], expected[valid[0, 0]])
        assert valid.any()
        assert not result[~valid].any()


@pytest.mark.parametrize(("mode", "dtype"), [("bilinear", torch.int64), ("nearest", torch.int32)])
def test_the_largest_integers_do_not_wrap_around(mode, dtype):
    top = torch.iinfo(dtype).max
    for count, size, back, _ in wholes(mode):
        result, valid = back(torch.full((1, count, 1, *size), top, dtype=dtype))
        # what the largest integer loses as a float64, and weights in float32
        assert int(result[valid].min()) >= top - (top * 1e-6 if mode == "bilinear" else 0)


@pytest.mark.parametrize(("mode", "bad"), [("bilinear", math.inf), ("nearest", math.nan)])
def test_a_view_without_weight_has_no_part(mode, bad):
    for count, size, back, weights in wholes(mode):
        images = torch.rand(1, count, 1, *size, generator=torch.Generator().manual_seed(0)).double()
        expected = back(images)[0][0, 0]
        images[:, 1] = bad
        result = back(images)[0][0, 0]
        free = weights[1] == 0
        assert torch.equal(result[free], expected[free])
        assert not result[weights.argmax(0) == 1].isfinite().any()


def test_views_give_no_label_that_is_in_no_image():
    camera = ct.KannalaBrandt.from_fov(190, image_size=(100, 160)).requires_grad_(False)
    views = ct.views.cube(camera, mode="nearest")
    labels, valid = views.back(views(torch.randint(1, 5, (1, 1, 100, 160))))
    assert valid.float().mean() > 0.99
    assert (labels[valid] > 0).all()
