"""`camtorch dewarp` on folders of JPEGs and on a video, beside reading, warping and writing alone.

A folder is done by new processes on either side, so the time in which they start and import torch is in both, which a
folder of one image shows; what is written is checked to be the same files. A video is done in this process on either
side, so that time is in neither; the map is made each time in both. The warp alone is of RGB, without the way there and
back.

What is required is judged by the fastest of three rounds, of the parts of a video by the fastest round of each.
"""

from __future__ import annotations

import filecmp
import io
import itertools
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image

import camtorch as ct
from benchmarks import bare, cameras
from benchmarks.options import Options, complain, progress
from benchmarks.point_peers import OURS
from benchmarks.tables import Record, only, table
from benchmarks.timing import summary
from benchmarks.verdict import Requirement, figures, times_faster, verdict
from camtorch.cli.main import main as command_line

BARE = "read + warp + write"
PARTS = ("decode", "warp", "encode")
APART = " + ".join(PARTS)
_MODEL = "kannala_brandt"
_SIZE, _QUICK_SIZE = (720, 1280), (120, 160)
_IMAGES, _QUICK_IMAGES = 1000, 6
_DIFFERENT = 25  # of the images; the others are copies
_FRAMES, _QUICK_FRAMES = 120, 8
_RATE = 30  # a second
_ROUNDS = 3  # at most: they are long
_JOBS = (1, 2)
_BOUND, _SCALING = 0.9, 1.7
# as `camtorch dewarp` encodes
_CRF, _THREADS, _ENCODING = 18, 4, {"mbtree": "0"}
_ROOT = Path(__file__).resolve().parents[1]

Timed = Callable[[], float]
"""Something that does its work and returns the seconds that it took."""


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    with TemporaryDirectory(prefix="camtorch-benchmark-") as name, torch.no_grad():
        place, size = Path(name), _QUICK_SIZE if options.quick else _SIZE
        camera = cameras.camera(_MODEL, torch.device("cpu"), size=size).requires_grad_(False)
        ct.save(camera, place / "camera.yml", format="opencv")
        counts = (_QUICK_IMAGES,) if options.quick else (1, _IMAGES)
        folders = [_folder(place, count, size, options) for count in counts]
        video = _video(place, size, options) if find_spec("av") else []
    if not video:
        complain("folders: no videos, for PyAV is not installed: pip install 'camtorch[video]'")
    records, tables = [], []
    for title, found in (("Folders", list(itertools.chain(*folders))), ("Videos", video)):
        records += found
        tables.append(table(f"{title}: seconds, medians (times camtorch)", only(found, "seconds"), beside=OURS))
        tables.append(table(f"{title}: seconds, fastest (times camtorch)", only(found, "fastest"), beside=OURS))
    return records, [*tables, verdict(_requirements(folders[-1], video))]


def _requirements(folder: Sequence[Record], video: Sequence[Record]) -> list[Requirement]:
    fastest = figures(folder, "fastest")
    one, two = ({case: times[OURS] for (case, found), times in fastest.items() if found == _jobs(n)} for n in _JOBS)
    beside_parts = times_faster(figures(video, "fastest"), OURS, [APART])
    return [
        Requirement(f"a folder: {_BOUND:g} times {BARE}", _BOUND, times_faster(fastest, OURS, [BARE])),
        Requirement(f"two jobs: {_SCALING:g} times one", _SCALING, {case: one[case] / two[case] for case in two}),
        Requirement(f"a video: {_BOUND:g} times {APART}", _BOUND, beside_parts),
    ]


def _jobs(count: int) -> str:
    return f"{count} job{'s' * (count > 1)}"


def _turns(case: str, runs: Mapping[tuple[str, str], Timed], options: Options) -> list[Record]:
    """Some rounds, in each of which everyone, by (operation, contestant), has a turn."""
    rounds = 1 if options.quick else min(options.repeats, _ROUNDS)
    samples: dict[tuple[str, str], list[float]] = {key: [] for key in runs}
    for turn in range(rounds):
        for operation, who in list(runs)[:: 1 if turn % 2 == 0 else -1]:
            progress(f"{case}, {operation}: round {turn + 1} of {rounds}, {who}")
            samples[operation, who].append(runs[operation, who]())
    return [r for (operation, who), taken in samples.items() for r in summary(case, who, operation, taken)]


