"""Points from the pixels at which several cameras see them."""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar, cast

import torch
from torch import Tensor
from torch.nn.functional import normalize

from camtorch.calibration.batches import as_double_rows, as_stacked, attached, learns, root_of
from camtorch.calibration.bundle import CameraObservations, Free, Poses, State, adjust
from camtorch.cameras.camera import Camera
from camtorch.least_squares.equations import System
from camtorch.poses.extrinsics import Extrinsics
from camtorch.values.arguments import Numbers, check_devices, hinting, shown, working_dtype
from camtorch.values.module import BatchedModule, model_of
from camtorch.values.threads import on_one_thread

M = TypeVar("M", bound=BatchedModule)

_STEPS, _DAMPING = 60, 1e-8  # the first damping is low: starts are near the optimum
_SETTLED = 1e-8  # the squared distance to the optimum, over the variance, at which a search ends
_NOTHING = 1e-9  # px, that rounding may leave
_FAR = 100.0  # times the extent of the cameras' positions: the start of points whose rays meet behind cameras
_FLEEING = 0.01  # of the distance: a point with a longer next step is on its way to infinity
_LEAST, _TINY = 1e-15, 1e-300  # added to divisors


class Triangulation(NamedTuple):
    """The result of `triangulate`."""

    points: Tensor
    """(*N, 3) in the world's frame."""
    rms: Tensor
    """(*N,) px: root mean square of the distances in the cameras that see the point; infinite if invalid."""
    valid: Tensor
    """(*N,) bool."""


@on_one_thread
@hinting("It takes lists: ct.triangulate([camera, ...], [extrinsics, ...], pixels), pixels (C, N, 2)")
def triangulate(
    cameras: Sequence[Camera] | Camera, extrinsics: Sequence[Extrinsics] | Extrinsics, pixels: Numbers
) -> Triangulation:
    """Find the points whose projections are nearest to pixels of C cameras: least squares in px for each point.

    Cameras may be of any models, rays of any angle.

    Points and rms have first derivatives by pixels, extrinsics and the cameras' parameters, by the implicit function
    theorem at the optimum. Computation is in float64, results are in the widest dtype of the arguments. It reads
    values, so it does not work in torch.compile or vmap; pass vmap's batch as *N.

    Args:
        cameras: C cameras without batch dims, in a list; a camera with a batch of C; or one for all.
        extrinsics: C poses, camera from world, in the same forms.
        pixels: (C, *N, 2); a point is unseen by a camera if its pixel is NaN or has no ray.

    Returns:
        points (*N, 3) in the world's frame, rms (*N,) in px and valid (*N,) bool. A point is invalid, finite and
        without meaning, if fewer than two cameras see it, its rays do not meet in front of all of them, or a surface
        (`Splined`) ends before it.

    Raises:
        TypeError: If cameras, extrinsics or pixels have a wrong type. ValueError: If shapes or numbers do not fit,
            cameras have further batch dims, or there are fewer than two.

    Example:
        >>> camera = ct.KannalaBrandt([300.0, 300.0, 319.5, 239.5], [0.1, 0.0, 0.0, 0.0])
        >>> poses = ct.Extrinsics([[0.0, 0.0, 0.0]] * 2, [[0.0, 0.0, 0.0], [-0.1, 0.0, 0.0]])
        >>> pixels, _ = camera.project(poses([[[0.5, 0.2, 2.0]]]))  # (2, 1, 2)
        >>> points, rms, valid = ct.triangulate(camera, poses, pixels)  # (1, 3), (1,), (1,)
        >>> [round(value, 3) for value in points[0].tolist()]
        [0.5, 0.2, 2.0]
    """
    device = pixels.device if isinstance(pixels, Tensor) else torch.device("cpu")
    seen_at = as_stacked(pixels, "pixels", "triangulate", device)
    if seen_at.ndim < 2 or seen_at.shape[-1] != 2:
        raise ValueError(f"triangulate: pixels must be (C, *N, 2); got shape {tuple(seen_at.shape)}")
    count, *shape = seen_at.shape[:-1]
    given, poses = _as_list(cameras, "cameras", Camera, count), _as_list(extrinsics, "extrinsics", Extrinsics, count)
    if count < 2 or not len(given) == len(poses) == count:
        raise ValueError(
            "triangulate: cameras, extrinsics and rows of pixels (C, *N, 2) must be of the same C >= 2 cameras; got "
            f"{len(given)} cameras, {len(poses)} extrinsics and pixels {tuple(seen_at.shape)}"
        )
    check_devices("triangulate", pixels=seen_at, **{f"extrinsics[{i}]": p.rotation for i, p in enumerate(poses)})
    dtype = working_dtype(seen_at, *(t for camera in given for t in camera.tensors), *(p.rotation for p in poses))
    rows = [as_double_rows(camera, torch.Size()) for camera in given]
    matrices = torch.stack([pose.matrix().double() for pose in poses])
    at = seen_at.double().reshape(count, torch.Size(shape).numel(), 2)
    with torch.no_grad():
        rays, seen = map(torch.stack, zip(*(c.unproject(p) for c, p in zip(rows, at, strict=True)), strict=True))
    task = _Task(rows, matrices[:, :3, :3], matrices[:, :3, 3], torch.where(seen[..., None], at, 0.0), seen)
    points, valid = _solve(task, rays)
    if learns([*given, *poses], task.pixels):
        points = attached(task.cost, points, valid)
    rms = root_of(2 * task.cost(points) / seen.sum(0).clamp(min=1), valid)
    return Triangulation(points.to(dtype).view(*shape, 3), rms.to(dtype).view(shape), valid.view(shape))


