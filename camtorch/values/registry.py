"""Classes by their full names: operators take no classes."""

from __future__ import annotations

import importlib
from typing import Any


class _Classes(dict[str, Any]):
    def __missing__(self, name: str) -> Any:
        importlib.import_module(name.rpartition(".")[0])  # a saved program is loaded before what it is made of
        if name not in self:
            raise KeyError(name)
        return self[name]


CLASSES = _Classes()
"""Every class of cameras and of radial factors."""


def register(entry: type) -> str:
    """The name under which a class is known from now on.

    A class of the same name, made by a function that was called again, gets a name of its own.
    """
    wanted = name = f"{entry.__module__}.{entry.__qualname__}"
    count = 2
    while name in CLASSES:
        name, count = f"{wanted}#{count}", count + 1
    CLASSES[name] = entry
    return name
