"""Disparities of rectified images, by OpenCV's semi-global matching."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from camtorch.stereo.rectification import Rectification

_BLOCK = 5  # pixels, the side of what is compared
_STEP = 16  # the matcher's disparities are 16ths, and as many pixels are the least range of them
_ROUNDING = 1e-6  # px, by which a disparity may be off zero


def opencv() -> Any:
    """The module `cv2`, or an ImportError that says how to install it."""
    try:
        import cv2
    except ImportError:
        raise ImportError('disparities need OpenCV: pip install "camtorch[stereo]"') from None
    return cv2


def match(
    rectification: Rectification, left: Tensor, right: Tensor, least: float, most: float
) -> tuple[Tensor, Tensor]:
    """Disparities (H, W) of the rectified left image, NaN where none is known, and where both cameras see the place.

    Args:
        rectification: of one pair; where its columns correspond, disparities lie along them.
        left: (C, H, W) uint8 or uint16, what `rectification.left` made; a fourth channel is left out.
        right: likewise.
        least: the least disparity to look for, in pixels, negative where the right camera stands to the left.
        most: the greatest.
    """
    cv2 = opencv()
    images = _of_bytes(left, right, rectification.vertical)
    start = math.floor(least + _ROUNDING)
    count = _STEP * max(1, math.ceil((math.ceil(most - _ROUNDING) - start + 1) / _STEP))
    # the matcher leaves out columns from where it could look past the image
    before, after = max(start + count, 0), max(-start, 0)
    padded = [cv2.copyMakeBorder(image, 0, 0, before, after, cv2.BORDER_REPLICATE) for image in images]
    channels = 1 if images[0].ndim == 2 else images[0].shape[2]
    matcher = cv2.StereoSGBM_create(
        minDisparity=start,
        numDisparities=count,
        blockSize=_BLOCK,
        P1=8 * channels * _BLOCK**2,
        P2=32 * channels * _BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
    )
    raw = matcher.compute(*padded)[:, before : before + images[0].shape[1]]
    raw = np.ascontiguousarray(raw.T if rectification.vertical else raw)
    disparity = torch.from_numpy(raw.astype(np.float32) / _STEP)
    seen_left, seen_right, _ = (mask[0, 0] for mask in rectification.valid_masks())
    known = (disparity >= start) & seen_left & _seen(seen_right, disparity, rectification.vertical)
    return torch.where(known, disparity, torch.nan), known


def _of_bytes(left: Tensor, right: Tensor, vertical: bool) -> list[NDArray[np.uint8]]:
    """(H, W, C), or (H, W) of one channel, of images of one scale, with rows that correspond."""
    order = (2, 1, 0) if vertical else (1, 2, 0)
    arrays = [image[: 3 if len(image) > 2 else 1].permute(order).numpy() for image in (left, right)]
    if any(array.dtype != np.uint8 for array in arrays):
        scale = 255 / max(1.0, *(float(array.max()) for array in arrays))
        arrays = [np.rint(array * scale).astype(np.uint8) for array in arrays]
    return [np.ascontiguousarray(array[..., 0] if array.shape[2] == 1 else array) for array in arrays]


def _seen(mask: Tensor, disparity: Tensor, vertical: bool) -> Tensor:
    """Whether the right camera sees what a disparity says."""
    dim = 0 if vertical else 1
    places = torch.arange(disparity.shape[dim]).unsqueeze(1 - dim) - disparity
    nearest = places.round().long()
    inside = (nearest >= 0) & (nearest < disparity.shape[dim])
    return inside & mask.gather(dim, nearest.clamp(0, disparity.shape[dim] - 1))
