"""Boards that are photographed to calibrate: what they are, and finding them in images."""
