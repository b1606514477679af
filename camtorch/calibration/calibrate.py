"""The calibration of one camera from views of known boards: `calibrate`."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from camtorch.calibration.board_poses import Lens, other_poses, poses_for
from camtorch.calibration.bundle import Adjusted, CameraObservations, Free, Poses, Prior, State, adjust
from camtorch.calibration.model import Model, asked_model
from camtorch.calibration.observations import Layout, Observations, Points, as_observations, repeats
from camtorch.calibration.robust import Loss, as_loss
from camtorch.calibration.start import other_cameras, start_from_nothing
from camtorch.calibration.uncertainty import Spread, shared_factor, spread
from camtorch.calibration.verdict import Calibration, check_determined
from camtorch.cameras.camera import Camera
from camtorch.poses.extrinsics import Extrinsics
from camtorch.poses.rotations import rotation_vector
from camtorch.values.arguments import as_flag, hinting, warn
from camtorch.values.threads import on_one_thread

STEPS = 300
_SMOOTH = 0.02  # the weight of a surface's second differences, in px, see `Camera.smoothness`
_BESIDE = 1e-3  # radians from the axis: the second point that holds a surface's frame
_AS_GOOD = 9.0  # variances: optima whose costs differ by less are equally good


@on_one_thread
@hinting('A model comes first: ct.calibrate("brown_conrady", object_points, image_points, image_size=(height, width))')
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
) -> Calibration:
    """Calibrate a camera of a model from known points and their pixels, without a focal length to start from.

    The result has the least squared distances in pixels, over the camera's parameters and the poses of all views.

    Args:
        model: Class of cameras, its key, or a camera to start from.
        object_points: (N, 3) for all views, (V, N, 3), or a list of (N_i, 3), in the board's frame and any unit.
        image_points: (V, N, 2) or a list of (N_i, 2), in pixels, (0, 0) the top-left one's centre; NaN if unseen.
        image_size: (height, width), as `image.shape`.
        count: Number of coefficients; the model's default if left out.
        start: A camera to start from, of the model.
        fixed: Names of parameters to hold ("cx", "k3", ...) at the start's values; without a start at zero distortion,
            and the principal point in the middle of the image. "all" finds the poses only.
        loss: None for least squares; "cauchy" or "huber", of a residual's length, if some corners may be wrong. With
            5 % of the corners exchanged, coefficients of "huber" spread by up to 1.6 times what `std` claims, those of
            "cauchy" as claimed.
        loss_scale: px, the length from which a robust loss grows slower.
        bend: Whether the board may be bent, which adds two unknowns, see `Calibration.bend`.

    Raises:
        ValueError: If an argument is bad, or the views do not determine the camera, as a single view of a plane.

    Example:
        >>> board = [[x, y, 0.0] for y in range(5) for x in range(6)]
        >>> lens = ct.KannalaBrandt([300.0, 300.0, 319.5, 239.5], [0.1, 0.0, 0.0, 0.0], image_size=(480, 640))
        >>> turns = [[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, -0.5, 0.5]]
        >>> pixels, _ = lens.project(ct.Extrinsics(turns, [[-2.5, -2.0, 5.0]] * 4)([board]))  # (4, 30, 2)
        >>> ct.calibrate("kannala_brandt", board, pixels, image_size=(480, 640)).rms < 0.001
        True
    """
    owner = "calibrate"
    seen, layout = as_observations(object_points, image_points, image_size, owner)
    robust, bend = as_loss(loss, loss_scale, owner), as_flag(bend, "bend", owner)
    asked = asked_model(model, count, start, fixed, layout.image_size, owner)
    search = Search(owner, asked, seen, layout, middle_of([seen]), robust)
    (result,), _ = results([search], search.alone(bend), search.free(bend))
    if not result.converged:
        warn(f"{owner}: {result.failure} (rms {result.rms:.4g} px). Do not use the result; see its warnings")
    return result


def middle_of(seen: Sequence[Observations]) -> Tensor:
    """Return the middle (3,) of all seen points of boards."""
    points = torch.cat([s.points[s.seen] for s in seen])
    return (points.amin(0) + points.amax(0)) / 2


@dataclass
class Search:
    """The search for one camera: its model, observations and loss."""

    owner: str  # the function, and the camera's name in a rig, for messages
    asked: Model
    seen: Observations
    layout: Layout  # of what was passed
    middle: Tensor  # (3,) of the boards
    loss: Loss

    @cached_property
    def centred(self) -> Observations:
        """Observations with boards about their middle, which makes a pose's turn and shift nearly independent."""
        return self.seen._replace(points=torch.where(self.seen.seen[..., None], self.seen.points - self.middle, 0.0))

    @cached_property
    def observed(self) -> CameraObservations:
        """The observations for an adjustment, with the prior of a surface."""
        return CameraObservations.of_one(self.asked.kind, self.centred, self._prior())

    def _prior(self) -> Prior | None:
        """Return the prior of a surface that starts from a camera, whose shape it keeps where nothing is seen."""
        kind, start, smooth = self.asked.kind, self.asked.start, self.asked.kind.smoothness()
        if start is None or smooth is None:
            return None
        like = self.seen.pixels
        core, coefficients = (t.detach().to(like).reshape(-1) for t in (start.intrinsics, start.distortion))
        axis = like.new_tensor([[0.0, 0.0, 1.0], [_BESIDE, 0.0, 1.0]])

        def frame(coefficients: Tensor) -> Tensor:
            (x, y), (_, right) = kind(core, coefficients).project(axis)[0]
            return torch.stack((x, y, (right - y) / _BESIDE / 10))

        # a surface can imitate a turn of the camera, so its frame is held at the start's
        rows = _SMOOTH * float(core[:2].mean()) * smooth.to(like), torch.func.jacrev(frame)(coefficients)
        return Prior(torch.cat((core, coefficients)), torch.nn.functional.pad(torch.cat(rows), (4, 0)))

    def free(self, bend: bool = False) -> Free:
        """Return the unknowns of a search for this camera alone; `bend` adds the board's shape."""
        return Free((self.asked.free.to(self.seen.pixels.device),), bend=bend)

    def alone(self, bend: bool = False) -> Adjusted:
        """Return the optimum for this camera's views; poses are searched again and kept if they fit it better."""
        asked, seen = self.asked, self.centred

        def optimum(state: State) -> Adjusted:
            return adjust([self.observed], state, self.free(bend), loss=self.loss, steps=STEPS)

        if asked.start is None and asked.kind.smoothness() is not None:
            raise ValueError(
                f"{self.owner}: start must be a camera, of any model, as {asked.kind.__name__} learns a surface over "
                'its lens; got None. Pass start=calibrate("kannala_brandt", ...).camera'
            )
        if asked.start is None:
            with torch.inference_mode():  # takes a tenth less time, and no graph needs the result
                first = start_from_nothing(seen, asked, self.loss)
            first = first.of(torch.arange(1, device=seen.pixels.device))
        else:
            given = torch.cat([t.detach().to(seen.pixels).reshape(1, -1) for t in asked.start.tensors], -1)
            first = poses_for(Lens(asked.kind, given, Poses.none(1, 1, given)), seen)
        adjusted = optimum(first)
        for _ in range(3):
            other = other_poses(adjusted, seen, asked.kind)
            if other is None:
                break
            again = optimum(other)
            if not bool(again.cost < adjusted.cost):
                break
            adjusted = again
        return adjusted

    def in_best_basin(
        self, camera: int, observed: Sequence[CameraObservations], adjusted: Adjusted, free: Free
    ) -> Adjusted:
        """Return the best optimum of this model's basins, if it has several."""
        state = adjusted.state
        lens = Lens(self.asked.kind, state.parameters[camera], state.boards_from(camera))
        starts = other_cameras(lens, self.asked, self.centred)
        if starts is None:
            return adjusted
        first = state.of(torch.zeros(len(starts), dtype=torch.long, device=starts.device))
        parameters = tuple(starts if c == camera else p for c, p in enumerate(first.parameters))
        others = adjust(observed, first._replace(parameters=parameters), free, loss=self.loss)
        best = others.cost.argmin()[None]
        variance = adjusted.cost / (2 * sum(int((one.weights > 0).sum()) for one in observed))
        if not bool(others.cost[best] < adjusted.cost - _AS_GOOD * variance):  # an equal one does not replace the first
            return adjusted
        return adjust(observed, others.state.of(best), free, loss=self.loss, steps=STEPS)

    def result(
        self, camera: int, adjusted: Adjusted, spread: Spread, sigma: float, inliers: Tensor, again: Tensor
    ) -> Calibration:
        """Return the calibration of a camera by its index; inliers (V, N), and the indices of views seen `again`."""
        seen, layout, state = self.seen, self.layout, adjusted.state
        residuals, has_pixel = adjusted.residuals[camera][0], adjusted.valid[camera][0]
        copies = layout.views[again[seen.seen[again].any(-1)]]
        return Calibration(
            camera=self.asked.camera(state.parameters[camera][0]),
            extrinsics=extrinsics_of(state.boards_from(camera), self.middle),
            rms=rms_of(residuals, seen.seen),
            sigma=sigma,
            residuals=layout.restore(torch.where(has_pixel[..., None], residuals, torch.nan), seen.seen),
            inliers=layout.restore(inliers, seen.seen),
            parameter_names=self.asked.names,
            spread=spread,
            converged=bool(adjusted.converged[0]) and bool((has_pixel | ~seen.seen).all()),
            bend=(float(state.bend[0, 0]), float(state.bend[0, 1])),
            image_size=layout.image_size,
            views=tuple(layout.views.tolist()),
            copies=tuple(copies.tolist()),
            observations=seen,
            adjusted=adjusted,
            point_inliers=inliers,
            loss=self.loss.name,
            index=camera,
        )


