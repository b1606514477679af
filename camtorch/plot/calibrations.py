"""The figure of a calibration: its residuals over the image, and how far the camera can be trusted."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from camtorch.calibration.rig import RigCalibration
from camtorch.calibration.verdict import Calibration
from camtorch.plot.axes import (
    COLOURS,
    INK,
    NO_RAYS,
    draw_arrows,
    draw_frame,
    levels,
    magnification,
    printable,
    require_matplotlib,
    size_of,
)
from camtorch.rays.lattices import image_lattice

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:  # it is optional, and takes a second: for those who ask for hints at runtime
    Axes = Figure = Any

_ARROWS = 15_000  # as many as an image has room for
_LATTICE = 96  # of the map of uncertainty, along the longer side
_BANDS = 8


@torch.no_grad()
def calibration(calibration: Calibration | RigCalibration) -> Figure:
    """Draw the residuals over the image, and the uncertainty of projections; for a rig a row for each camera.

    Residuals are arrows from where a corner was seen to where the camera shows it, longer by a factor that the title
    names; crosses are outliers. The map is `calibration.uncertainty`, at infinity; dots are corners, and grey pixels
    have no rays.

    Args:
        calibration: Result of `ct.calibrate` or `ct.calibrate_rig`.
    """
    require_matplotlib()
    from matplotlib import pyplot

    cameras = getattr(calibration, "cameras", None) or {"": calibration}
    figure, axes = pyplot.subplots(
        len(cameras), 2, squeeze=False, figsize=(12.4, 5.2 * len(cameras)), layout="constrained"
    )
    for (name, camera), (left, right) in zip(cameras.items(), axes, strict=True):
        seen = camera.observations.seen & camera.point_residuals.isfinite().all(-1)
        inliers = (seen & camera.point_inliers).numpy(force=True)
        pixels, errors = (t.double().numpy(force=True) for t in (camera.observations.pixels, camera.point_residuals))
        head = f"{printable(name)}: " if name else ""
        _draw_residuals(left, camera, pixels[inliers], errors[inliers], head)
        outliers = pixels[seen.numpy(force=True) & ~inliers]
        if len(outliers):
            label = f"{len(outliers):,} outlier{'s' * (len(outliers) > 1)}"
            left.plot(*outliers.T, "x", color=COLOURS[1], markersize=4, label=label, zorder=5)
            left.legend(loc="lower right", framealpha=0.8)
        _draw_uncertainty(right, camera, head)
        right.plot(*pixels[inliers].T, ".", color=INK, markersize=1.5, zorder=4)
    return figure


def _draw_residuals(ax: Axes, calibration: Calibration, pixels: np.ndarray, errors: np.ndarray, head: str) -> None:
    height, width = size_of(calibration.camera)
    draw_frame(ax, height, width)
    lengths = np.linalg.norm(errors, axis=-1)
    # an even choice of all lengths, the longest last and so above the others
    some = np.argsort(lengths, kind="stable")[np.linspace(0, len(lengths) - 1, min(len(lengths), _ARROWS)).astype(int)]
    usual = float(np.quantile(lengths, 0.98)) if len(lengths) else 0.0
    longer = magnification(0.05 * max(height, width) / max(usual, 1e-9))
    planes = *pixels[some].T, *errors[some].T * longer, lengths[some]
    arrows = draw_arrows(ax, *planes, colours="residuals", clim=(0, usual or 1.0))
    ax.figure.colorbar(arrows, ax=ax, label="px", shrink=0.8, pad=0.02, extend="max")
    less = "" if len(some) == len(lengths) else f" of {len(lengths):,}"
    ax.set_title(f"{head}residuals of {len(some):,}{less} corners, {longer:,} times as long")


def _draw_uncertainty(ax: Axes, calibration: Calibration, head: str) -> None:
    height, width = size_of(calibration.camera)
    draw_frame(ax, height, width)
    rows, columns = (max(2, round(_LATTICE * side / max(height, width))) + 1 for side in (height, width))
    pixels = image_lattice(calibration.camera, rows, columns).double()
    values = np.ma.masked_invalid(calibration.uncertainty(pixels).double().numpy(force=True))
    ax.fill_between([-0.5, width - 0.5], -0.5, height - 0.5, color=NO_RAYS, linewidth=0, zorder=0.5)
    ax.set_title(f"{head}sigma of a projection")
    if values.count():
        # bounds from 1, 2, 5, 10, ... around most values
        low, high = (math.log10(max(value, 1e-6)) for value in np.quantile(values.compressed(), (0.01, 0.97)))
        powers = range(math.floor(low), math.ceil(high) + 1)
        ladder = [float(f"{digit}e{power}") for power in powers for digit in (1, 2, 5)]
        first = max(i for i, bound in enumerate(ladder) if i == 0 or bound <= 10**low)
        last = next((i for i, bound in enumerate(ladder) if bound >= 10**high and i > first), len(ladder) - 1)
        bounds = ladder[first : min(last, first + _BANDS) + 1]
        u, v = pixels[0, :, 0].numpy(force=True), pixels[:, 0, 1].numpy(force=True)
        colours = levels("uncertainty", len(bounds)).colors
        bands = ax.contourf(u, v, np.ma.maximum(values, bounds[0]), bounds, colors=colours, extend="max", zorder=1)
        ax.figure.colorbar(bands, ax=ax, label="px", format="%g", shrink=0.8, pad=0.02)
        ax.set_title(f"{head}sigma of a projection at infinity, median {np.median(values.compressed()):.2g} px")
