"""The pose of an object whose points are known, from the pixels at which a camera sees them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from camtorch._arguments import Numbers, as_number, broadcast_shapes, no_camera, working_dtype
from camtorch._module import remade
from camtorch._threads import on_one_thread
from camtorch.calibration.batches import as_tensor, as_vectors, learns, root_of, rows_of
from camtorch.calibration.ransac import consensus
from camtorch.calibration.rays import poses_from_rays
from camtorch.camera import Camera
from camtorch.extrinsics import Extrinsics
from camtorch.least_squares.equations import Equations, System, triangle_of_few
from camtorch.least_squares.implicit import attached
from camtorch.least_squares.levenberg_marquardt import minimise, rounding_of
from camtorch.mixed import Mixed
from camtorch.rotations import rotation_matrix, rotation_vector, skew_matrix, small_turn

_LEAST = 4  # points
_FEW = 5  # points, that may have minima far from where they start
_WORSE, _MUCH_WORSE = 4.0, 100.0  # times the cost of the best start, beyond which none became the best; of few points
_MOVE = 1e-6  # of rays, whose pixels' difference is a derivative
_THIN = 0.1  # of the extent of points: what is thinner may have the minima of a plane
_STEPS, _FEW_STEPS = 40, 8  # at most; towards a minimum that is rarely the better one
_DAMPING = 1e-8  # at first: a start is nearly the optimum
_SETTLED = 1e-7  # of the variance: the squared distance to the optimum, in standard deviations, that ends a search
_NOTHING = 1e-9  # px, that rounding may leave
_LINE = 1e-6  # of the extent of points: less across is none
_TURNS, _CHOICES = 12, 6  # steps by inliers, at most, and before how many of them they are chosen again
_LOST = 1e3  # px, that a point without a pixel counts as where starts are compared


class _Pose(NamedTuple):
    extrinsics: Extrinsics
    rms: Tensor
    valid: Tensor


class Pose(_Pose):
    """What `solve_pnp` returns; it unpacks into the first three."""

    extrinsics: Extrinsics
    """Camera from object, batch *B."""
    rms: Tensor
    """(*B,) px: the root of the weighted mean over the inliers of the squared distance; infinite where invalid."""
    valid: Tensor
    """(*B,) bool."""
    inliers: Tensor
    """(*B, N) bool: the points that the pose was found from; none where invalid."""
    covariance: Tensor
    """(*B, 6, 6) of (w, dt) where R = exp([w]x) R_found and t = t_found + dt, in radians and the points' unit, for
    noise of the variance that the inliers leave, the sum of squares over 2 N - 6; NaN where invalid. No graph."""

    def __new__(cls, extrinsics: Extrinsics, rms: Tensor, valid: Tensor, inliers: Tensor, covariance: Tensor) -> Pose:
        """All five."""
        pose = super().__new__(cls, extrinsics, rms, valid)
        pose.inliers, pose.covariance = inliers, covariance
        return pose

    def __getnewargs__(self) -> tuple[Any, ...]:
        return (*self, self.inliers, self.covariance)


@on_one_thread
def solve_pnp(
    camera: Camera,
    object_points: Numbers,
    pixels: Numbers,
    *,
    weights: Numbers | None = None,
    threshold: float | None = None,
) -> Pose:
    """The pose, camera from object, under which known points are seen nearest to pixels: least squares in px.

    Any camera model, rays of any angle, four points or more, on a plane or not, and no start: closed forms on rays give
    it (`camtorch.calibration.rays`), the Levenberg-Marquardt method the optimum. Points on a plane may have two
    minima: both are refined, and the better one is returned.

    With a threshold some points may be anywhere: poses of triples of points are compared by how many others agree
    (RANSAC on rays, `camtorch.calibration.ransac`), and the best one is refined by these alone. The triples are always
    the same, torch's random state is not touched. From six points that agree on, it is not chance.

    Pose and rms have first derivatives by pixels, points, weights and the camera's parameters, by the implicit function
    theorem at the optimum, whatever led there. All is computed in float64 and returned in the widest dtype that came
    in. It looks at values: not for torch.compile and vmap, whose batch goes in as one.

    Args:
        camera: with batch dims or without; all broadcast.
        object_points: (*B, N, 3) in the object's frame, in any unit; (N, 3) for one object in all rows.
        pixels: (*B, N, 2). NaN is unseen, as is a pixel that the camera has no ray for. OpenCV's points (N, 1, 2), and
            (N, 1, 3), are N points.
        weights: (*B, N) of the squared residuals, not negative, 0 for unseen; all 1 if left out.
        threshold: px, how far from its pixel a point may be seen that belongs to the pose; by default all do. Three or
            four times the standard deviation of the noise keeps nearly all that belong.

    Returns:
        A `Pose`: extrinsics (camera from object, batch *B), rms (*B,) in px and valid (*B,) bool; beside these three
        its attributes inliers (*B, N) bool and covariance (*B, 6, 6). A row is invalid, its
        pose finite and without a meaning, if less than four points are seen, or agree, or all of them on one line, if a
        point or a parameter is not finite, or if no minimum was found that has all seen points in the camera's view.

    Raises:
        TypeError: no camera, or no numbers. ValueError: shapes that do not fit, less than four points, negative
            weights, a threshold that is not positive.
    """
    if threshold is not None:
        threshold = as_number(threshold, "threshold", "solve_pnp")
        if not 0 < threshold < math.inf:
            raise ValueError(f"solve_pnp: threshold must be positive, in px; got {threshold:g}")
    if isinstance(camera, Mixed):
        return _of_each_model(camera, object_points, pixels, weights, threshold)
    task = _Task.of(camera, object_points, pixels, weights)
    with torch.no_grad():
        found = _solved(task) if threshold is None else _agreed(task, threshold)
        inliers = found.inliers & found.valid[:, None]
        rotation, translation, mean = rotation_vector(found.rotations), found.translations, found.normal[:, 6, 6]
        moved = (found.rotations @ task.middles[..., None])[..., 0]
        covariance = _covariance(found, moved)
    task = task._replace(weights=torch.where(inliers, task.weights, 0.0))
    if learns([camera], task.points, task.pixels, task.weights):
        unknowns = attached(task.cost, torch.cat((rotation, translation), -1), found.valid)
        mean = 2 * task.cost(unknowns)
        rotation, translation = unknowns.split(3, -1)
        moved = (rotation_matrix(rotation) @ task.middles[..., None])[..., 0]
    mean = mean / task.weights.sum(-1).clamp(min=torch.finfo(torch.float64).tiny)
    rotation, translation = (t.to(task.dtype).view(*task.batch, 3) for t in (rotation, translation - moved))
    rms, valid = root_of(mean, found.valid).to(task.dtype).view(task.batch), found.valid.view(task.batch)
    inliers = inliers.view(*task.batch, inliers.shape[-1])
    covariance = covariance.to(task.dtype).view(*task.batch, 6, 6)
    return Pose(_fixed(rotation, translation), rms, valid, inliers, covariance)


def _of_each_model(
    camera: Mixed, object_points: Numbers, pixels: Numbers, weights: Numbers | None, threshold: float | None
) -> Pose:
    """`solve_pnp` of each group, whose poses are put together again."""
    owner, count, device = "solve_pnp", len(camera), camera.intrinsics.device
    points = as_vectors(object_points, "object_points", 3, owner, device)
    seen_at = as_vectors(pixels, "pixels", 2, owner, device)
    given = seen_at.new_ones(seen_at.shape[-2]) if weights is None else as_tensor(weights, "weights", owner, device)
    fields = points, seen_at, given[..., None]
    leads = [tuple(field.shape[:-2]) for field in fields]
    if any(lead not in ((), (1,), (count,)) for lead in leads):
        raise ValueError(f"{owner}: a Mixed of {count} cameras takes batch dims () or ({count},); got {leads}")
    found = []
    for rows, group in camera.groups:
        mine = [field[rows] if field.shape[:-2] == (count,) else field for field in fields]
        pose = solve_pnp(group, mine[0], mine[1], weights=mine[2][..., 0], threshold=threshold)
        found.append((pose.extrinsics.rotation, pose.extrinsics.translation, *pose[1:], pose.inliers, pose.covariance))
    rotation, translation, *others = (camera._in_order(torch.cat(parts)) for parts in zip(*found, strict=True))
    return Pose(_fixed(rotation, translation), *others)


def _fixed(rotation: Tensor, translation: Tensor) -> Extrinsics:
    """A pose that does not learn by itself; gradients go to what it was found from."""
    made = Extrinsics(rotation[..., None], translation)
    return made if rotation.requires_grad else made.requires_grad_(False)


class _Task(NamedTuple):
    """B rows, float64, with graphs where there are: what is unseen has weight 0 and is finite."""

    camera: Camera  # of B rows, or of none for all
    points: Tensor  # (B, N, 3) about their middles
    pixels: Tensor  # (B, N, 2)
    weights: Tensor  # (B, N)
    rays: Tensor  # (B, N, 3)
    middles: Tensor  # (B, 3) of the points as they were passed, which may lie far from the origin
    batch: torch.Size
    dtype: torch.dtype

    @classmethod
    def of(cls, camera: Camera, object_points: Numbers, pixels: Numbers, weights: Numbers | None) -> _Task:
        """What users pass, checked."""
        owner = "solve_pnp"
        if not isinstance(camera, Camera):
            raise TypeError(f"{owner}: camera must be a camera, as ct.KannalaBrandt(...); got {no_camera(camera)}")
        device = camera.intrinsics.device
        points = as_vectors(object_points, "object_points", 3, owner, device)
        seen_at = as_vectors(pixels, "pixels", 2, owner, device)
        count = seen_at.shape[-2]
        given = None if weights is None else as_tensor(weights, "weights", owner, device)
        shapes = f"object_points {tuple(points.shape)} and pixels {tuple(seen_at.shape)}"
        if points.shape[-2] != count:
            raise ValueError(
                f"{owner}: {shapes} are not the same number of points. Rows of fewer points are padded with NaN pixels"
            )
        if count < _LEAST:
            raise ValueError(f"{owner}: it takes {_LEAST} points at least; got {shapes}")
        given = seen_at.new_ones(count)
        if weights is not None:
            given = as_tensor(weights, "weights", owner, device)
            if given.shape[-1:] != (count,):
                raise ValueError(f"{owner}: weights must be (*B, N) with N = {count}; got shape {tuple(given.shape)}")
            if not bool((given >= 0).all()):
                raise ValueError(f"{owner}: weights must not be negative; got {given.detach().min().item():.4g}")
        try:
            batch = broadcast_shapes(camera.batch_shape, points.shape[:-2], seen_at.shape[:-2], given.shape[:-1])
        except ValueError:
            raise ValueError(
                f"{owner}: the batch dims of {shapes}, weights {tuple(given.shape)} and the camera's "
                f"{tuple(camera.batch_shape)} do not fit"
            ) from None
        dtype = working_dtype(points, seen_at, *camera._tensors)
        points, seen_at, given = (
            t.double().expand(*batch, count, *size).reshape(-1, count, *size)
            for t, size in ((points, (3,)), (seen_at, (2,)), (given, ()))
        )
        rows = rows_of(camera, batch)
        with torch.no_grad():
            rays, seen = rows.unproject(seen_at)
            # a sum shows what is not finite, and these powers what would not be
            seen = seen & torch.isfinite(points.square().sum(-1).square() + given)
            counts = (seen & (given > 0))[..., None]
            middles = torch.where(counts, points, 0.0).sum(-2) / counts.sum(-2).clamp(min=1)
        points = torch.where(seen[..., None], points - middles[:, None], 0.0)
        seen_at, given = torch.where(seen[..., None], seen_at, 0.0), torch.where(seen, given, 0.0)
        return cls(rows, points, seen_at, given, rays, middles, batch, dtype)

    def cost(self, unknowns: Tensor) -> Tensor:
        """(B,) half the sum of squares at rotation vectors and translations (B, 6)."""
        seen = self.points @ rotation_matrix(unknowns[:, :3]).mT + unknowns[:, None, 3:]
        pixels, valid = self.camera.project(seen)
        squares = (pixels - self.pixels).square().sum(-1)
        return 0.5 * (torch.where(valid, squares, 0.0) * self.weights).sum(-1)


class _Optimum(NamedTuple):
    """Rotations (B, 3, 3), translations (B, 3), whether they are one, and which points (B, N) they are of.

    normal: (B, 7, 7), the weighted products of the residuals' derivatives by turn and shift, and of the residuals;
    inverse: (B, 6, 6), of the former.
    """

    rotations: Tensor
    translations: Tensor
    valid: Tensor
    inliers: Tensor
    normal: Tensor
    inverse: Tensor


def _solved(task: _Task) -> _Optimum:
    """The poses of least cost of all that is seen."""
    points, pixels, weights = (t.detach() for t in task[1:4])
    starts = poses_from_rays(points, task.rays, weights)
    seen_at, mapped = task.camera.project(starts.moved(points).flatten(1, 2))
    shape = *starts.valid.shape, points.shape[1]
    squares = (seen_at.view(*shape, 2) - pixels[:, None]).square().sum(-1)
    costs = (torch.where(mapped.view(shape), squares, _LOST**2) * weights[:, None]).sum(-1)
    costs = torch.where(starts.valid, costs, torch.inf)
    best, every = costs.argmin(-1), torch.arange(len(costs), device=costs.device)
    found = _refined(task, every, starts.rotations[every, best], starts.translations[every, best])
    found = found._replace(costs=torch.where(starts.valid[every, best], found.costs, torch.inf))
    few = (weights > 0).sum(-1) <= _FEW
    others = costs.scatter(1, best[:, None], torch.inf).amin(-1)
    for those, factor, steps in ((few, _MUCH_WORSE, _STEPS), (~few, _WORSE, _FEW_STEPS)):
        (rows,) = (those & (others <= factor * costs.amin(-1)) & (others < torch.inf)).nonzero(as_tuple=True)
        other = starts.rotations[rows, 1 - best[rows]], starts.translations[rows, 1 - best[rows]]
        found = found.or_better(rows, _refined(task, rows, *other, steps))
    # of so few points on a plane the other minimum may be one of pixels, and none of rays
    (rows,) = (few & starts.valid[:, 0] & ~starts.valid[:, 1]).nonzero(as_tuple=True)
    flat, turned, moved = _mirrored(points[rows], weights[rows], found.rotations[rows], found.translations[rows])
    found = found.or_better(rows[flat], _refined(task, rows[flat], turned[flat], moved[flat]))
    problem = _Reprojection(task, every)
    normal = _normal(*problem.linear((found.rotations, found.translations), every), weights)
    valid = torch.isfinite(found.costs)
    return _Optimum(found.rotations, found.translations, valid, weights > 0, normal, _inverse(normal))


class _Found(NamedTuple):
    """Minima: costs (R,), infinite where there is none, rotations (R, 3, 3) and translations (R, 3)."""

    costs: Tensor
    rotations: Tensor
    translations: Tensor

    def or_better(self, rows: Tensor, other: _Found) -> _Found:
        """With the minima of some rows, where they are lower, in the place of those here."""
        better = other.costs < self.costs[rows]
        whole = _Found(*(t.clone() for t in self))
        for mine, its in zip(whole, other, strict=True):
            mine[rows[better]] = its[better]
        return whole


def _agreed(task: _Task, threshold: float) -> _Optimum:
    """The poses of least cost of the points on which most agree: steps of Gauss and Newton by what is near before."""
    given = task.weights > 0
    every = torch.arange(len(given), device=given.device)
    problem = _Reprojection(task, every)
    # differences do where poses are only looked for
    moves = _MOVE * torch.eye(4, 3, dtype=task.rays.dtype, device=task.rays.device)  # the last one: none
    pixels, seen = problem.camera.project((task.rays[:, :, None] + moves).flatten(1, 2))
    pixels, seen = pixels.unflatten(1, (given.shape[1], 4)), seen.unflatten(1, (given.shape[1], 4)).all(-1)
    slopes = ((pixels[:, :, :3] - pixels[:, :, 3:]) / _MOVE).mT
    rotations, translations, _ = consensus(problem.points, task.rays, slopes, given & seen, threshold)
    inliers = torch.zeros_like(given)
    for number in range(_TURNS):
        state, before = (rotations, translations), inliers
        if number % 2 == 0:  # a step hardly changes the derivatives
            residuals, mapped, columns = problem.linear(state, every)
        else:
            residuals, mapped = problem.residuals(state)
        if number < _CHOICES:
            inliers = given & mapped & (residuals.square().sum(-1) < threshold**2)
        normal = _normal(residuals, mapped, columns, torch.where(inliers, problem.weights, 0.0))
        inverse = _inverse(normal)
        step = -(inverse @ normal[:, :6, 6:])[..., 0]
        gain, cost = -(step * normal[:, :6, 6]).sum(-1), normal[:, 6, 6]
        rounding = 2 * (cost * problem.rounding).sqrt() + problem.rounding
        tolerance = _SETTLED / (2 * inliers.sum(-1) - 6).clamp(min=1)
        settled = (gain <= torch.maximum(tolerance * cost, rounding)) & (inliers == before).all(-1)
        step = torch.where(torch.isfinite(step).all(-1, keepdim=True), step, 0.0)
        rotations, translations = small_turn(step[:, :3]) @ rotations, translations + step[:, 3:]
        if bool(settled.all()):
            break
    settled &= _spread(problem.points, inliers)
    return _Optimum(rotations, translations, settled, inliers, normal, inverse)


def _spread(points: Tensor, inliers: Tensor) -> Tensor:
    """(B,) bool: whether there are enough inliers, which are on no line."""
    weights = inliers.to(points)
    counts = weights.sum(-1)
    centred = points - (weights[..., None] * points).sum(-2, keepdim=True) / counts.clamp(min=1)[:, None, None]
    moments = (weights[..., None] * centred).mT @ centred
    # of eigenvalues a > b > c, (a + b + c)^2 and 2 (a b + b c + c a)
    whole = moments.diagonal(dim1=-2, dim2=-1).sum(-1).square()
    enough: Tensor = (counts >= _LEAST) & (whole - moments.square().sum((-1, -2)) > 2 * _LINE**2 * whole)
    return enough


def _derivatives(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels, whether there is one, and derivatives (B, N, 2, 3) by points (B, N, 3) of a frozen camera."""
    with torch.inference_mode(False), torch.enable_grad():
        # each point twice: all derivatives by one pass backward
        leaf = torch.cat((points.detach(), points.detach()), -2).requires_grad_()
        pixels, valid = camera.project(leaf)
        by = torch.zeros_like(pixels)
        count = points.shape[-2]
        by[:, :count, 0] = by[:, count:, 1] = 1.0
        (slopes,) = torch.autograd.grad(pixels, leaf, by)
    return pixels[:, :count].detach(), valid[:, :count], slopes.unflatten(1, (2, count)).transpose(1, 2)


