"""Ray tracing of `cabin`: what rays meet, and in what light.

Convention: that of `cabin`; rays are unit vectors from the camera.
"""

import torch
from torch import Tensor

from scenes import driver, paint
from scenes.car import BOXES, MOVING, WALLS, corners, cushion, seat_paint, slabs, wall_paint
from scenes.driver import LOOKS, Neck, Planes, Shape

CLASSES = ("background", "skin", "hair", "eye", "clothes", "seat", "window", "cabin")
BACKGROUND, SKIN, HAIR, EYE, CLOTHES, SEAT, WINDOW, CABIN = range(8)


class Scene:
    """What the drivers decide, as float32 rows that rays pick from."""

    def __init__(self, pose: Tensor, gaze: Tensor, looks: Tensor):
        pose = pose.to(torch.float32)
        self.turn, place = pose[:, :3, :3], pose[:, :3, 3]
        self.looks = looks.to(torch.float32)
        self.shape = driver.shape_of(self.looks)
        self.eyes = driver.eyeballs(self.shape)
        self.origin = -(place[:, None] @ self.turn)[:, 0]
        self.gaze = (gaze.to(torch.float32)[:, None] @ self.turn)[:, 0]
        still = torch.tensor([0.0, 0.0, 0.65])
        self.place = place
        self.body = still + (place - still) * torch.tensor([0.8, 0.75, 0.8]) + torch.tensor([0.0, 0.18, 0.1])
        neck = self.turn @ torch.tensor([0.0, 0.05, 0.085]) + place - self.body
        self.neck = Neck(*neck.unbind(-1))
        look = dict(zip(LOOKS, self.looks.unbind(-1), strict=True))
        side = torch.stack([1.3 * look["sun"] - 0.75, torch.full_like(look["sun"], -0.62), -0.75 + 0 * look["sun"]], -1)
        self.sun = side / side.norm(dim=-1, keepdim=True)
        self.day, self.upholstery = 0.35 + 0.65 * look["day"], look["upholstery"]


def _columns(rows: Tensor) -> Planes:
    return tuple(rows.T.contiguous().unbind(0))


def trace(rays: Tensor, turned: Tensor, row: Tensor, scene: Scene) -> tuple[Tensor, Tensor]:
    """Colours (M, 3) and classes (M) of unit rays (M, 3), in the head's frame too, each of one driver's image."""
    rays = torch.where(rays.abs() < 1e-7, 1e-7, rays)
    ray = _columns(rays)
    light = torch.zeros(3, len(rays))
    classes = torch.full((len(rays),), CABIN)

    # the head, in its own frame
    head_ray = tuple(torch.where(c.abs() < 1e-7, 1e-7, c) for c in _columns(turned))
    near, far = slabs(_columns(scene.origin[row]), head_ray, *driver.HEAD_BOX)
    best = torch.full_like(near, torch.inf)
    some = (near < far).nonzero()[:, 0]
    o, r = _columns(scene.origin[row[some]]), tuple(c[some] for c in head_ray)
    shape = Shape._make(c[row[some]] for c in scene.shape)
    best[some] = driver.march(driver.head, o, r, near[some], far[some], shape)
    on_head = best < torch.inf

    # the body, in its frame
    start = _columns(-scene.body[row])
    boxes = [slabs(start, ray, *box) for box in driver.BODY_BOXES]
    near = torch.stack([torch.where(a < b, a, torch.inf) for a, b in boxes]).amin(0)
    far = torch.stack([b for _, b in boxes]).amax(0)
    some = ((near < far) & (near < best)).nonzero()[:, 0]
    o, r = tuple(c[some] for c in start), tuple(c[some] for c in ray)
    neck = Neck._make(c[row[some]] for c in scene.neck)
    found = driver.march(driver.body, o, r, near[some], torch.minimum(far, best)[some], neck)
    closer = found < best[some]
    on_body = some[closer]
    best[on_body] = found[closer]
    on_head[on_body] = False

    # the seats
    seat = torch.full((len(rays),), -1)
    way = torch.zeros(3, len(rays))
    for i, (centre, half, round_) in enumerate(BOXES):
        shift = scene.body[row, 2] if i < MOVING else torch.zeros(())
        o = (torch.full((), -centre[0]), torch.full((), -centre[1]), -centre[2] - shift)
        near, far = slabs(o, ray, [-h for h in half], half)
        some = ((near < far) & (near < best)).nonzero()[:, 0]
        if len(some) == 0:
            continue
        r, t, limit = tuple(c[some] for c in ray), near[some], far[some]
        o = tuple(c if c.ndim == 0 else c[some] for c in o)
        for _ in range(10):
            gap, out = cushion(tuple(a + t * b for a, b in zip(o, r, strict=True)), half, round_)
            t = t + gap
        hit = (gap < 2e-3) & (t < best[some]) & (t < limit)
        here = some[hit]
        best[here], seat[here], way[:, here] = t[hit], i, out[:, hit]
        on_head[here] = False
    on_body = on_body[seat[on_body] < 0]

    here = on_head.nonzero()[:, 0]
    light[:, here], classes[here] = _trace_head(ray, head_ray, best[here], here, row[here], scene)

    k = row[on_body]
    p = tuple(best[on_body] * c[on_body] for c in ray)
    local = tuple(a - b for a, b in zip(p, _columns(scene.body[k]), strict=True))
    normal = driver.normals(driver.body, local, Neck._make(c[k] for c in scene.neck))
    albedo, bare, held = paint.body(local, scene.looks[k])
    shade = _under_head(p, normal, scene, k)
    light[:, on_body] = _lit(albedo, normal, shade, tuple(c[on_body] for c in ray), scene, k, 0.02 * bare)
    classes[on_body] = torch.where(held, CABIN, torch.where(bare, SKIN, CLOTHES))

    here = (seat >= 0).nonzero()[:, 0]
    k, which = row[here], seat[here]
    p = tuple(best[here] * c[here] for c in ray)
    normal = way[:, here] / (way[:, here].norm(dim=0) + 1e-9)
    albedo = seat_paint(p, which, scene.upholstery[k])
    shade = _under_head(p, normal, scene, k) * corners(p)
    light[:, here] = _lit(albedo, normal, shade, tuple(c[here] for c in ray), scene, k, 0.0)
    classes[here] = SEAT

    here = (best == torch.inf).nonzero()[:, 0]
    k, r = row[here], tuple(c[here] for c in ray)
    facing = torch.tensor(WALLS, dtype=torch.float32)
    height = (facing[:, 0] * facing[:, 1]).sum(-1)[:, None]
    speed = facing[:, 1] @ torch.stack(r)
    t, which = torch.where(speed < -1e-6, height / speed, torch.inf).min(0)
    p = tuple(t * c for c in r)
    albedo, glow, glass = wall_paint(which, p, r, {"upholstery": scene.upholstery[k], "day": scene.day[k]})
    classes[here] = torch.where(glass, WINDOW, CABIN)
    normal = facing[which, 1].T
    light[:, here] = _lit(albedo, normal, corners(p), r, scene, k, 0.0) + glow

    return (1 - torch.exp(-1.3 * light)).pow(1 / 2.2).T, classes


