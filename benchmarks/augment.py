"""Augmentation: a random camera for every image of a batch, with its mask and its landmarks.

Every call draws anew and moves the image, a mask and 68 keypoints of each sample. OpenCV goes sample by sample, from
a lens that it knows to a turned pinhole camera, and cannot do the other cases. kornia's RandomAffine moves the same
data by an affine map, which needs no camera; it takes floats only, so that uint8 is converted there and back.

A chain, a resized crop, a flip and another lens, is timed beside the crop and the flip alone as torchvision's v2 makes
them, sample by sample and with one draw for the whole batch, written here in the operators that it calls.

What is required is judged by the fastest rounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import kornia.augmentation as K  # noqa: N812 (kornia's own name for it)
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.options import Options
from benchmarks.point_peers import COMPILED, OPENCV, OURS
from benchmarks.tables import Record, only, table
from benchmarks.timing import Run, measure
from benchmarks.verdict import Requirement, figures, times_faster, verdict
from camtorch.augment import Compose, HorizontalFlip, RandomCamera, RandomLens, RandomResizedCrop
from camtorch.augment.kornia import RandomCamera as KorniaRandomCamera

ADAPTER, AFFINE = "camtorch in kornia", "kornia RandomAffine"
BATCH, SIZE, QUICK_SIZE, LANDMARKS = 8, (480, 640), (120, 160), 68
FLOAT, BYTE = OPERATIONS = ("float32", "uint8")
CHAIN, CHAIN_EDITS = "crop, flip, lens", "camtorch crop, flip"
VISION, VISION_BATCH = "torchvision crop, flip", "torchvision, one draw"
ANGLES = {"yaw": 10, "pitch": 10, "roll": 10, "min_filled": 0}
_DEGREES = np.radians(10)
_ROUNDS = 0.1  # seconds of a chain's round: of single calls the fastest is the luckiest draw, of one crop or of eight
_COMPILED = 1  # cases whose compiled contestants are timed: to compile takes longer than everything else


@dataclass(frozen=True)
class Case:
    """From which camera to which lens."""

    name: str
    source: str
    like: str | None
    fov: tuple[float, float] | None = None


CASES = (
    Case("brown_conrady to pinhole", "brown_conrady", "pinhole", (65, 80)),
    Case("kannala_brandt to pinhole", "kannala_brandt", "pinhole", (65, 80)),
    Case("kannala_brandt to its like", "kannala_brandt", None),
    Case("pinhole to dms130", "pinhole", "dms130"),
    Case("pinhole to aria", "pinhole", "aria"),
)
Data = tuple[Tensor, Tensor, Tensor]


def run(options: Options) -> tuple[list[Record], list[str]]:
    """Measure; the records and the tables."""
    size = QUICK_SIZE if options.quick else SIZE
    records = []
    for i, case in enumerate(CASES[:2] if options.quick else CASES):
        for operation in OPERATIONS:
            runs = contestants(case, size, data_of(operation, size, options), options, compiled=i < _COMPILED)
            records += measure(case.name, operation, runs, options)
    chain = measure(CHAIN, BYTE, chains(size, options), options, shortest=_ROUNDS)
    shape = f"{BATCH}x1x{size[0]}x{size[1]}"
    tables = [
        table(
            f"Augmentation of {shape}, mask, {LANDMARKS} keypoints: milliseconds (times camtorch)",
            only(records, "seconds"),
            scale=1e3,
            beside=OURS,
        ),
        table(
            f"Chain of {BATCH}x3x{size[0]}x{size[1]}, uint8, {LANDMARKS} keypoints: milliseconds (times camtorch)",
            only(chain, "seconds"),
            scale=1e3,
            beside=OURS,
        ),
        verdict(requirements([*records, *chain])),
    ]
    return [*records, *chain], tables


def requirements(records: Sequence[Record]) -> list[Requirement]:
    """What has to hold of the times."""
    rows = figures(records, "fastest")
    chain = {row: times for row, times in rows.items() if row[0] == CHAIN}
    rows = {row: times for row, times in rows.items() if row[0] != CHAIN}
    found = [
        Requirement(f"{CHAIN}: faster than torchvision's without the lens", 1.0, times_faster(chain, OURS, [VISION])),
        Requirement(f"{CHAIN}: 1.5 times {VISION_BATCH}", 1.5, times_faster(chain, OURS, [VISION_BATCH])),
    ]
    for case, bound in zip(CASES[:2], (1.5, 5.0), strict=True):
        ratios = times_faster({row: times for row, times in rows.items() if row[0] == case.name}, OURS, [OPENCV])
        found.append(Requirement(f"{case.name}: {bound:g} times OpenCV", bound, ratios))
    found.append(Requirement(f"every row: no slower than {AFFINE}", 1.0, times_faster(rows, OURS, [AFFINE])))
    wide, wider = (case.name for case in CASES[3:])
    ratios = {
        f"{wider}, {operation}": rows[wider, operation][OURS] / rows[wide, operation][OURS]
        for operation in OPERATIONS
        if {(wider, operation), (wide, operation)} <= rows.keys()
    }
    found.append(Requirement("to aria: at most 2 times dms130", 2.0, ratios, at_most=True))
    return found


def data_of(dtype: str, size: tuple[int, int], options: Options) -> Data:
    """Images (B, 1, H, W), masks of the same shape, and keypoints (B, N, 2)."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(BATCH, 1, *size, generator=generator).to(options.device)
    mask = (image > 0.5).to(image)
    keypoints = torch.rand(BATCH, LANDMARKS, 2, generator=generator) * torch.tensor(size[::-1])
    if dtype == BYTE:
        image, mask = (image * 255).byte(), mask.byte()
    return image, mask, keypoints.to(options.device)