def _normal(residuals: Tensor, valid: Tensor, columns: Tensor, weights: Tensor) -> Tensor:
    """(B, 7, 7), see `_Optimum`."""
    root = torch.where(valid, weights, 0.0).sqrt()[..., None, None]
    rows = (torch.cat((columns, residuals[..., None]), -1) * root).flatten(1, 2)
    normal: Tensor = rows.mT @ rows
    return normal


def _inverse(normal: Tensor) -> Tensor:
    """(B, 6, 6) of what is for the unknowns, whose units differ; not finite where there is none."""
    normal = normal[:, :6, :6]
    scale = normal.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(scale > 0, scale, 1.0).rsqrt()
    scale = scale[:, :, None] * scale[:, None]
    inverse, failed = torch.linalg.inv_ex(normal * scale)
    return torch.where((failed == 0)[:, None, None], inverse * scale, torch.nan)


class _Reprojection:
    """Poses of some rows of a task, for `minimise`: states are rotations (R, 3, 3) and translations (R, 3)."""

    def __init__(self, task: _Task, rows: Tensor):
        self.points, self.pixels, self.weights = (t.detach()[rows] for t in task[1:4])
        with torch.inference_mode(False):
            tensors = {name: getattr(task.camera, name).detach().clone() for name in task.camera.tensor_names}
        self.camera = remade(task.camera, **{name: t[rows] if t.ndim > 1 else t for name, t in tensors.items()})
        self.rounding = rounding_of(self.pixels, self.weights)

    def _of(self, rows: Tensor) -> tuple[Camera, Tensor, Tensor, Tensor]:
        whole = len(rows) == len(self.points)
        camera = self.camera if whole or not self.camera.batch_shape else self.camera[rows]
        points, pixels, weights = (t if whole else t[rows] for t in (self.points, self.pixels, self.weights))
        return camera, points, pixels, weights

    def cost(self, state: tuple[Tensor, ...], rows: Tensor) -> Tensor:
        """(R,)."""
        camera, points, seen_at, weights = self._of(rows)
        pixels, valid = camera.project(points @ state[0].mT + state[1][:, None])
        squares = torch.where(valid, (pixels - seen_at).square().sum(-1), _LOST**2)
        total = (squares * weights).sum(-1)
        return torch.where(torch.isfinite(total), total, torch.inf)

    def linear(self, state: tuple[Tensor, ...], rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Residuals (R, N, 2), whether there is a pixel, and derivatives (R, N, 2, 6) by turn and shift."""
        camera, points, seen_at, _ = self._of(rows)
        turned = points @ state[0].mT
        pixels, valid, slopes = _derivatives(camera, turned + state[1][:, None])
        turns = torch.linalg.cross(turned[:, :, None].expand_as(slopes), slopes)
        return torch.where(valid[..., None], pixels - seen_at, 0.0), valid, torch.cat((turns, slopes), -1)

    def linearised(self, state: tuple[Tensor, ...], rows: Tensor) -> System:
        """At a state."""
        residuals, valid, columns = self.linear(state, rows)
        root = torch.where(valid, self._of(rows)[3], 0.0).sqrt()[..., None, None]
        block = (torch.cat((columns, residuals[..., None]), -1) * root).flatten(1, 2)
        equations = Equations(triangle_of_few(block)[:, None], block.new_zeros(len(block), 1, 1))
        return System(equations, 6, torch.zeros(len(block), 0, dtype=torch.bool, device=block.device))

    def residuals(self, state: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """(B, N, 2) of all rows, and whether there is a pixel."""
        pixels, valid = self.camera.project(self.points @ state[0].mT + state[1][:, None])
        return torch.where(valid[..., None], pixels - self.pixels, 0.0), valid

    def moved(self, state: tuple[Tensor, ...], step: tuple[Tensor, ...], rows: Tensor) -> tuple[Tensor, ...]:
        """The state a step further."""
        turn, shift = step[0][:, 0].split(3, -1)
        return small_turn(turn) @ state[0], state[1] + shift


def _refined(task: _Task, rows: Tensor, rotations: Tensor, translations: Tensor, steps: int = _STEPS) -> _Found:
    """The minima that starts (R, ...) for some rows of the task lead to."""
    if len(rows) == 0:
        return _Found(translations[:, 0], rotations, translations)
    problem = _Reprojection(task, rows)
    counts = (problem.weights > 0).sum(-1)
    found = minimise(
        problem,
        (rotations, translations),
        tolerance=_SETTLED / (2 * counts - 6).clamp(min=1),
        tiny=_NOTHING**2 * counts,
        going=counts >= _LEAST,
        steps=steps,
        damping=_DAMPING,
    )
    rotations, translations = found.state
    complete = (problem.residuals(found.state)[1] | (problem.weights == 0)).all(-1)
    return _Found(torch.where(found.converged & complete, found.cost, torch.inf), rotations, translations)


def _covariance(found: _Optimum, middles: Tensor) -> Tensor:
    """(B, 6, 6) of turns, and shifts of the origin, from which the points' middles (B, 3) lie in the camera's axes."""
    variance = found.normal[:, 6, 6] / (2 * found.inliers.sum(-1) - 6).clamp(min=1)
    carried = torch.eye(6, dtype=middles.dtype, device=middles.device).repeat(len(middles), 1, 1)
    carried[:, 3:, :3] = skew_matrix(middles)
    covariance = carried @ (found.inverse * variance[:, None, None]) @ carried.mT
    return torch.where(found.valid[:, None, None], covariance, torch.nan)


def _mirrored(
    points: Tensor, weights: Tensor, rotations: Tensor, translations: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Whether points are nearly on a plane, and poses whose normals of it are mirrored at the line of sight."""
    share = weights / weights.sum(-1, keepdim=True)
    centre = (share[..., None] * points).sum(-2)
    centred = points - centre[:, None]
    variances, axes = torch.linalg.eigh((share[..., None] * centred).mT @ centred)
    flat, normal = variances[:, 0] <= _THIN**2 * variances[:, 2], axes[..., 0]
    middle = (rotations @ centre[..., None])[..., 0] + translations
    across_sight, in_plane = (
        torch.eye(3, dtype=v.dtype, device=v.device) - 2 * v[..., :, None] * v[..., None, :]
        for v in (normalize(middle, dim=-1), normal)
    )
    mirrored = across_sight @ rotations @ in_plane
    return flat, mirrored, middle - (mirrored @ centre[..., None])[..., 0]
