"""Measures how many images of new cameras one camera's images with augmentation are worth.

Networks find landmarks in images of rendered drivers' faces, and the direction of gaze. Some learn from images of one
camera, some from 80 to 10,000 images of the cameras of the tests, some from both. They start from the same weights for
a seed, and take the same number of steps. The script writes the result of each network into a file, reads those that
the file has, and trains the others. All take two hours on two cores; `--numbers FILE` begins a new file.

    python examples/train_faces.py -o faces.png
"""

import argparse
import functools
import json
import multiprocessing
import os
import statistics
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import torch
from scenes import cabin, crops, faces
from scenes.faces import Samples
from scenes.reader import Network, loss_of, medians

import camtorch as ct
from camtorch.plot.figures import COLOURS

NUMBERS = Path(__file__).with_suffix(".json")


class Contestant(NamedTuple):
    """The images that a network learns from."""

    title: str
    one: int = 0
    """How many images of one camera."""
    augmentation: str = "camtorch"
    """Of these images, a key of `crops.AUGMENTATIONS`."""
    own: int = 0
    """How many images of the cameras of the tests."""
    rays: bool = True
    """Whether the network receives the rays of the corners of each crop."""
    longer: int = 1
    """How many times as many steps the network learns."""


CONTESTANTS = {
    "own 80": Contestant("80 of the new cameras' own", own=80),
    "own 400": Contestant("400 of the new cameras' own", own=400),
    "own 2000": Contestant("2,000 of the new cameras' own", own=2000),
    "own 10000": Contestant("10,000 of the new cameras' own", own=10000),
    "camtorch": Contestant("400 of one camera with camtorch", 400),
    "camtorch 2000": Contestant("2,000 of one camera with camtorch", 2000),
    "both 80": Contestant("400 of one camera with camtorch, 80 own", 400, own=80),
    "both 400": Contestant("400 of one camera with camtorch, 400 own", 400, own=400),
    "both 2000": Contestant("400 of one camera with camtorch, 2,000 own", 400, own=2000),
    "plain": Contestant("400 of one camera", 400, "plain"),
    "affine, no rays": Contestant("400 of one camera with RandomAffine, no rays", 400, "affine", rays=False),
    "camtorch, no rays": Contestant("400 of one camera with camtorch, no rays", 400, rays=False),
    "box, no rays": Contestant("400 of one camera with camtorch and BoxCrop, no rays", 400, "box", rays=False),
}
LONGER = "own 80", "own 400", "own 2000", "own 10000", "camtorch", "camtorch 2000", "both 2000", "box, no rays"
CONTESTANTS |= {f"{name}, longer": CONTESTANTS[name]._replace(longer=4) for name in LONGER}
TESTS = {
    "seen": "the same camera",
    "mounts": "new lenses and mounts",
    "shutter": "new, rolling shutters",
    "lens": "a lens outside",
    "mount": "mounts outside",
}
OUTSIDE_FOV, OUTSIDE_MOUNTS = 175.0, ((36.0, 45.0), (21.0, 25.0), (0.0, 20.0))
BATCH = 32
CHUNK = 250  # images that a process renders at a time
VIEWS = {"own": 8, "plain": 8, "affine": 16, "camtorch": 32, "box": 16}  # of each image
OWN_WIDER = 1.25  # squares kept of images that nothing turns


# -- crops to learn from and to test with, made once for all seeds


class Data(NamedTuple):
    """Crops of faces."""

    learned: dict[str, Samples]
    """"own", and by `crops.AUGMENTATIONS` those of one camera: several views (V, N, ...) of each of N images."""
    tests: dict[str, dict[str, Samples]]
    """"plain" and "box" crops of other drivers, by `TESTS`."""


