"""The start of a calibration without a known camera: an approximate lens, and the poses of the boards."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.calibration.bundle import SETTLED, Adjusted, CameraObservations, Free, Poses, Prior, State, adjust, minima
from camtorch.calibration.model import Model
from camtorch.calibration.observations import Observations
from camtorch.calibration.rays import poses_from_rays
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
_ROUNDS = 3  # of finding poses again without outliers
_BAD = 2.0  # times the usual error: the pose of such a view may be wrong
_IN_DOUBT = 4.0  # times the better pose's error: below it the other pose is refined as well
_HANDFULS, _HANDFUL = 48, 6  # samples, and corners of each, if outliers spoil the pose of all corners
_CHANGED = 0.9  # of a view's error in the round before: below it another round follows
_TRIMMED = 0.8  # the part of the views, those with the least errors, that rank a lens
_LEAST_SCALE = 0.5  # px, the least scale of robust weights
_NO_PIXEL = 1e3  # px, the error of a corner without a pixel
_LEAST_SLOPE = 1e-3  # the least slope of a lens at the axis when a search starts
_WORSE, _LITTLE_WORSE = 2.0, 1.01  # times the least cost: cameras above it are dropped
_ALIKE = 1e-3  # the relative difference below which two starts are one
_SAME = 1e-7  # the relative difference below which two costs are of one optimum
_FEW_STEPS, _STEPS, _MANY_STEPS = 6, 12, 40
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
_OTHER = 0.05  # radians, or part of the distance: poses further apart are two minima
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
    found = adjust([as_seen(asked.kind, observations)], lens.state, free, loss=loss, steps=_MANY_STEPS)
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


def poses_for(lens: Lens, observations: Observations) -> State:
    """Return the state of a known camera, B = 1, and all views' poses, whatever poses the lens has."""
    camera = lens.camera
    boards, errors = _without_outliers(camera, observations, *_closed_form(camera, observations))
    return _choose_poses(lens._replace(boards=boards), observations, errors).state


def other_poses(found: Adjusted, observations: Observations, model: type[Camera]) -> State | None:
    """Return the state of an optimum, B = 1, with better poses for views that have them; None if none has."""
    state = found.state
    lens = Lens(model, state.parameters[0], state.boards)
    errors = _lengths(found.residuals[0], found.valid[0], observations.seen)[0]
    # views with greater errors than many others are doubted
    rows = errors.nanmedian(-1).values.argsort(descending=True)[:50]
    boards = state.boards.of(rows, 1)
    lens = lens._replace(boards=boards, scale=max(_LEAST_SCALE, 2 * float(errors.nanmedian())))
    with torch.inference_mode():
        others = _choose_poses(lens, observations.of(rows), errors[None, rows]).boards
    cosine = ((boards.rotations * others.rotations).sum((-1, -2)) - 1) / 2
    shift = torch.linalg.vector_norm(others.translations - boards.translations, dim=-1)
    is_other = (cosine < math.cos(_OTHER)) | (shift > _OTHER * torch.linalg.vector_norm(boards.translations, dim=-1))
    if not bool(is_other.any()):
        return None
    return state._replace(boards=state.boards.with_views(rows, Poses.where(is_other[0], others, boards)))


def other_cameras(lens: Lens, asked: Model, observations: Observations) -> Tensor | None:
    """Return cameras (S, 4 + n) fitted from starts along the model's valley, see `_ALONG`, or None if it has none."""
    if asked.kind.key not in _ALONG or _ALONG[asked.kind.key][0] in asked.fixed:
        return None
    found = _fit_model(lens, observations, asked).parameters
    return torch.where(asked.free.to(found.device), found, lens.parameters)


class Lens(NamedTuple):
    """Cameras of a model, parameters (B, 4 + n), with poses (B, V) of the boards."""

    model: type[Camera]
    parameters: Tensor
    boards: Poses
    scale: float = _LEAST_SCALE  # px: twice the median error of corners, from which they count less

    @property
    def state(self) -> State:
        return State.of_one(self.parameters, self.boards)

    @property
    def camera(self) -> Camera:
        return fixed_camera(self.model, self.parameters[:, :4], self.parameters[:, 4:])

    def lost(self, some: Observations) -> Tensor:
        """Whether seen corners have no pixel, (B, V, N) bool."""
        _, valid = self.camera.project(self.boards.moved(some.points).flatten(1, 2))
        return some.seen & ~valid.view(-1, *some.seen.shape)

    def of(self, rows: Tensor | slice) -> Lens:
        return self._replace(parameters=self.parameters[rows], boards=self.boards.of(rows))

    @property
    def best(self) -> Lens:
        """The first camera of those that are sorted."""
        return self.of(slice(1))

    def adjusted(
        self, few: Observations, free: Free, steps: int, worst: float, loss: Loss, settled: float = SETTLED
    ) -> Lens:
        """Return adjusted cameras, the best first, without doubles and costs above `worst` times the least."""
        found = adjust([as_seen(self.model, few)], self.state, free, loss=loss, steps=steps, settled=settled)
        cost, rows = found.cost.sort()
        near = cost <= worst * cost[0]
        near[1:] &= cost.diff() > _SAME * cost[:-1]
        rows = rows[near]
        errors = torch.linalg.vector_norm(found.residuals[0][rows[0]], dim=-1)
        errors = torch.where(found.valid[0][rows[0]], errors, _NO_PIXEL)[few.seen]
        scale = max(_LEAST_SCALE, 2 * float(errors.median()))
        return self._replace(parameters=found.state.parameters[0], boards=found.state.boards, scale=scale).of(rows)


