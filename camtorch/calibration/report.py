"""The report of a calibration, of a rig's too: one HTML file that needs nothing else, `write_report`."""

from __future__ import annotations

import base64
import html
import io
import math
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence, Sized
from importlib import resources
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

import camtorch.plot as plot
from camtorch._arguments import check_path
from camtorch._photographs import load_stored, stored_size
from camtorch.calibration.calibrate import Calibration
from camtorch.calibration.rig import RigCalibration
from camtorch.calibration.svg import Plots, palette
from camtorch.calibration.verdict import ROUGH, Survey
from camtorch.io.writing import replacing
from camtorch.plot.calibrations import Sightings, sightings
from camtorch.projection.rays import image_lattice

if TYPE_CHECKING:
    from PIL import Image

    Images: TypeAlias = Sequence[Any] | None
    Names: TypeAlias = Sequence[str] | None

_WORST = 6  # views that are shown
_ROWS = 24  # of the table of views, before it has to be opened
_PHOTOGRAPH = 760  # px, of the longer side
_QUALITY = 80
_PAIRS = 8  # cameras, between which all distances are listed
_BINS = 27  # of the small histograms
_TONES = {
    "good": ("Can be used", "M5 13l4.5 4.5L19.5 7"),
    "care": ("To be used with care", "M12 4.5v9.5M12 19v.5"),
    "bad": ("Not to be used", "M6 6l12 12M18 6L6 18"),
}
_SENTENCE = re.compile(r"(?<=\.)\s(?=[A-Z])")
_NEXT = re.compile(r"\s(?=Next\b|More views\b)")  # of a verdict: where it says what to do, which has a line of its own
_INTRINSICS = {
    "fx": "focal length across, px",
    "fy": "focal length down, px",
    "cx": "principal point across, px",
    "cy": "principal point down, px",
}


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
        ImportError: no matplotlib (`pip install 'camtorch[plot]'`). ValueError: not as many images or names as views,
            an image of another size than the camera's, a name that no camera has. TypeError: images of a rig that are
            no mapping. OSError: the file cannot be written.
    """
    if not isinstance(calibration, (Calibration, RigCalibration)):
        raise TypeError(f"write_report: calibration must be what calibrate returns; got {type(calibration).__name__}")
    check_path(path, "write_report")
    page = _Page()
    if isinstance(calibration, RigCalibration):
        cameras = _rig_shots(calibration, images, names)
        parts = [page.rig_opening(calibration, cameras), page.rig(calibration)]
        for name, shots in cameras.items():
            head = f'<div class="camera" id="{shots.prefix}">\n<h2>{_label(name)}</h2>\n'
            parts += [head + page.opening(shots), *page.sections(shots), "</div>"]
        found = f"Rig of {len(cameras)} cameras"
    else:
        one = _Shots(calibration, images, names)
        parts = [page.opening(one), *page.sections(one)]
        height, width = calibration.image_size
        found = f"A camera of {width} x {height} pixels"
    text = page.document(title or found, [*parts, _footer()])
    with replacing(path) as (file,):
        file.write(text.encode())


def _rig_shots(calibration: RigCalibration, images: Any, names: Any) -> dict[str, _Shots]:
    if images is not None and not isinstance(images, Mapping):
        raise TypeError(
            f"write_report: images of a rig are a mapping from the names of its cameras; got {type(images).__name__}"
        )
    for what, given in (("images", images), ("names", names)):
        stray = [name for name in given if name not in calibration.cameras] if isinstance(given, Mapping) else []
        if stray:
            there = ", ".join(map(repr, calibration.cameras))
            raise ValueError(f"write_report: {what} of {', '.join(map(repr, stray))}; the rig has {there}")
    return {
        name: _Shots(
            camera,
            None if images is None else images.get(name),
            names.get(name) if isinstance(names, Mapping) else names,
            f"camera-{i}-",
        )
        for i, (name, camera) in enumerate(calibration.cameras.items())
    }


class _Shots:
    """A camera's calibration, its views by name, and their photographs."""

    def __init__(self, calibration: Calibration, images: Any, names: Any, prefix: str = ""):
        self.calibration, self.prefix = calibration, prefix
        count = len(calibration.image_points)
        for what, given in (("images", images), ("names", names)):
            if given is not None and not isinstance(given, Sized):
                raise TypeError(f"write_report: {what} must be a list, one for each view; got {type(given).__name__}")
            if given is not None and len(given) != count:
                raise ValueError(f"write_report: {len(given)} {what} for {count} views; give one of each, or None")
        self.images: list[Any] = [None] * count if images is None else list(images)
        self.names = [_name(i, image) for i, image in enumerate(self.images)] if names is None else list(names)
        self.seen: Sightings = sightings(calibration)

    @property
    def tone(self) -> str:
        """Good, care or bad."""
        if not self.calibration.converged or Survey(self.calibration).good_within(ROUGH)[1] == 0:
            return "bad"
        return "care" if self.calibration.warnings else "good"


