"""One camera from what it saw of known boards: `calibrate` and its result."""

from __future__ import annotations

import math
import warnings as python_warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch._arguments import as_number, as_whole, shown
from camtorch._threads import on_one_thread
from camtorch.calibration.bundle import LOSSES, Adjusted, Free, Poses, Sight, State, adjust
from camtorch.calibration.observations import Layout, Observations, Points, as_observations, repeats
from camtorch.calibration.start import other_cameras, other_poses, poses_for, start_from_nothing
from camtorch.calibration.uncertainty import Spread, noise_under, spread, uncertainty
from camtorch.calibration.verdict import check_determined, verdict, warnings
from camtorch.camera import Camera
from camtorch.camera import as_model as as_kind
from camtorch.extrinsics import Extrinsics
from camtorch.rotations import rotation_vector

INTRINSICS = ("fx", "fy", "cx", "cy")
STEPS = 300
_MANY = 100  # coefficients
_OUTLIER = 3.0  # standard deviations
_ROUNDS = 20
_SECOND_LOOKS = 3  # at the poses
_AS_GOOD = 9.0  # variances: the difference of two costs that three standard deviations explain
_APART, _SAME = 5.0, 1e-3  # standard deviations, and part of the parameter, of two optima


@dataclass(frozen=True)
class Model:
    """Which camera is asked for: a class, its number of coefficients, a camera to start from or None, what is held."""

    kind: type[Camera]
    count: int
    start: Camera | None
    free: Tensor
    """(4 + n,) bool, on the CPU."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of all parameters."""
        return (*INTRINSICS, *(self.kind.names_of(self.count) or ()))


def as_model(
    model: type[Camera] | str | Camera,
    count: int | None,
    start: Camera | None,
    fixed: Collection[str] | str,
    owner: str,
) -> Model:
    """What the arguments of `calibrate` say about the camera.

    Raises:
        ValueError: no such model, a number of coefficients that it does not take, unknown names in `fixed`, a start
            that is another model, that has a batch, or that is missing where a focal length is fixed. TypeError: no
            model.
    """
    if isinstance(model, Camera):
        if start is not None:
            raise ValueError(f"{owner}: model is a camera to start from already; got start={start!r} as well")
        start, model = model, type_before_parametrizations(model)
    model = as_kind(model, owner)
    if start is not None:
        start = _as_start(start, model, owner)
        if count is not None and count != start.distortion.shape[-1]:
            raise ValueError(f"{owner}: count={count}, and the start has {start.distortion.shape[-1]} coefficients")
        count = start.distortion.shape[-1]
    count = model.default_count if count is None else as_whole(count, "count", owner)
    names = model.names_of(count) if 0 <= count <= _MANY else None
    if names is None:
        limit = f", here {_MANY} at most" if count > _MANY else ""
        raise ValueError(f"{owner}: {model.__name__} takes {model.counts_text()}{limit}; got count={count}")
    names = (*INTRINSICS, *names)
    if not isinstance(fixed, Collection) or isinstance(fixed, Mapping):
        raise TypeError(f'{owner}: fixed must be names of parameters, as ("cx", "cy"), or "all"; got {fixed!r}')
    fixed = (names if fixed == "all" else (fixed,)) if isinstance(fixed, str) else tuple(fixed)
    unknown = [name for name in fixed if not isinstance(name, str) or name not in names]
    if unknown:
        raise ValueError(
            f"{owner}: fixed names {', '.join(map(repr, unknown))}; {model.__name__} has {', '.join(names)}"
        )
    if start is None and {"fx", "fy"} & set(fixed):
        raise ValueError(f"{owner}: a focal length is held at its value of the start; give start=a camera")
    return Model(model, count, start, torch.tensor([name not in fixed for name in names], device="cpu"))


def _as_start(start: Camera, model: type[Camera], owner: str) -> Camera:
    if not isinstance(start, Camera):
        raise TypeError(f"{owner}: start must be a camera; got {type(start).__name__}")
    if type_before_parametrizations(start) is not model:
        raise ValueError(
            f"{owner}: start is {type(start).__name__}, and the model {model.__name__}; "
            f"start.convert({model.__name__}).camera is one"
        )
    if start.batch_shape.numel() != 1:
        raise ValueError(f"{owner}: start must be one camera; got batch_shape={tuple(start.batch_shape)}")
    return start


