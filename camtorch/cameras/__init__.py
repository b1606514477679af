"""Cameras: one, several of several models, rigs."""

# torch needs the operators of saved programs, and the way to batch cameras, before there is a camera
from camtorch.cameras import mixed as mixed
from camtorch.cameras import operators as operators
