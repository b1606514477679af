"""The result of a calibration, with its use and the limits of its data in words, and advice."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from camtorch.calibration.bundle import Adjusted, CameraObservations
from camtorch.calibration.observations import Observations, named
from camtorch.calibration.uncertainty import Spread, uncertainty, worst
from camtorch.cameras.camera import Camera
from camtorch.poses.extrinsics import Extrinsics
from camtorch.rays.lattices import angles_from_axis, image_lattice

_FINE, _ROUGH = 0.5, 3.0  # px, standard deviations of projections for measuring, and for viewing
_CELLS, _PATTERN = 32, 8  # cells along the longer side: of the map of uncertainty, and of residuals
_FEW_VIEWS = 6
_NINTHS = (  # of an image, by rows
    *("top left", "top", "top right"),
    *("left", "", "right"),
    *("bottom left", "bottom", "bottom right"),
)
_ALIKE = math.radians(30)  # the largest angle between two boards
_BEYOND = math.radians(3)
_FISHEYE, _RIM = math.radians(60), math.radians(8)  # a fisheye's image may end this far beyond its corners
_CORNER_NOISE = 1.0  # px, more than the error of detectors
_WORSE_VIEW = 3.0  # times the median of all views
_PATTERN_SHARE = 0.3  # of the residuals
_CERTAIN = 5.0  # standard deviations
_USUAL_NOISE = 0.1  # px
_OPEN = 0.02  # of the corners' extent: projections that are less certain are not determined
_MISFIT = 3.0  # px, the median residual above which no camera fits the views
_TILTED = "Tilt the board by 30 to 45 degrees to all sides"


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
    """The indices of passed views that have poses: those with corners, `copies` among them."""
    copies: tuple[int, ...]
    """The indices of passed views that repeat another one, which widens the uncertainties as if they were missing."""
    observations: Observations = field(repr=False)
    adjusted: Adjusted = field(repr=False)
    point_inliers: Tensor = field(repr=False)
    """(V, N) bool, the inliers of `observations`."""
    loss: str | None = None
    """The robust loss, if any."""
    index: int = field(default=0, repr=False)
    """The index of the camera among those adjusted together."""

    @property
    def covariance(self) -> Tensor:
        """Covariance (P, P) of the parameters, in their order; 0 for fixed ones.

        With a robust loss it is that of the weighted problem at its optimum. Intervals are right if outliers fall on
        all corners alike, and somewhat too narrow if they gather in some views. "huber" claims too little: with 5 % of
        the corners exchanged, coefficients spread by up to 1.6 times as much; "cauchy" does not.
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

    @property
    def failure(self) -> str:
        """The reason why the camera must not be used, or empty."""
        lost = int((self.observations.seen & ~self.adjusted.valid[self.index][0]).sum())
        ends = [] if bool(self.adjusted.converged[0]) else ["the search did not end at an optimum"]
        ends += [f"{lost} corners have no pixel, as the camera (a surface: its grid) ends before them"] if lost else []
        return " and ".join(ends)

    @cached_property
    @torch.no_grad()
    def warnings(self) -> list[str]:
        """The limits of the data and misfits, in words, each with advice."""
        return [*_of_residuals(self), *_of_data(self, _Survey(self))]

    @property
    @torch.no_grad()
    def verdict(self) -> str:
        """The use of the calibration in words, the angle up to which it is valid, and what to photograph next."""
        if self.failure:
            return f"Do not use this camera: {self.failure}."
        survey, good = _Survey(self), "Not for measuring"
        # the noise does not cover errors of the model at rays far from any corner
        fine, rough = survey.good_within(_FINE, survey.reach + _BEYOND), survey.good_within(_ROUGH)
        if fine[1] > 0:
            good = (
                f"Good for measuring up to {_degrees(fine[0])} from the optical axis, {_percent(fine[1])} of the image"
            )
        good += f": projections are known to {_px(survey.middle)} in the middle (standard deviation)."
        if rough[1] > fine[1]:
            good += f" Good for looking at up to {_degrees(rough[0])}, {_percent(rough[1])} of the image."
        ahead = "Four times as many views would halve the uncertainty."
        if survey.weak:
            ahead = f"Next, hold the board in {survey.weak} of the image, so near that its corners reach the edges."
        tilt = f" {_TILTED}." if survey.tilt < _ALIKE else ""
        return f"{good} Corners were seen up to {survey.reaches}. {ahead}{tilt}"

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


