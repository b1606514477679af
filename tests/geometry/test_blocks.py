"""What is said of a point does not depend on what else is in its batch, nor on the parts in which that is evaluated."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from cameras import RARE_ARE_SLOW, drawn, each_kind, fan, one
from hypothesis import given, settings
from hypothesis import strategies as st

import camtorch as ct
from camtorch.native.library import native_available
from camtorch.warp import grid_sample, sampling
from camtorch.warp.lattice import PixelPositions
from camtorch.warp.options import Sampler


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


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 4, 5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.uint8, torch.bool])
def test_parts_of_images_change_nothing(threads, count, dtype, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr(grid_sample, "native_available", lambda: False)
    images = (255 * torch.rand(count, 3, 11, 13)).to(dtype)
    positions = 2.4 * torch.rand(count, 7, 5, 2) - 1.2
    where = PixelPositions(positions, torch.ones(count, 7, 5, dtype=torch.bool), None)
    for mode in ("bilinear", "nearest", "bicubic"):
        result = sampling.render(images, where, Sampler(mode, "zeros", (0.0,)))
        wide = images.double() if dtype == torch.float64 else images.float()
        expected = F.grid_sample(wide, positions.to(wide.dtype), mode, "zeros", align_corners=False)
        if dtype == torch.uint8:
            expected = expected.round().clamp(0, 255)
        assert result.dtype == dtype
        assert torch.equal(result, expected >= 0.5 if dtype == torch.bool else expected.to(dtype))


def test_no_cameras_make_no_images():
    source = ct.Pinhole(torch.ones(0, 4), image_size=(8, 8)).requires_grad_(False)
    nothing = ct.Warp(source, ct.Pinhole([4.0, 4, 4, 4], image_size=(8, 8)).requires_grad_(False))
    assert nothing(torch.rand(0, 1, 8, 8)).shape == (0, 1, 8, 8)
