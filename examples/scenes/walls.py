"""The surfaces of `room`: where they are, and their colours, as formulas.

Convention: x right, y down, z forward, in metres. Colours are linear light, (3, N) or (3, 1).
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

LOW, HIGH = (-2.7, -1.45, -2.6), (2.7, 1.25, 4.4)
TILE, SQUARE, RAIL = 0.6, 0.2, 0.55
WINDOW = (-1.3, 1.3, -1.0, 0.38)  # x, x, y, y of the frame's outer edge; likewise below
TEST_CHART = (1.6, 2.4, -0.8, 0.2)
PRINT = (-2.4, -1.6, -0.8, 0.2)
POSTER = (0.4, 2.0, -0.85, 0.25)  # z, z, y, y on the side walls
DOOR = (2.55, 3.5, -0.75, 1.25)
SHELF = (0.5, 3.2, -0.9, 0.2)
FRAME = 0.09
RUG = (-1.5, 1.5, 1.45, 3.45)
BEAMS = [((-2.7, -1.45, z), (2.7, -1.25, z + 0.22)) for z in (-1.3, 0.3, 1.9, 3.5)]
TABLE = [((-0.75, 0.72, 2.0), (0.75, 0.79, 2.9))]
TABLE += [((x, 0.79, z), (x + 0.07, 1.25, z + 0.07)) for x in (-0.72, 0.65) for z in (2.03, 2.8)]
CUBE = ((-0.52, 0.42, 2.35), (-0.22, 0.7199, 2.65))
GLOBE, GLOBE_RADIUS = (0.38, 0.56, 2.4), 0.16
LAMPS, LAMP_RADIUS = [(x, -0.74, 2.6) for x in (-1.0, 0.0, 1.0)], 0.14
CORDS = [((x - 0.012, -1.45, 2.588), (x + 0.012, -0.88, 2.612)) for x, _, _ in LAMPS]
SUN = tuple(c / math.sqrt(0.3**2 + 0.52**2 + 1) for c in (0.3, -0.52, 1.0))  # towards it

LEFT_WALL, RIGHT_WALL, CEILING, FLOOR, REAR_WALL, BACK_WALL, BEAM, TABLE_TOP, CHEQUERED, CORD, MIRROR, LAMP = range(12)
# for each group of things the box around it, its boxes and its balls: most rays then ask one question instead of many
GROUPS = [
    ((LOW, (HIGH[0], -1.25, HIGH[2])), [(box, BEAM) for box in BEAMS], []),
    (
        ((-0.75, 0.4, 2.0), (0.75, 1.25, 2.9)),
        [*((box, TABLE_TOP) for box in TABLE), (CUBE, CHEQUERED)],
        [(GLOBE, GLOBE_RADIUS, MIRROR)],
    ),
    (
        ((-1.15, -1.45, 2.45), (1.15, -0.59, 2.75)),
        [(box, CORD) for box in CORDS],
        [(centre, LAMP_RADIUS, LAMP) for centre in LAMPS],
    ),
]


def colour(code: str) -> Tensor:
    """(3, 1) linear light of an sRGB hex code."""
    return torch.tensor([int(code[i : i + 2], 16) / 255 for i in (0, 2, 4)], dtype=torch.float32).pow(2.2)[:, None]


_PLASTER, _SAGE, _PANEL, _CREAM = (colour(c) for c in ("ead9bf", "5d7f76", "6b8d83", "f6eddd"))
_DARK_TILE, _LIGHT_TILE, _CEILING, _INK = (colour(c) for c in ("4a5f66", "efe3cd", "f7ebd6", "2b2a2e"))
_WALNUT, _OAK, _PETROL, _BRASS = (colour(c) for c in ("5b3a26", "a8743f", "1f5560", "c39a4a"))
_TERRACOTTA, _MUSTARD, _TEAL, _OXBLOOD = (colour(c) for c in ("c4573a", "e0a33a", "2f7f83", "8c2f2a"))
_BOOKS = torch.cat(
    [_TERRACOTTA, _MUSTARD, _TEAL, _LIGHT_TILE, *map(colour, ("7a2e3a", "34506b", "8fa67a", "d99a8b"))], 1
)


def surface(kind: int, point: tuple[Tensor, ...], ray: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Albedo (3, N), own light (3, N) and mirror share (N) of one kind of surface at points, seen along rays."""
    x, y, z = point
    glow, gloss = torch.zeros_like(x).expand(3, -1), torch.zeros_like(x)
    plain = {CEILING: _CEILING, BEAM: _WALNUT, TABLE_TOP: _OAK, CORD: _BRASS, MIRROR: _TEAL, LAMP: _CREAM}
    if kind in plain:
        albedo = plain[kind].expand(3, len(x))
    elif kind == CHEQUERED:
        cells = [torch.floor((c - low - 1e-3) / 0.1) for c, low in zip(point, CUBE[0], strict=True)]
        albedo = torch.where(torch.stack(cells).sum(0) % 2 == 1, _TERRACOTTA, _CREAM)
    elif kind in (LEFT_WALL, RIGHT_WALL):
        albedo = (_left_wall if kind == LEFT_WALL else _right_wall)(z, y)
    elif kind == REAR_WALL:
        albedo = _rear_wall(x, y)
    elif kind == FLOOR:
        albedo, rug = _floor(x, z)
        gloss = torch.where(rug, 0.0, 0.05)
    else:
        open_air = panes(x, y, 1e-5) > 0.5
        albedo = torch.where(open_air, 0.0, _back_wall(x, y))
        glow = torch.where(open_air, _outside(*ray), 0.0)
    if kind == MIRROR:
        gloss = gloss + 0.45
    if kind == LAMP:
        glow = colour("ffe3b0") * (0.9 + 0.4 * (y - LAMPS[0][1]) / LAMP_RADIUS)
    return albedo, glow, gloss


