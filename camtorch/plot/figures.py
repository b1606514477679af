"""Plots of cameras, of the difference of two, of rigs, and of calibrations with their uncertainty."""

import math
from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.analysis import numbers
from camtorch.calibration.rig import RigCalibration
from camtorch.calibration.verdict import Calibration
from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.poses.rotations import rotation_matrix, rotation_vector
from camtorch.rays.lattices import angles_from_axis, followed, ideal, image_lattice
from camtorch.values.arguments import imported

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:  # matplotlib is optional and slow: runtime type hints must not import it
    Axes = Figure = Any

INK, GREY, PALE = "#2b2a2e", "#8a8378", "#efe9dd"
COLOURS = ("#1e64f0", "#e21d48", "#0b8a5f", "#b86e00", "#7a3fc2", "#5a6472")  # of cameras; the second also for marks
NO_RAYS = "#d9d4ca"  # for pixels without a value
_AZIMUTHS, _ANGLES = 32, 721
_ARROWS = 15_000  # the most that an image has room for
_LATTICE = 96  # of the map of uncertainty, along the longer side
_BANDS = 8  # of that map
_NOTHING = 1e-6  # px: less is rounding, and shown as none
_FAINT = 1e-3  # px: smallest range of colours


@torch.no_grad()
def distortion_field(camera: Camera, ax: Axes | None = None, *, count: int = 21) -> Axes:
    """Draw arrows from the pixels of an ideal lens to the actual pixels; grey: pixels without rays.

    The ideal lens has the same intrinsics and coefficients without effect: Kannala-Brandt's is equidistant,
    Brown-Conrady's perspective. Short arrows are drawn longer, by a factor in the title.

    Args:
        camera: A single camera with an image size.
        ax: Axes; default new ones.
        count: Number of arrows along the longer side.

    Raises:
        ValueError: If the camera is a batch, or has no image size.
    """
    height, width = size_of(camera)
    ax = axes_or_new(ax)
    step = max(width, height) / count
    inner = image_lattice(camera, max(2, round(height / step)) + 1, max(2, round(width / step)) + 1)
    pixels = (inner[1:, 1:] + inner[:-1, :-1]) / 2
    rays, valid = camera.unproject(pixels)
    undistorted, covered = ideal(camera).project(rays)
    edges = draw_frame(ax, height, width)
    dark = camera.unproject(image_lattice(camera, 200, 200))[1].numpy(force=True)
    shade = np.ma.masked_array(np.ones((200, 200)), dark)
    ax.imshow(shade, extent=edges, cmap="Greys", vmin=0, vmax=5, interpolation="nearest", zorder=0)
    cx, cy = camera.intrinsics[2:].tolist()
    ax.plot([cx], [cy], "+", color=COLOURS[1], markersize=11, markeredgewidth=1.6, zorder=4)
    both, title = valid & covered, "no distortion"
    end, along = pixels[both].double(), (pixels - undistorted)[both].double()
    length = torch.linalg.vector_norm(along, dim=-1)
    if len(length) and float(length.max()) > _NOTHING:
        longer = magnification(0.7 * step / max(float(length.quantile(0.9)), _NOTHING))
        planes = [plane.numpy(force=True) for plane in (*(end - longer * along).T, *(longer * along).T, length)]
        _bar(ax, draw_arrows(ax, *planes, headwidth=4, headlength=5, zorder=3), length)
        times = f", {longer} times as long" if longer > 1 else ""
        title = f"distortion, from the ideal pixel to the actual one{times}"
    ax.set_title(title if bool(both.any()) else "no ray in common with the ideal lens")
    return ax


