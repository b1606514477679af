"""Plots of calibrations: what the camera saw, how well it was explained, and how far the result can be trusted."""

from __future__ import annotations

import bisect
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from camtorch.plot.axes import (
    COLOURS,
    GREY,
    INK,
    NO_RAYS,
    PALE,
    axes_or_new,
    draw_frame,
    levels,
    magnification,
    printable,
    size_of,
)
from camtorch.projection.rays import followed, image_lattice

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from numpy.typing import ArrayLike

    from camtorch.calibration.calibrate import Calibration

_CELLS = 14  # of the coverage, along the longer side
_ARROWS = 15_000  # which is as many as an image has room for
_BOARDS = 300
_DENSE = 3000  # corners, that are drawn finer
_LATTICE = 96  # of the map of uncertainty, along the longer side
_AZIMUTHS = 16
_MOST_BANDS = 8


class Sightings(NamedTuple):
    """What a camera saw of V views of up to N corners each: NaN and False where there is nothing.

    numbers: (V,) of the views, among those that were passed. pixels: (V, N, 2) observed. errors: (V, N, 2) projected
    minus observed. inliers: (V, N). points: (V, N, 3) in the camera's frame.
    """

    numbers: tuple[int, ...]
    pixels: np.ndarray
    errors: np.ndarray
    inliers: np.ndarray
    points: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(V, N) corners that have a residual."""
        return np.asarray(np.isfinite(self.errors).all(-1))

    @property
    def used(self) -> np.ndarray:
        """(V, N) those that are no outliers."""
        return np.asarray(self.seen & self.inliers)

    @property
    def lengths(self) -> np.ndarray:
        """(V, N) px, of the residuals."""
        return np.asarray(np.linalg.norm(self.errors, axis=-1))

    @property
    def angles(self) -> np.ndarray:
        """(K,) radians from the optical axis, of the corners that are no outliers."""
        x, y, z = self.points[self.used].T
        return np.asarray(np.arctan2(np.hypot(x, y), z))

    @property
    def reach(self) -> float:
        """Radians from the axis of the furthest inlier, but for one in 200, which may be wrong; 0 without any."""
        angles = np.sort(self.angles)
        return float(angles[math.ceil(0.995 * len(angles)) - 1]) if len(angles) else 0.0

    @property
    def rms(self) -> np.ndarray:
        """(V,) px per point of the inliers of each view, NaN for a view without any."""
        squares, counts = np.where(self.used, self.lengths**2, 0).sum(-1), self.used.sum(-1)
        return np.asarray(np.sqrt(np.where(counts > 0, squares, np.nan) / np.maximum(counts, 1)))


@torch.no_grad()
def sightings(calibration: Calibration) -> Sightings:
    """Of the views that have corners."""
    found = calibration.observations
    placed = (found.pixels, calibration.point_residuals, calibration.extrinsics(found.points))
    known = [torch.where(found.seen[..., None], t, torch.nan) for t in placed]
    some = found.seen.any(-1)
    numbers = tuple(number for number, has in zip(calibration.views, some.tolist(), strict=True) if has)
    pixels, errors, points = (t[some].double().numpy(force=True) for t in known)
    return Sightings(numbers, pixels, errors, calibration.point_inliers[some].numpy(force=True), points)


def _on_image(calibration: Calibration, ax: Axes | None) -> tuple[Axes, Sightings, tuple[int, int]]:
    """Axes with the frame of the camera's image, what was seen on it, and its (height, width)."""
    ax, size = axes_or_new(ax), size_of(calibration.camera)
    draw_frame(ax, *size)
    return ax, sightings(calibration), size


def coverage(calibration: Calibration, ax: Axes | None = None) -> Axes:
    """Where the image has corners: dots, on cells that are the darker the more corners they have; crosses are outliers.

    The title says in how many of the cells that have rays a corner was seen.
    """
    from matplotlib.colors import PowerNorm

    ax, shots, (height, width) = _on_image(calibration, ax)
    rows, columns = (max(3, round(_CELLS * side / max(height, width))) for side in (height, width))
    pixels = shots.pixels[shots.used]
    edges = [np.linspace(-0.5, length - 0.5, count + 1) for length, count in ((height, rows), (width, columns))]
    counts = np.histogram2d(pixels[:, 1], pixels[:, 0], edges)[0]
    cells = np.ma.masked_equal(counts, 0)
    cmap, norm = levels("counts").with_extremes(bad=PALE), PowerNorm(0.5, 0, max(counts.max(), 1))
    ax.pcolormesh(edges[1], edges[0], cells, cmap=cmap, norm=norm, zorder=0.5, edgecolors="#ffffff", linewidth=0.6)
    _strokes(
        ax, np.repeat(pixels[_evenly(len(pixels), _ARROWS)][:, None], 2, 1), INK, 0.9 if len(pixels) > _DENSE else 1.6
    )
    _crosses(ax, shots)
    lattice = image_lattice(calibration.camera, 2 * rows + 1, 2 * columns + 1)[1::2, 1::2]
    with torch.no_grad():
        rays = calibration.camera.unproject(lattice)[1].numpy(force=True) | (counts > 0)
    share = (counts > 0).sum() / max(rays.sum(), 1)
    ax.set_title(f"{len(pixels):,} corners in {100 * share:.0f} % of the image")
    return ax


