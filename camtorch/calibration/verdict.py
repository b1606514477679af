"""What a calibration is good for, and what its data do not carry: in words, each with what to do."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from camtorch._arguments import columns
from camtorch.calibration.bundle import Adjusted, Bundle, Free, Sight, State
from camtorch.calibration.observations import named
from camtorch.calibration.uncertainty import Spread, worst
from camtorch.projection.rays import angles_from_axis, image_edges, image_lattice

if TYPE_CHECKING:
    from camtorch.calibration.calibrate import Calibration

FINE, ROUGH = 0.5, 3.0
"""Px, the standard deviations of projections that are good enough to measure by, and to look at images."""

_CELLS, _PATTERN = 32, 8  # along the longer side: of the map of uncertainty, and of that of residuals
_FEW_VIEWS = 6
_ALIKE = math.radians(30)  # the largest angle between two boards
_LOOSE_FOCAL, _LOOSE_CENTRE = 0.01, 0.005  # standard deviations: of a focal length, and of the longer side
_BEYOND = math.radians(3)
_FISHEYE, _RIM = math.radians(60), math.radians(8)  # beyond the corners of a fisheye its image ends
_CORNER_NOISE = 1.0  # px, more than detectors leave
_WORSE_VIEW = 3.0  # times the median of all views
_PATTERN_SHARE = 0.3  # of the residuals
_CERTAIN = 5.0  # standard deviations
_GAIN = 0.02  # of the sum of squares, for which a model may have more parameters
_USUAL_NOISE = 0.1  # px
_OPEN = 0.02  # of the corners' extent: the uncertainty of projections that are not determined
_OPEN_COEFFICIENT = 0.1  # standard deviation
_MISFIT = 3.0  # px, the median residual of views that no camera fits
_MOST_OF_A_VIEW = 0.8  # of its corners

_TILTED = "Tilt the board by 30 to 45 degrees to all sides"
_ROWS, _COLUMNS = ("top", "", "bottom"), ("left", "", "right")


class Zone(NamedTuple):
    """A ninth of the image."""

    name: str
    share: float
    """The part of its cells that corners lie in or next to."""
    rays: float
    """The part of its cells that have rays."""
    uncertainty: float
    """Px, the largest there, of directions; NaN where it has no ray."""


class Survey:
    """Numbers of a calibration that sentences are made of, over a map of the image."""

    shape: tuple[int, ...]
    pixels: Tensor

    def __init__(self, calibration: Calibration):
        self.calibration = calibration
        cell = max(calibration.image_size) / _CELLS
        rows, columns = self.shape = tuple(max(1, round(side / cell)) for side in calibration.image_size)
        # with the edges of the cells every second is a middle
        self.pixels = image_lattice(calibration.camera, 2 * rows + 1, 2 * columns + 1)[1::2, 1::2]
        """(rows, columns, 2) the middle of each cell."""

    @property
    def parameters(self) -> Tensor:
        """(4 + n,)."""
        return self.calibration.spread.parameters[0]

    @cached_property
    def rays(self) -> tuple[Tensor, Tensor]:
        """Of the cells (rows, columns, 3), and whether there is one."""
        with torch.no_grad():
            return self.calibration.camera.unproject(self.pixels)

    @cached_property
    def angles(self) -> Tensor:
        """(rows, columns) radians from the axis, NaN where there is no ray."""
        rays, valid = self.rays
        return torch.where(valid, angles_from_axis(rays), torch.nan)

    @cached_property
    def uncertainty(self) -> Tensor:
        """(rows, columns) px, of directions; NaN where there is no ray."""
        return self.calibration.uncertainty(self.pixels)

    @cached_property
    def seen(self) -> Tensor:
        """(V, N) bool."""
        return self.calibration.observations.seen

    @cached_property
    def corners(self) -> Tensor:
        """(M, 2) all that were seen."""
        return self.calibration.observations.pixels[self.seen]

    @property
    def rounding(self) -> float:
        """px: residuals up to here say nothing, for corners and poses often come in float32."""
        return torch.finfo(torch.float32).eps * float(self.corners.abs().amax())

    @cached_property
    def points(self) -> Tensor:
        """(V, N, 3) those of the boards in the camera's frame."""
        with torch.no_grad():
            pose = self.calibration.extrinsics.matrix().to(self.seen.device)
            return self.calibration.observations.points @ pose[:, :3, :3].mT + pose[:, None, :3, 3]

    @cached_property
    def reach(self) -> float:
        """Radians from the axis, of the corner that is furthest from it but for one in 200, which may be wrong."""
        angles = angles_from_axis(self.points[self.seen])
        return float(angles.sort().values[math.ceil(0.995 * len(angles)) - 1])

    @cached_property
    def image_reach(self) -> float:
        """Radians from the axis, of the ray of the image that is furthest from it."""
        return float(self.angles.nan_to_num(0.0).amax())

    @property
    def ends_in_the_dark(self) -> bool:
        """Whether the lens ends beyond the circle that a fisheye shows, where corners reach."""
        return self.reach > _FISHEYE and self.image_reach > self.reach + _RIM

    @cached_property
    def covered(self) -> Tensor:
        """(rows, columns) bool: in the cell or in one next to it there is a corner."""
        low, high = image_edges(self.calibration.image_size, self.corners)
        count = self.corners.new_tensor(self.shape[::-1])
        index = ((self.corners - low) / (high - low) * count).long().clamp(min=0)
        column, row = torch.minimum(index, count.long() - 1).unbind(-1)
        cells = torch.zeros(self.shape, dtype=self.corners.dtype, device=self.corners.device)
        cells[row, column] = 1
        return torch.nn.functional.max_pool2d(cells[None, None], 3, 1, 1)[0, 0] > 0

    @cached_property
    def loose_focal(self) -> float:
        """The standard deviation of the focal length at the axis over itself: the worse of both.

        In some models a coefficient does nearly what the parameter called focal length does.
        """
        with torch.inference_mode(False), torch.enable_grad():
            p = self.parameters.detach().clone().requires_grad_()
            x, y = (p.new_zeros(1, 1).requires_grad_() for _ in range(2))
            chart, lens = self.calibration.spread.model.optics(columns(p[None, 4:]))
            a, b = chart.to_plane(x, y, torch.ones_like(x), order=2)
            if lens.stages:
                a, b = lens(a, b)
            pairs = (p[0] * a, x), (p[1] * b, y)
            focal = [torch.autograd.grad(to.sum(), of, create_graph=True)[0].sum() for to, of in pairs]
            slopes = [torch.autograd.grad(f, p, retain_graph=True)[0] for f in focal]
        factor = self.calibration.spread.factor[0, : len(p)]
        stds = [float(torch.linalg.vector_norm(slope @ factor)) for slope in slopes]
        return max(std / abs(float(f.detach())) for std, f in zip(stds, focal, strict=True))

    @cached_property
    def zones(self) -> list[Zone]:
        """Nine, by rows."""
        result = []
        bands, parts = (torch.arange(count, device="cpu").tensor_split(3) for count in self.shape)
        for (i, band), (j, part) in itertools.product(enumerate(bands), enumerate(parts)):
            here = self.uncertainty[band][:, part]
            known = here[~here.isnan()]
            name = " ".join(filter(None, (_ROWS[i], _COLUMNS[j]))) or "middle"
            share = float(self.covered[band][:, part].double().mean())
            result.append(Zone(name, share, len(known) / here.numel(), float(known.amax()) if len(known) else math.nan))
        return result

    @property
    def missing(self) -> list[Zone]:
        """Where there are few corners, and the lens is much less certain than in the middle or has no rays at all."""
        middle = self.zones[4].uncertainty
        limit = max(FINE, 3 * middle) if math.isfinite(middle) else FINE
        return [
            zone
            for zone in self.zones
            if zone.share < 0.5
            and (zone.uncertainty > limit or zone.rays < 0.5)
            and not (zone.rays < 0.5 and self.ends_in_the_dark)
        ]

    def good_within(self, limit: float, furthest: float = math.inf) -> tuple[float, float]:
        """The angle from the axis up to which projections are known to `limit` px, and the part of the image within it.

        furthest: radians, an angle beyond which they count as unknown.
        """
        known, angles = self.uncertainty.nan_to_num(torch.inf), self.angles
        bad = ~((known <= limit) & (angles <= furthest)) & ~angles.isnan()
        within = angles < torch.where(bad, angles, torch.inf).amin()
        return float(torch.where(within, angles, 0.0).amax()), float(within.double().mean())

    @cached_property
    def normals(self) -> Tensor | None:
        """(V, 3) of the boards, towards the camera; None if some are no planes."""
        weights = self.seen.to(self.points)[..., None]
        middle = (self.points * weights).sum(1, keepdim=True) / weights.sum(1, keepdim=True).clamp(min=1)
        _, sizes, axes = torch.linalg.svd((self.points - middle) * weights, full_matrices=False)
        used = self.seen.any(-1)
        if not bool(used.any()) or bool((sizes[used, 2] > 1e-3 * sizes[used, 1]).any()):
            return None
        normals = axes[used, 2]
        return torch.where((normals * middle[used, 0]).sum(-1, keepdim=True) > 0, -normals, normals)

    @cached_property
    def tilt(self) -> float:
        """Radians, the largest angle between two boards; infinite if some are no planes."""
        if self.normals is None:
            return math.inf
        return float(torch.acos((self.normals @ self.normals.mT).clamp(-1, 1)).amax())

    @cached_property
    def view_rms(self) -> Tensor:
        """(V,) px per point; NaN where nothing was seen."""
        squares = self.calibration.point_residuals.square().sum(-1) * self.seen
        return (squares.sum(-1) / self.seen.sum(-1)).sqrt()

    @cached_property
    def gains(self) -> tuple[tuple[float, float, float], tuple[int, float] | None]:
        """What more parameters would gain, by the linear problem: parts of the sum of squares.

        Of the board's bend: the two numbers, and its gain, 0 where it learned or does not apply. Of more coefficients:
        how many in all, and their gain; None where the model takes no more.
        """
        calibration, adjusted = self.calibration, self.calibration.adjusted
        none = (0.0, 0.0, 0.0), None
        state, cost = adjusted.state, float(adjusted.cost[0])
        if len(state.parameters) > 1 or not cost > 0 or not self.learns.any():
            return none
        points, seen = calibration.observations.points, self.seen
        ends = torch.stack((points[seen].amin(0), points[seen].amax(0)))
        points = torch.where(seen[..., None], points - ends.mean(0), 0.0)
        model = calibration.spread.model
        sight = Sight(model, points[None], calibration.observations.pixels[None], adjusted.weights[0])
        bend = none[0]
        if not any(calibration.bend) and self.normals is not None and float(points.abs().amax((0, 1))[2]) == 0:
            free = Free((self.learns,), (False,), bend=True)
            step, gain = _more(Bundle([sight], state, free, None, 1.0), state, 2)
            bend = (*step.tolist(), gain / cost)
        count = len(self.parameters) - 4
        names = model.names_of(count)
        counts = [n for n in (*model.fit_counts, count + 1, count + 2, count + 3, count + 4) if n > count]
        longer = ((n, model.names_of(n) or ()) for n in counts)
        more = next((n for n, its in longer if its and its[:count] == names and not any(model.ideal(n)[count:])), None)
        if more is None or not bool(self.learns[4:].all()):
            return bend, None
        free = Free((torch.cat((self.learns, self.learns.new_ones(more - count))),), (False,))
        ideal = self.parameters.new_tensor(model.ideal(more))[count:]
        wider = state._replace(parameters=(torch.cat((state.parameters[0], ideal[None]), -1),))
        _, gain = _more(Bundle([sight], wider, free, None, 1.0), wider, more - count)
        return bend, (more, gain / cost)

    @property
    def pattern_share(self) -> float:
        """The part of the residuals' size that is a mean over a part of the image, 0 where chance may have done it."""
        use = self.calibration.point_inliers
        residuals, pixels = self.calibration.point_residuals[use], self.calibration.observations.pixels[use]
        side = max(self.calibration.image_size) / _PATTERN
        rows, columns = (math.ceil(length / side) for length in self.calibration.image_size)
        place = ((pixels + 0.5) / side).long().clamp(min=0)
        cell = place[:, 1].clamp(max=rows - 1) * columns + place[:, 0].clamp(max=columns - 1)
        sums = residuals.new_zeros(rows * columns, 2).index_add_(0, cell, residuals)
        counts = cell.bincount(minlength=rows * columns)
        here = counts > 0
        variance = float(residuals.square().mean()) if len(residuals) else 0.0
        if variance == 0:
            return 0.0
        squares = float((sums[here].square().sum(-1) / counts[here]).sum() / variance)
        free = 2 * int(here.sum())
        if squares - free < _CERTAIN * math.sqrt(2 * free):
            return 0.0
        return math.sqrt((squares - free) / (2 * len(residuals)))

    @cached_property
    def learns(self) -> Tensor:
        """(4 + n,) bool: which parameters were free."""
        mine = [i for c, i in self.calibration.adjusted.equations.columns if c == self.calibration.index]
        learns = torch.zeros(len(self.parameters), dtype=torch.bool, device=self.parameters.device)
        learns[[i for i in mine if i < len(learns)]] = True
        return learns


