"""Images: dewarping with a map that is kept, and with maps computed each time; and pairs rectified by kept maps.

OpenCV and deltacamera have their images as arrays (H, W, C), or (H, W) of one channel, before the clock starts, and
give lists of such. The error is the largest difference, in grey levels, to `grid_sample` in float64 with positions from
a float64 camera, over the pixels whose interpolation stays inside the image. The images are noise, whose neighbours
differ by up to 255: 0.01 px shows as some 2 grey levels. Results in uint8 are up to 0.5 off by rounding.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from kornia.geometry.calibration import undistort_image
from torch import Tensor

import camtorch as ct
from benchmarks import cameras
from benchmarks.harness import KORNIA, NAMES, OPENCV, OPENCV_MAPS, OURS, Figure, Options, Row, Run, Table, dc, threaded

MODELS = ("kannala_brandt", "brown_conrady")
SMALL, LARGE, QUICK = (480, 640), (720, 1280), (120, 160)
KEPT, NEW = "kept maps", "new cameras"
DELTACAMERA, GRID_SAMPLE, TORCH_MAP = "deltacamera", "`grid_sample` alone", "a torch map and `cv2.remap`"
_EVERYONE = (OURS, OPENCV, TORCH_MAP, DELTACAMERA, KORNIA, GRID_SAMPLE)
TABLES = (
    Table("kept maps", "kept maps, ms", _EVERYONE),
    Table("new cameras", "new cameras, ms", _EVERYONE),
    Table("images, errors", "largest difference, grey levels", _EVERYONE, 1, None),
    Table("stereo", "a pair rectified, ms", (OURS, OPENCV)),
)
_JUDGED = 2  # images of a batch whose errors are taken


class Task:
    """Images of random noise, which no error of a position can hide in.

    "kept maps" are of one camera for all images, into the target that `ct.Dewarp` chose. "new cameras" are as
    many different cameras, made anew each time, into a pinhole camera of the same K: what every peer can do.
    The shape (H, W, C) is of images whose channels lie last in memory, as OpenCV's do.
    """

    def __init__(self, key: str, batch: int, shape: tuple[int, int, int], dtype: torch.dtype, device: torch.device):
        channels_last = shape[-1] == 3
        size, shape = "x".join(map(str, shape)), (shape[-1], *shape[:-1]) if channels_last else shape
        self.key, self.size, self.device = key, shape[1:], device
        self.name = f"{NAMES[key]}, {batch} of {size} {str(dtype).removeprefix('torch.')}"
        generator = torch.Generator().manual_seed(0)
        bytes_ = torch.randint(256, (batch, *shape), generator=generator, dtype=torch.uint8)
        layout = torch.channels_last if channels_last else torch.contiguous_format
        self.images = bytes_.to(device, dtype).contiguous(memory_format=layout)
        arrays = [np.ascontiguousarray(image.permute(1, 2, 0).numpy()) for image in bytes_.to(dtype)]
        self.arrays = [array[..., 0] for array in arrays] if shape[0] == 1 else arrays
        self.dewarp = ct.Dewarp(self.camera())
        self.new = self.warp_of(self.camera(batch))

    def camera(self, batch: int | None = None, dtype: torch.dtype = torch.float32) -> ct.Camera:
        """Return the camera of all images, or a batch of them."""
        camera = cameras.camera(self.key, self.device, dtype, size=self.size, batch=batch)
        return camera.requires_grad_(False)

    def warp_of(self, source: ct.Camera) -> ct.Warp:
        """Return the warp to pinhole cameras of the same K."""
        return ct.Warp(source, ct.Pinhole(source.intrinsics, image_size=self.size).requires_grad_(False))


def rows(options: Options) -> Iterator[Row]:
    """Measure every kind of image, speed and errors; then pairs."""
    full, byte = torch.float32, torch.uint8
    asked = [(1, shape, byte) for shape in ((1, *SMALL), (3, *SMALL), (*SMALL, 3), (3, *LARGE))]
    asked += [(1, (3, *LARGE), full), (8, (3, *LARGE), byte), (8, (3, *SMALL), full), (8, (3, *LARGE), full)]
    if options.quick:
        asked = [(1, (*QUICK, 3), byte), (8, (3, *QUICK), full)]
    for key, kind in product(options.chosen(MODELS), asked):
        task = Task(key, *kind, options.device)
        for operation, runs in contestants(task).items():
            yield from threaded(operation, task.name, runs, options, 1 if len(task.images) == 1 else options.threads)
            if not options.rows:
                yield Row("images, errors", f"{task.name}, {operation}", _errors(task, operation, runs))
    with torch.no_grad():
        for key, channels in product(options.chosen(MODELS), (1, 3)):
            yield from _pair(key, channels, options)


def _errors(task: Task, operation: str, runs: dict[str, Run]) -> dict[str, Figure]:
    """The largest error of each contestant, over pixels none of whose neighbours lies off the image."""
    images, double = task.images[:_JUDGED], torch.float64
    if operation == KEPT:
        target = task.dewarp.target
        straight = ct.Pinhole(target.intrinsics.double(), image_size=target.image_size).requires_grad_(False)
        warp = ct.Warp(task.camera(dtype=double), straight)
    else:
        warp = task.warp_of(task.camera(len(images), double))
    with torch.no_grad():
        rays, has_ray = warp.target.rays()
        pixels, mapped = warp.source.project(rays)
        last = pixels.new_tensor([warp.source.width - 1, warp.source.height - 1])
        inside = ((pixels > 0) & (pixels < last)).all(-1) & has_ray & mapped
        grid = 2 * pixels / last - 1
        truth = F.grid_sample(images.double(), grid.expand(len(images), *grid.shape[-3:]), align_corners=True)
    inside = inside.expand(len(images), *inside.shape[-2:]).unsqueeze(1).expand_as(truth)
    found = {who: run() for who, run in runs.items()}
    for who, result in found.items():
        if not isinstance(result, Tensor):
            arrays = [torch.from_numpy(array).reshape(*array.shape[:2], -1) for array in result]
            found[who] = torch.stack(arrays).permute(0, 3, 1, 2).to(truth)
    return {who: Figure((result[:_JUDGED] - truth).abs()[inside].max().item()) for who, result in found.items()}


def contestants(task: Task) -> dict[str, dict[str, Run]]:
    """Return operation -> name -> what is timed, which gives a tensor or a list of arrays."""
    images, arrays, dewarp, given = task.images, task.arrays, task.dewarp, task.new.source
    pairs = [(task.new.source[i], task.new.target[i]) for i in range(len(images))]

    def new() -> Tensor:
        values = [p.clone() for p in (given.intrinsics, given.distortion)]  # from which nothing was computed yet
        return task.warp_of(type(given)(*values, image_size=task.size).requires_grad_(False))(images)

    # camtorch as a user writes it; uint8 in, uint8 out
    found: dict[str, dict[str, Run]] = {KEPT: {OURS: lambda: dewarp(images)}, NEW: {OURS: new}}
    for name, kind in zip(OPENCV_MAPS, (cv2.CV_32FC1, cv2.CV_16SC2), strict=True):
        kept = opencv_maps(dewarp.source, dewarp.target, np.eye(3), kind)()
        makers = [opencv_maps(*pair, np.eye(3), kind) for pair in pairs]
        found[KEPT][name] = partial(_remap, arrays, [lambda kept=kept: kept] * len(arrays))
        found[NEW][name] = partial(_remap, arrays, makers)
    makers = [partial(_torch_map, *pair) for pair in pairs]
    found[NEW][TORCH_MAP] = partial(_remap, arrays, makers)
    if dc is not None:
        lenses = [tuple(map(_deltacamera, pair)) for pair in [(dewarp.source, dewarp.target), *pairs]]
        # its best case: the map, or for new cameras what it keeps of each lens, is in its cache
        found[KEPT][DELTACAMERA] = lambda: [dc.reproject_image(a, *lenses[0], cache_maps=True) for a in arrays]
        found[NEW][DELTACAMERA] = lambda: [dc.reproject_image(a, *ab) for a, ab in zip(arrays, lenses[1:], strict=True)]
    if images.is_floating_point():
        grid = dewarp.grid().expand(len(images), -1, -1, -1)
        found[KEPT][GRID_SAMPLE] = lambda: F.grid_sample(images, grid, align_corners=False)
        if task.key == "brown_conrady":  # which kornia knows; it computes its map every time
            found[NEW][KORNIA] = lambda: undistort_image(images, given.K, given.distortion)
    return found


def _remap(arrays: list[np.ndarray], makers: list[Callable[[], tuple[np.ndarray, np.ndarray]]]) -> list[np.ndarray]:
    return [cv2.remap(array, *make(), cv2.INTER_LINEAR) for array, make in zip(arrays, makers, strict=True)]


def _torch_map(source: ct.Camera, target: ct.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the maps of `cv2.remap` by the formula of a lens in torch, as a user writes it who knows the lens."""
    fx, fy, cx, cy = target.intrinsics.tolist()
    (height, width), (k1, k2, *more) = target.image_size, source.distortion.tolist()
    x, y = (torch.arange(width) - cx) / fx, (torch.arange(height)[:, None] - cy) / fy
    square = x * x + y * y
    if isinstance(source, ct.KannalaBrandt):
        radius, (k3, k4) = square.sqrt(), more
        angle = radius.atan()
        square = angle * angle
        scale = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))) / radius
        x, y = x * scale, y * scale
    else:
        twice, (p1, p2, k3) = 2 * x * y, more
        scale = 1 + square * (k1 + square * (k2 + square * k3))
        u = x * scale + p1 * twice + p2 * (square + 2 * x * x)
        x, y = u, y * scale + p2 * twice + p1 * (square + 2 * y * y)
    fx, fy, cx, cy = source.intrinsics.tolist()
    return (x * fx + cx).numpy(), (y * fy + cy).numpy()


