"""The result of a calibration, with its use and the limits of its data in words, and advice."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from camtorch.calibration.bundle import Adjusted, CameraObservations, pixel_jacobians
from camtorch.calibration.observations import Observations, named
from camtorch.calibration.uncertainty import Spread, uncertainty, worst
from camtorch.cameras.camera import Camera
from camtorch.cameras.opaque import fixed_camera
from camtorch.poses.extrinsics import Extrinsics
from camtorch.rays.lattices import angles_from_axis, image_edges, image_lattice

_FINE, _ROUGH = 0.5, 3.0  # px, standard deviations of projections for measuring, and for viewing
_CELLS, _PATTERN = 32, 8  # cells along the longer side: of the map of uncertainty, and of residuals
_FEW_VIEWS = 6
_ALIKE = math.radians(30)  # the largest angle between two boards
_LOOSE_FOCAL, _LOOSE_CENTRE = 0.01, 0.005  # standard deviations, relative to a focal length and to the longer side
_BEYOND = math.radians(3)
_FISHEYE, _RIM = math.radians(60), math.radians(8)  # a fisheye's image may end this far beyond its corners
_CORNER_NOISE = 1.0  # px, more than the error of detectors
_WORSE_VIEW = 3.0  # times the median of all views
_PATTERN_SHARE = 0.3  # of the residuals
_CERTAIN = 5.0  # standard deviations
_USUAL_NOISE = 0.1  # px
_OPEN = 0.02  # of the corners' extent: projections that are less certain are not determined
_OPEN_COEFFICIENT = 0.1  # standard deviation
_MISFIT = 3.0  # px, the median residual above which no camera fits the views
_MOST_OF_A_VIEW = 0.8  # of its corners

_TILTED = "Tilt the board by 30 to 45 degrees to all sides"
_NOISE = "one standard deviation in the worst direction"


@dataclass(repr=False)
class Calibration:
    """The result of `calibrate`, and its uncertainty.

    Units are pixels, and for poses those of the object points. `views` are those of the poses.
    """

    camera: Camera
    """The camera: float64, an ordinary module that goes on learning."""
    extrinsics: Extrinsics
    """Camera from board, with batch dims (V,)."""
    rms: float
    """The root of the mean squared length of the residuals, per point, as OpenCV's."""
    sigma: float
    """Standard deviation of a pixel's coordinate: sqrt(sum of squares / (2 N - parameters)), robust: of the inliers."""
    residuals: Any
    """Projected minus observed, in the shape or the list form of the image points; NaN for unseen corners, views left
    out, and corners for which a camera that did not converge has no pixel."""
    inliers: Any
    """Bool, in the same form: the residual is shorter than max(3 loss_scale, 3 sigma of the inliers)."""
    parameter_names: tuple[str, ...]
    """fx, fy, cx, cy and the names of the coefficients."""
    spread: Spread = field(repr=False)
    """The effect of the corners' noise on the parameters and the poses."""
    converged: bool
    """Whether the search ended at an optimum, in which every seen corner has a pixel."""
    bend: tuple[float, float]
    """How far the middle of the board lies off the plane of its edges, along x and y; zeros without bend=True."""
    image_size: tuple[int, int]
    views: tuple[int, ...]
    """The indices of passed views that have poses: those with corners, unlike all earlier ones."""
    copies: tuple[int, ...]
    """The indices of passed views that repeat another one: left out if equal, else they widen the uncertainties."""
    observations: Observations = field(repr=False)
    adjusted: Adjusted = field(repr=False)
    point_inliers: Tensor = field(repr=False)
    """(V, N) bool, the inliers of `observations`."""
    loss: str | None = None
    """The robust loss, if any."""
    index: int = field(default=0, repr=False)
    """The index of the camera among those adjusted together."""
    twins: tuple[tuple[float, ...], ...] = field(default=(), repr=False)
    """The parameters of other optima that fit equally well, up to the noise. Such a camera's projections are known near
    corners, its parameters are not. Double spheres have twins."""

    @property
    def covariance(self) -> Tensor:
        """Covariance (P, P) of the parameters, in their order; 0 for fixed ones.

        With a robust loss it is that of the weighted problem at its optimum. Intervals are right if outliers fall on
        all corners alike, and somewhat too narrow if they gather in some views.
        """
        return self.spread.covariance[0]

    @property
    def std(self) -> Tensor:
        """Standard deviations (P,) of the parameters; 0 for fixed ones."""
        return self.spread.std[0]

    @property
    def point_residuals(self) -> Tensor:
        """Residuals (V, N, 2) of `observations`."""
        return self.adjusted.residuals[self.index][0]

    @property
    def lost(self) -> int:
        """Number of seen corners without a pixel in the camera, because it ends before them."""
        return int((self.observations.seen & ~self.adjusted.valid[self.index][0]).sum())

    def uncertainty(self, pixels: Any, distance: float = math.inf) -> Tensor:
        """Return the standard deviation of pixels if the camera were calibrated again from images of this quality.

        It is that of a point's pixel in the worst direction, and includes the boards' poses: mrcal's mean-pcam.

        Args:
            pixels: (..., 2).
            distance: Distance from the camera, in units of the object points.

        Returns:
            (...,) px; NaN if a pixel has no ray.
        """
        return uncertainty(self.spread, pixels, distance)

    @cached_property
    @torch.no_grad()
    def warnings(self) -> list[str]:
        """The limits of the data and misfits, in words, each with advice."""
        survey = _Survey(self)
        finders = (_search, _residuals, _views, _parameters, _over_image)
        return [text for find in finders for text in find(survey)]

    @property
    @torch.no_grad()
    def verdict(self) -> str:
        """The use of the calibration in words, the angle up to which it is valid, and what to photograph next."""
        survey = _Survey(self)
        if not self.converged:
            return next(_search(survey)) + "."
        middle = survey.zones[4].uncertainty
        # the noise does not cover errors of the model at rays far from any corner
        fine, fine_share = survey.good_within(_FINE, survey.reach + _BEYOND)
        rough, rough_share = survey.good_within(_ROUGH)
        good = f"Not for measuring: projections are known to {_px(middle)} in the middle ({_NOISE})."
        if fine_share > 0:
            there = float(survey.uncertainty[survey.angles <= fine].amax())
            good = (
                f"Good for measuring up to {_degrees(fine)} from the optical axis, {_percent(fine_share)} of the image"
                f": projections are known to {_px(middle)} in the middle and to {_px(there)} at worst ({_NOISE})."
            )
        if rough_share > fine_share:
            good += f" Good for looking at up to {_degrees(rough)}, {_percent(rough_share)} of the image."
        reach = f"Corners were seen up to {_degrees(survey.reach)}; the image goes to {_degrees(survey.image_reach)}."
        loose = [zone for zone in survey.zones if zone.rays >= 0.5 and zone.uncertainty > max(_FINE, 2 * middle)]
        tilt = f" {_TILTED}." if survey.tilt < _ALIKE else ""
        if wanted := survey.missing or sorted(loose, key=lambda zone: -zone.uncertainty)[:3]:
            near = "so near that its corners reach the edges"
            ahead = f"Next, hold the board in {_zone_names(wanted)} of the image, {near}.{tilt}"
        elif tilt:
            ahead = f"Next:{tilt}"
        elif middle > _FINE:
            ahead = "Next, take more views, near and tilted: four times as many halve the uncertainty."
        else:
            ahead = "It needs no more views; four times as many would halve the uncertainty."
        return f"{good} {reach} {ahead}"

    def __repr__(self) -> str:
        values = [*self.camera.intrinsics.tolist(), *self.camera.distortion.tolist()]
        pairs = zip(self.parameter_names, values, self.std.tolist(), strict=True)
        numbers = [f"  {name} = {value:.7g}" + (f" +- {std:.2g}" if std else ", held") for name, value, std in pairs]
        count, seen = len(self.views), int(self.observations.seen.sum())
        head = (
            f"Calibration({type(self.camera).__name__}: rms {self.rms:.4g} px, sigma {self.sigma:.4g} px, "
            f"{count} view{'s' * (count != 1)}, {seen} corners{'' if self.converged else ', NOT CONVERGED'})"
        )
        return "\n".join((head, *numbers, *(f"  ! {text}" for text in self.warnings), f"  {self.verdict}"))


