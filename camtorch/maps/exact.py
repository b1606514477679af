"""What a map is measured against: where a warp takes the pixels of its target from, in float64."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from camtorch.warp.warp import Warp

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

_STRIP = 1 << 19  # pixels computed at a time


class Exact:
    """Positions on the source's image by pixels of the target, as the cameras say: no lattice, nothing rounded."""

    positions: Floats
    """(H', W', 2): x and y in pixels of the source for every pixel of the target; finite, on its image or off."""
    mapped: Bools  # (H', W'): the pixel has a ray, and the source maps it, on its image or off
    shown: Bools  # (H', W'): the pixel shows something of the source's image, as `Warp.valid_mask`

    def __init__(self, warp: Warp, owner: str):
        if not isinstance(warp, Warp):
            raise TypeError(f"{owner}: warp must be a Warp; got {type(warp).__name__}")
        if (count := warp.batch_shape.numel()) != 1:
            raise ValueError(
                f"{owner}: a map is of one warp, and this is a batch of {count}; camera[i] is one of a batch of "
                "cameras, so take each ct.Warp(source[i], target[i], rotation[i])"
            )
        self.warp = warp
        self.source_size: tuple[int, int] = warp.source._size_for(owner)
        self.target_size: tuple[int, int] = warp.target._size_for(owner)
        with torch.no_grad():
            self._back = warp.inverse()
        height, width = self.target_size
        self.positions, self.mapped = self.at(np.arange(float(width)), np.arange(float(height)))
        outer = np.array(self.source_size[::-1]) - 0.5
        self.shown = self.mapped & ((self.positions >= -0.5) & (self.positions <= outer)).all(-1)

    def at(self, columns: Floats, rows: Floats) -> tuple[Floats, Bools]:
        """Return positions (n, m, 2) and `mapped` (n, m) where columns (m,) and rows (n,) of the target cross."""
        positions, mapped = np.empty((len(rows), len(columns), 2)), np.empty((len(rows), len(columns)), np.bool_)
        step = max(_STRIP // max(len(columns), 1), 1)
        for top in range(0, len(rows), step):
            here = slice(top, top + step)
            grid = np.stack(np.meshgrid(columns, rows[here]), -1)
            pixels = torch.from_numpy(grid).to(self.warp.target.intrinsics.device)
            with torch.no_grad():
                moved, valid = self._back._move(pixels.expand(*self.warp.batch_shape, *grid.shape))
            positions[here] = moved.double().cpu().numpy().reshape(grid.shape)
            mapped[here] = valid.cpu().numpy().reshape(grid.shape[:-1])
        return positions, mapped