def _clocked(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


# -- folders


def _folder(place: Path, count: int, size: tuple[int, int], options: Options) -> list[Record]:
    case = f"{count:,} JPEG{'s' * (count > 1)} of {size[1]}x{size[0]}"
    progress(f"{case}: preparing")
    source = place / "images"
    _write_images(source, count, size)
    camera, outputs = place / "camera.yml", {who: place / who.replace(" ", "") for who in (OURS, BARE)}
    runs: dict[tuple[str, str], Timed] = {}
    for jobs in _JOBS:
        dewarp = [["camtorch", "dewarp", source, "--camera", camera, "-o", outputs[OURS], "--jobs", jobs]]
        script = [["benchmarks.bare", camera, source, outputs[BARE], rank, jobs] for rank in range(jobs)]
        runs[_jobs(jobs), OURS] = _into(outputs[OURS], dewarp)
        runs[_jobs(jobs), BARE] = _into(outputs[BARE], script)
    records = _turns(case, runs, options)
    names = [path.name for path in source.iterdir()]
    equal, *_ = filecmp.cmpfiles(*outputs.values(), names, shallow=False)
    if len(equal) != count:
        raise RuntimeError(f"folders: of {count} files, only {len(equal)} are the same by camtorch dewarp and bare")
    for used in (source, *outputs.values()):
        shutil.rmtree(used)
    return records


def _into(output: Path, commands: list[list[Any]]) -> Timed:
    """Modules of Python's with arguments, at the same time, into a folder that is empty before."""

    def timed() -> float:
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir()
        return _clocked(lambda: _at_once(commands))

    return timed


def _at_once(commands: list[list[Any]]) -> None:
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", *map(str, command)],
            cwd=_ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for command in commands
    ]
    try:
        for process in processes:
            _, errors = process.communicate()
            if process.returncode:
                raise RuntimeError(f"folders: {' '.join(map(str, process.args))} failed: {errors[-1000:]}")
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _write_images(folder: Path, count: int, size: tuple[int, int]) -> None:
    """JPEGs with about as much in them as photographs have."""
    folder.mkdir()
    random = np.random.default_rng(0)
    height, width = size
    for i in range(count):
        path = folder / f"{i:05}.jpg"
        if i < _DIFFERENT:
            coarse = random.integers(256, size=(height // 8, width // 8, 3), dtype=np.uint8)
            Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC).save(path, quality=90)
        else:
            shutil.copyfile(folder / f"{i % _DIFFERENT:05}.jpg", path)


# -- videos


def _video(place: Path, size: tuple[int, int], options: Options) -> list[Record]:
    count = _QUICK_FRAMES if options.quick else _FRAMES
    case, operation = f"{count} frames of {size[1]}x{size[0]}", "a video"
    progress(f"{case}: preparing")
    source, camera = place / "source.mp4", ct.load(place / "camera.yml").camera
    moving = _moving(count, size)
    _encode(source, [_frame(image) for image in moving], {"preset": "veryfast", "crf": "20"})
    decoded = [frame.to_ndarray(format="rgb24") for frame in _decode(source)]
    images = [torch.from_numpy(image).permute(2, 0, 1)[None] for image in decoded]
    warped = [_frame(image[0].permute(1, 2, 0).contiguous().numpy()) for image in _warp(camera, images)]
    target, again = place / "target.mp4", place / "again.mp4"
    words = ["dewarp", source, "--camera", place / "camera.yml", "-o", target, "--crf", _CRF, "--force"]
    works: dict[str, Callable[[], object]] = {
        OURS: lambda: _command([str(word) for word in words]),
        "decode": lambda: sum(1 for _ in _decode(source)),
        "warp": lambda: sum(1 for _ in _warp(camera, images)),
        "encode": lambda: _encode(again, warped, {"crf": str(_CRF), **_ENCODING}),
    }
    runs = {(operation, who): lambda work=work: _clocked(work) for who, work in works.items()}
    records = _turns(case, runs, options)
    made = sum(1 for _ in _decode(target))
    if made != count:
        raise RuntimeError(f"folders: of {count} frames, camtorch dewarp wrote {made}")
    for quantity in ("seconds", "fastest"):
        total = sum(r.value for r in records if r.quantity == quantity and r.contestant in PARTS)
        records.append(Record(case, APART, operation, quantity, total))
    return records


def _command(words: list[str]) -> None:
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        status = command_line(words)
    if status:
        raise RuntimeError(f"folders: camtorch {' '.join(words)}: {said.getvalue()[-1000:]}")


def _moving(count: int, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """So many (H, W, 3) uint8: a scene that moves by, and a sensor's noise."""
    random = np.random.default_rng(0)
    height, width = size
    rows, columns = (height + count // 2) // 10 + 1, (width + 3 * count) // 10 + 1
    coarse = random.integers(256, size=(rows, columns, 3), dtype=np.uint8)
    scene = np.asarray(Image.fromarray(coarse).resize((10 * columns, 10 * rows), Image.Resampling.BICUBIC))
    for i in range(count):
        part = scene[i // 2 : i // 2 + height, 3 * i : 3 * i + width]
        yield (part + random.integers(-3, 4, part.shape, dtype=np.int16)).clip(0, 255).astype(np.uint8)


def _frame(image: np.ndarray) -> Any:
    import av

    return av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24").reformat(format="yuv420p")


def _decode(path: Path) -> Iterator[Any]:
    import av

    with av.open(str(path)) as container:
        container.streams.video[0].thread_type = "AUTO"
        yield from container.decode(video=0)


def _warp(camera: ct.Camera, images: Sequence[torch.Tensor]) -> Iterator[torch.Tensor]:
    warp = ct.Dewarp(camera, tolerance=bare.TOLERANCE)
    return map(warp, images)


def _encode(path: Path, frames: Sequence[Any], encoding: dict[str, str]) -> None:
    import av

    tick = Fraction(1, _RATE)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=_RATE, time_base=tick)
        stream.width, stream.height, stream.pix_fmt = frames[0].width, frames[0].height, "yuv420p"
        stream.options, stream.codec_context.thread_count = encoding, _THREADS
        for i, frame in enumerate(itertools.chain(frames, [None])):
            if frame is not None:
                frame.pts, frame.time_base = i, tick
            container.mux(stream.encode(frame))