def results(searches: Sequence[Search], adjusted: Adjusted, free: Free) -> tuple[list[Calibration], Tensor]:
    """Return the calibrations at an optimum, or at a better one in another basin of a model, and the noise in px.

    The noise, a tensor (), scales all covariances; without a loss it is sigma.
    """
    observed = [search.observed for search in searches]
    for c, search in enumerate(searches):
        adjusted = search.in_best_basin(c, observed, adjusted, free)
    spreads = [spread(adjusted, search.asked.kind, c) for c, search in enumerate(searches)]
    for c, search in enumerate(searches):
        check_determined(adjusted, c, spreads[c], search.asked.names, observed[c], search.owner)
    loss, given = searches[0].loss, [search.seen for search in searches]
    seen = torch.cat([one.seen for one in given])
    residuals, valid = (torch.cat([t[0] for t in of_all]) for of_all in (adjusted.residuals, adjusted.valid))
    views = torch.stack([one.seen.any(-1) for one in given]).any(0)
    inliers, sigma, noise = noise_of(residuals, seen, valid, loss, unknowns(observed, adjusted, int(views.sum())))
    again = repeats(given, [r[0] for r in adjusted.residuals])  # widen uncertainty as if they were missing
    noise = noise * math.sqrt(len(views) / (len(views) - len(again)))
    found = [
        search.result(c, adjusted, spreads[c].scaled(noise.reshape(1)), float(sigma), own, again)
        for c, (search, own) in enumerate(zip(searches, inliers.split(len(views)), strict=True))
    ]
    return found, noise


