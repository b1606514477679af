"""Cameras fitted to pixels of rays, by the Levenberg-Marquardt method, each row of a batch for itself."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from camtorch._arguments import columns
from camtorch.projection.rays import slopes_at_axis

if TYPE_CHECKING:
    from camtorch.camera import Camera

FURTHEST = 20.0
"""The furthest from the centre of a chart's plane that a fit looks: 87 degrees in perspective."""
_MOST_STEPS = 60
_ROUNDS = 3
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-14, 1e8
_LAWSON_ROUNDS, _LAWSON_STEPS, _PATIENCE = 40, 2, 6
_SETTLED = 1e-8  # the relative decrease of the cost that ends the search
_NOTHING, _NEARLY_NOTHING = 1e-11, 1e-9  # px
_LEAST_SLOPE = 1e-3  # of a lens at the axis, that a fit starts from
_LOST = 0.1  # the error, in focal lengths, that a ray without a pixel counts as, where alternatives are compared


class Observations(NamedTuple):
    """What a camera shall see: rays (C, N, 3), pixels (C, N, 2) and weights of the errors (C, N), 0 for no ray."""

    rays: Tensor
    pixels: Tensor
    weights: Tensor

    def of(self, rows: Tensor) -> Observations:
        """Those of some rows."""
        return Observations(*(t[rows] for t in self))


class SensorPoints(NamedTuple):
    """Planes (C, N): points on the plane of the sensor, the centre where there is none, and whether there is one."""

    a: Tensor
    b: Tensor
    covered: Tensor


def to_sensor(camera: Camera, k: Tensor, rays: Tensor) -> SensorPoints:
    """Rays through the chart and the lens of coefficients (C, n), whether or not they lie before a fold."""
    chart, lens = camera.optics(columns(k))
    x, y, z = rays.unbind(-1)
    covered = (chart.margin(x, y, z) > 0).expand_as(x)
    x, y, z = torch.where(covered, x, 0.0), torch.where(covered, y, 0.0), torch.where(covered, z, 1.0)
    a, b = chart.to_plane(x, y, z, order=1)
    covered = covered & (torch.maximum(a.abs(), b.abs()) <= FURTHEST)
    if lens.stages:
        a, b = lens(a, b)
    covered = covered & torch.isfinite(a) & torch.isfinite(b)
    return SensorPoints(torch.where(covered, a, 0.0), torch.where(covered, b, 0.0), covered)


def fit(camera: Camera, observations: Observations, starts: Tensor, slopes: Tensor) -> Tensor:
    """The parameters (C, 4 + n) at which a camera sees the pixels of the rays as nearly as it can.

    Rays that the camera's chart never covers do not count. No row depends on another.

    Args:
        camera: gives its optics, not its numbers.
        observations: what it shall see.
        starts: (S, C, n) coefficients to start from; of what becomes of them the best is kept.
        slopes: (C, 4) the focal lengths at the axis in x and y, and the pixel of the axis.
    """
    results, scores = [], []
    tiny = _NEARLY_NOTHING**2 * observations.weights.sum(-1)
    found = torch.zeros_like(tiny, dtype=torch.bool)
    for start in starts:
        focal = slopes[:, :2] / slopes_at_axis(camera.optics, start).clamp(min=_LEAST_SLOPE)
        parameters = torch.cat((focal, slopes[:, 2:], start), -1)
        low, high = _bounds(camera, parameters)
        parameters = parameters.clamp(low, high)
        within = observations._replace(weights=torch.zeros_like(observations.weights))
        for _ in range(_ROUNDS):
            # a chart may cover more once its coefficients fit what it covered before
            weights = observations.weights * to_sensor(camera, parameters[:, 4:], observations.rays).covered
            more = (weights != within.weights).any(-1) & ~found
            within = observations._replace(weights=weights)
            parameters = _refine(camera, within, parameters, low, high, more)
        score = _cost(camera, within, parameters)
        score = score + (observations.weights - within.weights).sum(-1) * (_LOST * slopes[:, :2].mean(-1)) ** 2
        found |= score <= tiny
        results.append(parameters)
        scores.append(score)
    best = torch.stack(scores).argmin(0)
    return torch.stack(results)[best, torch.arange(len(best), device=best.device)]


