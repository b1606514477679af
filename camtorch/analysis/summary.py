"""What a camera sees, in numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.cameras.camera import Camera
from camtorch.rays.lattices import followed, ideal, image_lattice

_SIDE = 129  # of a lattice over the image
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
    """Degrees: horizontal and vertical through the principal point, and on the wider diagonal of the image, from
    outer edge to outer edge or as far as there are rays."""
    seen: float | None = None  # the part of the image that has rays
    corners: tuple[tuple[float, float] | str, ...] | None = None
    """For each of CORNERS how many pixels right and down distortion moves what is there, or why that has no answer."""

    def lines(self) -> list[str]:
        """For people: a label and its numbers on each line."""
        camera = self.camera
        fx, fy, cx, cy = camera.intrinsics.tolist()
        size = "not stated" if camera.image_size is None else "{1} x {0}".format(*camera.image_size)
        named = zip(camera.distortion_names, camera.distortion.tolist(), strict=True)
        texts = [f"{name} {value:.8g}" for name, value in named]
        if len(texts) > _MOST_COEFFICIENTS:
            texts = [*texts[:4], f"... {texts[-1]} ({len(texts)} in all)"]
        rows = [
            ("model", f"{type_before_parametrizations(camera).__name__} ({camera.key})"),
            ("image", size),
            ("focal length", f"fx {fx:.8g}, fy {fy:.8g} px"),
            ("principal point", f"cx {cx:.8g}, cy {cy:.8g} px"),
            ("coefficients", ", ".join(texts) or "none"),
        ]
        low, high = (math.degrees(angle) for angle in self.valid_angle)
        furthest = f", {high:.1f} in places" if high > low + 0.1 else ""
        rows.append(("valid rays", f"up to {low:.1f} degrees from the axis{furthest}"))
        if self.fov is not None and self.seen is not None and self.corners is not None:
            wide, tall, across = (f"{angle:.1f}" for angle in self.fov)
            rows.append(("field of view", f"{wide} horizontal, {tall} vertical, {across} diagonal degrees"))
            rows.append(("has rays", f"{100 * self.seen:.4g} % of the image"))
            moves = [m if isinstance(m, str) else f"({m[0]:+.1f}, {m[1]:+.1f})" for m in self.corners]
            texts = [f"{name} {move}" for name, move in zip(CORNERS, moves, strict=True)]
            rows.append(("distortion, px", ", ".join(texts) if len(set(moves)) > 1 else f"corners {moves[0]}"))
        return [f"{label:<16} {text}" for label, text in rows]


@torch.no_grad()
def summarise(camera: Camera) -> Summary:
    """Return the summary of a single camera."""
    if camera.batch_shape:
        raise ValueError(f"summary: camera must be a single one; got batch dims {tuple(camera.batch_shape)}")
    angles = torch.linspace(0, math.pi, _ANGLES).to(camera.intrinsics)
    counts = followed(camera, angles, _AZIMUTHS)[1].sum(0)
    least, most = (float(angles[(count - 1).clamp(min=0)]) for count in counts.aminmax())
    result = Summary(camera, (least, most))
    if camera.image_size is not None:
        result.fov = tuple(camera.fov.tolist())
        result.seen = float(camera.unproject(image_lattice(camera, _SIDE, _SIDE))[1].double().mean())
        pixels = image_lattice(camera, 2, 2).flatten(0, 1)
        rays, valid = camera.unproject(pixels)
        undistorted, covered = ideal(camera).project(rays)
        # rounding is no distortion, and has a sign of its own
        moved = ((pixels - undistorted).double().round(decimals=6) + 0.0).tolist()
        result.corners = tuple(
            "no ray" if not valid[i] else "past the ideal projection" if not covered[i] else tuple(moved[i])
            for i in range(len(CORNERS))
        )
    return result
