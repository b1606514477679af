"""Images at positions: torch's grid_sample for every dtype and derivative, filled, antialiased, in bounded memory."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch.evaluate.door import converted, in_transform, is_cheap_to_read, is_eager
from camtorch.evaluate.tensors import are_plain
from camtorch.native import memory, sampler
from camtorch.values.dtypes import SIGNED, as_pixels, narrow, wide_dtype, widen
from camtorch.values.threads import thread_count
from camtorch.warp.grid_sample import is_sampled_natively, padded, sample
from camtorch.warp.lattice import PixelPositions, Positions
from camtorch.warp.options import PaddingMode, Sampler

SHRINKS = 1.5  # pixels of the image to one of the result, from which on edits antialias by themselves
SURELY = 0.999  # of that: images that shrink less do not antialias, whatever rounding does
_CACHED_NUMBERS = 1 << 23  # in an image: a larger one leaves every cache when it is copied in float32
_STRIP_NUMBERS = 1 << 17  # of a result in float32 that are made at a time
_TILE_SIDE = 512  # pixels of what is then sampled at a time
_TRACED_LEVELS = 4  # if the values that decide cannot be read: down to a sixteenth


def render(images: Tensor, where: Positions, how: Sampler, pyramids: dict[int, Pyramid] | None = None) -> Tensor:
    """Return the images (B, C, h, W') that a warp makes of (B or 1, C, H, W), in their dtype.

    Half precision is sampled in float32; integers are rounded and stay in their range, bool is true from one half on.
    Images that are computed in another dtype are copied in parts. `pyramids` holds halves of the images for the next
    call.
    """
    call = prepared(images, where, how)
    return by_torch(images, where, how, pyramids) if call is None else call(images)


def laid_as(images: Tensor, result: Tensor) -> Tensor:
    """Return the result with its channels last in memory if the images have them there."""
    if in_transform() or sampler.layout(images) == torch.contiguous_format:
        return result
    return result.contiguous(memory_format=torch.channels_last)


def prepared(images: Tensor, where: Positions, how: Sampler) -> sampler.NativeJob | None:
    """Return the call of native code for images (B or 1, C, H, W) of this form.

    None with a graph, a transform, another device or dtype, or antialiasing.
    """
    mode, padding_mode, fill = how
    like = where.like()
    if not is_sampled_natively(images, like, mode) or (where.scale is not None and mode != "nearest"):
        return None
    fill = fill * images.shape[1] if len(fill) == 1 else fill
    images = images if len(like) == 1 else images.expand(len(like), -1, -1, -1)
    return sampler.NativeJob(images, where.size, mode, padding_mode, fill, **where.for_native(padding_mode))


def by_torch(images: Tensor, where: Positions, how: Sampler, pyramids: dict[int, Pyramid] | None = None) -> Tensor:
    """Sample images (B or 1, C, H, W) by `grid_sample`; see `render`."""
    where = where.pixels
    cameras = where.grid.shape[0]
    images = images if cameras == 1 else images.expand(cameras, -1, -1, -1)
    if how.mode == "nearest":
        where = where._replace(scale=None)
    if not images.dtype.is_floating_point:
        where = where._replace(grid=where.grid.detach())
    return laid_as(images, _within_memory(images, where, how, {} if pyramids is None else pyramids))


def _within_memory(images: Tensor, where: PixelPositions, how: Sampler, pyramids: dict[int, Pyramid]) -> Tensor:
    """Return the samples of images, in parts where those are copied in another dtype."""
    count, dtype = images.shape[0], images.dtype
    if how.mode == "nearest" and not dtype.is_floating_point and dtype.itemsize > 2:
        return _nearest_integers(images, where, how)
    where = where._replace(grid=converted(where.grid, wide_dtype(dtype)))
    if dtype == wide_dtype(dtype) or not (is_eager(images, where.grid) and are_plain(images, where.grid)):
        levels = pyramids.setdefault(0, Pyramid(widen(images)))
        return narrow(_one_piece(levels.images, where.grid, where, levels, how), dtype)
    large = math.prod(images.shape[1:]) > _CACHED_NUMBERS
    # the step must not change between strips of the target: `pyramids` are those of parts by their first image
    step = 1 if large else thread_count()
    if count <= step and not large:
        return _by_strips(images, where, how, pyramids)
    result = images.new_empty(*images.shape[:2], *where.size)
    for i in range(0, count, step):
        part = slice(i, i + step)
        levels = pyramids.setdefault(i, Pyramid(images[part]))
        here = where if where.grid.shape[0] == 1 else where.cameras(part)
        if large:
            _render_tiles(result[part], levels, here, how)
        else:
            result[part] = narrow(_one_piece(widen(images[part]), here.grid, here, levels, how), dtype)
    return result


def _by_strips(images: Tensor, where: PixelPositions, how: Sampler, pyramids: dict[int, Pyramid]) -> Tensor:
    """Render images strip by strip, whose memory is used again: new memory takes as long as sampling."""
    height, width = where.size
    copy = memory.empty(tuple(images.shape), wide_dtype(images.dtype), sampler.layout(images))
    levels = pyramids.setdefault(0, Pyramid(copy.copy_(images)))
    result = sampler.maker(images, len(images), where.size)()
    rows = max(_STRIP_NUMBERS // max(math.prod(images.shape[:2]) * width, 1), 1)
    for top in range(0, height, rows):
        here = where.part(slice(top, top + rows))
        made = narrow(_one_piece(levels.images, here.grid, here, levels, how), images.dtype)
        # channel by channel: channels that are last in memory would be copied pixel by pixel
        for plane, channel in zip(result[:, :, top : top + rows].unbind(1), made.unbind(1), strict=True):
            plane.copy_(channel)
    return result


def _nearest_integers(images: Tensor, where: PixelPositions, how: Sampler) -> Tensor:
    """Return the nearest pixels of integers (B, C, H, W), moved and not computed with: no float holds every id."""
    value = as_pixels(how.fill, images.dtype, images.device)
    height, width = images.shape[-2:]
    u, v = (
        padded(((position + 1) * side - 1) / 2, side, how.padding_mode).round()
        for position, side in zip(where.grid.unbind(-1), (width, height), strict=True)
    )
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    seen = inside if how.padding_mode == "zeros" else where.mapped
    index = torch.where(inside, v.long() * width + u.long(), 0).flatten(1).unsqueeze(1)
    pixels = images.view(SIGNED.get(images.dtype, images.dtype)).flatten(2)
    picked = pixels.gather(2, index.expand(*images.shape[:2], -1)).view(images.dtype)
    return torch.where(seen.unsqueeze(1), picked.unflatten(2, where.grid.shape[1:3]), value)


def _render_tiles(result: Tensor, levels: Pyramid, where: PixelPositions, how: Sampler) -> None:
    """Render an image in tiles of the target, each from a copy of the part that it reads."""
    for top in range(0, result.shape[2], _TILE_SIDE):
        for left in range(0, result.shape[3], _TILE_SIDE):
            down, across = slice(top, top + _TILE_SIDE), slice(left, left + _TILE_SIDE)
            here = where.part(down, across)
            images, grid = _part_read(levels.images, here, how)
            result[:, :, down, across] = narrow(_one_piece(images, grid, here, levels, how), result.dtype)


def _part_read(images: Tensor, where: PixelPositions, how: Sampler) -> tuple[Tensor, Tensor]:
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


def _one_piece(images: Tensor, grid: Tensor, where: PixelPositions, levels: Pyramid, how: Sampler) -> Tensor:
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
        for n in range(min(int(level.amax().ceil()) if is_cheap_to_read(level) else _TRACED_LEVELS, last)):
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
