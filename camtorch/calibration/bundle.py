"""Bundle adjustment: the cameras, their mounts and the boards' poses of least reprojection error.

A QR reduces each view to a triangle before views are joined. It eliminates the view's own six unknowns as a Schur
complement does, without the squares of normal equations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from camtorch.calibration.native_calls import Errors, PoseSearch, project_views, refine_poses, turned_by
from camtorch.calibration.observations import Observations
from camtorch.calibration.robust import LEAST_SQUARES, Loss
from camtorch.cameras.camera import Camera
from camtorch.cameras.operators import fixed_camera
from camtorch.convert.fitting import bounds
from camtorch.least_squares.equations import Equations, System, padded, triangle_of_few
from camtorch.least_squares.jacobians import sensor_jacobians
from camtorch.least_squares.levenberg_marquardt import FIRST_DAMPING, minimise, rounding_of
from camtorch.native.structs import LOST
from camtorch.poses.rotations import small_turn
from camtorch.projection import native_calls
from camtorch.projection.evaluation import native_forms
from camtorch.projection.rows import CameraRows
from camtorch.values.module import remade

SETTLED = 1e-10  # see `adjust`
_NOTHING = 1e-11  # px


class Poses(NamedTuple):
    """Rotations (B, P, 3, 3) and translations (B, P, 3)."""

    rotations: Tensor
    translations: Tensor

    def moved(self, points: Tensor) -> Tensor:
        """Return points moved by the poses, (B, P, N, 3)."""
        return points @ self.rotations.mT + self.translations.unsqueeze(-2)

    def of(self, index: Tensor | slice, dim: int = 0) -> Poses:
        """Return some of the poses, by batch row or by view."""
        return Poses(*(t[index] if dim == 0 else t[:, index] for t in self))

    def expand(self, batch: int) -> Poses:
        return Poses(*(t.expand(batch, *t.shape[1:]) for t in self))

    def with_views(self, index: Tensor, other: Poses) -> Poses:
        return Poses(*(t.index_copy(1, index, new) for t, new in zip(self, other, strict=True)))

    @classmethod
    def where(cls, which: Tensor, a: Poses, b: Poses) -> Poses:
        """Return the poses of a at which `which`, bool (P,), is true, and those of b elsewhere."""
        return cls(*(torch.where(which.view(-1, *[1] * (x.ndim - 2)), x, y) for x, y in zip(a, b, strict=True)))

    @classmethod
    def none(cls, batch: int, count: int, like: Tensor) -> Poses:
        """Return identity poses."""
        eye = torch.eye(3, dtype=like.dtype, device=like.device)
        return cls(eye.repeat(batch, count, 1, 1), like.new_zeros(batch, count, 3))


class Prior(NamedTuple):
    """Prior knowledge of a camera's parameters p: root @ (p - centre) are further residuals."""

    centre: Tensor  # (P,)
    root: Tensor  # (R, P), in pixels


class CameraObservations(NamedTuple):
    """The observations of one camera for B problems, V views and N points each; leading dims may be 1."""

    model: type[Camera]
    points: Tensor  # (B, V, N, 3) in the board's frame
    pixels: Tensor  # (B, V, N, 2)
    weights: Tensor  # (B, V, N) of the squares, 0 for unseen points, whose other numbers are any finite ones
    prior: Prior | None = None

    @classmethod
    def of_one(cls, model: type[Camera], seen: Observations, prior: Prior | None = None) -> CameraObservations:
        """Return the observations of one camera, for one problem."""
        return cls(model, seen.points[None], seen.pixels[None], seen.seen.to(seen.pixels)[None], prior)

    def mapped(self, change: Callable[[Tensor], Tensor]) -> CameraObservations:
        """Return the observations with a change applied to all tensors of problems."""
        points, pixels, weights = map(change, self[1:4])
        return CameraObservations(self.model, points, pixels, weights, self.prior)


