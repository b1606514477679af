"""The start of a calibration without a known camera: an approximate lens, found by the poses of the boards."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from camtorch.calibration.board_poses import (
    LEAST_SCALE,
    Lens,
    choose_poses,
    closed_form_poses,
    pixel_errors,
    poses_for,
    without_outliers,
)
from camtorch.calibration.bundle import CameraObservations, Free, Poses, State, adjust
from camtorch.calibration.model import Model
from camtorch.calibration.observations import Observations
from camtorch.calibration.robust import Loss
from camtorch.cameras.camera import Camera
from camtorch.cameras.operators import fixed_camera
from camtorch.convert import fitting, views
from camtorch.models import UCM, KannalaBrandt
from camtorch.rays.lattices import angles_from_axis

# The lenses tried: alpha of a unified camera (0 is perspective, 1/2 stereographic, 0.65 nearly equidistant or
# equisolid), and the angle from the axis, in degrees, of the seen pixel that is furthest from the middle
_TRIED = {
    0.0: (4.0, 7.0, 12.0, 18.0, 27.0, 38.0, 51.0, 66.0),
    0.5: (12.0, 26.0, 44.0, 64.0, 84.0, 106.0),
    0.65: (14.0, 28.0, 46.0, 66.0, 88.0),
}
_VIEWS, _POINTS = 24, 100  # at most, in a search
_TRIMMED = 0.8  # the part of the views, those with the least errors, that rank a lens
_LEAST_SLOPE = 1e-3  # the least slope of a lens at the axis when a search starts
_WORSE, _LITTLE_WORSE = 2.0, 1.01  # times the least cost: cameras above it are dropped
_ALIKE = 1e-3  # the relative difference below which two starts are one
_STEPS, _MANY_STEPS = 12, 40
_NEARLY = 1.0  # like `SETTLED`, for a lens from which another fit starts
# Coefficients along which the cost has a valley with several minima, and the values to start from
_ALONG = {
    "double_sphere": ("xi", (-0.3, 0.0, 0.3, 0.7)),
    "eucm": ("beta", (0.5, 1.0, 2.0)),
    "mei": ("xi", (0.0, 1.0, 2.0, 4.0)),
}
# Numbers of coefficients of further starts: with all of them a lens may fold just beyond the corners, and no step
# crosses a fold
_LOW_ORDERS = (1, 4)
_REACH = 1.1  # how much further than the corners a start reaches
_ERRS = 1.5  # times the unified lens' scale: above it the model does not fit
_LOST = 0.01  # the part of the corners without a pixel above which a model is wrong


def start_from_nothing(observations: Observations, asked: Model, loss: Loss) -> State:
    """Return a camera of the model, B = 1, and the poses of all views, from which an adjustment reaches the optimum.

    Unified cameras of many widths are ranked by the errors of the poses that their rays give in closed form. The best
    few are refined with a Cauchy loss, and the model is fitted to the best one from several starts. Fixed parameters
    are held: coefficients as in `Camera.ideal`, the principal point in the middle of the image.
    """
    few, free = _subsample(observations, asked), _free_parameters(asked)
    unified = _find_unified(few, asked)
    lens = _fit_model(_in_good_shape(unified, few, asked), few, asked)
    if few is not observations or len(lens.parameters) > 1 or bool(lens.lost(few).any()):
        lens = _refine(lens, few, free, loss)
        _check_pixels(lens.best, few, unified.scale)
    state = lens.best.state if few is observations else poses_for(lens.best, observations)
    if len(lens.parameters) == 1:
        return state
    lens = lens._replace(boards=state.boards.expand(len(lens.parameters)))
    observed = CameraObservations.of_one(asked.kind, observations)
    found = adjust([observed], lens.state, free, loss=loss, steps=_MANY_STEPS)
    return found.state.of(found.cost.argmin()[None])


def _in_good_shape(lens: Lens, few: Observations, asked: Model) -> Lens:
    """Return the lens, for models that keep their start's shape a better one: Kannala and Brandt's."""
    if not asked.count or any(asked.kind.fit_bounds.get(name, ()) is not None for name in asked.names[4:]):
        return lens
    good = replace(asked, kind=KannalaBrandt, count=4)
    fitted = _fit_model(lens, few, good)
    return _refine(fitted, few, _free_parameters(good), Loss("cauchy", lens.scale)).best


def _check_pixels(lens: Lens, few: Observations, scale: float) -> None:
    """Raise if a camera has no pixels for corners, or for many of them if it fits as well as a lens of that scale."""
    lost, seen = int(lens.lost(few).sum()), int(few.seen.sum())
    if lost > (_LOST * seen if lens.scale <= _ERRS * scale else 0):
        raise ValueError(
            f"calibrate: model must have pixels for all corners; got {lens.model.__name__}, without {lost} of {seen}"
            ". Use a fisheye, such as kannala_brandt"
        )


def other_cameras(lens: Lens, asked: Model, observations: Observations) -> Tensor | None:
    """Return cameras (S, 4 + n) fitted from starts along the model's valley, see `_ALONG`, or None if it has none."""
    if asked.kind.key not in _ALONG or _ALONG[asked.kind.key][0] in asked.fixed:
        return None
    found = _fit_model(lens, observations, asked).parameters
    return torch.where(asked.free.to(found.device), found, lens.parameters)


