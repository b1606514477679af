"""A DataLoader: samples per second of its workers, of arrays that are in memory already.

Each sample is an image of (480, 640, 3) uint8, a mask and 68 landmarks; batches of 8 come out. "nothing done" hands
samples on as they are: what the DataLoader itself takes. The loaders take turns, an epoch each: all collate as torch
does, then all of them by `ct.augment.collate`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import product

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

import camtorch.augment.numpy
from benchmarks import augment, cameras
from benchmarks.options import Options
from benchmarks.point_peers import OPENCV, OURS
from benchmarks.tables import Record, only, table
from benchmarks.timing import Run, measure, threads
from benchmarks.verdict import Requirement, figures, verdict
from camtorch.augment import RandomCamera, collate

NOTHING, ALBUMENTATIONS = "nothing done", "albumentations Affine"
WORKERS = (1, 2)
_CHANNELS = 3
_BATCHES, _QUICK_BATCHES = 12, 2  # of an epoch
_OPERATION = "{} worker{}{}"
_COLLATES = {"": None, ", ct.augment.collate": collate}

Sample = dict[str, np.ndarray]
Move = Callable[[Sample], Sample]


class Samples(Dataset):
    """The same few samples again and again, each augmented anew."""

    def __init__(self, move: Move, size: tuple[int, int], count: int):
        random = np.random.default_rng(0)
        self.move, self.count = move, count
        self.images = random.integers(256, size=(augment.BATCH, *size, _CHANNELS), dtype=np.uint8)
        self.masks = random.integers(2, size=(augment.BATCH, *size), dtype=np.uint8)
        self.keypoints = (random.random((augment.BATCH, augment.LANDMARKS, 2)) * size[::-1]).astype(np.float32)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Sample:
        """One of the samples, augmented."""
        i = index % len(self.images)
        return self.move({"image": self.images[i], "mask": self.masks[i], "keypoints": self.keypoints[i]})


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    records = measured(options)
    height, width = augment.QUICK_SIZE if options.quick else augment.SIZE
    title = f"DataLoader: samples per second, {height}x{width}x{_CHANNELS} uint8, mask, {augment.LANDMARKS} landmarks"
    return records, [table(title, only(records, "per second"), beside=OURS), verdict(requirements(records))]


def measured(options: Options) -> list[Record]:
    """Samples per second of everyone, with one worker and with two."""
    if options.device.type != "cpu":
        return []
    size = augment.QUICK_SIZE if options.quick else augment.SIZE
    count = augment.BATCH * (_QUICK_BATCHES if options.quick else _BATCHES)
    records = []
    for case in augment.CASES[:2]:
        for (how, by), workers in product(_COLLATES.items(), WORKERS):
            operation = _OPERATION.format(workers, "s" * (workers > 1), how)
            runs = {who: epochs(Samples(move, size, count), workers, by) for who, move in moves(case, size).items()}
            # OpenCV as torch does by itself: one in a worker. Its threads do not come along with a fork, so before that
            with threads(1):
                taken = measure(f"DataLoader, {case.name}", operation, runs, options)
            records += taken
            records += [
                Record(r.case, r.contestant, r.operation, "per second", count / r.value)
                for r in taken
                if r.quantity == "seconds"
            ]
    return records


def requirements(records: Sequence[Record]) -> list[Requirement]:
    """A worker gives more samples than one that has another library do it."""
    rows, found = figures(records, "per second"), []
    for who, bound in ((OPENCV, 2.0), (ALBUMENTATIONS, 1.3)):
        ratios = {
            f"{case}, {operation}": speeds[OURS] / speeds[who]
            for (case, operation), speeds in rows.items()
            if {OURS, who} <= speeds.keys()
        }
        found.append(Requirement(f"DataLoader: {bound:g} times as many samples as with {who}", bound, ratios))
    return found


def epochs(samples: Samples, workers: int, collate_fn: Callable | None) -> Run:
    """An epoch of a loader whose workers stay."""
    loader = DataLoader(
        samples,
        batch_size=augment.BATCH,
        num_workers=workers,
        persistent_workers=True,
        collate_fn=collate_fn,
    )

    def run() -> None:
        for _ in loader:
            pass

    return run


def moves(case: augment.Case, size: tuple[int, int]) -> dict[str, Move]:
    """Name -> how a sample is augmented."""
    camera = cameras.camera(case.source, torch.device("cpu"), size=size).requires_grad_(False)
    ours = camtorch.augment.numpy.Transform(RandomCamera(case.like, camera=camera, fov=case.fov, **augment.ANGLES))
    found: dict[str, Move] = {
        OURS: partial(_fields, ours),
        OPENCV: partial(_opencv, augment.OpenCVCamera(case, camera)),
        augment.AFFINE: partial(_affine, augment.affine_of(["input", "mask", "keypoints"])),
    }
    if find_spec("albumentations"):
        found[ALBUMENTATIONS] = partial(_fields, _albumentations())
    return {**found, NOTHING: dict}


def _fields(transform: Callable[..., Sample], sample: Sample) -> Sample:
    """By a transform of keyword arguments."""
    moved = transform(**sample)
    return {name: moved[name] for name in sample}


def _opencv(move: augment.OpenCVCamera, sample: Sample) -> Sample:
    return dict(zip(sample, move(*sample.values()), strict=True))


def _affine(affine: Callable, sample: Sample) -> Sample:
    image, mask, keypoints = (torch.from_numpy(value) for value in sample.values())
    moved = affine(image.permute(2, 0, 1)[None].float(), mask[None, None].float(), keypoints[None])
    image = moved[0][0].round_().byte().permute(1, 2, 0)
    return {
        "image": image.contiguous().numpy(),
        "mask": moved[1][0, 0].byte().numpy(),
        "keypoints": moved[2][0].numpy(),
    }


def _albumentations() -> Callable[..., Sample]:
    import albumentations as A  # noqa: N812 (its own name for it)

    affine = A.Affine(rotate=(-10, 10), translate_percent=(-0.02, 0.02), scale=(0.95, 1.05), p=1.0)
    return A.Compose([affine], keypoint_params=A.KeypointParams("xy", remove_invisible=False))
