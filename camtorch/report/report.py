"""The report of a calibration, of a rig's too: one HTML file that needs nothing else, `write_report`.

What the page says and how it looks is in the template `report.html` beside this file; here are its numbers and figures.
"""

from __future__ import annotations

import base64
import io
import math
import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence, Sized
from importlib import resources
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import torch

import camtorch.plot as plot
from camtorch._arguments import check_path
from camtorch._photographs import as_jpeg
from camtorch.calibration.calibrate import Calibration
from camtorch.calibration.rig import RigCalibration
from camtorch.calibration.verdict import ROUGH, Survey
from camtorch.io.writing import replacing
from camtorch.plot.axes import printable, require_matplotlib
from camtorch.plot.calibrations import sightings
from camtorch.projection.rays import image_lattice

if TYPE_CHECKING:
    Images: TypeAlias = Sequence[Any] | None
    Names: TypeAlias = Sequence[str] | None

_WORST = 6  # views that are shown
_PAIRS = 8  # cameras, between which all distances are listed
_WIDTH = 5.6  # inches, of a figure
_STYLE: dict[Any, Any] = {
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.size": 9.0,
    "svg.fonttype": "none",  # the browser has fonts for names in all scripts
}
_SIDE, _QUALITY = 760, 80  # px of the longer side of a photograph, and of its JPEG file


@torch.no_grad()
def write_report(
    calibration: Calibration | RigCalibration,
    path: str | os.PathLike[str],
    *,
    images: Images | Mapping[str, Images] = None,
    names: Names | Mapping[str, Names] = None,
    title: str | None = None,
) -> None:
    """Write what a calibration found, and how far it can be trusted, as one HTML file to look at and to print.

    The file needs no other and no network. It says first in words what the calibration is good for.

    Args:
        calibration: of a camera, or of a rig.
        path: the file; an existing one is replaced as a whole.
        images: of all views that were passed: paths, Pillow images, arrays (H, W) or (H, W, C), tensors (C, H, W), or
            None. The views with the largest residuals show theirs. Of a rig, a mapping from the cameras' names.
        names: of all views; by default the names of the image files, or numbers from 0. Of a rig, those of all cameras,
            or a mapping.
        title: by default the size of the image, or the number of cameras.

    Raises:
        ImportError: no matplotlib or no Jinja2 (`pip install 'camtorch[plot]'`). ValueError: not as many images or
            names as views, an image of another size than the camera's, a name that no camera has. TypeError: images or
            names that are no list, images of a rig that are no mapping. OSError: the file cannot be written, an image
            file is not there.
    """
    if not isinstance(calibration, (Calibration, RigCalibration)):
        raise TypeError(f"write_report: calibration must be what calibrate returns; got {type(calibration).__name__}")
    check_path(path, "write_report")
    require_packages()
    if isinstance(calibration, RigCalibration):
        shots = _rig_shots(calibration, images, names)
        found, rig = f"Rig of {len(shots)} cameras", _rig(calibration, shots)
    else:
        shots, rig = [_Shots(calibration, images, names)], None
        height, width = calibration.image_size
        found = f"A camera of {width} x {height} pixels"
    import jinja2

    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True).from_string(
        resources.files("camtorch.report").joinpath("report.html").read_text("utf-8")
    )
    today = time.strftime("%d %B %Y").lstrip("0")
    cameras = [_camera(one) for one in shots]
    text = template.render(title=printable(str(title or found)), today=today, rig=rig, cameras=cameras)
    with replacing(path) as (file,):
        file.write(text.encode())


def require_packages() -> None:
    """Raise an ImportError that says how to install what reports are made with, unless it is there."""
    require_matplotlib()
    try:
        import jinja2  # noqa: F401
    except ImportError:
        raise ImportError("reports need Jinja2: pip install 'camtorch[plot]'") from None


def _rig_shots(calibration: RigCalibration, images: Any, names: Any) -> list[_Shots]:
    if images is not None and not isinstance(images, Mapping):
        raise TypeError(
            f"write_report: images of a rig are a mapping from the names of its cameras; got {type(images).__name__}"
        )
    for what, given in (("images", images), ("names", names)):
        stray = [name for name in given if name not in calibration.cameras] if isinstance(given, Mapping) else []
        if stray:
            there = ", ".join(map(repr, calibration.cameras))
            raise ValueError(f"write_report: {what} of {', '.join(map(repr, stray))}; the rig has {there}")
    shots = []
    for i, (name, camera) in enumerate(calibration.cameras.items()):
        own = names.get(name) if isinstance(names, Mapping) else names
        shots.append(_Shots(camera, (images or {}).get(name), own, name, f"camera-{i}-"))
    return shots


