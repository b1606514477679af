"""Augmentation: a random camera for every image of a batch, with its mask and its landmarks.

Every call draws anew and moves the image, a mask and 68 keypoints of each sample. OpenCV goes sample by sample, from
a lens that it knows to a turned pinhole camera, and cannot do the other cases. kornia's RandomAffine moves the same
data by an affine map, which needs no camera; it takes floats only, so that uint8 is converted there and back.

A chain, a resized crop, a flip and another lens, is timed beside the crop and the flip alone as torchvision's v2 makes
them, sample by sample and with one draw for the whole batch.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import kornia.augmentation as K  # noqa: N812 (kornia's own name for it)
import numpy as np
import torch
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.harness import NAMES, OPENCV, OURS, Options, Row, Run, Table, measure, tv, v2
from camtorch.augment import Compose, HorizontalFlip, RandomCamera, RandomLens, RandomResizedCrop

AFFINE = "kornia RandomAffine"
BY_SAMPLE, ONE_DRAW = "torchvision, by sample", "torchvision, one draw"
BATCH, SIZE, QUICK_SIZE, LANDMARKS = 8, (480, 640), (120, 160), 68
ANGLES = {"yaw": 10, "pitch": 10, "roll": 10, "min_filled": 0}
TABLES = (Table("augment", f"{BATCH} images, ms", (OURS, AFFINE, OPENCV, BY_SAMPLE, ONE_DRAW)),)
_DEGREES = np.radians(10)
_SHORTEST = 0.1  # seconds of a chain's round: of single calls the fastest is the luckiest draw


class Case(NamedTuple):
    """From which camera to which lens."""

    source: str
    like: str | None
    fov: tuple[float, float] | None = None

    @property
    def name(self) -> str:
        """As a row of a table is called."""
        return f"{NAMES.get(self.source, self.source)} to {self.like or 'its like'}"


CASES = (
    Case("brown_conrady", "pinhole", (65, 80)),
    Case("kannala_brandt", "pinhole", (65, 80)),
    Case("kannala_brandt", None),
    Case("pinhole", "dms130"),
    Case("pinhole", "aria"),
)


def rows(options: Options) -> Iterator[Row]:
    """Measure the cases, and the chain."""
    size = QUICK_SIZE if options.quick else SIZE
    for case in CASES[:2] if options.quick else CASES:
        for dtype in (torch.float32, torch.uint8):
            runs = _contestants(case, size, dtype, options.device)
            yield measure("augment", f"{case.name}, {str(dtype).removeprefix('torch.')}", runs, options)
    yield measure("augment", "crop, flip, lens, uint8", _chains(size, options), options, shortest=_SHORTEST)


def _contestants(case: Case, size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> dict[str, Run]:
    """The batch moved by a new draw."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(BATCH, 1, *size, generator=generator).to(device)
    mask = (image > 0.5).to(image)
    keypoints = (torch.rand(BATCH, LANDMARKS, 2, generator=generator) * torch.tensor(size[::-1])).to(device)
    is_float = dtype.is_floating_point
    if not is_float:
        image, mask = (image * 255).byte(), mask.byte()
    camera = cameras.camera(case.source, device, size=size).requires_grad_(False)
    ours = RandomCamera(case.like, camera=camera, fov=case.fov, **ANGLES)
    affine = K.RandomAffine(10.0, translate=(0.02, 0.02), scale=(0.95, 1.05), p=1.0)
    affine = K.AugmentationSequential(affine, data_keys=["input", "mask", "keypoints"])

    def by_affine() -> tuple[Tensor, ...]:
        moved = affine(image.float(), mask.float(), keypoints)
        return tuple(moved) if is_float else (moved[0].round_().byte(), moved[1].byte(), moved[2])

    runs: dict[str, Run] = {OURS: lambda: ours(image=image, mask=mask, keypoints=keypoints), AFFINE: by_affine}
    if case.like == "pinhole":
        move, arrays = opencv_camera(case, camera), [t.cpu().numpy() for t in (image[:, 0], mask[:, 0], keypoints)]
        runs[OPENCV] = lambda: [move(*sample) for sample in zip(*arrays, strict=True)]
    return runs


def opencv_camera(case: Case, camera: ct.Camera) -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return what moves an image, its mask and its landmarks to a turned pinhole camera, by a new map each time."""
    lens = camera.K.cpu().double().numpy(), camera.distortion.cpu().double().numpy()
    module, random = cv2.fisheye if case.source == "kannala_brandt" else cv2, np.random.default_rng(0)

    def move(image: np.ndarray, mask: np.ndarray, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        height, width = image.shape[:2]
        rotation, _ = cv2.Rodrigues(random.uniform(-_DEGREES, _DEGREES, 3))
        focal = width / 2 / np.tan(np.radians(random.uniform(*case.fov)) / 2)
        target = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        maps = module.initUndistortRectifyMap(*lens, rotation, target, (width, height), cv2.CV_32FC1)
        points = module.undistortPoints(keypoints[:, None], *lens, R=rotation, P=target)
        return cv2.remap(image, *maps, cv2.INTER_LINEAR), cv2.remap(mask, *maps, cv2.INTER_NEAREST), points[:, 0]

    return move


def _chains(size: tuple[int, int], options: Options) -> dict[str, Run]:
    """A batch of colour images and their landmarks through a chain, each by its own draw."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (BATCH, 3, *size), dtype=torch.uint8, generator=generator).to(options.device)
    landmarks = (torch.rand(BATCH, LANDMARKS, 2, generator=generator) * torch.tensor(size[::-1])).to(options.device)
    camera = cameras.camera("kannala_brandt", options.device, size=size).requires_grad_(False)
    lens = RandomLens("pinhole", fov=(65, 80), min_filled=0)
    chain = Compose([RandomResizedCrop(size), HorizontalFlip(landmarks={}), lens], camera=camera)

    runs: dict[str, Run] = {OURS: lambda: chain(image=images, keypoints=landmarks)}
    if v2 is not None:
        theirs = v2.Compose([v2.RandomResizedCrop(size), v2.RandomHorizontalFlip()])
        batch = tv.Image(images), tv.KeyPoints(landmarks, canvas_size=size)
        samples = [tuple(tv.wrap(part[i], like=part) for part in batch) for i in range(BATCH)]
        runs |= {BY_SAMPLE: lambda: [theirs(*sample) for sample in samples], ONE_DRAW: lambda: theirs(*batch)}
    return runs
