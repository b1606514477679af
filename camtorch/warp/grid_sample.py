"""torch's `grid_sample` with every derivative, by native code where that samples alike."""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch.evaluate.door import in_transform, is_eager
from camtorch.evaluate.tensors import are_concrete, are_plain
from camtorch.native import sampler
from camtorch.native.library import native_available, warn_if_missing
from camtorch.warp.options import PADDINGS, Mode, PaddingMode


def is_sampled_natively(images: Tensor, positions: Tensor, mode: Mode) -> bool:
    """Whether native code samples images at positions: not with a graph, a transform, another device or dtype."""
    if not is_eager(images, positions):
        return False
    if not (native_available() and sampler.takes(images.dtype, mode)):
        warn_if_missing()
        return False
    learns = images.requires_grad or (positions.requires_grad and images.dtype.is_floating_point)
    return not learns and positions.dtype in (torch.float32, torch.float64)


def sample(images: Tensor, grid: Tensor, mode: Mode, padding_mode: PaddingMode) -> Tensor:
    """Return `grid_sample` with align_corners=False of images (B, C, H, W) at a grid (B or 1, H', W', 2).

    On a CPU an infinite or NaN pixel spoils only bicubic samples that weight it.
    """
    grid = grid.to(images.dtype)
    if not (isinstance(images.shape[0], int) and len(grid) == len(images)):  # comparing would fix open sizes
        grid = grid.expand(images.shape[0], -1, -1, -1)
    if torch.compiler.is_compiling():  # torch.compile knows no jvp of our own, and needs none
        return _grid_sample(images, grid, mode, padding_mode)
    if are_plain(images, grid):
        return _on_cpu(images, grid, mode, padding_mode)
    result: Tensor = _WithForwardMode.apply(images, grid, mode, padding_mode)  # type: ignore[no-untyped-call]
    return result


def _grid_sample(images: Tensor, grid: Tensor, mode: Mode, padding_mode: PaddingMode) -> Tensor:
    """Return torch's samples of images (B, C, H, W) at a grid (B, H', W', 2)."""
    return F.grid_sample(images, grid, mode, padding_mode, align_corners=False)


def _on_cpu(images: Tensor, grid: Tensor, mode: Mode, padding_mode: PaddingMode) -> Tensor:
    """Sample on a CPU with work for every thread; grid_sample gives one thread to each image."""
    if padding_mode == "zeros" and is_sampled_natively(images, grid, mode):
        at = grid[:1] if grid.stride(0) == 0 else grid
        call = sampler.NativeJob(
            images, (grid.shape[1], grid.shape[2]), mode, "zeros", [0.0] * images.shape[1], grid=at
        )
        return call(images)
    threads = torch.get_num_threads()
    if len(images) >= threads:
        result = _grid_sample(images, grid, mode, padding_mode)
    else:
        result = images.new_empty(*images.shape[:2], *grid.shape[1:3])
        height = grid.shape[1] // threads  # of a tile; then come the rows that are left over
        tiles = threads * height
        for made, image, places in zip(result, images, grid, strict=True):
            if tiles:
                parts, same = places[:tiles].unflatten(0, (threads, height)), image.expand(threads, *image.shape)
                sampled = _grid_sample(same, parts, mode, padding_mode)
                made[:, :tiles].unflatten(1, (threads, height)).copy_(sampled.movedim(0, 1))
            if tiles < len(places):
                rest = _grid_sample(image[None], places[None, tiles:], mode, padding_mode)
                made[:, tiles:] = rest[0]
    if mode == "bicubic" and not math.isfinite(result.sum()):
        # where the bicubic result is not finite, pixels without a weight, but for rounding, lose their part in it
        b, y, x = (~torch.isfinite(result)).any(1).nonzero(as_tuple=True)
        height, width = images.shape[-2:]
        columns, rows = (
            _taps(position, side, padding_mode)
            for position, side in zip(grid[b, y, x].unbind(-1), (width, height), strict=True)
        )
        total = result.new_zeros(len(b), result.shape[1])
        for j, by_row in rows:
            for i, by_column in columns:
                weight = (by_row * by_column).unsqueeze(-1)
                total += torch.where(weight != 0, weight * images[b, :, j, i], 0)
        result[b, :, y, x] = total
    return result