def make_data(own: int, one: int, count: int, pool: Executor) -> Data:
    """Render `own` images of the new cameras, `one` of the one camera, and `count` of other drivers for each test."""
    print(f"rendering {own} + {one} images to learn from, {count} for each of {len(TESTS)} tests", flush=True)
    generator = torch.Generator().manual_seed(100)
    lenses = [faces.lens(name) for name in faces.LENSES]
    wide = ct.KannalaBrandt.from_fov(OUTSIDE_FOV, image_size=faces.SIZE).double().requires_grad_(False)
    kinds: dict[str, tuple[int, list[ct.Camera]]] = {
        "own": (own, lenses),
        "one": (one, [faces.teacher()]),
        "seen": (count, [faces.teacher()]),
        "mounts": (count, lenses),
        "shutter": (count, lenses),
        "lens": (count, [wide]),
        # behind other lenses a face is not on the image from these mounts
        "mount": (count, [lens for lens in lenses if lens.fov[0] > 2 * OUTSIDE_MOUNTS[0][0]]),
    }
    jobs: list[tuple[str, ct.Camera, cabin.Drivers, int]] = []
    for kind, (number, cameras) in kinds.items():
        drivers = cabin.random_drivers(number, generator)
        for camera, rows in zip(cameras, torch.arange(number).tensor_split(len(cameras)), strict=True):
            jobs += [(kind, camera, drivers[part], len(jobs) + i) for i, part in enumerate(rows.split(CHUNK))]
    made: dict[tuple[str, str], list[Samples]] = {}
    for i, (job, found) in enumerate(zip(jobs, pool.map(see, *zip(*jobs, strict=True)), strict=True)):
        print(f"{i + 1} of {len(jobs)} parts", end="\r", flush=True)
        for way, samples in found.items():
            made.setdefault((job[0], way), []).append(samples)
    whole = {key: Samples(*(torch.cat(v, 1) for v in zip(*parts, strict=True))) for key, parts in made.items()}
    learned = {way: samples for (kind, way), samples in whole.items() if kind in ("own", "one")}
    tests = {way: {kind: whole[kind, way] for kind in TESTS} for way in ("plain", "box")}
    return Data(learned, tests)