def _more(bundle: Bundle, state: State, count: int) -> tuple[Tensor, float]:
    """The step of the last unknowns, and how much the sum of squares would fall by them, were the problem linear."""
    shared = bundle.equations(bundle.flat(state)).shared[0, :-1]
    triangle, right = shared[-count:, -count - 1 : -1], shared[-count:, -1]
    scale = torch.linalg.vector_norm(shared[:, -count - 1 : -1], dim=0).clamp(min=torch.finfo(shared.dtype).tiny)
    if bool((triangle.diagonal().abs() < 1e-9 * scale).any()):
        return torch.zeros_like(right), 0.0
    step = -torch.linalg.solve_triangular(triangle, right[:, None], upper=True)[:, 0]
    return step, float(right.square().sum())


# -- sentences


@torch.no_grad()
def warnings(calibration: Calibration) -> list[str]:
    """What the data do not carry, and what does not fit: each with what to do. Empty where all is well."""
    survey = Survey(calibration)
    finders = (_search, _noise, _outliers, _bad_views, _views, _loose, _twins, _coverage, _angles, _pattern, _needless)
    return [text for find in finders for text in find(survey)]


def _search(survey: Survey) -> Iterator[str]:
    found = survey.calibration
    if lost := found.lost:
        yield (
            f"{lost} corners have no pixel in this camera, which ends before them: do not use it. "
            "A surface has to reach further: give a wider grid"
        )
    if not bool(found.adjusted.converged[0]):
        held = found.adjusted.held_by
        by = f", held by {held} corners at the end of what the camera shows, lost by another step" if held else ""
        yield (
            f"The search did not end at an optimum{by}: do not use this camera. See whether the board's size, the "
            "image size and the model are right, try another model first, or give start=a camera"
        )


