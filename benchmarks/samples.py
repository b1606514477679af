"""One sample at a time, as a worker of a DataLoader has it: a uint8 image of three channels and 68 landmarks.

Affine and OpticalDistortion are albumentations', of about the same extent; the latter moves no landmarks here, which
would make it many times slower. "RandomCamera" moves a mask as well, and stands beside the same by OpenCV: new maps,
the image, the mask and the landmarks. One thread.

Then the workers themselves: samples per second of a DataLoader, of arrays that are in memory already, in batches of 8.
"nothing done" hands samples on as they are: what the DataLoader itself takes.
"""

from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from itertools import product

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

import camtorch.augment.numpy
from benchmarks import augment, cameras
from benchmarks.harness import NAMES, OPENCV, OURS, Options, Row, Run, Table, measure, threads
from camtorch.augment import RandomCamera, RandomLens, RandomMount, collate

ALBUMENTATIONS = "albumentations"
SIZES = (256, 256), (480, 640)
NOTHING, KORNIA_AFFINE, ALBUMENTATIONS_AFFINE = "nothing done", "kornia RandomAffine", "albumentations Affine"
_LOADERS = {who: (who,) for who in (OURS, OPENCV, KORNIA_AFFINE, ALBUMENTATIONS_AFFINE, NOTHING)}
TABLES = (
    Table("samples", "one image, ms", {w: (w,) for w in (OURS, ALBUMENTATIONS, OPENCV)}),
    Table("loader", "samples a second", _LOADERS, 1, None, rate=True),
)
_ANGLES = {"yaw": 10, "pitch": 10, "roll": 10}
_SHORTEST = 0.02  # seconds that one round of a contestant takes
_BATCHES, _QUICK_BATCHES = 12, 2  # of an epoch
_COLLATES = {"": None, ", ct.augment.collate": collate}

Sample = dict[str, np.ndarray]
Move = Callable[[Sample], Sample]


def rows(options: Options) -> Iterator[Row]:
    """Measure each change on both sizes, then the loaders."""
    if options.device.type == "cpu":
        with threads(1):
            for size in SIZES[:1] if options.quick else SIZES:
                for case, runs in _contestants(size).items():
                    yield measure("samples", "{}, {}x{}x3".format(case, *size), runs, options, shortest=_SHORTEST)
        yield from _loaders(options)


def _contestants(size: tuple[int, int]) -> dict[str, dict[str, Run]]:
    """Case -> name -> what is timed."""
    random = np.random.default_rng(0)
    image = random.integers(256, size=(*size, 3), dtype=np.uint8)
    mask = random.integers(2, size=size, dtype=np.uint8)
    keypoints = (random.random((augment.LANDMARKS, 2)) * size[::-1]).astype(np.float32)
    keys, cpu = ("brown_conrady", "kannala_brandt"), torch.device("cpu")
    brown, fisheye = (cameras.camera(key, cpu, size=size).requires_grad_(False) for key in keys)

    def ours(change: Callable, **fields: np.ndarray) -> Run:
        transform = camtorch.augment.numpy.Transform(change)
        return lambda: transform(image=image, keypoints=keypoints, **fields)

    found: dict[str, dict[str, Run]] = {
        "RandomMount": {OURS: ours(RandomMount(camera=brown, min_filled=0, **_ANGLES))},
        "RandomLens": {OURS: ours(RandomLens(camera=brown))},
        "RandomLens to a fisheye": {OURS: ours(RandomLens("kannala_brandt", camera=brown, fov=(60, 70), min_filled=0))},
    }
    if find_spec("albumentations"):
        import albumentations as A  # noqa: N812 (its own name; optional)

        distortion = A.Compose([A.OpticalDistortion(distort_limit=0.3, p=1)])
        found["RandomMount"][ALBUMENTATIONS] = partial(albumentations_affine(), image=image, keypoints=keypoints)
        for case in ("RandomLens", "RandomLens to a fisheye"):
            found[case][ALBUMENTATIONS] = partial(distortion, image=image)
    for case, camera in zip(augment.CASES[:2], (brown, fisheye), strict=True):
        change = RandomCamera(case.like, camera=camera, fov=case.fov, **augment.ANGLES)
        runs = {
            OURS: ours(change, mask=mask),
            OPENCV: partial(augment.opencv_camera(case, camera), image, mask, keypoints),
        }
        found[f"RandomCamera, {NAMES[case.source]} to {case.like}"] = runs
    return found


