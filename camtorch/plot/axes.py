"""Common parts of the plots: the palette, new Axes, the frame of an image."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from camtorch.values.arguments import imported

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.quiver import Quiver

    from camtorch.cameras.camera import Camera

INK, GREY, PALE = "#2b2a2e", "#8a8378", "#efe9dd"
COLOURS = ("#1e64f0", "#e21d48", "#0b8a5f", "#b86e00", "#7a3fc2", "#5a6472")  # of cameras; the second also for marks
NO_RAYS = "#d9d4ca"  # for pixels without a value


def require_matplotlib() -> None:
    """Raise an ImportError with the line to install matplotlib if it is missing."""
    imported("matplotlib", "plots need matplotlib", "plot")


def axes_or_new(ax: Axes | None) -> Axes:
    """Return the Axes, or new Axes in a figure of their own; raise a TypeError for anything else."""
    if ax is not None:
        if not hasattr(ax, "get_figure"):
            hint = "Pass several cameras as one list, [a, b]"
            raise TypeError(f"plot: ax must be Axes of matplotlib; got {type(ax).__name__}. {hint}")
        return ax
    require_matplotlib()
    from matplotlib import pyplot  # late: this import chooses the backend

    return pyplot.subplots(layout="constrained")[1]


def check_single(camera: Camera) -> None:
    """Raise a ValueError if the camera is a batch."""
    if camera.batch_shape:
        raise ValueError(f"plot: camera must be a single one; got batch dims {tuple(camera.batch_shape)}")


def size_of(camera: Camera) -> tuple[int, int]:
    """Return (height, width) of a single camera, which must have them."""
    check_single(camera)
    return camera._size_for("a plot")


def draw_frame(ax: Axes, height: int, width: int) -> tuple[float, float, float, float]:
    """Draw the outer edges of an image, rows downwards, and return them as an `extent` for `imshow`."""
    margin = 0.02 * max(height, width)
    ax.set_xlim(-0.5 - margin, width - 0.5 + margin)
    ax.set_ylim(height - 0.5 + margin, -0.5 - margin)
    ax.set_aspect("equal")
    ax.spines[:].set_visible(False)
    ax.plot([-0.5, width - 0.5, width - 0.5, -0.5, -0.5], [-0.5, -0.5, height - 0.5, height - 0.5, -0.5], color=INK)
    return -0.5, width - 0.5, height - 0.5, -0.5


def draw_arrows(ax: Axes, *planes: np.ndarray, **options: Any) -> Quiver:
    """Draw arrows in the image's pixels: u and v of their starts and of their lengths, and values for colours."""
    return ax.quiver(*planes, cmap="viridis_r", angles="xy", scale_units="xy", scale=1, width=0.0025, **options)


def magnification(most: float) -> int:
    """Return the largest of 1, 2, 5, 10, ... up to a number."""
    if not 1 < most < 1e9:
        return 1
    power = int(10 ** math.floor(math.log10(most)))
    return power * max(n for n in (1, 2, 5) if n * power <= most)


def printable(name: str) -> str:
    """Return a name without characters that fonts cannot draw, as control characters and lone surrogates."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name)
