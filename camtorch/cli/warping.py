"""Images of the command line through warps, large ones too."""

from __future__ import annotations

import torch
from torch import Tensor

from camtorch.cli.terminal import progress
from camtorch.warp.warp import Warp


def warped(warp: Warp, image: Tensor, what: str) -> tuple[Tensor, float]:
    """An image (C, H, W) through a warp, by strips, and the filled part of it; `what` is what is shown meanwhile."""
    height, width = warp.target.height, warp.target.width
    # as image files have it, channels last: they need no copy
    result = torch.empty(height, width, len(image), dtype=image.dtype).permute(2, 0, 1)
    filled, show = 0, progress(what)
    for rows, part, valid in warp.strips(image[None]):
        result[:, rows] = part[0]
        filled += int(valid.sum())
        show(rows.stop / height)
    return result, filled / (height * width)
