"""Vignetting: how much less light a lens lets through, the farther a ray is from the axis."""

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.values.arguments import as_values
from camtorch.warp.warp import as_sized

_LEAST_COSINE = 0.1  # from 84 degrees on the light is constant


def vignetting(camera: Camera, power: float | Tensor = 1.0) -> Tensor:
    """Return natural vignetting (B or 1, 1, H, W): the fourth power of the cosine of each pixel's angle to the axis.

    `images * ct.vignetting(camera)` applies it to images in linear light, `images / ct.vignetting(camera)` undoes it.
    It is 1 on the axis. From 84 degrees on, and at pixels without a ray, it is constant, 0.0001. The angle is the
    lens's, not a pinhole's, and only `power` has derivatives.

    Args:
        camera: a camera with image_size.
        power: the exponent's factor, a number or (B,): 0 is no vignetting, 1 the natural one, -1 its inverse. Lenses
            made to light their rim evenly, such as fisheyes, have less than 1.

    Raises:
        ValueError: If the camera has no image_size, or powers do not fit it. TypeError: If power is not numeric.
    """
    height, width = as_sized(camera, "camera", "vignetting").size_for("vignetting")
    with torch.no_grad():
        rays, valid = camera.rays()
        cosine = torch.where(valid, rays[..., 2], _LEAST_COSINE).reshape(-1, 1, height, width).clamp(_LEAST_COSINE, 1.0)
    if isinstance(power, (int, float)):
        power = cosine.new_tensor(power)
    power = as_values(power, "power", "vignetting").to(cosine)
    if power.ndim > 1 or (power.ndim and len(cosine) > 1 and len(power) not in (1, len(cosine))):
        raise ValueError(
            f"vignetting: power must be a number, or one for each of {len(cosine)} cameras; got shape "
            f"{tuple(power.shape)}"
        )
    return cosine ** (4 * power.reshape(-1, 1, 1, 1))


def falloff(camera: Camera, loss: Tensor) -> Tensor:
    """Return the light (B or 1, 1, H, W) of a lens that loses `loss`, (B,) or a number, in the farthest corner.

    The loss grows with the square of the distance from the principal point.
    """
    cx, cy = camera.intrinsics.detach()[..., 2:].reshape(-1, 2, 1, 1).unbind(1)
    grid = camera.pixel_grid()
    square = (grid[..., 0] - cx) ** 2 + (grid[..., 1] - cy) ** 2
    across, down = (torch.maximum(c, side - 1 - c) for c, side in ((cx, camera.width), (cy, camera.height)))
    farthest = (across**2 + down**2).clamp(min=1e-12)
    return (1 - loss.reshape(-1, 1, 1) * square / farthest).unsqueeze(1)
