"""Points: a model in both directions, forward and backward, eager and compiled.

OpenCV and kornia's lenses map the plane z = 1, so that they cannot tell a ray past 90 degrees from its mirror image;
kornia's are even spared the division by z here. The errors of `unproject` are taken where a pixel ought to be: the
ray is projected in float64, and compared with the pixel that went in.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from kornia.geometry import calibration
from kornia.geometry.camera import distortion_kannala_brandt as kannala_brandt
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.harness import KORNIA, NAMES, OPENCV, OURS, Figure, Options, Row, Table, measure, step, threads
from benchmarks.memory import kept_for_backward

COMPILED, FORMULA = "compiled", "its formula in torch"
_EVERYONE = (OURS, COMPILED, OPENCV, KORNIA)
TABLES = (
    Table("points", "1M float32 points, ms", _EVERYONE, alone=(COMPILED,)),
    Table("few points", "100 float32 points, us", (OURS, FORMULA), 1e6),
    Table("points, memory", "bytes a point that wait for the backward pass, input included", _EVERYONE, 1, None),
    Table("points, errors", "largest error, px, where there is an answer", _EVERYONE, 1, None),
    Table("points, lost", "% without an answer, or off by more than 1 px", _EVERYONE, 100, None),
)
_WITHIN_90 = ("pinhole", "brown_conrady")
_OFF = 1.0  # pixels: an answer further off is wrong
_COMPILED = ("kannala_brandt", "brown_conrady", "fisheye624")  # unless asked for models: each takes half a minute
_MOST_JUDGED = 250_000  # points whose errors are taken
_ahead = lambda points: points[:, :2] / points[:, 2:]
_on_plane = lambda pixels: torch.nn.functional.pad(pixels, (0, 1), value=1.0)


@dataclass(frozen=True)
class Direction:
    """One direction of one contestant.

    `call` is timed; `prepare` makes what it takes of (N, 3) points or (N, 2) pixels, `answer` makes pixels or rays of
    what it gives, NaN where that is called invalid. `learns` receives gradients besides the input; None has none.
    """

    call: Callable[[Any], Any]
    prepare: Callable[[Tensor], Any] = lambda x: x
    answer: Callable[[Any], Tensor] = lambda result: result
    learns: tuple[Tensor, ...] | None = ()

    def values(self, source: Any) -> Tensor:
        """Return the part of the result that has gradients."""
        result = self.call(source)
        return result if isinstance(result, Tensor) else result[0]


Contestants = dict[str, Direction]


def rows(options: Options) -> Iterator[Row]:
    """Measure every model."""
    for key in options.chosen(tuple(cameras.COEFFICIENTS)):
        torch.compiler.reset()  # what was compiled for another model
        compiled = options.compile and (key in _COMPILED or key in options.model)
        reference = cameras.camera(key, options.device, torch.float64).requires_grad_(False)
        points = cameras.points(options.size, 75, options.device)
        pixels = reference.project(points.double())[0].float().contiguous()
        for way, source in (("project", points), ("unproject", pixels)):
            everyone = contestants(key, way, options.device, compiled=compiled)
            yield from _way(f"{NAMES.get(key, key)} {way}", everyone, source, options)
            for degrees in () if options.rows else (45, 75) if key in _WITHIN_90 else (75, 100):
                yield from _errors(f"{NAMES.get(key, key)} {way}", way, everyone, reference, degrees, options)
    if few := options.chosen(("kannala_brandt",)):
        lens, points = cameras.camera(*few, options.device), cameras.points(100, 90, options.device)
        runs = {OURS: lambda: lens.project(points), FORMULA: lambda: _bare_fisheye(points, *lens.parameters())}
        with threads(1), torch.no_grad():
            yield measure("few points", f"{NAMES[few[0]]} project", runs, options)


def _bare_fisheye(points: Tensor, intrinsics: Tensor, k: Tensor) -> Tensor:
    """Project by the bare formula, which says of no point whether it is valid."""
    radius = torch.linalg.vector_norm(points[:, :2], dim=1, keepdim=True)
    angle = torch.atan2(radius, points[:, 2:])
    square = angle * angle
    scale = angle * (1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3])))) / radius
    return points[:, :2] * scale * intrinsics[:2] + intrinsics[2:]


def contestants(key: str, way: str, device: torch.device, *, compiled: bool) -> Contestants:
    """Return who can do a direction of a model."""
    lens = cameras.camera(key, device)
    learns = tuple(p for p in lens.parameters() if p.numel())
    masked = lambda result: torch.where(result[1][..., None], result[0], torch.nan)
    call = getattr(lens, way)
    found = {OURS: Direction(call, answer=masked, learns=learns)}
    if compiled:
        found[COMPILED] = Direction(torch.compile(call, dynamic=False), answer=masked, learns=learns)
    peers = {"kannala_brandt": _fisheye_peers, "brown_conrady": _perspective_peers}.get(key, lambda *_: {})
    return found | {who: both[way == "unproject"] for who, both in peers(cameras.COEFFICIENTS[key], device).items()}


def _fisheye_peers(lens: tuple[float, ...], device: torch.device) -> dict[str, tuple[Direction, Direction]]:
    flat = torch.tensor((*cameras.INTRINSICS, *lens), device=device).requires_grad_()
    project = lambda x: kannala_brandt.distort_points_kannala_brandt(x, flat)
    unproject = lambda x: kannala_brandt.undistort_points_kannala_brandt(x, flat)
    kornia = Direction(project, _ahead, learns=(flat,)), Direction(unproject, answer=_on_plane, learns=(flat,))
    return {OPENCV: _opencv(cv2.fisheye, lens), KORNIA: kornia}


def _perspective_peers(lens: tuple[float, ...], device: torch.device) -> dict[str, tuple[Direction, Direction]]:
    matrix = torch.tensor(cameras.matrix()[None], dtype=torch.float32, device=device)
    learns = matrix.requires_grad_(), torch.tensor([lens], device=device).requires_grad_()
    focal, centre = torch.tensor(cameras.INTRINSICS, dtype=torch.float64, device=device).split(2)
    kornia = (
        Direction(
            lambda x: calibration.distort_points(x, *learns),
            lambda points: (_ahead(points.double()) * focal + centre).float()[None],  # of a camera without distortion
            lambda pixels: pixels[0],
            learns,
        ),
        Direction(
            lambda x: calibration.undistort_points(x, *learns),
            lambda pixels: pixels[None],
            lambda pixels: _on_plane((pixels[0].double() - centre) / focal),
            learns,
        ),
    )
    return {OPENCV: _opencv(cv2, lens), KORNIA: kornia}


def _opencv(module: Any, lens: tuple[float, ...]) -> tuple[Direction, Direction]:
    """In float32, as its callers' points are."""
    still, matrix, coefficients = np.zeros(3), cameras.matrix(), np.array(lens)
    as_array = lambda x: x.cpu().numpy()[None]
    project = lambda p: module.projectPoints(p, still, still, matrix, coefficients)
    unproject = lambda p: module.undistortPoints(p, matrix, coefficients)
    return (
        Direction(project, as_array, lambda r: torch.from_numpy(r[0].reshape(-1, 2)), None),
        Direction(unproject, as_array, lambda r: _on_plane(torch.from_numpy(r.reshape(-1, 2))), None),
    )


