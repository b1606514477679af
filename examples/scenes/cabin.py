"""Images of a driver in a car, as a driver-monitoring camera on the dashboard sees them: both are formulas.

Convention: everything is in the camera's frame, x right, y down, z forward, in metres; the camera stands at the origin
and looks along z at the driver, who sits about 0.65 m before it. Images are (B, 3, H, W) in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.poses.rotations import rotation_matrix
from scenes import driver, landmarks
from scenes.driver import FRIENDLY, LOOKS
from scenes.exposure import corner_rays, in_strips, lattice
from scenes.landmarks import LANDMARKS
from scenes.ray_tracing import BACKGROUND, CLASSES, Scene, trace

__all__ = ["CLASSES", "LANDMARKS", "LOOKS", "Drivers", "random_drivers", "render", "render_classes"]

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
    return rotation_matrix(angle[:, None] * torch.eye(3, dtype=angle.dtype)[axis])


# -- images


def _scan(rays: Tensor, scene: Scene) -> tuple[Tensor, Tensor]:
    """Colours (B, P, 3) and classes (B, P) of rays (B or 1, P, 3)."""
    count, size = len(scene.looks), rays.shape[1]
    rays = torch.nn.functional.normalize(rays, dim=-1).to(torch.float32)
    turned = (rays @ scene.turn).flatten(0, 1)
    rays = rays.expand(count, -1, -1).flatten(0, 1)
    rows = torch.arange(count).repeat_interleave(size)
    parts = zip(rays.split(_CHUNK), turned.split(_CHUNK), rows.split(_CHUNK), strict=True)
    colours, classes = zip(*(trace(ray, turn, row, scene) for ray, turn, row in parts), strict=True)
    return torch.cat(colours).unflatten(0, (count, size)), torch.cat(classes).unflatten(0, (count, size))


@torch.no_grad()
def _seen(
    camera: Camera, drivers: Drivers, rotation: Tensor | None, places: list[tuple[float, float]]
) -> tuple[Tensor, Tensor, Tensor]:
    """Of the rays at some places in each pixel: the mean of their colours (B, 3, H, W), the classes (B, 1, H, W) of the
    last ones; and which pixels have rays, (B or 1, 1, H, W).
    """
    corners, valid = corner_rays(camera)
    corners, valid = (values.reshape(-1, *values.shape[len(camera.batch_shape) :]) for values in (corners, valid))
    scene = Scene(drivers.pose, drivers.gaze, drivers.looks)
    height, width = camera.height, camera.width
    total = torch.zeros(())
    # small images are seen at several places of each pixel at a time: what costs is the number of calls
    group = max(1, _CHUNK // (len(drivers) * height * width))
    for some in (places[i : i + group] for i in range(0, len(places), group)):
        rays = torch.cat([_rays(corners, *place, rotation) for place in some], 1)
        colours, classes = _scan(rays, scene)
        total = total + colours.unflatten(1, (len(some), -1)).sum(1)
    image = (total / len(places)).unflatten(1, (height, width)).permute(0, 3, 1, 2)
    return image, classes[:, -height * width :].unflatten(1, (height, width))[:, None], valid[:, None]


def _rays(corners: Tensor, across: float, down: float, rotation: Tensor | None) -> Tensor:
    """(B or 1, P, 3): rays at a place within each pixel, from those of its corners."""
    rays = torch.lerp(corners[..., :-1, :], corners[..., 1:, :], across)
    rays = torch.lerp(rays[:, :-1], rays[:, 1:], down)
    return (rays if rotation is None else rays @ rotation.to(rays)).flatten(1, 2)


def _by_rows(rotation: Tensor | None, height: int) -> Tensor | None:
    """Rotations (3, 3), (B, 3, 3) or (B, H, 3, 3) as (B or 1, H, 3, 3)."""
    if rotation is None or rotation.ndim == 4:
        return rotation
    return rotation.reshape(-1, 1, 3, 3).expand(-1, height, -1, -1)


def render(camera: Camera, drivers: Drivers, rotation: Tensor | None = None, *, samples: int = 4) -> Tensor:
    """The images (B, 3, H, W) in [0, 1] that a camera takes of drivers; black where it has no rays.

    Args:
        camera: with image_size; no batch dims (all drivers share it) or a batch of B.
        drivers: B of them.
        rotation: (3, 3) or (B, 3, 3), turns the camera: what was at p is seen at `rotation @ p`; (B, H, 3, 3) while it
            reads row after row, one rotation each.
        samples: rays per pixel, whose mean is the pixel, as on a sensor.
    """
    turns = _by_rows(rotation, camera.height)

    def strip(part: Camera, rows: slice) -> Tensor:
        image, _, valid = _seen(part, drivers, None if turns is None else turns[:, rows], lattice(samples))
        return torch.where(valid, image, 0.0)

    return in_strips(camera, strip)


def render_classes(camera: Camera, drivers: Drivers, rotation: Tensor | None = None) -> Tensor:
    """What is seen at the pixels' centres, (B, 1, H, W) uint8: indices of `CLASSES`; background has no ray."""
    _, classes, valid = _seen(camera, drivers, _by_rows(rotation, camera.height), [(0.5, 0.5)])
    return torch.where(valid, classes, BACKGROUND).to(torch.uint8)
