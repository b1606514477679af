"""Write docs/accuracy.md, how exact results are, from tests/golden and the models: python docs/make_accuracy.py."""

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import torch
from torch import Tensor
from torch.func import functional_call, jacrev, vmap

sys.path.append(str(Path(__file__).parents[1] / "tests"))  # which have reference numbers and cameras
sys.path.extend([f"{sys.path[-1]}/{room}" for room in ("models", "stereo")])

import cameras
import numpy as np
import test_rectify as rectifying
import test_splined as splined
from boards import opencv_left
from cameras import GOLDEN, golden_camera, tensor

import camtorch as ct

PAGE = Path(__file__).parent / "accuracy.md"
TOOLS = {"mpmath": "50 digits", "cv2": "OpenCV", "pycolmap": "COLMAP", "projectaria": "Aria", "basalt": "Basalt"}
HEAD = """# Accuracy

This page shows how far results of camtorch are from those of other programs, and from themselves after a way there
and back. `python docs/make_accuracy.py` makes it. A test compares it with what the script makes now.

A cell is an upper bound of the largest error of all points, rounded up to a power of ten. Each error is measured
twice, with the native code and with the formula that torch records, and the larger one counts. Results are in
float64, except in the column "float32".

## Against other programs

The folder `tests/golden` has cameras, points and results of five sources: OpenCV 5.0, COLMAP 4.2, Project Aria 2.3,
Basalt (2021), and the published formulas, computed with 50 digits by mpmath.

* **Up to** is the largest angle between the axis and a point. Many points are far outside the image.
* **Pixels** are in pixels, beyond 1,000 px from the origin per 1,000 px of that distance.
* **float32** is the error in pixels of a camera and points in float32, on the image only.
* **Rays** are in radians.
* **Jacobians** are derivatives of pixels by points and by all parameters, relative to their column. One rounding of
  the focal length is allowed, because columns vanish on the axis.

| model | by | cameras | points | up to | pixels | float32 | rays | Jacobians |
|---|---|---:|---:|---:|---:|---:|---:|---:|
"""
RAYS = """
The rays of camtorch agree with 50 digits to {exact}. Larger differences are errors of the other program: projected
again, rays of camtorch meet the given pixels to {met} px, and rays of the others only to {missed} px.

Results of mrcal come from its fork drcal, and from its formula:

| result | by | largest difference |
|---|---|---|
"""
LAWS = """
## There and back

Every model of camtorch is tested in this way, also those that no other program has. The cameras are the real
calibrations above, and one camera a model with all coefficients away from zero.

* **Pixels**: a lattice of pixels on the image, to rays and back, in pixels.
* **Rays**: rays on 24 azimuths from the axis to the rim of the image, to pixels and back, in radians.
* **Jacobians**: derivatives of native code, compared with those of the recorded formula, relative to their column.

| model | cameras | widest ray | pixels | rays | Jacobians |
|---|---:|---:|---:|---:|---:|
"""
ATTACKS = """
## What is fuzzed and attacked

These are tests. `pytest -m slow` and `.ci/run` run those that are slow.

| what | how | how often |
|---|---|---|
| C code that samples images | random jobs in memory of exactly the needed size, under AddressSanitizer and UBSan, compared with plain C | 250 for each kind of CPU, slow |
| C code of cameras, moved points and lattices | the same sanitizers, with NaN, infinity and huge numbers | 800 for each of two kinds of CPU, slow |
| C code of poses and calibrations | the same | 4,000 for each of two kinds of CPU, slow |
| {models} models | drawn coefficients, plausible and wild: there and back, folds, distances, any number as input | 2 to 5 cameras for each test and model, mostly slow |
| readers of files | files of all formats cut at every 37th byte; bytes and values replaced; stray text; files made to exhaust memory | all places, 60 files with other bytes, 10 with other values |
| messages | wrong calls of every kind: the error must name the argument and its value | one call for each error |

These comparisons were made by hand for 0.4, and are no tests:

* 12,057 calls of augmentations that had been used before, with fresh ones of the same seed
* 4,900 boxes and 200 homographies, with OpenCV
* 10,464 checks of rolling shutters, with the time of each row computed apart
* 4,200 labels of torchvision's, kornia's, albumentations' and NumPy's front ends, with a camera of the test's own
* 62 minutes of random jobs for the C code, among them its whole library, under the sanitizers: no finding

## What this page does not show

* How well a model fits a lens: [the verdict on a calibration](guides/calibration.md#how-good-is-it).
* Errors of interpolation, and the tolerance of a warp: [limits](limits.md).
* GPUs: no number on this page was measured on one.
"""  # noqa: E501 (rows of a table)


