"""What is said of a point does not depend on what else is in its batch, nor on the parts in which that is evaluated."""

import math

import pytest
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from cameras import RARE_ARE_SLOW, drawn, each_kind, fan, make, one, pixel_lattice, spread
from hypothesis import given, settings
from hypothesis import strategies as st

import camtorch as ct
from camtorch.native.library import native_available
from camtorch.optics.charts import Perspective
from camtorch.warp import grid, sampling
from camtorch.warp.grid import Sampling


def batch_of(key, count):
    single = spread(key)
    scale = 1 + 0.05 * torch.arange(count, dtype=torch.float64)[:, None]
    return make(key, single.intrinsics.detach() * scale, single.distortion.detach() * scale, image_size=(480, 640))


def awkward_points(key, count):
    """Valid ones, and in between what is behind, beyond the fold, at the origin, huge, tiny, or no number."""
    points = fan(88 if isinstance(one(key).optics(spread(key).distortion.unbind(-1))[0], Perspective) else 170)
    bad = [[0, 0, 0], [math.nan, 1, 1], [0, 0, -1], [1e-3, 0, -1], [math.inf, 0, 1], [1e200, 1e199, 1e200]]
    bad += [[1e-80, 2e-80, 3e-80], [0, 0, 1], [0, 0, 1e-5], [3, 4, 1e-3]]
    points = torch.cat((points, torch.tensor(bad, dtype=torch.float64)))
    generator = torch.Generator().manual_seed(0)
    return points[torch.randint(len(points), (count,), generator=generator)]


def everything(camera, method, values):
    values = values.clone().requires_grad_()
    result, valid = getattr(camera, method)(values)
    weights = torch.linspace(-1, 2, result.numel(), dtype=result.dtype).view_as(result)
    leaves = [values, *(p for p in camera.parameters() if p.numel())]
    return result.detach(), valid, *torch.autograd.grad((result * weights).sum(), leaves)


@each_kind
@pytest.mark.parametrize("method", ["project", "unproject"])
def test_planes_and_triples_are_the_same(key, method):
    camera = one(key)
    values = awkward_points(key, 200) if method == "project" else pixel_lattice(camera)
    planes = values.T.contiguous().T
    for result, expected in zip(everything(camera, method, planes), everything(camera, method, values), strict=True):
        torch.testing.assert_close(result, expected, rtol=1e-12, atol=1e-10)


@pytest.mark.skipif(not native_available(), reason="autograd keeps more of the formula")
@each_kind
@pytest.mark.parametrize(("method", "limit"), [("project", 32), ("unproject", 40)])
def test_bytes_kept_for_backward(key, method, limit):
    """Of a float32 point: what came in, whether it is valid, and a plane or two."""
    camera = one(key).float()
    count = 10_000
    points = (torch.rand(count, 3) + torch.tensor([-0.5, -0.5, 1.0])).requires_grad_()
    values = points if method == "project" else camera.project(points)[0].detach().contiguous().requires_grad_()
    kept = {}

    def pack(tensor):
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        result, _ = getattr(camera, method)(values)
    assert result.requires_grad
    assert sum(kept.values()) <= limit * count
    with torch.no_grad(), torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        kept.clear()
        getattr(camera, method)(values)
    assert not kept