def extrinsics_of(boards: Poses, middle: Tensor) -> Extrinsics:
    """Return the poses (V,) of boards, of a single problem, from those about the boards' middle."""
    rotations, translations = (t[0] for t in boards)
    return Extrinsics(rotation_vector(rotations).unsqueeze(-1), translations - rotations @ middle)


def unknowns(observed: Sequence[CameraObservations], adjusted: Adjusted, views: int) -> float:
    """Return the number of unknowns that the residuals determine: those that learn, less the priors' share."""
    factor, by_priors = shared_factor(adjusted.equations), 0.0
    for c, one in enumerate(observed):
        if one.prior:
            places, own = adjusted.problem.learnt[c]
            by_priors += float((one.prior.root[:, own] @ factor[0, places]).square().sum())
    return adjusted.problem.shared_width + 6 * views - by_priors


def rms_of(residuals: Tensor, seen: Tensor) -> float:
    """Return the root mean square of the seen residuals, px per point."""
    lengths = torch.where(seen, torch.linalg.vector_norm(residuals, dim=-1), 0.0)
    return float((lengths.square().sum() / seen.sum().clamp(min=1)).sqrt())


def noise_of(residuals: Tensor, seen: Tensor, valid: Tensor, loss: Loss, free: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return inliers, bool (V, N), sigma (see `Calibration`) and the noise for the covariance; free: parameters."""

    def sigma_of(lengths: Tensor) -> Tensor:
        return (lengths.square().sum() / max(2 * len(lengths) - free, 1)).sqrt()

    lengths = torch.linalg.vector_norm(residuals, dim=-1)
    inliers = seen & valid
    whole = sigma = sigma_of(lengths[inliers])
    for _ in range(20):
        found = seen & valid & (lengths < 3 * max(loss.scale, float(sigma)))
        if torch.equal(found, inliers):
            break
        inliers, sigma = found, sigma_of(lengths[found])
    if loss.name is None:
        return inliers, whole, whole
    return inliers, sigma, loss.noise(residuals, seen & valid, free)
