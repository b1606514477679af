"""Operators that compiled graphs call instead of tracing: a warp of images, and sampling positions with a tolerance.

Exported programs know them by the name of this module. Operators take neither flags nor fills, so that options are
`written` as texts, and `is_last` is "True" if channels come last in memory, else "False".
"""

import ast
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.cameras.operators import CameraNumbers, opaque
from camtorch.evaluate.kept import Kept
from camtorch.native.sampler import layout
from camtorch.values.arguments import broadcast_shapes
from camtorch.warp.camera_pair import CameraPair
from camtorch.warp.grid import locate
from camtorch.warp.options import Sampler
from camtorch.warp.sampling import render


def _count(rotation: Tensor | None, *numbers: Tensor) -> int:
    """Return the number of cameras, of rotations (*B, 3, 3) and numbers (*B, n)."""
    shapes = [t.shape[:-1] for t in numbers] + ([] if rotation is None else [rotation.shape[:-2]])
    return math.prod(broadcast_shapes(*shapes))


def _shapes(source: CameraNumbers, target: CameraNumbers, rotation: Tensor | None, *_: Any) -> tuple[Tensor, Tensor]:
    given = [*source[:2], *target[:2]]
    count, size = _count(rotation, *given), target.image_size
    dtype = torch.promote_types(source.intrinsics.dtype, target.intrinsics.dtype)
    dtype = dtype if rotation is None else torch.promote_types(dtype, rotation.dtype)
    planes = source.intrinsics.new_empty(count, 2, *size, dtype=dtype)
    return planes, planes.new_empty(count, *size, dtype=torch.bool)


@opaque(_shapes)
def positions(
    source: Camera, target: Camera, rotation: Tensor | None, tolerance: float, padding: str
) -> tuple[Tensor, Tensor]:
    """Return the positions of all target pixels, planes (B or 1, 2, H', W'), and whether they are mapped."""
    every = range(target.size_for("Warp")[0])
    grid, mapped = locate(CameraPair(source, target, rotation), every, tolerance, padding, False).pixels[:2]
    return grid.movedim(-1, 1).contiguous(), mapped.contiguous()


def warped(
    images: Tensor,
    cameras: CameraPair,
    tolerance: float,
    antialias: bool | None,
    padding: str,
    how: Sampler,
    matrix: Tensor | None = None,
    by: Callable[..., tuple[Tensor, ...]] | None = None,
) -> Tensor:
    """Return warped images (B, C, h, w); an edit passes its `matrix` and, in `by`, its own operator. See `Warp`."""
    source, target, rotation = cameras
    turned = None if rotation is None else rotation.detach()
    options = written(antialias, padding, how)
    is_last = str(layout(images) == torch.channels_last)
    given = (*options, matrix, is_last) if by else (*options, is_last)
    (result,) = (by or _warp)(images.detach(), source, target, turned, float(tolerance), *given)
    return result


def written(antialias: bool | None, padding: str, how: Sampler) -> tuple[str, str, str, str, str]:
    """Return options as texts, in which operators and saved programs have them: no float holds a fill that is an id."""
    return str(antialias), padding, how.mode, how.padding_mode, ",".join(map(repr, how.fill))


def read(antialias: str, padding: str, mode: Any, padding_mode: Any, fill: str) -> tuple[bool | None, str, Sampler]:
    """Return the options of `written` texts."""
    return ast.literal_eval(antialias), padding, Sampler(mode, padding_mode, ast.literal_eval(f"({fill},)"))


def laid(images: Tensor, is_last: str) -> Tensor:
    """Return images with their channels last in memory if `is_last` is "True", else plane by plane."""
    return images.contiguous(memory_format=torch.channels_last if is_last == "True" else torch.contiguous_format)


def warp_shapes(
    images: Tensor, source: CameraNumbers, target: CameraNumbers, rotation: Tensor | None, *options: Any
) -> tuple[Tensor]:
    """Return an empty tensor for an operator's result, of images between cameras of these numbers."""
    count = _count(rotation, *source[:2], *target[:2])
    result = images.new_empty(images.shape[0] if count == 1 else count, images.shape[1], *target.image_size)
    return (laid(result, options[-1]),)


_located = Kept(2)  # masks are warped after their images, and cameras may stay the same


@opaque(warp_shapes)
def _warp(
    images: Tensor, source: Camera, target: Camera, rotation: Tensor | None, tolerance: float, *options: str
) -> tuple[Tensor]:
    """Return images (B, C, h, w); see `warped`."""
    *texts, is_last = options
    antialias, padding, how = read(*texts)
    cameras, every = CameraPair(source, target, rotation), range(target.size_for("Warp")[0])
    found = partial(locate, cameras, every, tolerance, padding, bool(antialias))
    form = source.form, target.form, tolerance, antialias, padding, rotation is None
    where = _located(cameras.tensors, form, found)
    return (laid(render(images, where, how), is_last),)