def albumentations_affine() -> Callable[..., dict]:
    """Return its affine map of about the same extent."""
    import albumentations as A  # noqa: N812 (its own name; optional)

    affine = A.Affine(rotate=(-10, 10), translate_percent=(-0.02, 0.02), scale=(0.95, 1.05), p=1)
    return A.Compose([affine], keypoint_params=A.KeypointParams("xy", remove_invisible=False))


class Samples(Dataset):
    """The same few samples again and again, each augmented anew."""

    def __init__(self, move: Move, size: tuple[int, int], count: int):
        random = np.random.default_rng(0)
        self.move, self.count = move, count
        self.images = random.integers(256, size=(augment.BATCH, *size, 3), dtype=np.uint8)
        self.masks = random.integers(2, size=(augment.BATCH, *size), dtype=np.uint8)
        self.keypoints = (random.random((augment.BATCH, augment.LANDMARKS, 2)) * size[::-1]).astype(np.float32)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Sample:
        """Return one of the samples, augmented."""
        i = index % len(self.images)
        return self.move({"image": self.images[i], "mask": self.masks[i], "keypoints": self.keypoints[i]})


def _loaders(options: Options) -> Iterator[Row]:
    """Epochs with one worker and with two, all collated as torch does, then all by `ct.augment.collate`."""
    size = augment.QUICK_SIZE if options.quick else augment.SIZE
    count = augment.BATCH * (_QUICK_BATCHES if options.quick else _BATCHES)
    for case, (how, by), workers in product(augment.CASES[:2], _COLLATES.items(), (1, 2)):
        runs = {who: _epochs(Samples(move, size, count), workers, by) for who, move in _moves(case, size).items()}
        # OpenCV as torch does by itself: one in a worker. Its threads do not come along with a fork, so before that
        with threads(1):
            found = measure("loader", f"{case.name}, {workers} worker{'s' * (workers > 1)}{how}", runs, options)
        rates = {w: f._replace(median=count / f.median) for w, f in found.figures.items()}
        yield found._replace(figures=rates)


def _epochs(samples: Samples, workers: int, collate_fn: Callable | None) -> Run:
    """An epoch of a loader whose workers stay."""
    how = {"batch_size": augment.BATCH, "num_workers": workers, "persistent_workers": True, "collate_fn": collate_fn}
    loader = DataLoader(samples, **how)

    def run() -> None:
        for _ in loader:
            pass

    return run


def _moves(case: augment.Case, size: tuple[int, int]) -> dict[str, Move]:
    """Name -> how a sample is augmented."""
    camera = cameras.camera(case.source, torch.device("cpu"), size=size).requires_grad_(False)
    ours = camtorch.augment.numpy.Transform(RandomCamera(case.like, camera=camera, fov=case.fov, **augment.ANGLES))
    found: dict[str, Move] = {
        OURS: partial(_fields, ours),
        OPENCV: partial(_opencv, augment.opencv_camera(case, camera)),
        KORNIA_AFFINE: partial(_affine, augment.affine_of(["input", "mask", "keypoints"])),
    }
    if find_spec("albumentations"):
        found[ALBUMENTATIONS_AFFINE] = partial(_fields, albumentations_affine())
    return {**found, NOTHING: dict}


def _fields(transform: Callable[..., Sample], sample: Sample) -> Sample:
    moved = transform(**sample)
    return {name: moved[name] for name in sample}


def _opencv(move: Callable, sample: Sample) -> Sample:
    return dict(zip(sample, move(*sample.values()), strict=True))


def _affine(affine: Callable, sample: Sample) -> Sample:
    image, mask, keypoints = (torch.from_numpy(value) for value in sample.values())
    image, mask, keypoints = affine(image.permute(2, 0, 1)[None].float(), mask[None, None].float(), keypoints[None])
    image = image[0].round_().byte().permute(1, 2, 0).contiguous()
    return {"image": image.numpy(), "mask": mask[0, 0].byte().numpy(), "keypoints": keypoints[0].numpy()}