def as_seen(model: type[Camera], observations: Observations, prior: Prior | None = None) -> CameraObservations:
    """Return the observations of one camera, for one problem."""
    points, pixels, weights = observations.points, observations.pixels, observations.seen.to(observations.pixels)
    return CameraObservations(model, points[None], pixels[None], weights[None], prior)


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
    lens, errors = _ranked(lens, *_closed_form(lens.camera, few), len(lens.parameters), 4.0)
    lens, _ = _ranked(lens, *_without_outliers(lens.camera, few, lens.boards, errors), 3, 2.0)
    free = _free_parameters(Model(UCM, 1, fixed=tuple(name for name in asked.fixed if name in ("cx", "cy"))))
    lens = lens.adjusted(few, free, _STEPS, _WORSE, Loss("cauchy", lens.scale), _NEARLY).best
    return _choose_poses(lens, few, _errors(lens.camera, lens.boards, few))


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
    lens = lens._replace(boards=boards, scale=max(_LEAST_SCALE, 2 * float(score[0])))
    return lens.of(rows), errors[rows]


def _closed_form(camera: Camera, some: Observations) -> tuple[Poses, Tensor]:
    """Return closed-form poses (B, V) for cameras (B,), and errors (B, V, N) in px; NaN if a corner is unseen."""
    rays, has_ray = _rays(camera, some)
    points = some.points.expand_as(rays)
    found = poses_from_rays(*(t.flatten(0, 1) for t in (points, rays, has_ray.to(rays.dtype))))
    boards = Poses(*(t[:, 0].unflatten(0, has_ray.shape[:2]) for t in found[:2]))
    return boards, _errors(camera, boards, some)


def _without_outliers(camera: Camera, some: Observations, boards: Poses, errors: Tensor) -> tuple[Poses, Tensor]:
    """Return closed-form poses and their errors after rounds that weigh the outliers of the one before less."""
    rays, has_ray = _rays(camera, some)
    points = some.points.expand_as(rays).flatten(0, 1)
    usual = errors.nanmedian(-1).values.clamp(min=_LEAST_SCALE / 2)
    is_better = torch.ones_like(usual, dtype=torch.bool)
    for _ in range(_ROUNDS):
        (rows,) = is_better.flatten().nonzero(as_tuple=True)
        if len(rows) == 0:
            break
        weights = 1 / (1 + (errors / (2 * usual[..., None])).square())
        weights = torch.where(has_ray, weights, 0.0).flatten(0, 1)
        found = poses_from_rays(points[rows], rays.flatten(0, 1)[rows], weights[rows])
        boards = Poses(
            *(
                old.flatten(0, 1).index_copy(0, rows, new[:, 0]).view_as(old)
                for old, new in zip(boards, found[:2], strict=True)
            )
        )
        errors, before = _errors(camera, boards, some), usual
        usual = errors.nanmedian(-1).values.clamp(min=_LEAST_SCALE / 2)
        is_better = usual < _CHANGED * before
    return boards, errors


def _resample_poses(camera: Camera, boards: Poses, some: Observations, errors: Tensor) -> tuple[Poses, Tensor]:
    """Return the poses (1, V), by samples of corners for views spoilt by outliers, and the errors (1, V, N)."""
    usual = errors[0].nanmedian(-1).values
    (bad,) = (usual > _BAD * usual.median().clamp(min=_LEAST_SCALE)).nonzero(as_tuple=True)
    if len(bad) == 0:
        return boards, errors
    generator = torch.Generator("cpu").manual_seed(0)
    many = some.of(bad.repeat_interleave(_HANDFULS))
    rays, has_ray = (t[0] for t in _rays(camera, many))
    chances = torch.rand(has_ray.shape, generator=generator, device="cpu").to(rays.device).masked_fill(~has_ray, -1.0)
    least = chances.topk(min(_HANDFUL, has_ray.shape[1])).values[:, -1:]
    found = poses_from_rays(many.points, rays, (has_ray & (chances >= least)).to(rays.dtype))
    tried = Poses(found.rotations[None, :, 0], found.translations[None, :, 0])
    usual = torch.cat((_errors(camera, tried, many)[0].nanmedian(-1).values.view(-1, _HANDFULS), usual[bad, None]), 1)
    best = usual.argmin(-1)
    changed = best < _HANDFULS
    rows = (torch.arange(len(bad), device=bad.device) * _HANDFULS + best)[changed]
    boards = boards.with_views(bad[changed], tried.of(rows, 1))
    return boards, _errors(camera, boards, some)