class Zone(NamedTuple):
    """A ninth of the image: the shares of it near corners and with rays, and its largest uncertainty, px or NaN."""

    name: str
    share: float
    rays: float
    uncertainty: float


class _Survey:
    """Numbers of a calibration for its sentences, over a map (rows, columns) of the image."""

    def __init__(self, calibration: Calibration):
        self.calibration, self.seen = calibration, calibration.observations.seen
        cell = max(calibration.image_size) / _CELLS
        rows, columns = self.shape = tuple(max(1, round(side / cell)) for side in calibration.image_size)
        # the middles of cells
        pixels = image_lattice(calibration.camera, 2 * rows + 1, 2 * columns + 1)[1::2, 1::2]
        rays, self.has_ray = calibration.camera.unproject(pixels)
        self.angles = torch.where(self.has_ray, angles_from_axis(rays), torch.nan)  # radians from the axis
        self.uncertainty = calibration.uncertainty(pixels)  # px, of directions; NaN without a ray
        self.corners = calibration.observations.pixels[self.seen]
        self.rounding = torch.finfo(torch.float32).eps * float(self.corners.abs().amax())  # px: corners may be float32
        pose = calibration.extrinsics.matrix().to(self.seen.device)
        self.points = calibration.observations.points @ pose[:, :3, :3].mT + pose[:, None, :3, 3]  # of the camera
        angles = angles_from_axis(self.points[self.seen]).sort().values
        self.reach = float(angles[math.ceil(0.995 * len(angles)) - 1])  # without one corner in 200, which may be wrong
        self.image_reach = float(self.angles.nan_to_num(0.0).amax())
        # a fisheye's corners reach nearly to the circle at which its image ends
        self.ends_in_the_dark = self.reach > _FISHEYE and self.image_reach > self.reach + _RIM

    @cached_property
    def zones(self) -> list[Zone]:
        """Nine zones of the image, by rows."""
        low, high = image_edges(self.calibration.image_size, self.corners)
        count = self.corners.new_tensor(self.shape[::-1])
        index = ((self.corners - low) / (high - low) * count).long().clamp(min=0)
        column, row = torch.minimum(index, count.long() - 1).unbind(-1)
        cells = torch.zeros(self.shape, dtype=self.corners.dtype, device=self.corners.device)
        cells[row, column] = 1
        covered = torch.nn.functional.max_pool2d(cells[None, None], 3, 1, 1)[0, 0]
        bands, parts = (torch.arange(n, device="cpu").tensor_split(3) for n in self.shape)
        result = []
        for (i, band), (j, part) in itertools.product(enumerate(bands), enumerate(parts)):
            here = self.uncertainty[band][:, part]
            known = here[~here.isnan()]
            name = " ".join(filter(None, (("top", "", "bottom")[i], ("left", "", "right")[j]))) or "middle"
            share, most = float(covered[band][:, part].mean()), float(known.amax()) if len(known) else math.nan
            result.append(Zone(name, share, len(known) / here.numel(), most))
        return result

    @property
    def missing(self) -> list[Zone]:
        """Zones with few corners in which the lens is much less certain than in the middle, or has no rays."""
        middle = self.zones[4].uncertainty
        limit = max(_FINE, 3 * middle) if math.isfinite(middle) else _FINE
        few = (zone for zone in self.zones if zone.share < 0.5)
        return [z for z in few if (not self.ends_in_the_dark if z.rays < 0.5 else z.uncertainty > limit)]

    def good_within(self, limit: float, furthest: float = math.inf) -> tuple[float, float]:
        """Return the angle from the axis up to which projections are certain to `limit` px, and the image's part."""
        known = self.uncertainty.nan_to_num(torch.inf)
        bad = ~((known <= limit) & (self.angles <= furthest)) & self.has_ray
        within = self.angles < torch.where(bad, self.angles, torch.inf).amin()
        return float(torch.where(within, self.angles, 0.0).amax()), float(within.double().mean())

    @cached_property
    def tilt(self) -> float:
        """The largest angle between two boards, in radians; infinite if a board is not flat."""
        weights = self.seen.to(self.points)[..., None]
        middle = (self.points * weights).sum(1, keepdim=True) / weights.sum(1, keepdim=True).clamp(min=1)
        _, sizes, axes = torch.linalg.svd((self.points - middle) * weights, full_matrices=False)
        used = self.seen.any(-1)
        if not bool(used.any()) or bool((sizes[used, 2] > 1e-3 * sizes[used, 1]).any()):
            return math.inf
        normals = axes[used, 2]
        normals = torch.where((normals * middle[used, 0]).sum(-1, keepdim=True) > 0, -normals, normals)
        return float(torch.acos((normals @ normals.mT).clamp(-1, 1)).amax())

    @property
    def loose_focal(self) -> float:
        """The relative standard deviation of the focal length at the axis, which is no parameter; the larger of two."""
        spread, near = self.calibration.spread, 1e-4
        camera = fixed_camera(spread.model, spread.parameters[:, :4], spread.parameters[:, 4:])
        rays = spread.parameters.new_tensor([[0.0, 0, 1], [near, 0, 1], [0, near, 1]])
        by_ray, by_parameters = (jacobians[0] for jacobians in pixel_jacobians(camera, rays[None]))
        slopes = torch.stack([by_parameters[i + 1, i] - by_parameters[0, i] for i in (0, 1)]) / near
        stds = torch.linalg.vector_norm(slopes @ spread.factor[0, : slopes.shape[-1]], dim=-1)
        return float((stds / by_ray[0, :, :2].diagonal().abs()).amax())

    @property
    def pattern_share(self) -> float:
        """The part of the residuals that is a pattern over the image; 0 if it may be chance."""
        use = self.calibration.point_inliers
        residuals, pixels = self.calibration.point_residuals[use], self.calibration.observations.pixels[use]
        side = max(self.calibration.image_size) / _PATTERN
        rows, columns = (math.ceil(length / side) for length in self.calibration.image_size)
        place = ((pixels + 0.5) / side).long().clamp(min=0)
        cell = place[:, 1].clamp(max=rows - 1) * columns + place[:, 0].clamp(max=columns - 1)
        sums = residuals.new_zeros(rows * columns, 2).index_add_(0, cell, residuals)
        counts = cell.bincount(minlength=rows * columns)
        variance, free = float(residuals.square().mean()) if len(residuals) else 0.0, 2 * int((counts > 0).sum())
        squares = float((sums.square().sum(-1) / counts.clamp(min=1)).sum()) / variance if variance else 0.0
        if squares - free < _CERTAIN * math.sqrt(2 * free):
            return 0.0
        return math.sqrt((squares - free) / (2 * len(residuals)))


