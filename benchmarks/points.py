"""Points: every model in both directions, forward and backward, eager and compiled, beside the peers.

Directions are uniform up to 75 degrees. The errors of `unproject` are taken where a pixel ought to be: the ray
that came out is projected in float64, and compared with the pixel that went in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.memory import growth, kept_for_backward
from benchmarks.options import Options, progress
from benchmarks.passes import passes, prepared
from benchmarks.point_peers import COMPILED, COPY, FLOOR, OPENCV, OURS, PLANES, Contestant, contestants
from benchmarks.tables import Record, only, relative, table
from benchmarks.timing import measure

_OFF = 1.0  # pixels: an answer further off than this is counted as wrong
_COMPILED = ("kannala_brandt", "brown_conrady", "fisheye624")  # unless asked for models: each takes half a minute
_MOST_JUDGED = 250_000  # points whose errors are looked at


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    records = [r for key in options.chosen(tuple(cameras.COEFFICIENTS)) for r in _model(key, options)]
    seconds = only(records, "seconds")
    compiling = only(records, "first call", lambda who: who in (COMPILED, PLANES))
    count = f"{options.size:,} points"
    tables = [
        table(f"Points: milliseconds per {count} (times camtorch eager)", seconds, scale=1e3, beside=OURS),
        table("Points: time in cold copies of 20 bytes per point", relative(seconds, COPY)),
        table("Points: seconds to compile", compiling),
        table("Points: bytes per point that wait for the backward pass, input included", only(records, "kept")),
        table("Points: bytes per point at the peak, beyond the input", only(records, "peak")),
        table("Points: largest error in pixels, where there is an answer", only(records, "error")),
        table("Points: percent without an answer, or off by more than 1 px", only(records, "lost"), scale=100),
    ]
    return records, tables


def _model(key: str, options: Options) -> Iterator[Record]:
    """Everything about one model. What was compiled for another is forgotten first."""
    torch.compiler.reset()
    everyone = contestants(key, options.device, options.compile and (key in _COMPILED or key in options.models))
    reference = cameras.camera(key, options.device, torch.float64)
    points = cameras.points(options.size, cameras.TIMED_ANGLE, options.device)
    for name, source in (("project", points), ("unproject", pixels_of(reference, points))):
        for operation, runs in passes(everyone, name, source):
            records = measure(key, operation, runs, options)
            yield from records
            # OpenCV allocates where torch does not see it, and of the floor nobody wants to know
            seen = {r.contestant for r in records} - {OPENCV, *FLOOR}
            for who in (who for who in runs if who in seen):
                progress(f"{key}, {operation}: memory of {who}")
                yield Record(key, who, operation, "peak", growth(runs[who], options.device)[0] / options.size)
        for who, (direction, x) in prepared(everyone, name, source).items():
            if direction.learns is not None and who in seen:
                kept = kept_for_backward(direction.values, x, options.device)
                yield Record(key, who, name, "kept", kept / options.size)
    for degrees in cameras.angles(key):
        yield from _errors(key, reference, everyone, degrees, options)


def pixels_of(reference: ct.Camera, points: Tensor) -> Tensor:
    """(*B, *N, 2) float32, contiguous: where the reference sees the points."""
    with torch.no_grad():
        return reference.project(points.double())[0].float().contiguous()


def _errors(
    key: str, reference: ct.Camera, everyone: list[Contestant], degrees: int, options: Options
) -> Iterator[Record]:
    """The errors over all directions up to an angle, of those that the model maps."""
    points = cameras.points(min(options.size, _MOST_JUDGED), degrees, options.device)
    with torch.no_grad():
        truth, mapped = reference.project(points.double())
    asked = truth.float().contiguous()

    def of_pixels(pixels: Tensor) -> Tensor:
        return (pixels.double() - truth).norm(dim=-1)

    def of_rays(rays: Tensor) -> Tensor:
        pixels, valid = reference.project(rays.double())
        return torch.where(valid, (pixels - asked.double()).norm(dim=-1), torch.nan)

    judged: dict[str, tuple[Tensor, Callable[[Tensor], Tensor]]] = {
        "project": (points, of_pixels),
        "unproject": (asked, of_rays),
    }
    for name, (source, error_of) in judged.items():
        for who, (direction, x) in prepared(everyone, name, source).items():
            if who in FLOOR:
                continue
            progress(f"{key}, {name} up to {degrees} degrees: errors of {who}")
            try:
                with torch.no_grad():
                    error = error_of(direction.answer(direction.call(x)).to(options.device))[mapped]
            except Exception:  # it has failed, and been named, when it was timed
                continue
            answered = error[torch.isfinite(error)]
            operation = f"{name}, {degrees}°"
            yield Record(key, who, operation, "error", answered.max().item() if answered.numel() else float("nan"))
            yield Record(key, who, operation, "lost", 1 - (error <= _OFF).double().mean().item())
