"""Boxes and polygons moved by a warp, which may bend their edges: points along the edges are moved."""

import torch
from torch import Tensor

from camtorch.evaluate.devices import sent
from camtorch.evaluate.tensors import is_predicted, known_true
from camtorch.native.structs import EDGE_POINTS
from camtorch.values.arguments import Numbers, as_coordinates, as_values, as_whole, check_boxes
from camtorch.warp.routes import RoutedWarp

_ROUNDED_PIXELS = 1e-3  # from a panorama's edges, where rounding would cost rays
_LATTICE_STEPS = 16  # across and down the target, between points that are tested against a polygon


def moved_boxes(warp: RoutedWarp, boxes: Numbers) -> tuple[Tensor, Tensor]:
    """Return boxes moved by a warp, and whether they are valid; see `Warp.transform_boxes`."""
    boxes = as_values(boxes, "boxes", "Warp", warp.source.intrinsics.device)
    if boxes.ndim == 0 or boxes.shape[-1] != 4:
        raise ValueError(f"Warp: boxes must be (B, *N, 4) = x1, y1, x2, y2; got shape {tuple(boxes.shape)}")
    if not boxes.dtype.is_floating_point:
        boxes = boxes.to(warp.source.intrinsics.dtype)
    if not is_predicted(boxes):
        check_boxes(boxes, "boxes", "Warp")
    enclosing, valid = enclosed(warp, corners_of(boxes))
    ordered = in_order(boxes)
    return torch.where(ordered.unsqueeze(-1), enclosing, -1.0), valid & ordered


def enclosed(warp: RoutedWarp, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Return the boxes that enclose moved polygons, and whether they are valid; see `Warp.enclose`."""
    corners = as_coordinates(corners, "corners", 2, "Warp", warp.source.intrinsics.device, "B, *N, K")
    if corners.ndim < 2:
        raise ValueError(f"Warp: corners must be (B, *N, K, 2); got shape {tuple(corners.shape)}")
    return around(warp, corners, *warp.move(along_edges(corners, EDGE_POINTS)))


def around(warp: RoutedWarp, corners: Tensor, moved: Tensor, mapped: Tensor) -> tuple[Tensor, Tensor]:
    """Return the boxes that enclose polygons, of which a warp has moved the points along their edges."""
    finite = torch.isfinite(corners).flatten(-2).all(-1, keepdim=True)
    mapped = mapped & finite
    low = torch.where(mapped.unsqueeze(-1), moved, torch.inf).amin(-2)
    high = torch.where(mapped.unsqueeze(-1), moved, -torch.inf).amax(-2)
    some, valid = mapped.any(-1), (mapped & warp.target.contains(moved)).any(-1)
    # a polygon about a direction that the target does not map is turned inside out
    plain = valid & mapped.all(-1) & (_area(corners) * _area(moved) > 0)
    is_panorama = warp.target.turn_axis is not None
    if is_panorama or not known_true(plain):
        lattice, inside = _inside(warp, corners, moved)
        inside = inside & finite & (is_panorama | ~plain.unsqueeze(-1))  # row by row
        some, valid = some | inside.any(-1), valid | inside.any(-1)
        inside = inside.unsqueeze(-1)
        low = torch.minimum(low, torch.where(inside, lattice, torch.inf).amin(-2))
        high = torch.maximum(high, torch.where(inside, lattice, -torch.inf).amax(-2))
    return torch.where(some.unsqueeze(-1), torch.cat((low, high), -1), -1.0), valid


def _inside(warp: RoutedWarp, corners: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return a lattice (N, 2) over the target, and whether (B, *M, N) polygons enclose the scene at its points."""
    height, width = warp.target.size_for("Warp")
    host, device = warp.host, like.device
    share = torch.linspace(0, 1, _LATTICE_STEPS + 1, dtype=like.dtype, device="cpu" if host else device)
    if warp.target.turn_axis is not None:
        share = share.clamp(_ROUNDED_PIXELS / height, 1 - _ROUNDED_PIXELS / height)
    lattice = torch.cartesian_prod(share * width, share * height) - 0.5
    with torch.no_grad():
        shown, seen = (host or warp).move(lattice.expand(*warp.batch_shape, *lattice.shape), back=True)
        if host is not None:
            lattice, shown, seen = sent([lattice, shown, seen], device)
        if warp.batch_shape:
            lead = len(shown), *[1] * (corners.ndim - 3), len(lattice)
            shown, seen = shown.reshape(*lead, 2), seen.reshape(lead)
        return lattice, within(corners, shown) & seen


def corners_of(boxes: Tensor) -> Tensor:
    """Return the corners (..., 4, 2) of boxes (..., 4) of x1 y1 x2 y2, clockwise from (x1, y1)."""
    x1, y1, x2, y2 = boxes.unbind(-1)
    return torch.unflatten(torch.stack((x1, y1, x2, y1, x2, y2, x1, y2), -1), -1, (4, 2))


def in_order(boxes: Tensor) -> Tensor:
    """Whether (...) boxes (..., 4) have x1 <= x2 and y1 <= y2, as boxes of x, y, width, height seldom do."""
    return (boxes[..., :2] <= boxes[..., 2:]).all(-1)


def along_edges(corners: Tensor, samples: int) -> Tensor:
    """Return points (..., samples * K, 2) at even steps along the edges of polygons (..., K, 2), with their corners."""
    share = torch.linspace(0, 1, samples + 1, dtype=corners.dtype, device=corners.device)[:-1, None]
    start, end = corners.unsqueeze(-2), corners.roll(-1, -2).unsqueeze(-2)
    return (start + (end - start) * share).flatten(-3, -2)


def _area(corners: Tensor) -> Tensor:
    """Return the areas (...) of polygons (..., K, 2), negative if they run counter-clockwise on the image."""
    (x, y), (next_x, next_y) = corners.unbind(-1), corners.roll(-1, -2).unbind(-1)
    return (x * next_y - next_x * y).sum(-1) / 2


def within(corners: Tensor, points: Tensor) -> Tensor:
    """Whether (..., N) points (..., N, 2) are inside closed polygons (..., K, 2): counts the edges to their right."""
    x, y = points.unsqueeze(-2).unbind(-1)
    x1, y1 = corners.unsqueeze(-3).unbind(-1)
    across, down = x1.roll(-1, -1) - x1, y1.roll(-1, -1) - y1
    above = y1 <= y
    crossed = above != above.roll(-1, -1)
    to_the_right = ((x - x1) * down < across * (y - y1)) == (down > 0)
    return (crossed & to_the_right).sum(-1) % 2 == 1


def outlines(boxes: Tensor, samples: int = 16) -> Tensor:
    """Return the outlines of boxes, as polygons that an augmentation moves point by point.

    At the rim of a fisheye a box that encloses its warped outline is mostly background; the outline is not.

    Args:
        boxes: (..., 4) of x1 y1 x2 y2.
        samples: points on each edge.

    Returns:
        polygons (..., 4 * samples, 2).
    """
    boxes = as_coordinates(boxes, "boxes", 4, "outlines", means=" = x1, y1, x2, y2")
    return along_edges(corners_of(boxes), as_whole(samples, "samples", "outlines", least=1))