def text() -> str:
    """Return the whole page."""
    found = {name: _against(case) for name, case in sorted(GOLDEN.items())}
    rows = []
    for family in sorted({case["family"] for case in GOLDEN.values()}):
        for tool, title in TOOLS.items():
            here = [found[name] for name in found if name.startswith(tool) and GOLDEN[name]["family"] == family]
            if here:
                counts, angles, *errors = zip(*here, strict=True)
                cells = [f"`{family}`", title, str(len(here)), str(sum(counts)), f"{max(angles):.0f}°"]
                rows.append([*cells, *(_power(max(column)) for column in errors)])
    exact = max(errors[4] for name, errors in found.items() if name.startswith("mpmath"))
    met, missed = (max(column) for column in zip(*map(_returns, GOLDEN.values()), strict=True))
    page = HEAD + _table(rows) + RAYS.format(exact=_power(exact), met=_power(met), missed=_power(missed))
    page += _table([what, by, _power(error) + unit] for what, by, error, unit in _mrcal())
    page += LAWS + _table([f"`{key}`", *_there_and_back(key)] for key in sorted(ct.MODELS))
    return page + ATTACKS.format(models=len(ct.MODELS))


def _table(rows: Iterable[list[str]]) -> str:
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _power(error: float) -> str:
    """Return the power of ten that bounds an error, and not less than some roundings of 1."""
    return "-" if math.isnan(error) else f"1e{max(math.ceil(math.log10(max(error, 1e-300))), -15)}"


def _degrees(rays: Tensor) -> float:
    return float(torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2]).rad2deg().max())


