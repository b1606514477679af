"""Images at positions: torch's grid_sample for every dtype and derivative, filled, antialiased, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias, TypedDict, get_args

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch.evaluate.door import converted, in_transform, is_eager, may_look
from camtorch.evaluate.tensors import are_known, are_plain
from camtorch.native import memory, sampler
from camtorch.native.library import native_available, warn_if_missing
from camtorch.values.arguments import as_flag, as_number, one_of, shown
from camtorch.values.dtypes import SIGNED, as_pixels, narrow, wide_dtype, widen
from camtorch.values.threads import thread_count
from camtorch.warp.lattice import Lattice, PixelPositions

Mode: TypeAlias = sampler.Mode
PaddingMode = Literal["zeros", "border", "reflection"]
Fill = float | Sequence[float]
MODES = tuple(sampler.MODES)
PADDINGS: tuple[PaddingMode, ...] = get_args(PaddingMode)

SHRINKS = 1.5  # pixels of the image to one of the result, from which on edits antialias by themselves
SURELY = 0.999  # of that: images that shrink less do not antialias, whatever rounding does
_LARGE = 1 << 23  # numbers in an image whose copy in float32 leaves every cache
_STRIP = 1 << 17  # numbers of a result in float32 that are made at a time
_TILE = 512  # pixels along the sides of what is then sampled at a time
_TRACED_LEVELS = 4  # if the values that decide cannot be read: down to a sixteenth


class Sampler(NamedTuple):
    """How the images of one call are sampled."""

    mode: Mode
    padding_mode: PaddingMode
    fill: tuple[float, ...]


def render(
    images: Tensor,
    where: PixelPositions | Lattice,
    mode: Mode,
    padding_mode: PaddingMode,
    fill: tuple[float, ...],
    kept: dict[int, Pyramid] | None = None,
    out: Tensor | None = None,
) -> Tensor:
    """Return the images (B, C, h, W') that a warp makes of (B or 1, C, H, W), in their dtype.

    Half precision is sampled in float32; integers are rounded and stay in their range, bool is true from one half on.
    Images that are computed in another dtype are copied in parts. `kept` holds halves of the images for the next call,
    and `out` takes a result without a graph.
    """
    how = Sampler(mode, padding_mode, fill)
    call = prepared(images, where, how, out)
    return by_torch(images, where, how, kept, out) if call is None else call(images, out)


def laid_as(images: Tensor, result: Tensor) -> Tensor:
    """Return the result with its channels last in memory if the images have them there."""
    if in_transform() or sampler.layout(images) == torch.contiguous_format:
        return result
    return result.contiguous(memory_format=torch.channels_last)


def prepared(
    images: Tensor, where: PixelPositions | Lattice, how: Sampler, out: Tensor | None = None
) -> sampler.Call | None:
    """Return the call of native code for images (B or 1, C, H, W) of this form, of which results lie like `out`.

    None with a graph, a transform, another device or dtype, or antialiasing.
    """
    mode, padding_mode, fill = how
    positions = where.like
    if not is_eager(images, positions):
        return None
    if not (native_available() and sampler.takes(images.dtype, mode)):
        warn_if_missing()
        return None
    if images.requires_grad or (positions.requires_grad and images.dtype.is_floating_point):
        return None
    if positions.dtype not in (torch.float32, torch.float64) or (where.scale is not None and mode != "nearest"):
        return None
    fill = fill * images.shape[1] if len(fill) == 1 else fill
    cameras = positions.shape[0]
    images = images if cameras == 1 else images.expand(cameras, -1, -1, -1)
    return sampler.Call(images, where.size, mode, padding_mode, fill, **where.for_native(padding_mode), out=out)


def by_torch(
    images: Tensor,
    where: PixelPositions | Lattice,
    how: Sampler,
    kept: dict[int, Pyramid] | None = None,
    out: Tensor | None = None,
) -> Tensor:
    """Sample images (B or 1, C, H, W) by `grid_sample`; see `render`."""
    where = where.pixels
    cameras = where.grid.shape[0]
    images = images if cameras == 1 else images.expand(cameras, -1, -1, -1)
    if how.mode == "nearest":
        where = where._replace(scale=None)
    if not images.dtype.is_floating_point:
        where = where._replace(grid=where.grid.detach())
    result = _by_torch(images, where, how, kept)
    return laid_as(images, result) if out is None else out.copy_(result)


def _by_torch(images: Tensor, where: PixelPositions, how: Sampler, kept: dict[int, Pyramid] | None) -> Tensor:
    count, dtype = images.shape[0], images.dtype
    wide = dtype == wide_dtype(dtype)
    if how.mode == "nearest" and not dtype.is_floating_point and dtype.itemsize > 2:
        # the nearest of integers (B, C, H, W), moved and not computed with: no float holds every id
        value = as_pixels(how.fill, images.dtype, images.device)
        height, width = images.shape[-2:]
        u, v = (
            _padded(((position + 1) * side - 1) / 2, side, how.padding_mode).round()
            for position, side in zip(where.grid.unbind(-1), (width, height), strict=True)
        )
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        seen = inside if how.padding_mode == "zeros" else where.mapped
        index = torch.where(inside, v.long() * width + u.long(), 0).flatten(1).unsqueeze(1)
        pixels = images.view(SIGNED.get(images.dtype, images.dtype)).flatten(2)
        picked = pixels.gather(2, index.expand(*images.shape[:2], -1)).view(images.dtype)
        return torch.where(seen.unsqueeze(1), picked.unflatten(2, where.grid.shape[1:3]), value)
    where = where._replace(grid=converted(where.grid, wide_dtype(dtype)))
    plain = is_eager(images, where.grid) and are_plain(images, where.grid)
    large = plain and not wide and math.prod(images.shape[1:]) > _LARGE
    # the same for all strips of an image, however many cores are free: the pyramids that they keep are of these parts
    step = count if wide or not plain else 1 if large else thread_count()
    if not large and count <= step:
        if wide or not plain:
            levels = _levels(kept, 0, widen(images))
            return narrow(_render(levels.images, where.grid, where, levels, how), dtype)
        # strip by strip, whose memory is used again: new memory takes as long as sampling
        _, height, width, _ = where.grid.shape
        copy = memory.empty(tuple(images.shape), wide_dtype(dtype), sampler.layout(images))
        levels, result = _levels(kept, 0, copy.copy_(images)), sampler.maker(images, count, (height, width))()
        rows = max(_STRIP // max(math.prod(images.shape[:2]) * width, 1), 1)
        for top in range(0, height, rows):
            here = where.part(slice(top, top + rows))
            made = narrow(_render(levels.images, here.grid, here, levels, how), dtype)
            # channel by channel: channels that are last in memory would be copied pixel by pixel
            for plane, channel in zip(result[:, :, top : top + rows].unbind(1), made.unbind(1), strict=True):
                plane.copy_(channel)
        return result
    result = images.new_empty(*images.shape[:2], *where.grid.shape[1:3])
    for i in range(0, count, step):
        part = slice(i, i + step)
        levels = _levels(kept, i, images[part])
        here = where if where.grid.shape[0] == 1 else where.cameras(part)
        if large:
            _render_tiles(result[part], levels, here, how)
        else:
            made = _render(widen(images[part]), here.grid, here, levels, how)
            result[part] = narrow(made, dtype)
    return result


def _levels(kept: dict[int, Pyramid] | None, i: int, images: Tensor) -> Pyramid:
    """Return the pyramid of the images from the i-th on: the `kept` one, with the halves that it has, or a new one."""
    return Pyramid(images) if kept is None else kept.setdefault(i, Pyramid(images))


def _render_tiles(result: Tensor, levels: Pyramid, where: PixelPositions, how: Sampler) -> None:
    """Render an image in tiles of the target, each from a copy of the part that it reads."""
    for top in range(0, result.shape[2], _TILE):
        for left in range(0, result.shape[3], _TILE):
            down, across = slice(top, top + _TILE), slice(left, left + _TILE)
            here = where.part(down, across)
            images, grid = _read(levels.images, here, how)
            result[:, :, down, across] = narrow(_render(images, grid, here, levels, how), result.dtype)


def _read(images: Tensor, where: PixelPositions, how: Sampler) -> tuple[Tensor, Tensor]:
    """Return the part of the images that is read, as of `widen`, and the positions on it; padding stays as it is."""
    reach, slices, axes = sampler.MODES[how.mode].reach, [], []
    sides, planes = images.shape[:-3:-1], where.grid.unbind(-1)
    ranges = [[float(end) for end in torch.aminmax(plane)] for plane in planes]
    if any(low < -1 or high > 1 for low, high in ranges):
        read = where.mapped
        if how.padding_mode == "zeros":
            margins = (1 + 2 * reach / side for side in sides)
            across, down = (plane.abs() < margin for plane, margin in zip(planes, margins, strict=True))
            read = across & down
        bounds = (torch.inf, torch.amin), (-torch.inf, torch.amax)
        ranges = [[float(pick(torch.where(read, plane, none))) for none, pick in bounds] for plane in planes]
    for plane, side, ends in zip(planes, sides, ranges, strict=True):
        first, last = ((end + 1) * side / 2 - 0.5 for end in ends)
        if how.padding_mode == "reflection" and (first < 0 or last > side - 1):
            first, last = 0.0, side - 1.0
        # one more pixel for what is lost in rounding
        start = int(min(max(first - reach, 0), side - 1))
        stop = int(min(max(last + reach + 2, start + 1), side))
        slices.append(slice(start, stop))
        axes.append(((plane + 1) * side - 2 * start) / (stop - start) - 1)
    return widen(images[:, :, slices[1], slices[0]]), torch.stack(axes, -1)


def _render(images: Tensor, grid: Tensor, where: PixelPositions, levels: Pyramid, how: Sampler) -> Tensor:
    """Render images of a dtype to compute in, or a part of them, at positions `grid` on it, filled and antialiased."""
    mode, padding_mode, fill = how
    minifies = where.scale is not None
    # what lies beyond the rim is left out by coverage: at small levels the rim's pixels are wide
    beyond: PaddingMode = "border" if minifies and padding_mode == "zeros" else padding_mode
    result = sample(images, grid, mode, beyond)
    if where.scale is not None:
        # a pixel that covers n source pixels takes the mean of about as many
        level = where.scale.clamp(min=1).log2().unsqueeze(1)
        last = min(levels.images.shape[-2:]).bit_length() - 1
        for n in range(min(int(level.amax().ceil()) if may_look(level) else _TRACED_LEVELS, last)):
            levels = levels.half
            smaller = sample(levels.images, where.grid, mode, beyond)
            share = (level - n).clamp(0, 1).to(result)
            # an image without a share has no part either in what is not a number
            blended = torch.where(share < 1, torch.lerp(result, smaller, share), smaller)
            result = torch.where(share > 0, blended, result)
    if any(fill) or padding_mode != "zeros" or minifies:
        value = float(fill[0]) if len(fill) == 1 else result.new_tensor(fill)[:, None, None]
        if padding_mode == "zeros":
            # `covered`: the part of a sample that comes from the image, not from the zeros around it
            ones = images.new_ones(1, 1, *images.shape[-2:]).expand(grid.shape[0], -1, -1, -1)
            covered = sample(ones, grid, mode, "zeros")
            result = torch.where(covered != 0, result * covered, 0) if minifies else result
            result = result + value * (1 - covered)
        else:
            result = torch.where(where.mapped.unsqueeze(1), result, value)
    return result


@dataclass(eq=False)
class Pyramid:
    """Images, and their half, a pyramid again, when it is asked for (Williams, Pyramidal Parametrics, 1983)."""

    images: Tensor
    _half: Pyramid | None = None

    @property
    def half(self) -> Pyramid:
        """The pyramid of the images at half their size, in a dtype to compute in."""
        if self._half is None:  # no cached_property, whose lock compilers refuse
            size = [max(side // 2, 1) for side in self.images.shape[-2:]]
            # a copy in another dtype is large
            step = 1 if self.images.dtype != wide_dtype(self.images.dtype) else self.images.shape[1]
            options: Any = {"mode": "bilinear", "align_corners": False, "antialias": True}
            halves = [F.interpolate(widen(part), size, **options) for part in self.images.split(step, 1)]
            self._half = Pyramid(torch.cat(halves, 1))
        return self._half


def sample(images: Tensor, grid: Tensor, mode: Mode, padding_mode: PaddingMode) -> Tensor:
    """Return `grid_sample` with align_corners=False of images (B, C, H, W) at a grid (B or 1, H', W', 2).

    On a CPU an infinite or NaN pixel has a part in those bicubic samples alone in which it has a weight.
    """
    grid = grid.to(images.dtype)
    if not (isinstance(images.shape[0], int) and len(grid) == len(images)):  # comparing would fix open sizes
        grid = grid.expand(images.shape[0], -1, -1, -1)
    if torch.compiler.is_compiling():  # torch.compile knows no jvp of our own, and needs none
        return _grid_sample(images, grid, mode, padding_mode)
    if are_plain(images, grid):
        return _sample(images, grid, mode, padding_mode)
    result: Tensor = _Sample.apply(images, grid, mode, padding_mode)  # type: ignore[no-untyped-call]
    return result


def _grid_sample(images: Tensor, grid: Tensor, mode: Mode, padding_mode: PaddingMode) -> Tensor:
    """Return torch's samples of images (B, C, H, W) at a grid (B, H', W', 2)."""
    return F.grid_sample(images, grid, mode, padding_mode, align_corners=False)


def _sample(images: Tensor, grid: Tensor, mode: Mode, padding_mode: PaddingMode) -> Tensor:
    """Sample on a CPU with work for every thread; grid_sample gives one thread to each image."""
    where = PixelPositions(grid[:1] if grid.stride(0) == 0 else grid, images.new_empty(0), None)
    call = prepared(images, where, Sampler(mode, padding_mode, (0.0,))) if padding_mode == "zeros" else None
    if call is not None:
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
        pixel = _padded(cell + k, side, padding_mode)
        known = (pixel >= 0) & (pixel <= side - 1) & (weight.abs() > lost)
        taps.append((pixel.clamp(0, side - 1).long(), torch.where(known, weight, 0)))
    return taps


def _padded(u: Tensor, side: int, padding_mode: PaddingMode) -> Tensor:
    """Return pixel coordinates, those off the image repeated or reflected; "zeros" leaves them."""
    if padding_mode == "zeros":
        return u
    if padding_mode == "reflection":
        u = (u + 0.5).remainder(2 * side) - 0.5
        u = torch.minimum(u, 2 * side - 1 - u)
    return u.clamp(0, side - 1)


class Options(TypedDict):
    """The options of a `Warp`."""

    mode: Mode
    padding_mode: PaddingMode
    fill: tuple[float, ...]
    antialias: bool
    tolerance: float | None


class WarpOptions(TypedDict, total=False):
    """The options of every kind of warp; see `Warp`."""

    mode: Mode
    padding_mode: PaddingMode
    fill: Fill
    antialias: bool


class TolerantOptions(WarpOptions, total=False):
    """The options of warps that may interpolate positions, within `tolerance` pixels."""

    tolerance: float | None


def as_options(
    owner: str,
    mode: str = "bilinear",
    padding_mode: str = "zeros",
    fill: Fill = 0.0,
    antialias: bool | None = False,
    tolerance: float | None = None,
) -> Options:
    """Return the checked options of a `Warp`, by name."""
    tolerance = None if tolerance is None else as_number(tolerance, "tolerance", owner)
    if tolerance is not None and not 0 <= tolerance < math.inf:
        raise ValueError(f"{owner}: tolerance must be a number of pixels, zero or more; got {tolerance!r}")
    return {
        "mode": one_of(mode, MODES, "mode", owner),
        "padding_mode": one_of(padding_mode, PADDINGS, "padding_mode", owner),
        "fill": as_fill(fill, owner),
        "antialias": antialias is not None and as_flag(antialias, "antialias", owner),
        "tolerance": tolerance,
    }


def as_fill(fill: Fill, owner: str) -> tuple[float, ...]:
    """Return one value or one for each channel as a tuple; integers, which may be ids, stay integers."""
    try:
        if isinstance(fill, (str, bytes)):
            raise TypeError
        given = tuple(fill) if isinstance(fill, Iterable) else (fill,)
        values = tuple(value if isinstance(value, int) else float(value) for value in given)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise TypeError(f"{owner}: fill must be a number or one for each channel; got {shown(fill)}") from None
    if not values or not all(map(math.isfinite, values)):
        raise ValueError(f"{owner}: fill must be finite, a number or one for each channel; got {shown(fill)}")
    return values


class _Sample(torch.autograd.Function):
    """grid_sample with the forward-mode derivative that torch does not have."""

    generate_vmap_rule = True

    @staticmethod
    def forward(images: Tensor, grid: Tensor, mode: Mode, padding_mode: PaddingMode) -> Tensor:
        if images.is_cpu and are_known(images, grid):
            return _sample(images.detach(), grid.detach(), mode, padding_mode)  # native code takes no graph
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