class _Shots:
    """A camera's calibration, its views by name, and their photographs."""

    def __init__(self, calibration: Calibration, images: Any, names: Any, camera: str = "", prefix: str = ""):
        self.calibration, self.camera, self.prefix = calibration, printable(camera), prefix
        count = len(calibration.image_points)
        for what, given in (("images", images), ("names", names)):
            if given is not None and (not isinstance(given, Sized) or isinstance(given, (str, bytes))):
                raise TypeError(f"write_report: {what} must be a list, one for each view; got {given!r:.60}")
            if given is not None and len(given) != count:
                raise ValueError(f"write_report: {len(given)} {what} for {count} views; give one of each, or None")
        self.images: list[Any] = [None] * count if images is None else list(images)
        paths = {i: os.fsdecode(image) for i, image in enumerate(self.images) if _is_path(image)}
        for i, path in paths.items():
            if not os.path.exists(path):
                raise FileNotFoundError(f"write_report: images[{i}] is no file: {path!r}")
        usual = [os.path.basename(paths[i]) if i in paths else f"view {i}" for i in range(count)]
        self.names = [printable(str(name)) for name in (usual if names is None else names)]
        self.seen = sightings(calibration)
        self.corners, self.outliers = int(self.seen.seen.sum()), int((self.seen.seen & ~self.seen.inliers).sum())

    @property
    def tone(self) -> str:
        """Good, care or bad."""
        if not self.calibration.converged or Survey(self.calibration).good_within(ROUGH)[1] == 0:
            return "bad"
        return "care" if self.calibration.warnings else "good"


def _is_path(image: Any) -> bool:
    return isinstance(image, (str, bytes, os.PathLike))


def _tiles(calibration: Calibration | RigCalibration, note: str) -> list[tuple[str, str, str]]:
    """Numbers that the page begins with: label, value and note."""
    return [
        ("Reprojection rms", f"{calibration.rms:.3g} px", note),
        ("Noise (sigma)", f"{calibration.sigma:.3g} px", "of a coordinate of a corner"),
    ]


def _views_tile(count: int, corners: int, outliers: int) -> tuple[str, str, str]:
    return "Views", f"{count}", f"{corners:,} corners, {outliers:,} outlier{'s' * (outliers != 1)}"


def _camera(shots: _Shots) -> dict[str, Any]:
    """What the template shows of a camera."""
    calibration, seen = shots.calibration, shots.seen
    camera, (height, width) = calibration.camera, calibration.image_size
    count = len(camera.distortion_names)
    over_image, beside = min(1.6, 0.88 * height / width), 0.66  # ratios of height to width

    def figure(draw: Callable[..., Any], ratio: float, **options: Any) -> _Figure:
        return _drawn(lambda ax: draw(calibration, ax, **options), ratio)

    distances = np.sqrt((seen.points**2).sum(-1))
    distances = distances[np.isfinite(distances)]
    uncertainty = [figure(plot.uncertainty, over_image)]
    if len(distances) and (near := float(np.median(distances))) > 0:
        uncertainty.append(figure(plot.uncertainty, over_image, distance=near))
    squares = np.nan_to_num(seen.lengths**2).sum(-1) / np.maximum(seen.seen.sum(-1), 1)
    ranked: list[int] = np.argsort(-squares, kind="stable").tolist()
    most = float(np.nan_to_num(seen.rms).max(initial=0.0)) or 1.0
    intrinsics, distortion = camera.intrinsics.tolist(), camera.distortion.tolist()
    numbers = [str(intrinsics), *[str(distortion)] * (count > 0), f"image_size={calibration.image_size}"]
    code = ",\n    ".join(numbers)
    values = zip(calibration.parameter_names, intrinsics + distortion, calibration.std.tolist(), strict=True)
    parameters = [(name, _rounded(value, std), f"{std:.2g}" if std > 0 else "held") for name, value, std in values]
    if any(calibration.bend):
        parameters.append(("bend along x, y", "{:.3g}, {:.3g}".format(*calibration.bend), ""))
    wide, tall, _ = camera.fov.numpy(force=True)
    sigmas = calibration.uncertainty(image_lattice(camera, 25, 33).double())
    median = f"{float(sigmas.nanmedian()):.2g}".replace("nan", "-")
    clean = np.sqrt((seen.lengths[seen.used] ** 2).mean()) if shots.corners > shots.outliers else math.nan
    reach = f"{math.degrees(seen.reach):.1f}°"
    return {
        "name": shots.camera,
        "prefix": shots.prefix,
        "about": f"{type(camera).__name__}{f' with {count} coefficient' + 's' * (count != 1) if count else ''}"
        f" · {width} x {height} px",
        "tone": shots.tone,
        "verdict": calibration.verdict,
        "warnings": calibration.warnings,
        "tiles": [
            *_tiles(calibration, f"{clean:.3g} without outliers" if shots.outliers else "per corner"),
            ("Uncertainty", f"{median} px", "median over the image, at infinity"),
            _views_tile(len(seen.numbers), shots.corners, shots.outliers),
            ("Corners reach", reach, "from the axis, but for one in 200"),
            ("Field of view", f"{wide:.0f} x {tall:.0f}°", "of the image, across and down"),
        ],
        "reach": reach,
        "coverage": figure(plot.coverage, over_image),
        "radius": figure(plot.calibrated_radius, beside),
        "residuals": figure(plot.residuals, over_image),
        "histogram": figure(plot.residual_histogram, beside),
        "uncertainty": uncertainty,
        "boards": figure(plot.boards, beside),
        "views": [
            {
                "name": shots.names[seen.numbers[row]],
                "id": f"{shots.prefix}view-{seen.numbers[row]}" if place < _WORST else "",
                "percent": f"{100 * np.nan_to_num(seen.rms[row]) / most:.1f}",
                "rms": f"{seen.rms[row]:.3g}",
                "corners": int(seen.seen[row].sum()),
                "outliers": int((seen.seen[row] & ~seen.inliers[row]).sum()),
            }
            for place, row in enumerate(ranked)
        ],
        "worst": [_photograph(shots, seen.numbers[row]) for row in ranked[:_WORST]],
        "parameters": parameters,
        "code": f"import camtorch as ct\n\ncamera = ct.{type(camera).__name__}(\n    {code},\n)",
    }


