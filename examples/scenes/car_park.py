"""Images of a car park that is a formula: lines painted on asphalt, seen by the four cameras of a car.

Convention: the ground is z = 0 in metres, x to the car's right, y ahead, z up; the car's middle is at the origin.
"""

import math

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.models import KannalaBrandt
from camtorch.poses.extrinsics import Extrinsics
from scenes.exposure import expose, in_strips
from scenes.walls import colour, soft

LENGTH, WIDTH = 4.4, 1.8
"""Of the car whose cameras see."""
BAY, DEPTH, LINE = 2.5, 4.6, 0.12
"""Metres: the width and length of a bay, and the width of its lines."""
_AISLE = 2.7  # from the car's middle to where bays begin
_HEIGHTS = {"front": 0.7, "right": 1.0, "rear": 0.9, "left": 1.0}
_EDGE = 0.008  # metres, over which paint ends
_CHUNK = 1 << 18

_ASPHALT, _PAINT, _MUSTARD = colour("5c5b5e"), colour("f4eee0"), colour("e3a637")
_TEAL, _TERRACOTTA, _GRASS, _KERB = (colour(c) for c in ("2f7f83", "c4573a", "7d8f5c", "cdbfa6"))
_WAVES = torch.nn.functional.normalize(torch.randn(12, 2, generator=torch.Generator().manual_seed(3)), dim=-1)
_LENGTHS = torch.logspace(math.log10(0.05), math.log10(3.0), 12)


def rig(size: tuple[int, int] = (800, 1280)) -> Rig:
    """The car's four fisheyes of 190 degrees, each with extrinsics, camera from ground."""
    height, width = size
    focal = width / math.radians(190)
    values = torch.tensor([focal, focal, (width - 1) / 2, (height - 1) / 2], dtype=torch.float64)
    lens = torch.tensor([0.015, -0.004, 0.0008, -0.0002], dtype=torch.float64)
    cameras, poses = {}, {}
    for name, heading, x, y, pitch in (
        ("front", 0, 0.0, LENGTH / 2, 28),
        ("right", 90, WIDTH / 2 + 0.08, 0.5, 42),
        ("rear", 180, 0.0, -LENGTH / 2, 32),
        ("left", 270, -WIDTH / 2 - 0.08, 0.5, 42),
    ):
        cameras[name] = KannalaBrandt(values, lens, image_size=size).requires_grad_(False)
        place = torch.tensor([x, y, _HEIGHTS[name]], dtype=torch.float64)
        poses[name] = _looking(heading, pitch, place)
    return Rig(cameras, poses)


def _looking(heading: float, pitch: float, place: Tensor) -> Extrinsics:
    """Camera from ground, of a camera that looks towards a heading, clockwise from y, and down by a pitch."""
    a, b = math.radians(heading), math.radians(pitch)
    right = [math.cos(a), -math.sin(a), 0.0]
    ahead = [math.sin(a) * math.cos(b), math.cos(a) * math.cos(b), -math.sin(b)]
    down = [-math.sin(a) * math.sin(b), -math.cos(a) * math.sin(b), -math.cos(b)]
    rotation = torch.tensor([right, down, ahead], dtype=torch.float64)
    return Extrinsics.from_matrix(rotation, -rotation @ place).requires_grad_(False)


def _stripe(a: Tensor, middle: Tensor | float, half: float = LINE / 2) -> Tensor:
    return soft(a, middle - half, middle + half, _EDGE)


def _arrow(x: Tensor, y: Tensor) -> Tensor:
    """An arrow along y from the origin, 2.4 m long."""
    shaft = _stripe(x, 0.0, 0.09) * soft(y, 0.0, 1.5, _EDGE)
    head = torch.sigmoid((0.42 * (2.4 - y) / 0.95 - x.abs()) / _EDGE) * torch.sigmoid((y - 1.45) / _EDGE)
    return torch.maximum(shaft, head)


def _wheelchair(x: Tensor, y: Tensor) -> Tensor:
    """The sign of a bay for wheelchairs, about a metre high."""
    radius = torch.hypot(x + 0.02, y + 0.2)
    angle = torch.atan2(y + 0.2, x + 0.02)
    wheel = torch.where((angle > 0.35) & (angle < 1.75), 0.0, soft(radius, 0.25, 0.34, _EDGE))
    head = torch.sigmoid((0.085 - torch.hypot(x + 0.05, y - 0.48)) / _EDGE)
    back = _stripe(x, -0.05, 0.045) * soft(y, -0.05, 0.36, _EDGE)
    seat = _stripe(y, -0.05, 0.045) * soft(x, -0.09, 0.26, _EDGE)
    arm = _stripe(y, 0.17, 0.035) * soft(x, -0.05, 0.2, _EDGE)
    leg = _stripe(x - 0.22 - (-(y + 0.05)).clamp(min=0) * 0.35, 0.0, 0.05) * soft(y, -0.42, -0.02, _EDGE)
    foot = _stripe(y, -0.42, 0.04) * soft(x, 0.31, 0.47, _EDGE)
    return torch.stack((wheel, head, back, seat, arm, leg, foot)).amax(0)