def _rays(camera: Camera, some: Observations) -> tuple[Tensor, Tensor]:
    """Return rays (B, V, N, 3) of the pixels for cameras (B,), and whether seen corners have them, bool (B, V, N)."""
    rays, has_ray = camera.unproject(some.pixels.flatten(0, 1).expand(len(camera.intrinsics), -1, -1))
    shape = len(rays), *some.seen.shape
    return rays.view(*shape, 3), has_ray.view(shape) & some.seen


def _errors(camera: Camera, boards: Poses, some: Observations) -> Tensor:
    """Return errors (B, V, N) in px for B cameras, or one for all, NaN if a corner is unseen."""
    points = boards.moved(some.points)
    pixels, valid = camera.project(points.reshape(len(camera.intrinsics), -1, 3))
    return _lengths(pixels.view(*points.shape[:-1], 2) - some.pixels, valid.view(points.shape[:-1]), some.seen)


def _lengths(residuals: Tensor, valid: Tensor, seen: Tensor) -> Tensor:
    """Return lengths (B, V, N) in px, NaN if a corner is unseen."""
    # a norm along the last dim would be slow: components lie in planes
    return torch.where(seen, torch.where(valid, torch.hypot(*residuals.unbind(-1)), _NO_PIXEL), torch.nan)


def _choose_poses(lens: Lens, some: Observations, errors: Tensor) -> Lens:
    """Return a single camera with the best pose of each view: a plane has two similar ones; errors (1, V, N)."""
    camera = lens.camera
    old, errors = _resample_poses(camera, lens.boards, some, errors)
    rays, has_ray = (t[0] for t in _rays(camera, some))
    weights = torch.where(has_ray, 1 / (1 + (errors[0] / lens.scale).square()), 0.0)
    found = poses_from_rays(some.points, rays, weights)
    both = Poses(*(t.transpose(0, 1) for t in found[:2]))
    first, second = (both.of(slice(i, i + 1)) for i in range(2))
    usual, other, others = torch.cat((errors, _errors(camera, both, some))).nanmedian(-1).values
    first = Poses.where(usual <= other, old, first)
    (rows,) = (others <= _IN_DOUBT * torch.minimum(usual, other)).nonzero(as_tuple=True)
    if len(rows):
        first = first.with_views(rows, _better_minima(lens, some.of(rows), first.of(rows, 1), second.of(rows, 1)))
    return lens._replace(boards=first)


def _better_minima(lens: Lens, some: Observations, first: Poses, second: Poses) -> Poses:
    """Return for each view the better one of the minima near two poses, (1, V) each."""
    both = Poses(*(torch.cat(pair, 1).transpose(0, 1) for pair in zip(first, second, strict=True)))
    twice = Observations(*(torch.cat((t, t)) for t in some))
    found, costs = minima(lens.model, lens.parameters, both, twice, Loss("cauchy", lens.scale), _FEW_STEPS)
    one, other = (Poses(*pair) for pair in zip(*(t.transpose(0, 1).chunk(2, 1) for t in found), strict=True))
    cost, other_cost = costs.chunk(2)
    return Poses.where(cost <= other_cost, one, other)


def _refine(lens: Lens, few: Observations, free: Free, loss: Loss) -> Lens:
    """Refine the cameras by a few steps, drop all but the nearly best, and refine the rest; the best comes first."""
    lens = lens.adjusted(few, free, _STEPS, _WORSE, loss)
    return lens if len(lens.parameters) == 1 else lens.adjusted(few, free, _MANY_STEPS, _LITTLE_WORSE, loss)


def _fit_model(lens: Lens, few: Observations, asked: Model) -> Lens:
    """Fit cameras (S,) of another model to the corners, with the boards held."""
    model, camera = asked.kind, lens.camera
    slopes = views.focal_at_axis(camera)
    rays = torch.nn.functional.normalize(lens.boards.moved(few.points), dim=-1)
    inliers = few.seen & (_errors(camera, lens.boards, few) < 3 * lens.scale)
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