@torch.no_grad()
def radius_curve(cameras: Camera | Sequence[Camera], ax: Axes | None = None, *, labels: Sequence[str] = ()) -> Axes:
    """Draw the distance from the principal point over the angle from the axis, up to a dot at the last valid angle.

    A band shows the range if azimuths differ. The ideal lens is dashed. The angles of the first image are pale.

    Args:
        cameras: Single cameras.
        ax: Axes; default new ones.
        labels: Labels of the cameras; default their models.

    Raises:
        ValueError: If a camera is a batch, or the numbers of labels and cameras differ.
    """
    cameras = cameras if isinstance(cameras, Sequence) else [cameras]
    labels = labels or [camera.key for camera in cameras]
    if len(labels) != len(cameras):
        raise ValueError(f"plot: labels must be as many as cameras, {len(cameras)}; got {len(labels)}")
    ax = axes_or_new(ax)
    shown = seen = 0.0
    for i, (camera, label, colour) in enumerate(zip(cameras, labels, cycle(COLOURS), strict=False)):
        check_single(camera)
        angles, low, high = _radii(camera)
        ax.fill_between(np.degrees(angles), low, high, color=colour, alpha=0.25, linewidth=0, zorder=2)
        middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
        wide = 3.2 if i == 0 < len(cameras) - 1 else 1.5  # later curves are thinner, to leave the first visible
        ax.plot(np.degrees(angles), middle, color=colour, label=label, linewidth=wide)
        ax.plot(np.degrees(angles[-1:]), middle[-1:], "o", color=colour, markersize=5, zorder=3)
        if i == 0 and camera.distortion_names:
            angles, low, _ = _radii(ideal(camera))
            ax.plot(np.degrees(angles), low, "--", color=GREY, linewidth=1, label="ideal", zorder=1)
        if camera.image_size is not None:
            pixels = image_lattice(camera, 65, 65)
            rays, valid = camera.unproject(pixels)
            far = float(angles_from_axis(rays)[valid].max()) if bool(valid.any()) else 0.0
            seen = max(seen, math.degrees(far))
            if i == 0:
                ax.axvspan(0, seen, color=PALE, zorder=0)
            shown = max(shown, float(torch.linalg.vector_norm(pixels - camera.intrinsics[2:], dim=-1).max()))
    ax.set_xlim(0, 1.15 * seen or None)
    ax.set_ylim(0, 1.15 * shown or None)  # limits for tangents, which grow without end
    ax.set(xlabel="angle from the axis, degrees", ylabel="distance from the principal point, px")
    ax.set_title("radius over angle, as far as valid")
    ax.legend(frameon=False, loc="lower right")
    return ax


@torch.no_grad()
def difference(a: Camera, b: Camera, ax: Axes | None = None, *, remove_rotation: bool = False) -> Axes:
    """Draw the distance in pixels of the same ray in two cameras, over the image of the first; grey: one has no ray.

    Args:
        a: Camera whose image is shown.
        b: The other camera, with the same image size or none.
        ax: Axes; default new ones.
        remove_rotation: Whether to rotate rays to the other camera's first: calibrations may differ by that.

    Raises:
        ValueError: If a camera is a batch, or image sizes are missing or differ.
    """
    compared = numbers.difference(a, b, remove_rotation=remove_rotation)
    height, width = a.size_for("a difference")
    ax = axes_or_new(ax)
    values = np.ma.masked_array(compared.apart.numpy(force=True), ~compared.both.numpy(force=True))
    ax.set_facecolor(NO_RAYS)
    image = ax.imshow(values, extent=draw_frame(ax, height, width), cmap="magma_r", interpolation="nearest")
    _bar(ax, image, compared.apart[compared.both])
    degrees = math.degrees(rotation_vector(compared.rotation).norm())
    turned = f", turned by {degrees:.3g} degrees" if remove_rotation else ""
    ax.set_title(f"{a.key} and {b.key}: {compared}{turned}")
    return ax