def as_options(
    loss: str | None, loss_scale: float, bend: bool, progress: Callable[[int, float], None] | None, owner: str
) -> None:
    """Refuse what is no loss, no flag and no function."""
    if loss is not None and not (isinstance(loss, str) and loss in LOSSES):
        raise ValueError(f"{owner}: loss must be None or one of {LOSSES}; got {shown(loss)}")
    if not 0 < as_number(loss_scale, "loss_scale", owner) < math.inf:
        raise ValueError(f"{owner}: loss_scale must be positive pixels; got {loss_scale}")
    if not isinstance(bend, bool):
        raise TypeError(f"{owner}: bend must be True or False; got {bend!r}")
    if progress is not None and not callable(progress):
        raise TypeError(f"{owner}: progress must be a function of the step and the cost; got {progress!r}")


@dataclass(repr=False)
class Calibration:
    """What `calibrate` found, and how far it can be trusted.

    Units are pixels, and for poses those of the object points. The pose of a view is `extrinsics[i]`; views without a
    corner have none, nor have those that are equal to others, see `views`.
    """

    camera: Camera
    """The camera: float64, an ordinary module that goes on learning."""
    extrinsics: Extrinsics
    """Camera from board, of batch dims (V,)."""
    rms: float
    """The root of the mean squared length of the residuals, per point, as OpenCV's."""
    sigma: float
    """The standard deviation of a coordinate of a pixel: sqrt(sum of squares / (2 N - parameters)). With a robust loss
    that of the inliers."""
    residuals: Any
    """Projected minus observed, in the shape or the list form of the image points; NaN where nothing was seen, in
    views left out, and where a camera that did not converge has no pixel for what was seen."""
    inliers: Any
    """Bool, in the same form: the residual is shorter than max(3 loss_scale, 3 sigma of the inliers)."""
    parameter_names: tuple[str, ...]
    """fx, fy, cx, cy and the names of the coefficients."""
    spread: Spread = field(repr=False)
    """What the noise of the corners does to the parameters and the poses."""
    converged: bool
    """Whether nothing was left to gain when the search ended."""
    bend: tuple[float, float]
    """How far the middle of the board lies off the plane of its edges, along x and y; zeros unless it was asked for."""
    image_size: tuple[int, int]
    views: tuple[int, ...]
    """The numbers of the views that have poses, of those that were passed."""
    copies: tuple[int, ...]
    """The numbers of the views that show another one again: equal ones are left out, nearly equal ones widen the
    uncertainties until they count as one."""
    object_points: Any = field(repr=False)
    image_points: Any = field(repr=False)
    observations: Observations = field(repr=False)
    adjusted: Adjusted = field(repr=False)
    point_inliers: Tensor = field(repr=False)
    """(V, N) bool, the inliers of `observations`."""
    loss: str | None = None
    """The robust loss, if there was one."""
    index: int = field(default=0, repr=False)
    """Which of the cameras that were adjusted together it is."""
    twins: tuple[tuple[float, ...], ...] = field(default=(), repr=False)
    """The parameters of other optima that fit as well, to within the noise: of such a camera projections are known
    where corners were seen, and its parameters are not. Double spheres have them."""

    @property
    def covariance(self) -> Tensor:
        """(P, P) of the parameters, in their order; 0 for those that were fixed.

        With a robust loss that of the weighted problem at its optimum, by the noise that the loss leaves: intervals
        hold where outliers fall on all corners alike, and are somewhat too narrow where they gather in some views.
        """
        return self.spread.covariance[0]

    @property
    def std(self) -> Tensor:
        """(P,) the standard deviations of the parameters; 0 for those that were fixed."""
        return self.spread.std[0]

    @property
    def point_residuals(self) -> Tensor:
        """(V, N, 2) the residuals of `observations`."""
        return self.adjusted.residuals[self.index][0]

    def uncertainty(self, pixels: Any, distance: float = math.inf) -> Tensor:
        """How far the camera may be wrong about pixels, were it calibrated again from other images of such quality.

        The standard deviation in the worst direction of where a point is seen, with the poses of the boards in their
        own uncertainty: mrcal's mean-pcam.

        Args:
            pixels: (..., 2).
            distance: from the camera, in units of the object points.

        Returns:
            (...,) px; NaN where a pixel has no ray.
        """
        return uncertainty(self.spread, pixels, distance)

    @cached_property
    def warnings(self) -> list[str]:
        """What the data do not carry, and what does not fit, in words: each with what to do."""
        return warnings(self)

    @property
    def verdict(self) -> str:
        """In words: what it is good for, up to which angle, and what to photograph next."""
        return verdict(self)

    def __repr__(self) -> str:
        values = [*self.camera.intrinsics.tolist(), *self.camera.distortion.tolist()]
        pairs = zip(self.parameter_names, values, self.std.tolist(), strict=True)
        numbers = [f"  {name} = {value:.7g}" + (f" +- {std:.2g}" if std else "") for name, value, std in pairs]
        count, seen = len(self.views), int(self.observations.seen.sum())
        head = (
            f"Calibration({type(self.camera).__name__}: rms {self.rms:.4g} px, sigma {self.sigma:.4g} px, "
            f"{count} view{'s' * (count != 1)}, {seen} corners{'' if self.converged else ', NOT CONVERGED'})"
        )
        return "\n".join((head, *numbers, *(f"  ! {text}" for text in self.warnings)))


