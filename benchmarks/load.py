"""Beside load: what calls take on idle cores, beside one busy process, and beside one on every core.

What a process may get of a core that another is busy on is half of it: a call that loses no time to waiting takes twice
as long. OpenCV and kornia are measured beside the same load, in turns. Medians, of calls of 20 ms or several that
take as long: the fastest round is the one that the other process was not there in.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch

from benchmarks import augment, cameras, images
from benchmarks.busy import Busy, cores
from benchmarks.image_peers import CACHED, FRESH, LATTICE, OPENCV_MAPS, Task
from benchmarks.image_peers import contestants as image_contestants
from benchmarks.options import Options
from benchmarks.passes import passes
from benchmarks.point_peers import KORNIA, OPENCV, OURS, camtorch, kornia, opencv
from benchmarks.points import pixels_of
from benchmarks.tables import Record, only, table
from benchmarks.timing import Run, measure
from benchmarks.verdict import Requirement, figures, times_faster, verdict

POINT_MODELS = ("kannala_brandt", "brown_conrady", "fisheye624")
IMAGES, POINTS, AUGMENT = "image", "points", "RandomCamera"
IDLE = "idle"
_COUNT, _QUICK_COUNT = 1_000_000, 10_000
_SHORTEST = 20e-3  # seconds: some slices of the scheduler's


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    with Busy(cores()) as busy:
        records = [
            record
            for case, runs in _rows(options)
            for count in sorted({0, 1, cores()})
            for record in _beside(busy, count, case, runs, options)
        ]
    seconds = only(records, "seconds")
    tables = [
        table("Beside load: milliseconds (times camtorch)", seconds, scale=1e3, beside=OURS),
        table("Beside load: times idle", _times_idle(seconds)),
        verdict(requirements(records)),
    ]
    return records, tables


def state(count: int) -> str:
    """How a column is called."""
    return f"beside {count} busy" if count else IDLE


def requirements(records: Sequence[Record]) -> list[Requirement]:
    """What has to hold beside one busy process a core."""
    loaded = state(cores())
    rows = {row: times for row, times in figures(records, "seconds").items() if row[1] == loaded}
    idle = {row[0]: times for row, times in figures(records, "seconds").items() if row[1] == IDLE}
    ours = [OURS, LATTICE]
    found = []
    for kind, bound in ((IMAGES, 2.5), (POINTS, 4.0)):
        ratios = {
            f"{case}, {who}": times[who] / idle[case][who]
            for (case, _), times in rows.items()
            for who in ours
            if case.startswith(kind) and who in times
        }
        found.append(Requirement(f"{kind} rows {loaded}: at most {bound:g} times idle", bound, ratios, at_most=True))
    for name, peers in (("OpenCV", (OPENCV, *OPENCV_MAPS)), (KORNIA, (KORNIA, augment.AFFINE))):
        found.append(Requirement(f"every row {loaded}: no slower than {name}", 1.0, times_faster(rows, OURS, peers)))
    return found


def _times_idle(seconds: Sequence[Record]) -> list[Record]:
    idle = {(r.case, r.contestant): r.value for r in seconds if r.operation == IDLE}
    return [
        Record(r.case, r.contestant, r.operation, r.quantity, r.value / idle[r.case, r.contestant])
        for r in seconds
        if r.operation != IDLE and (r.case, r.contestant) in idle
    ]


def _beside(busy: Busy, count: int, case: str, runs: dict[str, Run], options: Options) -> list[Record]:
    busy.spin(count)
    try:
        return measure(case, state(count), runs, options, shortest=0.0 if options.quick else _SHORTEST)
    finally:
        busy.spin(0)


def _rows(options: Options) -> Iterator[tuple[str, dict[str, Run]]]:
    """What is measured: (case, by contestant)."""
    for key in options.chosen(images.MODELS):
        for task in _tasks(key, options):
            everyone = image_contestants(task)
            for operation in (CACHED, FRESH):
                wanted = (OURS, LATTICE, *OPENCV_MAPS, KORNIA)
                runs = {who: everyone[who][operation] for who in wanted if operation in everyone[who]}
                yield f"{IMAGES} {task.name}, {operation}", runs
    for key in options.chosen(POINT_MODELS):
        yield from _points(key, options)
    size = augment.QUICK_SIZE if options.quick else augment.SIZE
    for case in augment.CASES[:1] if options.quick else augment.CASES:
        for dtype in augment.OPERATIONS:
            found = augment.contestants(case, size, augment.data_of(dtype, size, options), options)
            runs = {who: found[who] for who in (OURS, augment.AFFINE, OPENCV) if who in found}
            yield f"{AUGMENT} {case.name}, {dtype}", runs


def _tasks(key: str, options: Options) -> list[Task]:
    if options.quick:
        return [Task(key, 8, 1, images.QUICK, torch.uint8, options.device)]
    shapes = ((8, 1, images.SMALL, torch.uint8), (1, 3, images.LARGE, torch.uint8))
    shapes += ((8, 3, images.LARGE, torch.uint8), (8, 3, images.LARGE, torch.float32))
    return [Task(key, *shape, options.device) for shape in shapes]


def _points(key: str, options: Options) -> Iterator[tuple[str, dict[str, Run]]]:
    """Both directions, forward and with backward."""
    everyone = [camtorch(cameras.camera(key, options.device)), *opencv(key), *kornia(key, options.device)]
    count = _QUICK_COUNT if options.quick else _COUNT
    points = cameras.points(count, cameras.TIMED_ANGLE, options.device)
    reference = cameras.camera(key, options.device, torch.float64)
    for name, source in (("project", points), ("unproject", pixels_of(reference, points))):
        for operation, runs in passes(everyone, name, source):
            yield f"{POINTS} {key}, {operation}", runs
