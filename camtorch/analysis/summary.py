"""What a camera sees, in numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from camtorch.camera import Camera

_POINTS, _SIDE = 513, 129  # along a line, and on the sides of a lattice over the image
_ANGLES, _AZIMUTHS = 3601, 32
_MOST_COEFFICIENTS = 16
CORNERS = ("top left", "top right", "bottom left", "bottom right")


@dataclass
class Summary:
    """Numbers of a single camera; those of the image are None for a camera without image size."""

    camera: Camera
    valid_angle: tuple[float, float]
    """Radians from the axis up to which rays are valid, on the azimuths where that is least and greatest."""
    fov: tuple[float, float, float] | None = None
    """Radians: horizontal and vertical through the principal point, and on the wider diagonal of the image, from
    outer edge to outer edge or as far as there are rays."""
    seen: float | None = None
    """The part of the image that has rays."""
    corners: tuple[tuple[float, float] | str, ...] | None = None
    """For each of CORNERS how many pixels right and down distortion moves what is there, or why that has no answer."""

    def lines(self) -> list[str]:
        """For people: a label and its numbers on each line."""
        camera = self.camera
        fx, fy, cx, cy = camera.intrinsics.tolist()
        size = "not stated" if camera.image_size is None else "{1} x {0}".format(*camera.image_size)
        named = zip(camera.distortion_names, camera.distortion.tolist(), strict=True)
        rows = [
            ("model", f"{type(camera).__name__} ({camera.key})"),
            ("image", size),
            ("focal length", f"fx {fx:.8g}, fy {fy:.8g} px"),
            ("principal point", f"cx {cx:.8g}, cy {cy:.8g} px"),
            ("coefficients", _shortened([f"{name} {value:.8g}" for name, value in named])),
        ]
        low, high = (math.degrees(angle) for angle in self.valid_angle)
        rows.append(
            ("valid rays", f"up to {low:.1f} degrees from the axis" + (f", {high:.1f} in places" * (high > low + 0.1)))
        )
        if self.fov is not None:
            wide, tall, across = (f"{math.degrees(angle):.1f}" for angle in self.fov)
            rows.append(("field of view", f"{wide} horizontal, {tall} vertical, {across} diagonal degrees"))
            rows.append(("has rays", f"{100 * self.seen:.4g} % of the image"))
            moves = [m if isinstance(m, str) else f"({m[0]:+.1f}, {m[1]:+.1f})" for m in self.corners]
            texts = [f"{name} {move}" for name, move in zip(CORNERS, moves, strict=True)]
            rows.append(("distortion, px", ", ".join(texts) if len(set(moves)) > 1 else f"corners {moves[0]}"))
        return [f"{label:<16} {text}" for label, text in rows]


def _shortened(texts: list[str]) -> str:
    if len(texts) > _MOST_COEFFICIENTS:
        return f"{', '.join(texts[:4])}, ... {texts[-1]} ({len(texts)} in all)"
    return ", ".join(texts) or "none"


@torch.no_grad()
def summarise(camera: Camera) -> Summary:
    """The summary of a camera.

    Raises:
        ValueError: the camera is a batch.
    """
    if camera.batch_shape:
        raise ValueError(f"a summary is of one camera; got batch dims {tuple(camera.batch_shape)}")
    result = Summary(camera, _valid_angle(camera))
    if camera.image_size is not None:
        result.fov = _fov(camera)
        result.seen = float(camera.unproject(lattice(camera, _SIDE, _SIDE))[1].double().mean())
        result.corners = _corners(camera)
    return result


def ideal(camera: Camera) -> Camera:
    """The camera of the same pixels per radian at the axis, with coefficients that do nothing."""
    if not camera.distortion_names:
        return camera
    values = camera.distortion.new_tensor(camera.ideal(len(camera.distortion_names)))
    axis = camera.intrinsics.new_tensor([0.0, 0.0, 1.0])
    slopes = torch.func.jacrev(lambda ray: camera.project(ray)[0])(axis).diagonal().detach()
    intrinsics = camera.intrinsics.detach()
    # that a chart or a table has a slope of its own is no distortion
    slopes = torch.where(((slopes / intrinsics[:2] - 1).abs() > 1e-9) & (slopes > 0), slopes, intrinsics[:2])
    return type(camera)(torch.cat((slopes, intrinsics[2:])), values, image_size=camera.image_size)


def lattice(camera: Camera, rows: int, columns: int) -> Tensor:
    """(rows, columns, 2): pixels from outer edge to outer edge of the image."""
    height, width = camera.image_size
    v, u = (torch.linspace(-0.5, side - 0.5, n).to(camera.intrinsics) for side, n in ((height, rows), (width, columns)))
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)


def fan(angles: Tensor, azimuths: int) -> Tensor:
    """(K,) angles from the axis -> (K, azimuths, 3) rays, evenly around the axis."""
    phi = (torch.arange(azimuths).to(angles) + 0.25) * (2 * math.pi / azimuths)
    theta = angles[:, None]
    return torch.stack((theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos().expand(-1, azimuths)), -1)


def _valid_angle(camera: Camera) -> tuple[float, float]:
    angles = torch.linspace(0, math.pi, _ANGLES).to(camera.intrinsics)
    valid = camera.project(fan(angles, _AZIMUTHS))[1].long().cumprod(0).sum(0)
    return tuple(float(angles[(count - 1).clamp(min=0)]) for count in (valid.amin(), valid.amax()))


def _fov(camera: Camera) -> tuple[float, float, float]:
    height, width = camera.image_size
    left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5
    cx, cy = camera.intrinsics[2:].clamp(min=-0.5).tolist()
    cx, cy = min(cx, right), min(cy, bottom)
    diagonals = [_along(camera, (left, top), (right, bottom)), _along(camera, (left, bottom), (right, top))]
    return _along(camera, (left, cy), (right, cy)), _along(camera, (cx, top), (cx, bottom)), max(diagonals)


def _along(camera: Camera, start: tuple[float, float], end: tuple[float, float]) -> float:
    """The angle, in radians, that a line of the image takes, as far as it has rays."""
    start, end = (camera.intrinsics.new_tensor(point) for point in (start, end))
    pixels = start + torch.linspace(0, 1, _POINTS).to(start)[:, None] * (end - start)
    rays, valid = camera.unproject(pixels)
    if not bool(valid.any()):
        return 0.0
    x, y, z = rays.double().unbind(-1)
    dx, dy = ((end - start) / torch.linalg.vector_norm(end - start)).tolist()
    # from a turn to the one side to a turn to the other: more than half a circle is no angle between two rays
    angle = torch.atan2(torch.hypot(x, y).copysign(x * dx + y * dy), z)[valid]
    return float(angle.amax() - angle.amin())


def _corners(camera: Camera) -> tuple[tuple[float, float] | str, ...]:
    pixels = lattice(camera, 2, 2).flatten(0, 1)
    rays, valid = camera.unproject(pixels)
    undistorted, covered = ideal(camera).project(rays)
    # rounding is no distortion, and has a sign of its own
    moved = ((pixels - undistorted).double().round(decimals=6) + 0.0).tolist()
    return tuple(
        "no ray" if not valid[i] else "past the ideal projection" if not covered[i] else tuple(moved[i])
        for i in range(len(CORNERS))
    )
