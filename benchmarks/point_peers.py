"""Everyone who can project or unproject points, as data.

What a contestant takes and gives differs: OpenCV and kornia's lenses map the plane z = 1, so that they cannot
tell a ray past 90 degrees from its mirror image, and kornia's are even spared the division by z here. The accuracy
tables show what that costs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import torch
from kornia.geometry import calibration
from kornia.geometry import camera as perspective
from kornia.geometry.camera import distortion_kannala_brandt as kannala_brandt
from torch import Tensor

import camtorch as ct
from benchmarks.cameras import COEFFICIENTS, INTRINSICS, camera, matrix

OURS, COMPILED, PLANES = "camtorch", "camtorch compiled", "camtorch compiled, planes"
OPENCV, KORNIA, COPY = "OpenCV", "kornia", "cold copy"
FLOOR = (COPY, "clone", "atan2")
# A copy from memory that was not touched for this many bytes finds nothing of it in a cache
_COLD_BYTES = 256 * 2**20


@dataclass(frozen=True)
class Direction:
    """One direction of one contestant.

    Args:
        call: what is timed.
        prepare: (N, 3) points or (N, 2) pixels to what `call` takes; not timed.
        answer: the result of `call` as pixels (N, 2), or rays (N, 3) of any length, NaN where it is called invalid.
        learns: the leaves that receive gradients besides the input; None if there are no gradients.
    """

    call: Callable[[Any], Any]
    prepare: Callable[[Tensor], Any] = lambda x: x
    answer: Callable[[Any], Tensor] = lambda result: result
    learns: tuple[Tensor, ...] | None = ()

    def values(self, source: Any) -> Tensor:
        """The part of the result that has gradients."""
        result = self.call(source)
        return result if isinstance(result, Tensor) else result[0]


@dataclass(frozen=True)
class Contestant:
    """Who competes, in the directions that it has."""

    name: str
    project: Direction | None = None
    unproject: Direction | None = None


def contestants(key: str, device: torch.device, compiled: bool) -> list[Contestant]:
    """All that can do something for a model, the floor of the machine last."""
    ours = camtorch(camera(key, device))
    found = [ours, *(compilations(ours) if compiled else ()), *opencv(key), *kornia(key, device)]
    return [*found, *floor(device)]


def camtorch(lens: ct.Camera) -> Contestant:
    """The eager camera, learning."""
    learns = tuple(p for p in lens.parameters() if p.numel())

    def direction(mapping: Callable[[Tensor], tuple[Tensor, Tensor]]) -> Direction:
        return Direction(mapping, answer=lambda r: torch.where(r[1][..., None], r[0], torch.nan), learns=learns)

    return Contestant(OURS, direction(lens.project), direction(lens.unproject))


def compilations(ours: Contestant) -> list[Contestant]:
    """The same by `torch.compile`, on triples as they come and on planes."""

    def compiled(direction: Direction, **changes) -> Direction:
        return replace(direction, call=torch.compile(direction.call, dynamic=False), **changes)

    planes = compiled(ours.project, prepare=lambda points: points.T.contiguous().movedim(0, -1))
    return [
        Contestant(COMPILED, compiled(ours.project), compiled(ours.unproject)),
        Contestant(PLANES, planes),
    ]


def opencv(key: str) -> list[Contestant]:
    """`cv2.fisheye`, or `cv2` for the perspective cameras; in float32, as its callers' points are."""
    intrinsics, coefficients, still = matrix(), np.array(COEFFICIENTS[key]), np.zeros(3)
    as_array = lambda x: x.cpu().numpy()[None]
    if key == "kannala_brandt":
        project = lambda p: cv2.fisheye.projectPoints(p, still, still, intrinsics, coefficients)
        unproject = lambda p: cv2.fisheye.undistortPoints(p, intrinsics, coefficients)
    elif key in ("brown_conrady", "pinhole"):
        coefficients = coefficients if coefficients.size else None
        project = lambda p: cv2.projectPoints(p, still, still, intrinsics, coefficients)
        unproject = lambda p: cv2.undistortPoints(p, intrinsics, coefficients)
    else:
        return []
    return [
        Contestant(
            OPENCV,
            Direction(project, as_array, lambda r: torch.from_numpy(r[0].reshape(-1, 2)), None),
            Direction(unproject, as_array, lambda r: on_plane(torch.from_numpy(r.reshape(-1, 2))), None),
        )
    ]


