"""The poses of boards for approximate cameras: in closed form from rays, without outliers, and the better of two."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.calibration.bundle import SETTLED, Adjusted, CameraObservations, Free, Poses, State, adjust, minima
from camtorch.calibration.observations import Observations
from camtorch.calibration.rays import poses_from_rays
from camtorch.calibration.robust import Loss
from camtorch.cameras.camera import Camera
from camtorch.cameras.operators import fixed_camera

LEAST_SCALE = 0.5  # px, the least scale of robust weights
_ROUNDS = 3  # of finding poses again without outliers
_CHANGED = 0.9  # of a view's error in the round before: below it another round follows
_BAD = 2.0  # times the usual error: the pose of such a view may be wrong
_HANDFULS, _HANDFUL = 48, 6  # samples, and corners of each, if outliers spoil the pose of all corners
_IN_DOUBT = 4.0  # times the better pose's error: below it the other pose is refined as well
_FEW_STEPS = 6  # of that
_NO_PIXEL = 1e3  # px, the error of a corner without a pixel
_DOUBTED = 50  # views at most, those with the greatest errors, whose poses are searched again at an optimum
_OTHER = 0.05  # radians, or part of the distance: poses further apart are two minima
_SAME = 1e-7  # the relative difference below which two costs are of one optimum


class Lens(NamedTuple):
    """Cameras of a model, parameters (B, 4 + n), with poses (B, V) of the boards."""

    model: type[Camera]
    parameters: Tensor
    boards: Poses
    scale: float = LEAST_SCALE  # px: twice the median error of corners, from which they count less

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
        observed = CameraObservations.of_one(self.model, few)
        found = adjust([observed], self.state, free, loss=loss, steps=steps, settled=settled)
        cost, rows = found.cost.sort()
        near = cost <= worst * cost[0]
        near[1:] &= cost.diff() > _SAME * cost[:-1]
        rows = rows[near]
        errors = torch.linalg.vector_norm(found.residuals[0][rows[0]], dim=-1)
        errors = torch.where(found.valid[0][rows[0]], errors, _NO_PIXEL)[few.seen]
        scale = max(LEAST_SCALE, 2 * float(errors.median()))
        return self._replace(parameters=found.state.parameters[0], boards=found.state.boards, scale=scale).of(rows)


def poses_for(lens: Lens, observations: Observations) -> State:
    """Return the state of a known camera, B = 1, and all views' poses, whatever poses the lens has."""
    camera = lens.camera
    boards, errors = without_outliers(camera, observations, *closed_form_poses(camera, observations))
    return choose_poses(lens._replace(boards=boards), observations, errors).state


def other_poses(found: Adjusted, observations: Observations, model: type[Camera]) -> State | None:
    """Return the state of an optimum, B = 1, with better poses for views that have them; None if none has."""
    state = found.state
    lens = Lens(model, state.parameters[0], state.boards)
    errors = _lengths(found.residuals[0], found.valid[0], observations.seen)[0]
    # views with greater errors than many others are doubted
    rows = errors.nanmedian(-1).values.argsort(descending=True)[:_DOUBTED]
    boards = state.boards.of(rows, 1)
    lens = lens._replace(boards=boards, scale=max(LEAST_SCALE, 2 * float(errors.nanmedian())))
    with torch.inference_mode():
        others = choose_poses(lens, observations.of(rows), errors[None, rows]).boards
    cosine = ((boards.rotations * others.rotations).sum((-1, -2)) - 1) / 2
    shift = torch.linalg.vector_norm(others.translations - boards.translations, dim=-1)
    is_other = (cosine < math.cos(_OTHER)) | (shift > _OTHER * torch.linalg.vector_norm(boards.translations, dim=-1))
    if not bool(is_other.any()):
        return None
    return state._replace(boards=state.boards.with_views(rows, Poses.where(is_other[0], others, boards)))


def closed_form_poses(camera: Camera, some: Observations) -> tuple[Poses, Tensor]:
    """Return closed-form poses (B, V) for cameras (B,), and errors (B, V, N) in px; NaN if a corner is unseen."""
    rays, has_ray = _rays(camera, some)
    points = some.points.expand_as(rays)
    found = poses_from_rays(*(t.flatten(0, 1) for t in (points, rays, has_ray.to(rays.dtype))))
    boards = Poses(*(t[:, 0].unflatten(0, has_ray.shape[:2]) for t in found[:2]))
    return boards, pixel_errors(camera, boards, some)


