"""Images: dewarping with a map that is kept, with maps computed each time, and with gradients.

The error is the largest difference, in grey levels, to `grid_sample` in float64 with positions from a float64 camera,
over the pixels whose interpolation stays inside the image. The images are noise, whose neighbours differ by up
to 255: an error of a position of 0.01 px shows as some 2 grey levels. Results in uint8 are up to 0.5 off by rounding.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

import camtorch as ct
from benchmarks.image_peers import CACHED, CLONE, FRESH, GRID_SAMPLE, OPERATIONS, Task, contestants
from benchmarks.options import Options, progress
from benchmarks.point_peers import OPENCV, OURS
from benchmarks.tables import Record, only, relative, table
from benchmarks.timing import Run, measure

MODELS = ("kannala_brandt", "brown_conrady")
SIZES = ((1, (480, 640)), (8, (480, 640)), (1, (720, 1280)), (8, (720, 1280)), (1, (2160, 3840)))
QUICK_SIZES = ((1, (240, 320)), (8, (240, 320)))
THREADS_SIZE = (720, 1280)
_DTYPES = (torch.float32, torch.uint8)


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    keys = options.chosen(MODELS)
    sizes = QUICK_SIZES if options.quick else SIZES
    tasks = [Task(key, *size, dtype, options.device) for key in keys for size in sizes for dtype in _DTYPES]
    records = [record for task in tasks for record in _task(task, options)]
    seconds = only(records, "seconds")
    every = _with(options.threads)
    threads = [r for key in keys for r in _threads(key, options)]
    tables = [
        table("Images: milliseconds (times camtorch)", seconds, scale=1e3, beside=OURS),
        table("Images: time in clones of the images", relative(seconds, CLONE)),
        table("Images: largest difference to float64, in grey levels", only(records, "error")),
        table(f"Images: milliseconds by threads (times {every})", only(threads, "seconds"), scale=1e3, beside=every),
    ]
    return records + threads, tables


def _task(task: Task, options: Options) -> Iterator[Record]:
    """One kind of image: speed, then errors."""
    progress(f"{task.name}: preparing")
    everyone = contestants(task)
    timed = []
    for operation in OPERATIONS:
        runs = {who: operations[operation] for who, operations in everyone.items() if operation in operations}
        timed += measure(task.name, operation, runs, options)
    order = list(everyone)
    yield from sorted(timed, key=lambda record: order.index(record.contestant))
    truths = {CACHED: ct.Warp(task.camera(dtype=torch.float64), _double(task.dewarp.target))}
    truths[FRESH] = task.fresh(dtype=torch.float64)
    for operation, warp in truths.items():
        truth, inside = _truth(task.images, warp)
        for who, operations in everyone.items():
            if operation not in operations or who == CLONE:
                continue
            progress(f"{task.name}, {operation}: errors of {who}")
            result = operations[operation]()
            if isinstance(result, Tensor):  # arrays are of OpenCV, whose result as a tensor has been judged
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


def _threads(key: str, options: Options) -> Iterator[Record]:
    """A single image on one thread and on all: who leaves cores idle? Nothing to ask on one thread or on a GPU."""
    if options.threads == 1 or options.device.type != "cpu":
        return
    task = Task(key, 1, QUICK_SIZES[0][1] if options.quick else THREADS_SIZE, torch.float32, options.device)
    everyone = contestants(task)
    for who in (OURS, OPENCV, GRID_SAMPLE):
        for operation, call in everyone[who].items():
            runs = {_with(count): _on(count, call) for count in (1, options.threads)}
            try:
                yield from measure(f"{task.name} {who}", operation, runs, options)
            finally:
                _set_threads(options.threads)


def _with(count: int) -> str:
    return f"{count} thread{'s' * (count > 1)}"


def _on(count: int, call: Run) -> Run:
    """The call on so many threads; to set them takes microseconds."""

    def run():
        _set_threads(count)
        return call()

    return run


def _set_threads(count: int) -> None:
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
