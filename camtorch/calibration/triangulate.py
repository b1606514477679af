"""Points from the pixels at which several cameras see them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch import Tensor
from torch.nn.functional import normalize

from camtorch._arguments import Numbers, as_number, hinting, working_dtype
from camtorch._module import BatchedModule
from camtorch._threads import on_one_thread
from camtorch.calibration.batches import as_tensor, learns, root_of, rows_of
from camtorch.calibration.bundle import Bundle, Free, Poses, Sight, State
from camtorch.calibration.rig import RigCalibration
from camtorch.camera import Camera
from camtorch.extrinsics import Extrinsics
from camtorch.least_squares.implicit import attached
from camtorch.least_squares.levenberg_marquardt import minimise

M = TypeVar("M", bound=BatchedModule)

_STEPS, _DAMPING = 60, 1e-8  # the first damping: the start is nearly the optimum
_SETTLED = 1e-8  # of the variance: the squared distance to the optimum, in standard deviations, that ends a search
_NOTHING = 1e-9  # px, that rounding may leave
_FAR = 100.0  # times the extent of the cameras' positions, where rays start that seem to meet behind the cameras
_FLEEING = 0.01  # of the distance: a point with a longer step to go is on its way to infinity
_SAME = 1e-5  # the relative difference of cameras and poses that are those of a calibration
_TOGETHER = 1 << 14  # points
_LEAST, _TINY = 1e-15, 1e-300  # added to what is divided by


class _Triangulation(NamedTuple):
    points: Tensor
    rms: Tensor
    valid: Tensor


class Triangulation(_Triangulation):
    """What `triangulate` returns; it unpacks into the first three."""

    points: Tensor
    """(*N, 3) in the world's frame."""
    rms: Tensor
    """(*N,) px: the root of the mean, over the cameras that see the point, of the squared distance; infinite where
    invalid."""
    valid: Tensor
    """(*N,) bool."""
    covariance: Tensor
    """(*N, 3, 3) of the points, for the noise of the pixels, and of the calibration where one is given; NaN where
    invalid. No graph."""

    def __new__(cls, points: Tensor, rms: Tensor, valid: Tensor, covariance: Tensor) -> Triangulation:
        """All four."""
        found = super().__new__(cls, points, rms, valid)
        found.covariance = covariance
        return found

    def __getnewargs__(self) -> tuple[Any, ...]:
        return (*self, self.covariance)


@on_one_thread
@hinting("It takes lists: ct.triangulate([camera, ...], [extrinsics, ...], pixels), pixels (C, N, 2)")
def triangulate(
    cameras: Sequence[Camera] | Camera,
    extrinsics: Sequence[Extrinsics] | Extrinsics,
    pixels: Numbers,
    *,
    sigma: float | None = None,
    calibration: RigCalibration | None = None,
) -> Triangulation:
    """The points whose projections are nearest to pixels of C cameras: least squares in px, of each point by itself.

    Any camera models, rays of any angle. The start is the point nearest to the rays, the optimum the
    Levenberg-Marquardt method's.

    Points and rms have first derivatives by pixels, extrinsics and the cameras' parameters, by the implicit function
    theorem at the optimum. All is computed in float64 and returned in the widest dtype that came in. It looks at
    values: not for torch.compile and vmap, whose batch goes in as *N.

    Args:
        cameras: C cameras without batch dims, in a list, or one for all; a camera with a batch of C is a list too.
        extrinsics: C poses, camera from world, likewise.
        pixels: (C, *N, 2); NaN is unseen, as is a pixel that its camera has no ray for.
        sigma: px, the standard deviation of a coordinate of a pixel, for the covariance. By default that of all
            residuals of this call, sqrt(sum of squares / sum of (2 C - 3)): two cameras leave one number a point, so
            that it takes many points, or cameras, to mean much.
        calibration: of `calibrate_rig`, which cameras and extrinsics are of: what it does not know is in the
            covariance too. The extrinsics may be from another world than the first camera.

    Returns:
        A `Triangulation`: points (*N, 3) in the world's frame, rms (*N,) in px and valid (*N,) bool; beside these three
        its attribute covariance (*N, 3, 3), to first order about the optimum. Invalid, finite
        and without a meaning, is a point that fewer than two cameras see, or whose rays do not meet in front of all of
        them, as rays that are parallel or diverge.

    Raises:
        TypeError: no cameras, extrinsics or numbers. ValueError: shapes and numbers that do not fit, cameras with
            further batch dims, fewer than two, a sigma that is negative, a calibration of other cameras.
    """
    if sigma is not None and not 0 <= as_number(sigma, "sigma", "triangulate") < math.inf:
        raise ValueError(f"triangulate: sigma must be px, not negative; got {sigma}")
    task = _Task.of(cameras, extrinsics, pixels)
    with torch.no_grad():
        points, valid, factor = _solved(task)
        if sigma is None:
            spare = torch.where(valid, 2 * task.seen.sum(0) - 3, 0).sum()
            factor = factor * (2 * task.cost(points)[valid].sum() / spare).sqrt()
        else:
            factor = factor * sigma
        covariance = factor @ factor.mT
        if calibration is not None:
            poses = task.rotations.detach(), task.translations.detach()
            moved = moved_by_calibration(calibration, task.cameras, *poses, points, task.seen & valid, "triangulate")
            covariance = covariance + moved @ moved.mT
        covariance = torch.where(valid[:, None, None], covariance, torch.nan)
    if learns([*task.given, *task.poses], task.pixels):
        points = attached(task.cost, points, valid)
    mean = 2 * task.cost(points) / task.seen.sum(0).clamp(min=1)
    rms = root_of(mean, valid).to(task.dtype).view(task.shape)
    covariance = covariance.to(task.dtype).view(*task.shape, 3, 3)
    return Triangulation(points.to(task.dtype).view(*task.shape, 3), rms, valid.view(task.shape), covariance)


