"""Scaling: what a point costs from a hundred to ten million of them, and what a call costs, with many cameras too."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.options import Options
from benchmarks.passes import passes
from benchmarks.point_peers import OURS, Contestant, camtorch, kornia, opencv
from benchmarks.points import pixels_of
from benchmarks.tables import Record, only, table
from benchmarks.timing import measure

MODELS = ("kannala_brandt", "brown_conrady", "fisheye624")
COUNTS = tuple(10**e for e in range(2, 8))
BATCHES = (1, 8, 64)
POINTS_PER_CAMERA = 100
# A quick run goes as far. Beyond, peers would come to keep several GB for their backward pass
_MANY = 10**5
_FEW = 10**4  # points that take no longer than the overhead of a call


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    keys = options.chosen(MODELS)
    counts = {f"{n:,}": n for n in COUNTS if n <= _MANY or not options.quick}
    by_count = [r for key in keys for label, n in counts.items() for r in _points(key, label, n, options)]
    by_batch = [r for key in keys for batch in BATCHES for r in _cameras(key, batch, options)]
    seconds = only(by_count, "seconds")
    per_point = [
        Record(r.case, r.contestant, r.operation, "seconds per point", r.value / counts[r.operation]) for r in seconds
    ]
    few = [r for r in seconds if counts[r.operation] <= _FEW]
    many = f"Scaling: microseconds per call, B cameras of {POINTS_PER_CAMERA} points each"
    tables = [
        table("Scaling: nanoseconds per point, for N points", per_point, scale=1e9),
        table("Scaling: microseconds per call, for N points (times camtorch)", few, scale=1e6, beside=OURS),
        table(many, only(by_batch, "seconds"), scale=1e6),
    ]
    return by_count + per_point + by_batch, tables


def _points(key: str, label: str, count: int, options: Options) -> list[Record]:
    """One camera and a number of points."""
    everyone = [camtorch(cameras.camera(key, options.device))]
    if count <= _MANY:
        everyone += [*opencv(key), *kornia(key, options.device)]
    points = cameras.points(count, cameras.TIMED_ANGLE, options.device)
    reference = cameras.camera(key, options.device, torch.float64)
    return list(_measure(key, label, everyone, points, reference, options))


def _cameras(key: str, batch: int, options: Options) -> list[Record]:
    """A batch of cameras, each a little different and with a few points of its own: nothing that peers do."""
    lens, reference = (
        cameras.camera(key, options.device, dtype, batch=batch) for dtype in (torch.float32, torch.float64)
    )
    points = cameras.points(batch * POINTS_PER_CAMERA, cameras.TIMED_ANGLE, options.device)
    points = points.reshape(batch, POINTS_PER_CAMERA, 3)
    return list(_measure(key, f"B = {batch}", [camtorch(lens)], points, reference, options))


def _measure(
    key: str, column: str, everyone: list[Contestant], points: Tensor, reference: ct.Camera, options: Options
) -> Iterator[Record]:
    """All operations, each a case of its own: the columns are sizes."""
    for name, source in (("project", points), ("unproject", pixels_of(reference, points))):
        for operation, runs in passes(everyone, name, source):
            yield from measure(f"{key} {operation}", column, runs, options)