class State(NamedTuple):
    """The unknowns of a search. A point of a board is at `mount(board(point))` for a camera."""

    parameters: tuple[Tensor, ...]  # of each camera (B, 4 + n), fx, fy, cx, cy and the coefficients
    mounts: Poses  # of each camera, from the first one's frame; the first is the identity
    boards: Poses  # of each view
    bend: Tensor  # (B, 2), how far the board's middle lies behind its edges along x and y, see `bend_points`

    @classmethod
    def of_one(cls, parameters: Tensor, boards: Poses) -> State:
        """Return the state of a single camera, parameters (1 or B, 4 + n), and flat boards in its frame."""
        batch = len(boards.translations)
        return cls((parameters,), Poses.none(batch, 1, parameters), boards, parameters.new_zeros(batch, 2))

    def of(self, rows: Tensor) -> State:
        parameters = tuple(p[rows] for p in self.parameters)
        return State(parameters, self.mounts.of(rows), self.boards.of(rows), self.bend[rows])

    def boards_from(self, camera: int) -> Poses:
        """Return the poses of the boards in the frame of a camera."""
        rotations, translations = (t[:, camera, None] for t in self.mounts)
        return Poses(rotations @ self.boards.rotations, self.boards.translations @ rotations[:, 0].mT + translations)


class Free(NamedTuple):
    """The unknowns that learn."""

    parameters: tuple[Tensor, ...]  # of each camera (4 + n,) bool
    mounts: bool = False  # those of all cameras but the first one
    boards: str = "poses"  # or "positions" for their translations alone
    bend: bool = False  # the shape of the board


@dataclass(frozen=True)
class Adjusted:
    """The end of a search, an optimum if it converged."""

    state: State
    cost: Tensor  # (B,)
    converged: Tensor  # (B,)
    residuals: tuple[Tensor, ...]  # of each camera (B, V, N, 2), projected minus observed
    valid: tuple[Tensor, ...]  # (B, V, N) bool, whether points, of any weight, have a pixel
    problem: Bundle

    @cached_property
    @torch.no_grad()
    def equations(self) -> Equations:
        return self.problem.equations(self.problem.flat(self.state), self.problem.every)


@torch.no_grad()
def adjust(
    observed: Sequence[CameraObservations],
    state: State,
    free: Free,
    *,
    loss: Loss = LEAST_SQUARES,
    steps: int = 60,
    settled: float = SETTLED,
    nothing: float = _NOTHING,
    damping: float = FIRST_DAMPING,
    going: Tensor | None = None,
) -> Adjusted:
    """Return the state of least squares near a given one, for each of B problems, whose cameras see the same views.

    A seen point without a pixel counts as far away, so no step loses points. During the search a lens may reach beyond
    its end, see `Camera.model_for_search`; points that lie there at the end are not valid.

    A search ends at the squared distance `settled` to the optimum, over the variance, or if the errors are at most
    `nothing` px; `damping` is the first one. `going`, bool (B,), selects the problems to search, all by default.
    """
    problem = Bundle(observed, state, free, loss)
    counts = torch.stack([(s.weights > 0).sum((-1, -2)) for s in problem.observed]).sum(0)
    found = minimise(
        problem,
        problem.flat(state),
        tolerance=settled / (2 * counts - problem.unknowns).clamp(min=1),
        tiny=nothing**2 * counts,
        going=going,
        steps=steps,
        damping=damping,
    )
    by_camera = problem.all_errors(found.state, problem.every)
    return Adjusted(
        problem.state(found.state),
        found.cost,
        found.converged,
        tuple(errors.residuals for errors in by_camera),
        tuple(problem.shown(c, found.state, errors) for c, errors in enumerate(by_camera)),
        problem,
    )


def minima(
    model: type[Camera], parameters: Tensor, poses: Poses, seen: Observations, loss: Loss, steps: int
) -> tuple[Poses, Tensor]:
    """Return the poses (K, 1) of least cost near the given ones, each a problem of its own, and their costs (K,)."""
    points, pixels, weights = seen.points, seen.pixels, seen.seen.to(seen.pixels)
    camera = remade(_template(model, parameters), intrinsics=parameters[:, :4], distortion=parameters[:, 4:])
    made = native_forms([camera], pixels)
    if made is not None:
        search = PoseSearch(steps, SETTLED, _NOTHING, FIRST_DAMPING, loss)
        start = poses.rotations[:, 0], poses.translations[:, 0]
        rotations, translations, cost = refine_poses(made[0][0], points, pixels, weights, start, search)
        return Poses(rotations[:, None], translations[:, None]), cost
    observed = CameraObservations(model, points[:, None], pixels[:, None], weights[:, None])
    found = adjust_poses(observed, parameters, poses, loss=loss, steps=steps)
    return found.state.boards, found.cost


