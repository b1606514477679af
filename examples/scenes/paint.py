"""The colours of the driver in `cabin`.

Convention: positions are those of `driver`; colours are linear light, (3, N) or (3, 1).
"""

import torch
from torch import Tensor

from scenes import driver
from scenes.driver import LOOKS, Planes, Shape
from scenes.walls import colour, soft

_SKINS = torch.cat([colour(c) for c in ("f3cdb4", "e8b696", "d69b74", "a96f4b", "6f4630", "4a2e22")], 1)
_HAIRS = torch.cat([colour(c) for c in ("17130f", "2b1c14", "4f3020", "7a4a2a", "b98a4e", "9b958d")], 1)
_IRISES = torch.cat([colour(c) for c in ("4d7fa8", "5f8f7a", "7b6a3a", "6b4226", "3d2415")], 1)
_SHIRTS = torch.cat([colour(c) for c in ("e9e4da", "2f7f83", "34506b", "c4573a", "e0a33a", "7a2e3a", "2b2a2e")], 1)
_BELT, _JEANS = colour("34363b"), colour("34455c")
_FLUSH, _LIP, _LASH, _SCLERA = (
    torch.tensor([[1.02], [0.66], [0.62]]),
    torch.tensor([[0.86], [0.42], [0.42]]),
    colour("20140f"),
    colour("ddd5ce"),
)


def blend(palette: Tensor, where: Tensor) -> Tensor:
    """(3, N): colours at positions in [0, 1] along a palette (3, n)."""
    last = palette.shape[1] - 1
    place = where * last
    index = place.floor().clamp(0, last - 1).long()
    palette = palette.to(where)
    return torch.lerp(palette[:, index], palette[:, index + 1], place - index)


def _dark(look: dict[str, Tensor]) -> Tensor:
    """How much a dark skin has dark hair and eyes with it, 0 to 1."""
    return (2.2 * look["skin"] - 0.9).clamp(0, 0.9)


def _strands(look: dict[str, Tensor]) -> Tensor:
    hue = look["hair"]
    return blend(_HAIRS, torch.where(hue < 0.9, hue * (1 - 0.8 * _dark(look)), hue))


def head(p: Planes, s: Shape, looks: Tensor) -> tuple[Tensor, Tensor]:
    """Albedo (3, N) and which are hair, of points on the head whose looks are (N, K)."""
    x, y, z = p
    look = dict(zip(LOOKS, looks.unbind(-1), strict=True))
    a, front = x.abs() / s.width, torch.sigmoid((0.03 - z) / 0.004)
    tone, strands = blend(_SKINS, look["skin"]), _strands(look)
    flush = 0.5 * front * torch.exp(-((a - 0.04) ** 2 + (y - 0.034) ** 2) / 0.017**2)
    flush = flush + 0.3 * torch.exp(-(x**2 + (y - 0.042 - s.nose) ** 2 + (z + 0.042) ** 2) / 0.012**2)
    flush = flush + 0.25 * torch.sigmoid((a - 0.074) / 0.002)
    albedo = tone * torch.lerp(torch.ones(3, 1), _FLUSH.to(tone), flush)
    shade = 0.6 * torch.exp(-(((a - 0.0075) / 0.0036) ** 2) - ((z + 0.031) / 0.0042) ** 2)
    albedo = albedo * (1 - shade * (y > 0.044) * (y < 0.058) * (1 + 0.4 * front))

    top, line, bottom, place = driver.lips(x, s)
    lips = front * soft(y, top, bottom, 0.0005) * (place.abs() < 1)
    chin = torch.sigmoid((y - 0.058 - 0.25 * (0.052 - a).clamp(min=-0.04)) / 0.005) * torch.sigmoid((0.075 - z) / 0.008)
    beard = (2.2 * look["beard"] - 1.3).clamp(0, 0.85) * chin * (1 - lips)
    albedo = torch.lerp(albedo, 0.8 * strands, beard)
    albedo = torch.lerp(albedo, tone * _LIP.to(tone) * torch.where(y < line, 0.85, 1.0), 0.9 * lips)
    seam = front * torch.exp(-(((y - line) / 0.0009) ** 2)) * torch.sigmoid((1.02 - place.abs()) / 0.02)
    albedo = albedo * (1 - 0.72 * seam)

    along = (a - driver.BROW[0]) / (driver.BROW[1] - driver.BROW[0])
    half = 0.0037 * (1 - 0.6 * along.clamp(0, 1)) * (along.clamp(0, 1) * 25).clamp(max=1).sqrt()
    height = y - driver.brow(along, s)
    brow = front * soft(height, -half, half, 0.0007) * soft(along, 0.0, 1.0, 0.015)
    albedo = torch.lerp(albedo, 0.6 * strands, 0.9 * brow)

    top, bottom, place = driver.lids(x, s)
    near = front * torch.sigmoid((1.02 - place.abs()) / 0.02)
    lash = near * torch.exp(-(((y - top + 0.0005) / (0.0009 + 0.0005 * place.clamp(0, 1))) ** 2))
    lash = lash + 0.35 * near * torch.exp(-(((y - bottom - 0.0003) / 0.0007) ** 2))
    crease = 0.35 * near * torch.exp(-(((y - top + 0.0042 - 0.001 * place**2) / 0.0009) ** 2))
    albedo = torch.lerp(albedo * (1 - crease), _LASH.to(tone), lash.clamp(0, 0.92))

    is_hair = driver.hair(p, s) < driver.skin(p, s)
    comb = torch.atan2(x + 0.02 * s.parting, z - 0.075) - 4.5 * s.parting * (y + 0.05) * torch.exp(-((x / 0.06) ** 2))
    comb = comb + 0.06 * torch.sin(38 * y + 5 * comb)
    wave = sum(torch.sin(f * comb + i) for i, f in enumerate((19, 43, 71, 113)))
    return torch.where(is_hair, strands * (1 + 0.13 * wave), albedo), is_hair