def _photograph(shots: _Shots, number: int) -> dict[str, str]:
    """A view's photograph, if there is one, and the marks to lay over it."""
    height, width = shots.calibration.image_size

    def draw(ax: Any) -> None:
        plot.view(shots.calibration, number, ax)
        ax.set_xlim(-0.5, width - 0.5)
        ax.set_ylim(height - 0.5, -0.5)
        ax.lines[0].remove()  # the frame, which is the edge of the image here

    marks = _drawn(draw, height / width, bare=True)
    image, name, note = "", shots.names[number], marks.title.split(", ", 1)[1]
    if shots.images[number] is not None:
        try:
            image = _as_url(
                "image/jpeg", as_jpeg(shots.images[number], (height, width), name, "write_report", _SIDE, _QUALITY)
            )
        except OSError as error:
            note += f"; no photograph: {error.strerror or error}"
    return {"id": f"{shots.prefix}view-{number}", "name": name, "note": note, "image": image, "marks": marks.url}


def _rig(calibration: RigCalibration, cameras: Sequence[_Shots]) -> dict[str, Any]:
    """What the template shows of a rig as a whole."""
    tones = [shots.tone for shots in cameras] + ["good" if calibration.converged else "bad"]
    poses = calibration.rig.extrinsics
    positions = {name: pose.position.tolist() for name, pose in poses.items()}
    size = max(math.hypot(*position) for position in positions.values())
    mounts, between = [], []
    for name, pose in poses.items():
        std = calibration.mount_std[name].tolist()
        cells = [_rounded(value, size / 100) for value in positions[name]]
        for value, spread in (
            (float(pose.translation.norm()), math.hypot(*std[3:])),
            (math.degrees(float(pose.rotation.norm())), math.degrees(math.hypot(*std[:3]))),
        ):
            cells += [_rounded(value, spread), f"{spread:.2g}"]
        mounts.append((printable(name), cells))
        apart = [None if other is pose else other.compose(pose.inverse()) for other in poses.values()]
        lengths = [p and (f"{p.translation.norm():.4g}", f"{p.rotation.norm().rad2deg():.3g}°") for p in apart]
        between.append((printable(name), lengths))
    return {
        "tone": min(tones, key=("bad", "care", "good").index),
        # of each camera's verdict the first sentence; all of it is in the camera's own part
        "verdicts": [
            (shots.camera, shots.calibration.verdict.partition(". ")[0].removesuffix(".") + ".") for shots in cameras
        ],
        "tiles": [
            *_tiles(calibration, "per corner, all cameras"),
            ("Cameras", f"{len(cameras)}", "that see the same boards"),
            _views_tile(len(calibration.views), sum(s.corners for s in cameras), sum(s.outliers for s in cameras)),
        ],
        "figure": _drawn(lambda ax: plot.rig(calibration.rig, ax), 0.72),
        "mounts": mounts,
        "between": between if 2 < len(poses) <= _PAIRS else [],
    }


def _rounded(value: float, std: float) -> str:
    """To the second digit of its standard deviation."""
    if not (std > 0 and math.isfinite(std)):
        return f"{value:.6g}"
    digits = max(0, min(12, 1 - math.floor(math.log10(std))))
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "\N{MINUS SIGN}")


# -- figures and photographs


class _Figure(NamedTuple):
    """The title of a plot, which is not drawn, and the plot as SVG in the address of an image."""

    title: str
    url: str


def _drawn(draw: Callable[[Any], object], ratio: float, *, bare: bool = False) -> _Figure:
    """A plot on Axes of a ratio of height to width, which are all of the figure, without labels, if it is bare."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # the browser has other fonts
        figure = Figure(figsize=(_WIDTH, _WIDTH * ratio), layout=None if bare else "constrained")
        ax = figure.add_axes((0, 0, 1, 1)) if bare else figure.add_subplot()
        draw(ax)
        title = ax.get_title()
        ax.set_title("")
        if bare:
            ax.set_axis_off()
        file = io.BytesIO()
        figure.savefig(file, format="svg", transparent=bare)
    return _Figure(title[:1].upper() + title[1:], _as_url("image/svg+xml", file.getvalue()))


def _as_url(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
