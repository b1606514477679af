"""Cameras, poses and points from pixels: calibration of cameras and rigs, poses of objects, triangulation."""
