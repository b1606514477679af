"""One wide image as several pinhole ones, and back again: seamless."""

import math
from functools import cache

import pytest
import torch

import camtorch as ct


def wide(size=(360, 480), degrees=190):
    height, width = size
    focal = width / 2 / math.radians(degrees / 2)
    camera = ct.KannalaBrandt([focal, focal, (width - 1) / 2, (height - 1) / 2], [0.01, 0, 0, 0], image_size=size)
    return camera.double().requires_grad_(False)


def sky(rays):
    return 0.5 + 0.4 * torch.sin(4 * rays).prod(-1)


@cache
def wholes(mode="nearest"):
    """What makes one image of several: their count, their size, how, and the weights of each (N, H, W)."""
    camera = wide((120, 160))
    views = ct.views.cube(camera, mode=mode), ct.views.ring(camera, 3, mode=mode)
    return [(len(v), v.view.image_size, v.back, v.weights()) for v in views]


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int32, torch.uint64, torch.int64, torch.float32])
def test_the_label_of_the_heaviest_view_wins(dtype):
    if torch.__version__.startswith("2.10.") and dtype == torch.uint64:
        pytest.skip("torch.where of torch 2.10 takes no uint64")
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


@pytest.mark.parametrize(("mode", "dtype"), [("bilinear", torch.uint16), ("nearest", torch.int32)])
def test_the_largest_integers_do_not_wrap_around(mode, dtype):
    top = torch.iinfo(dtype).max
    for count, size, back, _ in wholes(mode):
        result, valid = back(torch.full((1, count, 1, *size), top, dtype=dtype))
        # what the largest integer loses as a float64, and weights in float32
        assert int(result[valid].long().min()) >= top - (top * 1e-6 if mode == "bilinear" else 0)


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


@pytest.mark.parametrize(("kind", "degrees"), [("cube", 190), ("ring", 170)])
def test_a_wide_image_goes_to_views_and_back(kind, degrees):
    camera = wide((480, 640), degrees)
    rays, valid = camera.rays()
    image = torch.stack([sky(rays), sky(rays.flip(-1)), sky(-rays)])[None]
    views = ct.views.cube(camera) if kind == "cube" else ct.views.ring(camera, 3)
    made = views(image)
    assert made.shape == (1, len(views), 3, *views.view.image_size)
    again, shown = views.back(made)
    inner = torch.zeros(480, 640, dtype=torch.bool)
    if kind == "cube":
        assert views.names == ("front", "right", "back", "left", "up", "down")
        assert torch.equal(shown[0, 0], valid)
        # at the rim of the image a face has no neighbours to interpolate between
        inner = (camera.pixel_grid() - camera.pixel_grid().mean((0, 1))).norm(dim=-1) < 230
        pixel, seen = views.warps[1].transform_points(camera.project(torch.tensor([[1.0, 0.1, 0.2]]).double())[0])
        assert seen.all()
        torch.testing.assert_close(pixel, views.view.project(torch.tensor([[-0.2, 0.1, 1.0]]).double())[0])
    else:
        inner[200:280, 20:-20] = True
        assert views.back((255 * made).round().to(torch.uint8))[0].dtype == torch.uint8
    assert shown[..., inner].all()
    noise = (again - image)[..., inner]
    assert noise.abs().max() < 0.05
    assert 10 * math.log10(1 / float(noise.square().mean())) > 40
