"""Pictures at positions: torch's grid_sample for every dtype and every kind of derivative."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch.memory import empty
from camtorch.parameters import in_graph, in_transform, is_concrete

# Between two pixel centres the interpolation is a polynomial; as many nodes determine it
_NODES = {"nearest": (), "bilinear": (0.0, 1.0), "bicubic": (0.0, 1 / 3, 2 / 3, 1.0)}
MODES = tuple(_NODES)
PADDINGS = ("zeros", "border", "reflection")


def sample(images: Tensor, grid: Tensor, mode: str, padding_mode: str) -> Tensor:
    """`grid_sample` with align_corners=False.

    Args:
        images: (B, C, H, W), floating point, integer or bool.
        grid: (B, H', W', 2), normalised positions.
        mode: one of `MODES`.
        padding_mode: one of `PADDINGS`.

    Returns:
        (B, C, H', W') of the dtype of the images. Half precision is sampled in float32; integers are rounded
        and stay in their range, bool is true from one half on.
    """
    dtype = images.dtype
    if not dtype.is_floating_point:
        images, grid = images.detach(), grid.detach()
    plain = images.is_cpu and not any(in_graph(t) for t in (images, grid)) and not in_transform()
    if plain or not dtype.is_floating_point:
        return (_sample_in_parts if plain else _sample_part)(images, grid, mode, padding_mode)
    wide = torch.promote_types(dtype, torch.float32)
    images, grid = images.to(wide), grid.to(wide)
    if torch.compiler.is_compiling():  # which knows no jvp of one's own, nor needs it
        return F.grid_sample(images, grid, mode, padding_mode, align_corners=False).to(dtype)
    return _Sample.apply(images, grid, mode, padding_mode).to(dtype)


def _sample_in_parts(images: Tensor, grid: Tensor, mode: str, padding_mode: str) -> Tensor:
    """As many pictures at a time as there are threads, or rows of one picture: grid_sample has one thread for each.

    What a part needs beside its result, such as uint8 pictures as floats, stays in the cache.
    """
    (count, channels), (height, width), threads = images.shape[:2], grid.shape[1:3], torch.get_num_threads()
    result = empty((count, channels, height, width), images)
    whole = count // threads * threads
    for start in range(0, whole, threads):
        part = slice(start, start + threads)
        result[part] = _sample_part(images[part], grid[part], mode, padding_mode)
    tile = max(height // threads, 1)
    rows = tile * (height // tile)
    for i in range(whole, count):
        tiles = grid[i, :rows].unflatten(0, (-1, tile))
        sampled = _sample_part(images[i].expand(len(tiles), -1, -1, -1), tiles, mode, padding_mode)
        result[i, :, :rows].unflatten(1, (-1, tile)).copy_(sampled.movedim(0, 1))
        if rows < height:
            result[i, :, rows:] = _sample_part(images[i : i + 1], grid[i : i + 1, rows:], mode, padding_mode)[0]
    return result


def _sample_part(images: Tensor, grid: Tensor, mode: str, padding_mode: str) -> Tensor:
    dtype = images.dtype
    # wide enough that every value, a class id too, is exact
    wide = torch.float64 if not dtype.is_floating_point and dtype.itemsize > 2 else torch.float32
    images = images.to(torch.promote_types(dtype, wide) if dtype.is_floating_point else wide)
    result = F.grid_sample(images, grid.to(images.dtype), mode, padding_mode, align_corners=False)
    if dtype == torch.bool:
        return result >= 0.5
    if not dtype.is_floating_point:
        low, high = torch.iinfo(dtype).min, torch.iinfo(dtype).max
        # the largest int64 is no float64: the next one would wrap around
        high = high if int(float(high)) == high else math.nextafter(float(high), 0.0)
        result = result.round().clamp(low, high)
    return result.to(dtype)


class _Sample(torch.autograd.Function):
    """grid_sample with the forward-mode derivative that torch does not have."""

    generate_vmap_rule = True

    @staticmethod
    def forward(images, grid, mode, padding_mode):
        if images.is_cpu and is_concrete(images) and is_concrete(grid):
            return _sample_in_parts(images, grid, mode, padding_mode)
        return F.grid_sample(images, grid, mode, padding_mode, align_corners=False)

    @staticmethod
    def setup_context(ctx, inputs, output):
        images, grid, ctx.mode, ctx.padding_mode = inputs
        ctx.save_for_backward(images, grid)
        ctx.save_for_forward(images, grid)

    @staticmethod
    def backward(ctx, gradient):
        images, grid = ctx.saved_tensors
        by_images, by_grid = torch.ops.aten.grid_sampler_2d_backward(
            gradient,
            images,
            grid,
            {"bilinear": 0, "nearest": 1, "bicubic": 2}[ctx.mode],
            PADDINGS.index(ctx.padding_mode),
            False,
            ctx.needs_input_grad[:2],
        )
        return by_images, by_grid, None, None

    @staticmethod
    def jvp(ctx, images_tangent, grid_tangent, *_):
        images, grid = ctx.saved_tensors
        tangent = F.grid_sample(images_tangent, grid, ctx.mode, ctx.padding_mode, align_corners=False)
        nodes = _NODES[ctx.mode]
        for axis in (0, 1):
            size = images.shape[3 - axis]
            position = ((grid[..., axis] + 1) * size - 1) / 2
            cell = position.floor()
            weights = _derivative_weights(nodes, position - cell)
            for node, weight in zip(nodes, weights, strict=True):
                moved = (2 * (cell + node) + 1) / size - 1
                at_node = torch.stack((moved, grid[..., 1]) if axis == 0 else (grid[..., 0], moved), -1)
                value = F.grid_sample(images, at_node, ctx.mode, ctx.padding_mode, align_corners=False)
                tangent = tangent + value * (weight * grid_tangent[..., axis] * (size / 2)).unsqueeze(1)
        return tangent


def _derivative_weights(nodes: tuple[float, ...], t: Tensor) -> list[Tensor]:
    """The derivative at t of the Lagrange polynomial of each node."""
    weights = []
    for i, node in enumerate(nodes):
        others = [n for j, n in enumerate(nodes) if j != i]
        scale = 1.0
        for n in others:
            scale *= node - n
        total = torch.zeros_like(t)
        for left_out in range(len(others)):
            term = torch.ones_like(t)
            for j, n in enumerate(others):
                if j != left_out:
                    term = term * (t - n)
            total = total + term
        weights.append(total / scale)
    return weights