def adjust_poses(observed: CameraObservations, parameters: Tensor, poses: Poses, **options: Any) -> Adjusted:
    """Return the poses (K, 1) of least cost near the given ones, each a problem of its own, for a fixed camera."""
    free = Free((torch.zeros(parameters.shape[-1], dtype=torch.bool, device="cpu"),))
    return adjust([observed], State.of_one(parameters, poses), free, **options)


def bend_points(points: Tensor, bend: Tensor) -> tuple[Tensor, Tensor]:
    """Return the points of bent boards, and the derivatives (..., N, 2) of their z by the bend.

    z grows by bend_x (1 - x^2) + bend_y (1 - y^2), where x and y go from -1 to 1 over the points (..., N, 3) of the
    board about its middle: mrcal's paraboloid. bend: (B, 2), in the units of the points.
    """
    plane = points[..., :2]
    reach = plane.abs().amax(tuple(range(plane.ndim - 1)), keepdim=True)
    slopes = 1 - (plane / torch.where(reach > 0, reach, 1.0)).square()
    depth = (slopes * bend[:, None, None]).sum(-1, keepdim=True)
    flat = torch.cat((torch.zeros_like(plane), torch.ones_like(depth)), -1)
    return points + flat * depth, slopes


class Bundle:
    """The problem for `levenberg_marquardt.minimise`, whose state is a flat tuple of tensors (B, ...)."""

    def __init__(self, observed: Sequence[CameraObservations], state: State, free: Free, loss: Loss = LEAST_SQUARES):
        self.free, self.loss = free, loss
        self._last: tuple[tuple[Tensor, ...], list[Errors]] | None = None
        batch = state.boards.translations.shape[0]
        self.every = torch.arange(batch, device=state.boards.translations.device)
        self.observed = [s.mapped(lambda t: t.expand(batch, *t.shape[1:])) for s in observed]
        self.cameras = [_template(s.model, p) for s, p in zip(observed, state.parameters, strict=True)]
        self.rounding = torch.stack([rounding_of(s.pixels, s.weights) for s in self.observed]).sum(0)
        # a camera that does not learn, and is the same for all problems, projects all points as one row
        self.fixed = [
            remade(camera, intrinsics=p[0, :4], distortion=p[0, 4:]) if len(p) == 1 and not bool(f.any()) else None
            for camera, p, f in zip(self.cameras, state.parameters, free.parameters, strict=True)
        ]
        # for each camera, the places of its parameters among the shared unknowns, and their indices; those of its mount
        self.shared_width = 0  # the number of shared unknowns
        indices = [f.nonzero()[:, 0].tolist() for f in free.parameters]
        self.learnt = [(self._next_places(len(own)), own) for own in indices]
        self.mounted = [self._next_places(6 if free.mounts and c > 0 else 0) for c in range(len(observed))]
        self.bent = self._next_places(2 if free.bend else 0)
        # native code knows one camera that sees flat boards at unknown poses
        is_plain = len(observed) == 1 and free.boards == "poses" and not free.bend
        self.is_compiled = is_plain and native_forms(self.cameras, self.observed[0].pixels) is not None
        self.width = 6 if free.boards == "poses" else 3  # of the unknowns of a view
        views = torch.stack([(s.weights > 0).any(-1).any(0) for s in self.observed]).any(0).sum()
        self.unknowns = self.shared_width + self.width * int(views)
        ends = [bounds(camera, p) for camera, p in zip(self.cameras, state.parameters, strict=True)]
        self.low = self._of_shared([low for low, _ in ends], -torch.inf)
        self.high = self._of_shared([high for _, high in ends], torch.inf)

    def _next_places(self, count: int) -> list[int]:
        """Add so many shared unknowns, and return their places."""
        first = self.shared_width
        self.shared_width += count
        return [*range(first, self.shared_width)]

    def flat(self, state: State) -> tuple[Tensor, ...]:
        """Return the state as tensors (B, ...)."""
        batch = len(state.boards.translations)
        return (*state.boards, *state.mounts, state.bend, *[p.expand(batch, -1) for p in state.parameters])

    def state(self, flat: Sequence[Tensor]) -> State:
        return State(tuple(flat[5:]), Poses(*flat[2:4]), Poses(*flat[:2]), flat[4])

    def _of_shared(self, parameters: Sequence[Tensor], other: float) -> Tensor:
        """Return the value of each shared unknown (B, G) in `parameters`, or `other` for mounts and bends."""
        found = parameters[0].new_full((max(map(len, parameters)), self.shared_width), other)
        for (places, own), values in zip(self.learnt, parameters, strict=True):
            found[:, places] = values[:, own]
        return found

    def points(self, c: int, state: State, observed: CameraObservations) -> tuple[Tensor, Tensor, Tensor]:
        """Return points (B, V, N, 3) of the turned board, of the first camera's frame, and of this camera's frame."""
        points = bend_points(observed.points, state.bend)[0] if self.free.bend else observed.points
        turned = points @ state.boards.rotations.mT
        first = turned + state.boards.translations[:, :, None]
        if c == 0:
            return turned, first, first
        mounts = state.mounts
        return turned, first, first @ mounts.rotations[:, c, None].mT + mounts.translations[:, c, None, None]

    def camera(self, c: int, state: State) -> Camera:
        fixed, parameters = self.fixed[c], state.parameters[c]
        if fixed is not None:
            return fixed
        return remade(self.cameras[c], intrinsics=parameters[:, :4], distortion=parameters[:, 4:])

    def errors_of(self, c: int, flat: Sequence[Tensor], rows: Tensor) -> Errors:
        """Return residuals, validity, weights and costs of a camera at a state."""
        state, observed = self.state(flat), self.observed_by(c, rows)
        if self.is_compiled and len(rows):
            return self._compiled_errors(state, observed)
        pixels, valid = self.camera(c, state).project(self.points(c, state, observed)[-1])
        residuals = torch.where((valid & (observed.weights > 0))[..., None], pixels - observed.pixels, 0.0)
        u, v = residuals.unbind(-1)
        cost, slope = self.loss.of(u * u + v * v)
        lost, _ = self.loss.of(cost.new_tensor(LOST**2))
        cost = (torch.where(valid, cost, lost) * observed.weights).sum(-1)
        return Errors(residuals, valid, torch.where(valid, slope * observed.weights, 0.0), cost)

    def _compiled_errors(self, state: State, observed: CameraObservations) -> Errors:
        (parameters,), (_, own) = state.parameters, self.learnt[0]
        parameters = parameters if self.fixed[0] is None else parameters[:1]
        native = CameraRows(type(self.cameras[0]), parameters[:, :4], parameters[:, 4:]).native
        assert native is not None  # the first cameras had it
        has_triangles = native.plan.places is not None or all(i < 4 for i in own)
        given = observed.points, state.boards, observed.pixels, observed.weights, self.loss
        # triangles for the next step, which begins here unless this one is rejected
        return project_views(native, *given, own if has_triangles else None)

    def all_errors(self, flat: Sequence[Tensor], rows: Tensor) -> list[Errors]:
        """Return the errors of all cameras; the last ones are reused if the state is the same."""
        given, last = (rows, *flat), self._last
        if last is None or not all(a is b or torch.equal(a, b) for a, b in zip(given, last[0], strict=True)):
            self._last = last = given, [self.errors_of(c, flat, rows) for c in range(len(self.observed))]
        return last[1]

    def shown(self, c: int, flat: Sequence[Tensor], errors: Errors) -> Tensor:
        """Whether a camera, of the model itself and not the one for the search, has pixels, (B, V, N) bool."""
        kind = self.observed[c].model
        if kind.model_for_search() is kind:
            return errors.valid
        state = self.state(flat)
        searched = self.camera(c, state)
        camera = fixed_camera(kind, searched.intrinsics, searched.distortion)
        camera._expects_unusable = True
        return errors.valid & camera.project(self.points(c, state, self.observed[c])[-1])[1]

    def observed_by(self, c: int, rows: Tensor) -> CameraObservations:
        """Return the observations of a camera for some of the problems."""
        return self.observed[c].mapped(lambda t: _of_rows(t, rows))

    def cost(self, flat: Sequence[Tensor], rows: Tensor) -> Tensor:
        total = torch.cat([errors.cost for errors in self.all_errors(flat, rows)], -1).sum(-1)
        for one, parameters in zip(self.observed, flat[5:], strict=True):
            if one.prior:
                total = total + ((parameters - one.prior.centre) @ one.prior.root.mT).square().sum(-1)
        return total.nan_to_num(torch.inf, torch.inf)

    def linearised(self, flat: Sequence[Tensor], rows: Tensor) -> System:
        equations = self.equations(flat, rows)
        # parameters that would leave their bounds stay there, so that the others can move on
        view, shared = equations.view[..., self.width :], equations.shared
        slope = (view[..., :-1] * view[..., -1:]).sum((1, 2)) + (shared[..., :-1] * shared[..., -1:]).sum(1)
        values, low, high = self._of_shared(flat[5:], 0.0), _of_rows(self.low, rows), _of_rows(self.high, rows)
        held = (values <= low) & (slope > 0) | (values >= high) & (slope < 0)
        return System(equations, self.width, held)

    def equations(self, flat: Sequence[Tensor], rows: Tensor) -> Equations:
        """Return the linearised problem."""
        state, by_camera = self.state(flat), self.all_errors(flat, rows)
        if by_camera[0].triangles is not None:
            view, shared = by_camera[0].triangles
            return Equations(view, self._with_priors(shared, state) if self.observed[0].prior else shared)
        # of all cameras, (B, V, R, L + G + 1)
        block = torch.cat([self.linearised_rows(c, errors, state, rows) for c, errors in enumerate(by_camera)], -2)
        if self.shared_width == 0:  # at most six columns, for which squares are accurate enough
            return Equations(triangle_of_few(block), block.new_zeros(len(block), 1, 1))
        triangle, width = torch.linalg.qr(padded(block), mode="r").R, self.width
        left = triangle[..., width:, width:].flatten(1, 2)  # what views leave to the shared unknowns
        return Equations(triangle[..., :width, :], self._with_priors(left, state))

    def _with_priors(self, rows: Tensor, state: State) -> Tensor:
        """Return the triangle (B, G + 1, G + 1) of rows (B, R, G + 1) and those of the priors."""
        found = [rows]
        for c, (one, parameters) in enumerate(zip(self.observed, state.parameters, strict=True)):
            if one.prior:
                centre, root = one.prior
                of_prior = root.new_zeros(len(parameters), len(root), self.shared_width + 1)
                places, own = self.learnt[c]
                of_prior[..., places] = root[:, own]
                of_prior[..., -1] = (parameters - centre) @ root.mT
                found.append(of_prior)
        triangle: Tensor = torch.linalg.qr(padded(torch.cat(found, -2)), mode="r").R
        return triangle

    def linearised_rows(self, c: int, errors: Errors, state: State, rows: Tensor) -> Tensor:
        """Return rows (B, V, R, L + G + 1) of a camera: derivatives by a view's and the shared unknowns, residuals."""
        observed = self.observed_by(c, rows)
        turned, first, points = self.points(c, state, observed)
        batch, views, count = points.shape[:3]
        lead = (batch, views * count) if self.fixed[c] is None else (1, batch * views * count)
        places, own = self.learnt[c]
        found = pixel_jacobians(self.camera(c, state), points.reshape(*lead, 3), bool(own))
        by_point, by_parameters = (by.reshape(batch, views, count, 2, by.shape[-1]) for by in found)
        by_first = by_point if c == 0 else by_point @ state.mounts.rotations[:, c, None, None]
        columns = []
        if self.width == 6:
            columns.append(torch.linalg.cross(turned[..., None, :].expand_as(by_first), by_first, dim=-1))
        columns.append(by_first)
        if own:
            columns.append(by_parameters[..., own])
        if self.mounted[c]:
            turned = first @ state.mounts.rotations[:, c, None].mT
            columns += [torch.linalg.cross(turned[..., None, :].expand_as(by_point), by_point, dim=-1), by_point]
        if self.free.bend:
            along = by_first @ state.boards.rotations[:, :, None, :, 2:]
            columns.append(along * bend_points(observed.points, state.bend)[1][..., None, :])
        columns.append(errors.residuals[..., None])
        weighted = (torch.cat(columns, -1) * errors.weights.sqrt()[..., None, None]).flatten(2, 3)
        if self.shared_width == 0 or len(self.observed) == 1:  # the camera has all columns
            return weighted
        # a triangle has fewer rows to spread over the columns of all cameras
        triangle: Tensor = torch.linalg.qr(weighted, mode="r").R
        spread = triangle.new_zeros(*triangle.shape[:-1], self.width + self.shared_width + 1)
        shared = [self.width + place for place in (*places, *self.mounted[c], *self.bent)]
        spread[..., [*range(self.width), *shared, -1]] = triangle
        return spread

    def moved(self, flat: Sequence[Tensor], step: Sequence[Tensor], rows: Tensor) -> tuple[Tensor, ...]:
        """Return the state after steps of the views' unknowns (R, V, L) and the shared ones (R, G)."""
        state = self.state(flat)
        of_views, shared = step
        boards, mounts, bend = state.boards, state.mounts, state.bend
        if self.width == 6:
            boards = Poses(turned_by(boards.rotations, of_views), boards.translations + of_views[..., 3:])
        else:
            boards = boards._replace(translations=boards.translations + of_views)
        parameters = []
        for p, (places, own) in zip(state.parameters, self.learnt, strict=True):
            if own:
                low, high = (_of_rows(ends, rows)[:, places] for ends in (self.low, self.high))
                p = p.clone()
                p[:, own] = (p[:, own] + shared[:, places]).clamp(low, high)
            parameters.append(p)
        if self.free.bend:
            bend = bend + shared[:, -2:]
        if self.free.mounts:
            turn, shift = torch.zeros_like(mounts.translations), torch.zeros_like(mounts.translations)
            for c, places in enumerate(self.mounted):
                if places:
                    turn[:, c], shift[:, c] = shared[:, places[:3]], shared[:, places[3:]]
            mounts = Poses(small_turn(turn) @ mounts.rotations, mounts.translations + shift)
        return self.flat(State(tuple(parameters), mounts, boards, bend))