def _noise(survey: Survey) -> Iterator[str]:
    sigma = survey.calibration.sigma
    if sigma > _CORNER_NOISE * max(1.0, max(survey.calibration.image_size) / 2000):
        yield (
            f"What is left is {_px(sigma)} per coordinate, far more than corners are wrong by: the board may be bent "
            "or not as described, images out of focus or smeared, or the model not that of the lens"
        )


def _outliers(survey: Survey) -> Iterator[str]:
    calibration, seen = survey.calibration, survey.seen
    inliers = calibration.point_inliers
    bad = seen & ~inliers
    per_view, count = bad.sum(-1), int(bad.sum())
    lengths = torch.linalg.vector_norm(calibration.point_residuals, dim=-1)
    usual = math.sqrt(float(lengths[inliers].square().mean()) / 2) if bool(inliers.any()) else 0.0
    # of the lengths of normal errors so many are beyond three standard deviations, and none beyond six
    if count > 3 + 2 * math.exp(-4.5) * int(seen.sum()) or bool((lengths[bad] > 6 * usual).any()):
        most = int(per_view.argmax())
        robust = "" if calibration.loss else ': loss="huber" keeps them from pulling'
        yield (
            f"{count} of {int(seen.sum())} corners are outliers, {int(per_view[most])} of them in view "
            f"{calibration.views[most]}{robust}. Look at the views"
        )
    (lost,) = (per_view > _MOST_OF_A_VIEW * seen.sum(-1)).nonzero(as_tuple=True)
    if len(lost) and calibration.loss:
        yield (
            f"Nearly all corners of {_numbered(survey, lost)} are outliers, as where they are numbered in another "
            "order. Leave such views out: they make all parameters look less certain"
        )