def _search(survey: _Survey) -> Iterator[str]:
    found = survey.calibration
    if lost := found.lost:
        yield (
            f"{lost} corners have no pixel in this camera, which ends before them: do not use it. "
            "A surface must reach further: give a wider grid"
        )
    if not bool(found.adjusted.converged[0]):
        held = found.adjusted.held_by
        by = f", held by {held} corners at the end of what the camera shows, lost by another step" if held else ""
        yield (
            f"The search did not end at an optimum{by}: do not use this camera. Check the board's size, the image size "
            "and the model, try another model first, or give start=a camera"
        )


def _residuals(survey: _Survey) -> Iterator[str]:
    calibration, seen, inliers = survey.calibration, survey.seen, survey.calibration.point_inliers
    if calibration.sigma > _CORNER_NOISE * max(1.0, max(calibration.image_size) / 2000):
        yield (
            f"Residuals are {_px(calibration.sigma)} per coordinate, far more than the errors of corners: the board "
            "may be bent or not as described, images out of focus or smeared, or the model not that of the lens"
        )
    bad, squares = seen & ~inliers, calibration.point_residuals.square().sum(-1)
    per_view, count, total = bad.sum(-1), int(bad.sum()), int(seen.sum())
    usual = float(squares[inliers].mean()) / 2 if bool(inliers.any()) else 0.0
    # so many normal errors exceed three standard deviations, and none exceeds six
    if count > 3 + 2 * math.exp(-4.5) * total or bool((squares[bad] > 36 * usual).any()):
        most = int(per_view.argmax())
        robust = "" if calibration.loss else ': loss="huber" keeps them from pulling'
        yield (
            f"{count} of {total} corners are outliers, {int(per_view[most])} of them in view "
            f"{calibration.views[most]}{robust}. Look at the views"
        )
    lost = [calibration.views[i] for i in (per_view > _MOST_OF_A_VIEW * seen.sum(-1)).nonzero()[:, 0].tolist()]
    if lost and calibration.loss:
        yield (
            f"Nearly all corners of {named(lost)} are outliers, as if they were numbered in another "
            "order. Leave such views out: they make all parameters look less certain"
        )
    rms = ((squares * seen).sum(-1) / seen.sum(-1)).sqrt()
    middle = float(rms[~rms.isnan()].median())
    worse = (rms > max(_WORSE_VIEW * middle, survey.rounding)).nonzero()[:, 0].tolist()
    if worse and len(rms) >= _FEW_VIEWS:
        views = named([calibration.views[i] for i in worse])
        yield (
            f"The rms of {views} is up to {_px(float(rms[worse].amax()))}, and {_px(middle)} is usual. Look at the "
            "corners, or leave such views out"
        )


