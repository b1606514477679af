"""The content of a written map, and its error."""

from dataclasses import dataclass
from typing import Any

import torch

from camtorch.maps.lookup import Exact, LookupMap


@dataclass(frozen=True)
class MapReport:
    """The error of a map from its warp, measured pixel by pixel from the written bytes.

    Errors are distances in pixels of the source, over the pixels at which the warp shows the source's image. Positions
    beyond the outermost pixel centres count as on them, because edges are repeated.
    """

    path: str
    format: str
    source_size: tuple[int, int]
    """(height, width) of the input images."""
    target_size: tuple[int, int]
    """(height, width) of the output images."""
    max_error: float
    rms_error: float
    shown: int
    """Number of target pixels that show the source's image, over which errors are computed."""
    stray: int
    """Number of pixels that the warp leaves empty and the map does not: a mesh continues where rays end."""
    files: tuple[str, ...]
    """Written files: the map, and for a bare table its description."""
    facts: dict[str, Any]
    """Other facts that a user of the map needs by name, such as "step", "nodes" or "block_size"."""

    def __str__(self) -> str:
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
