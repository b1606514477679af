"""Everyone who can dewarp images, as data: per contestant the operations that it has."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from kornia.geometry.calibration import undistort_image
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.point_peers import KORNIA, OPENCV, OURS
from benchmarks.timing import Run

CACHED, FRESH = "cached map", "fresh maps"
TO_IMAGES, TO_CAMERAS = "f+b images", "f+b images, cameras"
OPERATIONS = (CACHED, FRESH, TO_IMAGES, TO_CAMERAS)
GRID_SAMPLE, CLONE = "grid_sample alone", "clone"
_CHANNELS = 3


@dataclass(frozen=True)
class Task:
    """What is to be done: `batch` images of random noise, which no error of a position can hide in.

    "cached map" is one camera for all of them, into the target that `ct.Dewarp` chose. "fresh maps" are as many
    different cameras, made anew each time, into a pinhole camera of the same K: what every peer can do.
    """

    key: str
    batch: int
    size: tuple[int, int]
    dtype: torch.dtype
    device: torch.device

    @property
    def name(self) -> str:
        """As a row of a table is called."""
        height, width = self.size
        return f"{self.key} {self.batch}x{_CHANNELS}x{height}x{width} {str(self.dtype).removeprefix('torch.')}"

    @cached_property
    def images(self) -> Tensor:
        """(batch, 3, H, W) in grey levels of 0 to 255."""
        generator = torch.Generator().manual_seed(0)
        shape = (self.batch, _CHANNELS, *self.size)
        return torch.randint(256, shape, generator=generator, dtype=torch.uint8).to(self.device, self.dtype)

    @cached_property
    def dewarp(self) -> ct.Dewarp:
        """The cached map."""
        return ct.Dewarp(self.camera().requires_grad_(False))

    def camera(self, batch: int | None = None, dtype: torch.dtype = torch.float32) -> ct.Camera:
        """The camera of all images, or a batch of them."""
        return cameras.camera(self.key, self.device, dtype, size=self.size, batch=batch)

    def fresh(self, *, learns: bool = False, dtype: torch.dtype = torch.float32) -> ct.Warp:
        """The warp of different cameras to pinhole cameras of the same K."""
        source = self.camera(self.batch, dtype).requires_grad_(learns)
        target = ct.Pinhole(source.intrinsics.detach(), image_size=self.size).requires_grad_(False)
        return ct.Warp(source, target)


def contestants(task: Task) -> dict[str, dict[str, Run]]:
    """Name -> operation -> what is timed; each call gives (B, 3, H, W), or the gradients."""
    makers = {
        OURS: camtorch,
        OPENCV: lambda t: opencv(t, cv2.CV_32FC1),
        "OpenCV, fixed-point map": lambda t: opencv(t, cv2.CV_16SC2),
        "OpenCV, remap alone": remap_alone,
        KORNIA: kornia,
        GRID_SAMPLE: grid_sample,
        CLONE: lambda t: dict.fromkeys(OPERATIONS if t.dtype.is_floating_point else (CACHED, FRESH), t.images.clone),
    }
    return {name: make(task) for name, make in makers.items()}


def camtorch(task: Task) -> dict[str, Run]:
    """As a user writes it; uint8 in, uint8 out."""
    given = task.camera(task.batch).requires_grad_(False)
    learning = task.fresh(learns=True)

    def fresh() -> Tensor:
        source = type(given)(*_values(given), image_size=task.size).requires_grad_(False)
        target = ct.Pinhole(given.intrinsics, image_size=task.size).requires_grad_(False)
        return ct.Warp(source, target)(task.images)

    forward = {CACHED: lambda: task.dewarp(task.images), FRESH: fresh}
    if not task.dtype.is_floating_point:
        return forward
    learns = [p for p in learning.source.parameters() if p.numel()]
    return {
        **forward,
        TO_IMAGES: gradients(task.dewarp, task.images),
        TO_CAMERAS: gradients(learning, task.images, learns),
    }


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
    """Tensor in, tensor out: to (H, W, C) and back, image by image."""
    cached = opencv_map(task.key, task.dewarp.source, task.dewarp.target, kind)
    given = task.fresh()

    def warped(maps: Iterable[tuple[np.ndarray, np.ndarray]]) -> Tensor:
        result = torch.empty(task.images.shape, dtype=task.dtype)
        for image, made, (first, second) in zip(task.images, result, maps, strict=True):
            array = image.permute(1, 2, 0).contiguous().cpu().numpy()
            made.copy_(torch.from_numpy(cv2.remap(array, first, second, cv2.INTER_LINEAR)).permute(2, 0, 1))
        return result.to(task.device)

    pairs = list(zip(_unbatched(given.source), _unbatched(given.target), strict=True))
    return {
        CACHED: lambda: warped([cached] * task.batch),
        FRESH: lambda: warped(opencv_map(task.key, source, target, kind) for source, target in pairs),
    }


def remap_alone(task: Task) -> dict[str, Run]:
    """`cv2.remap` of arrays (H, W, C) that are there already and may stay so."""
    maps = opencv_map(task.key, task.dewarp.source, task.dewarp.target, cv2.CV_32FC1)
    arrays = [image.permute(1, 2, 0).contiguous().cpu().numpy() for image in task.images]
    return {CACHED: lambda: [cv2.remap(array, *maps, cv2.INTER_LINEAR) for array in arrays]}


def opencv_map(key: str, source: ct.Camera, target: ct.Camera, kind: int) -> tuple[np.ndarray, np.ndarray]:
    """What `cv2.remap` takes, from the source's to the target's image."""
    lens, straight = (camera.K.cpu().double().numpy() for camera in (source, target))
    coefficients = source.distortion.cpu().double().numpy()
    initialise = cv2.fisheye.initUndistortRectifyMap if key == "kannala_brandt" else cv2.initUndistortRectifyMap
    return initialise(lens, coefficients, np.eye(3), straight, target.image_size[::-1], kind)


def _unbatched(camera: ct.Camera) -> list[ct.Camera]:
    """The cameras of a batch."""
    rows = zip(camera.intrinsics, camera.distortion, strict=True)
    made = (type(camera)(*[v for v in row if v.numel()], image_size=camera.image_size) for row in rows)
    return [one.requires_grad_(False) for one in made]


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
    still = task.dewarp.grid().expand(task.batch, -1, -1, -1)
    grid = task.fresh().grid().requires_grad_()
    sample = lambda x, where: F.grid_sample(x, where, align_corners=False)
    return {
        CACHED: lambda: sample(task.images, still),
        TO_IMAGES: gradients(lambda x: sample(x, still), task.images),
        TO_CAMERAS: gradients(lambda x: sample(x, grid), task.images, [grid]),
    }
