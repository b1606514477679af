"""The car in `cabin`: flat walls around boxes with round edges, what is painted on them, and what is outside.

Convention: that of `cabin`; positions and rays are planes (x, y, z) of N values, colours are linear light, (3, N).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from scenes.driver import Planes
from scenes.paint import blend
from scenes.walls import colour, soft

# a point on each wall and where it faces; all the car is on that side of it
WALLS = (
    ((0, -0.36, 0), (0, 1, 0)),
    ((0, 0.95, 0), (0, -1, 0)),
    ((0.55, 0, 0), (-1, 0, 0)),
    ((0.55, 0.08, 0), (-0.94, 0.34, 0)),
    ((-1.1, 0, 0), (1, 0, 0)),
    ((-1.1, 0.08, 0), (0.94, 0.34, 0)),
    ((0, 0.05, 1.95), (0, -0.23, -0.973)),
    ((0, 0.05, 2.05), (0, 0.643, -0.766)),
    ((0, 0, -0.5), (0, 0, 1)),
    ((0, 0.1, -0.5), (0, 0.78, 0.625)),
)
ROOF, FLOOR, DOOR, PANE, FAR_DOOR, FAR_PANE, BENCH, REAR_PANE, DASH, SCREEN = range(10)
# centre, half size, roundness; the first few are the driver's and move with him
BOXES = (
    ((0.0, 0.42, 0.235), (0.25, 0.34, 0.07), 0.06),
    ((0.0, -0.09, 0.245), (0.13, 0.085, 0.045), 0.04),
    ((0.0, 0.66, 0.0), (0.26, 0.08, 0.28), 0.06),
    ((-0.62, 0.42, 0.9), (0.25, 0.36, 0.07), 0.06),
    ((-0.62, -0.11, 0.91), (0.13, 0.085, 0.045), 0.04),
    ((-0.62, 0.72, 0.62), (0.26, 0.1, 0.28), 0.06),
    ((-0.8, -0.03, 1.88), (0.13, 0.08, 0.05), 0.04),
    ((-0.05, -0.03, 1.88), (0.13, 0.08, 0.05), 0.04),
    ((-0.275, 0.62, 1.6), (0.8, 0.1, 0.3), 0.06),
)
MOVING = 3


def slabs(
    origin: Sequence[Tensor | float], ray: Planes, low: Sequence[Tensor | float], high: Sequence[Tensor | float]
) -> tuple[Tensor, Tensor]:
    """Distances at which rays enter (0 if they start inside) and leave a box."""
    near, far = torch.zeros(()), torch.tensor(torch.inf)
    for o, r, a, b in zip(origin, ray, low, high, strict=True):
        a, b = (a - o) / r, (b - o) / r
        near, far = torch.maximum(near, torch.minimum(a, b)), torch.minimum(far, torch.maximum(a, b))
    return near, far


def cushion(p: Planes, half: Sequence[Tensor | float], round_: float) -> tuple[Tensor, Tensor]:
    """The distance to a box with round edges, and (3, N) the way to it."""
    out = torch.stack([c.abs() - h + round_ for c, h in zip(p, half, strict=True)])
    gap = out.clamp(min=0)
    return gap.norm(dim=0) + out.amax(0).clamp(max=0) - round_, gap * torch.stack(p).sign()


def wall_paint(which: Tensor, p: Planes, ray: Planes, light: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Albedo (3, N) and own light (3, N) of points on the walls, and which of them are glass."""
    x, y, z = p
    dark, cloth = _TRIM[:, 0:1] + 0 * x, blend(_FABRICS, light["upholstery"])
    # a door from the front to the back: pillar, window, pillar, window; under it the panel
    opened = soft(y, -0.315, 0.055, 0.002)
    front = soft(z + 0.75 * (y + 0.36), 0.1, 9, 0.004) * soft(z, -9, 0.98, 0.003)
    back = soft(z, 1.12, 1.62 + 0.5 * y, 0.003)
    side = opened * (front + back).clamp(max=1)
    rear = soft((x + 0.275).abs(), -1.0, 0.62 + 0.35 * y, 0.003) * soft(y, -0.29, 0.02, 0.003)
    ahead = soft((x + 0.275).abs(), -1, 0.72 + 0.2 * y, 0.004) * soft(z, -9, -0.02, 0.004)
    pane = torch.zeros_like(x)
    for wall, glass in ((PANE, side), (FAR_PANE, side), (REAR_PANE, rear), (SCREEN, ahead)):
        pane = torch.where(which == wall, glass, pane)
    panel = torch.where(soft(y, 0.28, 0.5, 0.004) > 0.5, cloth, dark * 1.6)
    panel = panel * (1 - 0.6 * torch.exp(-(((y - 0.27) / 0.006) ** 2)))
    panel = torch.where(soft(y, 0.19, 0.235, 0.002) * soft(z, 0.3, 0.55, 0.002) > 0.5, _TRIM[:, 3:4], panel)
    panel = torch.where((z - 0.15) ** 2 + (y - 0.6) ** 2 < 0.1**2, dark * 0.7, panel)
    panel = torch.where(y < 0.1, dark * 0.8, panel)
    bench = cloth * (1 - 0.5 * torch.exp(-((((x + 0.275).abs() % 0.36 - 0.18) / 0.008) ** 2)))
    bench = torch.where(y < 0.05, dark, bench)
    dash = torch.where(soft(y, 0.25, 0.29, 0.002) > 0.5, _TRIM[:, 3:4] * 0.7, dark)
    frame = torch.where((z > 0.95) & (z < 1.15), _TRIM[:, 1:2], _TRIM[:, 1:2] * 0.9)
    # the roof's lamp, and visors
    lamp = soft(x + 0.275, -0.09, 0.09, 0.003) * soft(z, 0.45, 0.57, 0.003)
    roof = _TRIM[:, 2:3] * (1 - 0.45 * lamp) * (1 - 0.35 * torch.exp(-(((z - 1.05) / 0.006) ** 2)))
    visor = soft((x + 0.275).abs(), 0.13, 0.52, 0.003) * soft(z, 0.07, 0.22, 0.003)
    roof = roof * (1 - 0.3 * visor)
    albedo = dark
    for wall, paint in (
        *((ROOF, roof), (FLOOR, dark * 0.6), (DOOR, panel), (FAR_DOOR, panel), (PANE, frame)),
        *((FAR_PANE, frame), (BENCH, bench), (REAR_PANE, frame), (DASH, dash), (SCREEN, frame)),
    ):
        albedo = torch.where(which == wall, paint, albedo)
    return albedo * (1 - pane), pane * _outside(ray, light), pane > 0.5


