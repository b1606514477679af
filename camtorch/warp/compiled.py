"""What compiled code calls instead of tracing it: a warp of images, and the positions of one with a tolerance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from camtorch._arguments import broadcast_shapes
from camtorch._module import Memo
from camtorch._opaque import CameraNumbers, opaque
from camtorch._registry import CLASSES
from camtorch.camera import Camera, fixed_camera
from camtorch.native.sampler import layout
from camtorch.warp.grid import Lattice, Sampling, locate, tabulate
from camtorch.warp.sampling import MODES, PADDINGS, Mode, PaddingMode, one_of, render


def positions(
    source: Camera, target: Camera, rotation: Tensor | None, tolerance: float, padding: str
) -> tuple[Tensor, Tensor]:
    """`grid.tabulate` of all pixels, between cameras that do not learn."""
    planes, mapped = _positions(source, target, rotation, tolerance, padding)
    return planes.movedim(1, -1), mapped


def _count(rotation: Tensor | None, *numbers: Tensor) -> int:
    """How many cameras there are, of rotations (*B, 3, 3) and numbers (*B, n)."""
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
def _positions(
    source: Camera, target: Camera, rotation: Tensor | None, tolerance: float, padding: str
) -> tuple[Tensor, Tensor]:
    """The positions: planes (B or 1, 2, H', W'), and (B or 1, H', W') bool."""
    grid, mapped = tabulate(source, target, rotation, tolerance, padding=padding)
    return grid.movedim(-1, 1).contiguous(), mapped.contiguous()


# -- images


def takes(images: Tensor, inputs: Sequence[Tensor]) -> bool:
    """Whether the operator makes the images of compiled code: on the CPU and without a graph.

    Args:
        images: of the source.
        inputs: all that the positions depend on.
    """
    return all(t.is_cpu and not (t.requires_grad and torch.is_grad_enabled()) for t in (images, *inputs))


def warped(
    images: Tensor,
    source: Camera,
    target: Camera,
    rotation: Tensor | None,
    tolerance: float,
    antialias: bool,
    padding: str,
    mode: Mode,
    padding_mode: PaddingMode,
    fill: tuple[float, ...],
) -> Tensor:
    """The images (B, C, h, w) of a warp; arguments as of `Warp`, and the padding of `on_lattice`."""
    cameras = [n for c in (source, target) for n in (c._model, c.intrinsics.detach(), c.distortion.detach())]
    sizes = [side for camera in (source, target) for side in camera._size_for("Warp")]
    last = layout(images) == torch.channels_last
    options = tolerance, antialias, padding, mode, padding_mode, list(fill), last
    turned = None if rotation is None else rotation.detach()
    result: Tensor = _warp(images.detach(), *cameras, turned, sizes, *options)
    return result


def _layout(channels_last: bool) -> torch.memory_format:
    return torch.channels_last if channels_last else torch.contiguous_format


_located = Memo(2)  # masks are warped after their images, and cameras may be still


@torch.library.custom_op("camtorch::warp", mutates_args=())
def _warp(
    images: Tensor,
    source_model: str,
    source_intrinsics: Tensor,
    source_distortion: Tensor,
    target_model: str,
    target_intrinsics: Tensor,
    target_distortion: Tensor,
    rotation: Tensor | None,
    sizes: Sequence[int],
    tolerance: float,
    antialias: bool,
    padding: str,
    mode: str,
    padding_mode: str,
    fill: Sequence[int | float | bool],
    channels_last: bool,
) -> Tensor:
    """The images (B, C, h, w), plane by plane or with their channels last in memory."""
    numbers = source_intrinsics, source_distortion, target_intrinsics, target_distortion

    def positions() -> Sampling | Lattice:
        source = fixed_camera(CLASSES[source_model], *numbers[:2], sizes[:2])
        target = fixed_camera(CLASSES[target_model], *numbers[2:], sizes[2:])
        return locate(source, target, rotation, tolerance, antialias, range(sizes[2]), padding)

    inputs = [*numbers] if rotation is None else [*numbers, rotation]
    what = source_model, target_model, tuple(sizes), tolerance, antialias, padding, rotation is None
    where = _located(inputs, what, positions)
    options = one_of(mode, MODES, "mode", "Warp"), one_of(padding_mode, PADDINGS, "padding_mode", "Warp"), tuple(fill)
    return render(images, where, *options).contiguous(memory_format=_layout(channels_last))


@_warp.register_fake
def _(
    images: Tensor,
    _: str,
    source: Tensor,
    source_distortion: Tensor,
    __: str,
    target: Tensor,
    target_distortion: Tensor,
    rotation: Tensor | None,
    sizes: Sequence[int],
    *options: Any,
) -> Tensor:
    count = _count(rotation, source, source_distortion, target, target_distortion)
    result = images.new_empty(images.shape[0] if count == 1 else count, images.shape[1], *sizes[2:])
    return result.contiguous(memory_format=_layout(options[-1]))


@_warp.register_vmap
def _(info: Any, in_dims: tuple[Any, ...], *arguments: Any) -> tuple[Tensor, int]:
    dims = (*in_dims, *[None] * (len(arguments) - len(in_dims)))
    rows = (
        [a if not isinstance(dim, int) else a.select(dim, i) for a, dim in zip(arguments, dims, strict=True)]
        for i in range(info.batch_size)
    )
    return torch.stack([_warp(*row) for row in rows]), 0