def eye(q: Tensor, gaze: Tensor, p: Planes, s: Shape, looks: Tensor) -> Tensor:
    """Albedo (3, N) of eyeballs at q (3, N), unit vectors from their centres; gaze (3, N), head frame."""
    look = dict(zip(LOOKS, looks.unbind(-1), strict=True))
    angle = (q - gaze).norm(dim=0) * driver.EYE_RADIUS
    ring = soft(angle, -1.0, driver.IRIS, 0.00025)
    around = torch.atan2(q[1] - gaze[1], q[0] - gaze[0])
    rays = 1 + 0.15 * torch.sin(23 * around) + 0.12 * torch.sin(37 * around + 2)
    iris = (
        1.3
        * blend(_IRISES, torch.lerp(look["iris"], torch.ones(()), _dark(look)))
        * rays
        * (0.55 + 0.75 * soft(angle, driver.PUPIL, 0.0064, 0.0007))
    )
    top, _, place = driver.lids(p[0], s)
    red = 0.2 * (place.abs() - 0.5).clamp(min=0)
    albedo = torch.lerp(_SCLERA.to(q) * torch.lerp(torch.ones(3, 1), _FLUSH.to(q), red), iris, ring)
    albedo = albedo * (1 - soft(angle, -1.0, driver.PUPIL, 0.0002))
    return albedo * (1 - 0.55 * torch.exp(-(p[1] - top).clamp(min=0) / 0.0022)) * (1 - 0.25 * place**4)


def body(p: Planes, looks: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Albedo (3, N) of points on the body, which are bare skin and which the steering wheel."""
    x, y, z = p
    look = dict(zip(LOOKS, looks.unbind(-1), strict=True))
    collar = ((x / 0.082) ** 2 + ((y + 0.012).clamp(min=0) / 0.082) ** 2).sqrt()
    collar = torch.where(z > 0.03, torch.maximum(collar, 0.95 + y / 0.06), collar)
    # the neck, wherever it leans
    collar = torch.where(y < -0.02, 0.0, collar)
    fold = 1 + 0.06 * torch.sin(60 * (x + 0.7 * y) + 6 * torch.sin(11 * y + 9 * x))
    albedo = blend(_SHIRTS, look["shirt"]) * torch.where(collar < 1.13, 0.75, fold)
    shirt = driver.shirt(p)
    albedo = torch.where(driver.legs(p) < shirt, _JEANS.to(albedo), albedo)
    belt = driver.belt(x, y) * (z < 0.03) * (y < 0.5) * (x.abs() < 0.2)
    edge = 1 - 0.35 * torch.exp(-((((0.78 * x + 0.62 * y - 0.155).abs() - 0.018) / 0.0015) ** 2))
    albedo = torch.lerp(albedo, _BELT.to(albedo) * edge, belt)
    bare = ((collar < 1) | (driver.hands(p) < torch.minimum(shirt, driver.legs(p)))) & (belt < 0.5)
    held = driver.wheel(p) < 1e-3
    albedo = torch.where(bare, blend(_SKINS, look["skin"]), albedo)
    return torch.where(held, _BELT.to(albedo), albedo), bare & ~held, held