def _between(a: Tensor, low: float, high: float) -> Tensor:
    return (a > low) & (a < high)


def _inside(a: Tensor, b: Tensor, box: Sequence[float], margin: float = 0.0) -> Tensor:
    return _between(a, box[0] + margin, box[1] - margin) & _between(b, box[2] + margin, box[3] - margin)


def _odd(a: Tensor, b: Tensor, origin: tuple[float, float], side: float) -> Tensor:
    return (torch.floor((a - origin[0]) / side) + torch.floor((b - origin[1]) / side)) % 2 == 1


def soft(a: Tensor, low: float | Tensor, high: float | Tensor, width: float | Tensor) -> Tensor:
    """1 between low and high, 0 outside, blurred by `width`."""
    return torch.sigmoid((a - low) / width) * torch.sigmoid((high - a) / width)


_WAVES = torch.nn.functional.normalize(torch.randn(24, 3, generator=torch.Generator().manual_seed(5)), dim=-1)
_WAVES = _WAVES * 2 * math.pi / torch.logspace(math.log10(0.035), math.log10(0.4), 24)[:, None]


def grain(point: tuple[Tensor, ...]) -> Tensor:
    """(N): what part of their albedo points of rough plaster have: waves of 3.5 to 40 cm in all directions."""
    total = torch.zeros_like(point[0])
    for i, (a, b, c) in enumerate(_WAVES.tolist()):
        total += torch.sin(a * point[0] + b * point[1] + c * point[2] + i)
    return 0.82 + 0.16 * torch.tanh(total / 4)


# -- what the surfaces look like: albedo (3, N) at positions on them


def _wall(along: Tensor, y: Tensor) -> Tensor:
    albedo = torch.where(y > RAIL, _SAGE, _PLASTER)
    panel = _between(along % 0.9, 0.1, 0.8) & _between(y, RAIL + 0.2, 1.05)
    albedo = torch.where(panel, _PANEL, albedo)
    return torch.where(_between(y, RAIL, RAIL + 0.1) | (y > 1.13), _CREAM, albedo)


def _framed(albedo: Tensor, a: Tensor, b: Tensor, box: Sequence[float], image: Tensor) -> Tensor:
    albedo = torch.where(_inside(a, b, box, -FRAME), _INK, albedo)
    return torch.where(_inside(a, b, box), image, albedo)


def _back_wall(x: Tensor, y: Tensor) -> Tensor:
    albedo = torch.where(_inside(x, y, WINDOW), _CREAM, _wall(x, y))
    squares = torch.where(_odd(x, y, (TEST_CHART[0], TEST_CHART[2]), SQUARE), _INK, _CREAM)
    albedo = _framed(albedo, x, y, TEST_CHART, squares)
    nested = _CREAM.expand(3, len(x))
    for margin, paint in ((0.06, _MUSTARD), (0.15, _TERRACOTTA), (0.24, _OXBLOOD)):
        nested = torch.where(
            _inside(x, y, (PRINT[0], PRINT[1], PRINT[2] + margin / 2, PRINT[3]), margin), paint, nested
        )
    return _framed(albedo, x, y, PRINT, nested)


