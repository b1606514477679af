"""Fits of cameras to rays and their pixels, each row of a batch on its own."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.least_squares.equations import Equations, System, padded
from camtorch.least_squares.jacobians import SensorPoints, sensor_jacobians, to_sensor
from camtorch.least_squares.levenberg_marquardt import FIRST_DAMPING, LEAST_DAMPING, minimise, rounding_of
from camtorch.projection.camera_like import CameraLike
from camtorch.rays.lattices import angles_from_axis, slopes_at_axis
from camtorch.values.arguments import columns

_LAWSON_ROUNDS, _LAWSON_STEPS, _PATIENCE = 40, 2, 6
_SETTLED = 1e-8  # the part of the cost left to gain at which a search ends
_NOTHING, _NEARLY_NOTHING = 1e-11, 1e-9  # px
_SMOOTH = 1e-4  # the weight of a surface's second differences, in px, which decide where there are no pixels
_LEAST_SLOPE = 1e-3  # the least slope of a lens at the axis when a fit starts
_LOST = 0.1  # the error, in focal lengths, of a ray without a pixel when alternatives are compared


class RayPixels(NamedTuple):
    """Rays (C, N, 3), their pixels (C, N, 2), and weights of the errors (C, N), 0 for no ray or no pixel."""

    rays: Tensor
    pixels: Tensor
    weights: Tensor

    def of(self, rows: Tensor) -> RayPixels:
        return RayPixels(*(t[rows] for t in self))

    @property
    def valid(self) -> Tensor:
        """Whether a row has both a ray and its pixel, bool (C, N)."""
        return self.weights > 0

    @property
    def angles(self) -> Tensor:
        """Angles (C, N) from the axis in radians."""
        return angles_from_axis(self.rays)


def fit(
    camera: CameraLike, observations: RayPixels, starts: Tensor, slopes: Tensor, fixed: Tensor | None = None
) -> Tensor:
    """Return the parameters (C, 4 + n) at which a camera projects rays nearest to their pixels.

    Rays that the camera's chart never covers do not count. No row depends on another.

    Args:
        camera: Camera, of which only the optics are used.
        observations: Rays, pixels and weights to fit to.
        starts: (S, C, n) coefficients to start from; the best result is returned.
        slopes: (C, 4) the focal lengths at the axis in x and y, and the pixel of the axis.
        fixed: (4 + n,) values of parameters that are held, NaN for those to find.
    """
    smooth = camera.smoothness()
    if smooth is not None:
        return _fit_linear(camera, observations, slopes, smooth.to(slopes), fixed)
    results, scores = [], []
    tiny = _NEARLY_NOTHING**2 * observations.weights.sum(-1)
    found = torch.zeros_like(tiny, dtype=torch.bool)
    for start in starts:
        focal = slopes[:, :2] / slopes_at_axis(camera.optics, start).clamp(min=_LEAST_SLOPE)
        parameters = torch.cat((focal, slopes[:, 2:], start), -1)
        low, high = bounds(camera, parameters)
        if fixed is not None:
            low, high = (torch.where(fixed.isnan(), ends, fixed) for ends in (low, high))
        parameters = parameters.clamp(low, high)
        within = observations._replace(weights=torch.zeros_like(observations.weights))
        for _ in range(3):
            # a chart may cover more rays after a fit to those that it covers
            weights = observations.weights * to_sensor(camera, parameters[:, 4:], observations.rays).covered
            more = (weights != within.weights).any(-1) & ~found
            within = observations._replace(weights=weights)
            parameters = _Fit(camera, within, low, high).refined(parameters, more)
        score = _cost(camera, within, parameters)
        score = score + (observations.weights - within.weights).sum(-1) * (_LOST * slopes[:, :2].mean(-1)) ** 2
        found |= score <= tiny
        results.append(parameters)
        scores.append(score)
    best = torch.stack(scores).argmin(0)
    return torch.stack(results)[best, torch.arange(len(best), device=best.device)]


def _fit_linear(
    camera: CameraLike, observations: RayPixels, slopes: Tensor, smooth: Tensor, fixed: Tensor | None
) -> Tensor:
    """Fit a lens that is linear in its coefficients in one step, at given focal lengths and pixels of the axis."""
    parameters = torch.cat((slopes, slopes.new_tensor(camera.ideal(smooth.shape[-1])).expand(len(slopes), -1)), -1)
    fixed = torch.full_like(parameters[0], torch.nan) if fixed is None else fixed
    free, parameters = fixed.isnan(), torch.where(fixed.isnan(), parameters, fixed)
    seen, _, by_k = sensor_jacobians(camera, parameters[:, 4:], observations.rays)
    weights = (observations.weights * seen.covered)[:, None]
    slope = (by_k[:, :, free[4:]] * (parameters[:, :2, None] * weights)[:, :, None]).movedim(2, -1).flatten(1, 2)
    slight = _SMOOTH * parameters[:, :2].mean(-1)[:, None, None] * smooth
    errors = _residuals(observations._replace(weights=weights[:, 0]), parameters, seen).flatten(1)
    missing = -torch.cat((errors, (slight @ parameters[:, 4:, None])[..., 0]), -1)
    rows = torch.cat((slope, slight[..., free[4:]]), 1)
    parameters[:, 4:][:, free[4:]] += torch.linalg.lstsq(rows, missing[..., None]).solution[..., 0]
    return parameters


def refine_minimax(camera: CameraLike, observations: RayPixels, parameters: Tensor) -> Tensor:
    """Return parameters (C, 4 + n) near the given ones with a smaller largest error; no row depends on another.

    Lawson's algorithm: repeated weighted least squares; each time the weight of a square is multiplied by its error.
    """
    if camera.smoothness() is not None:  # such a lens has more coefficients than the errors have peaks
        return parameters
    low, high = bounds(camera, parameters)
    covered = observations.weights * to_sensor(camera, parameters[:, 4:], observations.rays).covered
    observations = observations._replace(weights=covered)
    best, weights = parameters, covered
    error = _distances(observations, camera, parameters)
    least, stale = error.amax(-1), torch.zeros_like(error[:, 0])
    for _ in range(_LAWSON_ROUNDS):
        going = stale < _PATIENCE
        if not bool(going.any()):
            break
        # weights are of errors, not of their squares
        weights = weights * (error / error.amax(-1, keepdim=True).clamp(min=_NOTHING)).sqrt()
        weights = weights / weights.amax(-1, keepdim=True).clamp(min=1e-30)
        weighted = _Fit(camera, observations._replace(weights=weights), low, high)
        parameters = weighted.refined(parameters, going, _LAWSON_STEPS, LEAST_DAMPING)
        error = _distances(observations, camera, parameters)
        better = going & (error.amax(-1) < least)
        best = torch.where(better[:, None], parameters, best)
        stale = torch.where(error.amax(-1) < 0.999 * least, 0.0, stale + 1)
        least = torch.where(better, error.amax(-1), least)
    return best


def _distances(observations: RayPixels, camera: CameraLike, parameters: Tensor) -> Tensor:
    """Return the distances (C, N) in pixels between projections and observations."""
    residuals = _residuals(observations, parameters, to_sensor(camera, parameters[:, 4:], observations.rays))
    distances: Tensor = torch.linalg.vector_norm(residuals, dim=1)
    return distances


def bounds(camera: CameraLike, parameters: Tensor) -> tuple[Tensor, Tensor]:
    """Return the least and the greatest parameters (C, 4 + n); a focal length stays within a factor of 1000."""
    low, high = torch.full_like(parameters, -torch.inf), torch.full_like(parameters, torch.inf)
    low[:, :2], high[:, :2] = parameters[:, :2] * 1e-3, parameters[:, :2] * 1e3
    for i, name in enumerate(camera.distortion_names, 4):
        ends = camera.fit_bounds.get(name, (-torch.inf, torch.inf))
        low[:, i], high[:, i] = ends or (parameters[:, i], parameters[:, i])
    return low, high


def _residuals(observations: RayPixels, parameters: Tensor, seen: SensorPoints) -> Tensor:
    """Return the weighted residuals (C, 2, N) in pixels."""
    fx, fy, cx, cy = columns(parameters[:, :4])
    u, v = observations.pixels.unbind(-1)
    return torch.stack((fx * seen.a + cx - u, fy * seen.b + cy - v), 1) * observations.weights[:, None]


def _cost(camera: CameraLike, observations: RayPixels, parameters: Tensor) -> Tensor:
    """Return the sums of squares (C,); infinite if a weighted ray is not covered or the coefficients are undefined."""
    seen = to_sensor(camera, parameters[:, 4:], observations.rays)
    lost = (~seen.covered & (observations.weights > 0)).any(-1)
    cost = _residuals(observations, parameters, seen).square().sum((1, 2))
    defined = camera.defined(parameters[:, 4:].unbind(-1))
    if defined is not None:
        lost = lost | ~(defined > 0)
    return torch.where(lost | ~torch.isfinite(cost), torch.inf, cost)


class _Fit:
    """The problem for `levenberg_marquardt.minimise`, whose state is the parameters (C, P)."""

    def __init__(self, camera: CameraLike, observations: RayPixels, low: Tensor, high: Tensor):
        self.camera, self.observations, self.low, self.high = camera, observations, low, high
        self.rounding = rounding_of(observations.pixels, observations.weights.square())
        (self.free,) = (low < high).any(0).nonzero(as_tuple=True)

    def cost(self, state: tuple[Tensor, ...], rows: Tensor) -> Tensor:
        return _cost(self.camera, self.observations.of(rows), state[0])

    def linearised(self, state: tuple[Tensor, ...], rows: Tensor) -> System:
        (parameters,), free, observations = state, self.free, self.observations.of(rows)
        seen, _, by_k = sensor_jacobians(self.camera, parameters[:, 4:], observations.rays)
        residuals = _residuals(observations, parameters, seen).flatten(1)
        zero, one = torch.zeros_like(seen.a), torch.ones_like(seen.a)
        by_intrinsics = [(seen.a, zero), (zero, seen.b), (one, zero), (zero, one)]
        slopes = torch.stack([torch.stack(pair, 1) for pair in by_intrinsics], 1)
        slopes = torch.cat((slopes, by_k.transpose(1, 2) * parameters[:, None, :2, None]), 1)
        slopes = (slopes * observations.weights[:, None, None]).flatten(2)
        slope, values = (slopes @ residuals[..., None])[:, free, 0], parameters[:, free]
        # parameters that would leave their bounds stay there, so that the others can move on
        held = (values <= self.low[rows][:, free]) & (slope > 0) | (values >= self.high[rows][:, free]) & (slope < 0)
        triangle = torch.linalg.qr(padded(torch.cat((slopes[:, free], residuals[:, None]), 1).mT), mode="r").R
        none = triangle.new_zeros(len(rows), 0, 0, triangle.shape[-1])
        return System(Equations(none, triangle), 0, held)

    def moved(self, state: tuple[Tensor, ...], step: tuple[Tensor, ...], rows: Tensor) -> tuple[Tensor, ...]:
        new = state[0].clone()
        new[:, self.free] += step[1]
        return (new.clamp(self.low[rows], self.high[rows]),)

    def refined(self, parameters: Tensor, going: Tensor, steps: int = 60, damping: float = FIRST_DAMPING) -> Tensor:
        """Return the parameters (C, P) of least cost near the given ones, for rows that are `going`."""
        tiny = _NOTHING**2 * self.observations.weights.sum(-1)
        found = minimise(self, (parameters,), tolerance=_SETTLED, tiny=tiny, going=going, steps=steps, damping=damping)
        return found.state[0]
