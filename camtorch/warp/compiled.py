"""What compiled code calls instead of tracing it: the positions of a warp with a tolerance, as one operator."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from camtorch._arguments import broadcast_shapes
from camtorch.camera import Camera, from_values
from camtorch.warp.grid import tabulate


def positions(source: Camera, target: Camera, rotation: Tensor | None, tolerance: float) -> tuple[Tensor, Tensor]:
    """`grid.tabulate` of all pixels, between cameras that do not learn."""
    cameras = [n for c in (source, target) for n in (c._model, c.intrinsics, c.distortion)]
    sizes = [side for camera in (source, target) for side in camera._size("Warp")]
    planes, mapped = _positions(*cameras, rotation, sizes, tolerance)
    return planes.movedim(1, -1), mapped


@torch.library.custom_op("camtorch::positions", mutates_args=())
def _positions(
    source_model: str,
    source_intrinsics: Tensor,
    source_distortion: Tensor,
    target_model: str,
    target_intrinsics: Tensor,
    target_distortion: Tensor,
    rotation: Tensor | None,
    sizes: Sequence[int],
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """The positions: planes (B or 1, 2, H', W'), and (B or 1, H', W') bool."""
    source = from_values(source_model, source_intrinsics, source_distortion, sizes[:2])
    target = from_values(target_model, target_intrinsics, target_distortion, sizes[2:])
    grid, mapped = tabulate(source, target, rotation, tolerance)
    return grid.movedim(-1, 1).contiguous(), mapped.contiguous()


@_positions.register_fake
def _(_, source, source_distortion, __, target, target_distortion, rotation, sizes, tolerance):
    shapes = [t.shape[:-1] for t in (source, source_distortion, target, target_distortion)]
    shapes += [] if rotation is None else [rotation.shape[:-2]]
    count = math.prod(broadcast_shapes(*shapes))
    dtype = torch.promote_types(source.dtype, target.dtype)
    dtype = dtype if rotation is None else torch.promote_types(dtype, rotation.dtype)
    planes = source.new_empty(count, 2, *sizes[2:], dtype=dtype)
    return planes, source.new_empty(count, *sizes[2:], dtype=torch.bool)
