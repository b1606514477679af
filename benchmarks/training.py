"""The training path: a warp forward and backward, to the images, and to the images and the cameras of a batch.

kornia's `undistort_image` computes its map each time; the lens that it does not know goes through its formula and its
`remap`. Without cameras that learn, its map is kept, as camtorch's is. `grid_sample` alone has no camera: its
positions are given, and learn where cameras do.
"""

from collections.abc import Iterator
from functools import partial

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from kornia.geometry.calibration import undistort_image
from kornia.geometry.camera.distortion_kannala_brandt import distort_points_kannala_brandt
from kornia.geometry.transform import remap

import camtorch as ct
from benchmarks.harness import KORNIA, OURS, Options, Row, Run, Table, step, threaded
from benchmarks.images import GRID_SAMPLE, MODELS, QUICK, SMALL, Task

GRID_LEARNS = "`grid_sample`, its grid learns"
TABLES = (Table("training", "forward and backward, ms", (OURS, KORNIA, GRID_SAMPLE, GRID_LEARNS)),)


def rows(options: Options) -> Iterator[Row]:
    """Measure both lenses, with one thread and with two."""
    for key in options.chosen(MODELS):
        shape = (3, *(QUICK if options.quick else SMALL))
        task = Task(key, 8, shape, torch.float32, options.device)
        for case, runs in _contestants(task).items():
            yield from threaded("training", f"{task.name}, to {case}", runs, options, options.threads)


def _contestants(task: Task) -> dict[str, dict[str, Run]]:
    """Case -> name -> what is timed."""
    images, learns = task.images, task.new.source.clone().requires_grad_()
    learning, parameters = ct.Warp(learns, task.new.target), (learns.intrinsics, learns.distortion)
    with torch.no_grad():
        rays, _ = task.new.target.rays()
        pixels, _ = task.new.source.project(rays)
    plane = rays[..., :2] / rays[..., 2:]
    grid = 2 * pixels / pixels.new_tensor([task.size[1] - 1, task.size[0] - 1]) - 1
    move, sample = partial(remap, align_corners=True), partial(F.grid_sample, align_corners=True)
    lenses = lambda: torch.cat(parameters, -1)[:, None, None]
    by_kornia = {
        "kannala_brandt": lambda x, *_: move(x, *distort_points_kannala_brandt(plane, lenses()).unbind(-1)),
        "brown_conrady": lambda x, *_: undistort_image(x, learns.K, learns.distortion),
    }[task.key]
    return {
        "images": {
            OURS: step(task.new, images),
            KORNIA: step(lambda x: move(x, *pixels.unbind(-1)), images),
            GRID_SAMPLE: step(lambda x: sample(x, grid), images),
        },
        "images and cameras": {
            OURS: step(lambda x, *_: learning(x), images, *parameters),
            KORNIA: step(by_kornia, images, *parameters),
            GRID_LEARNS: step(sample, images, grid),
        },
    }