def contestants(
    case: Case, size: tuple[int, int], data: Data, options: Options, *, compiled: bool = False
) -> dict[str, Run]:
    """Name -> what is timed: the batch moved by a new draw."""
    camera = cameras.camera(case.source, options.device, size=size).requires_grad_(False)
    ours = RandomCamera(case.like, camera=camera, fov=case.fov, **ANGLES)
    affine = affine_of(["input", "mask", "keypoints"])
    image, mask, keypoints = data
    is_float = image.is_floating_point()

    def apply(image: Tensor, mask: Tensor, keypoints: Tensor, draw: dict[str, Tensor]) -> tuple[Tensor, ...]:
        moved = ours(image=image, mask=mask, keypoints=keypoints, draw=draw)
        return moved["image"], moved["mask"], moved["keypoints"], moved["keypoints_valid"]

    def drawn(function: Callable) -> tuple[Tensor, ...]:
        return function(image, mask, keypoints, ours.draw(BATCH))

    def by_affine() -> tuple[Tensor, ...]:
        if is_float:
            return tuple(affine(*data))
        moved = affine(image.float(), mask.float(), keypoints)
        return moved[0].round_().byte(), moved[1].byte(), moved[2]

    runs: dict[str, Run] = {OURS: partial(drawn, apply), AFFINE: by_affine}
    if is_float:
        adapter = K.AugmentationSequential(
            KorniaRandomCamera(camera, case.like, fov=case.fov, **ANGLES), data_keys=["input", "mask", "keypoints"]
        )
        runs[ADAPTER] = lambda: adapter(*data)
        if compiled and options.compile:
            runs[COMPILED] = partial(drawn, torch.compile(apply, fullgraph=True))
            compiled_affine = torch.compile(lambda *tensors: affine(*tensors))
            runs[f"{AFFINE}, compiled"] = lambda: compiled_affine(*data)
    if case.like == "pinhole":
        runs[OPENCV] = _opencv(case, camera, data)
    return runs


