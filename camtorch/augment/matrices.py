"""Pinhole cameras of samples without a camera: of a matrix K among their fields, or guessed for images of any size."""

from __future__ import annotations

import functools
import logging
import numbers
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NoReturn

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.cameras.image_sizes import off_centre, warn_of_order, warn_of_size
from camtorch.cameras.mixed import Mixed
from camtorch.evaluate.tensors import known_false, known_some
from camtorch.models import Pinhole
from camtorch.values.arguments import check_degrees, first_time
from camtorch.values.dtypes import widen
from camtorch.warp.views import pinhole

if TYPE_CHECKING:
    from camtorch.augment.change import Change

NAMES = "K", "intrinsics", "camera_matrix"
SHAPE = "(B, 3, 3) or (B, 4, 4), [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] of the image"
SIDES = (3, 3), (4, 4)
_SKEW = 1e-6  # parts of the focal length: a skew up to there is none
_ALIKE = 1e-5  # relative: matrices that were float32 on the way are the same ones
_log = logging.getLogger(__name__)


class Guess(float):
    """A number given as camera=: degrees across of the pinhole that stands in for the unknown camera of photographs."""

    @classmethod
    def instead(cls, camera: Any, owner: str) -> Any:
        """Return a number as a `Guess`, and all else as it is."""
        if not isinstance(camera, numbers.Real) or isinstance(camera, (bool, Guess)):
            return camera
        degrees = float(camera)
        if not 0 < degrees < 180:
            raise ValueError(
                f"{owner}: camera must be a Camera, or degrees across of a guessed pinhole, above 0 and below 180; "
                f"got {camera!r}"
            )
        check_degrees(degrees, camera, owner)
        return cls(degrees)

    def pinhole_for(self, size: tuple[int, int]) -> Pinhole:
        """Return the camera of images of a size (height, width), one for all of them."""
        known = _guessed.__wrapped__ if torch.compiler.is_compiling() else _guessed
        return known(float(self), (int(size[0]), int(size[1])))


@functools.lru_cache(256)
def _guessed(degrees: float, size: tuple[int, int]) -> Pinhole:
    if not torch.compiler.is_compiling() and first_time("cameras are guessed"):
        _log.info(
            "cameras are guessed: images without one are taken for those of a pinhole of the degrees given as camera=. "
            "Positions in images move as they look; directions and poses are as right as the guess"
        )
    with torch.inference_mode(False), torch.no_grad():  # it may be used in a graph later
        return Pinhole.from_fov(degrees, image_size=size).requires_grad_(False)


def matrix_hint(value: Tensor, name: str, batched: bool) -> str:
    """Return what to do about a wrong shape of a matrix K."""
    if value.shape[-2:] in SIDES and batched and value.ndim == 2:
        return f"One that all samples share goes in as {name}.expand(B, -1, -1)"
    if value.shape[-2:] == (3, 4):
        return f"Of [K | 0] pass K, {name}[..., :3]"
    if value.shape[-1:] == (4,):
        return "Numbers fx, fy, cx, cy go in as camera=ct.Pinhole(numbers, image_size=(height, width))"
    return f"If it is something else, fields={{{name!r}: 'keep'}} keeps it unchanged"


def check_matrix(value: Tensor, name: str, owner: str) -> None:
    """Raise a ValueError if matrices (..., 3, 3) or (..., 4, 4) are not those of pinhole cameras without skew."""
    matrix = value.detach()
    wanted = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    wanted[:2, :3] = matrix.new_tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    free = torch.zeros_like(wanted, dtype=torch.bool)
    free[0, 0] = free[1, 1] = free[0, 2] = free[1, 2] = True
    free[3:, 3:] = True
    as_wanted = matrix == wanted
    for row, column in ((0, 1), (1, 0)):  # which rounding may leave of a product of matrices
        as_wanted[..., row, column] |= matrix[..., row, column].abs() <= _SKEW * matrix[..., 0, 0]
    wrong = ~(torch.where(free, torch.isfinite(matrix), as_wanted).flatten(-2).all(-1))
    wrong = wrong | (matrix[..., 0, 0] <= 0) | (matrix[..., 1, 1] <= 0)
    if known_some(wrong):
        one = matrix.reshape(-1, *matrix.shape[-2:])[wrong.reshape(-1)][0].tolist()
        raise ValueError(
            f"{owner}: {name} must be {SHAPE}, with fx, fy above 0 and no skew; got {one}. Leave one unchanged with "
            f"fields={{{name!r}: 'keep'}}, and give the camera of the images as camera="
        )


