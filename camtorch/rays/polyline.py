"""Projection of edges in space to curves in the image."""

from __future__ import annotations

import torch
from torch import Tensor

from camtorch.poses.extrinsics import Extrinsics
from camtorch.projection.camera_like import CameraLike
from camtorch.values.arguments import Numbers, as_points

_FIRST_PIECES = 32  # of an edge, of equal angles, before any is divided
_LONGEST_STEP, _MOST_SAG = 20.0, 0.05  # px: between points, and from a piece to its curve
_LEAST_PIECE = 1e-11  # of an edge's angle: there it is cut
_FARTHEST_IMAGES = 16.0  # a pinhole's pixels grow without limit towards 90 degrees from its axis


def project_polyline(camera: CameraLike, points: Numbers, extrinsics: Extrinsics | None) -> list[Tensor]:
    """Return the curves of edges in the image; see `Camera.project_polyline`."""
    owner = f"{type(camera).__name__}.project_polyline"
    if camera.batch_shape:
        raise ValueError(f"{owner}: camera must be single; got batch dims {tuple(camera.batch_shape)}. Use camera[i]")
    points, _ = as_points(points, "points", 3, torch.Size(), camera.tensors, owner)
    if points.ndim not in (2, 3) or points.shape[-2] < 2 or not bool(torch.isfinite(points).all()):
        what = f"shape {tuple(points.shape)}, {points.detach().tolist()!s:.200}"
        raise ValueError(f"{owner}: points must be finite, (N, 3), two or more, or (E, N, 3), lines; got {what}")
    if extrinsics is not None:
        if not isinstance(extrinsics, Extrinsics) or extrinsics.batch_shape:
            raise TypeError(f"{owner}: extrinsics must be one Extrinsics, camera from world; got {extrinsics!r:.100}")
        points = extrinsics(points)
    if points.ndim == 3:
        return [curve for line in points for curve in project_polyline(camera, line, None)]
    edges = _Edges(points.double())
    # the middle of the image, and the distance from it at which curves end
    intrinsics = camera.intrinsics.detach().double()
    middle, reach = intrinsics[2:], _FARTHEST_IMAGES * float(intrinsics[:2].max())
    if camera.image_size is not None:
        height, width = camera.image_size
        middle, reach = middle.new_tensor([width / 2, height / 2]), _FARTHEST_IMAGES * max(height, width)

    def seen(places: Tensor) -> tuple[Tensor, Tensor]:
        pixels, valid = camera.project(edges.at(places))
        return pixels, valid & ((pixels - middle).norm(dim=-1) < reach)

    with torch.no_grad():
        count, device = edges.count, points.device
        places = torch.linspace(0, count, _FIRST_PIECES * count + 1, dtype=torch.float64, device=device)
        for _ in range(60):
            pixels, valid = seen(places)
            both = valid[1:] & valid[:-1]
            start, step = places[:-1], places.diff()
            chord = pixels.diff(dim=0)
            length = chord.norm(dim=-1)
            away = torch.zeros_like(length)
            for share in (0.25, 0.5, 0.75):
                offset = seen(start + share * step)[0] - pixels[:-1]
                across = (chord[:, 0] * offset[:, 1] - chord[:, 1] * offset[:, 0]).abs()
                away = torch.maximum(away, torch.where(length > 0, across / length.clamp(min=1e-30), 0.0))
            divided = torch.where(both, (length > _LONGEST_STEP) | (away > _MOST_SAG), valid[1:] != valid[:-1])
            divided &= step > _LEAST_PIECE * count
            if not bool(divided.any()):
                break
            places = torch.cat((places, (start + step / 2)[divided])).sort().values
        # the ends of a piece that remains longer belong to two curves, like those at the seam of a panorama
        linked = both & (length <= _LONGEST_STEP)
        ends = torch.cat((linked.new_zeros(1), linked)) != torch.cat((linked, linked.new_zeros(1)))
        runs = ends.nonzero()[:, 0].reshape(-1, 2).tolist()
    return [camera.project(edges.at(places[a : b + 1]))[0].to(points.dtype) for a, b in runs]


class _Edges:
    """Straight edges between points (N, 3); places from 0 to N - 1 advance by equal angles from the camera."""

    def __init__(self, points: Tensor):
        self.count = len(points) - 1
        self.start, self.way = points[:-1], points.diff(dim=0)
        with torch.no_grad():
            square = self.way.square().sum(-1).clamp(min=1e-300)
            self.foot = -(self.start * self.way).sum(-1) / square  # of the edge, its nearest point
            self.near = ((self.start + self.foot[:, None] * self.way).norm(dim=-1) / square.sqrt()).clamp(min=1e-9)
            self.low, high = (torch.atan((end - self.foot) / self.near) for end in (0.0, 1.0))
            self.angle = high - self.low

    def at(self, places: Tensor) -> Tensor:
        edge = places.long().clamp(max=self.count - 1)
        share = places - edge
        along = self.foot[edge] + self.near[edge] * torch.tan(self.low[edge] + share * self.angle[edge])
        # the ends exactly
        along = torch.where(share == 0, 0.0, torch.where(share == 1, 1.0, along.clamp(0, 1)))
        return self.start[edge] + along[:, None] * self.way[edge]
