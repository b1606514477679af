"""Plots of cameras and calibrations, by matplotlib (`pip install -e ".[plot]"`): each function draws on Axes, `ax`,
by default new ones, and returns them; `calibration` and `portrait` return a Figure.
"""

from camtorch.plot.figures import calibration, difference, distortion_field, portrait, radius_curve, rig

__all__ = ["calibration", "difference", "distortion_field", "portrait", "radius_curve", "rig"]
