"""What a format of maps provides: its names, the options that it takes, and how it is written and read."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from camtorch.maps.exact import Exact
from camtorch.maps.lookup import LookupMap

MOST_PIXELS = 1 << 26
"""Of a map that is read: 8192 x 8192."""
SIZES = "source_height", "source_width", "target_height", "target_width"
"""What files and descriptions call them."""
_LONGEST = 1 << 16  # pixels along a side


@dataclass(frozen=True)
class Options:
    """What is said of a map: by `Warp.save`, or by the description of one to read. None is the format's own."""

    step: int | None = None
    v: str | None = None
    block: tuple[int, int] | None = None
    dtype: str | None = None
    clip: bool | None = None
    source_size: tuple[int, int] | None = None
    target_size: tuple[int, int] | None = None


class MapFormat(ABC):
    """A format: one object a format, in `camtorch.maps.formats`.

    Attributes:
        name: its key in `Warp.save`.
        suffixes: of its files; the first format that has a suffix is meant by it. None of a bare table.
        options: of `Options`, those that `Warp.save` takes for it.
        described: whether its files say nothing of themselves, so that a description is written beside them.
    """

    name: str
    suffixes: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    described = False

    @abstractmethod
    def encode(self, path: str, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        """The file of a warp, and the facts that its user needs beside it.

        Raises:
            CameraFileError: what the format cannot hold. ValueError: a bad option.
        """

    def matches(self, path: str, content: bytes) -> bool:
        """Whether this is such a file."""
        return bool(self.suffixes) and path.lower().endswith(self.suffixes)

    @abstractmethod
    def decode(self, content: bytes, given: Options) -> LookupMap:
        """Read a file. Any exception but an ImportError says that it is damaged."""


def named_sizes(source: tuple[int, int], target: tuple[int, int]) -> dict[str, int]:
    """`SIZES` of images (height, width)."""
    return dict(zip(SIZES, (*source, *target), strict=True))


def checked(name: str, size: Any) -> tuple[int, int]:
    """The (height, width) that a map to read is for, as the file or its description says.

    Raises:
        ValueError: it is none.
    """
    sides = tuple(size) if isinstance(size, (tuple, list)) else ()
    whole = all(isinstance(side, int) and 0 < side <= _LONGEST for side in sides)
    if len(sides) != 2 or not whole or sides[0] * sides[1] > MOST_PIXELS:
        raise ValueError(f"{name} {size!r:.60} is no (height, width) of a map; at most {MOST_PIXELS} pixels")
    return sides[0], sides[1]
