"""Scenes that are formulas, rendered through any camera: where everything in their images is, is known exactly."""
