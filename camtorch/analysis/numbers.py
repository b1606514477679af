"""Numbers of a camera, and the distance of two cameras' pixels for the same rays."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.cameras.camera import Camera
from camtorch.poses.rotations import nearest_rotation
from camtorch.rays.lattices import followed, ideal, image_lattice

_LONG = 400  # pixels of the lattice along the longer side
_ROUNDING = 1e-9  # px, far above the rounding of two equal cameras
_SIDE = 129  # of a lattice over the image
_ANGLES, _AZIMUTHS = 3601, 32
_MOST_COEFFICIENTS = 16
CORNERS = ("top left", "top right", "bottom left", "bottom right")


class Difference(NamedTuple):
    """Comparison of two cameras on a lattice (rows, columns) of pixels of the first one's image."""

    apart: Tensor  # pixels between the pixel and where the second camera shows its ray, float64
    both: Tensor  # bool: both have the ray
    rotation: Tensor  # (3, 3): rotation that was applied to the rays

    @property
    def rms(self) -> float:
        """Root of the mean square distance in pixels over common rays; NaN if there are none."""
        return float(self.apart[self.both].square().mean().sqrt())

    @property
    def largest(self) -> float:
        """Largest distance in pixels over common rays; NaN if there are none."""
        return float(self.apart[self.both].max()) if bool(self.both.any()) else math.nan

    @property
    def same(self) -> bool:
        """Whether common rays agree up to rounding; False if there are none."""
        return self.largest < _ROUNDING

    @property
    def part(self) -> float:
        """Part of the image with common rays."""
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

    `remove_rotation` first rotates the rays by the rotation that brings the cameras' rays closest: two
    calibrations of one camera may differ by their direction.
    """
    for camera in (a, b):
        if camera.batch_shape:
            raise ValueError(f"difference: cameras must be single; got batch dims {tuple(camera.batch_shape)}")
    height, width = a.size_for("a difference")
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


@dataclass
class Summary:
    """Numbers of a single camera; those of the image are None for a camera without image size."""

    camera: Camera
    valid_angle: tuple[float, float]  # radians from the axis up to which rays are valid, on the worst and best azimuth
    fov: tuple[float, float, float] | None = None  # degrees, see `Camera.fov`
    seen: float | None = None  # part of the image that has rays
    # for each of CORNERS the pixels right and down by which distortion moves it, or a text if there is no answer
    corners: tuple[tuple[float, float] | str, ...] | None = None

    def lines(self) -> list[str]:
        """Return lines for people, each with a label and its numbers."""
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
        # rounding is no distortion; its sign must not appear
        moved = ((pixels - undistorted).double().round(decimals=6) + 0.0).tolist()
        result.corners = tuple(
            "no ray" if not valid[i] else "past the ideal projection" if not covered[i] else tuple(moved[i])
            for i in range(len(CORNERS))
        )
    return result