def ground(x: Tensor, y: Tensor, blur: Tensor | float = 0.0) -> Tensor:
    """(3, N) colours of the ground, linear light, at positions in metres; `blur` metres take away what is finer."""
    fade = torch.exp(-((2 * math.pi * torch.as_tensor(blur)[..., None] / _LENGTHS) ** 2) / 8)
    phase = 2 * math.pi * (x[..., None] * _WAVES[:, 0] + y[..., None] * _WAVES[:, 1]) / _LENGTHS
    noise = (torch.sin(phase + torch.arange(12.0)) * fade).sum(-1) / 12**0.5
    light = _ASPHALT * (1 + 0.13 * noise)
    side, along = x.abs(), y + BAY / 2
    bays = soft(side, _AISLE, _AISLE + DEPTH, _EDGE)
    nearest = torch.round(along / BAY) * BAY
    index = torch.floor(along / BAY)
    # one bay is for wheelchairs, one is for charging
    special = (x > 0) & (index == 1)
    charging = (x < 0) & (index == 0)
    inner = soft(side, _AISLE + 0.06, _AISLE + DEPTH - 0.06, _EDGE)
    light = torch.lerp(light, _TEAL * (1 + 0.1 * noise), 0.9 * inner * special)
    light = torch.lerp(light, colour("5d7f56") * (1 + 0.1 * noise), 0.9 * inner * charging)
    paint = bays * _stripe(along, nearest)
    paint = torch.maximum(paint, _stripe(side, _AISLE + DEPTH))
    # arrows of the aisle: up on the right, down on the left
    for shift in (-7.2, 4.2):
        paint = torch.maximum(paint, _arrow(x - 1.5, y - shift))
        paint = torch.maximum(paint, _arrow(-x - 1.5, -y - shift))
    u, v = y - 1.5 * BAY + BAY / 2, x - _AISLE - 2.3
    paint = torch.maximum(paint, _wheelchair(-u / 1.5, v / 1.5) * (x > 0))
    # a crossing ahead, and its stop line
    crossing = soft(y, 7.4, 9.8, _EDGE) * soft(side, 0.0, _AISLE - 0.2, _EDGE)
    bars = soft((x + 0.25) % 1.0, 0.0, 0.5, _EDGE)
    paint = torch.maximum(paint * (1 - soft(y, 7.2, 10.0, _EDGE) * (side < _AISLE)), crossing * bars)
    worn = (0.88 + 0.10 * noise).clamp(0, 1)
    light = torch.lerp(light, _PAINT, paint * worn)
    # a hatched island behind
    island = soft(y, -8.6, -5.8, _EDGE) * soft(side, 0.0, 0.9, _EDGE)
    hatch = soft((x + y) % 0.8, 0.0, 0.3, _EDGE)
    frame = island - soft(y, -8.5, -5.9, _EDGE) * soft(side, -1.0, 0.8, _EDGE)
    light = torch.lerp(light, _MUSTARD, worn * (island * torch.maximum(hatch, frame)).clamp(0, 1))
    # kerb and grass behind the bays
    out = torch.sigmoid((side - _AISLE - DEPTH - 0.45) / _EDGE)
    light = torch.lerp(light, _KERB * (1 + 0.05 * noise), out)
    return torch.lerp(light, _GRASS * (1 + 0.3 * noise), torch.sigmoid((side - _AISLE - DEPTH - 0.75) / 0.02))


def screen(light: Tensor) -> Tensor:
    """Colours in [0, 1], ready for a screen, of linear light."""
    return (1 - torch.exp(-1.9 * light)).pow(1 / 2.2)


def radiance(rays: Tensor, place: Tensor) -> Tensor:
    """(..., 3) colours in [0, 1], ready for a screen, of rays (..., 3) from a place (3,) above the ground."""
    flat, colours = rays.reshape(-1, 3), torch.empty(rays.shape).reshape(-1, 3)
    origin = place.to(torch.float32)
    for start in range(0, len(flat), _CHUNK):
        x, y, z = torch.nn.functional.normalize(flat[start : start + _CHUNK], dim=-1).unbind(-1)
        far = origin[2] / (-z).clamp(min=1e-3)
        seen = ground(origin[0] + far * x, origin[1] + far * y, 0.004 * far / (-z).clamp(min=0.02))
        sky = torch.lerp(colour("f6e6cc"), colour("6fa9d6"), (z.clamp(min=0) / 0.5).clamp(max=1).sqrt())
        turn = torch.atan2(x, y)
        trees = 0.05 + 0.022 * torch.sin(7 * turn + 1) + 0.012 * torch.sin(17 * turn) + 0.007 * torch.sin(41 * turn)
        sky = torch.lerp(colour("5f7a52") * (1 + 0.2 * torch.sin(61 * turn)), sky, torch.sigmoid((z - trees) / 0.003))
        haze = 1 - torch.exp(-far / 90)
        seen = torch.lerp(seen, colour("8d9a86"), haze)
        light = torch.where(z < 0, seen, sky)
        colours[start : start + _CHUNK] = screen(light).T
    return colours.reshape(rays.shape)


def render(camera: Camera, extrinsics: Extrinsics, *, samples: int = 6) -> Tensor:
    """The image (3, H, W) in [0, 1] that a camera takes.

    Args:
        camera: with image_size and without batch dims.
        extrinsics: camera from ground.
        samples: rays per pixel.
    """
    rotation, place = extrinsics.matrix()[:3, :3], extrinsics.position

    def strip(part: Camera, rows: slice) -> Tensor:
        return expose(part, lambda rays: radiance(rays, place), rotation, samples=samples)

    return in_strips(camera, strip)
