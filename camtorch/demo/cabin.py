"""Images of a driver in a car, as a driver-monitoring camera on the dashboard sees them: both are formulas.

Convention: everything is in the camera's frame, x right, y down, z forward, in metres; the camera stands at the origin
and looks along z at the driver, who sits about 0.65 m before it. Images are (B, 3, H, W) in [0, 1].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from camtorch.camera import Camera
from camtorch.demo import driver, landmarks
from camtorch.demo.driver import FRIENDLY, LOOKS
from camtorch.demo.landmarks import LANDMARKS
from camtorch.demo.ray_tracing import BACKGROUND, CLASSES, Scene, trace

__all__ = ["CLASSES", "LANDMARKS", "LOOKS", "Drivers", "random_drivers", "render", "render_classes"]

DOT = (0.0, 1.0, 0.0)
"""The colour of dots; nothing else is as green."""
_CHUNK = 1 << 18


@dataclass
class Drivers:
    """A batch of B drivers.

    Attributes:
        pose: (B, 4, 4) camera from head. The head's frame has its origin midway between the eyeballs' centres, x to
            the image's right when the head faces the camera (the person's left), y down, z into the head: the identity
            rotation faces the camera.
        gaze: (B, 3) unit direction in the camera frame in which both eyes look.
        looks: (B, K) in [0, 1], appearance; `LOOKS` names the columns.
    """

    pose: Tensor
    gaze: Tensor
    looks: Tensor

    def __len__(self) -> int:
        return len(self.pose)

    def __getitem__(self, index: Tensor | slice | int) -> Drivers:
        index = slice(index, index + 1 or None) if isinstance(index, int) else index
        return Drivers(self.pose[index], self.gaze[index], self.looks[index])

    @torch.no_grad()
    def landmarks(self) -> Tensor:
        """(B, N, 3): points on the surface, in the order of `LANDMARKS`; some may be turned away or under hair."""
        return self._to_camera(landmarks.face_points(driver.shape_of(self.looks), self._gaze_of_head())[0])

    @torch.no_grad()
    def face_box_points(self) -> Tensor:
        """(B, M, 3): points of the face's outline, whose bounding box in an image is the face's."""
        return self._to_camera(landmarks.face_points(driver.shape_of(self.looks), self._gaze_of_head())[1])

    def eyes(self) -> Tensor:
        """(B, 2, 3): the eyeballs' centres, the driver's right one first."""
        return self._to_camera(driver.eyeballs(driver.shape_of(self.looks)))

    def _gaze_of_head(self) -> Tensor:
        return (self.gaze[:, None] @ self.pose[:, :3, :3])[:, 0]

    def _to_camera(self, points: Tensor) -> Tensor:
        return points @ self.pose[:, :3, :3].mT + self.pose[:, None, :3, 3]


def random_drivers(count: int, generator: torch.Generator | None = None, *, spread: float = 1.0) -> Drivers:
    """Draw drivers (float64).

    Args:
        count: how many.
        generator: of the random numbers.
        spread: how far heads move and turn and how much they differ. At 1 yaw is within 35 degrees, pitch and roll
            within 15, x and y within 0.12 m, the distance 0.5 to 0.85 m; 0 is `count` times the same friendly driver,
            who looks into the camera.
    """
    chance = torch.rand(count, 8 + len(LOOKS), generator=generator, dtype=torch.float64)
    signed = spread * (2 * chance[:, :8] - 1)
    angles = signed[:, :3] * torch.tensor([35.0, 15.0, 15.0]).deg2rad()
    pose = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    pose[:, :3, :3] = _turn(angles[:, 0], 1) @ _turn(angles[:, 1], 0) @ _turn(angles[:, 2], 2)
    pose[:, :2, 3] = 0.12 * signed[:, 3:5] * torch.tensor([1.0, 0.5])
    pose[:, 2, 3] = 0.65 + signed[:, 5] * torch.where(signed[:, 5] > 0, 0.2, 0.15)
    # people look at things: between where the head points and the camera, and the eyes turn from there
    to = -pose[:, :3, 3] / pose[:, :3, 3].norm(dim=-1, keepdim=True) - 1.2 * min(spread, 1.0) * pose[:, :3, 2]
    to = to / to.norm(dim=-1, keepdim=True)
    swing = signed[:, 6:8] * torch.tensor([15.0, 9.0]).deg2rad()
    gaze = (_turn(swing[:, 0], 1) @ _turn(swing[:, 1], 0) @ to[..., None])[..., 0]
    friendly = torch.tensor(FRIENDLY, dtype=torch.float64)
    return Drivers(pose, gaze, torch.lerp(friendly.expand(count, -1), chance[:, 8:], min(spread, 1.0)))


def _turn(angle: Tensor, axis: int) -> Tensor:
    """(B, 3, 3): rotations about a coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = torch.eye(3, dtype=torch.float64).repeat(len(angle), 1, 1)
    matrix[:, i, i] = matrix[:, j, j] = angle.cos()
    matrix[:, j, i] = angle.sin()
    matrix[:, i, j] = -angle.sin()
    return matrix


# -- images


def _rays(corners: Tensor, across: float, down: float, turn: Tensor | None) -> Tensor:
    """(B, P, 3) unit rays at a place within each pixel, from the rays of its corners (B, H + 1, W + 1, 3)."""
    rows = torch.lerp(corners[..., :-1, :], corners[..., 1:, :], across)
    rays = torch.lerp(rows[:, :-1], rows[:, 1:], down)
    rays = (rays if turn is None else rays @ turn).flatten(1, 2)
    unit: Tensor = rays / rays.norm(dim=-1, keepdim=True)
    return unit