def opencv_maps(
    source: ct.Camera, target: ct.Camera, rotation: np.ndarray, kind: int
) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """Return what makes the maps of `cv2.remap`, from numbers that are there as OpenCV takes them."""
    lens, straight = (camera.K.cpu().double().numpy() for camera in (source, target))
    module = cv2.fisheye if isinstance(source, ct.KannalaBrandt) else cv2
    coefficients, size = source.distortion.cpu().double().numpy(), target.image_size[::-1]
    return partial(module.initUndistortRectifyMap, lens, coefficients, rotation, straight, size, kind)


def _deltacamera(camera: ct.Camera) -> Any:
    coefficients = camera.distortion.cpu().numpy()
    lens = dc.FisheyeKannalaBrandt if isinstance(camera, ct.KannalaBrandt) else dc.BrownConradyEx
    model = lens(coefficients) if coefficients.size else None
    return dc.Camera(intrinsic_matrix=camera.K.cpu().numpy(), distortion_model=model, image_shape=camera.image_size)


def _pair(key: str, channels: int, options: Options) -> Iterator[Row]:
    """Two cameras of a model, a little turned against each other, into images of their size."""
    size, device = QUICK if options.quick else LARGE, options.device
    camera = cameras.camera(key, device, size=size).requires_grad_(False)
    extrinsics = ct.Extrinsics([0.01, -0.02, 0.015], [-0.1, 0.002, -0.001]).to(device).requires_grad_(False)
    wide = np.degrees(2 * np.arctan(size[1] / 2 / float(camera.intrinsics[0])))
    ours = ct.rectify(camera, camera, extrinsics, fov=float(wide), image_size=size, align="opencv")
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(256, (2, 1, channels, *size), generator=generator, dtype=torch.uint8).to(device)
    arrays = [np.ascontiguousarray(image[0].permute(1, 2, 0).cpu().numpy()) for image in images]
    turns = [turn.cpu().numpy() for turn in (ours.rotation_left, ours.rotation_right)]
    runs: dict[str, Run] = {OURS: lambda: ours(*images)}
    for name, kind in zip(OPENCV_MAPS, (cv2.CV_32FC1, cv2.CV_16SC2), strict=True):
        maps = [opencv_maps(camera, ours.camera_left, turn, kind)() for turn in turns]
        runs[name] = partial(_remap, arrays, [lambda pair=pair: pair for pair in maps])
    name = "{}, {}x{}x{} uint8".format(NAMES[key], channels, *size)
    yield from threaded("stereo", name, runs, options, options.threads)