def _outside(ray: Planes, light: dict[str, Tensor]) -> Tensor:
    """(3, N): out-of-focus street and sky in a direction."""
    x, y, z = ray
    up, turn = -y, torch.atan2(x, z)
    sky = torch.lerp(colour("f2eee4"), colour("8fbfe6"), (up * 1.6).clamp(0, 1))
    tops = 0.1 + 0.05 * torch.sin(5 * turn + 1) + 0.03 * torch.sin(13 * turn) + 0.015 * torch.sin(31 * turn + 2)
    leaves = torch.lerp(colour("6f8f63"), colour("9fb48a"), 0.5 + 0.5 * torch.sin(19 * turn + 3 * torch.sin(30 * up)))
    scene = torch.lerp(sky, leaves, torch.sigmoid((tops - up) / 0.02))
    houses = 0.02 + 0.05 * torch.sigmoid(20 * torch.sin(4 * turn + 4) - 4)
    scene = torch.lerp(scene, colour("c9b49a"), torch.sigmoid((houses - up) / 0.01))
    scene = torch.lerp(scene, colour("8b8a88"), torch.sigmoid((-0.05 - up) / 0.015))
    return scene * (0.7 + 1.1 * light["day"])


_TRIM = torch.cat([colour(c) for c in ("3a3b3f", "c4bdb0", "efe9dd", "a7a9ac")], 1)
_FABRICS = torch.cat([colour(c) for c in ("4a4d55", "6f5a48", "a5805a", "8b8f96", "3b3f47")], 1)


def corners(p: Planes) -> Tensor:
    """(N): what part of its light a point keeps, less close to several walls."""
    shade = torch.ones_like(p[0])
    for point, facing in WALLS:
        gap = torch.stack([(c - a) * b for c, a, b in zip(p, point, facing, strict=True)]).sum(0)
        shade = shade * (1 - 0.35 / (1 + (gap / 0.06).square()))
    return shade / 0.65


def seat_paint(p: Planes, which: Tensor, upholstery: Tensor) -> Tensor:
    """Albedo (3, N) of points on boxes."""
    boxes = torch.tensor([(*c, *h) for c, h, _ in BOXES])
    x, y = (p[0] - boxes[which, 0]) / boxes[which, 3], (p[1] - boxes[which, 1]) / boxes[which, 4]
    fabric = blend(_FABRICS, upholstery)
    seam = torch.exp(-(((x.abs() - 0.58) / 0.02) ** 2)) * (boxes[which, 3] > 0.2)
    stripe = 1 + 0.1 * torch.sin(40 * y) * (x.abs() < 0.58)
    return fabric * stripe * (1 - 0.5 * seam)