def _by_rows(rotation: Tensor | None, rays: Tensor) -> Tensor | None:
    """Rotations (3, 3), (B, 3, 3) or (B, H, 3, 3) as (B or 1, H or 1, 3, 3), of the rays' dtype."""
    if rotation is None:
        return None
    rotation = rotation.to(rays)
    return rotation if rotation.ndim == 4 else rotation.reshape(-1, 1, 3, 3)


def _corners_of(camera: Camera) -> tuple[Tensor, Tensor]:
    """Rays (B or 1, H + 1, W + 1, 3) of the pixels' corners, and which pixels have them, (B or 1, 1, H, W)."""
    height, width = camera.height, camera.width
    grid = camera.crop(0, 0, height + 1, width + 1).pixel_grid() - 0.5
    corners, valid = camera.unproject(grid.expand(*camera.batch_shape, *grid.shape))
    corners, valid = corners.reshape(-1, height + 1, width + 1, 3), valid.reshape(-1, 1, height + 1, width + 1)
    valid = valid[..., 1:, 1:] & valid[..., 1:, :-1] & valid[..., :-1, 1:] & valid[..., :-1, :-1]
    return corners, valid


def _scan(rays: Tensor, scene: Scene, dots: Tensor | None, radius: float) -> tuple[Tensor, Tensor]:
    """Colours (B, P, 3) and classes (B, P) of rays (B or 1, P, 3)."""
    count, size = len(scene.looks), rays.shape[1]
    rays = rays.to(torch.float32)
    turned = rays @ scene.turn
    colours, classes = torch.empty(count, size, 3), torch.empty(count, size, dtype=torch.uint8)
    for start in range(0, count * size, _CHUNK):
        index = torch.arange(start, min(start + _CHUNK, count * size))
        row = index // size
        ray = rays[row if len(rays) > 1 else 0, index % size]
        colours.view(-1, 3)[index], kind = trace(ray, turned.view(-1, 3)[index], row, scene)
        classes.view(-1)[index] = kind.to(torch.uint8)
    for dot in () if dots is None else dots.unbind(1):
        toward = (dot / dot.norm(dim=-1, keepdim=True)).to(torch.float32)
        # of small angles the chord knows more than the cosine
        chord = (rays - toward[:, None]).square().sum(-1)
        colours[chord < (2 * math.sin(radius / 2)) ** 2] = torch.tensor(DOT)
    return colours, classes


@torch.no_grad()
def render(
    camera: Camera,
    drivers: Drivers,
    rotation: Tensor | None = None,
    *,
    samples: int = 4,
    generator: torch.Generator | None = None,
    dots: Tensor | None = None,
    dot_radius: float = 0.01,
    grey: bool = False,
) -> Tensor:
    """The images (B, 3, H, W) in [0, 1] that a camera takes of drivers; black where it has no rays.

    Args:
        camera: with image_size; no batch dims (all drivers share it) or a batch of B.
        drivers: B of them.
        rotation: (3, 3) or (B, 3, 3), turns the camera: what was at p is seen at `rotation @ p`; (B, H, 3, 3) while it
            reads row after row, one rotation each.
        samples: rays per pixel, spread over it as a lattice; their mean is the pixel, as on a sensor.
        generator: shifts the lattice at random; without it the same image comes out each time.
        dots: (B, N, 3) points, not turned by `rotation`, that are painted over everything else in the colour `DOT`.
        dot_radius: radians; a dot is all rays within that angle of the direction to its point.
        grey: see as an infrared camera does that brings its own light.
    """
    corners, valid = _corners_of(camera)
    turn = _by_rows(rotation, corners)
    scene = Scene(drivers.pose, drivers.gaze, drivers.looks, grey)
    # the lattice's step is a golden section of its size: even over each axis and over the square
    step = max(1, round(samples * 0.618))
    while math.gcd(step, samples) > 1:
        step += 1
    shift = [0.5 / samples] * 2 if generator is None else torch.rand(2, generator=generator).tolist()
    total = torch.zeros(())
    # small images are seen several samples at a time: what costs is the number of calls
    group = max(1, _CHUNK // (len(drivers) * camera.height * camera.width))
    for some in torch.arange(samples).split(group):
        places = [((i / samples + shift[0]) % 1, (i * step % samples / samples + shift[1]) % 1) for i in some.tolist()]
        rays = torch.cat([_rays(corners, *place, turn) for place in places], 1)
        total = total + _scan(rays, scene, dots, dot_radius)[0].unflatten(1, (len(places), -1)).sum(1)
    image = (total / samples).unflatten(1, (camera.height, camera.width)).permute(0, 3, 1, 2)
    return torch.where(valid, image, 0.0)


@torch.no_grad()
def render_classes(camera: Camera, drivers: Drivers, rotation: Tensor | None = None) -> Tensor:
    """What is seen at the pixels' centres, (B, 1, H, W) uint8: indices of `CLASSES`; background has no ray."""
    corners, valid = _corners_of(camera)
    turn = _by_rows(rotation, corners)
    classes = _scan(_rays(corners, 0.5, 0.5, turn), Scene(drivers.pose, drivers.gaze, drivers.looks, False), None, 0.0)[
        1
    ]
    return torch.where(valid, classes.unflatten(1, camera.image_size)[:, None], BACKGROUND)