def _views(survey: _Survey) -> Iterator[str]:
    calibration = survey.calibration
    if calibration.copies:
        yield (
            f"Copies of other views, or nearly so, are {named(calibration.copies)}: they count once. "
            "Take new photographs instead"
        )
    copies = [calibration.views.index(view) for view in calibration.copies if view in calibration.views]
    count = int(survey.seen.any(-1).sum()) - int(survey.seen[copies].any(-1).sum())
    if count < _FEW_VIEWS:
        yield f"Few views ({count}): a bad one cannot be detected. Take 10 to 20. {_TILTED}"


def _parameters(survey: _Survey) -> Iterator[str]:
    found = survey.calibration
    if (loose := survey.loose_focal) > _LOOSE_FOCAL:
        why = "Take views in which the board is near and tilted, and fills the image"
        if len(survey.seen) > 1 and survey.tilt < _ALIKE:
            why = f"All boards are parallel to within {_degrees(survey.tilt)}. {_TILTED}"
        yield f"The focal length is known to {_percent(loose)} only. {why}"
    if (std := max(found.std[2:4].tolist())) > _LOOSE_CENTRE * max(found.image_size):
        yield (
            f"The principal point is known to {_px(std)} only. {_TILTED}, or hold it in the middle with "
            'fixed=("cx", "cy")'
        )
    if found.twins:
        names = (found.parameter_names[0], *found.parameter_names[4:])
        optima = [(p[0], *p[4:]) for p in (found.spread.parameters[0].tolist(), *found.twins)]
        first, *others = (", ".join(f"{n} {v:.4g}" for n, v in zip(names, p, strict=True)) for p in optima)
        yield (
            f"The parameters are not known, only projections near corners: {first} fits no better than "
            f"{'; '.join(others)}. Do not compare parameters, or use eucm or kannala_brandt"
        )


