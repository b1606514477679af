"""A map as read, and the exact positions to compare it with: positions on the source's image for target pixels."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch.native.structs import FAR, OUTSIDE
from camtorch.values.dtypes import check_averaged, narrow, widen
from camtorch.warp.arrays import Image, warped_alike
from camtorch.warp.warp import Warp

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

_STRIP = 1 << 19  # pixels computed at a time


class Exact:
    """Exact positions on the source's image for target pixels, computed by the cameras without lattice or rounding."""

    positions: Floats  # (H', W', 2): x and y in pixels of the source; finite, on its image or off
    mapped: Bools  # (H', W'): the pixel has a ray, and the source maps it, on its image or off
    shown: Bools  # (H', W'): the pixel shows something of the source's image, as `Warp.valid_mask`

    def __init__(self, warp: Warp, owner: str):
        if not isinstance(warp, Warp):
            raise TypeError(f"{owner}: warp must be a Warp; got {type(warp).__name__}")
        count = warp.batch_shape.numel()
        if count != 1:
            raise ValueError(f"{owner}: warp must be a single one, as of camera[i]; got a batch of {count}")
        self.warp = warp
        self.source_size: tuple[int, int] = warp.source.size_for(owner)
        self.target_size: tuple[int, int] = warp.target.size_for(owner)
        with torch.no_grad():
            self._back = warp.inverse()
        height, width = self.target_size
        self.positions, self.mapped = self.at(np.arange(float(width)), np.arange(float(height)))
        outer = np.array(self.source_size[::-1]) - 0.5
        self.shown = self.mapped & ((self.positions >= -0.5) & (self.positions <= outer)).all(-1)

    def at(self, columns: Floats, rows: Floats) -> tuple[Floats, Bools]:
        """Return positions (n, m, 2) and `mapped` (n, m) at crossings of columns (m,) and rows (n,) of the target."""
        positions, mapped = np.empty((len(rows), len(columns), 2)), np.empty((len(rows), len(columns)), np.bool_)
        step = max(_STRIP // max(len(columns), 1), 1)
        for top in range(0, len(rows), step):
            here = slice(top, top + step)
            grid = np.stack(np.meshgrid(columns, rows[here]), -1)
            pixels = torch.from_numpy(grid).to(self.warp.target.intrinsics.device)
            with torch.no_grad():
                moved, valid = self._back.move(pixels.expand(*self.warp.batch_shape, *grid.shape))
            positions[here] = moved.double().cpu().numpy().reshape(grid.shape)
            mapped[here] = valid.cpu().numpy().reshape(grid.shape[:-1])
        return positions, mapped


@dataclass(eq=False, repr=False)
class LookupMap:
    """A map that was read from a file: the source position of every target pixel.

    Meshes are interpolated as the hardware does. Use it to check a file, and to see the images that a runtime will
    make; `Warp` is faster and more exact.
    """

    positions: Tensor
    """(H', W', 2) float64, x and y in pixels of the source; NaN for pixels that the map leaves empty."""
    source_size: tuple[int, int]
    """(height, width) of its input images."""
    format: str
    facts: dict[str, Any]
    """Other facts of the file or its description, such as `step`, `nodes` or `block_size`."""

    @property
    def target_size(self) -> tuple[int, int]:
        """(height, width) of its output images."""
        height, width = self.positions.shape[:2]
        return height, width

    @property
    def map_x(self) -> Tensor:
        """Columns (H', W') float32, as for `cv2.remap`."""
        return self.positions[..., 0].float()

    @property
    def map_y(self) -> Tensor:
        """Rows (H', W') float32, as for `cv2.remap`."""
        return self.positions[..., 1].float()

    def grid(self) -> Tensor:
        """Return the grid (1, H', W', 2) float32 for `grid_sample(..., align_corners=False)`; -9 means no position."""
        size = self.positions.new_tensor(self.source_size[::-1])
        grid = ((2 * self.positions + 1) / size - 1).nan_to_num(OUTSIDE, OUTSIDE, OUTSIDE)
        return grid.clamp(-FAR, FAR).float()[None]

    def valid_mask(self) -> Tensor:
        """Return a mask (1, 1, H', W') bool: True if the pixel shows a part of the source's image."""
        outer = self.positions.new_tensor(self.source_size[::-1]) - 0.5
        return ((self.positions >= -0.5) & (self.positions <= outer)).all(-1)[None, None]  # NaN is nowhere

    def __call__(self, images: Image, mode: str = "bilinear", padding_mode: str = "zeros") -> Image:
        """Warp images of the source's size, and return the same kind, as `Warp` does; dtypes are kept.

        `mode` is "nearest" (integers are exact up to 2^53), "bilinear" or "bicubic", `padding_mode` as in `Warp`.

        Raises:
            ValueError: If the images have another shape or size, or integers but uint8 and uint16 would be averaged.
        """
        size, given = self.source_size, cast("Any", images)
        if not isinstance(given, Tensor):
            warp: Any = partial(self, mode=mode, padding_mode=padding_mode)
            return cast("Image", warped_alike(given, size, "LookupMap", warp))
        if given.is_complex() or given.is_sparse or given.ndim < 3 or given.shape[-2:] != size:
            what, form = f"{given.dtype} {tuple(given.shape)}", f"(..., C, {size[0]}, {size[1]})"
            raise ValueError(f"LookupMap: images must be a dense tensor {form} of real numbers; got {what}")
        check_averaged(given, mode, "images", "LookupMap")
        values = widen(given[None].flatten(0, -4))
        grid = self.grid().to(values).expand(len(values), -1, -1, -1)
        made = narrow(F.grid_sample(values, grid, mode, padding_mode, align_corners=False), given.dtype)
        return cast("Image", made.view(*given.shape[:-2], *self.target_size))

    def error(self, warp: Warp) -> Tensor:
        """Return the distance (H', W') float64 to a warp in pixels of the source; NaN if the warp shows nothing there.

        Positions beyond the outermost pixel centres count as on them, because edges are repeated. If only the map
        leaves a pixel empty, the distance is infinite.

        Raises:
            ValueError: If the warp is between images of other sizes.
        """
        return self._off(Exact(warp, "LookupMap.error"))

    def _off(self, exact: Exact) -> Tensor:
        mine, wanted = (self.source_size, self.target_size), (exact.source_size, exact.target_size)
        if mine != wanted:
            raise ValueError(f"LookupMap.error: map and warp must have the same sizes; got {mine} and {wanted}")
        limits = self.positions.new_zeros(2), self.positions.new_tensor(self.source_size[::-1]) - 1
        off = self.positions.clamp(*limits) - torch.from_numpy(exact.positions).clamp(*limits)
        distance = torch.hypot(*off.unbind(-1)).nan_to_num(math.inf)
        return torch.where(torch.from_numpy(exact.shown), distance, math.nan)

    def __repr__(self) -> str:
        facts = "".join(f", {name}={value}" for name, value in self.facts.items())
        return f"LookupMap({self.format}, source_size={self.source_size}, target_size={self.target_size}{facts})"