@on_one_thread
def calibrate(
    model: type[Camera] | str | Camera,
    object_points: Points,
    image_points: Points,
    *,
    image_size: Sequence[int],
    count: int | None = None,
    start: Camera | None = None,
    fixed: Collection[str] | str = (),
    loss: str | None = None,
    loss_scale: float = 1.0,
    bend: bool = False,
    progress: Callable[[int, float], None] | None = None,
) -> Calibration:
    """The camera of a model under which known points are seen where they were seen, from nothing.

    No focal length has to be given, and angles may go beyond 90 degrees. Least squares of the distances in pixels, over
    the parameters of the camera and the poses of all views.

    Args:
        model: a class of cameras, its key, or a camera to start from.
        object_points: (N, 3) for all views, (V, N, 3), or a list of (N_i, 3), in the board's frame and any unit.
        image_points: (V, N, 2) or a list of (N_i, 2), in pixels, (0, 0) the centre of the top-left one. Rows with NaN
            are unseen.
        image_size: (height, width), as `image.shape`.
        count: of the coefficients; the model's default if left out.
        start: a camera to start from, of the model.
        fixed: names of parameters that are held ("cx", "k3", ...) where the start has them; without a start distortion
            at zero and the principal point in the middle of the image. "all" leaves the poses alone to be found.
        loss: None for least squares, "huber" or "cauchy" where some corners may be wrong; of a residual's length.
        loss_scale: px, from where a robust loss grows slower.
        bend: whether the board may be bent: two numbers more, see `Calibration.bend`.
        progress: called after each step of the final search with its number and the cost.

    Raises:
        ValueError: bad arguments, each with what to do; a problem that has no one solution, as a single view of a plane
            may be.
    """
    owner = "calibrate"
    seen, layout = as_observations(object_points, image_points, image_size, owner)
    asked = as_model(model, count, start, fixed, owner)
    as_options(loss, loss_scale, bend, progress, owner)
    # about its middle a pose's turn and its shift keep apart
    middle = middle_of([seen])
    centred = seen.about(middle)
    first = first_state(centred, asked, layout.image_size, loss, loss_scale)
    free = Free((asked.free.to(seen.pixels.device),), (False,), bend=bend)
    told = None if progress is None else lambda number, cost: progress(number, float(cost))
    adjusted = adjusted_alone(centred, asked, first, free, layout.image_size, loss, loss_scale, progress=told)
    sights = [sight_of(centred, asked)]
    adjusted, optima = other_optima(0, centred, asked, sights, adjusted, free, layout.image_size, loss, loss_scale)
    check_determined(adjusted, [asked.kind], [asked.names], sights, [owner])
    free_parameters = free_count(adjusted, [seen.seen])
    noise = noise_of(adjusted.residuals[0][0], seen.seen, adjusted.valid[0][0], loss, loss_scale, free_parameters)
    (layout,), noise = counted_once([seen], adjusted, [layout], noise)
    result = result_of(adjusted, 0, asked, seen, middle, layout, noise, (object_points, image_points))
    result.twins = twins_of(result, optima)
    if not result.converged:
        python_warnings.warn(
            f"{owner}: the search did not end at an optimum (rms {result.rms:.4g} px); do not use it. See its warnings",
            stacklevel=2,
        )
    return result


def middle_of(seen: Iterable[Observations]) -> Tensor:
    """(3,) of all points of boards that were seen."""
    points = torch.cat([s.points[s.seen] for s in seen])
    return (points.amin(0) + points.amax(0)) / 2


def first_state(
    seen: Observations, asked: Model, image_size: tuple[int, int], loss: str | None, loss_scale: float
) -> State:
    """Where to start from: nothing, or a camera that was given."""
    if asked.start is None:
        fixed = [name for name, free in zip(asked.names, asked.free.tolist(), strict=True) if not free]
        return start_from_nothing(
            seen, asked.kind, asked.count, image_size, fixed=fixed, loss=loss, loss_scale=loss_scale
        )
    given = (t.detach().to(seen.pixels).reshape(1, -1) for t in (asked.start.intrinsics, asked.start.distortion))
    return poses_for(torch.cat(tuple(given), -1), seen, asked.kind, image_size)


