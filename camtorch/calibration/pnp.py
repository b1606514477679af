"""The pose of an object with known points, from the pixels at which a camera sees them."""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from camtorch.calibration.batches import as_double_rows, as_point_sets, as_stacked, attached, learns, root_of
from camtorch.calibration.bundle import CameraObservations, Poses, adjust_poses
from camtorch.calibration.native_calls import PoseSearch, Solved, solve_poses
from camtorch.calibration.ransac import LEAST, consensus
from camtorch.calibration.rays import poses_from_rays
from camtorch.cameras.camera import Camera
from camtorch.poses.extrinsics import Extrinsics
from camtorch.poses.rotations import rotation_matrix, rotation_vector, skew_matrix
from camtorch.projection.evaluation import native_forms
from camtorch.values.arguments import Numbers, as_number, broadcast_shapes, hinting, no_camera, working_dtype
from camtorch.values.module import model_of, remade
from camtorch.values.threads import on_one_thread

_FEW_POINTS = 5  # which may have minima far from their start
_WORSE = 4.0  # times the least cost: a start below that may lead to less
_MOVE = 1e-6  # of rays, the step of finite differences
_THIN = 0.1  # of the extent of points: thinner ones may have the minima of a plane
_LINE = 1e-6  # of the extent of points: thinner ones are on a line
# Starts are near the optimum. `settled` is the squared distance to it, over the variance, at which a search ends, and
# `nothing` the px that rounding may leave
_SEARCH = PoseSearch(steps=40, settled=1e-7, nothing=1e-9, damping=1e-8)


class _Pose(NamedTuple):
    extrinsics: Extrinsics
    rms: Tensor
    valid: Tensor


class Pose(_Pose):
    """The result of `solve_pnp`; it unpacks into the first three fields."""

    extrinsics: Extrinsics
    """Camera from object, batch *B."""
    rms: Tensor
    """(*B,) px: the root of the weighted mean over the inliers of the squared distance; infinite if invalid."""
    valid: Tensor
    """(*B,) bool."""
    inliers: Tensor
    """(*B, N) bool: the points from which the pose was found; none if invalid."""
    covariance: Tensor
    """(*B, 6, 6) of (w, dt) where R = exp([w]x) R_found and t = t_found + dt, in radians and the points' unit, for
    noise of the inliers' variance, the sum of their squares over 2 N - 6; NaN if invalid. No graph."""

    def __new__(cls, extrinsics: Extrinsics, rms: Tensor, valid: Tensor, inliers: Tensor, covariance: Tensor) -> Pose:
        pose = super().__new__(cls, extrinsics, rms, valid)
        pose.inliers, pose.covariance = inliers, covariance
        return pose

    def __getnewargs__(self) -> tuple[Any, ...]:
        return (*self, self.inliers, self.covariance)