def _bad_views(survey: Survey) -> Iterator[str]:
    rms = survey.view_rms
    usual = float(rms[~rms.isnan()].median())
    (bad,) = (rms > max(_WORSE_VIEW * usual, survey.rounding)).nonzero(as_tuple=True)
    if len(bad) and len(rms) >= _FEW_VIEWS:
        yield (
            f"Worse than the others fit {_numbered(survey, bad)}, up to {_px(float(rms[bad].amax()))} where "
            f"{_px(usual)} is usual: look at their corners, or leave them out"
        )


def _views(survey: Survey) -> Iterator[str]:
    calibration = survey.calibration
    if calibration.copies:
        yield (
            f"Another view is shown again by {named(calibration.copies)}, as a copy of a file does: they count once. "
            "Take new photographs instead"
        )
    copies = [calibration.views.index(view) for view in calibration.copies if view in calibration.views]
    count = int(survey.seen.any(-1).sum()) - int(survey.seen[copies].any(-1).sum())
    if count < _FEW_VIEWS:
        yield f"Few views ({count}): a bad one has nothing to be told by. Take 10 to 20. {_TILTED}"


def _loose(survey: Survey) -> Iterator[str]:
    loose = survey.loose_focal
    if loose > _LOOSE_FOCAL:
        why = "Take views in which the board is near and tilted, and fills the image"
        if len(survey.seen) > 1 and survey.tilt < _ALIKE:
            why = f"All boards are parallel to within {_degrees(survey.tilt)}. {_TILTED}"
        yield f"The focal length is known to {_percent(loose)} only. {why}"
    std = max(survey.calibration.std[2:4].tolist())
    if std > _LOOSE_CENTRE * max(survey.calibration.image_size):
        yield (
            f"The principal point is known to {_px(std)} only. {_TILTED}, or hold it in the middle with "
            'fixed=("cx", "cy")'
        )


