"""Cameras, poses and points from what was seen: calibration, also of rigs, the pose of an object, triangulation."""