def refine_minimax(camera: Camera, observations: Observations, parameters: Tensor) -> Tensor:
    """Parameters (C, 4 + n) near those given at which the largest error is smaller; no row depends on another.

    Lawson's algorithm: weighted least squares over and over, the weight of a square multiplied by its error each time,
    approach what has the least largest error.
    """
    low, high = _bounds(camera, parameters)
    covered = observations.weights * to_sensor(camera, parameters[:, 4:], observations.rays).covered
    observations = observations._replace(weights=covered)
    best, weights = parameters, covered
    error = _distances(observations, camera, parameters)
    least, stale = error.amax(-1), torch.zeros_like(error[:, 0])
    for _ in range(_LAWSON_ROUNDS):
        going = stale < _PATIENCE
        if not bool(going.any()):
            break
        # of the error itself, the weight in a square is that of its root
        weights = weights * (error / error.amax(-1, keepdim=True).clamp(min=_NOTHING)).sqrt()
        weights = weights / weights.amax(-1, keepdim=True).clamp(min=1e-30)
        weighted = observations._replace(weights=weights)
        parameters = _refine(camera, weighted, parameters, low, high, going, _LAWSON_STEPS, _LEAST_DAMPING)
        error = _distances(observations, camera, parameters)
        better = going & (error.amax(-1) < least)
        best = torch.where(better[:, None], parameters, best)
        stale = torch.where(error.amax(-1) < 0.999 * least, 0.0, stale + 1)
        least = torch.where(better, error.amax(-1), least)
    return best


def _distances(observations: Observations, camera: Camera, parameters: Tensor) -> Tensor:
    """(C, N) pixels."""
    return torch.linalg.vector_norm(
        _residuals(observations, parameters, to_sensor(camera, parameters[:, 4:], observations.rays)), dim=1
    )