def _twins(survey: Survey) -> Iterator[str]:
    calibration = survey.calibration
    if calibration.twins:
        names = [0, *range(4, len(calibration.parameter_names))]
        found, *others = (
            ", ".join(f"{calibration.parameter_names[i]} {values[i]:.4g}" for i in names)
            for values in (survey.parameters.tolist(), *calibration.twins)
        )
        yield (
            "The parameters are not known, though projections are where corners were seen. As well as "
            f"{found} fit {'; '.join(others)}. Compare no parameters, or take eucm or kannala_brandt"
        )


def _coverage(survey: Survey) -> Iterator[str]:
    if missing := survey.missing:
        yield f"Few corners or none in {_places(missing)} of the image. Hold the board there, near to the edges"


def _angles(survey: Survey) -> Iterator[str]:
    reach, end = survey.reach, survey.image_reach
    lost = float((~survey.rays[1]).double().mean())
    if lost > 0.001 and not survey.ends_in_the_dark:
        yield (
            f"The fitted lens ends inside the image: {_percent(lost)} of the pixels have no ray, beyond {_degrees(end)}"
            f" from the axis, where corners reach {_degrees(reach)}. Take views with corners further out, or a model "
            "with fewer coefficients or of a wider lens"
        )
    if end > reach + _BEYOND and survey.good_within(ROUGH)[0] < end:
        yield (
            f"Corners reach {_degrees(reach)} from the axis, and the image {_degrees(end)}: beyond what was seen the "
            "lens is a guess. Hold the board nearer to the corners of the image"
        )