def numbers_of(matrix: Tensor) -> Tensor:
    """Return fx, fy, cx, cy (..., 4) of matrices."""
    wide = widen(matrix)
    return torch.stack((wide[..., 0, 0], wide[..., 1, 1], wide[..., 0, 2], wide[..., 1, 2]), -1)


def pinhole_of_matrix(name: str, matrix: Tensor | list[Tensor], size: tuple[int, int], owner: str) -> Pinhole:
    """Return the camera of images of a size (height, width) with a matrix, a batch or a list; gradients reach it."""
    rows = matrix if isinstance(matrix, list) else [matrix]
    for row in rows:
        if row.shape[-2:] not in SIDES or row.ndim > 3 - isinstance(matrix, list):
            raise ValueError(
                f"{owner}: {name} must be {SHAPE}; got shape {tuple(row.shape)}. {matrix_hint(row, name, False)}"
            )
        check_matrix(row, name, owner)
    intrinsics = torch.stack([numbers_of(row) for row in rows]) if isinstance(matrix, list) else numbers_of(matrix)
    off = off_centre(intrinsics, size)
    if off and first_time(("matrix of another image", owner)):
        warn_of_order(off, size, owner)
        warn_of_size(off, size, owner)
    return pinhole(intrinsics, size)


def check_agrees(name: str, matrix: Tensor | list[Tensor], camera: Camera, of: str, owner: str) -> None:
    """Raise a ValueError if matrices are not those of the `camera` beside them.

    of: whose camera it is, in words.
    """
    kinds = [one for _, one in camera.groups] if isinstance(camera, Mixed) else [camera]
    lens = next((one for one in kinds if not isinstance(one, Pinhole)), None)
    agrees = lens is None
    if agrees and len(matrix):
        ours = numbers_of(matrix) if isinstance(matrix, Tensor) else torch.stack([numbers_of(row) for row in matrix])
        near = max(_ALIKE, 2 * torch.finfo(matrix[0].dtype).eps)
        theirs = camera.intrinsics.detach().to(ours)
        agrees = not known_false(torch.isclose(ours.detach(), theirs, near, _ALIKE))
    if not agrees:
        kind = "a Pinhole of other numbers" if lens is None else f"a {type(lens).__name__}, which is more than a matrix"
        raise ValueError(
            f"{owner}: {name} must be the camera of the image, and agree with another one; got {of}, {kind}. Leave one "
            f"of both out, or keep the matrix unchanged with fields={{{name!r}: 'keep'}}"
        )


def check_alike(name: str, matrix: Tensor, owner: str) -> None:
    """Raise a ValueError if matrices (B, T, 3, 3) differ between the frames of a clip, which share a camera."""
    if known_false(matrix == matrix[:, :1]):
        raise ValueError(
            f"{owner}: {name} must be the same in all frames of a clip, (B, 3, 3) or (B, T, 3, 3); got others. Frames "
            "of several cameras go in as a batch: all fields by .flatten(0, 1)"
        )


def refuse(name: str, owner: str, kind: str = "lens of another kind") -> NoReturn:
    """Raise the ValueError of a new camera that has no matrix K."""
    raise ValueError(
        f"{owner}: {name} must be the camera of the new image, and only pinhole cameras have one; got a {kind}. Give "
        f"camera=ct.Pinhole.from_matrix({name}, image_size=(height, width)) instead, and take 'camera' of the result, "
        f"or keep the matrix unchanged with fields={{{name!r}: 'keep'}}"
    )


def check_targets(fields: Mapping[str, str], change: Change, owner: str) -> None:
    """Raise a ValueError if samples with a field K come to a lens without one."""
    lens = next((part.target for part in change.parts if not isinstance(part.target, Pinhole)), None)
    if lens is not None:
        refuse(next(name for name, kind in fields.items() if kind == "K"), owner, type(lens).__name__)


def moved_matrix(change: Change, matrix: Tensor, options: Mapping[str, float]) -> Tensor:
    """Return the matrices (B, 3, 3) or (B, 4, 4) of the cameras after a change; the other entries stay."""
    result = widen(matrix).clone()
    new = change.target.intrinsics.to(result)
    for i, (row, column) in enumerate(((0, 0), (1, 1), (0, 2), (1, 2))):
        result[..., row, column] = new[..., i]
    return result
