"""Panoramas of a whole turn: images whose left and right edges meet, and whose rows go on beyond the poles."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch._arguments import Numbers, as_coordinates, values_of
from camtorch.camera import Camera
from camtorch.models import Cylindrical, Equirectangular, LatLon, TransverseCylindrical

_NEAR = 0.05  # pixels by which a whole turn may miss the edges: a focal length of two decimals does by 0.03
_SPHERES = Equirectangular, LatLon
_DOWN = LatLon, TransverseCylindrical
PANORAMAS = Equirectangular, Cylindrical, *_DOWN


class Seam(NamedTuple):
    """Which edges of a panorama meet."""

    axis: int
    """0: the turn goes across, so that left and right meet; 1: down, so that top and bottom do."""
    ends: tuple[float, float]
    """The latitudes of the other two edges in radians: half of pi at a pole, and 0 on a cylinder."""

    @property
    def poles(self) -> tuple[bool, bool]:
        """Whether the other two edges are poles."""
        first, last = (abs(end) == math.pi / 2 for end in self.ends)
        return first, last

    def drawn_in(self, grid: Tensor) -> Tensor:
        """Positions (..., 2) as of `grid_sample`; those that rounding took beyond edges that meet, on the edge."""
        planes = list(grid.unbind(-1))
        planes[self.axis] = planes[self.axis].clamp(-1, 1)
        first, last = self.poles
        if first or last:
            planes[1 - self.axis] = planes[1 - self.axis].clamp(-1 if first else None, 1 if last else None)
        return torch.stack(planes, -1)

    def distance(self, steps: Tensor, grid: Tensor, size: tuple[int, int]) -> Tensor:
        """(...): the lengths of steps, the shorter way round; towards a pole steps across are shorter in the scene.

        Args:
            steps: (..., 2), in pixels.
            grid: (..., 2), where they begin, as of `grid_sample`.
            size: (height, width) of the image.
        """
        period = size[1 - self.axis]
        along = steps[..., self.axis]
        low, high = self.ends
        latitude = low + (grid[..., 1 - self.axis] + 1) * ((high - low) / 2)
        along = (along - period * (along / period).round()) * latitude.cos()
        return torch.hypot(along, steps[..., 1 - self.axis])

    def margins(self, images: Tensor, margin: int) -> tuple[tuple[int, int], tuple[int, int]]:
        """By how many pixels `around` makes images (B, C, H, W) longer: (left, right), (top, bottom)."""
        sides = images.shape[-1], images.shape[-2]
        turn = (min(margin, sides[self.axis]),) * 2
        first, last = (min(margin, sides[1 - self.axis]) * pole for pole in self.poles)
        return (turn, (first, last)) if self.axis == 0 else ((first, last), turn)

    def around(self, images: Tensor, margin: int) -> Tensor:
        """Images (B, C, H, W) with as many pixels more at the edges that meet, of what lies beyond them."""
        if self.axis:
            return self._replace(axis=0).around(images.mT, margin).mT
        (turn, _), (first, last) = self.margins(images, margin)
        width, rows = images.shape[-1], [images]
        # beyond a pole lies what is half a turn on, upside down
        order = torch.arange(max(first, last) - 1, -1, -1, device=images.device)
        if first:
            rows.insert(0, images[..., :first, :].roll(width // 2, -1)[..., order[-first:], :])
        if last:
            rows.append(images[..., -last:, :].roll(width // 2, -1)[..., order[-last:], :])
        images = torch.cat(rows, -2) if len(rows) > 1 else images
        return torch.cat((images[..., -turn:], images, images[..., :turn]), -1)


def seam_of(camera: Camera) -> Seam | None:
    """Which edges of a camera's image meet; None for a camera that is no panorama of a whole turn.

    While the values may not be looked at, it is what was found when they last could be.
    """
    if not isinstance(camera, PANORAMAS):
        return None
    numbers = values_of(camera.intrinsics)
    if numbers is not None:
        camera._seam = _found(camera, numbers.reshape(-1, 4))  # type: ignore[assignment]
    return getattr(camera, "_seam", None)


def _found(camera: Camera, numbers: Tensor) -> Seam | None:
    axis = int(isinstance(camera, _DOWN))
    sides = camera._size_for("Warp")[::-1]
    turn, focal, centre = numbers[:, axis], numbers[:, 1 - axis], numbers[:, 3 - axis]
    if not len(numbers) or not bool(((2 * math.pi * turn - sides[axis]).abs() < _NEAR).all()):
        return None
    if not isinstance(camera, _SPHERES):
        return Seam(axis, (0.0, 0.0))
    ends = []
    for edge, pole in ((-0.5, -math.pi / 2), (sides[1 - axis] - 0.5, math.pi / 2)):
        is_pole = bool(((edge - centre - pole * focal).abs() < _NEAR).all())
        ends.append(pole if is_pole else float((edge - centre[0]) / focal[0]))
    return Seam(axis, (ends[0], ends[1]))


def seen_by(source: Camera, rays: Tensor) -> tuple[Tensor, Tensor]:
    """As `source.project`, of rays (..., 3); a panorama of a whole turn has every pixel on its image, and its poles.

    Straight up, where a panorama has a row of pixels and the model none, it is one of them.
    """
    seam = seam_of(source)
    if seam is None:
        return source.project(rays)
    if any(seam.poles):
        planes = list(rays.unbind(-1))
        least = planes[1 - seam.axis].abs() * torch.finfo(rays.dtype).eps
        at_pole = torch.maximum(planes[seam.axis].abs(), planes[2].abs()) < least
        planes[2] = torch.where(at_pole, least, planes[2])
        rays = torch.stack(planes, -1)
    pixels, mapped = source.project(rays)
    period = source._size_for("Warp")[1 - seam.axis]
    planes = list(pixels.unbind(-1))
    turns = ((planes[seam.axis].detach() + 0.5) / period).floor()
    planes[seam.axis] = planes[seam.axis] - turns * period
    return torch.stack(planes, -1), mapped


def rays_of(target: Camera, pixels: Numbers) -> tuple[Tensor, Tensor]:
    """As `target.unproject`, of pixels (..., 2); a panorama of a whole turn has rays all the way round.

    The model has them up to half a turn from its principal point, which may lie anywhere on such an image.
    """
    seam = seam_of(target)
    if seam is None:
        return target.unproject(pixels)
    pixels = as_coordinates(pixels, "pixels", 2, "Warp", target.intrinsics.device, "B, *N")
    period = target._size_for("Warp")[1 - seam.axis]
    planes = list(pixels.unbind(-1))
    numbers = target.intrinsics.detach()
    numbers = numbers.reshape(*numbers.shape[:-1], *[1] * (pixels.ndim - numbers.ndim), 4)
    nearly = 1 - 8 * torch.finfo(numbers.dtype).eps  # the ends themselves are rounded beyond them
    for axis, angle in ((seam.axis, math.pi), (1 - seam.axis, math.pi / 2)):
        offset, end = planes[axis] - numbers[..., 2 + axis], angle * nearly * numbers[..., axis]
        if axis == seam.axis:
            offset = offset - (offset.detach() / period).round() * period
        elif not all(seam.poles):
            continue
        planes[axis] = numbers[..., 2 + axis] + torch.maximum(torch.minimum(offset, end), -end)
    return target.unproject(torch.stack(planes, -1))