def residuals(calibration: Calibration, ax: Axes | None = None) -> Axes:
    """The residuals of all corners over the image, from where a corner was seen to where the model shows it.

    They are drawn longer, by a factor that the title says. Crosses are outliers. Of more than 15,000 an even choice of
    all lengths is drawn, with the longest.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm
    from matplotlib.ticker import MaxNLocator

    ax, shots, (height, width) = _on_image(calibration, ax)
    use = shots.used
    pixels, errors, lengths = shots.pixels[use], shots.errors[use], shots.lengths[use]
    few = np.argsort(-lengths, kind="stable")[_evenly(len(lengths), _ARROWS)]
    pixels, errors, lengths = pixels[few], errors[few], lengths[few]
    usual = float(np.quantile(lengths, 0.98)) if len(lengths) else 0.0
    bounds = MaxNLocator(5).tick_values(0, usual or 1.0)
    room = 3 * math.sqrt(height * width / max(len(lengths), 1)) / max(height, width)  # for each, of the longer side
    longer = magnification(min(0.045, max(0.02, room)) * max(height, width) / bounds[-1])
    cmap = levels("residuals", len(bounds) - 1)
    dense = len(lengths) > _DENSE
    place = np.digitize(lengths, bounds[1:-1])
    for i, colour in enumerate(cmap(np.arange(cmap.N))):
        start, along = pixels[place == i], longer * errors[place == i]
        _strokes(ax, np.stack((start, start + along), 1), colour, 0.6 if dense else 0.9, 2 + i / 10)
        _strokes(ax, np.repeat(start[:, None], 2, 1), colour, 1.2 if dense else 2.0, 2 + i / 10)
    _crosses(ax, shots)
    extend = "max" if (lengths > bounds[-1]).any() else "neither"
    _bar(ax, ScalarMappable(BoundaryNorm(bounds, cmap.N), cmap), "px", extend=extend)
    times = f", {longer:,} times as long" if longer > 1 else ""
    less = "" if len(few) == use.sum() else f", {len(few):,} of {use.sum():,}"
    ax.set_title(f"residuals, from the seen corner to the projected one{times}{less}")
    return ax


def residual_histogram(calibration: Calibration, ax: Axes | None = None) -> Axes:
    """How often residuals have a size, across (u) and down (v), beside the normal distribution of sigma."""
    ax, shots = axes_or_new(ax), sightings(calibration)
    errors = shots.errors[shots.used]
    sigma = float(calibration.sigma)
    reach = 4.5 * sigma if sigma > 0 else 1.0
    bins = np.linspace(-reach, reach, 46).tolist()
    inside = errors.clip(-reach, reach)
    ax.hist(inside[:, 0], bins, color=COLOURS[0], alpha=0.35, label="u", linewidth=0)
    ax.hist(inside[:, 1], bins, color=COLOURS[3], histtype="step", linewidth=1.4, label="v")
    if sigma > 0:
        x = np.linspace(-reach, reach, 181)
        normal = np.exp(-((x / sigma) ** 2) / 2) / (sigma * math.sqrt(2 * math.pi))
        label = f"normal, {sigma:.3g} px"
        ax.plot(x, normal * len(errors) * (bins[1] - bins[0]), color=INK, linestyle="--", linewidth=1, label=label)
    title = "residuals across (u) and down (v)"
    ax.set(xlim=(-reach, reach), xlabel="residual, px", ylabel="corners", title=title)
    ax.legend(frameon=False, loc="upper right", handlelength=1.4)
    return ax


def views(calibration: Calibration, ax: Axes | None = None, *, names: Sequence[str] | None = None) -> Axes:
    """The rms of the residuals of each view, as bars, and that of all as a line.

    Args:
        calibration: of a camera.
        ax: by default new ones.
        names: of all views that were passed; by default their numbers from 0.

    Raises:
        ValueError: not as many names as views.
    """
    ax, shots = axes_or_new(ax), sightings(calibration)
    rms = shots.rms
    count = len(calibration.image_points)
    if names is not None and len(names) != count:
        raise ValueError(f"plot: {count} views, and names for {len(names)}")
    labels = [str(number) if names is None else printable(names[number]) for number in shots.numbers]
    ax.bar(np.arange(len(rms)), np.nan_to_num(rms), color=COLOURS[0], width=0.8)
    ax.axhline(float(calibration.rms), color=INK, linestyle="--", linewidth=1)
    step = max(1, math.ceil(len(rms) / (40 if names is None else 25)))
    shown = np.arange(0, len(rms), step)
    turned = 0 if names is None else 90
    ax.set_xticks(shown, [labels[i] for i in shown], parse_math=False, rotation=turned)
    title = "rms of each view; dashed: of all"
    ax.set(xlim=(-0.6, len(rms) - 0.4), xlabel="view", ylabel="rms, px", title=title)
    return ax


def view(calibration: Calibration, number: int, ax: Axes | None = None, *, image: ArrayLike | None = None) -> Axes:
    """The corners of one view as rings, on its photograph; lines to where the model shows them, longer than they are.

    Args:
        calibration: of a camera.
        number: of the view, from 0, among those that were passed.
        ax: by default new ones.
        image: (H, W) or (H, W, C), of the size of the camera's image.

    Raises:
        ValueError: no such view, or one without corners; an image of another size.
    """
    ax, shots = axes_or_new(ax), sightings(calibration)
    height, width = size_of(calibration.camera)
    if number not in shots.numbers:
        raise ValueError(
            f"plot: no view {number} with corners; of {len(calibration.image_points)} {len(shots.numbers)} have"
        )
    index = shots.numbers.index(number)
    edges = draw_frame(ax, height, width)
    if image is not None:
        image = np.asarray(image)
        if image.shape[:2] != (height, width):
            raise ValueError(
                f"plot: image is {image.shape[:2]} (height, width), and the camera's image_size {(height, width)}"
            )
        ax.imshow(image, extent=edges, cmap="gray", zorder=0)
    use = shots.used[index]
    pixels, errors = shots.pixels[index][use], shots.errors[index][use]
    usual = float(np.quantile(shots.lengths[index][use], 0.9)) if use.any() else 1.0
    longer = magnification(0.03 * max(height, width) / max(usual, 1e-9))
    size, thick = (6.5, 1.3) if use.sum() < 150 else (4.0, 0.9)
    ax.plot(*pixels.T, "o", markersize=size, markerfacecolor="none", markeredgecolor=COLOURS[0], markeredgewidth=thick)
    _strokes(ax, np.stack((pixels, pixels + longer * errors), 1), COLOURS[3], thick, 4)
    _crosses(ax, shots, index)
    times = f", residuals {longer:,} times as long" if longer > 1 else ""
    ax.set_title(f"view {number}, rms {shots.rms[index]:.3g} px{times}")
    return ax


def uncertainty(calibration: Calibration, ax: Axes | None = None, *, distance: float = math.inf) -> Axes:
    """How far a pixel can be trusted: `calibration.uncertainty` over the image, with the outline of what has corners.

    Args:
        calibration: of a camera.
        ax: by default new ones.
        distance: of what is seen, in the unit of the boards.
    """
    ax, shots, (height, width) = _on_image(calibration, ax)
    rows, columns = (max(2, round(_LATTICE * side / max(height, width))) + 1 for side in (height, width))
    pixels = image_lattice(calibration.camera, rows, columns).double()
    values = np.ma.masked_invalid(calibration.uncertainty(pixels, distance).double().numpy(force=True))
    ax.fill_between([-0.5, width - 0.5], -0.5, height - 0.5, color=NO_RAYS, linewidth=0, zorder=0.5)
    at = "at infinity" if math.isinf(distance) else f"at a distance of {distance:.3g}"
    ax.set_title(f"sigma of a projection {at}")
    if values.count():
        bounds = _bands(values.compressed())
        extend = "max" if values.max() > bounds[-1] else "neither"
        u, v = pixels[0, :, 0].numpy(force=True), pixels[:, 0, 1].numpy(force=True)
        colours = levels("uncertainty", len(bounds) - (extend == "neither")).colors
        filled = ax.contourf(u, v, np.ma.maximum(values, bounds[0]), bounds, colors=colours, extend=extend, zorder=1)
        _bar(ax, filled, "px")
        ax.set_title(f"sigma of a projection {at}: median {np.median(values.compressed()):.2g} px")
    outline = _hull(shots.pixels[shots.used])
    ax.plot(*outline.T, color=INK, linestyle=(0, (4, 3)), linewidth=1.1, zorder=4)
    return ax


@torch.no_grad()
def calibrated_radius(calibration: Calibration, ax: Axes | None = None) -> Axes:
    """The distance from the principal point over the angle from the axis, and what is known of it.

    Shaded are the angles that the corners have but for one in 200, with the histogram of all at the bottom. The band is
    the uncertainty of a projection at infinity, drawn wider by the factor that the legend says. The curve ends with the
    image, or with the rays.
    """
    ax, shots, camera = axes_or_new(ax), sightings(calibration), calibration.camera
    size_of(camera)
    angles = torch.linspace(0, math.pi, 181).to(camera.intrinsics)
    pixels, valid = followed(camera, angles, _AZIMUTHS)
    inside = valid & camera.contains(pixels)
    radius = torch.linalg.vector_norm(pixels - camera.intrinsics[2:], dim=-1)
    seen = np.degrees(shots.angles)
    known = math.degrees(shots.reach)
    ax.axvspan(0, known, color=PALE, zorder=0)
    some = inside.any(-1)
    middle = torch.where(valid, radius, torch.nan).nanmean(-1)[some].double()
    # the greatest among the azimuths that are inside
    sigmas = torch.where(inside, calibration.uncertainty(pixels.double()), -1.0).nan_to_num(-1.0).amax(-1)[some]
    sigma = torch.where(sigmas >= 0, sigmas, torch.nan).double().numpy(force=True)
    x, y = np.degrees(angles[some].double().numpy(force=True)), middle.numpy(force=True)
    top = 1.08 * float(np.nanmax(y)) if len(y) else 1.0
    within = sigma[x <= known]
    usual = float(np.nanmax(within)) if np.isfinite(within).any() else math.nan
    if usual > 0:
        wider = magnification(0.06 * top / usual)
        label = f"± sigma at infinity, {wider:,} times" if wider > 1 else "± sigma at infinity"
        low, high = (np.clip(y + sign * wider * sigma, 0, top) for sign in (-1, 1))
        ax.fill_between(x, low, high, color=COLOURS[0], alpha=0.22, linewidth=0, zorder=2, label=label)
    ax.plot(x, y, color=COLOURS[0], linewidth=1.8, zorder=3, label=camera.key)
    if len(x):
        ax.plot(x[-1:], y[-1:], "o", color=COLOURS[0], markersize=4.5, zorder=3)
    if len(seen):
        edges = np.arange(0, seen.max() + 2.5, 2.5)
        counts = np.histogram(seen, edges)[0]
        heights = counts * (0.16 * top / counts.max())
        ax.bar(edges[:-1], heights, 2.3, align="edge", color=GREY, alpha=0.55, zorder=1, label="corners")
    furthest = 1.06 * max(float(x[-1]) if len(x) else 1.0, float(seen.max(initial=1e-3)))
    ax.set(xlim=(0, furthest), ylim=(0, top), title="radius over angle, within the image")
    ax.set(xlabel="angle from the axis, degrees", ylabel="distance from the principal point, px")
    ax.legend(frameon=False, loc="upper left", handlelength=1.4)
    return ax


def boards(calibration: Calibration, ax: Axes | None = None) -> Axes:
    """The boards as they stood before the camera, seen from its upper right, each in the colour of its rms.

    Of more than 300 an even choice is drawn.
    """
    from matplotlib.collections import PolyCollection

    ax, shots = axes_or_new(ax), sightings(calibration)
    outlines = [_hull(_oblique(points[np.isfinite(points).all(-1)])) for points in shots.points]
    known = [i for i, outline in enumerate(outlines) if len(outline) > 2 and math.isfinite(shots.rms[i])]
    some = [known[i] for i in _evenly(len(known), _BOARDS)]
    size, few = 1.0, len(some) < 60
    if some:
        shapes = [outlines[i] for i in some]
        size = float(np.abs(np.concatenate(shapes)).max())
        options: Any = {"array": shots.rms[some], "cmap": levels("residuals")}
        ax.add_collection(PolyCollection(shapes, **options, alpha=0.35 if few else 0.15, zorder=2))
        rims = PolyCollection(shapes, **options, facecolors="none", linewidths=1.0 if few else 0.5, zorder=3)
        ax.add_collection(rims)
        _bar(ax, rims, "rms, px")
    _draw_camera(ax, 0.12 * size)
    _ruler(ax, size)
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.06)
    ax.set_axis_off()
    less = "" if len(some) == len(known) else f"{len(some)} of "
    ax.set_title(f"{less}{len(known):,} board{'s' * (len(known) != 1)} before the camera")
    return ax


# -- parts of plots


def _bar(ax: Axes, mappable: ScalarMappable, label: str, **options: Any) -> None:
    bar = ax.figure.colorbar(mappable, ax=ax, label=label, format="%g", shrink=0.8, pad=0.02, aspect=28, **options)
    bar.outline.set_visible(False)
    bar.ax.minorticks_off()


def _evenly(count: int, most: int) -> np.ndarray:
    """Indices of all, or of an even choice with the first and the last one."""
    return np.linspace(0, count - 1, min(count, most)).astype(int)


def _strokes(ax: Axes, ends: np.ndarray, colour: Any, width: float, zorder: float = 2.0) -> None:
    """(K, 2, 2) lines with round ends, of no length dots, as one path: thousands of them make a small file."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    path = Path(ends.reshape(-1, 2), np.tile([Path.MOVETO, Path.LINETO], len(ends)).astype(np.uint8))
    path.should_simplify = False  # which would drop the dots
    ax.add_patch(PathPatch(path, facecolor="none", edgecolor=colour, linewidth=width, capstyle="round", zorder=zorder))


