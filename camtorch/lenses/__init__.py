"""Real lenses: 9,810 calibrations of action cameras, phones, photo and cinema cameras, found by name."""

from camtorch.lenses.collection import Lens, find, search
from camtorch.lenses.lensfun import from_lensfun

__all__ = ["Lens", "find", "from_lensfun", "search"]
