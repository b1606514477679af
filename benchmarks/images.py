"""Images: dewarping with a map that is kept, with maps computed each time, and with gradients.

The error is the largest difference, in grey levels, to `grid_sample` in float64 with positions from a float64 camera,
over the pixels whose interpolation stays inside the image. The images are noise, whose neighbours differ by up
to 255: an error of a position of 0.01 px shows as some 2 grey levels. Results in uint8 are up to 0.5 off by rounding.

What is required is judged by the fastest rounds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

import camtorch as ct
from benchmarks import footprint
from benchmarks.image_peers import (
    CACHED,
    CLONE,
    DELTACAMERA,
    FRESH,
    GRID_SAMPLE,
    LATTICE,
    OPENCV_MAPS,
    OPERATIONS,
    Task,
    as_tensor,
    contestants,
)
from benchmarks.options import Options, progress
from benchmarks.point_peers import KORNIA, OURS
from benchmarks.tables import Record, only, relative, table
from benchmarks.timing import measure, threads
from benchmarks.verdict import Requirement, figures, times_faster, verdict

MODELS = ("kannala_brandt", "brown_conrady")
SMALL, LARGE, QUICK = (480, 640), (720, 1280), (120, 160)
_ONE_THREAD = ", 1 thread"
_LEARNING = ((1, 3, LARGE), (8, 3, SMALL), (8, 3, QUICK))  # whose gradients are timed
_JUDGED = 2  # images of a batch whose errors are looked at


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    found = [task for key in options.chosen(MODELS) for task in tasks(key, options)]
    records = [record for task in found for record in _task(task, options)]
    weighed = [task for task in found if task.batch > 1 and not task.last and task.size != SMALL]
    records += footprint.measured(weighed, options)
    seconds = only(records, "seconds")
    title = f"Images: milliseconds on {options.threads} threads, where not on one (times camtorch)"
    tables = [
        table(title, seconds, scale=1e3, beside=OURS),
        table("Images: time in clones of the images", relative(seconds, CLONE)),
        table("Images: largest difference to float64, in grey levels", only(records, "error")),
        table("Images: memory at the peak of a warp, in sizes of its result", only(records, "peak")),
        verdict(requirements(records)),
    ]
    return records, tables


def tasks(key: str, options: Options) -> list[Task]:
    """What is measured of a model."""
    full, byte = torch.float32, torch.uint8
    if options.quick:
        asked = [(1, 3, QUICK, full, False), (8, 3, QUICK, full, False), (8, 1, QUICK, byte, False)]
        asked += [(1, 3, QUICK, byte, True)]
    else:
        asked = [(batch, 3, LARGE, dtype, False) for batch in (1, 8) for dtype in (full, byte)]
        asked += [(batch, 3, LARGE, byte, True) for batch in (1, 8)]
        asked += [(8, 1, SMALL, byte, False), (8, 3, SMALL, byte, False), (8, 3, SMALL, full, False)]
    return [Task(key, *shape, dtype, options.device, last) for *shape, dtype, last in asked]


def requirements(records: Sequence[Record]) -> list[Requirement]:
    """What has to hold of the times and of the memory."""
    rows = figures(records, "fastest")
    cached, fresh = (
        {row: times for row, times in rows.items() if row[1].startswith(operation)} for operation in (CACHED, FRESH)
    )
    large = {row: times for row, times in cached.items() if " 8x" in row[0] and "x720x1280 float32" in row[0]}
    byte = {row: times for row, times in cached.items() if "uint8" in row[0]}
    found = [
        Requirement("cached map, 8 float32: 1.5 times OpenCV", 1.5, times_faster(large, OURS, OPENCV_MAPS)),
        Requirement("cached map, 8 float32: 2.5 times grid_sample", 2.5, times_faster(large, OURS, [GRID_SAMPLE])),
        Requirement("cached map, uint8: 1.25 times OpenCV", 1.25, times_faster(byte, OURS, OPENCV_MAPS)),
    ]
    for key, bound in (("brown_conrady", 2.0), ("kannala_brandt", 8.0)):
        ours = {row: times for row, times in fresh.items() if row[0].startswith(key)}
        text = f"fresh maps, {key}, tolerance=0.01: {bound:g} times OpenCV"
        found.append(Requirement(text, bound, times_faster(ours, LATTICE, OPENCV_MAPS)))
    for name, peers in (("OpenCV", OPENCV_MAPS), (KORNIA, [KORNIA]), (DELTACAMERA, [DELTACAMERA])):
        ratios = {**times_faster(cached, OURS, peers), **times_faster(fresh, OURS, peers)}
        found.append(Requirement(f"every row: no slower than {name}", 1.0, ratios))
    for operation, text in ((CACHED, "a map that is there"), (FRESH, "fresh maps")):
        peaks = {
            f"{r.case}, {r.contestant}": r.value
            for r in only(records, "peak")
            if r.contestant in (OURS, LATTICE) and r.operation == operation
        }
        text = f"memory of a warp, {text}: at most 1.1 results"
        found.append(Requirement(text, 1.1, peaks, at_most=True))
    return found


def _task(task: Task, options: Options) -> Iterator[Record]:
    """One kind of image: speed, then errors."""
    progress(f"{task.name}: preparing")
    everyone = contestants(task)
    timed = []
    for operation in OPERATIONS:
        runs = {who: operations[operation] for who, operations in everyone.items() if operation in operations}
        if operation in (CACHED, FRESH):
            timed += measure(task.name, operation, runs, options)
            if options.threads > 1 and options.device.type == "cpu":
                alone = {who: run for who, run in runs.items() if who != KORNIA}  # the slowest by far
                with threads(1):
                    timed += measure(task.name, operation + _ONE_THREAD, alone, options)
        elif (task.batch, task.channels, task.size) in _LEARNING:
            timed += measure(task.name, operation, runs, options)
    order = list(everyone)
    yield from sorted(timed, key=lambda record: order.index(record.contestant))
    if task.batch > 1 and task.size == LARGE:
        return  # as wrong as one image, or as smaller ones
    truths = {CACHED: ct.Warp(task.camera(dtype=torch.float64), _double(task.dewarp.target))}
    first = replace(task, batch=min(task.batch, _JUDGED))
    truths[FRESH] = first.fresh(dtype=torch.float64)
    for operation, warp in truths.items():
        truth, inside = _truth(task.images[: first.batch], warp)
        for who, operations in everyone.items():
            if operation not in operations or who == CLONE:
                continue
            progress(f"{task.name}, {operation}: errors of {who}")
            result = as_tensor(operations[operation]())[: len(truth)]
            yield Record(task.name, who, operation, "error", (result - truth).abs()[inside].max().item())


def _double(camera: ct.Camera) -> ct.Camera:
    """A copy of a pinhole camera in float64."""
    return ct.Pinhole(camera.intrinsics.detach().double(), image_size=camera.image_size)


def _truth(images: Tensor, warp: ct.Warp) -> tuple[Tensor, Tensor]:
    """(B, C, H, W) in float64, and where no neighbour lies off the image.

    It takes from `warp` its two cameras, and makes the positions and the sampling without it.
    """
    with torch.no_grad():
        rays, has_ray = warp.target.rays()
        pixels, mapped = warp.source.project(rays)
        height, width = warp.source.image_size
        last = pixels.new_tensor([width - 1, height - 1])
        inside = ((pixels > 0) & (pixels < last)).all(-1) & has_ray & mapped
        grid = 2 * pixels / last - 1
        grid = grid.expand(len(images), *grid.shape[-3:])
        truth = F.grid_sample(images.double(), grid, align_corners=True)
    return truth, inside.expand(len(images), *inside.shape[-2:]).unsqueeze(1).expand_as(truth)