def _crosses(ax: Axes, shots: Sightings, index: int | None = None) -> None:
    """Outliers."""
    rows = slice(None) if index is None else index
    out = shots.seen[rows] & ~shots.inliers[rows]
    if out.any():
        u, v = shots.pixels[rows][out].T
        label = f"{len(u):,} outlier{'s' * (len(u) > 1)}"
        size, thick = (4, 1.0) if index is None else (7, 1.6)
        ax.plot(u, v, "x", color=COLOURS[1], markersize=size, markeredgewidth=thick, label=label, zorder=5)
        ax.legend(loc="lower right", framealpha=0.8, handletextpad=0.2)


def _bands(values: np.ndarray) -> list[float]:
    """Bounds from 1, 2, 5, 10, ... around what most values are."""
    ladder = [float(f"{digit}e{power}") for power in range(-6, 10) for digit in (1, 2, 5)]
    low, high = np.quantile(values, (0.01, 0.97))
    first = max(bisect.bisect_right(ladder, low) - 1, 0)
    last = min(max(bisect.bisect_left(ladder, high), first + 1), first + _MOST_BANDS)
    return ladder[first : last + 1]


def _hull(points: np.ndarray) -> np.ndarray:
    """(M, 2), closed: the convex hull of (N, 2), by Andrew's monotone chain."""
    ordered = np.unique(points, axis=0)
    around: list[np.ndarray] = []
    for along in (ordered, ordered[::-1]) if len(ordered) > 2 else ():
        half: list[np.ndarray] = []
        for p in along:
            while len(half) > 1 and np.linalg.det((half[-1] - half[-2], p - half[-2])) <= 0:
                half.pop()
            half.append(p)
        around += half[:-1]
    return np.array([*around, around[0]]) if around else ordered


