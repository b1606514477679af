"""Calibration boards: their points, and finding them in images."""