@pytest.mark.parametrize("key", RARE_ARE_SLOW)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("end", [20, 179])
def test_few_points_of_a_learning_camera(key, dtype, end):
    learning = spread(key, dtype)
    frozen, rays = learning.detach(), fan(end, 20, 12).to(dtype)
    pixels, valid = frozen.project(rays)
    values = pixels[valid] if end < 90 else pixel_lattice(frozen, 20, 30).to(dtype) * 1.5 - 100
    for method, some, atol in (("project", rays, 0), ("unproject", values, 200 * torch.finfo(dtype).eps)):
        (expected, valid), (result, found) = (getattr(camera, method)(some) for camera in (frozen, learning))
        assert torch.equal(found, valid)
        torch.testing.assert_close(result, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("key", RARE_ARE_SLOW)
def test_a_pixel_is_valid_alone_as_in_a_batch(key):
    """The images of rays around the fold, where it is hard to tell, and pixels far from any ray."""

    @settings(max_examples=3)
    @given(drawn(key, wild=True), st.integers(0, 1000), st.sampled_from([torch.float32, torch.float64]))
    def law(camera, offset, dtype):
        camera = camera.requires_grad_(False).to(dtype)
        pixels, valid = camera.project(fan(179, 60, 12).to(dtype))
        rim = (valid.view(60, 12).sum(0) - 1).clamp(min=0) * 12 + torch.arange(12)
        away = (pixels - camera.intrinsics[2:]) * torch.linspace(0.9, 1.1, 7, dtype=dtype).view(-1, 1, 1)
        near = (camera.intrinsics[2:] + away[:, rim]).flatten(0, 1)
        some = torch.cat((near[offset % 4 :: 4], near[:3] * 100, near.new_tensor([[320.0, 240.0]])))
        rays, together = camera.unproject(torch.cat((some, near)))
        for i, pixel in enumerate(some):
            ray, alone = camera.unproject(pixel)
            assert bool(alone) == bool(together[i]), pixel
            assert (ray - rays[i]).abs().max() < torch.finfo(dtype).eps ** 0.5

    law()


@pytest.mark.slow
def test_two_classes_of_one_name_keep_their_own_lens():
    def build(factor):
        class Mine(ct.KannalaBrandt):
            @staticmethod
            def optics(k):
                return ct.KannalaBrandt.optics([factor * c for c in k])

        return Mine

    first, second = build(1.0), build(3.0)
    points = torch.tensor([[0.5, 0.2, 1.0]])
    for model in (first, second, first):
        camera = model([300.0, 300, 320, 240], [0.05, 0.0, 0.0, 0.0])
        compiled = torch.compile(camera.unproject, backend="eager", fullgraph=True)
        pixels = camera.project(points)[0].detach()
        torch.testing.assert_close(compiled(pixels)[0], camera.unproject(pixels)[0])
    assert first._model != second._model


# -- images


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 4, 5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.uint8, torch.bool])
def test_parts_of_images_change_nothing(threads, count, dtype, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr(sampling, "native_available", lambda: False)
    generator = torch.Generator().manual_seed(0)
    images = (255 * torch.rand(count, 3, 11, 13, generator=generator)).to(dtype)
    positions = 2.4 * torch.rand(count, 7, 5, 2, generator=generator) - 1.2
    where = Sampling(positions, torch.ones(count, 7, 5, dtype=torch.bool), None)
    for mode in ("bilinear", "nearest", "bicubic"):
        result = sampling.render(images, where, mode, "zeros", (0.0,))
        wide = images.double() if dtype == torch.float64 else images.float()
        expected = F.grid_sample(wide, positions.to(wide.dtype), mode, "zeros", align_corners=False)
        if dtype == torch.uint8:
            expected = expected.round().clamp(0, 255)
        assert result.dtype == dtype
        assert torch.equal(result, expected >= 0.5 if dtype == torch.bool else expected.to(dtype))


@pytest.mark.parametrize("cameras", [None, 3])
def test_strips_of_a_map_change_nothing(cameras, monkeypatch):
    source = batch_of("brown_conrady", cameras) if cameras else spread("brown_conrady")
    target = ct.Cylindrical([15.0, 12.0, 30.5, 20.25], image_size=(41, 63))
    for one_camera in (source, target):
        one_camera.requires_grad_(False)
    whole = ct.Warp(source, target)
    monkeypatch.setattr(grid, "_STRIP", 7 * 63)
    strips = ct.Warp(source, target)
    assert torch.equal(strips.grid(), whole.grid())
    assert torch.equal(strips.valid_mask(), whole.valid_mask())
    assert (whole.grid() == -9).any()


def test_no_cameras_make_no_images():
    source = ct.Pinhole(torch.ones(0, 4), image_size=(8, 8)).requires_grad_(False)
    nothing = ct.Warp(source, ct.Pinhole([4.0, 4, 4, 4], image_size=(8, 8)).requires_grad_(False))
    assert nothing(torch.rand(0, 1, 8, 8)).shape == (0, 1, 8, 8)
