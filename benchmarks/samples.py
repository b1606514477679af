"""One sample at a time, as a worker of a DataLoader has it: a uint8 image of three channels and 68 landmarks.

A "driver" also has a mask, a box, a gaze and a head pose; albumentations and torchvision move all but the last two.
Theirs are affine maps of about the same extent. Beside RandomLens stands albumentations' OpticalDistortion, which moves
no landmarks here: that would make it many times slower. "Image alone" is a bare affine warp. RandomCamera also moves a
mask, beside that affine map, and OpenCV: new maps, the image, the mask and the landmarks. One thread.

Then the workers themselves: samples per second of a DataLoader, of arrays that are in memory already, in batches of 8.
"nothing done" hands samples on as they are: what the DataLoader itself takes.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, default_collate

import camtorch.augment.numpy
from benchmarks import augment, cameras
from benchmarks.harness import OPENCV, OURS, A, Options, Row, Run, Table, kornia_rs, measure, threads, tv, v2
from camtorch.augment import RandomCamera, RandomLens, RandomMount, collate

ALBUMENTATIONS, TORCHVISION, NOTHING = "albumentations", "torchvision", "nothing done"
BARE_OPENCV, BARE_KORNIA = "OpenCV, image alone", "kornia-rs, image alone"
SIZES = (256, 256), (480, 640)
TABLES = (
    Table("samples", "one image, us", (OURS, ALBUMENTATIONS, TORCHVISION, OPENCV, BARE_OPENCV, BARE_KORNIA), 1e6),
    Table("loader", "samples a second", (OURS, OPENCV, ALBUMENTATIONS, NOTHING), alone=(NOTHING,), rate=True),
)
_ANGLES = {"yaw": 10, "pitch": 10, "roll": 10}
_SHORTEST = 0.02  # seconds that one round of a contestant takes
_BATCHES, _QUICK_BATCHES = 24, 2  # of an epoch
_PLAIN, _MASKED = ("image", "keypoints"), ("image", "mask", "keypoints")
_KNOWN = (*_MASKED, "bboxes")  # to albumentations and to torchvision
MOUNT, DRIVER, LENS, FISHEYE = "RandomMount", "RandomMount of a driver", "RandomLens", "RandomLens to a fisheye"
CAMERAS = {f"RandomCamera, {case.name}": case for case in augment.CASES[:2]}

Sample = dict[str, np.ndarray]
Move = Callable[[Sample], Sample]


def rows(options: Options) -> Iterator[Row]:
    """Measure each change on both sizes, then the loaders."""
    if options.device.type == "cpu":
        for size, case in product(SIZES[:1] if options.quick else SIZES, (MOUNT, DRIVER, LENS, FISHEYE, *CAMERAS)):
            sample, name = _sample(case, size), "{}, {}x{}x3".format(case, *size)
            runs = {who: partial(move, sample) for who, move in _moves(case, size).items()}
            runs |= _others(sample) if case in (MOUNT, DRIVER) else {}
            with threads(1):
                yield measure("samples", name, runs, options, shortest=_SHORTEST)
        yield from _loaders(options)


def _sample(case: str, size: tuple[int, int], index: int = 0) -> Sample:
    """Return a sample with the fields of a case: a driver's has every label."""
    random = np.random.default_rng(index)
    height, width = size
    driver = {
        "image": random.integers(256, size=(*size, 3), dtype=np.uint8),
        "mask": random.integers(2, size=size, dtype=np.uint8),
        "keypoints": (random.random((augment.LANDMARKS, 2)) * size[::-1]).astype(np.float32),
        "bboxes": np.array([[0.2 * width, 0.2 * height, 0.8 * width, 0.8 * height]], np.float32),
        "gaze": np.array([0.1, 0.2, -1.0], np.float32),
        "head_pose": np.array([[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.6], [0, 0, 0, 1]], np.float32),
    }
    return driver if case == DRIVER else {name: driver[name] for name in (_MASKED if case in CAMERAS else _PLAIN)}


