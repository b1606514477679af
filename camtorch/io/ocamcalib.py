"""OCamCalib's `calib_results.txt`: five lines of numbers between comments, in the order in which its C code reads them.

The second line is a polynomial of the other direction, which is close to the inverse of the first one. It is not read:
the camera inverts the first one exactly. Written is one that is fitted, and its comment says how far off it is.
"""

from __future__ import annotations

import math
import re

import torch
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.camera import Camera
from camtorch.io import poses
from camtorch.io._errors import CameraFileError
from camtorch.io.parsing import decoded
from camtorch.io.protocol import Names
from camtorch.io.record import Record
from camtorch.io.writing import Lossy
from camtorch.models import OCamCalib
from camtorch.rig import Rig

NAMES = Names("ocamcalib", "OCamCalib", (".txt",), ("*calib_results*.txt", "*ocam*.txt"))

_LINES = ("polynomial", "inverse polynomial", "centre", "affine", "image size")
_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)
_MOST_TERMS = 64
_START = 1 << 14  # of a file, where its kind shows
_LARGEST = 1 << 16
_SAMPLES, _ENOUGH, _HIGHEST = 500, 0.01, 20  # of the fit: angles, pixels, power


def matches(path: str, content: bytes) -> bool:
    """Whether this is such a file: comments, and a first line of as many numbers as it says."""
    lines = [line.split() for line in content[:_START].splitlines() if line.strip()]
    numbers = next((line for line in lines if not line[0].startswith(b"#")), [b""])
    counted = re.fullmatch(rb"[1-9]\d?", numbers[0]) is not None and int(numbers[0]) == len(numbers) - 1
    return counted and lines[0][0].startswith(b"#") and all(map(_NUMBER.fullmatch, numbers))


def read(path: str, content: bytes) -> Rig:
    """The one camera of a file; lines after the size, which some programs add, are not read."""
    if len(content) > _LARGEST:
        raise CameraFileError(path, "size", f"{len(content)} bytes; a calibration of OCamCalib has one thousand")
    lines = [line.split() for line in decoded(path, content).splitlines()]
    rows = [line for line in lines if line and not line[0].startswith("#")]
    if len(rows) < len(_LINES):
        raise CameraFileError(path, _LINES[len(rows)], "missing")
    record = Record(path, dict(zip(_LINES, rows, strict=False)))
    polynomial, inverse, centre, affine, size = (record[name] for name in _LINES)
    for terms in (polynomial, inverse):
        first = Record(path, terms.value[0], terms.place)
        count = first.whole(1, _MOST_TERMS, f"number of coefficients up to {_MOST_TERMS}")
        if len(terms) != count + 1:
            terms.fail(f"{len(terms) - 1} coefficients where the line says {count}")
    height, width = (
        (side.side() for side in size)
        if len(size) == 2
        else size.fail(f"not a height and a width, but {len(size)} numbers")
    )
    values = polynomial.numbers()[1:], centre.numbers(2), affine.numbers(3)
    try:
        return Rig({"camera": OCamCalib.from_ocamcalib(*map(poses.as_float64, values), image_size=(height, width))})
    except (ValueError, TypeError) as error:
        return record.fail(error)


def files(rig: Rig, path: str) -> dict[str, bytes]:
    """The text of a file, whose camera looks along -z as the toolbox has it."""
    lossy = Lossy(path, NAMES.title)
    lossy.no_pose(rig)
    name, camera = lossy.only_camera(rig)
    height, width = lossy.size(name, camera)
    _, (fx, fy, cx, cy), distortion = lossy.model(name, camera, {OCamCalib.key})
    c, d = fy / fx, distortion[0] * fy / fx
    terms = [-value / fx**i + 0.0 for i, value in enumerate(distortion[2:])]
    inverse, error, angle = _inverse(camera, (height, width))
    lines = (
        ("direct mapping: how many coefficients; z of the distance from the centre", [1 + len(terms), -fx, *terms]),
        (
            f"inverse mapping: how many coefficients; the distance of the angle; fitted, off by {error:.2g} pixels "
            f"up to {math.degrees(angle):.1f} degrees from the axis",
            [len(inverse), *inverse],
        ),
        ("centre: row and column, counted from 0", [cy, cx]),
        ("affine: c, d, e", [c, d, distortion[1]]),
        ("image size: height and width", [height, width]),
    )
    text = "\n".join(f"#{comment}\n\n{' '.join(map(repr, numbers))}\n" for comment, numbers in lines)
    return {path: text.encode()}


def _inverse(camera: Camera, size: tuple[int, int]) -> tuple[list[float], float, float]:
    """The coefficients of the distance, in pixels, by powers of the angle from the camera's plane; of the least degree
    that is good enough, or of the best one. And the largest error in pixels, and up to which angle from the axis.
    """
    model = type_before_parametrizations(camera)
    square = model(camera.intrinsics.detach().double(), camera.distortion.detach().double())
    bottom, right = (side - 1.0 for side in size)
    corners = torch.tensor([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]], dtype=torch.float64)
    fx, fy, cx, cy = square.intrinsics.detach().unbind()
    furthest = float((((corners - torch.stack((cx, cy))) / torch.stack((fx, fy))).norm(dim=-1)).max())
    with torch.no_grad():
        # without the affine part, along x
        straight = model([1.0, 1, 0, 0], torch.cat((square.distortion[:2] * 0, square.distortion[2:]))).double()
        radius = torch.linspace(0, furthest, _SAMPLES, dtype=torch.float64)
        rays, valid = straight.unproject(torch.stack((radius, 0 * radius), -1))
    rays, radius = rays[valid], radius[valid] * float(fx)
    theta = torch.atan2(-rays[:, 2], rays[:, 0])
    best: tuple[list[float], float] = [0.0], math.inf
    for degree in range(4, _HIGHEST + 1):
        powers = theta.unsqueeze(-1) ** torch.arange(degree + 1)
        scale = powers.abs().amax(0).clamp(min=1e-300)
        solution = torch.linalg.lstsq(powers / scale, radius.unsqueeze(-1), driver="gelsd").solution.squeeze(-1) / scale
        error = float((powers @ solution - radius).abs().max())
        if error < best[1]:
            best = solution.tolist(), error
        if error <= _ENOUGH:
            break
    return *best, float(theta.max()) + math.pi / 2
