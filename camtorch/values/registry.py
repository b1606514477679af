"""Classes by their full names: operators take no classes."""

from __future__ import annotations

from typing import Any

CLASSES: dict[str, Any] = {}
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
