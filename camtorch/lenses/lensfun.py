"""Lenses of lensfun's database, read by your own `lensfunpy`; camtorch includes no part of it."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from camtorch.models import Tabulated
from camtorch.values.arguments import as_image_size, as_number

_DIAGONAL = math.hypot(36, 24)  # mm, of a sensor with crop factor 1
_ASPECTS = (3 / 2, 4 / 3, 16 / 9, 1.0)  # of the calibration images, the first one most often
_NODES = 128
_SIDE = 600  # of the image that determines the aspect ratio
# LensType of lensfunpy -> the angle of a radius in focal lengths
_ANGLES: dict[str, Any] = {
    "RECTILINEAR": np.arctan,
    "FISHEYE": np.asarray,
    "FISHEYE_ORTHOGRAPHIC": np.arcsin,
    "FISHEYE_STEREOGRAPHIC": lambda r: 2 * np.arctan(r / 2),
    "FISHEYE_EQUISOLID": lambda r: 2 * np.arcsin(r / 2),
    "FISHEYE_THOBY": lambda r: np.arcsin(r / 1.47) / 0.713,
}
# DistortionModel of lensfunpy -> r_d / r_u of r = r_u and the terms
_FACTORS: dict[str, Any] = {
    "POLY3": lambda r, k, *_: 1 - k + k * r**2,
    "POLY5": lambda r, k1, k2, *_: 1 + k1 * r**2 + k2 * r**4,
    "PTLENS": lambda r, a, b, c: a * r**3 + b * r**2 + c * r + 1 - a - b - c,
}


def from_lensfun(camera: Any, lens: Any, focal_length: float, *, image_size: Sequence[int]) -> Tabulated:
    """Return the camera of a lens of lensfun, in float64 and frozen.

    lensfun's factors of the radius, "ptlens" (a r^3 + b r^2 + c r + 1 - a - b - c), "poly3" and "poly5", may have odd
    powers, so the camera is a table; `camera.convert("brown_conrady", count=8)` and others return their error. The
    focal length is that of Exif, which is not calibrated; the axis is in the middle of the image. r = 1 is half the
    shorter side of the calibration images. lensfunpy does not return their aspect ratio, so the one of 3:2, 4:3, 16:9
    and 1:1 that fits lensfunpy's `Modifier` is used. Source: lensfun 0.3, `mod-coord.cpp`.

    Args:
        camera: A `lensfunpy.Camera`, for its crop factor.
        lens: A `lensfunpy.Lens`.
        focal_length: Focal length in mm.
        image_size: (height, width) of the photographs.

    Raises:
        ValueError: If lensfun has no distortion or no angles of the lens, as for panoramas, or a focal length is 0.
        ImportError: If lensfunpy is not installed.
    """
    import lensfunpy

    owner = "lenses.from_lensfun"
    size, focal = as_image_size(image_size, owner), as_number(focal_length, "focal_length", owner)
    if size is None or focal <= 0:
        raise ValueError(f"{owner}: image_size must be given, focal_length be > 0; got {image_size}, {focal_length}")
    found = lens.interpolate_distortion(focal)
    if found is None or found.model.name not in _FACTORS or lens.type.name not in _ANGLES:
        what = f"{lens.maker} {lens.model} at {focal:g} mm, {lens.type.name.lower()}"
        raise ValueError(f"{owner}: lens must have distortion and angles in lensfun; got {what}")
    height, width = size
    corner = math.hypot(width, height) / 2
    # image corners in units of lensfun, for each possible aspect ratio of the calibration images
    corners = [lens.crop_factor / camera.crop_factor * math.hypot(1, aspect) for aspect in _ASPECTS]
    small = [max(2, round(side * _SIDE / max(size))) for side in (width, height)]
    modifier = lensfunpy.Modifier(lens, camera.crop_factor, *small)
    modifier.initialize(focal, lens.min_aperture or 8.0, scale=1.0, flags=lensfunpy.ModifyFlags.DISTORTION)
    moved = modifier.apply_geometry_distortion()
    factor = _FACTORS[found.model.name]
    if moved is not None:  # None means no distortion
        middle = (np.array(small) - 1) / 2
        seen = float(np.linalg.norm(moved[0, 0] - middle) / np.linalg.norm(middle))
        corners.sort(key=lambda r: abs(factor(r, *found.terms) - seen))
    angle = _ANGLES[lens.type.name]
    long = 2 * focal * camera.crop_factor / _DIAGONAL  # the focal length in half diagonals
    reach = np.linspace(0, 2, 8 * _NODES)  # undistorted, in half diagonals
    with np.errstate(invalid="ignore"):
        angles = angle(reach / long)
        heights = reach * factor(reach * corners[0], *found.terms)
    ascending = (np.diff(heights) > 0) & (np.diff(angles) > 0) & (heights[:-1] < 1) & (angles[1:] < math.pi)
    end = reach[int(np.argmin(np.append(ascending, False)))]
    radii = np.linspace(0, end, _NODES)[1:]
    heights = corner * radii * factor(radii * corners[0], *found.terms)
    made = Tabulated.from_table([(width - 1) / 2, (height - 1) / 2], angle(radii / long), heights, image_size=size)
    return made.requires_grad_(False)