def _bounds(camera: Camera, parameters: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the greatest parameters (C, 4 + n); a focal length stays within a factor of 1000."""
    low, high = torch.full_like(parameters, -torch.inf), torch.full_like(parameters, torch.inf)
    low[:, :2], high[:, :2] = parameters[:, :2] * 1e-3, parameters[:, :2] * 1e3
    for i, name in enumerate(camera.distortion_names, 4):
        if name in camera.fit_bounds:
            low[:, i], high[:, i] = camera.fit_bounds[name] or (parameters[:, i], parameters[:, i])
    return low, high


def _residuals(observations: Observations, parameters: Tensor, seen: SensorPoints) -> Tensor:
    """(C, 2, N) pixels."""
    fx, fy, cx, cy = columns(parameters[:, :4])
    u, v = observations.pixels.unbind(-1)
    return torch.stack((fx * seen.a + cx - u, fy * seen.b + cy - v), 1) * observations.weights[:, None]


def _cost(camera: Camera, observations: Observations, parameters: Tensor) -> Tensor:
    """(C,) the sum of squares; infinite where a ray that counts is not covered, or the coefficients make no camera."""
    seen = to_sensor(camera, parameters[:, 4:], observations.rays)
    lost = (~seen.covered & (observations.weights > 0)).any(-1)
    cost = _residuals(observations, parameters, seen).square().sum((1, 2))
    defined = camera.defined(parameters[:, 4:].unbind(-1))
    if defined is not None:
        lost = lost | ~(defined > 0)
    return torch.where(lost | ~torch.isfinite(cost), torch.inf, cost)


def _linearised(camera: Camera, observations: Observations, parameters: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
    """The residuals (C, 2 N), and their derivatives (C, F, 2 N) by the parameters of indices (F,), 0 to 3 first."""
    k = parameters[:, 4:]
    seen = to_sensor(camera, k, observations.rays)
    fx, fy, _, _ = columns(parameters[:, :4])
    zero, one = torch.zeros_like(seen.a), torch.ones_like(seen.a)
    derivatives = [(seen.a, zero), (zero, seen.b), (one, zero), (zero, one)]
    slopes = torch.stack([torch.stack(pair, 1) for pair in derivatives], 1)
    if len(free) > 4:
        along = torch.eye(k.shape[-1], dtype=k.dtype, device=k.device)[free[4:] - 4]
        by_k = _derivatives(camera, k, observations.rays, along)
        slopes = torch.cat((slopes, by_k * torch.stack((fx, fy), 1)[:, None]), 1)
    # where a derivative is no number, as at the end of a chart, a step goes without it
    slopes = slopes.nan_to_num(0.0, 0.0, 0.0) * observations.weights[:, None, None]
    return _residuals(observations, parameters, seen).flatten(1), slopes.flatten(2)


def _derivatives(camera: Camera, k: Tensor, rays: Tensor, directions: Tensor) -> Tensor:
    """(C, D, 2, N): of `to_sensor` by the coefficients (C, n), along directions (D, n).

    The directions are rows more: vmap over the derivatives of one would take Python's word for many operations.
    """
    count = len(directions)
    with warnings.catch_warnings(), forward_ad.dual_level():
        # on its first use forward mode loads what calls the deprecated torch.jit.script
        warnings.simplefilter("ignore", DeprecationWarning)
        dual = forward_ad.make_dual(k.repeat_interleave(count, 0), directions.repeat(len(k), 1))
        seen = to_sensor(camera, dual, rays.repeat_interleave(count, 0))
        tangents = [forward_ad.unpack_dual(plane).tangent for plane in seen[:2]]
    planes = [torch.zeros_like(seen.a) if t is None else t for t in tangents]
    return torch.stack(planes, 1).unflatten(0, (len(k), count))


def _refine(
    camera: Camera,
    observations: Observations,
    parameters: Tensor,
    low: Tensor,
    high: Tensor,
    going: Tensor,
    steps: int = _MOST_STEPS,
    first_damping: float = _FIRST_DAMPING,
) -> Tensor:
    """The parameters (C, P) of least cost near those given, of the rows that are `going`."""
    parameters = parameters.clone()
    cost = _cost(camera, observations, parameters)
    damping = torch.full_like(cost, first_damping)
    tiny = _NOTHING**2 * observations.weights.sum(-1)
    going = going & torch.isfinite(cost) & (cost > tiny)
    (free,) = (low < high).any(0).nonzero(as_tuple=True)
    for _ in range(steps):
        rows = going.nonzero()[:, 0]
        if len(rows) == 0:
            break
        # rows that have settled are left alone, so that each goes the way that it would go alone
        these, old, weight = observations.of(rows), parameters[rows], damping[rows]
        residuals, slopes = _linearised(camera, these, old, free)
        # what would leave its bounds stays there, so that the others can move on
        slope = (slopes @ residuals[..., None])[..., 0]
        at_low, at_high = ((old <= low[rows])[:, free], (old >= high[rows])[:, free])
        held = at_low & (slope > 0) | at_high & (slope < 0)
        step = torch.zeros_like(old)
        step[:, free] = _step(residuals, torch.where(held[..., None], 0.0, slopes), weight)
        new = (old + step).clamp(low[rows], high[rows])
        new_cost = _cost(camera, these, new)
        better = new_cost < cost[rows]
        settled = better & (cost[rows] - new_cost <= _SETTLED * cost[rows]) & (weight <= 1e-6)
        stuck = ~better & (weight >= _MOST_DAMPING)
        parameters[rows] = torch.where(better[:, None], new, old)
        cost[rows] = torch.where(better, new_cost, cost[rows])
        damping[rows] = torch.where(better, weight / 10, weight * 10).clamp(_LEAST_DAMPING, _MOST_DAMPING)
        going[rows] = ~(settled | stuck | (cost[rows] <= tiny[rows]))
    return parameters


def _step(residuals: Tensor, slopes: Tensor, damping: Tensor) -> Tensor:
    """(C, P): the damped step of Gauss and Newton; none where its equations have no solution."""
    # the columns differ by many orders of magnitude
    scale = slopes.square().sum(-1).sqrt()
    scale = torch.where(scale > 0, scale, 1.0)
    # the columns of high powers are nearly the same: normal equations would square that
    damped = torch.diag_embed(damping.sqrt()[:, None].expand(scale.shape))
    q, r = torch.linalg.qr(torch.cat((slopes / scale[..., None], damped), -1).mT)
    count = residuals.shape[-1]
    right = q[:, :count].mT @ -residuals[..., None]
    step = torch.linalg.solve_triangular(r, right, upper=True)[..., 0] / scale
    return torch.where(torch.isfinite(step).all(-1, keepdim=True), step, 0.0)