def _as_list(modules: Sequence[M] | M, name: str, kind: type[M], count: int) -> list[M]:
    """Return modules without batch dims, from a list, a batch, or one for all."""
    if isinstance(modules, kind):
        return [modules[i] for i in range(len(modules))] if modules.batch_shape else [modules] * count
    for module in cast(Sequence[M], modules):
        if not isinstance(module, kind):
            how = ". ct.Extrinsics.from_matrix(T) makes one of a matrix" * (name == "extrinsics")
            raise TypeError(f"triangulate: {name} must be {kind.__name__} in a list; got {shown(module)}{how}")
        if module.batch_shape:
            own = tuple(module.batch_shape)
            raise ValueError(f"triangulate: {name} must have no batch dims of their own; got one with {own}")
    return list(cast(Sequence[M], modules))


class _Task(NamedTuple):
    """P points that C cameras see, float64, with their graphs; unseen pixels are finite."""

    cameras: list[Camera]
    rotations: Tensor  # (C, 3, 3)
    translations: Tensor  # (C, 3)
    pixels: Tensor  # (C, P, 2)
    seen: Tensor  # (C, P)

    def cost(self, points: Tensor) -> Tensor:
        """Return half the sum of squares (P,) at points (P, 3)."""
        total = torch.zeros_like(points[:, 0])
        for camera, rotation, translation, seen_at, seen in zip(*self, strict=True):
            pixels, valid = camera.project(points @ rotation.mT + translation)
            total = total + torch.where(valid & seen, (pixels - seen_at).square().sum(-1), 0.0)
        return 0.5 * total


@torch.no_grad()
def _solve(task: _Task, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return the points of least cost (P, 3) and whether they are valid; rays: (C, P, 3) of the pixels."""
    rotations, translations, pixels = (t.detach() for t in task[1:4])
    seen, views = task.seen.to(pixels), task.seen.sum(0)
    positions, rays = -(rotations.mT @ translations[..., None])[..., 0], rays @ rotations
    # (P, 3): the points nearest to rays (C, P, 3) from positions (C, 3), by distance, then about by angle
    eye = torch.eye(3, dtype=rays.dtype, device=rays.device)
    weights, nearest = seen, seen.new_zeros(seen.shape[1], 3)
    for _ in range(2):
        across = weights[..., None, None] * (eye - rays[..., :, None] * rays[..., None, :])
        right, total = (across @ positions[:, None, :, None]).sum(0), across.sum(0)
        scale = total.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        nearest = torch.linalg.solve_ex(total + (_LEAST * scale + _TINY) * eye, right)[0][..., 0]
        nearest = torch.where(torch.isfinite(nearest), nearest, 0.0)
        squares = (nearest - positions[:, None]).square().sum(-1)
        weights = seen / torch.where(squares > 0, squares, 1.0)
    count = len(views)
    if count == 0:
        return nearest, views.bool()
    middle = (seen[..., None] * positions[:, None]).sum(0) / views.clamp(min=1)[:, None]
    ahead = normalize((seen[..., None] * rays).sum(0), dim=-1)
    extent = (positions - positions.mean(0)).norm(dim=-1).amax()
    fits = _is_ahead(nearest, positions, rays, task.seen)[:, None]
    start = torch.where(fits, nearest, middle + _FAR * extent * ahead)

    # a point is the position of a board with one corner, in the frame of the first camera
    first, shift = rotations[0], translations[0]
    turns = rotations @ first.mT
    parameters = tuple(torch.cat(camera.tensors, -1).detach()[None] for camera in task.cameras)
    state = State(
        parameters,
        Poses(turns[None], (translations - turns @ shift)[None]).expand(count),
        Poses.none(count, 1, start)._replace(translations=(start @ first.mT + shift)[:, None]),
        start.new_zeros(count, 2),
    )
    seen_by = zip(map(model_of, task.cameras), pixels[..., None, None, :], seen[..., None, None], strict=True)
    observed = [CameraObservations(model, start.new_zeros(count, 1, 1, 3), *rest) for model, *rest in seen_by]
    held = tuple(torch.zeros(p.shape[-1], dtype=torch.bool, device=p.device) for p in parameters)
    free = Free(held, boards="positions")
    found = adjust(
        observed, state, free, steps=_STEPS, settled=_SETTLED, nothing=_NOTHING, damping=_DAMPING, going=views >= 2
    )
    none_held = torch.zeros(count, 0, dtype=torch.bool, device=start.device)
    (step, _), _ = System(found.equations, 3, none_held).step(torch.zeros_like(found.cost))
    points = (found.state.boards.translations[:, 0] - shift) @ first
    valid = found.converged & (views >= 2) & _is_ahead(points, positions, rays, task.seen)
    valid &= step[:, 0].norm(dim=-1) <= _FLEEING * (points - middle).norm(dim=-1)
    valid &= torch.isfinite(points).all(-1)
    for has_pixel, is_seen in zip(found.valid, task.seen, strict=True):
        valid &= has_pixel[:, 0, 0] | ~is_seen
    return torch.where(torch.isfinite(points), points, 0.0), valid


def _is_ahead(points: Tensor, positions: Tensor, rays: Tensor, seen: Tensor) -> Tensor:
    """Whether points lie ahead on the rays of all cameras that see them, (P,)."""
    along = ((points - positions[:, None]) * rays).sum(-1)
    return ((along > 0) | ~seen).all(0)