def _both(call: Callable[[Tensor], tuple[Tensor, Tensor]], rows: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield what native code returns for rows, and what the recorded formula does."""
    yield call(rows)
    yield vmap(call)(rows)


def _error(found: Tensor, reference: Tensor, per: float = math.inf) -> float:
    return float(((found - reference).norm(dim=-1) / (reference.norm(dim=-1) / per).clamp(min=1)).max())


def _rays(case: dict) -> tuple[Tensor, Tensor]:
    """Return the pixels and rays of a case, of pixels that have one."""
    pixels, rays = tensor(case["unproject"]["pixels"]), tensor(case["unproject"]["rays"])
    return pixels[rays.isfinite().all(-1)], rays[rays.isfinite().all(-1)]


def _returns(case: dict) -> tuple[float, float]:
    """Return the distances from given pixels at which camtorch's rays, and a tool's, are projected again."""
    camera, (pixels, theirs) = golden_camera(case).requires_grad_(False), _rays(case)
    ours = camera.unproject(pixels)[0]
    return _error(camera.project(ours)[0], pixels), _error(camera.project(theirs)[0], pixels)


def _against(case: dict) -> tuple[float, ...]:
    """Return the number of points, the widest angle, and errors of pixels, in float32, of rays and of Jacobians."""
    camera, judged = golden_camera(case).requires_grad_(False), [bool(answer) for answer in case["valid"]]
    points, pixels = tensor(case["points"])[judged], tensor(case["pixels"])[judged]
    given, rays = _rays(case)
    pixel_error = max(_error(found, pixels, 1000) for found, _ in _both(camera.project, points))
    ray_error = max(_error(found, rays) for found, _ in _both(camera.unproject, given))
    jacobian = 0.0 if "jacobian" in case else math.nan
    if "jacobian" in case:
        general = case["family"] == "kannala_brandt_general"
        references = [tensor(case["jacobian"][name])[judged] for name in ("points", "parameters")]
        for found in _jacobians(camera, points, tensor(case["parameters"]), general):
            jacobian = max(jacobian, *(_relative(*pair, camera) for pair in zip(found, references, strict=True)))
    inside = camera.contains(pixels)
    single = golden_camera(case).requires_grad_(False).float().project(points[inside].float())[0].double()
    return len(points), _degrees(points), pixel_error, _error(single, pixels[inside]), ray_error, jacobian


def _relative(found: Tensor, reference: Tensor, camera: ct.Camera) -> float:
    """Return the error (N, 2, P) relative to columns, beyond a rounding of the focal length: some vanish."""
    rounding = torch.finfo(found.dtype).eps * camera.intrinsics.max()
    beyond = ((found - reference).abs() - rounding).clamp(min=0)
    return float((beyond / reference.norm(dim=-2, keepdim=True).clamp(min=1e-300)).max())


def _jacobians(camera: ct.Camera, points: Tensor, parameters: Tensor, general: bool = False) -> Iterator[tuple]:
    """Yield d(pixel)/d(point) (N, 2, 3) and d(pixel)/d(parameters) (N, 2, P): native, then recorded."""

    def project(points: Tensor, parameters: Tensor) -> Tensor:
        intrinsics, distortion = parameters[..., :4], parameters[..., 4:]
        if general:
            return ct.KannalaBrandt.from_general(intrinsics, distortion).project(points)[0]
        return functional_call(camera, {"intrinsics": intrinsics, "distortion": distortion}, (points,))[0]

    copies = [points[:, None].clone(), parameters.expand(len(points), -1).clone()]
    for copy in copies:
        copy.requires_grad_()
    planes = [torch.autograd.grad(project(*copies)[..., i].sum(), copies) for i in (0, 1)]
    by_point, by_parameter = (torch.stack(rows, 1) for rows in zip(*planes, strict=True))
    yield by_point[:, :, 0], by_parameter
    yield vmap(jacrev(project, argnums=(0, 1)), in_dims=(0, None))(points, parameters)


def _there_and_back(key: str) -> list[str]:
    """Return the cells of a model."""
    found = [*cameras.real(key).values(), cameras.spread(key)]
    widest = pixel_error = ray_error = jacobian = 0.0
    for camera in found:
        camera.requires_grad_(False)
        for direction, rows in ((camera.unproject, cameras.pixel_lattice(camera)), (camera.project, cameras.fan(179))):
            back = camera.project if direction == camera.unproject else camera.unproject
            for there, valid in _both(direction, rows):
                valid = valid if back == camera.project else valid & camera.contains(there)
                for again, returns in _both(back, there[valid]):
                    error = _error(again[returns], rows[valid][returns])
                    if back == camera.project:
                        pixel_error = max(pixel_error, error)
                    else:
                        ray_error, widest = max(ray_error, error), max(widest, _degrees(rows[valid]))
                        seen = rows[valid][::7]
        compiled, recorded = _jacobians(camera, seen, torch.cat((camera.intrinsics, camera.distortion)))
        jacobian = max(jacobian, *(_relative(*pair, camera) for pair in zip(compiled, recorded, strict=True)))
    return [str(len(found)), f"{widest:.0f}°", *map(_power, (pixel_error, ray_error, jacobian))]


def _mrcal() -> Iterator[tuple[str, str, float, str]]:
    """Yield rows of mrcal: result, its source, the largest difference, its unit."""
    lens, points = 0.0, 0.0
    for name, case in rectifying.CASES.items():
        found = rectifying.rectification(name)
        for side in ("left", "right"):
            rays = getattr(found, f"camera_{side}").unproject(tensor(case["pixels"]))[0]
            source, rotation = getattr(found, f"source_{side}"), getattr(found, f"rotation_{side}")
            pixels, valid = source.project(rays @ rotation)
            lens = max(lens, _error(pixels[valid], tensor(case[side])[valid]))
        there = found._points(tensor(case["pixels"])[None], tensor(case["disparity"])[None])[0][0]
        theirs = tensor(case["points"])
        points = max(points, float(((there - theirs).norm(dim=-1) / theirs.norm(dim=-1)).max()))
    yield "pixels of the source for pixels of rectified pairs, `latlon` and `pinhole`", "drcal", lens, " px"
    yield "points from disparities there", "drcal", points, ", relative"
    surface = 0.0
    for grid in splined.GRIDS:
        camera = splined.drawn(*grid).requires_grad_(False)
        rays = splined.on_surface(camera, 8, 0.999)
        reference = torch.tensor(np.array([splined.reference(camera, ray) for ray in rays.tolist()]))
        for pixels, _ in _both(camera.project, rays):
            surface = max(surface, _error(pixels, reference, 1000))
    yield "pixels of `splined`, five grids", "mrcal's formula in NumPy", surface, " px"
    corners, optima = opencv_left()
    found = ct.calibrate("brown_conrady", corners.object_points, corners.image_points, image_size=corners.image_size)
    yield (
        "rms of a calibration from 13 photographs, 5 coefficients",
        "OpenCV",
        abs(found.rms - float(optima[5]["rms"])),
        " px",
    )


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
