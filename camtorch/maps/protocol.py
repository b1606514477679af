"""What a format of maps provides: its names, the options that it takes, and how it is written and read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from camtorch.io._errors import CameraFileError
from camtorch.maps.exact import Exact
from camtorch.maps.lookup import LookupMap

MOST_PIXELS = 1 << 26
"""Of a map that is read: 8192 x 8192."""
SIZES = "source_height", "source_width", "target_height", "target_width"
"""What files and descriptions call them."""
_LONGEST = 1 << 16  # pixels along a side


@dataclass(frozen=True)
class Options:
    """What a caller may say of the map to write; None is the format's own. See `Warp.save`."""

    step: int | None = None
    v: str | None = None
    order: str | None = None
    block: tuple[int, int] | None = None
    dtype: str | None = None
    clip: bool | None = None


@dataclass(frozen=True)
class Given:
    """What a caller, or the description beside a table, says of a map to read, where its file does not."""

    source_size: tuple[int, int] | None = None
    target_size: tuple[int, int] | None = None
    step: int | None = None
    v: str | None = None
    order: str | None = None


@dataclass(frozen=True)
class Encoded:
    """A map that is to be written."""

    content: bytes
    facts: dict[str, Any] = field(default_factory=dict)
    """What whoever uses it has to know beside."""


class MapFormat(Protocol):
    """A format: one object a format, in `camtorch.maps.formats`."""

    @property
    def name(self) -> str:
        """Its key in `Warp.save`."""

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Of its files; the first format that has a suffix is meant by it. None of a bare table."""

    @property
    def options(self) -> tuple[str, ...]:
        """Of `Options`, those that it takes."""

    @property
    def described(self) -> bool:
        """Whether its files say nothing of themselves, so that a description is written beside them."""

    def encode(self, path: str, exact: Exact, options: Options) -> Encoded:
        """The map of a warp. Raises CameraFileError for what it cannot hold."""

    def matches(self, path: str, content: bytes) -> bool:
        """Whether this is such a file."""

    def decode(self, path: str, content: bytes, given: Given) -> LookupMap:
        """Read a file. Raises CameraFileError."""


def suffix_of(path: str, format: MapFormat) -> str:
    """The suffix of a file that is to be written, in small letters.

    Raises:
        ValueError: one that files of the format do not have.
    """
    suffix = os.path.splitext(path)[1].lower()
    if suffix not in format.suffixes:
        raise ValueError(f"{path}: files of {format.name} are called {', '.join(format.suffixes)}")
    return suffix


def named_sizes(source: tuple[int, int], target: tuple[int, int]) -> dict[str, int]:
    """`SIZES` of images (height, width)."""
    return dict(zip(SIZES, (*source, *target), strict=True))


def sizes_in(stated: Mapping[str, Any]) -> tuple[tuple[Any, Any], tuple[Any, Any]] | None:
    """(height, width) of source and target as they are stated, unchecked; None unless all are."""
    if not all(name in stated for name in SIZES):
        return None
    rows, columns, height, width = (stated[name] for name in SIZES)
    return (rows, columns), (height, width)


def checked(path: str, name: str, size: Any) -> tuple[int, int]:
    """The (height, width) that a map to read is for.

    Raises:
        CameraFileError: nobody says it, or it is none.
    """
    if size is None:
        raise CameraFileError(path, name, f"the file does not say it; say {name}=(height, width)")
    sides = tuple(size) if isinstance(size, (tuple, list)) else ()
    whole = all(isinstance(side, int) and 0 < side <= _LONGEST for side in sides)
    if len(sides) != 2 or not whole or sides[0] * sides[1] > MOST_PIXELS:
        raise CameraFileError(path, name, f"{size!r:.60} is no (height, width) of a map; at most {MOST_PIXELS} pixels")
    return sides[0], sides[1]