def _name(number: int, image: Any) -> str:
    return os.path.basename(os.fsdecode(image)) if isinstance(image, (str, bytes, os.PathLike)) else f"view {number}"


class _Page:
    """Parts of a report, as HTML."""

    def __init__(self) -> None:
        self._plots = Plots()

    def document(self, title: str, parts: Sequence[str]) -> str:
        """The file's text."""
        style = resources.files("camtorch.calibration").joinpath("report.css").read_text("utf-8")
        light, dark = ("".join(f"{name}:{pair[i]};" for name, *pair in palette()) for i in range(2))
        # print is on white, whatever the screen is
        colours = f":root{{{light}}}@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}"
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
            "style-src 'unsafe-inline'\">\n"
            f"<title>{_text(title)}</title>\n<style>\n{style}{colours}\n</style>\n</head>\n<body>\n<main>\n"
            f'<p class="kicker">Camera calibration</p>\n<h1>{_text(title)}</h1>\n' + "\n".join(parts) + "\n</main>\n"
            "</body>\n</html>\n"
        )

    def opening(self, shots: _Shots) -> str:
        """Verdict, key numbers, and links to what follows."""
        sections = {
            "coverage": "Coverage",
            "residuals": "Residuals",
            "worst": "Worst views",
            "uncertainty": "Uncertainty",
            "parameters": "Parameters and boards",
        }
        lines = [_text(line) for line in _NEXT.split(shots.calibration.verdict)]
        return (
            f'<p class="about">{_about(shots)}</p>\n{_verdict(shots.tone, lines)}\n{_tiles(_numbers(shots))}\n'
            f"{_warnings(shots.calibration.warnings)}"
            f"{_links({shots.prefix + key: label for key, label in sections.items()})}"
        )

    def rig_opening(self, calibration: RigCalibration, cameras: Mapping[str, _Shots]) -> str:
        """The same of a rig."""
        tones = [shots.tone for shots in cameras.values()]
        tone = next((tone for tone in ("bad", "care") if tone in tones), "good") if calibration.converged else "bad"
        lines = [
            f"<b>{_label(name)}</b>: {_text(_SENTENCE.split(shots.calibration.verdict)[0])}"
            for name, shots in cameras.items()
        ]
        links = {"rig": "Rig"} | {shots.prefix: name for name, shots in cameras.items()}
        corners = sum(int(shots.seen.seen.sum()) for shots in cameras.values())
        out = sum(int((shots.seen.seen & ~shots.seen.inliers).sum()) for shots in cameras.values())
        rows = [
            ("Reprojection rms", f"{calibration.rms:.3g}", "px", "per corner, all cameras"),
            ("Noise (sigma)", f"{calibration.sigma:.3g}", "px", "of a coordinate of a corner"),
            ("Cameras", f"{len(cameras)}", "", "that see the same boards"),
            ("Views", f"{len(calibration.views)}", "", f"{corners:,} corners, {out:,} outlier{'s' * (out != 1)}"),
        ]
        about = f'<p class="about">{_text(_today())}</p>'
        return f"{about}\n{_verdict(tone, lines)}\n{_tiles(rows)}\n{_links(links)}"

    def rig(self, calibration: RigCalibration) -> str:
        """Where the cameras are."""
        svg, title = self._plots.draw(lambda ax: plot.rig(calibration.rig, ax), ratio=0.72)
        figure = _figure_of(svg, title, "In the frame of the first camera; the wedges are what the images show.")
        first = next(iter(calibration.cameras))
        places = {name: pose.position.tolist() for name, pose in calibration.rig.extrinsics.items()}
        size = max(math.hypot(*place) for place in places.values())
        digits = max(0, min(12, 4 - math.ceil(math.log10(size)))) if size > 0 else 0
        rows = []
        for name, extrinsics in calibration.rig.extrinsics.items():
            std = calibration.mount_std[name].tolist()
            cells = [f"{value + 0.0:.{digits}f}".replace("-", "&minus;") for value in places[name]]
            for value, spread in (
                (extrinsics.translation.norm(), math.hypot(*std[3:])),
                (extrinsics.rotation.norm().rad2deg(), math.degrees(math.hypot(*std[:3]))),
            ):
                cells += [_rounded(float(value), spread), f"{spread:.2g}"]
            label = f'<th scope="row">{_label(name)}</th>'
            rows.append(f"<tr>{label}{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
        titles = ("camera", "x", "y", "z", "distance", "sigma", "turn, °", "sigma")
        head = f"<tr>{''.join(f'<th>{title}</th>' for title in titles)}</tr>"
        table = (
            f'<div class="card"><table class="names"><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'
        )
        lead = f"Positions and distances from {first}, in the boards' unit; the turn from its axes."
        between = _between(calibration)
        body = f'<div class="pair">{figure}<div>{between or table}</div></div>'
        if between:
            body += f'<p class="subtitle">From {_label(first)}</p>{table}'
        return f'<section id="rig">\n<h2>Rig</h2>\n<p class="lead">{_text(lead)}</p>\n{body}\n</section>'

    def sections(self, shots: _Shots) -> list[str]:
        """All sections of a camera."""
        return [
            self._coverage(shots),
            self._residuals(shots),
            self._worst(shots),
            self._uncertainty(shots),
            self._parameters(shots),
        ]

    def _figure(
        self, draw: Callable[..., Any], shots: _Shots, note: str = "", *, image: bool = True, **options: Any
    ) -> str:
        height, width = shots.calibration.image_size
        ratio = min(1.6, 0.88 * height / width) if image else 0.66
        svg, title = self._plots.draw(lambda ax: draw(shots.calibration, ax, **options), ratio=ratio)
        return _figure_of(svg, title, note)

    def _coverage(self, shots: _Shots) -> str:
        whole = self._figure(plot.coverage, shots, "The darker a cell, the more corners; crosses are outliers.")
        far = f"Corners reach {math.degrees(shots.seen.reach):.1f}° from the axis, but for one in 200."
        curve = self._figure(plot.calibrated_radius, shots, far, image=False)
        lead = "A camera is known where corners were seen. Elsewhere the model continues what it learned there."
        return _section(shots, "coverage", "Coverage", lead, f'<div class="pair">{whole}{curve}</div>')

    def _residuals(self, shots: _Shots) -> str:
        arrows = self._figure(
            plot.residuals, shots, "No direction should prevail anywhere: a pattern is what the model misses."
        )
        histogram = self._figure(
            plot.residual_histogram, shots, "Heavy ends are corners that were found badly.", image=False
        )
        lead = "What is left between the corners that were seen and those that the model shows."
        body = (
            f'<div class="pair">{arrows}{histogram}</div><p class="subtitle">Views, the worst first</p>{_views(shots)}'
        )
        return _section(shots, "residuals", "Residuals", lead, body)

    def _worst(self, shots: _Shots) -> str:
        figures = [self._photograph(shots, row) for row in _ranked(shots)[:_WORST]]
        lead = "Rings are the corners that were seen, lines lead to where the model shows them, crosses are outliers."
        return _section(shots, "worst", "Worst views", lead, f'<div class="photos">{"".join(figures)}</div>')

    def _photograph(self, shots: _Shots, row: int) -> str:
        number = shots.seen.numbers[row]
        height, width = shots.calibration.image_size

        def draw(ax: Any) -> None:
            plot.view(shots.calibration, number, ax)
            ax.set_xlim(-0.5, width - 0.5)
            ax.set_ylim(height - 0.5, -0.5)
            ax.lines[0].remove()  # the frame, which is the edge of the image here

        svg, title = self._plots.draw(draw, ratio=height / width, fill=True)
        photograph, trouble = _embedded(shots.images[number], (height, width), shots.names[number])
        note = title.split(", ", 1)[1] + (f"; {trouble}" if trouble else "")
        caption = f"<figcaption>{_label(shots.names[number])}<small>{_text(note)}</small></figcaption>"
        return f'<figure id="{shots.prefix}view-{number}"><div class="stack">{photograph}{svg}</div>{caption}</figure>'

    def _uncertainty(self, shots: _Shots) -> str:
        note = "Dashed: the outline of all corners. Were the camera calibrated again, a pixel would move by that much."
        far = self._figure(plot.uncertainty, shots, note)
        distance = _near(shots.seen)
        note = "The median distance of the boards, in their unit."
        near = self._figure(plot.uncertainty, shots, note, distance=distance) if distance > 0 else ""
        lead = "The standard deviation of where a point is seen, in the worst direction, poses included."
        return _section(shots, "uncertainty", "Uncertainty", lead, f'<div class="pair">{far}{near}</div>')

    def _parameters(self, shots: _Shots) -> str:
        note = (
            "From the camera's upper right. Boards at many angles and distances tell focal length and distance apart."
        )
        standing = self._figure(plot.boards, shots, note, image=False)
        body = f'<div class="pair"><div>{_table_of_parameters(shots)}</div>{standing}</div>'
        return _section(shots, "parameters", "Parameters and boards", "", body)


# -- parts without plots


def _text(text: object) -> str:
    """Safe within HTML, in quotes too, whatever it is: names of files come from outside."""
    plain = str(text).encode("utf-8", "replace").decode()
    return html.escape(re.sub(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", "�", plain))


def _label(name: object) -> str:
    """A name, whose direction of writing is its own."""
    return f"<bdi>{_text(name)}</bdi>"


def _section(shots: _Shots, key: str, title: str, lead: str, body: str) -> str:
    lead = f'<p class="lead">{_text(lead)}</p>\n' if lead else ""
    level = "h3" if shots.prefix else "h2"
    return f'<section id="{shots.prefix}{key}">\n<{level}>{_text(title)}</{level}>\n{lead}{body}\n</section>'


def _figure_of(svg: str, title: str, note: str = "") -> str:
    small = f"<small>{_text(note)}</small>" if note else ""
    return f"<figure><figcaption>{_text(title[:1].upper() + title[1:])}{small}</figcaption>{svg}</figure>"


def _links(targets: Mapping[str, str]) -> str:
    links = "".join(f'<a href="#{key}">{_label(label)}</a>' for key, label in targets.items())
    return f"<nav>{links}</nav>"


def _verdict(tone: str, lines: Sequence[str]) -> str:
    """A tone's word and sign, and lines of HTML."""
    word, stroke = _TONES[tone]
    return (
        f'<div class="verdict {tone}"><svg viewBox="0 0 24 24" role="img" aria-label="{word}">'
        '<circle cx="12" cy="12" r="12" style="fill:var(--tone)"/>'
        f'<path d="{stroke}" style="fill:none;stroke:var(--card);stroke-width:2.6;stroke-linecap:round"/></svg>'
        f"<div><p><strong>{word}</strong></p>{''.join(f'<p>{line}</p>' for line in lines if line.strip())}</div></div>"
    )


def _about(shots: _Shots) -> str:
    camera, (height, width) = shots.calibration.camera, shots.calibration.image_size
    count = len(camera.distortion_names)
    parts = [
        f"{type(camera).__name__} with {count} coefficient{'s' * (count != 1)}" if count else type(camera).__name__,
        f"{width} x {height} px",
        _today(),
    ]
    return _text(" · ".join(parts))


def _today() -> str:
    return time.strftime("%d %B %Y").lstrip("0")


def _numbers(shots: _Shots) -> list[tuple[str, str, str, str]]:
    """Label, value, unit and note of each."""
    calibration, seen = shots.calibration, shots.seen
    camera = calibration.camera
    corners, outliers = int(seen.seen.sum()), int((seen.seen & ~seen.inliers).sum())
    wide, tall, _ = camera.fov.numpy(force=True)
    values = calibration.uncertainty(image_lattice(camera, 25, 33).double(), math.inf).numpy(force=True)
    values = values[np.isfinite(values)]
    clean = float(np.sqrt((seen.lengths[seen.seen & seen.inliers] ** 2).mean())) if corners > outliers else math.nan
    return [
        (
            "Reprojection rms",
            f"{calibration.rms:.3g}",
            "px",
            f"{clean:.3g} without outliers" if outliers else "per corner",
        ),
        ("Noise (sigma)", f"{calibration.sigma:.3g}", "px", "of a coordinate of a corner"),
        (
            "Uncertainty",
            f"{np.median(values):.2g}" if len(values) else "&ndash;",
            "px",
            "median over the image, at infinity",
        ),
        ("Views", f"{len(seen.numbers)}", "", f"{corners:,} corners, {outliers:,} outlier{'s' * (outliers != 1)}"),
        ("Corners reach", f"{math.degrees(seen.reach):.1f}°", "", "from the axis, but for one in 200"),
        ("Field of view", f"{wide:.0f} &times; {tall:.0f}°", "", "of the image, across and down"),
    ]


def _tiles(rows: Sequence[tuple[str, str, str, str]]) -> str:
    cells = "".join(
        f"<div><dt>{label}</dt><dd><b>{value} <small>{unit}</small></b><span>{note}</span></dd></div>"
        for label, value, unit, note in rows
    )
    return f'<dl class="tiles">{cells}</dl>'


def _warnings(texts: Sequence[str]) -> str:
    if not texts:
        return ""
    return f'<ul class="warnings">{"".join(f"<li>{_text(text)}</li>" for text in texts)}</ul>\n'


def _ranked(shots: _Shots) -> list[int]:
    """Rows of the views, the worst first."""
    squares = np.nan_to_num(shots.seen.lengths**2).sum(-1) / np.maximum(shots.seen.seen.sum(-1), 1)
    order: list[int] = np.argsort(-squares, kind="stable").tolist()
    return order


def _views(shots: _Shots) -> str:
    seen, ranked, rms = shots.seen, _ranked(shots), shots.seen.rms
    is_seen, most = seen.seen, float(np.nan_to_num(rms).max(initial=0.0)) or 1.0
    reach = 4 * float(shots.calibration.sigma) or 1.0
    rows = []
    for place, row in enumerate(ranked):
        number, use = seen.numbers[row], is_seen[row]
        name = _label(shots.names[number])
        name = f'<a href="#{shots.prefix}view-{number}">{name}</a>' if place < _WORST else name
        out = int((use & ~seen.inliers[row]).sum())
        rows.append(
            f'<tr><th scope="row">{name}</th>'
            f'<td class="bar"><i style="width:{100 * np.nan_to_num(rms[row]) / most:.1f}%"></i></td>'
            f'<td>{rms[row]:.3g}</td><td class="narrow">{use.sum()}</td><td>{out or "&ndash;"}</td>'
            f'<td class="narrow">{_small_histogram(seen.errors[row][use], reach)}</td></tr>'
        )
    head = (
        '<thead><tr><th>view</th><th></th><th>rms of<br>inliers, px</th><th class="narrow">corners</th>'
        f'<th>outliers</th><th class="narrow">residuals,<br>± {reach:.2g} px</th></tr></thead>'
    )

    def table(part: Sequence[str]) -> str:
        return f'<div class="card"><table class="names">{head}<tbody>{"".join(part)}</tbody></table></div>'

    if len(rows) <= _ROWS + 6:
        return table(rows)
    rest = len(rows) - _ROWS
    return f"{table(rows[:_ROWS])}<details><summary>The other {rest} views</summary>{table(rows[_ROWS:])}</details>"


def _small_histogram(errors: np.ndarray, reach: float) -> str:
    """Of both coordinates of (N, 2) residuals."""
    counts = np.histogram(errors.clip(-reach, reach), _BINS, (-reach, reach))[0]
    heights = 20 * counts / max(counts.max(), 1)
    steps = "".join(f"M{4 * i + 0.5} 22v-{h:.1f}h3v{h:.1f}z" for i, h in enumerate(heights) if h)
    middle = f'<path d="M{2 * _BINS} 0v24" style="stroke:var(--rule);stroke-width:1"/>'
    path = f'<path d="{steps}" style="fill:var(--accent)"/>'
    return f'<svg viewBox="0 0 {4 * _BINS} 24" preserveAspectRatio="none" aria-hidden="true">{middle}{path}</svg>'


def _near(seen: Sightings) -> float:
    """The median distance of the boards."""
    distances = np.sqrt((seen.points**2).sum(-1))
    distances = distances[np.isfinite(distances)]
    return float(np.median(distances)) if len(distances) else 0.0


def _table_of_parameters(shots: _Shots) -> str:
    calibration = shots.calibration
    camera = calibration.camera
    values = [*camera.intrinsics.tolist(), *camera.distortion.tolist()]
    rows = "".join(
        f'<tr><th scope="row">{_text(name)}</th><td>{_rounded(value, std)}</td>'
        f"<td>{f'{std:.2g}' if std > 0 else 'held'}</td>"
        f'<td class="narrow">{_text(_INTRINSICS.get(name, "distortion"))}</td></tr>'
        for name, value, std in zip(calibration.parameter_names, values, calibration.std.tolist(), strict=True)
    )
    if any(calibration.bend):
        across, down = calibration.bend
        note = '<td class="narrow">of the board, along x and y</td>'
        rows += f'<tr><th scope="row">bend</th><td>{across:.3g}, {down:.3g}</td><td></td>{note}</tr>'
    numbers = [str(camera.intrinsics.tolist()), str(camera.distortion.tolist())][: 2 if camera.distortion_names else 1]
    arguments = ",\n    ".join((*numbers, f"image_size={calibration.image_size}"))
    code = f"import camtorch as ct\n\ncamera = ct.{type(camera).__name__}(\n    {arguments},\n)"
    return (
        '<div class="card"><table><thead><tr><th>parameter</th><th>value</th><th>sigma</th>'
        f'<th class="narrow"></th></tr></thead><tbody>{rows}</tbody></table></div>'
        f"<details><summary>All digits, as code</summary><pre>{_text(code)}</pre></details>"
    )


def _between(calibration: RigCalibration) -> str:
    """Distances and turns between all pairs of a few cameras."""
    names = list(calibration.cameras)
    if not 2 < len(names) <= _PAIRS:
        return ""
    poses = [calibration.rig.extrinsics[name] for name in names]
    head = "".join(f"<th>{_label(name)}</th>" for name in names)
    rows = []
    for name, a in zip(names, poses, strict=True):
        apart = [b.compose(a.inverse()) for b in poses]
        cells = "".join(
            f"<td>{float(p.translation.norm()):.4g}<br>{math.degrees(float(p.rotation.norm())):.3g}°</td>"
            if b is not a
            else "<td></td>"
            for b, p in zip(poses, apart, strict=True)
        )
        rows.append(f'<tr><th scope="row">{_label(name)}</th>{cells}</tr>')
    body = f"<thead><tr><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="card"><table class="names">{body}</table></div>'


def _rounded(value: float, std: float) -> str:
    """To the second digit of its standard deviation."""
    if not (std > 0 and math.isfinite(std)):
        return f"{value:.6g}"
    digits = max(0, min(12, 1 - math.floor(math.log10(std))))
    return f"{value:.{digits}f}".replace("-", "&minus;")


def _footer() -> str:
    return (
        "<footer><p>rms: the root of the mean squared length of the residuals, over all corners. Sigma: the standard "
        "deviation of one coordinate of a corner, from the residuals and the number of parameters. Residuals are "
        "projected minus observed. Uncertainty: where a point at a distance is seen, were the camera calibrated again "
        "from other images of such quality; the standard deviation in the worst direction, with the poses of the "
        "boards free. Pixels count from the centre of the top-left one; the camera looks along z, x is right and y "
        "down.</p><p>Made by camtorch.</p></footer>"
    )


# -- photographs


def _embedded(image: Any, size: tuple[int, int], name: str) -> tuple[str, str]:
    """A photograph within the page, and why it could not be read."""
    if image is None:
        return "", ""
    try:
        reduced = _reduced(image, size, name)
    except OSError as error:
        return "", f"no photograph: {error.strerror or error}"
    file = io.BytesIO()
    reduced.save(file, "JPEG", quality=_QUALITY, optimize=True)
    data = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="" src="data:image/jpeg;base64,{data}">', ""


def _reduced(image: Any, size: tuple[int, int], name: str) -> Image.Image:
    from PIL import Image

    if isinstance(image, (str, bytes, os.PathLike)):
        with Image.open(os.fsdecode(image)) as opened:
            _check_size(stored_size(opened), size, name)
            opened.draft(None, (_PHOTOGRAPH, _PHOTOGRAPH))
            image = load_stored(opened)
    else:
        image = image if isinstance(image, Image.Image) else _from_array(image)
        _check_size((image.height, image.width), size, name)
    if image.mode.startswith(("I", "F")):  # deep grey
        values = np.asarray(image, np.float64)
        image = Image.fromarray((255 * values / max(values.max(), 1e-9)).clip(0, 255).astype(np.uint8))
    reduced: Image.Image = image.convert("L" if image.mode in ("1", "L", "LA") else "RGB")
    reduced.thumbnail((_PHOTOGRAPH, _PHOTOGRAPH), reducing_gap=2.0)
    return reduced


def _from_array(image: Any) -> Image.Image:
    from PIL import Image

    if isinstance(image, Tensor):
        image = (image if image.ndim == 2 else image.movedim(0, -1)).numpy(force=True)
    values = np.asarray(image)
    if values.dtype.kind == "f":
        values = (255 * values).clip(0, 255).astype(np.uint8)
    return Image.fromarray(values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values)


def _check_size(image: tuple[int, int], camera: tuple[int, int], name: str) -> None:
    if image != camera:
        raise ValueError(
            f"write_report: the image {name!r} has {image[1]} x {image[0]} pixels, and those of the camera have "
            f"{camera[1]} x {camera[0]}"
        )