def _pattern(survey: Survey) -> Iterator[str]:
    calibration = survey.calibration
    if calibration.rms <= survey.rounding:
        return
    bend, more = survey.gains
    share = survey.pattern_share
    least = max(_GAIN, (_CERTAIN * calibration.sigma) ** 2 / max(float(calibration.adjusted.cost[0]), 1e-300))
    if bend[2] > least and share < 2 * _PATTERN_SHARE and len(survey.seen) >= _FEW_VIEWS:
        points = calibration.observations.points[survey.seen]
        sides = (points.amax(0) - points.amin(0))[:2].tolist()
        x, y = (_percent(abs(value) / side) for value, side in zip(bend[:2], sides, strict=True))
        yield (
            f"The board seems to be bent, by {x} of its length along its x and {y} along its y: the squares of the "
            f"residuals would fall by {_percent(bend[2])}. bend=True finds its shape; a stiff board is better"
        )
    if more is not None and more[1] > max(least, _PATTERN_SHARE * share):
        yield (
            f"The model does not quite fit: with count={more[0]} coefficients the squares of the residuals would fall "
            f"by {_percent(more[1])}"
        )
    elif share > _PATTERN_SHARE:
        yield (
            f"The residuals have a pattern over the image, of {_px(share * calibration.rms)}: the model is not that of "
            "the lens, or the board is not as described. Try brown_conrady, kannala_brandt or fisheye624, or bend=True"
        )


def _needless(survey: Survey) -> Iterator[str]:
    calibration = survey.calibration
    names = calibration.parameter_names[4:]
    ideal = calibration.spread.model.ideal(len(names))
    values = survey.parameters[4:]
    std, covariance = calibration.std[4:], calibration.covariance[4:, 4:]
    series: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if not ideal[i] and name[-1].isdigit():  # else it is no term of a series
            series.setdefault(name.rstrip("0123456789"), []).append(i)
    taken: list[int] = []
    for members in series.values():
        # the last terms of a series; together coefficients may say what each alone does not
        for i in reversed(members):
            some = [*taken, i]
            scale = std[some]
            if float(scale[-1]) == 0:
                continue
            correlation = covariance[some][:, some] / scale[:, None] / scale
            scaled = (values[some] / scale)[:, None]
            square = float((scaled.mT @ torch.linalg.pinv(correlation, hermitian=True) @ scaled)[0, 0])
            if square > len(some) + 2 * math.sqrt(2 * len(some)):
                break
            taken = some
    if taken:
        found = [names[i] for i in sorted(taken)]
        yield (
            f"{_listed(found)} cannot be told from zero, and the data do not need that: {_fixed(found)} makes the rest "
            "more certain"
        )


