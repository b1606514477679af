"""Cameras as layers for PyTorch: learnable camera models, exact in both directions, and every warp between them."""

import importlib
import importlib.util
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType

    from camtorch._public import *  # noqa: F403 (the list is there)
    from camtorch._public import __all__ as __all__
    from camtorch.models import *  # noqa: F403

__version__ = "0.2.0"

# What is public needs torch, which takes a second to import; `camtorch --help` does not. So names come at first use.


def _load() -> None:
    public = importlib.import_module("camtorch._public")
    globals().update({name: getattr(public, name) for name in ("__all__", *public.__all__)})


if not TYPE_CHECKING:  # a checker knows the names, and no others

    def __getattr__(name: str) -> Any:
        if name == "__all__" or not name.startswith("_"):
            _load()
            if name in globals():
                return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    # packages that were imported on the way are not the public surface
    return [*sys.modules[__name__].__all__, *(name for name in globals() if name.startswith("__"))]


class _AfterTorch:
    """A finder that loads camtorch once torch is there: `torch.export.load` reads programs of camtorch's operators."""

    @classmethod
    def find_spec(
        cls, name: str, path: "Sequence[str] | None" = None, target: "ModuleType | None" = None, /
    ) -> "ModuleSpec | None":
        """The spec of torch, of nothing else; what it executes has camtorch after it."""
        if name != "torch":
            return None
        sys.meta_path.remove(cls)
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_load(module: "ModuleType") -> None:
                execute(module)
                # whoever imports a part of camtorch, and torch by it, has what that part registers
                if not any(loaded.startswith("camtorch.") for loaded in sys.modules):
                    _load()

            spec.loader.exec_module = execute_and_load  # type: ignore[method-assign]
        return spec


if "torch" in sys.modules:
    _load()
else:
    sys.meta_path.insert(0, _AfterTorch)