def _trace_head(ray: Planes, turned: Planes, t: Tensor, here: Tensor, k: Tensor, scene: Scene) -> tuple[Tensor, Tensor]:
    """Light (3, N) and classes (N) of rays `here` that meet the head at distances t."""
    o, r, shape = _columns(scene.origin[k]), tuple(c[here] for c in turned), Shape._make(c[k] for c in scene.shape)
    p = tuple(a + t * b for a, b in zip(o, r, strict=True))
    normal = driver.normals(driver.head, p, shape)
    albedo, is_hair = paint.head(p, shape, scene.looks[k])
    # the hollow that a point looks out of: how much nearer the surface is than on a plane
    hollow = torch.ones_like(t)
    for step in (0.008, 0.025):
        out = tuple(a + step * b for a, b in zip(p, normal, strict=True))
        hollow = hollow * (0.5 + 0.5 * (driver.head(out, shape) / (0.9 * step)).clamp(0, 1))
    classes = torch.where(is_hair, HAIR, SKIN)
    gloss = torch.where(is_hair, 0.03, 0.012 + 0.05 * albedo.mean(0))

    opened = (driver.opening(p, shape) & ~is_hair).nonzero()[:, 0]
    centre = scene.eyes[k[opened], (p[0][opened] > 0).long()].T
    way = torch.stack([c[opened] for c in r])
    to = centre - torch.stack([c[opened] for c in o])
    along = (to * way).sum(0)
    inside = driver.EYE_RADIUS**2 - (to.square().sum(0) - along**2)
    q = ((along - inside.clamp(min=0).sqrt()) * way - to) / driver.EYE_RADIUS
    eye_shape = Shape._make(c[opened] for c in shape)
    colours = paint.eye(q, scene.gaze[k[opened]].T, tuple(c[opened] for c in p), eye_shape, scene.looks[k[opened]])
    seen = inside > 0
    albedo[:, opened] = torch.where(seen, colours, 0.35 * albedo[:, opened])
    normal[:, opened] = torch.where(seen, q, normal[:, opened])
    classes[opened] = torch.where(seen, EYE, SKIN)
    gloss[opened] = 0.9

    turn = scene.turn.flatten(1).T[:, k].unflatten(0, (3, 3))
    normal = (turn * normal).sum(1)
    view = tuple(c[here] for c in ray)
    return _lit(albedo, normal, hollow, view, scene, k, gloss), classes


def _under_head(p: Planes, normal: Tensor, scene: Scene, k: Tensor) -> Tensor:
    """How much of its light the head leaves a point."""
    centre = scene.place + scene.turn @ torch.tensor([0.0, 0.01, 0.06])
    to = centre.T[:, k] - torch.stack(p)
    square = to.square().sum(0)
    facing = (to * normal).sum(0) * square.rsqrt()
    return 1 - (0.95 * (0.55 + 0.45 * facing) * 0.115**2 / square).clamp(0, 0.8)


def _lit(
    albedo: Tensor, normal: Tensor, shade: Tensor, ray: Planes, scene: Scene, k: Tensor, gloss: Tensor | float
) -> Tensor:
    """(3, N): light from points: the sun through the windscreen, sky through the side windows, soft light around."""
    n = normal
    view = torch.stack(ray)
    sun, day = scene.sun[k].T, scene.day[k]
    facing = (n * sun).sum(0)
    key = ((facing + 0.2) / 1.2).clamp(min=0)
    left, right = (0.5 + 0.5 * (0.95 * n[0] - 0.3 * n[1])) ** 2, (0.5 + 0.5 * (-0.95 * n[0] - 0.3 * n[1])) ** 2
    warm, cool = torch.tensor([[1.0], [0.9], [0.78]]), torch.tensor([[0.88], [0.97], [1.08]])
    light = (0.3 + 0.06 * n[1]) * shade + (1.3 * key * (0.3 + 0.7 * shade)) * warm
    light = light + shade * (0.65 * left + 0.25 * right) * cool
    half = sun - view
    glint = ((n * half).sum(0) / half.norm(dim=0)).clamp(0, 1)
    shine = torch.as_tensor(gloss) * torch.where(torch.as_tensor(gloss) > 0.5, glint**400 * 3, 2 * glint**18)
    lit: Tensor = day * (1.15 * albedo * light + shine * shade)
    return lit
