"""The calibration of several cameras from views of the same boards: `calibrate_rig` and its result."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from camtorch.calibration.bundle import Bundle, CameraObservations, Free, Poses, State, adjust
from camtorch.calibration.calibrate import STEPS, Search, extrinsics_of, middle_of, results, rms_of
from camtorch.calibration.model import asked_model
from camtorch.calibration.observations import Points, as_rig_observations
from camtorch.calibration.robust import Loss, as_loss
from camtorch.calibration.uncertainty import shared_factor
from camtorch.calibration.verdict import Calibration
from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.poses.extrinsics import Extrinsics
from camtorch.poses.rotations import rotation_vector
from camtorch.values.arguments import as_flag, hinting, warn
from camtorch.values.threads import on_one_thread


@dataclass(repr=False)
class RigCalibration:
    """The result of `calibrate_rig`. Units are pixels, and for poses those of the object points."""

    rig: Rig
    """The cameras, float64, and for each the extrinsics: camera from the first camera."""
    boards: Extrinsics
    """First camera from board, with batch dims (V,)."""
    rms: float
    """The root of the mean squared length of the residuals of all cameras, per point."""
    sigma: float
    """The standard deviation of a coordinate of a pixel, in all cameras; see `Calibration.sigma`."""
    cameras: dict[str, Calibration]
    """The calibration of each camera, by name, as from `calibrate`, but from the views of all cameras."""
    mount_std: dict[str, Tensor]
    """Standard deviations (6,) of each camera's pose: of its turn in radians, about its own axes, and its shift."""
    converged: bool
    """Whether the search ended at an optimum."""
    bend: tuple[float, float]
    """The bend of the board, as in `Calibration`."""
    views: tuple[int, ...]
    """The indices of passed views that some camera saw, also those that are `copies` in `cameras`."""

    @property
    def residuals(self) -> dict[str, Any]:
        """Projected minus observed pixels, by name of the camera, in the form of its image points; NaN if unseen."""
        return {name: camera.residuals for name, camera in self.cameras.items()}

    @property
    def std(self) -> dict[str, Tensor]:
        """Standard deviations (P,) of the parameters, by name of the camera."""
        return {name: camera.std for name, camera in self.cameras.items()}

    @property
    def inliers(self) -> dict[str, Any]:
        """Inliers by name of the camera, as in `Calibration`."""
        return {name: camera.inliers for name, camera in self.cameras.items()}

    @property
    def parameter_names(self) -> dict[str, tuple[str, ...]]:
        """Names of parameters, by name of the camera."""
        return {name: camera.parameter_names for name, camera in self.cameras.items()}

    @property
    def covariance(self) -> dict[str, Tensor]:
        """Covariances (P, P) of the parameters, by name of the camera."""
        return {name: camera.covariance for name, camera in self.cameras.items()}

    @property
    def warnings(self) -> list[str]:
        """Warnings of all cameras, each with the camera's name; see `Calibration.warnings`."""
        return [f"{name}: {text}" for name, camera in self.cameras.items() for text in camera.warnings]

    def __repr__(self) -> str:
        count, boards = len(self.cameras), len(self.views)
        state = "" if self.converged else ", NOT CONVERGED"
        head = f"{count} cameras, {boards} views: rms {self.rms:.4g} px, sigma {self.sigma:.4g} px{state}"
        lines = [f"RigCalibration({head})"]
        first = next(iter(self.cameras))
        for name, camera in self.cameras.items():
            if name != first:
                pose = self.rig.extrinsics[name]
                vectors = pose.rotation.detach(), pose.translation.detach(), self.mount_std[name][3:]
                angle, distance, std = (float(torch.linalg.vector_norm(vector)) for vector in vectors)
                turned = f"turned by {math.degrees(angle):.4g} degrees"
                lines.append(f"{name}: {distance:.6g} +- {std:.2g} from {first}, {turned}")
            lines.append(f"{name}: {camera!r}")
        return "\n".join(lines)


