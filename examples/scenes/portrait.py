"""One driver, close by, with everything that is known of him."""

from dataclasses import dataclass

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.models import Pinhole
from camtorch.poses.rotations import mount_rotation
from scenes import cabin


@dataclass
class Portrait:
    """An image, its camera, and labels in its pixels and in the camera's frame."""

    image: Tensor
    """(3, H, W) uint8."""
    camera: Camera
    keypoints: Tensor
    """(N, 2) pixels, in the order of `cabin.LANDMARKS`."""
    boxes: Tensor
    """(1, 4) pixels x1, y1, x2, y2 of the face."""
    eyes: Tensor
    """(2, 3) points in metres."""
    gaze: Tensor
    """(2, 3) unit directions."""
    drivers: cabin.Drivers
    """Who was rendered, a batch of one."""


@torch.no_grad()
def driver(
    camera: Camera | None = None,
    *,
    yaw: float = 14.0,
    place: tuple[float, float, float] = (0.01, 0.0, 0.37),
    gaze: tuple[float, float, float] = (-0.6, 0.3, -1.0),
) -> Portrait:
    """A friendly driver as seen by a camera.

    Args:
        camera: by default a pinhole camera of 105 degrees.
        yaw: degrees by which his head is turned.
        place: of the point between his eyes, in metres.
        gaze: where he looks: past the camera, as the arrow of a gaze into it would be a point.
    """
    if camera is None:
        camera = Pinhole.from_fov(105, image_size=(480, 640)).requires_grad_(False)
    drivers = cabin.random_drivers(1, spread=0)
    drivers.pose[0, :3, :3] = mount_rotation(*torch.tensor([-yaw, 0.0, 0.0], dtype=torch.float64))
    drivers.pose[0, :3, 3] = torch.tensor(place)
    drivers.gaze = torch.nn.functional.normalize(torch.tensor([gaze], dtype=torch.float64), dim=-1)
    box = camera.project(drivers.face_box_points()[0])[0].double()
    return Portrait(
        (255 * cabin.render(camera, drivers)[0]).round().byte(),
        camera,
        camera.project(drivers.landmarks()[0])[0].double(),
        torch.cat([box.amin(0), box.amax(0)])[None],
        drivers.eyes()[0],
        drivers.gaze.expand(2, 3),
        drivers,
    )