def kornia(key: str, device: torch.device) -> list[Contestant]:
    """kornia's functions, eager, as they are documented."""
    leaf = lambda values: torch.tensor(values, dtype=torch.float32, device=device).requires_grad_()
    ahead = lambda points: points[:, :2] / points[:, 2:]
    if key == "kannala_brandt":
        flat = leaf((*INTRINSICS, *COEFFICIENTS[key]))
        project = lambda x: kannala_brandt.distort_points_kannala_brandt(x, flat)
        unproject = lambda x: kannala_brandt.undistort_points_kannala_brandt(x, flat)
        directions = Direction(project, ahead, learns=(flat,)), Direction(unproject, answer=on_plane, learns=(flat,))
    elif key == "brown_conrady":
        intrinsics, coefficients = leaf(matrix()[None].tolist()), leaf([COEFFICIENTS[key]])
        learns = intrinsics, coefficients
        focal, centre = torch.tensor(INTRINSICS, dtype=torch.float64, device=device).split(2)
        directions = (
            Direction(
                lambda x: calibration.distort_points(x, intrinsics, coefficients),
                # it takes the pixels of a camera without distortion
                lambda points: (ahead(points.double()) * focal + centre).float()[None],
                lambda pixels: pixels[0],
                learns,
            ),
            Direction(
                lambda x: calibration.undistort_points(x, intrinsics, coefficients),
                lambda pixels: pixels[None],
                lambda pixels: on_plane((pixels[0].double() - centre) / focal),
                learns,
            ),
        )
    elif key == "pinhole":
        intrinsics = leaf(matrix().tolist())
        depth = torch.ones((), device=device)
        directions = (
            Direction(lambda x: perspective.project_points(x, intrinsics), learns=(intrinsics,)),
            Direction(
                lambda x: perspective.unproject_points(x, depth.expand(len(x), 1), intrinsics), learns=(intrinsics,)
            ),
        )
    else:
        return []
    return [Contestant(KORNIA, *directions)]


def on_plane(pixels: Tensor) -> Tensor:
    """(N, 3) rays through points of the plane z = 1."""
    return torch.nn.functional.pad(pixels, (0, 1), value=1.0)


def floor(device: torch.device) -> list[Contestant]:
    """What no camera can beat: to move a point's bytes, and one transcendental function."""
    angle = lambda planes: torch.atan2(planes[0], planes[1])
    rows = lambda x: x.T.contiguous()
    copy = Direction(lambda run: run(), lambda x: _cold_copy(len(x), device), learns=None)
    clone, atan2 = Direction(torch.clone, learns=None), Direction(angle, rows, learns=None)
    return [Contestant(name, d, d) for name, d in zip(FLOOR, (copy, clone, atan2), strict=True)]


def _cold_copy(count: int, device: torch.device) -> Callable[[], None]:
    """Copies five planes, the 12 bytes of a point and the 8 of a pixel, between places that go round a large buffer."""
    source, target = _places(5 * count, device)
    turn = 0

    def run() -> None:
        nonlocal turn
        turn = (turn + 1) % len(source)
        target[turn].copy_(source[turn])

    return run


@lru_cache(maxsize=1)
def _places(width: int, device: torch.device) -> Tensor:
    """(2, n, width), written to: memory that is only reserved reads as one page of zeros, which no cache would miss."""
    return torch.ones(2, max(2, -(-_COLD_BYTES // (4 * width))), width, device=device)
