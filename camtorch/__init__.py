"""Cameras as layers for PyTorch: learnable camera models, exact in both directions, and every warp between them."""

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from camtorch._public import *  # noqa: F403 (the list is there)
    from camtorch.models import *  # noqa: F403

__version__ = "0.4.0.dev0"

# What is public needs torch, which takes a second to import; `camtorch --help` does not. So names come at first use.


def _load() -> None:
    public = vars(importlib.import_module("camtorch._public"))
    names = {name: value for name, value in public.items() if not name.startswith("_")}
    globals().update(names, __all__=sorted(names))


if not TYPE_CHECKING:  # a checker knows the names, and no others

    def __getattr__(name: str) -> Any:
        if name == "__all__" or not name.startswith("_"):
            _load()
            if name in globals():
                return globals()[name]
        from camtorch.values.arguments import LEFT

        raise AttributeError(f"module {__name__!r} has no attribute {name!r}. {LEFT}")


def __dir__() -> list[str]:
    # packages that were imported on the way are not the public surface
    return [*sys.modules[__name__].__all__, *(name for name in globals() if name.startswith("__"))]


if "torch" in sys.modules:  # what `torch.export.load` reads may have camtorch's operators
    _load()