@torch.no_grad()
def moved_by_calibration(
    calibration: RigCalibration,
    cameras: Sequence[Camera],
    rotations: Tensor,
    translations: Tensor,
    points: Tensor,
    seen: Tensor,
    owner: str,
) -> Tensor:
    """(P, 3, K): how K independent numbers of variance 1, the errors of a calibration, move points (P, 3).

    Of C cameras without batch dims, and their poses (C, 3, 3) and (C, 3), camera from world; seen: (C, P).

    Raises:
        TypeError: no calibration of a rig. ValueError: other cameras, or poses, than those of the calibration.
    """
    if not isinstance(calibration, RigCalibration):
        what = type(calibration).__name__
        raise TypeError(f"{owner}: calibration must be what ct.calibrate_rig returns; got {what}")
    rig, names, like = calibration.rig, list(calibration.rig.cameras), calibration.factor
    which: list[int] = []
    for c, camera in enumerate(cameras):
        own = torch.cat(camera._tensors, -1).to(like)
        for i, name in enumerate(names):
            other = torch.cat(rig.cameras[name]._tensors, -1).to(like)
            if i not in which and own.shape == other.shape and torch.allclose(own, other, rtol=_SAME, atol=_SAME):
                which.append(i)
                break
        else:
            raise ValueError(f"{owner}: calibration is of {', '.join(names)}, and cameras[{c}] is none of these")
    mounts = torch.stack([rig.extrinsics[names[i]].matrix().to(like) for i in which])
    turns, shifts = mounts[:, :3, :3], mounts[:, :3, 3]
    # of the world in the rig's frame
    turn = turns[0].mT @ rotations[0]
    shift = turns[0].mT @ (translations[0] - shifts[0])
    off = (turns @ turn - rotations).abs().amax()
    reach = shifts.abs().amax() + translations.abs().amax()
    if bool(off > _SAME) or bool((turns @ shift + shifts - translations).abs().amax() > _SAME * reach):
        raise ValueError(f"{owner}: the cameras do not stand to each other as in calibration.rig.extrinsics")
    columns = calibration.adjusted.equations.columns
    parameters = tuple(calibration.adjusted.state.parameters[i] for i in which)
    learns = [[(i, j) in columns for j in range(p.shape[-1])] for i, p in zip(which, parameters, strict=True)]
    mounted = tuple((i, p.shape[-1]) in columns for i, p in zip(which, parameters, strict=True))
    free = Free(tuple(torch.tensor(one, device="cpu") for one in learns), mounted, "positions")
    kinds = [type(rig.cameras[names[i]]) for i in which]
    moved = []
    for some, by in zip(points.split(_TOGETHER), seen.to(like).split(_TOGETHER, 1), strict=True):
        count = len(some)
        nothing = like.new_zeros(1, count, 1, 3)
        sights = [Sight(kind, nothing, nothing[..., :2], w[None, :, None]) for kind, w in zip(kinds, by, strict=True)]
        boards = Poses.none(1, count, like)._replace(translations=(some @ turn.mT + shift)[None])
        state = State(parameters, Poses(turns[None], shifts[None]), boards, like.new_zeros(1, 2))
        bundle = Bundle(sights, state, free, None, 1.0)
        one = torch.arange(1, device=like.device)
        normal, right = like.new_zeros(count, 3, 3), like.new_zeros(count, 3, like.shape[-1])
        for c, look in enumerate(bundle.looks(bundle.flat(state), one)):
            (block,), at = bundle.rows_of(c, look, state, one)
            by_point, rest = block[..., :3], block[..., 3:-1]
            cols = [columns.index((which[c], bundle.columns[g][1])) for g in at]
            normal += by_point.mT @ by_point
            right += by_point.mT @ (rest @ calibration.factor[cols])
        step, _ = torch.linalg.solve_ex(normal, right)  # of three unknowns, which squares do no harm
        moved.append(turn.mT @ -step)
    return torch.cat(moved) if moved else like.new_zeros(0, 3, 0)


