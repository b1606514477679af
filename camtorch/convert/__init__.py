"""Conversion of a camera to another model."""