def _moves(case: str, size: tuple[int, int]) -> dict[str, Move]:
    """Name -> how a sample is moved."""
    of_opencv = CAMERAS.get(case)
    key = of_opencv.source if of_opencv else "brown_conrady"
    camera = cameras.camera(key, torch.device("cpu"), size=size).requires_grad_(False)
    if of_opencv:
        change = RandomCamera(of_opencv.like, camera=camera, fov=of_opencv.fov, **augment.ANGLES)
    elif case in (MOUNT, DRIVER):
        change = RandomMount(camera=camera, min_filled=0, **_ANGLES)
    else:
        to_fisheye = {"like": "kannala_brandt", "fov": (60, 70), "min_filled": 0}
        change = RandomLens(camera=camera, **(to_fisheye if case == FISHEYE else {}))
    found: dict[str, Move] = {OURS: partial(_fields, camtorch.augment.numpy.Transform(change), None)}
    if of_opencv:
        found[OPENCV] = partial(_opencv, augment.opencv_camera(of_opencv, camera))
    if A is not None:
        affine = A.Affine(rotate=(-10, 10), translate_percent=(-0.02, 0.02), scale=(0.95, 1.05), p=1)
        boxes = A.BboxParams("pascal_voc") if case == DRIVER else None
        affine = A.Compose([affine], bbox_params=boxes, keypoint_params=A.KeypointParams("xy", remove_invisible=False))
        distortion = A.Compose([A.OpticalDistortion(distort_limit=0.3, p=1)])
        theirs = (distortion, ("image",)) if case in (LENS, FISHEYE) else (affine, _KNOWN)
        found[ALBUMENTATIONS] = partial(_fields, *theirs)
    return found


def _fields(transform: Callable[..., Sample], known: tuple[str, ...] | None, sample: Sample) -> Sample:
    """Return the fields that came in; those that a transform does not know stay."""
    moved = transform(**{name: value for name, value in sample.items() if known is None or name in known})
    return {name: moved.get(name, value) for name, value in sample.items()}


def _opencv(move: Callable, sample: Sample) -> Sample:
    return dict(zip(sample, move(*sample.values()), strict=True))


def _others(sample: Sample) -> dict[str, Run]:
    """The same by torchvision, whose tensors are there before the clock starts; an affine warp of the image alone."""
    image, (height, width) = sample["image"], sample["image"].shape[:2]
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), 7, 1.02)
    found: dict[str, Run] = {}
    if "bboxes" not in sample:
        found[BARE_OPENCV] = lambda: cv2.warpAffine(image, matrix, (width, height))
        numbers = tuple(matrix.ravel().tolist())
        if kornia_rs is not None:
            found[BARE_KORNIA] = lambda: kornia_rs.imgproc.warp_affine(image, numbers, (height, width), "bilinear")
    if v2 is not None:
        kinds = {
            "image": lambda image: tv.Image(image.permute(2, 0, 1).contiguous()),
            "mask": tv.Mask,
            "keypoints": partial(tv.KeyPoints, canvas_size=(height, width)),
            "bboxes": partial(tv.BoundingBoxes, format="XYXY", canvas_size=(height, width)),
        }
        given = {name: kinds[name](torch.from_numpy(sample[name])) for name in _KNOWN if name in sample}
        bilinear = v2.InterpolationMode.BILINEAR
        affine = v2.RandomAffine(10, translate=(0.02, 0.02), scale=(0.95, 1.05), interpolation=bilinear)
        found[TORCHVISION] = lambda: affine(given)
    return found


def _loaders(options: Options) -> Iterator[Row]:
    """Epochs with two workers: drivers, then lenses; all collated as torch does, then all by `ct.augment.collate`."""
    count = augment.BATCH * (_QUICK_BATCHES if options.quick or options.no_library else _BATCHES)
    for case, by in product((DRIVER, *CAMERAS), (default_collate, collate)):
        size = augment.QUICK_SIZE if options.quick else augment.SIZE if case in CAMERAS else SIZES[0]
        samples = [_sample(case, size, index) for index in range(augment.BATCH)] * (count // augment.BATCH)
        runs = {who: _epochs(samples, move, by) for who, move in {**_moves(case, size), NOTHING: dict}.items()}
        # OpenCV as torch does by itself: one in a worker. Its threads do not come along with a fork, so before that
        with threads(1):
            name = "{}, {}x{}x3{}".format(case, *size, ", ct.augment.collate" * (by is collate))
            found = measure("loader", name, runs, options)
        yield found._replace(figures={who: figure.times(1 / count) for who, figure in found.figures.items()})


def _epochs(samples: list[Sample], move: Move, by: Callable[[list[Sample]], object]) -> Run:
    """An epoch of a loader whose workers stay, move each sample anew, and collate."""
    how = {"batch_size": augment.BATCH, "num_workers": 2, "persistent_workers": True, "multiprocessing_context": "fork"}
    loader = DataLoader(samples, collate_fn=lambda batch: by([move(sample) for sample in batch]), **how)

    def run() -> None:
        for _ in loader:
            pass

    return run
