"""Images at positions: torch's grid_sample for every dtype and every kind of derivative."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch._tracing import in_graph, in_transform, is_concrete

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


def as_options(owner: str, mode: str, padding_mode: str, fill, antialias: bool, tolerance: float) -> dict:
    """The checked options of a `Warp`, by name.

    Raises:
        ValueError: a mode that does not exist, a fill or a tolerance that is none. TypeError: a fill that is no number.
    """
    if not 0 <= tolerance < math.inf:
        raise ValueError(f"{owner}: tolerance must be a number of pixels, zero or more; got {tolerance!r}")
    return {
        "mode": one_of(mode, MODES, "mode", owner),
        "padding_mode": one_of(padding_mode, PADDINGS, "padding_mode", owner),
        "fill": as_fill(fill, owner),
        "antialias": bool(antialias),
        "tolerance": float(tolerance),
    }


def one_of(value: str, allowed: tuple[str, ...], name: str, owner: str) -> str:
    """The value, if it is allowed."""
    if value not in allowed:
        raise ValueError(f"{owner}: {name} must be one of {allowed}; got {value!r}")
    return value


def as_fill(fill, owner: str) -> tuple[float, ...]:
    """One value or one for each channel, as a tuple."""
    try:
        values = tuple(map(float, fill)) if isinstance(fill, Iterable) else (float(fill),)
    except (TypeError, ValueError):
        raise TypeError(f"{owner}: fill must be a number or one for each channel; got {fill!r}") from None
    if not values or not all(map(math.isfinite, values)):
        raise ValueError(f"{owner}: fill must be finite; got {fill!r}")
    return values


def coverage(images: Tensor, grid: Tensor, mode: str) -> Tensor:
    """(B, 1, H', W'): what part of a sample comes from the image, and not from the zeros around it."""
    return sample(torch.ones_like(images[:1, :1]).expand(len(grid), -1, -1, -1), grid, mode, "zeros")


def _sample_in_parts(images: Tensor, grid: Tensor, mode: str, padding_mode: str) -> Tensor:
    """`_sample_part` with work for every thread, of which grid_sample gives one to each image.

    Images that need another dtype go in parts, so that their copies stay in the cache; a part of fewer images than
    threads goes image by image, in tiles of rows.
    """
    threads = torch.get_num_threads()
    step = len(images) if images.dtype in (torch.float32, torch.float64) and len(images) >= threads else threads
    if step == len(images):
        return _sample_part(images, grid, mode, padding_mode)
    result = images.new_empty(*images.shape[:2], *grid.shape[1:3])
    for parts in zip(*(t.split(step) for t in (result, images, grid)), strict=True):
        if len(parts[0]) == step:
            parts[0].copy_(_sample_part(*parts[1:], mode, padding_mode))
        else:
            for image in zip(*parts, strict=True):
                _sample_tiles(*image, threads, mode, padding_mode)
    return result


def _sample_tiles(result: Tensor, image: Tensor, grid: Tensor, count: int, mode: str, padding_mode: str) -> None:
    """One image (C, H, W) by tiles of rows that share it, and what rows are left over."""
    height = len(grid) // count
    tiles = count * height
    if tiles:
        images = image.expand(count, *image.shape)
        sampled = _sample_part(images, grid[:tiles].unflatten(0, (count, height)), mode, padding_mode)
        result[:, :tiles].unflatten(1, (count, height)).copy_(sampled.movedim(0, 1))
    if tiles < len(grid):
        result[:, tiles:] = _sample_part(image.unsqueeze(0), grid[tiles:].unsqueeze(0), mode, padding_mode)[0]


def _sample_part(images: Tensor, grid: Tensor, mode: str, padding_mode: str) -> Tensor:
    dtype = images.dtype
    images = widen(images)
    return narrow(F.grid_sample(images, grid.to(images.dtype), mode, padding_mode, align_corners=False), dtype)


def widen(images: Tensor) -> Tensor:
    """In a floating-point dtype in which every value, a class id too, is exact."""
    wide = torch.float64 if not images.is_floating_point() and images.dtype.itemsize > 2 else torch.float32
    return images.to(torch.promote_types(images.dtype, wide) if images.is_floating_point() else wide)


def narrow(values: Tensor, dtype: torch.dtype) -> Tensor:
    """What `widen` gave, back in its dtype: integers are rounded and stay in range, bool is true from one half on."""
    if dtype == torch.bool and values.is_floating_point():
        return values >= 0.5
    if not dtype.is_floating_point and values.is_floating_point():
        low, high = torch.iinfo(dtype).min, torch.iinfo(dtype).max
        # the largest int64 is no float64: the next one would wrap around
        high = high if int(float(high)) == high else math.nextafter(float(high), 0.0)
        values = values.round().clamp(low, high)
    return values.to(dtype)


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
