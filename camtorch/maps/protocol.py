"""The interface of a format of maps: its names, its options, and functions to write and read."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from camtorch.maps.lookup import Exact, LookupMap

MOST_PIXELS = 1 << 26  # of a map that is read: 8192 x 8192
SIZES = "source_height", "source_width", "target_height", "target_width"  # keys in files and descriptions
_LONGEST_SIDE = 1 << 16  # pixels


class MapFormat(ABC):
    """A format of maps, with one object in `camtorch.maps.formats`."""

    name: str  # its key in `save_map`
    suffixes: tuple[str, ...] = ()  # of its files; a suffix means the first format that has it
    options: tuple[str, ...] = ()  # names of its options in `save_map`
    described = False  # whether its files need a description next to them

    @abstractmethod
    def encode(self, path: str, exact: Exact, options: Mapping[str, Any]) -> tuple[bytes, dict[str, Any]]:
        """Return the file of a warp, and the facts that its user needs.

        Raises:
            CameraFileError: If the format cannot hold the warp. ValueError, TypeError: If an option is bad.
        """

    def matches(self, path: str, content: bytes) -> bool:
        """Whether a path or content is a file of this format."""
        return bool(self.suffixes) and path.lower().endswith(self.suffixes)

    @abstractmethod
    def decode(self, content: bytes, described: Mapping[str, Any]) -> LookupMap:
        """Read a file, with its description. Any exception except an ImportError means that it is damaged."""


def checked(name: str, size: Any) -> tuple[int, int]:
    """Return the (height, width) of a file or its description; raise a ValueError if it is no such pair."""
    sides = tuple(size)
    whole = all(isinstance(side, int) and 0 < side <= _LONGEST_SIDE for side in sides)
    if len(sides) != 2 or not whole or sides[0] * sides[1] > MOST_PIXELS:
        raise ValueError(f"{name} must be (height, width) of at most {MOST_PIXELS} pixels; got {size!r:.60}")
    return sides[0], sides[1]