class _Task(NamedTuple):
    """P points that C cameras see, float64, with graphs where there are: what is unseen is finite."""

    given: list[Camera]
    poses: list[Extrinsics]
    cameras: list[Camera]
    rotations: Tensor  # (C, 3, 3)
    translations: Tensor  # (C, 3)
    pixels: Tensor  # (C, P, 2)
    rays: Tensor  # (C, P, 3)
    seen: Tensor  # (C, P)
    shape: torch.Size
    dtype: torch.dtype

    @classmethod
    def of(
        cls, cameras: Sequence[Camera] | Camera, extrinsics: Sequence[Extrinsics] | Extrinsics, pixels: Numbers
    ) -> _Task:
        """What users pass, checked."""
        owner = "triangulate"
        device = pixels.device if isinstance(pixels, Tensor) else torch.device("cpu")
        seen_at = as_tensor(pixels, "pixels", owner, device)
        if seen_at.ndim < 2 or seen_at.shape[-1] != 2:
            raise ValueError(f"{owner}: pixels must be (C, *N, 2); got shape {tuple(seen_at.shape)}")
        count = len(seen_at)
        given, poses = _listed(cameras, "cameras", Camera, count), _listed(extrinsics, "extrinsics", Extrinsics, count)
        if not len(given) == len(poses) == count:
            raise ValueError(
                f"{owner}: it takes as many cameras as extrinsics and as pixels (C, *N, 2) have rows; got {len(given)} "
                f"cameras, {len(poses)} extrinsics and pixels {tuple(seen_at.shape)}"
            )
        if count < 2:
            raise ValueError(f"{owner}: it takes two cameras at least; got {count}")
        dtype = working_dtype(seen_at, *(t for camera in given for t in camera._tensors), *(p.rotation for p in poses))
        shape = seen_at.shape[1:-1]
        seen_at = seen_at.double().reshape(count, shape.numel(), 2)
        matrices = torch.stack([pose.matrix().double() for pose in poses])
        in_rows = [rows_of(camera, torch.Size()) for camera in given]
        with torch.no_grad():
            found = [camera.unproject(p) for camera, p in zip(in_rows, seen_at, strict=True)]
            rays, seen = map(torch.stack, zip(*found, strict=True))
        seen_at = torch.where(seen[..., None], seen_at, 0.0)
        return cls(given, poses, in_rows, matrices[:, :3, :3], matrices[:, :3, 3], seen_at, rays, seen, shape, dtype)

    def cost(self, points: Tensor) -> Tensor:
        """(P,) half the sum of squares at points (P, 3)."""
        total = torch.zeros_like(points[:, 0])
        for camera, rotation, translation, seen_at, seen in zip(
            self.cameras, self.rotations, self.translations, self.pixels, self.seen, strict=True
        ):
            pixels, valid = camera.project(points @ rotation.mT + translation)
            total = total + torch.where(valid & seen, (pixels - seen_at).square().sum(-1), 0.0)
        return 0.5 * total


def _listed(modules: Sequence[M] | M, name: str, kind: type[M], count: int) -> list[M]:
    """Modules without batch dims, of a list, of a batch, or of one for all."""
    if isinstance(modules, kind):
        listed = [modules[i] for i in range(len(modules))] if modules.batch_shape else [modules] * count
    else:
        try:
            listed = list(cast(Sequence[M], modules))
        except TypeError:
            what = type(modules).__name__
            raise TypeError(f"triangulate: {name} must be {kind.__name__} in a list; got a {what}") from None
    for module in listed:
        if not isinstance(module, kind):
            raise TypeError(f"triangulate: {name} must be {kind.__name__} in a list; got a {type(module).__name__}")
        if module.batch_shape:
            raise ValueError(
                f"triangulate: {name} must have no batch dims of their own; got one with {tuple(module.batch_shape)}"
            )
    return listed