class _WithForwardMode(torch.autograd.Function):
    """grid_sample with the forward-mode derivative that torch does not have."""

    generate_vmap_rule = True

    @staticmethod
    def forward(images: Tensor, grid: Tensor, mode: Mode, padding_mode: PaddingMode) -> Tensor:
        if images.is_cpu and are_concrete(images, grid):
            return _on_cpu(images.detach(), grid.detach(), mode, padding_mode)  # native code takes no graph
        return _grid_sample(images, grid, mode, padding_mode)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        images, grid, ctx.mode, ctx.padding_mode = inputs
        ctx.save_for_backward(images, grid)
        ctx.save_for_forward(images, grid)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        images, grid = ctx.saved_tensors
        wanted = (True, True) if in_transform() else ctx.needs_input_grad[:2]  # torch 2.10 maps over both alone
        return *_backward(gradient, images, grid, ctx, wanted), None, None

    @staticmethod
    def jvp(ctx: Any, images_tangent: Tensor, grid_tangent: Tensor, *_: Any) -> Tensor:
        images, grid = ctx.saved_tensors
        count, channels = images.shape[:2]
        tangent = _grid_sample(images_tangent, grid, ctx.mode, ctx.padding_mode)
        # a channel alone, so that its gradient by the positions is not added to that of others
        alone, at = images.flatten(0, 1).unsqueeze(1), grid.repeat_interleave(channels, 0)
        ones = torch.ones_like(tangent).flatten(0, 1).unsqueeze(1)
        slopes = _backward(ones, alone, at, ctx, (True, True))[1].unflatten(0, (count, channels))
        moved: Tensor = tangent + (slopes * grid_tangent.unsqueeze(1)).sum(-1)
        return moved


def _backward(gradient: Tensor, images: Tensor, grid: Tensor, ctx: Any, wanted: tuple[bool, ...]) -> tuple[Tensor, ...]:
    """Return the derivatives of grid_sample by images and positions."""
    mode, padding = sampler.MODES[ctx.mode].code_of_torch, PADDINGS.index(ctx.padding_mode)
    derivatives: tuple[Tensor, ...] = torch.ops.aten.grid_sampler_2d_backward(
        gradient, images, grid, mode, padding, False, wanted
    )
    return derivatives


def _taps(position: Tensor, side: int, padding_mode: PaddingMode) -> list[tuple[Tensor, Tensor]]:
    """Return the four pixels (K,) along an axis at positions (K,), and their weights (Keys, 1981, with a = -3/4)."""
    u = ((position + 1) * side - 1) / 2
    cell = u.floor()
    t = u - cell

    def near(d: Tensor) -> Tensor:
        return (1.25 * d - 2.25) * d * d + 1

    def far(d: Tensor) -> Tensor:
        return ((-0.75 * d + 3.75) * d - 6) * d + 3

    lost = 4 * side * torch.finfo(u.dtype).eps  # in rounding the position
    taps = []
    for k, weight in enumerate((far(t + 1), near(t), near(1 - t), far(2 - t)), start=-1):
        pixel = padded(cell + k, side, padding_mode)
        known = (pixel >= 0) & (pixel <= side - 1) & (weight.abs() > lost)
        taps.append((pixel.clamp(0, side - 1).long(), torch.where(known, weight, 0)))
    return taps


def padded(u: Tensor, side: int, padding_mode: PaddingMode) -> Tensor:
    """Return pixel coordinates, those off the image repeated or reflected; "zeros" leaves them."""
    if padding_mode == "zeros":
        return u
    if padding_mode == "reflection":
        u = (u + 0.5).remainder(2 * side) - 0.5
        u = torch.minimum(u, 2 * side - 1 - u)
    return u.clamp(0, side - 1)