def chains(size: tuple[int, int], options: Options) -> dict[str, Run]:
    """Name -> what is timed: a batch of colour images and their landmarks through a chain, each by its own draw."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (BATCH, 3, *size), dtype=torch.uint8, generator=generator).to(options.device)
    landmarks = (torch.rand(BATCH, LANDMARKS, 2, generator=generator) * torch.tensor(size[::-1])).to(options.device)
    camera = cameras.camera("kannala_brandt", options.device, size=size).requires_grad_(False)
    edits = [RandomResizedCrop(size), HorizontalFlip()]
    chain = Compose([*edits, RandomLens("pinhole", fov=(65, 80), min_filled=0)], camera=camera)
    alone = Compose(edits, camera=camera)

    def by_sample() -> tuple[Tensor, Tensor]:
        pairs = [as_torchvision(image[None], points) for image, points in zip(images, landmarks, strict=True)]
        return torch.cat([image for image, _ in pairs]), torch.stack([points for _, points in pairs])

    return {
        OURS: lambda: chain(image=images, keypoints=landmarks),
        CHAIN_EDITS: lambda: alone(image=images, keypoints=landmarks),
        VISION: by_sample,
        VISION_BATCH: lambda: as_torchvision(images, landmarks),
    }


def as_torchvision(images: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """`RandomResizedCrop` of the images' own size and `RandomHorizontalFlip` of v2: the operators that both call."""
    height, width = images.shape[-2:]
    for _ in range(10):
        area = height * width * float(torch.empty(1).uniform_(0.08, 1.0))
        ratio = float(torch.exp(torch.empty(1).uniform_(math.log(3 / 4), math.log(4 / 3))))
        w, h = round(math.sqrt(area * ratio)), round(math.sqrt(area / ratio))
        if 0 < w <= width and 0 < h <= height:
            break
    else:
        w, h = width, height
    top, left = int(torch.randint(0, height - h + 1, (1,))), int(torch.randint(0, width - w + 1, (1,)))
    images = images[..., top : top + h, left : left + w]
    images = F.interpolate(images, (height, width), mode="bilinear", align_corners=False, antialias=True)
    points = (points - points.new_tensor([left, top])) * points.new_tensor([width / w, height / h])
    if float(torch.rand(1)) < 0.5:
        images = images.flip(-1)
        points = torch.stack((width - 1 - points[..., 0], points[..., 1]), -1)
    return images, points


def affine_of(keys: list[str]) -> K.AugmentationSequential:
    """kornia's affine map of about the same extent."""
    return K.AugmentationSequential(
        K.RandomAffine(10.0, translate=(0.02, 0.02), scale=(0.95, 1.05), p=1.0), data_keys=keys
    )


def _opencv(case: Case, camera: ct.Camera, data: Data) -> Run:
    """Sample by sample."""
    move = OpenCVCamera(case, camera)
    image, mask, keypoints = (t.cpu().numpy() for t in data)
    return lambda: [move(image[i, 0], mask[i, 0], keypoints[i]) for i in range(BATCH)]


class OpenCVCamera:
    """A turned pinhole camera, its map, the image, the mask and the landmarks."""

    def __init__(self, case: Case, camera: ct.Camera):
        self.matrix = camera.K.cpu().double().numpy()
        self.distortion = camera.distortion.cpu().double().numpy()
        self.fov = case.fov
        self.module = cv2.fisheye if case.source == "kannala_brandt" else cv2
        self.random = np.random.default_rng(0)

    def __call__(
        self, image: np.ndarray, mask: np.ndarray, keypoints: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of (H, W, C) or (H, W), (H, W) and (N, 2)."""
        height, width = image.shape[:2]
        rotation, _ = cv2.Rodrigues(self.random.uniform(-_DEGREES, _DEGREES, 3))
        focal = width / 2 / np.tan(np.radians(self.random.uniform(*self.fov)) / 2)
        target = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        maps = self.module.initUndistortRectifyMap(
            self.matrix, self.distortion, rotation, target, (width, height), cv2.CV_32FC1
        )
        warped = cv2.remap(image, *maps, cv2.INTER_LINEAR)
        label = cv2.remap(mask, *maps, cv2.INTER_NEAREST)
        points = self.module.undistortPoints(keypoints[:, None], self.matrix, self.distortion, R=rotation, P=target)
        return warped, label, points[:, 0]