def _left_wall(z: Tensor, y: Tensor) -> Tensor:
    albedo = torch.where(_inside(z, y, (DOOR[0] - 0.12, DOOR[1] + 0.12, DOOR[2] - 0.12, 2.0)), _CREAM, _wall(z, y))
    albedo = torch.where(_inside(z, y, (*DOOR[:3], 2.0)), _PETROL, albedo)
    for low, high in ((-0.62, -0.1), (0.02, 1.12)):
        for start in (2.67, 3.07):
            albedo = torch.where(_inside(z, y, (start, start + 0.32, low, high)), _PETROL * 1.5, albedo)
    albedo = torch.where((z - 2.61) ** 2 + (y - 0.25) ** 2 < 0.03**2, _BRASS, albedo)
    image = torch.where(_between(y + 0.35 * z, 0.15, 0.42), _MUSTARD, _CREAM)
    image = torch.where((z - 1.45) ** 2 + (y + 0.4) ** 2 < 0.28**2, _TERRACOTTA, image)
    image = torch.where(_inside(z, y, (0.55, 0.95, -0.7, 0.1)), _TEAL, image)
    image = torch.where(_inside(z, y, (1.05, 1.9, -0.02, 0.1)), _INK, image)
    return _framed(albedo, z, y, POSTER, image)


def _right_wall(z: Tensor, y: Tensor) -> Tensor:
    shelf = (y - SHELF[2] - 0.06) / 0.345
    row, height = torch.floor(shelf), shelf % 1
    column = torch.floor((z - SHELF[0]) / 0.075)
    chance = torch.frac(torch.sin(column * 12.9898 + row * 78.233) * 4375.85).abs()
    book = _BOOKS[:, (chance * 8).long().clamp(0, 7)]
    top = 0.12 + 0.3 * torch.frac(chance * 37)
    books = torch.where(height > top, book, _WALNUT * 0.35)
    books = torch.where(height > 0.86, _WALNUT, books)
    albedo = torch.where(_inside(z, y, SHELF), _WALNUT, _wall(z, y))
    return torch.where(
        _inside(z, y, (SHELF[0] + 0.05, SHELF[1] - 0.05, SHELF[2], SHELF[3] + 0.05), 0.06), books, albedo
    )


def _rear_wall(x: Tensor, y: Tensor) -> Tensor:
    arch = (x.abs() < 0.9) & (y > -0.75)
    return torch.where(arch, torch.where(x.abs() < 0.8, _TERRACOTTA, _CREAM), _wall(x, y))


def _floor(x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Albedo, and where it is rug."""
    albedo = torch.where(_odd(x, z, (-TILE / 2, 0.05), TILE), _DARK_TILE, _LIGHT_TILE)
    rug = _inside(x, z, RUG)
    albedo = torch.where(rug, _TERRACOTTA, albedo)
    for margin, paint in ((0.14, _CREAM), (0.22, _TEAL), (0.42, _CREAM), (0.48, _MUSTARD)):
        albedo = torch.where(_inside(x, z, RUG, margin), paint, albedo)
    return albedo, rug


def _outside(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """The view from the window in direction (x, y, z): light (3, N)."""
    across, up = x / z, -y / z
    sky = torch.lerp(colour("fbe3bf"), colour("5f9fd0"), (up / 0.22).clamp(0, 1).sqrt())
    far = 0.035 + 0.018 * torch.sin(across * 9 + 1) + 0.012 * torch.sin(across * 23)
    sky = torch.where(up < far, colour("8fa3b8"), sky)
    near = 0.012 + 0.022 * torch.sin(across * 6 + 3.6)
    sky = torch.where(up < near, colour("54708a"), sky)
    return torch.where(up < 0, torch.lerp(colour("e8c39a"), colour("3f7f93"), (-up / 0.09).clamp(0, 1)), sky) * 1.15


def panes(x: Tensor, y: Tensor, blur: Tensor | float) -> Tensor:
    """How much of the window's 4 x 2 panes is open at (x, y), softened by `blur` metres."""
    width, height = (WINDOW[1] - WINDOW[0] - 2 * FRAME) / 4, (WINDOW[3] - WINDOW[2] - 2 * FRAME) / 2
    u, v = x - WINDOW[0] - FRAME, y - WINDOW[2] - FRAME
    within = soft(u, 0.0, 4 * width, blur) * soft(v, 0.0, 2 * height, blur)
    bar = 0.025
    return within * soft(u % width, bar, width - bar, blur) * soft(v % height, bar, height - bar, blur)
