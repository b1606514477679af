"""How far apart two cameras show the same rays."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.poses.rotations import nearest_rotation
from camtorch.rays.lattices import image_lattice

_LONG = 400  # pixels of the lattice along the longer side
_ROUNDING = 1e-9  # px, far above that of two equal cameras


class Difference(NamedTuple):
    """Two cameras on a lattice (rows, columns) of pixels of the first one's image."""

    apart: Tensor  # pixels between the pixel and where the second camera shows its ray, float64
    both: Tensor  # bool: where both have the ray
    rotation: Tensor  # (3, 3): by which the rays were turned

    @property
    def rms(self) -> float:
        """The root of the mean square over what both have; NaN where that is nothing."""
        return float(self.apart[self.both].square().mean().sqrt())

    @property
    def largest(self) -> float:
        """The largest distance in pixels; NaN where both have nothing."""
        return float(self.apart[self.both].max()) if bool(self.both.any()) else math.nan

    @property
    def median(self) -> float:
        """The median distance in pixels over what both have; NaN where that is nothing."""
        return float(self.apart[self.both].median()) if bool(self.both.any()) else math.nan

    def within(self, pixels: float) -> float:
        """The part of the image, 0 to 1, that both have rays for, at most so many pixels apart."""
        return float((self.both & (self.apart <= pixels)).double().mean())

    @property
    def same(self) -> bool:
        """Whether they are the same to rounding, where both have the ray; not where both have nothing."""
        return self.largest < _ROUNDING

    @property
    def part(self) -> float:
        """The part of the image that both have rays for."""
        return float(self.both.double().mean())

    def __str__(self) -> str:
        if not self.part:
            return "no ray in common"
        if self.same:
            return "the same to rounding"
        return f"rms {self.rms:.3g} px, at most {self.largest:.3g} px"


@torch.no_grad()
def difference(a: Camera, b: Camera, *, remove_rotation: bool = False) -> Difference:
    """Compare two single cameras over the image of the first.

    `remove_rotation` first turns the rays by the one rotation that brings those of the cameras closest: two
    calibrations of one camera may differ by where they look.
    """
    for camera in (a, b):
        if camera.batch_shape:
            raise ValueError(f"difference: cameras must be single; got batch dims {tuple(camera.batch_shape)}")
    height, width = a._size_for("a difference")
    if b.image_size not in (None, a.image_size):
        raise ValueError(f"difference: images must be of one size; got {a.image_size} and {b.image_size}")
    scale = _LONG / max(height, width)
    pixels = image_lattice(a, max(2, round(height * scale)), max(2, round(width * scale))).double()
    rays, seen = a.unproject(pixels)
    turn = torch.eye(3, dtype=torch.float64, device=rays.device)
    if remove_rotation:
        aim, found = b.unproject(pixels)
        both = seen & found
        turn = nearest_rotation(aim[both].double().mT @ rays[both].double())
    others, shown = b.project(rays.double() @ turn.mT)
    return Difference(torch.linalg.vector_norm(others.double() - pixels, dim=-1), seen & shown, turn)


def angle(rotation: Tensor) -> float:
    """Radians by which a matrix (3, 3) turns."""
    sine = torch.linalg.matrix_norm(rotation - rotation.mT) / math.sqrt(8)
    return math.atan2(float(sine), (float(rotation.trace()) - 1) / 2)
