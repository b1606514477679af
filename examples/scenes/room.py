"""Images of a sunlit room that is a formula: every ray has a colour, every edge and corner a known place.

Convention: the room's frame is x right, y down, z forward, in metres; cameras stand at its origin unless told
otherwise.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from scenes import walls
from scenes.exposure import expose, in_strips

Planes = tuple[Tensor, ...]
_CHUNK = 1 << 17

# -- where the rays go


def _slabs(origin: Planes, ray: Planes, box: Sequence[Sequence[float]]) -> tuple[Tensor, Tensor, Tensor]:
    """Distances at which rays enter and leave a box, and the axis of the face they enter through."""
    first = torch.zeros_like(ray[0])
    near, far, axis = first - torch.inf, first + torch.inf, first.long()
    for i in range(3):
        a, b = (box[0][i] - origin[i]) / ray[i], (box[1][i] - origin[i]) / ray[i]
        low, high = torch.minimum(a, b), torch.maximum(a, b)
        axis = torch.where(low > near, i, axis)
        near, far = torch.maximum(near, low), torch.minimum(far, high)
    return near, far, axis


def _ball(origin: Planes, ray: Planes, centre: Sequence[Any], radius: float) -> Tensor:
    """The distance to a ball, infinite where it is missed."""
    to = [c - o for c, o in zip(centre, origin, strict=True)]
    along = sum(a * b for a, b in zip(to, ray, strict=True))
    inside = radius**2 - (sum(a * a for a in to) - along**2)
    distance = along - inside.clamp(min=0).sqrt()
    return torch.where((inside > 0) & (distance > 0), distance, torch.inf)


def _facing(ray: Planes, axis: Tensor) -> Tensor:
    """(3, N): the unit vector along each ray's axis that looks back at where the ray came from."""
    directions, axis = torch.stack(ray), axis[None]
    return torch.zeros_like(directions).scatter_(0, axis, -directions.gather(0, axis).sign())


def _hit(origin: Planes, ray: Planes) -> tuple[Tensor, Tensor, Tensor]:
    """Distance to the first surface, which one it is, and its normal."""
    ahead = torch.stack(
        [(torch.where(r > 0, h, w) - o) / r for o, r, w, h in zip(origin, ray, walls.LOW, walls.HIGH, strict=True)]
    )
    distance, axis = ahead.min(0)
    normal = _facing(ray, axis)
    what = 2 * axis + (normal.sum(0) < 0)
    for bounds, boxes, balls in walls.GROUPS:
        near, far, _ = _slabs(origin, ray, bounds)
        some = ((near < far) & (far > 0) & (near < distance)).nonzero()[:, 0]
        o, r = tuple(c[some] for c in origin), tuple(c[some] for c in ray)
        best, kind, face = distance[some], what[some], axis[some]
        for box, label in boxes:
            near, far, entry = _slabs(o, r, box)
            closer = (near < far) & (near > 0) & (near < best)
            best, face = torch.where(closer, near, best), torch.where(closer, entry, face)
            kind = torch.where(closer, label, kind)
        n = _facing(r, face)
        for centre, radius, label in balls:
            near = _ball(o, r, centre, radius)
            closer = near < best
            best, kind = torch.where(closer, near, best), torch.where(closer, label, kind)
            out = torch.stack([(a + near * b - c) / radius for a, b, c in zip(o, r, centre, strict=True)])
            n = torch.where(closer, out, n)
        distance[some], what[some], normal[:, some] = best, kind, n
    return distance, what, normal


def _light(origin: Planes, ray: Planes, mirror: bool = True, rough: bool = False) -> Tensor:
    """(3, N) linear light that comes from the first surface along each ray; `mirror` follows it once more."""
    distance, what, normal = _hit(origin, ray)
    point = tuple(o + distance * r for o, r in zip(origin, ray, strict=True))
    albedo, glow, gloss = torch.empty_like(normal), torch.empty_like(normal), torch.empty_like(distance)
    for kind in what.bincount().nonzero()[:, 0].tolist():
        here = (what == kind).nonzero()[:, 0]
        albedo[:, here], glow[:, here], gloss[here] = walls.surface(
            kind, tuple(c[here] for c in point), tuple(c[here] for c in ray)
        )
    if rough:
        albedo = albedo * walls.grain(point)
    light = albedo * _irradiance(point, normal) + glow
    if mirror and not rough:
        here = (gloss > 0).nonzero()[:, 0]
        n, r = [c[here] for c in normal], [c[here] for c in ray]
        facing = sum(a * b for a, b in zip(n, r, strict=True))
        turned = tuple(a - 2 * facing * b for a, b in zip(r, n, strict=True))
        start = tuple(c[here] + 1e-3 * b for c, b in zip(point, n, strict=True))
        share = gloss[here] + (0.75 - gloss[here]) * (1 + facing).clamp(0, 1) ** 5
        light[:, here] = light[:, here] * (1 - share) + share * _light(start, turned, mirror=False)
    return light


