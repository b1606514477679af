"""One rendered driver with labels: what `camtorch augment` shows where no image is given."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from torch import Tensor

from camtorch.camera import Camera
from camtorch.demo import cabin
from camtorch.models import Pinhole

SIZE = (480, 640)
"""(height, width) of the image; of a given camera the width is this at most."""
_ROWS = 120  # of a strip, whatever the number of cores, for the same image


@dataclass
class Example:
    """An image, its camera, and labels in its pixels and in the camera's frame."""

    image: Tensor
    """(3, H, W) uint8."""
    camera: Camera
    keypoints: Tensor
    """(N, 2) pixels."""
    boxes: Tensor
    """(1, 4) pixels x1, y1, x2, y2 of the face."""
    eyes: Tensor
    """(2, 3) points in metres."""
    gaze: Tensor
    """(2, 3) unit directions."""
    drivers: cabin.Drivers
    """Who was rendered, a batch of one."""


@torch.no_grad()
def driver(camera: Camera | None = None) -> Example:
    """A driver as seen by a camera, by default a pinhole camera of 105 degrees."""
    height, width = SIZE
    if camera is None:
        focal = width / 2 / math.tan(math.radians(105) / 2)
        camera = Pinhole([focal, focal, (width - 1) / 2, (height - 1) / 2], image_size=SIZE).requires_grad_(False)
    rows, columns = camera.image_size or SIZE
    if columns > width:
        camera = camera.resize(max(1, round(rows * width / columns)), width)
    drivers = cabin.random_drivers(1, spread=0)
    # close by, and looking past the camera: the arrow of a gaze into it would be a point
    turn = torch.tensor(14.0, dtype=torch.float64).deg2rad()
    drivers.pose[0, 0, 0] = drivers.pose[0, 2, 2] = turn.cos()
    drivers.pose[0, 0, 2], drivers.pose[0, 2, 0] = turn.sin(), -turn.sin()
    drivers.pose[0, :3, 3] = torch.tensor([0.01, 0.0, 0.37])
    drivers.gaze = torch.nn.functional.normalize(torch.tensor([[-0.6, 0.3, -1.0]], dtype=torch.float64), dim=-1)
    box = camera.project(drivers.face_box_points()[0])[0].double()
    return Example(
        (255 * _rendered(camera, drivers)).round().byte(),
        camera,
        camera.project(drivers.landmarks()[0])[0].double(),
        torch.cat([box.amin(0), box.amax(0)])[None],
        drivers.eyes()[0],
        drivers.gaze.expand(2, 3),
        drivers,
    )


def _rendered(camera: Camera, drivers: cabin.Drivers) -> Tensor:
    """(3, H, W): the image, a strip at a time on each core: threads that share rays wait for each other."""
    height, width = camera.image_size or SIZE
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            parts = [camera.crop(top, 0, min(_ROWS, height - top), width) for top in range(0, height, _ROWS)]
            return torch.cat(list(pool.map(lambda part: cabin.render(part, drivers)[0], parts)), -2)
    finally:
        torch.set_num_threads(threads)
