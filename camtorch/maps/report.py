"""What a map that was written holds, and how far it is from the warp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from camtorch.maps.lookup import Exact, LookupMap


@dataclass(frozen=True)
class MapReport:
    """How far a map is from the warp that it was made of, by what its own bytes say, pixel by pixel.

    Errors are distances in pixels of the source, over the pixels where the warp shows the source's image. Positions
    beyond the outermost pixel centres count as on them, as edges are repeated.
    """

    path: str
    format: str
    source_size: tuple[int, int]
    """(height, width) of the images that the map takes."""
    target_size: tuple[int, int]
    """(height, width) of those that it makes."""
    max_error: float
    rms_error: float
    shown: int
    """Pixels of the target that show the source's image, of which the errors are."""
    stray: int
    """Pixels that the warp leaves empty, and the map does not: a mesh goes on where rays end."""
    files: tuple[str, ...]
    """What was written: the map, and beside a bare table its description."""
    facts: dict[str, Any]
    """What whoever uses the map has to know beside, such as `step`, `nodes` or `block_size`."""

    def __getattr__(self, name: str) -> Any:
        if name in (facts := self.__dict__.get("facts", {})):  # a fact is an attribute
            return facts[name]
        raise AttributeError(f"MapReport of {self.__dict__.get('format')} has no {name!r}; it has {', '.join(facts)}")

    def __str__(self) -> str:
        """One line, as the command line prints it."""
        (rows, columns), (height, width) = self.source_size, self.target_size
        part = 100 * self.shown / (height * width)
        stray = f"; {self.stray} pixels are drawn that the warp leaves empty" if self.stray else ""
        # sizes are (height, width), and printed as everywhere
        facts = {k: "x".join(map(str, v[::-1])) if isinstance(v, tuple) else v for k, v in self.facts.items()}
        return (
            f"{self.path}: {self.format}, {width}x{height} from {columns}x{rows}, off by at most "
            f"{self.max_error:.3g} px, rms {self.rms_error:.3g} px, over the {part:.4g} % that show the image{stray}"
            + "".join(f"; {name.replace('_', ' ')} {value}" for name, value in facts.items())
        )


def measure(path: str, read: LookupMap, exact: Exact, files: tuple[str, ...], facts: dict[str, Any]) -> MapReport:
    """Return the report on a map that was read back."""
    shown = torch.from_numpy(exact.shown)
    error = read._off(exact)[shown]
    return MapReport(
        path=path,
        format=read.format,
        source_size=read.source_size,
        target_size=read.target_size,
        max_error=float(error.max()) if len(error) else 0.0,
        rms_error=float(error.square().mean().sqrt()) if len(error) else 0.0,
        shown=int(shown.sum()),
        stray=int((read.valid_mask()[0, 0] & ~shown).sum()),
        files=files,
        facts=facts,
    )