def see(kind: str, camera: ct.Camera, drivers: cabin.Drivers, seed: int) -> dict[str, Samples]:
    """Render N drivers and return V crops of each, (V, N, ...), for each way to make crops."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)  # RandomAffine takes no generator
    generator = torch.Generator().manual_seed(seed)
    if kind in ("one", "seen"):
        mounts = torch.zeros(len(drivers), 3)
    else:
        mounts = faces.mounts(camera, drivers, generator, OUTSIDE_MOUNTS if kind == "mount" else faces.MOUNTS)
    rates = faces.RATE * (2 * torch.rand(len(drivers), 3, generator=generator) - 1) * (kind == "shutter")
    seen = faces.photograph(camera, drivers, mounts, rates, OWN_WIDER if kind == "own" else faces.WIDER)
    seen = seen.rows(seen.whole.nonzero()[:, 0])  # a camera that sees the face from no mount has no image of it
    if kind in TESTS:
        return {"plain": stacked([crops.plain_crops(seen)]), "box": stacked([crops.box_crops(seen)])}
    parts = [seen.rows(rows) for rows in torch.arange(len(seen.image)).split(50)]
    made = {}
    for way, augment in ({"own": crops.as_taken} if kind == "own" else crops.AUGMENTATIONS).items():
        rounds = [[augment(part, generator) for part in parts] for _ in range(VIEWS[way])]
        made[way] = stacked([Samples(*map(torch.cat, zip(*samples, strict=True))) for samples in rounds])
    return made


def stacked(views: list[Samples]) -> Samples:
    """Join several views of each of N images, (V, N, ...), with images in bytes."""
    samples = Samples(*map(torch.stack, zip(*views, strict=True)))
    return samples._replace(image=(255 * samples.image).round().byte())


# -- learning


def batches(contestant: Contestant, learned: dict[str, Samples], generator: torch.Generator) -> Iterator[Samples]:
    """Yield batches of the crops that a contestant learns from; if of both kinds, half of each."""
    sets = []
    for way, number in (("own", contestant.own), (contestant.augmentation, contestant.one)):
        if number:
            sets.append((learned[way], torch.randperm(learned[way].image.shape[1], generator=generator)[:number]))
    while True:
        parts = []
        for samples, rows in sets:
            drawn = torch.rand(2, BATCH // len(sets), generator=generator)
            view, row = (drawn * torch.tensor([[len(samples.image)], [len(rows)]])).long()
            parts.append(Samples(*(values[view, rows[row]] for values in samples)))
        yield floats(Samples(*map(torch.cat, zip(*parts, strict=True))))


def floats(samples: Samples) -> Samples:
    """Return samples with images in [0, 1]."""
    return samples._replace(image=samples.image / 255)


def train(contestant: Contestant, data: Data, steps: int, seed: int) -> dict[str, list[float]]:
    """Train a network and return `medians` by the test."""
    torch.manual_seed(seed)  # also of RandomAffine
    network = Network(contestant.rays)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-3, total_steps=steps, pct_start=0.2)
    learned = batches(contestant, data.learned, torch.Generator().manual_seed(seed))
    for samples, _ in zip(learned, range(steps), strict=False):
        loss = loss_of(network(samples), samples)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    tests = data.tests["box" if contestant.augmentation == "box" else "plain"]
    return {name: medians(network, floats(Samples(*(values[0] for values in test)))) for name, test in tests.items()}


# -- all networks, and the file of their results


def one_job(file: str, name: str, steps: int, seed: int) -> tuple[str, str, dict[str, list[float]], float]:
    """Train one network with one thread and return seed, name, medians and seconds."""
    torch.set_num_threads(1)  # networks side by side keep cores busier than many threads on small images
    start = time.perf_counter()
    found = train(CONTESTANTS[name], load(file), steps * CONTESTANTS[name].longer, seed)
    return str(seed), name, found, time.perf_counter() - start


@functools.cache
def load(file: str) -> Data:
    """Read the crops, which processes share."""
    return Data(*torch.load(file, weights_only=False, mmap=True))


def run(
    numbers: Path,
    rendered: Path,
    *,
    own: int = 10000,
    one: int = 2000,
    count: int = 400,
    steps: int = 1000,
    seeds: int = 5,
    workers: int = os.cpu_count() or 1,
) -> dict[str, Any]:
    """Train each contestant with each seed, except those whose result `numbers` has.

    Args:
        numbers: JSON file of settings and results: by the seed, the contestant and the test, `medians`.
        rendered: file of the crops, which is written if it is missing.
        own: images of the new cameras, to learn from.
        one: images of the one camera.
        count: of other drivers, in each test.
        steps: of each network.
        seeds: how many.
        workers: processes; 0 trains in this one.
    """
    settings = {"own": own, "one": one, "count": count, "steps": steps}
    kept: dict[str, Any] = {"settings": settings, "results": {}}
    if numbers.exists():
        kept = json.loads(numbers.read_text())
        if kept["settings"] != settings:
            raise ValueError(f"{numbers} must be of the same settings, {settings}; got {kept['settings']}")
    jobs = [(seed, name) for seed in range(seeds) for name in CONTESTANTS]
    jobs = [(seed, name) for seed, name in jobs if name not in kept["results"].get(str(seed), {})]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context) if workers else ThreadPoolExecutor(1) as pool:
        if jobs and not rendered.exists():
            torch.save(tuple(make_data(own, one, count, pool)), rendered)
        done = [pool.submit(one_job, str(rendered), name, steps, seed) for seed, name in jobs]
        for job in as_completed(done):
            seed, name, found, seconds = job.result()
            kept["results"].setdefault(seed, {})[name] = found
            numbers.write_text(json.dumps(kept) + "\n")
            print(f"seed {seed}, {name:<18} {found['mounts']}, {seconds:.0f} s", flush=True)
    return kept


# -- table and figure


def values(kept: dict[str, Any], name: str, test: str, which: int) -> list[float]:
    """Return the medians of the seeds that are done, of landmarks in % (0) or of gaze in degrees (1)."""
    return [seed[name][test][which] * (1 if which else 100) for seed in kept["results"].values() if name in seed]


def table(kept: dict[str, Any]) -> str:
    """Return the table of all contestants, in Markdown: means of the seeds and their standard deviations."""
    columns = [(0, "mounts", " %"), *((1, test, "°") for test in TESTS)]
    titles = ["learned from", f"landmarks, {TESTS['mounts']}", *(f"gaze, {title}" for title in TESTS.values())]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for name, contestant in CONTESTANTS.items():
        done = len(values(kept, name, "mounts", 0))
        longer = f"; {1000 * contestant.longer:,} steps, seeds: {done}" if contestant.longer > 1 else ""
        cells = [contestant.title + longer]
        for which, test, unit in columns if done else []:
            seeds = values(kept, name, test, which)
            spread = f" ± {statistics.pstdev(seeds):.1f}" if done > 1 else ""
            cells.append(f"{statistics.mean(seeds):.1f}{unit}{spread}")
        if done:
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(kept: dict[str, Any], output: str | Path) -> None:
    """Draw errors over the number of the new cameras' own images: means of the seeds, and bands of all seeds."""
    curves = {
        "the new cameras' own": ["own 80", "own 400", "own 2000", "own 10000"],
        "... and 400 of one camera with camtorch": ["both 80", "both 400", "both 2000"],
        "400 of one camera with camtorch": ["camtorch"],
        "2,000 of one camera with camtorch": ["camtorch 2000"],
        "400 of one camera": ["plain"],
    }
    panels = {
        "gaze, °; 1,000 steps": (1, ""),
        "gaze, °; 4,000 steps": (1, ", longer"),
        "landmarks, %; 1,000 steps": (0, ""),
        "landmarks, %; 4,000 steps": (0, ", longer"),
    }
    figure, axes = plt.subplots(2, 2, figsize=(6.6, 7.6), layout="constrained")  # a phone shows it readable
    for axis, (title, (which, suffix)) in zip(axes.flat, panels.items(), strict=True):
        for colour, (label, names) in zip(COLOURS, curves.items(), strict=False):
            seeds = {name: values(kept, name + suffix, "mounts", which) for name in names}
            errors = [error for error in seeds.values() if error]
            counts = [CONTESTANTS[name].own for name, error in seeds.items() if error]
            if counts == [0]:  # none of the new cameras' images: a line across
                counts, errors = [80, 10000], errors * 2
            style = "--" if len(names) == 1 else "o-"
            axis.plot(counts, [*map(statistics.mean, errors)], style, color=colour, label=label, markersize=4)
            axis.fill_between(counts, [*map(min, errors)], [*map(max, errors)], color=colour, alpha=0.15, linewidth=0)
        axis.set_title(title, fontsize="large")
        axis.tick_params(labelsize="large")
        axis.set_xscale("log")
        axis.set_xticks([80, 400, 2000, 10000], ["80", "400", "2,000", "10,000"])
        axis.minorticks_off()
        axis.set_ylim(0, 13 if which else 19)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[1]:
        axis.set_xlabel("the new cameras' own images", fontsize="large")
    entries = axes[0, 0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside lower center", fontsize="large", frameon=False)
    figure.savefig(output, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="faces.png")
    parser.add_argument("-n", "--numbers", type=Path, default=NUMBERS, help="file of results, read and written")
    parser.add_argument("-r", "--rendered", type=Path, default="train_faces.pt", help="file of crops, 3 GB")
    parser.add_argument("-s", "--seeds", type=int, default=5)
    arguments = parser.parse_args()
    numbers = run(arguments.numbers, arguments.rendered, seeds=arguments.seeds)
    print(table(numbers))
    draw(numbers, arguments.output)
