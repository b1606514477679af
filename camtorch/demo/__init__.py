"""Rendered rooms and drivers with exact truth, for the demos. Not part of the wheel."""