def _over_image(survey: _Survey) -> Iterator[str]:
    if missing := survey.missing:
        yield f"Few corners or none in {_zone_names(missing)} of the image. Hold the board there, near the edges"
    reach, end = survey.reach, survey.image_reach
    lost = float((~survey.has_ray).double().mean())
    if lost > 0.001 and not survey.ends_in_the_dark:
        yield (
            f"The fitted lens ends inside the image: {_percent(lost)} of the pixels have no ray, beyond {_degrees(end)}"
            f" from the axis, and corners reach {_degrees(reach)}. Take views with corners further out, or use a model "
            "with fewer coefficients or of a wider lens"
        )
    if end > reach + _BEYOND and survey.good_within(_ROUGH)[0] < end:
        yield (
            f"Corners reach {_degrees(reach)} from the axis, and the image {_degrees(end)}: beyond the corners the "
            "lens is a guess. Hold the board nearer to the corners of the image"
        )
    rms = survey.calibration.rms
    if rms > survey.rounding and (share := survey.pattern_share) > _PATTERN_SHARE:
        yield (
            f"The residuals have a pattern over the image, of {_px(share * rms)}: the model is not that of the lens, "
            "or the board is bent. Try brown_conrady with count=8, kannala_brandt or fisheye624, or bend=True"
        )