def _free_parameters(asked: Model) -> Free:
    """Return the parameters that learn: all except those that are fixed, or that the model keeps."""
    kept = torch.tensor([asked.kind.fit_bounds.get(name, ()) is None for name in asked.names], device="cpu")
    return Free((asked.free & ~kept,))


def _subsample(observations: Observations, asked: Model) -> Observations:
    """Return the views with most corners, and enough corners of each, evenly from the image's middle outwards."""
    if len(observations.seen) > _VIEWS:
        observations = observations.of(observations.seen.sum(-1).argsort(descending=True)[:_VIEWS].sort().values)
    points, pixels, seen = observations.points, observations.pixels, observations.seen
    if seen.shape[1] <= _POINTS:
        return observations
    distances = torch.linalg.vector_norm(pixels - _middle(asked, pixels), dim=-1)
    order = torch.where(seen, distances, torch.inf).argsort(-1)
    share = torch.linspace(0, 1, _POINTS, dtype=pixels.dtype, device=pixels.device)
    index = order.gather(-1, (share * (seen.sum(-1, keepdim=True) - 1).clamp(min=0)).round().long())
    once = torch.nn.functional.pad(index.diff(dim=-1) != 0, (1, 0), value=True)
    points, pixels = (torch.take_along_dim(t, index[..., None], 1) for t in (points, pixels))
    return observations._replace(points=points, pixels=pixels, seen=seen.gather(-1, index) & once)


def _middle(asked: Model, like: Tensor) -> Tensor:
    """Return the middle (2,) of the image."""
    assert asked.image_size is not None  # of a calibration it is known
    height, width = asked.image_size
    return like.new_tensor([(width - 1) / 2, (height - 1) / 2])


def _find_unified(few: Observations, asked: Model) -> Lens:
    """Return the best of many unified lenses, adjusted, with the best pose of each view."""
    lens = _unified_to_try(few, asked)
    lens, errors = _ranked(lens, *closed_form_poses(lens.camera, few), len(lens.parameters), 4.0)
    lens, _ = _ranked(lens, *without_outliers(lens.camera, few, lens.boards, errors), 3, 2.0)
    free = _free_parameters(Model(UCM, 1, fixed=tuple(name for name in asked.fixed if name in ("cx", "cy"))))
    lens = lens.adjusted(few, free, _STEPS, _WORSE, Loss("cauchy", lens.scale), _NEARLY).best
    return choose_poses(lens, few, pixel_errors(lens.camera, lens.boards, few))


def _unified_to_try(few: Observations, asked: Model) -> Lens:
    """Return the lenses of `_TRIED`, without poses."""
    centre = _middle(asked, few.pixels)
    reach = torch.where(few.seen, torch.linalg.vector_norm(few.pixels - centre, dim=-1), 0.0).amax()
    tried = [(alpha, math.radians(degrees)) for alpha, angles in _TRIED.items() for degrees in angles]
    radii = [math.sin(theta) / (alpha + (1 - alpha) * math.cos(theta)) for alpha, theta in tried]
    focal = reach / centre.new_tensor(radii)[:, None]
    alpha = centre.new_tensor([alpha for alpha, _ in tried])[:, None]
    parameters = torch.cat((focal, focal, centre.expand(len(tried), 2), alpha), -1)
    return Lens(UCM, parameters, Poses.none(1, 1, parameters))


def _ranked(lens: Lens, boards: Poses, errors: Tensor, most: int, unlike: float) -> tuple[Lens, Tensor]:
    """Return the best lenses with these poses and their errors: `most`, up to `unlike` times the best one's error."""
    by_view = errors.nanmedian(-1).values.sort(-1).values
    score = by_view[:, : math.ceil(_TRIMMED * by_view.shape[1])].mean(-1)
    score, rows = score.topk(min(most, len(score)), largest=False)
    rows = rows[score <= unlike * score[0]]
    lens = lens._replace(boards=boards, scale=max(LEAST_SCALE, 2 * float(score[0])))
    return lens.of(rows), errors[rows]


