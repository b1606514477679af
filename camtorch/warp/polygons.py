"""Outlines of boxes and polygons: enough points along the edges to follow them where a lens bends them."""

from __future__ import annotations

import torch
from torch import Tensor

EDGE_SAMPLES = 64  # per edge: one of 500 px bent to a radius of 300 px is then enclosed to 0.03 px


def corners_of(boxes: Tensor) -> Tensor:
    """(..., 4, 2): the corners of boxes (..., 4) of x1 y1 x2 y2, clockwise from (x1, y1)."""
    x1, y1, x2, y2 = boxes.unbind(-1)
    return torch.stack((x1, y1, x2, y1, x2, y2, x1, y2), -1).unflatten(-1, (4, 2))


def along_edges(corners: Tensor, samples: int) -> Tensor:
    """(..., samples * K, 2): even steps along the edges of closed polygons (..., K, 2), the corners among them."""
    share = torch.linspace(0, 1, samples + 1, dtype=corners.dtype, device=corners.device)[:-1, None]
    start, end = corners.unsqueeze(-2), corners.roll(-1, -2).unsqueeze(-2)
    return (start + (end - start) * share).flatten(-3, -2)


def outlines(boxes: Tensor, samples: int = 16) -> Tensor:
    """The outlines of boxes, as polygons that an augmentation moves point by point.

    At the rim of a fisheye a box that encloses its warped outline is mostly background; the outline is not.

    Args:
        boxes: (..., 4) of x1 y1 x2 y2.
        samples: points on each edge.

    Returns:
        (..., 4 * samples, 2).
    """
    if boxes.ndim == 0 or boxes.shape[-1] != 4:
        raise ValueError(f"outlines: boxes must be (..., 4) = x1, y1, x2, y2; got shape {tuple(boxes.shape)}")
    if samples < 1:
        raise ValueError(f"outlines: samples must be at least 1; got {samples}")
    return along_edges(corners_of(boxes if boxes.is_floating_point() else boxes.float()), samples)