@torch.inference_mode()
def check_determined(
    adjusted: Adjusted, camera: int, found: Spread, names: Sequence[str], observed: CameraObservations, owner: str
) -> None:
    """Raise a ValueError if the views do not determine a camera, as with boards that are all parallel.

    A camera is undetermined if corner errors of 0.1 px make projections of the seen points uncertain by more than 2 %
    of the corners' extent. Views that no camera fits get warnings instead. found: the spread for noise of 1 px.
    """
    found = found.scaled(adjusted.cost.new_full((1,), _USUAL_NOISE))
    seen = observed.weights[0] > 0
    views = int(seen.any(-1).sum())
    misfit = torch.linalg.vector_norm(adjusted.residuals[camera][0], dim=-1)[seen].median()
    if views > 1 and float(misfit) > _MISFIT:
        return
    pixels = observed.pixels[0][seen]
    pixels = pixels[:: max(1, len(pixels) // 512)][None]
    sizes = worst(found.of_pixels(pixels, torch.full_like(pixels[..., 0], torch.inf)))[0]
    sizes = sizes[~sizes.isnan()]
    extent = float((pixels.amax((0, 1)) - pixels.amin((0, 1))).amax())
    if not len(sizes) or float(sizes.median()) <= _OPEN * max(extent, 1.0):
        return
    std, values = found.std[0], found.parameters[0]
    limits = torch.cat((_OPEN * values[:2], _OPEN * values[:2], torch.full_like(values[4:], _OPEN_COEFFICIENT)))
    open_ones = [name for name, is_open in zip(names, (std > limits).tolist(), strict=True) if is_open]
    free = [name for name, size in zip(names, std.tolist(), strict=True) if size > 0]
    hold = [name for name in free if name not in ("fx", "fy")] or free
    given = "a single view of this board" if views == 1 else f"{views} views, which may be nearly parallel"
    raise ValueError(
        f"{owner}: views must determine {_words(open_ones or free)}; got {given}. Take 10 to 20 views. {_TILTED}, or "
        f"hold parameters: fixed={tuple(hold)}"
    )


def _words(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _zone_names(zones: Sequence[Zone]) -> str:
    return _words([f"the {zone.name}" for zone in zones])


def _px(value: float) -> str:
    return f"{value:.0f} px" if 99.5 <= value < 1e6 else f"{value:.2g} px"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share > 0.095 else f"{100 * share:.2g} %"


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):.0f} degrees"