def _of_rows(values: Tensor, rows: Tensor) -> Tensor:
    """Return the values of some problems; nothing is copied for all of them."""
    return values if len(rows) == len(values) else values[rows]


def _template(model: type[Camera], parameters: Tensor) -> Camera:
    """Return a frozen camera of the model, a template for others with its number of coefficients."""
    made = fixed_camera(model.model_for_search(), parameters[0, :4], parameters[0, 4:])
    made._expects_unusable = True  # a rejected step may have gone anywhere, and must not warn
    return made


def pixel_jacobians(camera: Camera, points: Tensor, learns: bool = True) -> tuple[Tensor, Tensor]:
    """Return the exact derivatives of pixels by points (C, N, 3), and by the parameters of cameras (C,) if one learns.

    (C, N, 2, 3) and (C, N, 2, 4 + n): zero if a point has no pixel, and without meaning if it is not valid.
    """
    made = native_forms([camera], points)
    if made is not None and (not learns or made[0][0].plan.places is not None):
        plan = made[0][0].plan
        by_point, by_own = (
            t.nan_to_num(0.0, 0.0, 0.0) for t in native_calls.project_jacobians(made[0][0], points, learns)
        )
        if not learns:
            return by_point, by_own
        by_k = plan.by_coefficients(by_own[..., 4:], camera.distortion.shape[-1])
        return by_point, torch.cat((by_own[..., :4], by_k), -1)
    intrinsics = camera.intrinsics.view(-1, 4)
    found = sensor_jacobians(camera, camera.distortion.view(len(intrinsics), -1), points, math.inf)
    focal = intrinsics[:, None, :2, None]
    by_focal = torch.diag_embed(torch.stack(found.points[:2], -1))
    by_centre = torch.diag_embed(found.points.covered[..., None].expand(*points.shape[:2], 2).to(points))
    by_parameters = torch.cat((by_focal, by_centre, found.by_k.permute(0, 3, 1, 2) * focal), -1)
    return found.by_ray.permute(0, 3, 1, 2) * focal, by_parameters
