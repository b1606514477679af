"""Plots of cameras, by matplotlib (`pip install camtorch[plot]`): each function draws on Axes and returns them."""

from camtorch.plot.cameras import difference, distortion_field, portrait, radius_curve

__all__ = ["difference", "distortion_field", "portrait", "radius_curve"]
