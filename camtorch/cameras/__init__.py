"""Cameras: one, several of several models, rigs."""