class _Survey:
    """Numbers of a calibration for its sentences, over a map (rows, columns) of the image."""

    def __init__(self, calibration: Calibration):
        size, self.seen = calibration.image_size, calibration.observations.seen
        rows, columns = (max(3, round(_CELLS * side / max(size))) for side in size)
        # the middles of cells
        pixels = image_lattice(calibration.camera, 2 * rows + 1, 2 * columns + 1)[1::2, 1::2]
        rays, self.has_ray = calibration.camera.unproject(pixels)
        self.angles = torch.where(self.has_ray, angles_from_axis(rays), torch.nan)  # radians from the axis
        self.uncertainty = calibration.uncertainty(pixels)  # px, of directions; NaN without a ray
        self.poses = calibration.extrinsics.matrix().to(self.seen.device)
        self.points = calibration.observations.points
        points = self.points @ self.poses[:, :3, :3].mT + self.poses[:, None, :3, 3]
        angles = angles_from_axis(points[self.seen]).sort().values
        self.reach = float(angles[math.ceil(0.995 * len(angles)) - 1])  # without one corner in 200, which may be wrong
        self.image_reach = float(self.angles.nan_to_num(0.0).amax())
        self.reaches = f"{_degrees(self.reach)}; the image goes to {_degrees(self.image_reach)}"
        # a fisheye's corners reach nearly to the circle at which its image ends
        ends_in_the_dark = self.reach > _FISHEYE and self.image_reach > self.reach + _RIM
        self.without_rays = 0.0 if ends_in_the_dark else float((~self.has_ray).double().mean())
        # the largest uncertainty of each ninth of the image, by rows
        values = self.uncertainty.nan_to_num(0.0 if ends_in_the_dark else torch.inf)
        most = [float(part.amax()) for band in values.tensor_split(3) for part in band.tensor_split(3, -1)]
        self.middle = most[4]
        weak = [(one, name) for one, name in zip(most, _NINTHS, strict=True) if one > max(_FINE, 3 * self.middle)]
        weakest = ", ".join(f"the {name}" for _, name in sorted(weak, reverse=True)[:3])
        self.weak = " and ".join(weakest.rsplit(", ", 1))

    def good_within(self, limit: float, furthest: float = math.inf) -> tuple[float, float]:
        """Return the angle from the axis up to which projections are certain to `limit` px, and the image's part."""
        known = self.uncertainty.nan_to_num(torch.inf)
        bad = ~((known <= limit) & (self.angles <= furthest)) & self.has_ray
        within = self.angles < torch.where(bad, self.angles, torch.inf).amin()
        return float(torch.where(within, self.angles, 0.0).amax()), float(within.double().mean())

    @property
    def tilt(self) -> float:
        """The largest angle between two boards, in radians; infinite if they are not flat."""
        points = self.points[self.seen]
        _, sizes, axes = torch.linalg.svd(points - points.mean(0), full_matrices=False)
        normals = self.poses[self.seen.any(-1), :3, :3] @ axes[2]
        flat = bool(sizes[2] <= 1e-3 * sizes[1])
        return float(torch.acos((normals @ normals.mT).clamp(-1, 1)).amax()) if flat else math.inf


def _of_residuals(calibration: Calibration) -> Iterator[str]:
    """Generate warnings about residuals: of all corners, of single ones, of views, and of parts of the image."""
    if calibration.failure:
        yield (
            f"Do not use this camera: {calibration.failure}. Check the board's size, the image size and the model, try "
            "another model first, or give start=a camera; give a surface a wider grid"
        )
    if calibration.sigma > _CORNER_NOISE * max(1.0, max(calibration.image_size) / 2000):
        yield (
            f"Residuals are {_px(calibration.sigma)} per coordinate, far more than the errors of corners: the board "
            "may be bent or not as described, images smeared, or the model not that of the lens"
        )
    yield from _of_outliers(calibration)
    # px: corners may be float32
    rounding = torch.finfo(torch.float32).eps * float(calibration.observations.pixels.abs().amax())
    yield from _of_worse_views(calibration, rounding)
    share = _pattern_share(calibration) if calibration.rms > rounding else 0.0
    if share > _PATTERN_SHARE:
        yield (
            f"The residuals have a pattern over the image, of {_px(share * calibration.rms)}: the model is not that of "
            "the lens, or the board is bent. Try brown_conrady with count=8, kannala_brandt or fisheye624, or bend=True"
        )


def _of_outliers(calibration: Calibration) -> Iterator[str]:
    """Generate the warning about corners that are far more wrong than others, or more of them than chance makes."""
    seen, inliers = calibration.observations.seen, calibration.point_inliers
    bad, squares = seen & ~inliers, calibration.point_residuals.square().sum(-1)
    per_view, count, total = bad.sum(-1), int(bad.sum()), int(seen.sum())
    usual = float(squares[inliers].mean()) / 2 if bool(inliers.any()) else 0.0
    # so many normal errors exceed three standard deviations, and none exceeds six
    if count > 3 + 2 * math.exp(-4.5) * total or bool((squares[bad] > 36 * usual).any()):
        robust = {
            None: ': loss="cauchy" keeps them from pulling',
            "huber": '. By loss="huber" results spread up to 1.6 times as far as claimed; by loss="cauchy" they do not',
        }.get(calibration.loss, "")
        most = f"{int(per_view.max())} of them in {named([calibration.views[int(per_view.argmax())]])}"
        yield f"{count} of {total} corners are outliers, {most}{robust}. Look at the views"