def _way(name: str, everyone: Contestants, source: Tensor, options: Options) -> Iterator[Row]:
    """Forward, and forward with backward."""
    inputs = {who: direction.prepare(source) for who, direction in everyone.items()}
    forward = {who: partial(torch.no_grad()(d.call), inputs[who]) for who, d in everyone.items()}
    learning = {who: d for who, d in everyone.items() if d.learns is not None}
    both = {who: step(lambda x, *_, d=d: d.values(x), inputs[who], *d.learns) for who, d in learning.items()}
    for text, runs in ((name, forward), (f"{name} and backward", both)):
        found, million = measure("points", text, runs, options).figures, 1e6 / len(source)
        yield Row("points", text, {who: figure.times(million) for who, figure in found.items()})
    kept = {who: kept_for_backward(everyone[who].values, inputs[who]) / len(source) for who in both if who in found}
    yield Row("points, memory", name, {who: Figure(value) for who, value in kept.items()})


def _errors(
    name: str, way: str, everyone: Contestants, reference: ct.Camera, degrees: int, options: Options
) -> Iterator[Row]:
    """The errors over all directions up to an angle that the model maps."""
    points = cameras.points(min(options.size, _MOST_JUDGED), degrees, options.device)
    with torch.no_grad():
        truth, mapped = reference.project(points.double())
    source = points if way == "project" else truth.float().contiguous()
    errors, lost = {}, {}
    for who, direction in everyone.items():
        try:
            with torch.no_grad():
                found = direction.answer(direction.call(direction.prepare(source))).to(options.device).double()
        except Exception:  # it was named when it was timed
            continue
        if way == "unproject":
            found, valid = reference.project(found)
            found = torch.where(valid[..., None], found, torch.nan)
        error = (found - (truth if way == "project" else source.double())).norm(dim=-1)[mapped]
        answered = error[torch.isfinite(error)]
        errors[who] = Figure(answered.max().item() if answered.numel() else float("nan"))
        lost[who] = Figure(1 - (error <= _OFF).double().mean().item())
    yield Row("points, errors", f"{name} up to {degrees}°", errors)
    yield Row("points, lost", f"{name} up to {degrees}°", lost)