def _irradiance(point: Planes, normal: Tensor) -> Tensor:
    """(3, N): soft light of the room, the window and the lamps, and the sun through the panes."""
    x, y, z = point
    corner = torch.ones_like(x)
    for c, n, low, high in zip(point, normal, walls.LOW, walls.HIGH, strict=True):
        for gap in (c - low, high - c):
            corner = corner * (1 - 0.42 * torch.exp(-gap / 0.35) * (1 - n.abs()))
    on_floor = walls.soft(y, 1.0, 2.0, 0.02)
    corner = corner * (1 - 0.6 * on_floor * walls.soft(x, -0.75, 0.75, 0.12) * walls.soft(z, 2.0, 2.9, 0.12))
    light = corner * (0.5 - 0.08 * normal[1]) * torch.tensor([[1.08], [1.0], [0.93]])
    to: Planes = (-x, -0.3 - y, 4.3 - z)
    square = sum(c * c for c in to) + 1e-6
    facing = sum(a * b for a, b in zip(to, normal, strict=True)).clamp(min=0) * to[2].clamp(min=0) / square
    light = light + 3.0 * facing / (square + 0.9) * torch.tensor([[1.0], [0.93], [0.84]]) * corner
    for lamp in walls.LAMPS:
        to = tuple(c - p for c, p in zip(lamp, point, strict=True))
        square = torch.stack(to).square().sum(0) + 1e-6
        facing = sum(a * b for a, b in zip(to, normal, strict=True)).clamp(min=0) * square.rsqrt()
        light = light + 0.3 * facing / (square + 0.2) * torch.tensor([[1.0], [0.85], [0.62]]) * corner
    facing = sum(a * b for a, b in zip(walls.SUN, normal, strict=True))
    way = ((walls.HIGH[2] - z) / walls.SUN[2]).clamp(min=0)
    sun = facing.clamp(min=0) * walls.panes(x + way * walls.SUN[0], y + way * walls.SUN[1], 0.004 + 0.008 * way)
    lit = (sun > 1e-3).nonzero()[:, 0]
    start = tuple(p[lit] + 1e-3 * n[lit] for p, n in zip(point, normal, strict=True))
    direction = tuple(torch.full_like(start[0], c) for c in walls.SUN)
    shaded = _ball(start, direction, walls.GLOBE, walls.GLOBE_RADIUS) < torch.inf
    for box in (*walls.TABLE, walls.CUBE):
        near, far, _ = _slabs(start, direction, box)
        shaded = shaded | ((near < far) & (near > 0))
    sun[lit] = torch.where(shaded, 0.0, sun[lit])
    sky: Tensor = light + 4.2 * sun * torch.tensor([[1.0], [0.76], [0.46]])
    return sky


# -- what the outside sees


Place = tuple[float, float, float]
_MIDDLE: Place = (0.0, 0.0, 0.0)


def _chunks(rays: Tensor, place: Place) -> Iterator[tuple[slice, Planes, Planes]]:
    """Parts of rays (N, 3) from a place, with their origins."""
    flat = torch.where(rays.abs() < 1e-9, 1e-9, rays.to(torch.float32))
    for start in range(0, len(flat), _CHUNK):
        part = slice(start, start + _CHUNK)
        ray = flat[part].T.contiguous().unbind(0)
        yield part, tuple(torch.full_like(r, c) for r, c in zip(ray, place, strict=True)), ray


def radiance(rays: Tensor, place: Place = _MIDDLE, *, rough: bool = False) -> Tensor:
    """(..., 3) colours in [0, 1], ready for a screen, of rays (..., 3) from a place."""
    flat = rays.reshape(-1, 3)
    colours = torch.empty(flat.shape)
    for part, origin, ray in _chunks(flat, place):
        colours[part] = (1 - torch.exp(-1.3 * _light(origin, ray, rough=rough))).pow(1 / 2.2).T
    return colours.reshape(rays.shape)


