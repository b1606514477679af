"""One sample at a time, as a worker of a DataLoader has it: a uint8 image of three channels and 68 landmarks.

A "driver" also has a mask, a box, a gaze and a head pose; albumentations and torchvision move all but the last two.
Theirs are affine maps of about the same extent. Beside RandomLens stands albumentations' OpticalDistortion, which moves
no landmarks here: that would make it many times slower. "Image alone" is a bare affine warp. RandomCamera also moves a
mask, beside the same by OpenCV: new maps, the image, the mask and the landmarks. One thread.

Then the workers themselves: samples per second of a DataLoader, of arrays that are in memory already, in batches of 8.
"nothing done" hands samples on as they are: what the DataLoader itself takes.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

import camtorch.augment.numpy
from benchmarks import augment, cameras
from benchmarks.augment import torchvision
from benchmarks.harness import NAMES, OPENCV, OURS, Options, Row, Run, Table, measure, threads
from camtorch.augment import RandomCamera, RandomLens, RandomMount, collate

try:
    import albumentations as A  # noqa: N812 (its own name)
except ModuleNotFoundError:
    A = None
try:
    import kornia_rs
except ModuleNotFoundError:
    kornia_rs = None

ALBUMENTATIONS, TORCHVISION, NOTHING = "albumentations", "torchvision", "nothing done"
BARE_OPENCV, BARE_KORNIA = "OpenCV, image alone", "kornia-rs, image alone"
SIZES = (256, 256), (480, 640)
_EVERYONE = (OURS, ALBUMENTATIONS, TORCHVISION, OPENCV, BARE_OPENCV, BARE_KORNIA)
_LOADERS = {who: (who,) for who in (OURS, OPENCV, ALBUMENTATIONS, NOTHING)}
TABLES = (
    Table("samples", "one image, us", {who: (who,) for who in _EVERYONE}, 1e6),
    Table("loader", "samples a second", _LOADERS, alone=(NOTHING,), rate=True),
)
_ANGLES = {"yaw": 10, "pitch": 10, "roll": 10}
_SHORTEST = 0.02  # seconds that one round of a contestant takes
_BATCHES, _QUICK_BATCHES = 24, 2  # of an epoch
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


def _driver(size: tuple[int, int], index: int = 0) -> Sample:
    """Return a sample with every label."""
    random = np.random.default_rng(index)
    height, width = size
    return {
        "image": random.integers(256, size=(*size, 3), dtype=np.uint8),
        "mask": random.integers(2, size=size, dtype=np.uint8),
        "keypoints": (random.random((augment.LANDMARKS, 2)) * size[::-1]).astype(np.float32),
        "bboxes": np.array([[0.2 * width, 0.2 * height, 0.8 * width, 0.8 * height]], np.float32),
        "gaze": np.array([0.1, 0.2, -1.0], np.float32),
        "head_pose": np.array([[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.6], [0, 0, 0, 1]], np.float32),
    }


def _contestants(size: tuple[int, int]) -> dict[str, dict[str, Run]]:
    """Case -> name -> what is timed."""
    driver, cpu = _driver(size), torch.device("cpu")
    masked, plain = ({name: driver[name] for name in names} for names in (_MASKED, _PLAIN))
    keys = ("brown_conrady", "kannala_brandt")
    brown, fisheye = (cameras.camera(key, cpu, size=size).requires_grad_(False) for key in keys)

    def ours(change: Callable, sample: Sample) -> Run:
        transform = camtorch.augment.numpy.Transform(change)
        return lambda: transform(**sample)

    mount, lens = RandomMount(camera=brown, min_filled=0, **_ANGLES), RandomLens(camera=brown)
    to_fisheye = RandomLens("kannala_brandt", camera=brown, fov=(60, 70), min_filled=0)
    found: dict[str, dict[str, Run]] = {
        "RandomMount": {OURS: ours(mount, plain), **_bare(driver["image"])},
        "RandomMount of a driver": {OURS: ours(mount, driver)},
        "RandomLens": {OURS: ours(lens, plain)},
        "RandomLens to a fisheye": {OURS: ours(to_fisheye, plain)},
    }
    for case, sample in (("RandomMount", plain), ("RandomMount of a driver", driver)):
        if A is not None:
            found[case][ALBUMENTATIONS] = partial(albumentations_affine(sample), **_known(sample))
        if torchvision is not None:
            found[case][TORCHVISION] = _torchvision_affine(sample)
    if A is not None:
        distortion = A.Compose([A.OpticalDistortion(distort_limit=0.3, p=1)])
        for case in ("RandomLens", "RandomLens to a fisheye"):
            found[case][ALBUMENTATIONS] = partial(distortion, image=driver["image"])
    for case, camera in zip(augment.CASES[:2], (brown, fisheye), strict=True):
        change = RandomCamera(case.like, camera=camera, fov=case.fov, **augment.ANGLES)
        by_hand = partial(augment.opencv_camera(case, camera), *masked.values())
        found[f"RandomCamera, {NAMES[case.source]} to {case.like}"] = {OURS: ours(change, masked), OPENCV: by_hand}
    return found


_PLAIN, _MASKED = ("image", "keypoints"), ("image", "mask", "keypoints")
_KNOWN = (*_MASKED, "bboxes")  # to albumentations and to torchvision


def _known(sample: Sample) -> Sample:
    return {name: value for name, value in sample.items() if name in _KNOWN}


def albumentations_affine(sample: Sample) -> Callable[..., dict]:
    """Return its affine map of about the same extent."""
    affine = A.Affine(rotate=(-10, 10), translate_percent=(-0.02, 0.02), scale=(0.95, 1.05), p=1)
    boxes = A.BboxParams("pascal_voc") if "bboxes" in sample else None
    return A.Compose([affine], bbox_params=boxes, keypoint_params=A.KeypointParams("xy", remove_invisible=False))


def _torchvision_affine(sample: Sample) -> Run:
    """The same by torchvision, whose tensors are there before the clock starts."""
    v2, tv, size = torchvision.transforms.v2, torchvision.tv_tensors, sample["image"].shape[:2]
    kinds = {
        "image": lambda image: tv.Image(image.permute(2, 0, 1).contiguous()),
        "mask": tv.Mask,
        "keypoints": partial(tv.KeyPoints, canvas_size=size),
        "bboxes": partial(tv.BoundingBoxes, format="XYXY", canvas_size=size),
    }
    given = {name: kinds[name](torch.from_numpy(value)) for name, value in _known(sample).items()}
    bilinear = v2.InterpolationMode.BILINEAR
    affine = v2.RandomAffine(10, translate=(0.02, 0.02), scale=(0.95, 1.05), interpolation=bilinear)
    return lambda: affine(given)


def _bare(image: np.ndarray) -> dict[str, Run]:
    """An affine warp of the image alone."""
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), 7, 1.02)
    found: dict[str, Run] = {BARE_OPENCV: lambda: cv2.warpAffine(image, matrix, (width, height))}
    if kornia_rs is not None:
        numbers = tuple(matrix.ravel().tolist())
        found[BARE_KORNIA] = lambda: kornia_rs.imgproc.warp_affine(image, numbers, (height, width), "bilinear")
    return found


class Samples(Dataset):
    """The same few samples again and again, each augmented anew."""

    def __init__(self, move: Move, samples: list[Sample], count: int):
        self.move, self.samples, self.count = move, samples, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Sample:
        """Return one of the samples, augmented."""
        return self.move(self.samples[index % len(self.samples)])


def _loaders(options: Options) -> Iterator[Row]:
    """Epochs with two workers: drivers, then lenses; all collated as torch does, then all by `ct.augment.collate`."""
    count = augment.BATCH * (_QUICK_BATCHES if options.quick or options.no_library else _BATCHES)
    for case, (how, by) in product((None, *augment.CASES[:2]), _COLLATES.items()):
        size = augment.QUICK_SIZE if options.quick else augment.SIZE if case else SIZES[0]
        drivers = [_driver(size, index) for index in range(augment.BATCH)]
        samples = [{name: driver[name] for name in (_MASKED if case else driver)} for driver in drivers]
        moves = _moves(case, size, samples[0])
        runs = {who: _epochs(Samples(move, samples, count), by) for who, move in moves.items()}
        # OpenCV as torch does by itself: one in a worker. Its threads do not come along with a fork, so before that
        with threads(1):
            name = f"{f'RandomCamera, {case.name}' if case else 'RandomMount of a driver'}, {size[0]}x{size[1]}x3{how}"
            found = measure("loader", name, runs, options)
        yield found._replace(figures={who: figure.times(1 / count) for who, figure in found.figures.items()})


def _epochs(samples: Samples, collate_fn: Callable | None) -> Run:
    """An epoch of a loader whose workers stay."""
    how = {"batch_size": augment.BATCH, "num_workers": 2, "persistent_workers": True, "collate_fn": collate_fn}
    loader = DataLoader(samples, **how)

    def run() -> None:
        for _ in loader:
            pass

    return run


def _moves(case: augment.Case | None, size: tuple[int, int], sample: Sample) -> dict[str, Move]:
    """Name -> how a sample is augmented."""
    key = case.source if case else "brown_conrady"
    camera = cameras.camera(key, torch.device("cpu"), size=size).requires_grad_(False)
    if case:
        change = RandomCamera(case.like, camera=camera, fov=case.fov, **augment.ANGLES)
        found = {OPENCV: partial(_opencv, augment.opencv_camera(case, camera))}
    else:
        change, found = RandomMount(camera=camera, min_filled=0, **_ANGLES), {}
    found[OURS] = partial(_fields, camtorch.augment.numpy.Transform(change))
    if A is not None:
        found[ALBUMENTATIONS] = partial(_fields, albumentations_affine(sample))
    return {**found, NOTHING: dict}


def _fields(transform: Callable[..., Sample], sample: Sample) -> Sample:
    """Return the fields that came in; what a transform does not know stays."""
    is_ours = isinstance(transform, camtorch.augment.numpy.Transform)
    moved = transform(**(sample if is_ours else _known(sample)))
    return {name: moved.get(name, value) for name, value in sample.items()}


def _opencv(move: Callable, sample: Sample) -> Sample:
    return dict(zip(sample, move(*sample.values()), strict=True))
