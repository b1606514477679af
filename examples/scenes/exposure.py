"""Images of scenes that are formulas: the mean of what several rays of a pixel see."""

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera

_ROWS = 120  # of a strip, whatever the number of cores, for the same image


def lattice(samples: int) -> list[tuple[float, float]]:
    """Places (across, down) in a pixel, from 0 to 1, spread over it evenly."""
    # the step down is a golden section of the number: even over each axis and over the square
    step = max(1, round(samples * 0.618))
    while math.gcd(step, samples) > 1:
        step += 1
    return [((i + 0.5) / samples, (i * step % samples + 0.5) / samples) for i in range(samples)]


def corner_rays(camera: Camera) -> tuple[Tensor, Tensor]:
    """Rays (*B, H + 1, W + 1, 3) of the corners of pixels, and which pixels have all four, (*B, H, W).

    Rays within a pixel are interpolated between them: off by 1 / (8 focal lengths) of a pixel, and the lens is inverted
    once for all samples.
    """
    grid = camera.crop(0, 0, camera.height + 1, camera.width + 1).pixel_grid() - 0.5
    rays, valid = camera.unproject(grid.expand(*camera.batch_shape, *grid.shape))
    return rays, valid[..., 1:, 1:] & valid[..., 1:, :-1] & valid[..., :-1, 1:] & valid[..., :-1, :-1]


@torch.no_grad()
def expose(
    camera: Camera, radiance: Callable[[Tensor], Tensor], rotation: Tensor | None = None, *, samples: int = 12
) -> Tensor:
    """The image (3, H, W) that a camera takes; black where it has no rays.

    Args:
        camera: with image_size and without batch dims.
        radiance: colours (..., 3) of rays (..., 3), float32, of the scene.
        rotation: (3, 3), camera from scene.
        samples: rays per pixel, whose mean is the pixel, as on a sensor.
    """
    corners, valid = corner_rays(camera)
    rays = (corners if rotation is None else corners @ rotation.to(corners)).to(torch.float32)
    image = torch.zeros(camera.height, camera.width, 3)
    for across, down in lattice(samples):
        rows = torch.lerp(rays[:, :-1], rays[:, 1:], across)
        image += torch.where(valid[..., None], radiance(torch.lerp(rows[:-1], rows[1:], down)), 0.0)
    return (image / samples).permute(2, 0, 1)


def in_strips(camera: Camera, render: Callable[[Camera, slice], Tensor]) -> Tensor:
    """Images (..., H, W), rendered strip by strip on all cores.

    Each strip is a thread's: threads of torch that share small tensors wait for each other more than they work.

    Args:
        camera: of the whole image.
        render: gets the camera of a strip, and its rows.
    """
    rows = [slice(top, min(top + _ROWS, camera.height)) for top in range(0, camera.height, _ROWS)]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            parts = pool.map(lambda s: render(camera.crop(s.start, 0, s.stop - s.start, camera.width), s), rows)
            return torch.cat(list(parts), -2)
    finally:
        torch.set_num_threads(threads)
