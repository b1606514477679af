"""Images shrunk without false patterns: sampled in a pyramid of smaller images, at each pixel in the right one."""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch._tracing import may_look
from camtorch.warp.sampling import sample

_TRACED_LEVELS = 4  # where the values that decide cannot be looked at: down to a sixteenth


def local_scale(grid: Tensor, mapped: Tensor, size: tuple[int, int]) -> Tensor:
    """(B, H', W'): how many source pixels lie between neighbours of the target, in the direction with more of them.

    Args:
        grid: (B, H', W', 2), sampling positions.
        mapped: (B, H', W') bool: there is such a position.
        size: (height, width) of the source.
    """
    half = grid.new_tensor([size[1] / 2, size[0] / 2])
    scale = grid.new_zeros(grid.shape[:-1])
    for dim in (1, 2):
        n = grid.shape[dim] - 1
        step = ((grid.narrow(dim, 1, n) - grid.narrow(dim, 0, n)) * half).norm(dim=-1)
        step = step * (mapped.narrow(dim, 1, n) & mapped.narrow(dim, 0, n))
        for start in (0, 1):
            here = scale.narrow(dim, start, n)
            here.copy_(torch.maximum(here, step))
    return scale


def sample_minified(images: Tensor, grid: Tensor, scale: Tensor, mode: str, padding_mode: str) -> Tensor:
    """`sample` of floating-point images, in which a pixel that covers n source pixels takes the mean of about as many.

    The method is mip mapping (Williams, Pyramidal Parametrics, 1983): every level halves the image by a triangle
    filter, and between levels is interpolated.

    Args:
        images: (B, C, H, W).
        grid: (B, H', W', 2).
        scale: (B or 1, H', W') of `local_scale`.
        mode: see `sample`.
        padding_mode: see `sample`.
    """
    level = scale.clamp(min=1).log2().unsqueeze(1)
    last = min(images.shape[-2:]).bit_length() - 1
    wanted = int(level.amax().ceil()) if may_look(level) else _TRACED_LEVELS
    result = sample(images, grid, mode, padding_mode)
    for n in range(min(wanted, last)):
        half = [max(side // 2, 1) for side in images.shape[-2:]]
        images = F.interpolate(images, half, mode="bilinear", align_corners=False, antialias=True)
        smaller, share = sample(images, grid, mode, padding_mode), (level - n).clamp(0, 1).to(result)
        # an image without a share has no part either in what is not a number
        blended = torch.where(share < 1, torch.lerp(result, smaller, share), smaller)
        result = torch.where(share > 0, blended, result)
    return result