@torch.no_grad()
def rig(rig: Rig, ax: Axes | None = None) -> Axes:
    """Draw the positions of the cameras of a rig from above, with wedges for the horizontal fields of view.

    The frame is the rig's, z to the top; cameras above each other are drawn from the right, with vertical fields.

    Args:
        rig: Rig of single cameras; cameras with a pose are shown.
        ax: Axes; default new ones.

    Raises:
        ValueError: If no camera has a pose.
    """
    ax = axes_or_new(ax)
    if not (names := [name for name in rig.cameras if name in rig.extrinsics]):
        raise ValueError(f"plot: rig must have extrinsics; got {list(rig.cameras)} without")
    places = torch.stack([rig.extrinsics[name].position for name in names]).double().numpy(force=True)
    spread = np.ptp(places, axis=0)
    above = spread[1] <= max(spread[0], spread[2])
    across, up = (0, 2) if above else (2, 1)
    size = float(spread.max()) or 1.0
    for name, place, colour in zip(names, places, cycle(COLOURS), strict=False):
        camera = rig.cameras[name]
        wide, tall = (1.0, 1.0) if camera.image_size is None else camera.field_of_view[:2].tolist()
        half = min(math.pi, (wide if above else tall) / 2)
        turns = np.linspace(-half, half, 49)
        around, ahead = np.sin(turns), np.cos(turns)
        arc = np.stack((around, 0 * turns, ahead) if above else (0 * turns, around, ahead), -1)
        turned = arc @ rotation_matrix(rig.extrinsics[name].rotation).double().numpy(force=True)
        wedge = place + 0.45 * size * np.concatenate((0 * arc[:1], turned, 0 * arc[:1]))
        ax.fill(wedge[:, across], wedge[:, up], color=colour, alpha=0.16, linewidth=0, zorder=1)
        ax.plot(wedge[:, across], wedge[:, up], color=colour, linewidth=0.9, zorder=2)
        ax.plot(place[across], place[up], "o", color=colour, markersize=6, zorder=3)
        options: Any = {"textcoords": "offset points", "color": INK, "ha": "center", "va": "top"}
        ax.annotate(printable(name), place[[across, up]], (0, -7), **options).set_parse_math(False)
    ax.set_aspect("equal")
    ax.margins(0.15)
    if not above:
        ax.invert_yaxis()
    title = f"{len(names)} cameras from {'above' if above else 'the right'}"
    ax.set(xlabel="xyz"[across], ylabel="xyz"[up], title=title)
    return ax


@torch.no_grad()
def calibration(calibration: Calibration | RigCalibration) -> Figure:
    """Draw the residuals over the image, and the uncertainty of projections; for a rig a row for each camera.

    Residuals are arrows from the corner seen to the camera's pixel of it, longer by a factor in the title; crosses are
    outliers. The map is `calibration.uncertainty` at infinity; dots are corners, and grey pixels have no rays.

    Args:
        calibration: Result of `ct.calibrate` or `ct.calibrate_rig`.
    """
    require_matplotlib()
    from matplotlib import pyplot

    cameras = getattr(calibration, "cameras", None) or {"": calibration}
    size = 12.4, 5.2 * len(cameras)
    figure, axes = pyplot.subplots(len(cameras), 2, squeeze=False, figsize=size, layout="constrained")
    for (name, camera), (left, right) in zip(cameras.items(), axes, strict=True):
        seen = camera.observations.seen & camera.point_residuals.isfinite().all(-1)
        inliers = (seen & camera.point_inliers).numpy(force=True)
        pixels, errors = (t.double().numpy(force=True) for t in (camera.observations.pixels, camera.point_residuals))
        head = f"{printable(name)}: " if name else ""
        _draw_residuals(left, camera, pixels[inliers], errors[inliers], head)
        if len(outliers := pixels[seen.numpy(force=True) & ~inliers]):
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
    # an even choice of all lengths; the longest are drawn last, above the others
    some = np.argsort(lengths, kind="stable")[np.linspace(0, len(lengths) - 1, min(len(lengths), _ARROWS)).astype(int)]
    usual = float(np.quantile(lengths, 0.98)) if len(lengths) else 0.0
    longer = magnification(0.05 * max(height, width) / max(usual, 1e-9))
    planes = *pixels[some].T, *errors[some].T * longer, lengths[some]
    arrows = draw_arrows(ax, *planes, clim=(0, usual or 1.0))
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
    ax.set_title(f"{head}sigma of a projection at infinity, median {np.nanmedian(values.filled(np.nan)):.2g} px")
    if values.count():
        low, high = np.quantile(values.compressed(), (0.01, 0.97)).clip(1e-6)
        ladder = (float(f"{digit}e{power}") for power in range(-7, 9) for digit in (1, 2, 5))
        bounds = [bound for bound in ladder if low / 2.5 < bound < high * 2.5][: _BANDS + 1]
        u, v = pixels[0, :, 0].numpy(force=True), pixels[:, 0, 1].numpy(force=True)
        bands = ax.contourf(u, v, np.ma.maximum(values, bounds[0]), bounds, cmap="magma_r", extend="max", zorder=1)
        ax.figure.colorbar(bands, ax=ax, label="px", format="%g", shrink=0.8, pad=0.02)


