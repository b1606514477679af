"""Cameras: one, several of several models, rigs."""

# torch knows operators of saved programs, and how cameras are batched, as soon as there may be a camera
from camtorch.cameras import mixed as mixed
from camtorch.cameras import opaque as opaque