def _refine(lens: Lens, few: Observations, free: Free, loss: Loss) -> Lens:
    """Refine the cameras by a few steps, drop all but the nearly best, and refine the rest; the best comes first."""
    lens = lens.adjusted(few, free, _STEPS, _WORSE, loss)
    return lens if len(lens.parameters) == 1 else lens.adjusted(few, free, _MANY_STEPS, _LITTLE_WORSE, loss)


def _fit_model(lens: Lens, few: Observations, asked: Model) -> Lens:
    """Fit cameras (S,) of another model to the corners, with the boards held."""
    model, camera = asked.kind, lens.camera
    slopes = views.focal_at_axis(camera)
    rays = torch.nn.functional.normalize(lens.boards.moved(few.points), dim=-1)
    inliers = few.seen & (pixel_errors(camera, lens.boards, few) < 3 * lens.scale)
    ideal = slopes.new_tensor(model.ideal(asked.count))
    starts = ideal[None]
    if asked.count:
        reach = torch.where(inliers, angles_from_axis(rays), 0.0).amax((-1, -2))
        by_radii = views.radii(camera, slopes, (_REACH * reach).clamp(max=math.pi))
        starts = model.fit_start(asked.names[4:], *by_radii)[:, 0]
    begun, held = _coefficients_to_try(asked, starts, ideal)
    seen = fitting.RayPixels(rays.flatten(1, 2), few.pixels.flatten(0, 1)[None], inliers.flatten(1).double())
    seen = fitting.RayPixels(*(t.expand(len(begun), *t.shape[1:]) for t in seen))
    parameters = _with_focal_lengths(model, begun, slopes)
    _, valid = fixed_camera(model, parameters[:, :4], begun).project(seen.rays)
    if model.key in _ALONG or not bool((valid | (seen.weights == 0)).all()):
        template = fixed_camera(model, slopes, ideal[None])
        parameters = fitting.fit(template, seen, begun[None], slopes.expand(len(begun), -1), fixed=held)
    parameters = _without_doubles(parameters)
    for i, name in enumerate(("cx", "cy")):
        if name in asked.fixed:
            parameters[:, 2 + i] = _middle(asked, parameters)[i]
    return lens._replace(model=model, parameters=parameters, boards=lens.boards.expand(len(parameters)))


def _with_focal_lengths(model: type[Camera], coefficients: Tensor, slopes: Tensor) -> Tensor:
    """Return parameters (S, 4 + n) with such slopes (1, 4) at the axis; coefficients: (S, n)."""
    slopes = slopes.expand(len(coefficients), -1)
    ones = slopes.new_tensor([1.0, 1.0, 0.0, 0.0]).expand_as(slopes)
    own = views.focal_at_axis(fixed_camera(model, ones, coefficients))[:, :2].clamp(min=_LEAST_SLOPE)
    return torch.cat((slopes[:, :2] / own, slopes[:, 2:], coefficients), -1)


def _without_doubles(parameters: Tensor) -> Tensor:
    """Return the cameras (S, 4 + n) that do not nearly equal an earlier one."""
    apart = (parameters[:, None] - parameters).abs() > _ALIKE * (parameters.abs() + _ALIKE)
    return parameters[~(~apart.any(-1)).tril(-1).any(-1)]


def _coefficients_to_try(asked: Model, starts: Tensor, ideal: Tensor) -> tuple[Tensor, Tensor]:
    """Return coefficients (S, n) to start from, and (S, 4 + n) the values of those that are held, NaN for others."""
    names, model = asked.names[4:], asked.kind
    is_fixed = torch.tensor([name in asked.fixed for name in names], dtype=torch.bool, device=starts.device)
    starts = torch.where(is_fixed, ideal, starts)
    sets = [(starts, is_fixed)]
    order = torch.arange(len(names), device=starts.device)
    if model.key not in _ALONG:
        sets += [(starts[:1], is_fixed | (order >= low)) for low in _LOW_ORDERS if len(names) > low]
    elif _ALONG[model.key][0] not in asked.fixed:
        along, values = _ALONG[model.key]
        more = starts[:1].repeat(len(values), 1)
        more[:, names.index(along)] = more.new_tensor(values)
        sets.append((more, is_fixed | (order == names.index(along))))
    begun = torch.cat([some for some, _ in sets])
    held = torch.cat([torch.where(stays, some, torch.nan) for some, stays in sets])
    return begun, torch.nn.functional.pad(held, (4, 0), value=torch.nan)