def _of_worse_views(calibration: Calibration, rounding: float) -> Iterator[str]:
    """Generate the warning about views with far greater residuals than others, and than the rounding of pixels."""
    seen, squares = calibration.observations.seen, calibration.point_residuals.square().sum(-1)
    rms = ((squares * seen).sum(-1) / seen.sum(-1)).sqrt()  # NaN for views of a rig that this camera does not see
    middle = float(rms.nanmedian())
    worse = (rms > max(_WORSE_VIEW * middle, rounding)).nonzero()[:, 0].tolist()
    if worse and len(rms) >= _FEW_VIEWS:
        yield (
            f"The rms of {named([calibration.views[i] for i in worse])} is up to {_px(float(rms[worse].amax()))}, and "
            f"{_px(middle)} is usual. Look at the corners, or leave such views out: they widen all uncertainties"
        )


def _pattern_share(calibration: Calibration) -> float:
    """Return the part of the residuals that is a pattern over the image; 0 if it may be chance."""
    use = calibration.point_inliers
    residuals, pixels = calibration.point_residuals[use], calibration.observations.pixels[use]
    side = max(calibration.image_size) / _PATTERN
    rows, columns = (math.ceil(length / side) for length in calibration.image_size)
    place = ((pixels + 0.5) / side).long().clamp(min=0)
    cell = place[:, 1].clamp(max=rows - 1) * columns + place[:, 0].clamp(max=columns - 1)
    sums = residuals.new_zeros(rows * columns, 2).index_add_(0, cell, residuals)
    counts = cell.bincount(minlength=rows * columns)
    variance = float(residuals.square().mean()) if len(residuals) else 0.0
    free = 2 * int((counts > 0).sum())
    squares = float((sums.square().sum(-1) / counts.clamp(min=1)).sum()) / variance if variance else 0.0
    if squares - free < _CERTAIN * math.sqrt(2 * free):
        return 0.0
    return math.sqrt((squares - free) / (2 * len(residuals)))


def _of_data(calibration: Calibration, survey: _Survey) -> Iterator[str]:
    """Generate warnings about views and their places in the image."""
    if calibration.copies:
        yield f"Copies of other views, or nearly so, are {named(calibration.copies)}: they count once. Take new ones"
    count = int(survey.seen.any(-1).sum()) - len(calibration.copies)
    if count < _FEW_VIEWS:
        yield f"Few views ({count}): a bad one cannot be detected. Take 10 to 20. {_TILTED}"
    if count > 1 and survey.tilt < _ALIKE and bool((survey.uncertainty > _FINE).any()):
        within = _degrees(survey.tilt)
        yield f"All boards are parallel to within {within}, which leaves the focal length uncertain. {_TILTED}"
    without = survey.without_rays
    if without > 0.001 or survey.good_within(_ROUGH)[0] < survey.image_reach:
        inside = f", where the lens ends: {_percent(without)} of the pixels have no ray" if without > 0.001 else ""
        yield (
            f"Corners reach {survey.reaches}{inside}. The lens is a guess in {survey.weak or 'the corners'} of the "
            "image: hold the board there"
        )


@torch.inference_mode()
def check_determined(
    adjusted: Adjusted, camera: int, found: Spread, names: Sequence[str], observed: CameraObservations, owner: str
) -> None:
    """Raise a ValueError if the views do not determine a camera, as with boards that are all parallel.

    A camera is undetermined if corner errors of 0.1 px make projections of the seen points uncertain by more than 2 %
    of the corners' extent. Views that no camera fits get warnings instead. found: the spread for noise of 1 px.
    """
    seen = observed.weights[0] > 0
    views = int(seen.any(-1).sum())
    misfit = torch.linalg.vector_norm(adjusted.residuals[camera][0], dim=-1)[seen].median()
    if views > 1 and float(misfit) > _MISFIT:
        return
    found = found.scaled(adjusted.cost.new_full((1,), _USUAL_NOISE))
    pixels = observed.pixels[0][seen]
    pixels = pixels[:: max(1, len(pixels) // 512)][None]
    sizes = worst(found.of_pixels(pixels, torch.full_like(pixels[..., 0], torch.inf)))[0]
    extent = float((pixels.amax((0, 1)) - pixels.amin((0, 1))).amax())
    if not float(sizes.nanmedian()) > _OPEN * max(extent, 1.0):
        return
    free = [name for name, std in zip(names, found.std[0].tolist(), strict=True) if std > 0]
    hold = tuple(name for name in free if name not in ("fx", "fy")) or tuple(free)
    given = "a single view of this board" if views == 1 else f"{views} views, which may be nearly parallel"
    raise ValueError(
        f"{owner}: views must determine the camera; got {given}. Take 10 to 20 views. {_TILTED}, or hold parameters: "
        f"fixed={hold}"
    )


def _px(value: float) -> str:
    return f"{value:.0f} px" if 99.5 <= value < 1e6 else f"{value:.2g} px"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share > 0.095 else f"{100 * share:.2g} %"


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):.0f} degrees"
