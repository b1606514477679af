"""What Python says of lenses, for the formulas of the page to be held to it: in node, and in a browser."""

import math
import random
import shutil

import torch
from cameras import CALIBRATIONS, GOLDEN, RANGES, golden_camera, limits_of, make, nodes_of_steps

import camtorch as ct
from camtorch.viewer.viewer import models

KEYS = sorted(models())
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SIDE = 11
# in JavaScript: the results of lenses as `asked` describes them
ANSWERS = """(lenses) => lenses.map(({ model, intrinsics, distortion, pixels, points }) => {
  const camera = new Formulas.Camera(model, intrinsics, distortion);
  return { rays: pixels.map((p) => camera.unproject(...p)), pixels: points.map((p) => camera.project(...p)) };
})"""


def preset(key):
    entry = models()[key]
    numbers = [torch.tensor(entry[name], dtype=torch.float64) for name in ("intrinsics", "distortion")]
    return make(key, *numbers, image_size=entry["image_size"])


def drawn(key, which, seed):
    """A camera with coefficients from the ranges of the laws: plausible for 0, wild for 1."""
    pick, names = random.Random(f"{key} {seed}"), ct.MODELS[key].names_of(ct.MODELS[key].default_count)
    values = [pick.uniform(*limits_of(key, name, which)) for name in names]
    distortion = nodes_of_steps(key, torch.tensor(values, dtype=torch.float64))
    if key == "tabulated":
        distortion[:6] *= min(1.0, 3.0 / float(distortion[5]))
    return make(key, torch.tensor([300.0, 310.0, 322.0, 238.0], dtype=torch.float64), distortion, image_size=(480, 640))


def lenses_of(key):
    found = [preset(key)]
    if key in CALIBRATIONS:
        *numbers, size = CALIBRATIONS[key]
        found.append(make(key, *(torch.tensor(v, dtype=torch.float64) for v in numbers), image_size=size))
    found += [golden_camera(case) for case in GOLDEN[key]["cameras"][:3]] if key in GOLDEN else []
    if key in RANGES:
        found += [drawn(key, which, seed) for which in (0, 1) for seed in range(3)]
    if key == "splined":
        other = ct.Splined.with_grid(columns=9, rows=11, fov_x=200, order=2)
        found += [preset("kannala_brandt").convert(other).camera]
    return [camera for camera in found if camera.key.split(":")[0] == key]


def asked(camera):
    """Pixels of a lattice a little larger than the image, and points all around, most of them ahead."""
    across, down = (torch.linspace(-0.1 * s, 1.1 * s, SIDE, dtype=torch.float64) for s in (camera.width, camera.height))
    pixels = torch.cartesian_prod(across, down)
    points = torch.randn(SIDE * SIDE, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points[::2] = points[::2] * torch.tensor([0.5, 0.5, 0.5]) + torch.tensor([0.0, 0.0, 1.0])
    return pixels, points


def described(camera):
    pixels, points = asked(camera)
    numbers = {"intrinsics": camera.intrinsics.tolist(), "distortion": camera.distortion.tolist()}
    return {"model": camera.key, **numbers, "pixels": pixels.tolist(), "points": points.tolist()}


def planes(rows, width):
    """Numbers (N, width) of a list in which null is no result, and which there are."""
    there = torch.tensor([row is not None for row in rows])
    return torch.tensor([row or [0.0] * width for row in rows], dtype=torch.float64), there


def beside(valid_of, places, steps):
    """Of places (M, n), whether some but not all of them and their neighbours (K, n) are valid."""
    valid = torch.stack([valid_of(places), *(valid_of(places + step) for step in steps)])
    return valid.any(0) & ~valid.all(0)


@torch.no_grad()
def check(camera, answer):
    """0.05 px, and validity equal but within a pixel of a limit."""
    pixels, points = asked(camera)
    expected, valid = camera.project(points)
    found, there = planes(answer["pixels"], 2)
    both = valid & there
    far = expected.abs().amax(-1).clamp(min=2e4) / 2e4  # what no image has is good to its own digits
    assert both.any()
    assert ((found - expected).abs().amax(-1) / far)[both].max() < 0.05
    unlike = points[valid != there]
    if len(unlike):
        distance, pixel = unlike.norm(dim=-1, keepdim=True), 1 / float(camera.intrinsics[:2].min())
        turns = [distance * pixel * torch.tensor(t, dtype=torch.float64) for t in _AROUND_3]
        assert beside(lambda p: camera.project(p)[1], unlike, turns).all()

    expected, valid = camera.unproject(pixels)
    found, there = planes(answer["rays"], 3)
    both = valid & there
    if both.any():
        seen, on = camera.project(found[both])
        assert ((seen - pixels[both]).abs().amax(-1)[on] < 0.05).all()
        assert beside(lambda p: camera.unproject(p)[1], pixels[both][~on], _AROUND_2).all()
        slack = 0.05 / float(camera.intrinsics[:2].min())
        steep = (found - expected)[both].norm(dim=-1) > slack  # next to a fold a ray moves far within a pixel
        assert beside(lambda p: camera.unproject(p)[1], pixels[both][steep], _AROUND_2).all()
    unlike = pixels[valid != there]
    assert beside(lambda p: camera.unproject(p)[1], unlike, _AROUND_2).all()


_AROUND_2 = [torch.tensor([math.cos(a), math.sin(a)], dtype=torch.float64) for a in torch.arange(8) * math.pi / 4]
_AROUND_3 = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)]
