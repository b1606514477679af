"""Cameras and poses from what was seen: calibration, of rigs too, the pose of an object, points from several cameras."""
