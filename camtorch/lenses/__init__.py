"""Real lenses: 9,810 calibrations of action cameras, phones, photo and cinema cameras, found by name."""

from camtorch.lenses.collection import Lens, find, search

__all__ = ["Lens", "find", "search"]
