"""The shape of the driver in `cabin`: distances to head and body, as formulas.

Convention: the head's frame has its origin midway between the two eyeballs' centres, x to the image's right when the
head faces the camera (the person's left), y down, z into the head, in metres; all sizes below are in it. The body's
frame has the camera's axes and its origin at the base of the neck. Positions are planes (x, y, z) of N values.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from scenes.walls import soft

Planes = tuple[Tensor, ...]

LOOKS = (
    *("skin", "hair", "length", "parting", "shirt", "iris", "beard", "smile", "nose", "jaw", "width", "lids"),
    *("brows", "sun", "day", "upholstery"),
)
"""What each column of `Drivers.looks` decides."""
FRIENDLY = (0.3, 0.36, 0.2, 0.8, 0.16, 0.6, 0.0, 0.85, 0.45, 0.5, 0.5, 0.7, 0.5, 0.3, 0.75, 0.0)

EYE, EYE_RADIUS, IRIS, PUPIL = 0.0325, 0.0126, 0.0073, 0.0031
EYE_WIDTH, BROW, MOUTH, MOUTH_Y, LIPS = 0.0166, (0.0135, 0.0515), 0.0265, 0.0690, (0.0066, 0.0092)
HEAD_BOX = ((-0.125, -0.15, -0.062), (0.125, 0.235, 0.215))
BODY_BOXES = (((-0.36, -0.14, -0.16), (0.36, 0.72, 0.19)), ((-0.36, 0.14, -0.62), (0.36, 0.72, 0.19)))


class Shape(NamedTuple):
    """What differs between heads; planes of N or 1 values."""

    width: Tensor
    nose: Tensor
    jaw: Tensor
    smile: Tensor
    lids: Tensor
    brows: Tensor
    length: Tensor
    parting: Tensor


def shape_of(looks: Tensor) -> Shape:
    """The shape (planes of N) that looks (N, K) decide."""
    look = dict(zip(LOOKS, looks.unbind(-1), strict=True))
    return Shape(
        0.94 + 0.12 * look["width"],
        0.008 * (look["nose"] - 0.5),
        0.92 + 0.16 * look["jaw"],
        0.008 * look["smile"] - 0.0015,
        0.72 + 0.3 * look["lids"],
        0.004 * (look["brows"] - 0.5),
        (look["length"] * 2 - 1).clamp(min=0),
        torch.where(look["parting"] > 0.5, 1.0, -1.0) * (0.3 + 0.7 * (2 * look["parting"] - 1).abs()),
    )


# -- distances


def _egg(x: Tensor, y: Tensor, z: Tensor, centre: Sequence[Any], radii: Sequence[Any]) -> Tensor:
    """The distance to an ellipsoid, exact on its surface and to first order."""
    square = steep = torch.full((), 1e-12)
    for place, middle, radius in zip((x, y, z), centre, radii, strict=True):
        # most middles are 0, and this is where the time goes
        place = place if isinstance(middle, (int, float)) and middle == 0 else place - middle
        part = (place * (1 / radius)).square()
        square, steep = square + part, steep + part * (1 / radius**2)
    # (length - 1) * length / steepness
    return (square - square.sqrt()) * steep.rsqrt()


def _limb(
    x: Tensor, y: Tensor, z: Tensor, start: Sequence[Any], end: Sequence[Any], thick: tuple[float, float]
) -> Tensor:
    """The distance to a round limb between two points, of its own thickness at each."""
    axis = [b - a for a, b in zip(start, end, strict=True)]
    to = [p - a for p, a in zip((x, y, z), start, strict=True)]
    along = (sum(t * a for t, a in zip(to, axis, strict=True)) / sum(a * a for a in axis)).clamp(0, 1)
    gap = sum((t - along * a) ** 2 for t, a in zip(to, axis, strict=True)).sqrt()
    distance: Tensor = gap - (thick[0] + (thick[1] - thick[0]) * along)
    return distance


def _join(a: Tensor, b: Tensor, width: float) -> Tensor:
    """The smaller of two distances, the crease filled over `width` metres."""
    return torch.minimum(a, b) - (width - (a - b).abs()).clamp(min=0).square() / (4 * width)


def _meet(a: Tensor, b: Tensor, width: float) -> Tensor:
    return torch.maximum(a, b) + (width - (a - b).abs()).clamp(min=0).square() / (4 * width)


def skin(p: Planes, s: Shape) -> Tensor:
    """The distance to the head without its hair."""
    x, y, z = p
    x = x.abs() / s.width
    d = _egg(x, y, z, (0, -0.03, 0.082), (0.074, 0.09, 0.098))
    d = _join(d, _egg(x / s.jaw, y, z, (0, 0.028, 0.043), (0.0645, 0.084, 0.064)), 0.03)
    d = _join(d, _egg(x / s.jaw, y, z, (0.036, 0.066, 0.04), (0.018, 0.022, 0.026)), 0.03)
    d = _join(d, _egg(x, y, z, (0, 0.094, 0.004), (0.024, 0.02, 0.025)), 0.03)
    d = _join(d, _egg(x, y, z, (0.037, 0.033, 0.006), (0.025, 0.022, 0.024)), 0.025)
    d = _join(d, _egg(x, y, z, (0.024, -0.022, 0.010), (0.036, 0.014, 0.022)), 0.03)
    d = _join(d, _egg(x, y, z, (0, 0.068, 0.0), (0.032, 0.024, 0.024)), 0.018)
    d = _join(d, _limb(x, y, z, (0, -0.012, -0.011), (0, 0.037, -0.031), (0.0065, 0.0098)), 0.014)
    d = _join(d, _egg(x, y - s.nose, z + 0.5 * s.nose, (0, 0.0395, -0.033), (0.0098, 0.0090, 0.0105)), 0.008)
    d = _join(d, _egg(x, y - s.nose, z, (0.0115, 0.043, -0.0215), (0.0064, 0.0068, 0.0105)), 0.006)
    d = _join(d, _egg(x, y, z, (EYE, 0.0, 0.0), (0.0172, 0.0148, 0.0146)), 0.007)
    level = y + _lift(x / MOUTH, s) - MOUTH_Y
    d = _join(d, _egg(x, level, z, (0, -0.0030, -0.0185), (0.021, 0.0052, 0.0080)), 0.010)
    d = _join(d, _egg(x, level, z, (0, 0.0048, -0.0180), (0.019, 0.0056, 0.0080)), 0.010)
    ear = _egg(x - 0.5 * (z - 0.09), y, z - 0.12 * y, (0.0775, 0.012, 0.092), (0.0085, 0.031, 0.019))
    ear = _meet(ear, -_egg(x - 0.5 * (z - 0.09), y, z - 0.12 * y, (0.087, 0.01, 0.089), (0.008, 0.02, 0.011)), 0.006)
    return _join(d, ear, 0.008)


def _lift(place: Tensor, s: Shape) -> Tensor:
    """How far the smile lifts the mouth, between its middle (0) and its corners (-1, 1) and beyond."""
    square = (place * place).clamp(max=1.5)
    return s.smile * square * (3 - square) / 2


def hair(p: Planes, s: Shape) -> Tensor:
    """The distance to the hair."""
    x, y, z = p
    x, side = x / s.width, x * s.parting
    a = x.abs()
    d = _egg(x, y, z, (0, -0.036, 0.088), (0.0825, 0.097, 0.103))
    d = _join(d, _egg(x + 0.02 * s.parting, y + 0.1 * side, z, (0, -0.097, 0.035), (0.058, 0.032, 0.054)), 0.035)
    # it begins at the forehead, comes down before the ears and ends at the nape
    line = (y + 0.068 - 1.3 * (z + 0.004) + 0.2 * side + 5 * (x * x - 0.06 * (x * x + 1e-4).sqrt())) / 1.7
    line = torch.maximum(line, (y - 0.03 - 0.6 * (z - 0.09)) / 1.2)
    d = _meet(d, line, 0.012)
    half = 0.07 + 0.1 * s.length
    fall = _egg(a, y, z, (0.062, half - 0.07, 0.098), (0.029, half, 0.05))
    fall = _join(fall, _egg(a, y, z, (0, half - 0.07, 0.14), (0.08, half, 0.06)), 0.03)
    d = _join(d, torch.where(s.length > 0, fall, 1.0), 0.02)
    return d + 0.0009 * torch.sin(210 * x + 110 * z + 2 * torch.sin(60 * y))


def head(p: Planes, s: Shape) -> Tensor:
    """The distance to the head."""
    return 0.9 * torch.minimum(skin(p, s), hair(p, s))


class Neck(NamedTuple):
    """The neck's upper end in the body's frame."""

    x: Tensor
    y: Tensor
    z: Tensor


def body(p: Planes, neck: Neck) -> Tensor:
    """The distance to neck, trunk, limbs and what the hands hold."""
    x, y, z = p
    bare = torch.minimum(_limb(x, y, z, (0.0, 0.03, 0.02), neck, (0.054, 0.049)), hands(p))
    return 0.9 * torch.minimum(_join(torch.minimum(shirt(p), legs(p)), bare, 0.008), wheel(p))


def shirt(p: Planes) -> Tensor:
    """The distance to the trunk and the sleeves."""
    x, y, z = p
    a = x.abs()
    d = _egg(a, y, z, (0.0, 0.3, 0.015), (0.17, 0.29, 0.115))
    d = _join(d, _limb(a, y, z, (0.0, 0.05, 0.03), (0.165, 0.085, 0.03), (0.062, 0.058)), 0.06)
    d = d - 0.003 * belt(x, y)
    arm = _limb(a, y, z, (0.185, 0.1, 0.025), (0.25, 0.36, -0.06), (0.054, 0.043))
    arm = _join(arm, _limb(a, y, z, (0.25, 0.36, -0.06), (0.195, 0.345, -0.26), (0.043, 0.037)), 0.02)
    return _join(d, arm, 0.03)


def hands(p: Planes) -> Tensor:
    """The distance to the hands and what the sleeves leave of the arms."""
    x, y, z = p
    a = x.abs()
    arm = _limb(a, y, z, (0.2, 0.345, -0.24), (0.178, 0.335, -0.345), (0.031, 0.023))
    return _join(arm, _egg(a, y, z, (0.172, 0.325, -0.37), (0.031, 0.042, 0.03)), 0.02)


def legs(p: Planes) -> Tensor:
    """The distance to the legs."""
    return _limb(p[0].abs(), p[1], p[2], (0.09, 0.56, 0.02), (0.14, 0.54, -0.5), (0.085, 0.07))


def wheel(p: Planes) -> Tensor:
    """The distance to the steering wheel."""
    # leant back by the angle whose sine is 0.4
    x, y, z = p[0], p[1] - 0.35, p[2] + 0.37
    y, z = 0.9165 * y + 0.4 * z, 0.9165 * z - 0.4 * y
    rim = (((x * x + y * y).sqrt() - 0.178) ** 2 + z * z).sqrt() - 0.0145
    spoke = _egg(x, y, z, (0.0, 0.01, -0.01), (0.175, 0.026, 0.012))
    return torch.minimum(rim, _join(spoke, _egg(x, y, z, (0.0, 0.01, 0.0), (0.062, 0.052, 0.02)), 0.02))


def belt(x: Tensor, y: Tensor) -> Tensor:
    """1 under the seat belt, 0 beside it."""
    return soft(0.78 * x + 0.62 * y - 0.155, -0.023, 0.023, 0.0012)


def march(
    distance: Callable[[Planes, Any], Tensor], origin: Planes, ray: Planes, near: Tensor, far: Tensor, shape: Any
) -> Tensor:
    """Where rays first meet a surface between near and far, infinite where they do not; `shape` is a NamedTuple."""
    found = torch.full_like(near, torch.inf)
    left, t = torch.arange(len(near)), near
    lines: Planes = (*origin, *ray)
    # along a silhouette steps are short; few rays go there
    for _ in range(12):
        for _ in range(4):
            x, y, z, a, b, c = lines
            gap = distance((x + t * a, y + t * b, z + t * c), shape)
            t = t + gap
        done = gap < 2e-4
        found[left[done]] = t[done]
        on = (~done & (t < far)).nonzero()[:, 0]
        if len(on) == 0:
            return found
        left, t, far, gap, lines = left[on], t[on], far[on], gap[on], tuple(w[on] for w in lines)
        shape = shape._make(w[on] for w in shape)
    close = gap < 2e-3
    found[left[close]] = t[close]
    return found


def normals(distance: Callable[[Planes, Any], Tensor], p: Planes, shape: Any, step: float = 4e-4) -> Tensor:
    """(3, N): the outward unit normals at points on a surface."""
    total = torch.zeros_like(torch.stack(p))
    for signs in ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1)):
        value = distance(tuple(c + step * e for c, e in zip(p, signs, strict=True)), shape)
        total += value * torch.tensor(signs)[:, None]
    unit: Tensor = total / (total.norm(dim=0) + 1e-12)
    return unit


# -- lines on the face


def lids(x: Tensor, s: Shape) -> tuple[Tensor, Tensor, Tensor]:
    """Heights of the upper and the lower lid's edge at x, and where between the corners (-1 to 1) that is."""
    across = x.abs() / s.width - EYE
    place = across / EYE_WIDTH
    arch = (1 - place**2) * s.lids
    return -0.05 * across - 0.0078 * arch, -0.05 * across + 0.0052 * arch, place


def opening(p: Planes, s: Shape) -> Tensor:
    """Where on the head's surface the lids are open."""
    top, bottom, place = lids(p[0], s)
    return (p[1] > top) & (p[1] < bottom) & (place.abs() < 1) & (p[2] < 0.02)


def lips(x: Tensor, s: Shape) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Heights of the upper lip's edge, the line between and the lower edge; where between the corners (-1 to 1)."""
    place = x / s.width / MOUTH
    line = MOUTH_Y - _lift(place, s)
    arch = (1 - place**2).clamp(min=0)
    return line - LIPS[0] * arch * (1 - 0.3 * torch.exp(-((place / 0.22) ** 2))), line, line + LIPS[1] * arch, place


def brow(along: Tensor, s: Shape) -> Tensor:
    """Height of the brow's middle at 0 (inner end) to 1 (outer end)."""
    return -0.0235 - 0.0050 * (1 - ((along - 0.62) / 0.62) ** 2) - s.brows


def eyeballs(s: Shape) -> Tensor:
    """(B, 2, 3): the eyeballs' centres, right and left, in the head frame."""
    zero = torch.zeros_like(s.width)
    return torch.stack([torch.stack([i * EYE * s.width, zero, zero], -1) for i in (-1, 1)], 1)