def sight_of(seen: Observations, asked: Model) -> Sight:
    """What a camera sees, as one problem."""
    return Sight(asked.kind, seen.points[None], seen.pixels[None], seen.seen[None].to(seen.pixels))


def adjusted_alone(
    seen: Observations,
    asked: Model,
    first: State,
    free: Free,
    image_size: tuple[int, int],
    loss: str | None,
    loss_scale: float,
    progress: Callable[[int, Tensor], None] | None = None,
) -> Adjusted:
    """The optimum for one camera near a state, and with other poses where those are better by the camera found."""

    def optimum(state: State) -> Adjusted:
        sight = sight_of(seen, asked)
        return adjust([sight], state, free, loss=loss, loss_scale=loss_scale, steps=STEPS, progress=progress)

    adjusted = optimum(first)
    for _ in range(_SECOND_LOOKS):
        other = other_poses(adjusted.state, seen, asked.kind, image_size)
        again = adjusted if other is adjusted.state else optimum(other)
        if not bool(again.cost < adjusted.cost):
            break
        adjusted = again
    return adjusted


class Optima(NamedTuple):
    """Where searches ended: the parameters (S, 4 + n) of one camera, the costs and whether they converged, (S,)."""

    parameters: Tensor
    cost: Tensor
    converged: Tensor


def other_optima(
    camera: int,
    seen: Observations,
    asked: Model,
    sights: Sequence[Sight],
    adjusted: Adjusted,
    free: Free,
    image_size: tuple[int, int],
    loss: str | None,
    loss_scale: float,
) -> tuple[Adjusted, Optima | None]:
    """An optimum, or a better one in another basin of a camera's model, and all; None where it has but one.

    Args:
        camera: which of the cameras of the problem it is.
        seen: what it saw.
        asked: its model.
        sights: what all cameras saw.
        adjusted: the optimum.
        free: what learns.
        image_size: (height, width).
        loss: as `calibrate` takes it.
        loss_scale: px.
    """
    state = adjusted.state
    rotations, translations = (t[:, camera, None] for t in state.mounts)
    boards = Poses(rotations @ state.boards.rotations, state.boards.translations @ rotations[:, 0].mT + translations)
    starts = other_cameras(
        state.parameters[camera], free.parameters[camera].cpu(), boards, seen, asked.kind, image_size
    )
    if starts is None:
        return adjusted, None
    first = state.of(torch.zeros(len(starts), dtype=torch.long, device=starts.device))
    parameters = tuple(starts if c == camera else p for c, p in enumerate(first.parameters))
    others = adjust(sights, first._replace(parameters=parameters), free, loss=loss, loss_scale=loss_scale)
    ends = (
        (others.state.parameters[camera], state.parameters[camera]),
        (others.cost, adjusted.cost),
        (others.converged, adjusted.converged),
    )
    best = others.cost.argmin()[None]
    variance = adjusted.cost / (2 * sum(int((sight.weights > 0).sum()) for sight in sights))
    if bool(others.cost[best] < adjusted.cost - _AS_GOOD * variance):  # one as good is no reason to leave the first
        adjusted = adjust(sights, others.state.of(best), free, loss=loss, loss_scale=loss_scale, steps=STEPS)
    return adjusted, Optima(*map(torch.cat, ends))


def twins_of(found: Calibration, optima: Optima | None) -> tuple[tuple[float, ...], ...]:
    """The parameters of optima that the noise does not tell from the one found, and that are apart from it."""
    if optima is None or not found.converged:
        return ()
    as_good = optima.converged & (optima.cost - found.adjusted.cost[0] <= _AS_GOOD * found.sigma**2)
    twins = [found.spread.parameters[0]]
    for new in optima.parameters[as_good][optima.cost[as_good].argsort()]:
        if all(bool(((new - p).abs() > _APART * found.std + _SAME * p.abs().clamp(min=1)).any()) for p in twins):
            twins.append(new)
    return tuple(tuple(p.tolist()) for p in twins[1:])


class Noise(NamedTuple):
    """Of the corners: the inliers, bool (V, N), sigma, and what makes the covariance; px per coordinate.

    Without a loss both are one number.
    """

    inliers: Tensor
    sigma: Tensor
    spread: Tensor
    loss: str | None