def _oblique(points: np.ndarray) -> np.ndarray:
    """(..., 3) of the camera's frame to (..., 2), right and up, as seen from its right, behind and above."""
    turn, tilt = math.radians(58), math.radians(24)
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    away = z * math.cos(turn) - x * math.sin(turn)
    return np.stack((z * math.sin(turn) + x * math.cos(turn), away * math.sin(tilt) - y * math.cos(tilt)), -1)


def _draw_camera(ax: Axes, size: float) -> None:
    """A frustum at the origin, and its axis."""
    sides = [(-0.6, -0.45, 1), (0.6, -0.45, 1), (0.6, 0.45, 1), (-0.6, 0.45, 1)]
    centre, *around, ahead = _oblique(size * np.array([(0, 0, 0), *sides, (0, 0, 2.2)]))
    for corner, following in zip(around, np.roll(around, -1, 0), strict=True):
        ax.plot(*np.stack((centre, corner, following)).T, color=INK, linewidth=1.2, zorder=5)
    ax.plot(*np.stack((centre, ahead)).T, color=GREY, linewidth=0.9, linestyle="--", zorder=4)


def _ruler(ax: Axes, size: float) -> None:
    """A length, for the boards' unit is the user's."""
    from matplotlib.ticker import MaxNLocator

    length = MaxNLocator(2, steps=[1, 2, 5, 10]).tick_values(0, 0.3 * size)[1]
    (left, low), (_, high) = ax.dataLim.min, ax.dataLim.max
    low -= 0.06 * (high - low)
    ax.plot([left, left + length], [low, low], color=GREY, linewidth=1.6, solid_capstyle="butt")
    middle = left + length / 2, low
    ax.annotate(f"{length:.3g}", middle, (0, -3), textcoords="offset points", color=GREY, ha="center", va="top")