@on_one_thread
@hinting("A camera comes first: ct.solve_pnp(ct.BrownConrady.from_matrix(K, distortion), object_points, pixels)")
def solve_pnp(
    camera: Camera,
    object_points: Numbers,
    pixels: Numbers,
    *,
    weights: Numbers | None = None,
    threshold: float | None = None,
) -> Pose:
    """Find the pose, camera from object, at which known points are seen nearest to pixels: least squares in px.

    The camera may be of any model, rays may have any angle, and four points or more may lie on a plane or not. A closed
    form on rays gives the start (`camtorch.calibration.rays`). Points on a plane may have two minima, and four points
    more: all are refined, and the best pose is returned.

    With a threshold some points may be wrong: RANSAC on rays (`camtorch.calibration.ransac`) finds the pose on which
    most points agree, and refines it by these alone. Samples are always the same, and torch's random state is not
    touched. Six points or more hardly agree by chance.

    Pose and rms have first derivatives by pixels, points, weights and the camera's parameters, by the implicit function
    theorem at the optimum. Computation is in float64, results are in the widest dtype of the arguments. It reads
    values, so it does not work in torch.compile or vmap; pass vmap's batch as a batch dim.

    Args:
        camera: Camera with or without batch dims; all arguments broadcast.
        object_points: (*B, N, 3) in the object's frame, in any unit; (N, 3) for one object in all rows.
        pixels: (*B, N, 2). A point is unseen if its pixel is NaN or has no ray. OpenCV's (N, 1, 2) are N points.
        weights: (*B, N) of the squared residuals, not negative, 0 for unseen; all 1 if left out.
        threshold: px, the largest distance of an inlier from its pixel; by default all points are inliers. Three or
            four times the standard deviation of the noise keeps nearly all inliers.

    Returns:
        A `Pose`: extrinsics (camera from object, batch *B), rms (*B,) in px and valid (*B,) bool, with the attributes
        inliers (*B, N) bool and covariance (*B, 6, 6). A row is invalid, its pose finite and without meaning, if fewer
        than four points are seen or agree, or all of them are on one line, if a point or a parameter is not finite, or
        if no minimum was found that has all seen points in the camera's view.

    Raises:
        TypeError: If `camera` is not a camera or values are not numeric. ValueError: If shapes do not fit, there are
            fewer than four points, a weight is negative, or the threshold is not positive.

    Example:
        >>> camera = ct.KannalaBrandt([300.0, 300.0, 319.5, 239.5], [0.1, 0.0, 0.0, 0.0])
        >>> corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]
        >>> pixels, _ = camera.project(ct.Extrinsics([0.3, 0.0, 0.0], [0.1, 0.2, 5.0])(corners))
        >>> pose, rms, valid = ct.solve_pnp(camera, corners, pixels)
        >>> [round(value, 2) for value in pose.translation.tolist()]
        [0.1, 0.2, 5.0]
    """
    if threshold is not None:
        threshold = as_number(threshold, "threshold", "solve_pnp")
        if not 0 < threshold < math.inf:
            raise ValueError(f"solve_pnp: threshold must be positive, in px; got {threshold:g}")
    given = _Given.of(camera, object_points, pixels, weights)
    with torch.no_grad():
        found = _solve_compiled(given, threshold) or _solve_anywhere(given, threshold)
    if learns([given.camera], *(t for t in given[1:4] if t is not None)):
        found = _attached(given, found)
    vectors, translations, rms, covariance = (
        t.to(given.dtype).view(given.batch + t.shape[1:])
        for t in (found.vectors, found.translations, found.rms, found.covariance)
    )
    valid, inliers = (t.view(given.batch + t.shape[1:]) for t in (found.valid, found.inliers))
    pose = remade(_identity(), rotation=vectors, translation=translations)  # frozen, with the graph of its tensors
    return Pose(pose, rms, valid, inliers, covariance)


@cache
def _identity() -> Extrinsics:
    with torch.inference_mode(False):
        return Extrinsics([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])


class _Given(NamedTuple):
    """The arguments, checked, in float64, with their graphs."""

    camera: Camera  # of B rows, or without batch dims for all
    points: Tensor  # (B or 1, N, 3)
    pixels: Tensor  # (B, N, 2)
    weights: Tensor | None  # (B, N)
    batch: torch.Size
    dtype: torch.dtype

    @classmethod
    def of(cls, camera: Camera, object_points: Numbers, pixels: Numbers, weights: Numbers | None) -> _Given:
        owner = "solve_pnp"
        if not isinstance(camera, Camera):
            raise TypeError(f"{owner}: camera must be a camera, as ct.KannalaBrandt(...); got {no_camera(camera)}")
        if camera.is_mixed:
            raise TypeError(f"{owner}: camera must be of one model; got a Mixed. Call it for each member, camera[i]")
        device = camera.intrinsics.device
        points = as_point_sets(object_points, "object_points", 3, owner, device)
        seen_at = as_point_sets(pixels, "pixels", 2, owner, device)
        count = seen_at.shape[-2]
        given = None if weights is None else as_stacked(weights, "weights", owner, device)
        shapes = f"object_points {tuple(points.shape)} and pixels {tuple(seen_at.shape)}"
        if points.shape[-2] != count or count < LEAST:
            hint = "Pad rows of fewer points with NaN pixels"
            raise ValueError(
                f"{owner}: object_points and pixels must be as many points, {LEAST} or more; got {shapes}. {hint}"
            )
        if given is not None and (given.shape[-1:] != (count,) or not bool((given >= 0).all())):
            got = f"shape {tuple(given.shape)}, down to {given.detach().min().item():.4g}"
            raise ValueError(f"{owner}: weights must be (*B, N) with N = {count}, and not negative; got {got}")
        leads = points.shape[:-2], seen_at.shape[:-2], () if given is None else given.shape[:-1]
        try:
            batch = broadcast_shapes(camera.batch_shape, *leads)
        except ValueError:
            got = f"{shapes}, weights of {leads[2]} and a camera of {tuple(camera.batch_shape)}"
            raise ValueError(f"{owner}: batch dims must broadcast; got {got}") from None
        dtype = working_dtype(points, seen_at, *camera.tensors)

        def rows(values: Tensor, *size: int) -> Tensor:
            return values.double().expand(*batch, *size).reshape(-1, *size)

        points = points.double().view(1, count, 3) if points.ndim == 2 else rows(points, count, 3)
        given = None if given is None else rows(given, count)
        return cls(as_double_rows(camera, batch), points, rows(seen_at, count, 2), given, batch, dtype)