def noise_of(residuals: Tensor, seen: Tensor, valid: Tensor, loss: str | None, loss_scale: float, free: int) -> Noise:
    """The inliers, bool (V, N), and sigma: that of all residuals, with a robust loss that of the inliers.

    A residual of an inlier is shorter than max(3 loss_scale, 3 sigma of the inliers).

    Args:
        residuals: (V, N, 2).
        seen: (V, N) bool.
        valid: (V, N) bool; where it is not, nothing fits.
        loss: as `calibrate` takes it.
        loss_scale: px.
        free: the number of parameters that were free.
    """
    lengths = torch.linalg.vector_norm(residuals, dim=-1)
    inliers = seen & valid
    whole = sigma = _sigma_of(lengths[inliers], free)
    for _ in range(_ROUNDS):
        found = seen & valid & (lengths < _OUTLIER * max(loss_scale, float(sigma)))
        if torch.equal(found, inliers):
            break
        inliers, sigma = found, _sigma_of(lengths[found], free)
    if loss is None:
        return Noise(inliers, whole, whole, loss)
    return Noise(inliers, sigma, noise_under(loss, loss_scale, [residuals], [seen & valid], free), loss)


def counted_once(
    seen: Sequence[Observations], adjusted: Adjusted, layouts: Sequence[Layout], noise: Noise
) -> tuple[list[Layout], Noise]:
    """With the views named that repeat others, and a noise as if there were so many less views of each."""
    again = repeats(seen, [r[0] for r in adjusted.residuals])
    total = len(seen[0].seen)
    named = [
        layout._replace(copies=tuple(sorted({*layout.copies, *layout.views[again[one.seen[again].any(-1)]].tolist()})))
        for layout, one in zip(layouts, seen, strict=True)
    ]
    return named, noise._replace(spread=noise.spread * math.sqrt(total / (total - len(again))))


def _sigma_of(lengths: Tensor, free: int) -> Tensor:
    """The standard deviation of a coordinate from the lengths of residuals, (N,)."""
    return (lengths.square().sum() / max(2 * len(lengths) - free, 1)).sqrt()


def free_count(adjusted: Adjusted, seen: Sequence[Tensor]) -> int:
    """How many parameters were free, poses of boards that were seen included. seen: (V, N) of each camera."""
    views = torch.stack([s.any(-1) for s in seen]).any(0)
    return len(adjusted.equations.columns) + 6 * int(views.sum())


def result_of(
    adjusted: Adjusted,
    camera: int,
    asked: Model,
    seen: Observations,
    middle: Tensor,
    layout: Layout,
    noise: Noise,
    passed: tuple[Any, Any],
) -> Calibration:
    """The result for one of the cameras.

    Args:
        adjusted: the optimum, with the boards about their middle.
        camera: which one.
        asked: its model.
        seen: what it saw, in the frame of the boards as they were passed.
        middle: (3,) of the boards.
        layout: of its image points.
        noise: of its corners.
        passed: the object points and image points as they came.
    """
    state, residuals = adjusted.state, adjusted.residuals[camera][0]
    parameters = state.parameters[camera][0]
    arguments = (parameters[:4], parameters[4:]) if asked.count else (parameters[:4],)
    made = asked.kind(*arguments, image_size=layout.image_size)
    rotations, translations = (t[0] for t in state.boards)
    mount = tuple(t[0, camera] for t in state.mounts)
    rotations, translations = mount[0] @ rotations, translations @ mount[0].mT + mount[1]
    translations = translations - rotations @ middle
    found = spread(adjusted, asked.kind, camera, noise.spread.reshape(1))
    whole = torch.where(seen.seen, torch.linalg.vector_norm(residuals, dim=-1), 0.0)
    return Calibration(
        camera=made,
        extrinsics=Extrinsics(rotation_vector(rotations).unsqueeze(-1), translations),
        rms=float((whole.square().sum() / seen.seen.sum().clamp(min=1)).sqrt()),
        sigma=float(noise.sigma),
        residuals=layout.restore(torch.where(adjusted.valid[camera][0][..., None], residuals, torch.nan)),
        inliers=layout.restore(noise.inliers),
        parameter_names=asked.names,
        spread=found,
        converged=bool(adjusted.converged[0]) and bool((adjusted.valid[camera][0] | ~seen.seen).all()),
        bend=(float(state.bend[0, 0]), float(state.bend[0, 1])),
        image_size=layout.image_size,
        views=tuple(layout.views.tolist()),
        copies=layout.copies,
        object_points=passed[0],
        image_points=passed[1],
        observations=seen,
        adjusted=adjusted,
        point_inliers=noise.inliers,
        loss=noise.loss,
        index=camera,
    )
