"""Panoramas of a whole turn: a warp extends their images beyond the edges that meet."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.evaluate.tensors import values_of
from camtorch.values.module import remade

_MOST_GAP = 0.05  # pixels by which a whole turn may miss the edges: a focal length of two decimals misses by 0.03
_RIM_PIXELS = 16  # beyond an edge: bicubic samples of images halved three times read so far


class Seam(NamedTuple):
    """Pixels by which images of a whole turn are extended."""

    axis: int  # 0: the turn goes across, so that left and right meet; 1: down, so that top and bottom do
    rims: tuple[int, int, int, int]  # pixels on the left, right, top and bottom

    def around(self, images: Tensor) -> Tensor:
        """Return images (B, C, H, W) extended beyond their edges."""
        if self.axis:
            return Seam(0, (*self.rims[2:], *self.rims[:2])).around(images.mT).mT
        left, right, top, bottom = self.rims
        width, rows = images.shape[-1], [images]
        # beyond a pole the image goes on half a turn away, upside down
        order = torch.arange(max(top, bottom) - 1, -1, -1, device=images.device)
        if top:
            rows.insert(0, images[..., :top, :].roll(width // 2, -1)[..., order[-top:], :])
        if bottom:
            rows.append(images[..., -bottom:, :].roll(width // 2, -1)[..., order[-bottom:], :])
        images = torch.cat(rows, -2) if len(rows) > 1 else images
        return torch.cat((images[..., -left:], images, images[..., :right]), -1)

    def camera_of(self, camera: Camera) -> Camera:
        """Return the camera of the extended images of a camera."""
        left, right, top, bottom = self.rims
        height, width = camera.size_for("Warp")
        intrinsics = camera.intrinsics + camera.intrinsics.new_tensor([0.0, 0.0, left, top])
        size = height + top + bottom, width + left + right
        return remade(camera, intrinsics=intrinsics, distortion=camera.distortion, image_size=size)

    def on_image(self, grid: Tensor, size: tuple[int, int]) -> Tensor:
        """Return positions (..., 2) on the extended images as positions on the images of a size."""
        (height, width), (left, right, top, bottom) = size, self.rims
        scale = grid.new_tensor([(left + width + right) / width, (top + height + bottom) / height])
        return grid * scale + grid.new_tensor([(right - left) / width, (bottom - top) / height])


def seam_of(camera: Camera) -> Seam | None:
    """Return how far a camera's whole-turn images are extended, or None; in traced code, the last result."""
    axis = camera.turn_axis
    if axis is None:
        return None
    numbers = values_of(camera.intrinsics)
    if numbers is not None:
        camera._seam = _found(camera, axis, numbers.reshape(-1, 4))  # type: ignore[assignment]
    return getattr(camera, "_seam", None)


def _found(camera: Camera, axis: int, numbers: Tensor) -> Seam | None:
    sides = camera.size_for("Warp")[::-1]
    side, other = sides[axis], sides[1 - axis]
    if not len(numbers) or not bool(((math.tau * numbers[:, axis] - side).abs() < _MOST_GAP).all()):
        return None
    # the model has pixels for half a turn to either side of its principal point, which may lie anywhere
    low, high = (float(end) - (side - 1) / 2 for end in torch.aminmax(numbers[:, 2 + axis]))
    beyond = [math.ceil(max(end, 0.0)) for end in (-low, high)]
    if max(beyond) > side:
        return None
    rims = [end + min(_RIM_PIXELS, side - end) for end in beyond]
    poles = [0, 0]
    if camera.has_poles:
        focal, centre = numbers[:, 1 - axis], numbers[:, 3 - axis]
        for i, (edge, pole) in enumerate(((-0.5, -math.pi / 2), (other - 0.5, math.pi / 2))):
            if bool(((edge - centre - pole * focal).abs() < _MOST_GAP).all()):
                poles[i] = min(_RIM_PIXELS, other)
    first, second = (rims, poles) if axis == 0 else (poles, rims)
    return Seam(axis, (first[0], first[1], second[0], second[1]))


def goes_round(camera: Camera) -> tuple[int, Tensor] | None:
    """Return the axis and the numbers (C, 4) of a panorama whose images show a whole turn or more; None for others."""
    axis = camera.turn_axis
    if axis is None:
        return None
    known = values_of(camera.intrinsics)
    if known is None:
        return None
    numbers, side = known.reshape(-1, 4), camera.size_for("Warp")[1 - axis]
    return (axis, numbers) if bool((math.tau * numbers[:, axis] < side + _MOST_GAP).all()) else None


def lengths(camera: Camera, steps: tuple[Tensor, Tensor], grid: tuple[Tensor, Tensor]) -> Tensor:
    """Return the lengths (B, h, w) of steps on a camera's image in pixels; on a panorama, as in the scene."""
    turn = goes_round(camera)
    if turn is None:
        return torch.hypot(*steps)
    axis, other = turn[0], 1 - turn[0]
    numbers = turn[1][..., None, None].to(grid[0])
    period = math.tau * numbers[:, axis]
    along = steps[axis] - period * (steps[axis] / period).round()
    if camera.has_poles:
        place = ((grid[other] + 1) * camera.size_for("Warp")[1 - other] - 1) / 2
        along = along * ((place - numbers[:, 2 + other]) / numbers[:, other]).cos()
    return torch.hypot(along, steps[other])


def off_poles(camera: Camera, rays: Tensor) -> Tensor:
    """Return rays (..., 3) moved off the poles of a sphere, where its image has a row of pixels and its model none."""
    axis = camera.turn_axis
    if axis is None or not camera.has_poles:
        return rays
    planes = list(rays.unbind(-1))
    least = planes[1 - axis].abs() * torch.finfo(rays.dtype).eps
    at_pole = torch.maximum(planes[axis].abs(), planes[2].abs()) < least
    planes[2] = torch.where(at_pole, least, planes[2])
    return torch.stack(planes, -1)


def within_turn(camera: Camera, pixels: Tensor) -> Tensor:
    """Return pixels ([B,] h, w, 2); those of a whole turn are wrapped to pixels for which the model has rays."""
    seam = seam_of(camera)
    if seam is None:
        return pixels
    axis, side = seam.axis, camera.size_for("Warp")[1 - seam.axis]
    numbers = camera.intrinsics.detach()
    numbers = numbers.reshape(*numbers.shape[:-1], *[1] * (pixels.ndim - numbers.ndim), 4)
    focal, centre = numbers[..., axis], numbers[..., 2 + axis]
    planes = list(pixels.unbind(-1))
    offset = planes[axis] - centre
    offset = offset - (offset / side).round() * side
    end = math.pi * (1 - 8 * torch.finfo(numbers.dtype).eps) * focal  # pi itself is rounded beyond the end
    planes[axis] = centre + torch.maximum(torch.minimum(offset, end), -end)
    return torch.stack(torch.broadcast_tensors(*planes), -1)