def _solve_compiled(given: _Given, threshold: float | None) -> Solved | None:
    made = native_forms([given.camera], given.pixels)
    if made is None or not len(given.pixels):
        return None
    start = None if threshold is None else _consensus(_Task.of(given), threshold)
    return solve_poses(made[0][0], given.points, given.pixels, given.weights, _SEARCH, start, threshold or 0.0)


def _attached(given: _Given, found: Solved) -> Solved:
    """Return the poses and the root mean squares with their derivatives."""
    task = _Task.of(given)
    task = task._replace(weights=torch.where(found.inliers, task.weights, 0.0))
    middles = task.middles[..., None]
    centred = found.translations + (rotation_matrix(found.vectors) @ middles)[..., 0]
    unknowns = attached(task.cost, torch.cat((found.vectors, centred), -1), found.valid)
    vectors, centred = unknowns.split(3, -1)
    translations = centred - (rotation_matrix(vectors) @ middles)[..., 0]
    means = 2 * task.cost(unknowns) / task.weights.sum(-1).clamp(min=torch.finfo(torch.float64).tiny)
    return found._replace(vectors=vectors, translations=translations, rms=root_of(means, found.valid))


class _Task(NamedTuple):
    """The problems of B rows, in which unseen points have weight 0 and are finite."""

    camera: Camera  # of B rows, or without batch dims for all
    points: Tensor  # (B, N, 3) about their middles
    pixels: Tensor  # (B, N, 2)
    weights: Tensor  # (B, N)
    rays: Tensor  # (B, N, 3)
    middles: Tensor  # (B, 3) of the points as they were passed, which may lie far from the origin

    @classmethod
    def of(cls, given: _Given) -> _Task:
        points, pixels = given.points.expand(len(given.pixels), -1, -1), given.pixels
        weights = torch.ones_like(pixels[..., 0]) if given.weights is None else given.weights
        with torch.no_grad():
            rays, seen = given.camera.unproject(pixels)
            # a sum shows values that are not finite, and these powers values that would overflow
            seen = seen & torch.isfinite(points.square().sum(-1).square() + weights)
            counts = (seen & (weights > 0))[..., None]
            middles = torch.where(counts, points, 0.0).sum(-2) / counts.sum(-2).clamp(min=1)
        points = torch.where(seen[..., None], points - middles[:, None], 0.0)
        pixels, weights = torch.where(seen[..., None], pixels, 0.0), torch.where(seen, weights, 0.0)
        return cls(given.camera, points, pixels, weights, rays, middles)

    def cost(self, unknowns: Tensor) -> Tensor:
        """Return half the sum of squares (B,) at rotation vectors and translations (B, 6)."""
        seen = self.points @ rotation_matrix(unknowns[:, :3]).mT + unknowns[:, None, 3:]
        pixels, valid = self.camera.project(seen)
        squares = (pixels - self.pixels).square().sum(-1)
        return 0.5 * (torch.where(valid, squares, 0.0) * self.weights).sum(-1)


