"""One wide image as several pinhole ones, and back again: seamless."""

import math

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


def test_views_without_weight_have_no_part_and_integers_do_not_wrap_around():
    camera, top = wide((120, 160)), torch.iinfo(torch.int64).max
    for views in (ct.views.cube(camera), ct.views.ring(camera, 3)):
        shape, weights = (1, len(views), 1, *views.view.image_size), views.weights()
        images = torch.rand(shape, generator=torch.Generator().manual_seed(0)).double()
        expected = views.back(images)[0][0, 0]
        images[:, 1] = math.inf
        result = views.back(images)[0][0, 0]
        free = weights[1] == 0
        assert torch.equal(result[free], expected[free])
        assert not result[weights.argmax(0) == 1].isfinite().any()
        result, valid = views.back(torch.full(shape, top))
        # what the largest integer loses as a float64, and weights in float32
        assert int(result[valid].min()) >= top * (1 - 1e-6)


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