@on_one_thread
@hinting("Models, image_points and image_sizes are dicts by the same names: image_sizes={'left': (480, 640), ...}")
def calibrate_rig(
    models: Mapping[str, type[Camera] | str | Camera],
    object_points: Points,
    image_points: Mapping[str, Points],
    *,
    image_sizes: Mapping[str, Sequence[int]],
    count: int | Mapping[str, int | None] | None = None,
    start: Mapping[str, Camera] | None = None,
    fixed: Collection[str] | str | Mapping[str, Collection[str] | str] = (),
    loss: str | None = None,
    loss_scale: float = 1.0,
    bend: bool = False,
) -> RigCalibration:
    """Calibrate cameras that see the same boards, and find their poses.

    A camera may miss boards, but must see some together with others, so that all cameras are linked.

    Args:
        models: A class, its key, or a camera to start from, by name of the camera. The first one's frame is the rig's.
        object_points: (N, 3) for all views, (V, N, 3), or a list of (N_i, 3), the same for all cameras.
        image_points: By name of the camera, as in `calibrate`, of V views at the same times: None or NaN if unseen.
        image_sizes: (height, width), by name of the camera.
        count: As in `calibrate`, for all cameras or by name.
        start: Cameras to start from, by name.
        fixed: As in `calibrate`, for all cameras or by name; "all" holds a camera's intrinsics and distortion.
        loss: As in `calibrate`, like all other arguments.
        loss_scale: px.
        bend: Whether the board may be bent.

    Raises:
        ValueError: If `calibrate` raises for an argument, names differ, or no board links a camera to the others.
    """
    owner = "calibrate_rig"
    by_name = as_rig_observations(object_points, image_points, image_sizes, models, owner)
    robust, bend = as_loss(loss, loss_scale, owner), as_flag(bend, "bend", owner)
    for given in (count, start, fixed):
        stray = [name for name in given if name not in by_name] if isinstance(given, Mapping) else []
        if stray:
            unknown = ", ".join(map(repr, stray))
            raise ValueError(f"{owner}: names must be those of cameras, {', '.join(by_name)}; got {unknown}")
    middle, searches = middle_of([seen for seen, _ in by_name.values()]), []
    for name, (seen, layout) in by_name.items():
        of, own_start = f"{owner}: {name}", _own(start, name, None)
        own_count, own_fixed = _own(count, name, None), _own(fixed, name, ())
        asked = asked_model(models[name], own_count, own_start, own_fixed, layout.image_size, of)
        searches.append(Search(of, asked, seen, layout, middle, robust))
    observed = [search.observed for search in searches]
    learns = tuple(parameters for search in searches for parameters in search.free().parameters)
    free = Free(learns, mounts=True, bend=bend)
    adjusted = adjust(observed, _join_starts(searches, observed, free), free, loss=robust, steps=STEPS)
    found, noise = results(searches, adjusted, free)
    adjusted = found[0].adjusted  # of all cameras
    std = torch.linalg.vector_norm(shared_factor(adjusted.equations)[0] * noise, dim=-1)
    mounts, mount_std = {}, {}
    posed = zip(by_name, *(t[0] for t in adjusted.state.mounts), adjusted.problem.mounted, strict=True)
    for name, rotation, shift, places in posed:
        mounts[name] = Extrinsics(rotation_vector(rotation).unsqueeze(-1), shift)
        mount_std[name] = std[places] if places else std.new_zeros(6)
    cameras = dict(zip(by_name, found, strict=True))
    residuals = torch.cat([r[0] for r in adjusted.residuals])
    result = RigCalibration(
        rig=Rig({name: c.camera for name, c in cameras.items()}, mounts),
        boards=extrinsics_of(adjusted.state.boards, middle),
        rms=rms_of(residuals, torch.cat([search.seen.seen for search in searches])),
        sigma=found[0].sigma,
        cameras=cameras,
        mount_std=mount_std,
        converged=all(c.converged for c in found),
        bend=found[0].bend,
        views=found[0].views,
    )
    if not result.converged:
        warn(
            f"{owner}: the search did not end at an optimum (rms {result.rms:.4g} px). Do not use the result; see its "
            "warnings, and check that all cameras took each view at the same moment"
        )
    return result


def _own(given: Any, name: str, otherwise: Any) -> Any:
    return given.get(name, otherwise) if isinstance(given, Mapping) else given


def _join_starts(searches: list[Search], observed: list[CameraObservations], free: Free) -> State:
    """Return the start: mounts from pairs that see the same boards, boards from the camera that sees each best."""
    has_pose, states = [search.seen.seen.any(-1) for search in searches], []
    for search, has in zip(searches, has_pose, strict=True):
        state = replace(search, seen=search.seen.of(has)).alone().state
        boards = Poses.none(1, len(has), search.seen.pixels).with_views(has.nonzero()[:, 0], state.boards)
        states.append(state._replace(boards=boards))
    parameters = tuple(state.parameters[0] for state in states)
    mounts = _join_mounts([state.boards for state in states], has_pose)
    boards, least = states[0].boards, torch.full_like(states[0].boards.translations[0, :, 0], torch.inf)
    for c, one in enumerate(states):
        turn, shift = (t[0, c] for t in mounts)
        own = Poses(turn.mT @ one.boards.rotations, (one.boards.translations - shift) @ turn)
        state = State(parameters, mounts, own, own.translations.new_zeros(1, 2))
        bundle = Bundle(observed, state, free, Loss("cauchy"))
        cost = torch.stack([errors.cost[0] for errors in bundle.all_errors(bundle.flat(state), bundle.every)]).sum(0)
        better = has_pose[c] & (cost < least)
        least = torch.where(better, cost, least)
        boards = Poses.where(better, own, boards)
    return State(parameters, mounts, boards, least.new_zeros(1, 2))


def _join_mounts(boards: list[Poses], has_pose: list[Tensor]) -> Poses:
    """Return the mounts (1, C) of cameras by their poses of boards (1, V), one after the other from the first on."""
    mounts = Poses.none(1, len(boards), boards[0].translations)
    turns, shifts = mounts.rotations[0], mounts.translations[0]
    together = torch.stack(has_pose).double()
    together = together @ together.mT  # (C, C), the number of boards that two cameras see
    known = [0]
    while len(known) < len(boards):
        rest = [c for c in range(len(boards)) if c not in known]
        i, j = divmod(int(together[known][:, rest].argmax()), len(rest))
        a, b = known[i], rest[j]
        both = has_pose[a] & has_pose[b]
        (from_a, at_a), (from_b, at_b) = ((t[0, both] for t in boards[c]) for c in (a, b))
        # from camera a to b: of all boards' poses, the one nearest to the others
        rotations = from_b @ from_a.mT
        translations = at_b - (rotations @ at_a[..., None])[..., 0]
        turned = (rotations[:, None] - rotations).flatten(2).norm(dim=-1)
        length = translations.norm(dim=-1).median().clamp(min=torch.finfo(translations.dtype).tiny)
        shifted = (translations[:, None] - translations).norm(dim=-1) / length
        middle = (turned + shifted).median(-1).values.argmin()
        turns[b] = rotations[middle] @ turns[a]
        shifts[b] = rotations[middle] @ shifts[a] + translations[middle]
        known.append(b)
    return mounts