def _consensus(task: _Task, threshold: float) -> tuple[Tensor, Tensor]:
    """Return the poses on which most points agree: rotations (B, 3, 3), translations (B, 3)."""
    # finite differences are accurate enough to search for poses
    moves = _MOVE * torch.eye(4, 3, dtype=task.rays.dtype, device=task.rays.device)  # the last one is no step
    pixels, seen = task.camera.project((task.rays[:, :, None] + moves).flatten(1, 2))
    pixels, seen = pixels.unflatten(1, (-1, 4)), seen.unflatten(1, (-1, 4)).all(-1)
    slopes = ((pixels[:, :, :3] - pixels[:, :, 3:]) / _MOVE).mT
    return consensus(task.points, task.rays, slopes, seen & (task.weights > 0), threshold)


def _solve_anywhere(given: _Given, threshold: float | None) -> Solved:
    task = _Task.of(given)
    if threshold is None:
        found = _best_minimum(task)
    else:
        found, task = _among_outliers(task, threshold)
    good = torch.isfinite(found.costs)
    inliers = (task.weights > 0) & good[:, None]
    away = (found.rotations @ task.middles[..., None])[..., 0]
    covariance = _covariance(found, inliers, away)
    rms = (found.costs / task.weights.sum(-1).clamp(min=torch.finfo(torch.float64).tiny)).sqrt()
    return Solved(rotation_vector(found.rotations), found.translations - away, rms, good, inliers, covariance)


def _best_minimum(task: _Task) -> _Found:
    """Return the best minima from the starts by rays, and from their mirror images."""
    starts = poses_from_rays(task.points, task.rays, task.weights)
    found = _take_best([_minimum(task, *(t[:, i] for t in starts)) for i in range(2)])
    # the other minimum of points on a plane may be one for pixels and not for rays, with few points or much noise
    turns, shifts, is_flat = _mirrored(task, found)
    few = ~starts.valid[:, 1] & ((task.weights > 0).sum(-1) <= _FEW_POINTS)
    near = 2 * task.cost(torch.cat((rotation_vector(turns), shifts), -1)) <= _WORSE * found.costs
    may_be_better = is_flat & torch.isfinite(found.costs) & (few | near)
    if not bool(may_be_better.any()):
        return found
    return _take_best([found, _minimum(task, turns, shifts, may_be_better)])


def _mirrored(task: _Task, found: _Found) -> tuple[Tensor, Tensor, Tensor]:
    """Return the poses at which planes are mirrored across the line of sight, and whether points are flat, (B,)."""
    share = task.weights / task.weights.sum(-1, keepdim=True)
    centre = (share[..., None] * task.points).sum(-2)
    about = task.points - centre[:, None]
    variances, axes = torch.linalg.eigh(((share[..., None] * about).mT @ about).nan_to_num(0.0))
    middle = (found.rotations @ centre[..., None])[..., 0] + found.translations
    across_sight, in_plane = (
        torch.eye(3, dtype=v.dtype, device=v.device) - 2 * v[..., :, None] * v[..., None, :]
        for v in (normalize(middle, dim=-1), axes[..., 0])
    )
    turns = across_sight @ found.rotations @ in_plane
    return turns, middle - (turns @ centre[..., None])[..., 0], variances[:, 0] <= _THIN**2 * variances[:, 2]


def _among_outliers(task: _Task, threshold: float) -> tuple[_Found, _Task]:
    """Return minima for the points near them, and the task in which only these have weights."""
    weights = task.weights
    rotations, translations = _consensus(task, threshold)
    lost, none = torch.full_like(weights[:, 0], torch.inf), weights.new_zeros(len(weights), 6, 7)
    found, before = _Found(lost, rotations, translations, none), torch.zeros_like(weights, dtype=torch.bool)
    near = _nearby(task, rotations, translations, threshold)
    for _ in range(8):  # choices of the near points
        if torch.equal(near, before):
            break
        task = task._replace(weights=torch.where(near, weights, 0.0))
        found = _minimum(task, found.rotations, found.translations, _are_spread(task.points, near))
        before, near = near, _nearby(task._replace(weights=weights), found.rotations, found.translations, threshold)
    return found._replace(costs=torch.where((near == before).all(-1), found.costs, torch.inf)), task


