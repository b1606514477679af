"""Everyone who can dewarp images, as data: per contestant the operations that it has.

OpenCV and deltacamera have their images as arrays (H, W, C), or (H, W) of one channel, before the clock starts, and
give lists of such: nothing is converted for them, nor for the others, which have tensors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from kornia.geometry.calibration import undistort_image
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.point_peers import KORNIA, OURS
from benchmarks.timing import Run

try:
    import deltacamera as dc
except ModuleNotFoundError:
    dc = None

CACHED, FRESH = "cached map", "fresh maps"
TO_IMAGES, TO_CAMERAS = "f+b images", "f+b images, cameras"
OPERATIONS = (CACHED, FRESH, TO_IMAGES, TO_CAMERAS)
EXACT, LATTICE = "camtorch, tolerance=0", "camtorch, tolerance=0.01"
OPENCV_FLOAT, OPENCV_FIXED = OPENCV_MAPS = ("OpenCV, float map", "OpenCV, fixed-point map")
DELTACAMERA, GRID_SAMPLE, CLONE = "deltacamera", "grid_sample alone", "clone"


@dataclass(frozen=True)
class Task:
    """What is to be done: `batch` images of random noise, which no error of a position can hide in.

    "cached map" is one camera for all of them, into the target that `ct.Dewarp` chose. "fresh maps" are as many
    different cameras, made anew each time, into a pinhole camera of the same K: what every peer can do.

    Args:
        key: of the model.
        batch: number of images.
        channels: of each.
        size: (height, width) of each.
        dtype: of the images.
        device: where tensors live.
        last: whether the memory of tensors is that of arrays (H, W, C): torch's channels_last.
    """

    key: str
    batch: int
    channels: int
    size: tuple[int, int]
    dtype: torch.dtype
    device: torch.device
    last: bool = False

    @property
    def name(self) -> str:
        """As a row of a table is called."""
        shape = "x".join(map(str, (self.batch, self.channels, *self.size)))
        return f"{self.key} {shape} {str(self.dtype).removeprefix('torch.')}{' HWC' * self.last}"

    @cached_property
    def images(self) -> Tensor:
        """(batch, C, H, W) in grey levels of 0 to 255."""
        generator = torch.Generator().manual_seed(0)
        shape = (self.batch, self.channels, *self.size)
        images = torch.randint(256, shape, generator=generator, dtype=torch.uint8).to(self.device, self.dtype)
        return images.contiguous(memory_format=torch.channels_last) if self.last else images

    @cached_property
    def arrays(self) -> list[np.ndarray]:
        """The images as (H, W, C), or (H, W) of one channel, contiguous."""
        arrays = [np.ascontiguousarray(image.permute(1, 2, 0).cpu().numpy()) for image in self.images]
        return [array[..., 0] for array in arrays] if self.channels == 1 else arrays

    @cached_property
    def dewarp(self) -> ct.Dewarp:
        """The cached map."""
        return ct.Dewarp(self.camera().requires_grad_(False))

    def camera(self, batch: int | None = None, dtype: torch.dtype = torch.float32) -> ct.Camera:
        """The camera of all images, or a batch of them."""
        return cameras.camera(self.key, self.device, dtype, size=self.size, batch=batch)

    def fresh(
        self, *, learns: bool = False, dtype: torch.dtype = torch.float32, tolerance: float | None = None
    ) -> ct.Warp:
        """The warp of different cameras to pinhole cameras of the same K."""
        source = self.camera(self.batch, dtype).requires_grad_(learns)
        target = ct.Pinhole(source.intrinsics.detach(), image_size=self.size).requires_grad_(False)
        return ct.Warp(source, target, tolerance=tolerance)


def contestants(task: Task) -> dict[str, dict[str, Run]]:
    """Name -> operation -> what is timed.

    Each call gives images, a tensor (B, C, H, W) or a list of arrays, or the gradients.
    """
    makers = {
        OURS: camtorch,
        EXACT: partial(camtorch_forward, tolerance=0.0),
        LATTICE: partial(camtorch_forward, tolerance=0.01),
        OPENCV_FLOAT: partial(opencv, kind=cv2.CV_32FC1),
        OPENCV_FIXED: partial(opencv, kind=cv2.CV_16SC2),
        KORNIA: kornia,
        DELTACAMERA: deltacamera,
        GRID_SAMPLE: grid_sample,
        CLONE: lambda task: dict.fromkeys((CACHED, FRESH), task.images.clone),
    }
    return {name: make(task) for name, make in makers.items()}


def as_tensor(result: object) -> Tensor:
    """(B, C, H, W) of what a contestant gave."""
    if isinstance(result, Tensor):
        return result
    return torch.stack([torch.from_numpy(array).reshape(*array.shape[:2], -1).permute(2, 0, 1) for array in result])


def camtorch(task: Task) -> dict[str, Run]:
    """As a user writes it; uint8 in, uint8 out."""
    forward = camtorch_forward(task, None)
    if not task.dtype.is_floating_point:
        return forward
    learning = task.fresh(learns=True)
    learns = [p for p in learning.source.parameters() if p.numel()]
    return {
        **forward,
        TO_IMAGES: gradients(task.dewarp, task.images),
        TO_CAMERAS: gradients(learning, task.images, learns),
    }


def camtorch_forward(task: Task, tolerance: float | None) -> dict[str, Run]:
    """Without gradients, of a tolerance, or of that which `ct.Warp` has by default."""
    given = task.camera(task.batch).requires_grad_(False)
    cached = ct.Warp(task.dewarp.source, task.dewarp.target, tolerance=tolerance)

    def fresh() -> Tensor:
        source = type(given)(*_values(given), image_size=task.size).requires_grad_(False)
        target = ct.Pinhole(given.intrinsics, image_size=task.size).requires_grad_(False)
        return ct.Warp(source, target, tolerance=tolerance)(task.images)

    return {CACHED: lambda: cached(task.images), FRESH: fresh}


def _values(camera: ct.Camera) -> list[Tensor]:
    """Copies of the parameters: values that nothing was computed from yet."""
    return [p.clone() for p in (camera.intrinsics, camera.distortion)]


def gradients(forward: Callable[[Tensor], Tensor], images: Tensor, learns: Iterable[Tensor] = ()) -> Run:
    """Forward and backward, to the images and what else learns."""
    upstream = torch.ones_like(images)
    learns = tuple(learns)

    def run():
        leaf = images.detach().requires_grad_()
        return torch.autograd.grad(forward(leaf), (leaf, *learns), upstream)

    return run


def opencv(task: Task, kind: int) -> dict[str, Run]:
    """`cv2.remap`, image by image; the maps of "fresh maps" are made before each."""
    cached = opencv_map(task.key, task.dewarp.source, task.dewarp.target, kind)
    given = task.fresh()
    pairs = list(zip(unbatched(given.source), unbatched(given.target), strict=True))
    matrices = [_opencv_camera(task.key, *pair) for pair in pairs]

    def fresh() -> list[np.ndarray]:
        return [
            cv2.remap(array, *initialise(kind), cv2.INTER_LINEAR)
            for array, initialise in zip(task.arrays, matrices, strict=True)
        ]

    return {CACHED: lambda: [cv2.remap(array, *cached, cv2.INTER_LINEAR) for array in task.arrays], FRESH: fresh}


def opencv_map(key: str, source: ct.Camera, target: ct.Camera, kind: int) -> tuple[np.ndarray, np.ndarray]:
    """What `cv2.remap` takes, from the source's to the target's image."""
    return _opencv_camera(key, source, target)(kind)


def _opencv_camera(key: str, source: ct.Camera, target: ct.Camera) -> Callable[[int], tuple[np.ndarray, np.ndarray]]:
    """The map of a kind, from numbers that are there as OpenCV takes them."""
    lens, straight = (camera.K.cpu().double().numpy() for camera in (source, target))
    coefficients = source.distortion.cpu().double().numpy()
    initialise = cv2.fisheye.initUndistortRectifyMap if key == "kannala_brandt" else cv2.initUndistortRectifyMap
    return partial(initialise, lens, coefficients, np.eye(3), straight, target.image_size[::-1])


def unbatched(camera: ct.Camera) -> list[ct.Camera]:
    """The cameras of a batch."""
    rows = zip(camera.intrinsics, camera.distortion, strict=True)
    made = (type(camera)(*[v for v in row if v.numel()], image_size=camera.image_size) for row in rows)
    return [one.requires_grad_(False) for one in made]


def deltacamera(task: Task) -> dict[str, Run]:
    """`reproject_image`, image by image, if it is installed; compiled by the calls before the clock starts.

    Its best case: the map, or for "fresh maps" what it keeps of each lens, is in its cache.
    """
    if dc is None:
        return {}
    lens = dc.FisheyeKannalaBrandt if task.key == "kannala_brandt" else dc.BrownConradyEx

    def converted(camera: ct.Camera) -> dc.Camera:
        coefficients = camera.distortion.cpu().numpy()
        model = lens(coefficients) if coefficients.size else None
        return dc.Camera(intrinsic_matrix=camera.K.cpu().numpy(), distortion_model=model, image_shape=task.size)

    given = task.fresh()
    kept = converted(task.dewarp.source), converted(task.dewarp.target)
    pairs = [tuple(map(converted, pair)) for pair in zip(unbatched(given.source), unbatched(given.target), strict=True)]
    return {
        CACHED: lambda: [dc.reproject_image(array, *kept, cache_maps=True) for array in task.arrays],
        FRESH: lambda: [dc.reproject_image(array, *pair) for array, pair in zip(task.arrays, pairs, strict=True)],
    }


def kornia(task: Task) -> dict[str, Run]:
    """`undistort_image`, which knows Brown-Conrady and floating point, and computes its map every time."""
    if task.key != "brown_conrady" or not task.dtype.is_floating_point:
        return {}
    given = task.fresh(learns=True).source
    still = given.K.detach(), given.distortion.detach()
    learns = [v.clone().requires_grad_() for v in still]
    return {
        FRESH: lambda: undistort_image(task.images, *still),
        TO_IMAGES: gradients(lambda x: undistort_image(x, *still), task.images),
        TO_CAMERAS: gradients(lambda x: undistort_image(x, *learns), task.images, learns),
    }


def grid_sample(task: Task) -> dict[str, Run]:
    """torch's sampling in one call, of a grid that is there already."""
    if not task.dtype.is_floating_point:
        return {}
    still = ct.Warp(task.dewarp.source, task.dewarp.target, tolerance=0.0).grid().expand(task.batch, -1, -1, -1)
    grid = task.fresh(tolerance=0.0).grid().requires_grad_()
    sample = lambda x, where: F.grid_sample(x, where, align_corners=False)
    return {
        CACHED: lambda: sample(task.images, still),
        TO_IMAGES: gradients(lambda x: sample(x, still), task.images),
        TO_CAMERAS: gradients(lambda x: sample(x, grid), task.images, [grid]),
    }
