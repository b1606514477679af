"""A real-looking camera of every model, and directions to look at with it."""

import math

import numpy as np
import torch
from torch import Tensor

import camtorch as ct

SIZE = (480, 640)
INTRINSICS = (280.0, 281.0, 319.5, 239.5)
_FISHEYE = (0.02, -0.01, 0.003, -0.001)
COEFFICIENTS: dict[str, tuple[float, ...]] = {
    "pinhole": (),
    "brown_conrady": (-0.05, 0.01, 1e-3, -5e-4, 1e-3),
    "kannala_brandt": _FISHEYE,
    "fisheye624": (*_FISHEYE, 1e-4, 0.0, 1e-3, -5e-4, 1e-3, -1e-4, 5e-4, 1e-4),
    "f_theta": (-0.09, 0.14, -0.02),
    "eucm": (0.6, 1.1),
    "double_sphere": (-0.1, 0.6),
    "mei": (1.2, -0.05, 0.01, 1e-3, -5e-4),
}
"""Models of each kind, with values as calibrations of such lenses have them; every term is at work."""


def intrinsics(size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Return fx fy cx cy for another image, of the same field of view across."""
    (height, width), (fx, fy, _, _) = size, INTRINSICS
    return fx * width / SIZE[1], fy * width / SIZE[1], (width - 1) / 2, (height - 1) / 2


def camera(
    key: str,
    device: torch.device,
    dtype: torch.dtype = torch.float32,
    *,
    size: tuple[int, int] = SIZE,
    batch: int | None = None,
) -> ct.Camera:
    """Return the sample camera of a model, learnable; or a batch, each a little longer than the one before.

    Values are rounded to float32 in every dtype, so that all are the same camera.
    """
    focal = torch.tensor(intrinsics(size))
    lens = torch.tensor(COEFFICIENTS[key])
    if batch is not None:
        longer = 1 + 0.002 * torch.arange(batch)[:, None]
        focal, lens = torch.cat((focal[:2] * longer, focal[2:].expand(batch, 2)), -1), lens * longer
    values = [v.to(device, dtype) for v in (focal, lens) if v.shape[-1]]
    return ct.MODELS[key](*values, image_size=size)


def matrix() -> np.ndarray:
    """Return K of the sample cameras, (3, 3) float64."""
    fx, fy, cx, cy = INTRINSICS
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def points(count: int, degrees: float, device: torch.device) -> Tensor:
    """Return (count, 3): directions uniform in the angle from the axis, at distances from 1 to 4."""
    generator = torch.Generator().manual_seed(0)
    angle, azimuth, distance = torch.rand(3, count, generator=generator, dtype=torch.float64)
    angle, azimuth, distance = angle * math.radians(degrees), azimuth * 2 * math.pi, 1 + 3 * distance
    rays = torch.stack((angle.sin() * azimuth.cos(), angle.sin() * azimuth.sin(), angle.cos()), -1)
    return (rays * distance[:, None]).float().to(device)
