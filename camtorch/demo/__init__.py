"""Rendered rooms and drivers with exact truth, for the demos: in the repository, not in wheels."""