@torch.no_grad()
def verdict(calibration: Calibration) -> str:
    """One paragraph: what the camera is good for, up to which angle, and what to photograph next."""
    survey = Survey(calibration)
    if not calibration.converged:
        return next(_search(survey)) + "."
    middle = survey.zones[4].uncertainty
    # what the model makes of rays that no corner was near is not told by the noise
    fine, fine_share = survey.good_within(FINE, survey.reach + _BEYOND)
    rough, rough_share = survey.good_within(ROUGH)
    noise = "one standard deviation in the worst direction"
    if fine_share > 0:
        there = float(survey.uncertainty[survey.angles <= fine].amax())
        good = (
            f"Good for measuring up to {_degrees(fine)} from the optical axis, {_percent(fine_share)} of the image: "
            f"projections are known to {_px(middle)} in the middle and to {_px(there)} at worst ({noise})."
        )
    else:
        good = f"Not for measuring: projections are known to {_px(middle)} in the middle ({noise})."
    if rough_share > fine_share:
        good += f" Good for looking at up to {_degrees(rough)}, {_percent(rough_share)} of the image."
    reach = f"Corners were seen up to {_degrees(survey.reach)}; the image goes to {_degrees(survey.image_reach)}."
    return f"{good} {reach} {_next(survey)}"


def _next(survey: Survey) -> str:
    """What to photograph next."""
    middle = survey.zones[4].uncertainty
    loose = [zone for zone in survey.zones if zone.rays >= 0.5 and zone.uncertainty > max(FINE, 2 * middle)]
    wanted = survey.missing or sorted(loose, key=lambda zone: -zone.uncertainty)[:3]
    tilt = f" {_TILTED}." if survey.tilt < _ALIKE else ""
    if wanted:
        return (
            f"Next, hold the board in {_places(wanted)} of the image, so near that its corners reach the edges.{tilt}"
        )
    if tilt:
        return f"Next:{tilt}"
    if middle > FINE:
        return "Next, take more views, near and tilted: four times as many halve the uncertainty."
    return "It needs no more views; four times as many would halve the uncertainty."


@torch.inference_mode()
def check_determined(
    adjusted: Adjusted, camera: int, found: Spread, names: Sequence[str], sight: Sight, owner: str
) -> None:
    """Refuse a problem in which the views of a camera leave it open, as those of boards that are all parallel do.

    It is open where corners that are wrong by a tenth of a pixel leave the projections of what was seen uncertain by a
    fiftieth of the extent of the corners: a matter of where the boards were, which corners without noise cannot hide.
    Several views that no camera fits are wrong, not open, and what warnings are for. found: of noise of 1 px.

    Raises:
        ValueError: it is open, with what to do.
    """
    found = found.scaled(adjusted.cost.new_full((1,), _USUAL_NOISE))
    seen = sight.weights[0] > 0
    views = int(seen.any(-1).sum())
    misfit = torch.linalg.vector_norm(adjusted.residuals[camera][0], dim=-1)[seen].median()
    if views > 1 and float(misfit) > _MISFIT:
        return
    pixels = sight.pixels[0][seen]
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
    what = "a single view of this board leaves" if views == 1 else f"these {views} views leave"
    why = "" if views == 1 else ", as boards that are all nearly parallel do"
    raise ValueError(
        f"{owner}: {what} {_listed(open_ones or free)} undetermined{why}. Take 10 to 20 views. {_TILTED}, or hold "
        f"parameters: {_fixed(hold)}"
    )


# -- words


def _numbered(survey: Survey, rows: Tensor) -> str:
    return named([survey.calibration.views[i] for i in rows.tolist()])


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _places(zones: Sequence[Zone]) -> str:
    return _listed([f"the {zone.name}" for zone in zones])


def _fixed(names: Sequence[str]) -> str:
    """The argument, as one writes it."""
    quoted = ", ".join(f'"{name}"' for name in names)
    return f"fixed=({quoted}{',' * (len(names) == 1)})"


def _px(value: float) -> str:
    return f"{value:.0f} px" if 99.5 <= value < 1e6 else f"{value:.2g} px"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share > 0.095 else f"{100 * share:.2g} %"


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):.0f} degrees"