def without_outliers(camera: Camera, some: Observations, boards: Poses, errors: Tensor) -> tuple[Poses, Tensor]:
    """Return closed-form poses and their errors after rounds that weigh the outliers of the one before less."""
    rays, has_ray = _rays(camera, some)
    points = some.points.expand_as(rays).flatten(0, 1)
    usual = errors.nanmedian(-1).values.clamp(min=LEAST_SCALE / 2)
    is_better = torch.ones_like(usual, dtype=torch.bool)
    for _ in range(_ROUNDS):
        (rows,) = is_better.flatten().nonzero(as_tuple=True)
        if len(rows) == 0:
            break
        weights = 1 / (1 + (errors / (2 * usual[..., None])).square())
        weights = torch.where(has_ray, weights, 0.0).flatten(0, 1)
        found = poses_from_rays(points[rows], rays.flatten(0, 1)[rows], weights[rows])
        turns, shifts = (
            old.flatten(0, 1).index_copy(0, rows, new[:, 0]).view_as(old)
            for old, new in zip(boards, found[:2], strict=True)
        )
        boards = Poses(turns, shifts)
        errors, before = pixel_errors(camera, boards, some), usual
        usual = errors.nanmedian(-1).values.clamp(min=LEAST_SCALE / 2)
        is_better = usual < _CHANGED * before
    return boards, errors


def _resample_poses(camera: Camera, boards: Poses, some: Observations, errors: Tensor) -> tuple[Poses, Tensor]:
    """Return the poses (1, V), by samples of corners for views spoilt by outliers, and the errors (1, V, N)."""
    usual = errors[0].nanmedian(-1).values
    (bad,) = (usual > _BAD * usual.median().clamp(min=LEAST_SCALE)).nonzero(as_tuple=True)
    if len(bad) == 0:
        return boards, errors
    generator = torch.Generator("cpu").manual_seed(0)
    many = some.of(bad.repeat_interleave(_HANDFULS))
    rays, has_ray = (t[0] for t in _rays(camera, many))
    chances = torch.rand(has_ray.shape, generator=generator, device="cpu").to(rays.device).masked_fill(~has_ray, -1.0)
    least = chances.topk(min(_HANDFUL, has_ray.shape[1])).values[:, -1:]
    found = poses_from_rays(many.points, rays, (has_ray & (chances >= least)).to(rays.dtype))
    tried = Poses(found.rotations[None, :, 0], found.translations[None, :, 0])
    by_sample = pixel_errors(camera, tried, many)[0].nanmedian(-1).values.view(-1, _HANDFULS)
    best = torch.cat((by_sample, usual[bad, None]), 1).argmin(-1)
    changed = best < _HANDFULS
    rows = (torch.arange(len(bad), device=bad.device) * _HANDFULS + best)[changed]
    boards = boards.with_views(bad[changed], tried.of(rows, 1))
    return boards, pixel_errors(camera, boards, some)


def choose_poses(lens: Lens, some: Observations, errors: Tensor) -> Lens:
    """Return a single camera with the best pose of each view: a plane has two similar ones; errors (1, V, N)."""
    camera = lens.camera
    old, errors = _resample_poses(camera, lens.boards, some, errors)
    rays, has_ray = (t[0] for t in _rays(camera, some))
    weights = torch.where(has_ray, 1 / (1 + (errors[0] / lens.scale).square()), 0.0)
    found = poses_from_rays(some.points, rays, weights)
    both = Poses(*(t.transpose(0, 1) for t in found[:2]))
    first, second = (both.of(slice(i, i + 1)) for i in range(2))
    usual, other, others = torch.cat((errors, pixel_errors(camera, both, some))).nanmedian(-1).values
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


def _rays(camera: Camera, some: Observations) -> tuple[Tensor, Tensor]:
    """Return rays (B, V, N, 3) of the pixels for cameras (B,), and whether seen corners have them, bool (B, V, N)."""
    rays, has_ray = camera.unproject(some.pixels.flatten(0, 1).expand(len(camera.intrinsics), -1, -1))
    shape = len(rays), *some.seen.shape
    return rays.view(*shape, 3), has_ray.view(shape) & some.seen


def pixel_errors(camera: Camera, boards: Poses, some: Observations) -> Tensor:
    """Return errors (B, V, N) in px for B cameras, or one for all, NaN if a corner is unseen."""
    points = boards.moved(some.points)
    pixels, valid = camera.project(points.reshape(len(camera.intrinsics), -1, 3))
    return _lengths(pixels.view(*points.shape[:-1], 2) - some.pixels, valid.view(points.shape[:-1]), some.seen)


def _lengths(residuals: Tensor, valid: Tensor, seen: Tensor) -> Tensor:
    """Return lengths (B, V, N) in px, NaN if a corner is unseen."""
    # a norm along the last dim would be slow: components lie in planes
    return torch.where(seen, torch.where(valid, torch.hypot(*residuals.unbind(-1)), _NO_PIXEL), torch.nan)
