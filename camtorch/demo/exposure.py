"""Images of scenes that are formulas: the mean of what several rays of a pixel see."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from camtorch.camera import Camera


@torch.no_grad()
def expose(
    camera: Camera, radiance: Callable[[Tensor], Tensor], rotation: Tensor | None = None, *, samples: int = 12
) -> Tensor:
    """The image (3, H, W) that a camera takes; black where it has no rays.

    Args:
        camera: with image_size and without batch dims.
        radiance: colours (..., 3) of rays (..., 3), float32, of the scene.
        rotation: (3, 3), camera from scene.
        samples: rays per pixel, spread over it as a lattice; their mean is the pixel, as on a sensor.
    """
    height, width = camera.height, camera.width
    # Rays of the pixels' corners, interpolated within the pixel: off by 1 / (8 focal lengths) of a pixel, and
    # the lens is inverted once for all samples
    corners, valid = camera.unproject(camera.crop(0, 0, height + 1, width + 1).pixel_grid() - 0.5)
    valid = (valid[1:, 1:] & valid[1:, :-1] & valid[:-1, 1:] & valid[:-1, :-1])[..., None]
    rays = corners.to(torch.float32) if rotation is None else (corners @ rotation.to(corners)).to(torch.float32)
    # the lattice's step is a golden section of its size: even over each axis and over the square
    step = max(1, round(samples * 0.618))
    while math.gcd(step, samples) > 1:
        step += 1
    image = torch.zeros(height, width, 3)
    for i in range(samples):
        across, down = (i + 0.5) / samples, (i * step % samples + 0.5) / samples
        rows = torch.lerp(rays[:, :-1], rays[:, 1:], across)
        image += torch.where(valid, radiance(torch.lerp(rows[:-1], rows[1:], down)), 0.0)
    return (image / samples).permute(2, 0, 1)