def portrait(camera: Camera, other: Camera | None = None, *, title: str = "") -> Figure:
    """Draw distortion field, radius curve and the difference to another camera, as `camtorch show -o` does."""
    require_matplotlib()
    from matplotlib.figure import Figure

    height, width = size_of(camera)
    panels = 2 if other is None else 3
    panel = min(6.0, max(3.2, 6.2 * height / width))
    figure = Figure(figsize=(7.4 * panels, panel + 1.3), dpi=120, layout="constrained")
    axes = figure.subplots(1, panels)
    distortion_field(camera, axes[0])
    labels = [camera.key] if other is None else [camera.key, f"{other.key}, the other"]
    radius_curve([camera] if other is None else [camera, other], axes[1], labels=labels)
    if other is not None:
        difference(camera, other, axes[2])
    title = title or f"{type_before_parametrizations(camera).__name__}, {width} x {height}"
    figure.suptitle(title, color=INK, fontsize=15)
    return figure


def _bar(ax: Axes, mappable: Any, values: Tensor) -> None:
    """Add a colour bar for the range of values, without the few largest if they are far from the others."""
    most, many = (float(values.max()), float(values.quantile(0.98))) if values.numel() else (0.0, 0.0)
    cut = most > 4 * many > _FAINT
    mappable.set_clim(0, 1.5 * many if cut else max(most, _NOTHING))
    ax.figure.colorbar(mappable, ax=ax, label="px", shrink=0.8, pad=0.02, extend="max" if cut else "neither")


def _radii(camera: Camera) -> tuple[np.ndarray, list[float], list[float]]:
    """Return angles, and the least and the greatest radius over the azimuths that are valid up to there."""
    angles = torch.linspace(0, math.pi, _ANGLES).to(camera.intrinsics)
    pixels, valid = followed(camera, angles, _AZIMUTHS)
    radius = torch.linalg.vector_norm(pixels - camera.intrinsics[2:], dim=-1)
    some = valid.any(-1)
    low, high = (torch.where(valid, radius, end) for end in (torch.inf, -torch.inf))
    return angles[some].numpy(force=True), low.amin(-1)[some].tolist(), high.amax(-1)[some].tolist()


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
    return camera.size_for("a plot")


def draw_frame(ax: Axes, height: int, width: int) -> tuple[float, float, float, float]:
    """Draw the outer edges of an image, rows downwards, and return them as an `extent` for `imshow`."""
    margin = 0.02 * max(height, width)
    ax.set_xlim(-0.5 - margin, width - 0.5 + margin)
    ax.set_ylim(height - 0.5 + margin, -0.5 - margin)
    ax.set_aspect("equal")
    ax.spines[:].set_visible(False)
    ax.plot([-0.5, width - 0.5, width - 0.5, -0.5, -0.5], [-0.5, -0.5, height - 0.5, height - 0.5, -0.5], color=INK)
    return -0.5, width - 0.5, height - 0.5, -0.5


def draw_arrows(ax: Axes, *planes: np.ndarray, **options: Any) -> Any:
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