def distances(rays: Tensor, place: Place = _MIDDLE) -> Tensor:
    """(...) metres to the first surface along rays (..., 3) of length 1 from a place; infinite out of the window."""
    flat = rays.reshape(-1, 3)
    found = torch.empty(len(flat))
    for part, origin, ray in _chunks(flat, place):
        distance, what, _ = _hit(origin, ray)
        x, y = (o + distance * r for o, r in zip(origin[:2], ray[:2], strict=True))
        outside = (what == walls.BACK_WALL) & (walls.panes(x, y, 1e-5) > 0.5)
        found[part] = torch.where(outside, torch.inf, distance)
    return found.reshape(rays.shape[:-1])


def visible(points: Tensor) -> Tensor:
    """(...) bool: nothing stands between the origin and a point (..., 3) on a surface."""
    length = points.norm(dim=-1).to(torch.float32)
    visible: Tensor = distances(points.to(torch.float32) / length[..., None]) > length - 2e-3
    return visible


def render(
    camera: Camera, rotation: Tensor | None = None, *, place: Place = _MIDDLE, samples: int = 12, rough: bool = False
) -> Tensor:
    """The image (3, H, W) in [0, 1] that a camera takes of the room; black where it has no rays.

    Args:
        camera: with image_size and without batch dims.
        rotation: (3, 3), camera from walls.
        place: where it stands.
        samples: rays per pixel.
        rough: surfaces have a grain and reflect nothing, as those that stereo can measure.
    """

    def strip(part: Camera, rows: slice) -> Tensor:
        return expose(part, lambda rays: radiance(rays, place, rough=rough), rotation, samples=samples)

    return in_strips(camera, strip)


def keypoints() -> Tensor:
    """(N, 3): corners between four squares, on the test chart and on the floor beside the rug."""
    x, y, z = walls.TEST_CHART[0], walls.TEST_CHART[2], walls.HIGH[2]
    chart = [(x + walls.SQUARE * i, y + walls.SQUARE * j, z) for i in range(1, 4) for j in range(1, 5)]
    floor = [(walls.TILE * (i - 0.5), walls.HIGH[1], 0.05 + walls.TILE * j) for i in range(-3, 5) for j in range(-2, 8)]
    floor = [
        p for p in floor if not (abs(p[0]) < walls.RUG[1] + 0.1 and walls.RUG[2] - 0.1 < p[2] < walls.RUG[3] + 0.1)
    ]
    return torch.tensor(chart + floor, dtype=torch.float64)


def lines() -> Tensor:
    """(N, 2, 3): the ends of straight edges between two colours, with nothing else close by."""
    left, right, back, floor = walls.LOW[0], walls.HIGH[0], walls.HIGH[2], walls.HIGH[1]
    edges = []
    for y in (walls.RAIL + 0.1, 1.13):
        edges += [((left, y, back), (right, y, back)), ((right, y, walls.LOW[2]), (right, y, back))]
        edges += [((left, y, walls.LOW[2]), (left, y, walls.DOOR[0] - 0.12))]
    for (a, b, c, d), margin, place in (
        (walls.WINDOW, 0.0, lambda u, v: (u, v, back)),
        (walls.TEST_CHART, walls.FRAME, lambda u, v: (u, v, back)),
        (walls.PRINT, walls.FRAME, lambda u, v: (u, v, back)),
        (walls.POSTER, walls.FRAME, lambda u, v: (left, v, u)),
        (walls.SHELF, 0.0, lambda u, v: (right, v, u)),
    ):
        ends = (
            place(a - margin, c - margin),
            place(b + margin, c - margin),
            place(b + margin, d + margin),
            place(a - margin, d + margin),
        )
        edges += zip(ends, (*ends[1:], ends[0]), strict=True)
    edges += [((left, walls.DOOR[2], z), (left, floor - 0.2, z)) for z in walls.DOOR[:2]]
    edges += [((low[0], high[1], z), (high[0], high[1], z)) for low, high in walls.BEAMS for z in (low[2], high[2])]
    return torch.tensor(edges, dtype=torch.float64)
