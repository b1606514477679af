"""The light that a lens lets through: less of it, the farther a ray is from the axis."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from camtorch._arguments import as_values, holds
from camtorch.camera import Camera
from camtorch.warp.grid import STEP, interpolated
from camtorch.warp.warp import as_sized

_CUBIC = 3 / 128  # of the fourth difference of its nodes is what a cubic misses in the middle between them
_OFF = 1e-4  # of a cosine
_LEAST = 0.1  # of a cosine: from 84 degrees on the light stays as it is there


def vignetting(camera: Camera, power: float | Tensor = 1.0) -> Tensor:
    """(B or 1, 1, H, W): natural vignetting, the fourth power of the cosine of each pixel's angle to the axis.

    `images * ct.vignetting(camera)` puts it on, `images / ct.vignetting(camera)` undoes it, of images in linear light.
    It is 1 on the axis. From 84 degrees on it stays what it is there, 0.0001, and so it is where pixels have no ray.

    Args:
        camera: with image_size.
        power: of the law, a number or (B,): 0 is no vignetting, 1 the law, -1 its inverse. Lenses made to light their
            rim evenly, as fisheyes are, have less than 1.

    The angle is that of the lens, not that of a pinhole. Of a camera in float64 it is exact at every pixel; in float32
    its cosine is interpolated between every eighth pixel, to 0.0001. Derivatives go to `power` alone.

    Raises:
        ValueError: a camera without image_size, powers of another number than cameras. TypeError: powers that are none.
    """
    height, width = as_sized(camera, "camera", "vignetting").size_for("vignetting")
    with torch.no_grad():
        single = camera.intrinsics.dtype == torch.float32
        cosine = _between_nodes(camera, height, width) if single and holds(camera.intrinsics[..., 0] > 0) else None
        if cosine is None:
            rays, valid = camera.rays()
            cosine = torch.where(valid, rays[..., 2], _LEAST)
        cosine = cosine.reshape(-1, 1, height, width).clamp(_LEAST, 1.0)
    if isinstance(power, (int, float)):
        power = cosine.new_tensor(power)
    power = as_values(power, "power", "vignetting").to(cosine)
    if power.ndim > 1 or (power.ndim and len(cosine) > 1 and len(power) not in (1, len(cosine))):
        raise ValueError(
            f"vignetting: power must be a number, or one for each of {len(cosine)} cameras; got shape "
            f"{tuple(power.shape)}"
        )
    made: Tensor = cosine ** (4 * power.reshape(-1, 1, 1, 1))
    return made


def _between_nodes(camera: Camera, height: int, width: int) -> Tensor | None:
    """(B or 1, 1, H, W): the cosines, by cubics through those of every eighth pixel, if all these have rays.

    None as well where the images are so small for their field of view that cubics would miss by more than 0.0001.
    """
    if min(height, width) <= 2 * STEP:
        return None
    v, u = (torch.arange(math.ceil(side / STEP) + 3).to(camera.intrinsics) * STEP - STEP for side in (height, width))
    nodes = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)
    rays, valid = camera.unproject(nodes.expand(*camera.batch_shape, *nodes.shape))
    if not bool(valid.all()):
        return None
    planes = rays[..., 2].reshape(-1, 1, *nodes.shape[:2])
    fourth = max(float(planes.diff(n=4, dim=dim).abs().max()) for dim in (-1, -2))
    if fourth * _CUBIC > _OFF:
        return None
    return interpolated(planes, len(v) - 3, len(u) - 3)[:, :, :height, :width]
