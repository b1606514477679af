"""What is said of a point does not depend on what else is in its batch."""

import pytest
import torch
from cameras import RARE_ARE_SLOW, drawn, fan
from hypothesis import given, settings
from hypothesis import strategies as st


@pytest.mark.parametrize("key", RARE_ARE_SLOW)
@pytest.mark.parametrize("dtype", [torch.float32, pytest.param(torch.float64, marks=pytest.mark.slow)])
def test_a_pixel_is_valid_alone_as_in_a_batch(key, dtype):
    """The images of rays around the fold, where it is hard to tell, and pixels far from any ray."""

    @settings(max_examples=3)
    @given(drawn(key, wild=True), st.integers(0, 1000))
    def law(camera, offset):
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
