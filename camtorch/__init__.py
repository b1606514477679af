"""Cameras as layers for PyTorch: learnable camera models, exact in both directions, and every warp between them."""

import importlib
import importlib.util
import sys
import threading
from typing import Any

from camtorch.values.stub import listed_names

__version__ = "0.5.0"

_PLACES = listed_names(__path__[0])
"""The module or package in which each public name is found."""
__all__ = sorted(_PLACES)

# What is public needs torch, which takes a second to import; `camtorch --help` does not. So names come at first use.
_REGISTERED = f"{__name__}.cameras"  # has torch know operators of saved programs, and batches of cameras
_LOCK = threading.RLock()  # a package and its files, imported by two threads at once, could be seen half made


def __getattr__(name: str) -> Any:
    place = _PLACES.get(name)
    with _LOCK:
        if place is not None:
            importlib.import_module(_REGISTERED)
        if place is not None and place != __name__:
            module = importlib.import_module(place)
            found = getattr(module, name, None) or importlib.import_module(f"{place}.{name}")
        elif not name.startswith("_") and importlib.util.find_spec(f"{__name__}.{name}"):
            found = importlib.import_module(f"{__name__}.{name}")
        else:
            from camtorch.values.arguments import LEFT

            raise AttributeError(f"module {__name__!r} has no attribute {name!r}. {LEFT}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    # packages that were imported on the way are not the public surface
    return [*__all__, *(name for name in globals() if name.startswith("__"))]


if "torch" in sys.modules:  # what `torch.export.load` reads may have camtorch's operators
    importlib.import_module(_REGISTERED)
