"""Operators that compiled graphs call instead of tracing: a warp of images, and sampling positions with a tolerance.

Exported programs know them by the name of this module.
"""

from __future__ import annotations

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
    grid, mapped = locate(source, target, rotation, tolerance, False, every, padding).pixels[:2]
    return grid.movedim(-1, 1).contiguous(), mapped.contiguous()


def warped(
    images: Tensor,
    source: Camera,
    target: Camera,
    rotation: Tensor | None,
    tolerance: float,
    antialias: bool | None,
    padding: str,
    how: Sampler,
    matrix: Tensor | None = None,
    by: Callable[..., tuple[Tensor, ...]] | None = None,
) -> Tensor:
    """Return warped images (B, C, h, w); an edit passes its `matrix` and, in `by`, its own operator. See `Warp`."""
    turned = None if rotation is None else rotation.detach()
    # numbers travel as strings: a fill may be an id, which no float holds
    options = str(antialias), padding, how.mode, how.padding_mode, ",".join(map(repr, how.fill))
    is_last = str(layout(images) == torch.channels_last)
    given = (*options, matrix, is_last) if by else (*options, is_last)
    (result,) = (by or _warp)(images.detach(), source, target, turned, float(tolerance), *given)
    return result


def laid(images: Tensor, is_last: str) -> Tensor:
    """Return images with their channels last in memory, or plane by plane."""
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
    """Return images (B, C, h, w), plane by plane or with their channels last in memory; see `warped`."""
    antialias, padding, mode, padding_mode, fill, is_last = options

    every = range(target.size_for("Warp")[0])
    found = partial(locate, source, target, rotation, tolerance, antialias == "True", every, padding)
    inputs = [*source.tensors, *target.tensors, *([] if rotation is None else [rotation])]
    where = _located(inputs, (source.form, target.form, tolerance, antialias, padding, rotation is None), found)
    how: tuple[Any, Any] = mode, padding_mode
    values = tuple(ast.literal_eval(f"({fill},)"))
    return (laid(render(images, where, *how, values), is_last),)
