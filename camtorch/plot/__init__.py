"""Plots of cameras and calibrations, by matplotlib (`pip install camtorch[plot]`): each function draws on Axes, `ax`,
by default new ones, and returns them. Without matplotlib an ImportError says how to install it.
"""

from camtorch.plot.calibrations import (
    boards,
    calibrated_radius,
    coverage,
    residual_histogram,
    residuals,
    uncertainty,
    view,
    views,
)
from camtorch.plot.cameras import difference, distortion_field, portrait, radius_curve, rig

__all__ = [
    "boards",
    "calibrated_radius",
    "coverage",
    "difference",
    "distortion_field",
    "portrait",
    "radius_curve",
    "residual_histogram",
    "residuals",
    "rig",
    "uncertainty",
    "view",
    "views",
]