def _solved(task: _Task) -> tuple[Tensor, Tensor, Tensor]:
    """(P, 3): the points of least cost, whether they are, and (P, 3, 3) how noise of variance 1 moves them."""
    rotations, translations, pixels = (t.detach() for t in (task.rotations, task.translations, task.pixels))
    seen = task.seen.to(pixels)
    positions = -(rotations.mT @ translations[..., None])[..., 0]
    rays = task.rays @ rotations
    start = _nearest(positions, rays, seen)
    if len(start) == 0:
        return start, torch.zeros_like(start[:, 0], dtype=torch.bool), start.new_zeros(0, 3, 3)
    middle = (seen[..., None] * positions[:, None]).sum(0) / seen.sum(0).clamp(min=1)[:, None]
    ahead = normalize((seen[..., None] * rays).sum(0), dim=-1)
    extent = (positions - positions.mean(0)).norm(dim=-1).amax()
    start = torch.where(_is_ahead(start, positions, rays, task.seen)[:, None], start, middle + _FAR * extent * ahead)

    # in the frame of the first camera
    count = len(start)
    first, shift = rotations[0], translations[0]
    turns = rotations @ first.mT
    moves = translations - (turns @ shift[:, None])[..., 0]
    parameters = [torch.cat(camera._tensors, -1).detach() for camera in task.cameras]
    state = State(
        tuple(p[None] for p in parameters),
        Poses(turns.expand(count, -1, 3, 3), moves.expand(count, -1, 3)),
        Poses.none(count, 1, start)._replace(translations=(start @ first.mT + shift)[:, None]),
        start.new_zeros(count, 2),
    )
    point = start.new_zeros(count, 1, 1, 3)
    sights = [
        Sight(camera, point, p[:, None, None], w[:, None, None])
        for camera, p, w in zip(task.cameras, pixels, seen, strict=True)
    ]
    nothing = tuple(torch.zeros(len(p), dtype=torch.bool, device=p.device) for p in parameters)
    problem = Bundle(sights, state, Free(nothing, (False,) * len(sights), "positions"), None, 1.0)
    views = task.seen.sum(0)
    found = minimise(
        problem,
        problem.flat(state),
        tolerance=_SETTLED / (2 * views - 3).clamp(min=1),
        tiny=_NOTHING**2 * views,
        going=views >= 2,
        steps=_STEPS,
        damping=_DAMPING,
    )
    every = torch.arange(count, device=start.device)
    system = problem.linearised(found.state, every)
    (step, _), _ = system.step(torch.zeros_like(found.cost))
    eye = torch.eye(3, dtype=start.dtype, device=start.device).expand(count, 3, 3)
    factor = first.mT @ torch.linalg.solve_triangular(system.equations.view[:, 0, :, :3], eye, upper=True)
    points = (found.state[1][:, 0] - shift) @ first
    distance = (points - middle).norm(dim=-1)
    valid = found.converged & (views >= 2) & _is_ahead(points, positions, rays, task.seen)
    valid = valid & (step[:, 0].norm(dim=-1) <= _FLEEING * distance) & torch.isfinite(points).all(-1)
    for c in range(len(sights)):
        valid = valid & (problem.look(c, found.state).valid[:, 0, 0] | ~task.seen[c])
    return torch.where(torch.isfinite(points), points, 0.0), valid, factor


def _nearest(positions: Tensor, rays: Tensor, seen: Tensor) -> Tensor:
    """(P, 3): the points nearest to rays (C, P, 3) from positions (C, 3), then nearest by angle."""
    eye = torch.eye(3, dtype=rays.dtype, device=rays.device)
    weights, points = seen, seen.new_zeros(seen.shape[1], 3)
    for _ in range(2):
        across = weights[..., None, None] * (eye - rays[..., :, None] * rays[..., None, :])
        right = (across @ positions[:, None, :, None]).sum(0)
        total = across.sum(0)
        scale = total.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        points = torch.linalg.solve_ex(total + (_LEAST * scale + _TINY) * eye, right)[0][..., 0]
        points = torch.where(torch.isfinite(points), points, 0.0)
        squares = (points - positions[:, None]).square().sum(-1)
        weights = seen / torch.where(squares > 0, squares, 1.0)
    return points


def _is_ahead(points: Tensor, positions: Tensor, rays: Tensor, seen: Tensor) -> Tensor:
    """(P,): whether points lie ahead on the rays of all that see them."""
    along = ((points - positions[:, None]) * rays).sum(-1)
    return ((along > 0) | ~seen).all(0)