def _covariance(found: _Found, inliers: Tensor, away: Tensor) -> Tensor:
    """Return covariances (B, 6, 6) of turns, and of shifts of the origin, which is `away` (B, 3) from the middle."""
    triangles = found.triangles[..., :6]
    size = triangles.square().sum(-2).sqrt()
    inverse, failed = torch.linalg.inv_ex(triangles / torch.where(size > 0, size, 1.0)[:, None])
    inverse = inverse / size[..., None]
    carried = torch.eye(6, dtype=size.dtype, device=size.device).repeat(len(size), 1, 1)
    carried[:, 3:, :3] = skew_matrix(away)
    carried = carried @ inverse
    variance = found.costs / (2 * inliers.sum(-1) - 6).clamp(min=1)
    covariance = carried @ carried.mT * variance[:, None, None]
    good = torch.isfinite(found.costs) & (failed == 0)
    return torch.where(good[:, None, None], covariance, torch.nan)


class _Found(NamedTuple):
    """Minima of a search, a row each."""

    costs: Tensor  # (B,), infinite if there is none
    rotations: Tensor  # (B, 3, 3)
    translations: Tensor  # (B, 3)
    triangles: Tensor  # (B, 6, 7): of the derivatives by turn and shift, and of the residuals


def _minimum(task: _Task, rotations: Tensor, translations: Tensor, valid: Tensor) -> _Found:
    """Return the minima near poses (B, ...); valid, bool (B,), selects the rows that count."""
    camera = task.camera
    parameters = torch.cat(camera.tensors, -1).detach()
    parameters = parameters.view(-1, parameters.shape[-1])
    observed = CameraObservations(model_of(camera), task.points[:, None], task.pixels[:, None], task.weights[:, None])
    found = adjust_poses(observed, parameters, Poses(rotations[:, None], translations[:, None]), steps=_SEARCH.steps)
    fine = found.converged & valid & ((task.weights > 0).sum(-1) >= LEAST)
    fine = fine & (found.valid[0][:, 0] | (task.weights == 0)).all(-1)
    (turned,), (moved,) = (t.unbind(1) for t in found.state.boards)
    return _Found(torch.where(fine, found.cost, torch.inf), turned, moved, found.equations.view[:, 0])


def _take_best(candidates: list[_Found]) -> _Found:
    """Return the candidate of least cost for each row."""
    best = torch.stack([found.costs for found in candidates]).argmin(0)
    rows = torch.arange(len(best), device=best.device)
    return _Found(*(torch.stack(parts)[best, rows] for parts in zip(*candidates, strict=True)))


def _nearby(task: _Task, rotations: Tensor, translations: Tensor, threshold: float) -> Tensor:
    """Whether points are seen near their pixels, bool (B, N)."""
    pixels, valid = task.camera.project(task.points @ rotations.mT + translations[:, None])
    return valid & (task.weights > 0) & ((pixels - task.pixels).square().sum(-1) < threshold**2)


def _are_spread(points: Tensor, inliers: Tensor) -> Tensor:
    """Whether there are enough inliers, which lie on no line, (B,) bool."""
    weights = inliers.to(points)
    counts = weights.sum(-1)
    centred = points - (weights[..., None] * points).sum(-2, keepdim=True) / counts.clamp(min=1)[:, None, None]
    moments = (weights[..., None] * centred).mT @ centred
    # with eigenvalues a > b > c, these are (a + b + c)^2 and 2 (a b + b c + c a)
    whole = moments.diagonal(dim1=-2, dim2=-1).sum(-1).square()
    return (counts >= LEAST) & (whole - moments.square().sum((-1, -2)) > 2 * _LINE**2 * whole)
