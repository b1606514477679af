"""Warps that choose how each image is made: halved before it is sampled, resized, or copied pixel by pixel.

A `HalvingWarp` halves images that shrink. An `AffineWarp` is one whose pixels move by crops, scales, flips and turns.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.cameras.operators import opaque
from camtorch.evaluate.door import in_transform, keeps_graph
from camtorch.evaluate.tensors import are_concrete, are_plain, is_unknown
from camtorch.native.sampler import maker
from camtorch.optics.radial_inverse import WITHOUT_FLOAT64
from camtorch.poses.rotations import transposed
from camtorch.values.arguments import Numbers, as_values, broadcast_shapes
from camtorch.values.dtypes import SIGNED, as_pixels, narrow, widen
from camtorch.warp import compiled
from camtorch.warp.camera_pair import placed
from camtorch.warp.lattice import PixelPositions, Positions, coarse, straight_lattice
from camtorch.warp.options import Options, PaddingMode, Sampler
from camtorch.warp.panorama import lengths
from camtorch.warp.routes import Route
from camtorch.warp.sampling import SHRINKS, render
from camtorch.warp.warp import Warp

_MOST_HALVINGS = 8  # an image is halved this often at most
_PLAIN_DTYPES = (torch.uint8, torch.float32, torch.float64)  # torch interpolates these dtypes without a conversion
_MAP_ROUNDING = 1e-9  # pixels: a number of a map this close to a whole one counts as whole
_INVERSE_ROUNDING = 1e-6  # pixels: the same for the inverse map

Rows = tuple[tuple[float, float, float], tuple[float, float, float]]
Map = Tensor | Rows
"""(*B, 2, 3) float64, from pixels (u, v, 1) to pixels; `Rows` if one map, known while code is traced, serves all."""


class ImageEdit(NamedTuple):
    """How an image is made: copied; resized by torch; or, without `move` and `box`, halved and sampled."""

    padding_mode: PaddingMode
    halvings: int = 0
    move: tuple[int, ...] = ()  # a map of pixels in whole numbers
    box: tuple[int, ...] = ()  # left, top, right, bottom in whole pixels
    flips: tuple[int, ...] = ()  # dims to flip


class HalvingWarp(Warp):
    """A `Warp` that, by antialias=None, halves images before it samples them if they shrink by more than 1.5.

    Its rotation is not checked, and may be a mirror.
    """

    may_mirror = True
    map: Map | None = None

    def __init__(self, source: Camera, target: Camera, rotation: Tensor | None, **options: Any):
        super().__init__(source, target, None, **options)
        self.turned_by(rotation)

    def warped(self, images: Tensor, sampler: Sampler, route: Route | None = None) -> Tensor:
        """Return warped images; each one may be copied, resized, or halved and sampled, see `ImageEdit`."""
        smooth = sampler.mode != "nearest" and images.dtype != torch.bool
        may_call = torch.compiler.is_compiling() and not torch.onnx.is_in_onnx_export()
        if may_call and self._edits_need_values(smooth) and not keeps_graph(images, *self.tensors):
            matrix = None if self.map is None else map_as_tensor(self.map)
            padding = sampler.padding_mode
            return compiled.warped(images, self.pair, self.tolerance, self.antialias, padding, sampler, matrix, _edited)
        route = route or self.route(images)
        edits = None if in_transform() else self._edits(sampler, smooth, route)
        if not edits:
            return super().warped(images, sampler, route)
        if len(edits) > 1:
            images = images.expand(len(edits), -1, -1, -1)
        if all(edit == edits[0] for edit in edits):
            return self._made(images, edits[0], sampler, route)
        return self._made_by_several(images, edits, sampler, route)

    def _made_by_several(self, images: Tensor, edits: list[ImageEdit], sampler: Sampler, route: Route) -> Tensor:
        """Return images, each made by its own edit; those of one edit are sampled together."""
        result = self._empty(images)
        for edit in dict.fromkeys(edits):
            rows = [i for i, other in enumerate(edits) if other == edit]
            if edit.move or edit.box:
                for i in rows:
                    self._made(images[i : i + 1], edit, sampler, route, out=result[i : i + 1])
                continue
            index = torch.tensor(rows, device=images.device)
            made = self._made(images[index], edit, sampler, route, index)
            for row, one in zip(rows, made, strict=True):  # unsigned integers have no index_put
                result[row] = one
        return result

    def _edits_need_values(self, smooth: bool) -> bool:
        """Whether edits depend on values, which are not known while code is traced."""
        mixed = self.source.is_mixed or self.target.is_mixed
        return self.antialias is None and smooth and self.moves_by_cameras and not mixed

    def _edits(self, sampler: Sampler, smooth: bool, route: Route) -> list[ImageEdit] | None:
        """Return the edit of each image, or one for all; None to sample as any `Warp` does."""
        if not (self.antialias is None and smooth and route == "kept" and are_concrete(self.target.intrinsics)):
            return None
        kept = self._positions()
        if kept.halvings is None:
            known = self.host or self  # the warp on the CPU, whose values need no wait
            kept.halvings = _halvings(known.positions("kept", sampler.padding_mode), known.sampled.source)
        return [ImageEdit(sampler.padding_mode, k) for k in kept.halvings] if any(kept.halvings) else None

    def _made(
        self,
        images: Tensor,
        edit: ImageEdit,
        sampler: Sampler,
        route: Route,
        rows: Tensor | None = None,
        out: Tensor | None = None,
    ) -> Tensor:
        """Return images made by one edit, of these rows or all; copies and resized ones may be written to `out`."""
        if edit.move:
            return _copied(images, edit.move, self._empty(images) if out is None else out, sampler.fill)
        if edit.box:
            left, top, right, bottom = edit.box
            made = _resized(images[..., top:bottom, left:right], self.image_size, sampler.mode, edit.flips)
            return made if out is None else out.copy_(made)
        sampler = sampler._replace(padding_mode=edit.padding_mode)
        if rows is None and not edit.halvings:
            return super().warped(images, sampler, route)
        images = self.lengthened(images)
        if edit.halvings:
            images = _resized(images, [max(-(-side >> edit.halvings), 1) for side in images.shape[-2:]])
        where = self.positions(route, edit.padding_mode)
        return render(images, where if rows is None else where.cameras(rows), sampler)

    def _empty(self, images: Tensor) -> Tensor:
        cameras, size = self.batch_shape.numel(), self.image_size
        count = len(images) if cameras == 1 else cameras
        if not are_plain(images):
            return images.new_empty(count, images.shape[1], *size)
        return maker(images, count, size)()

    def between(self, source: Camera, target: Camera, rotation: Tensor | None, **options: Any) -> Warp:
        return type(self)(source, target, rotation=rotation, **{**self.own_parts(), **options})


class AffineWarp(HalvingWarp):
    """A `Warp` that edits the image of `source`: all its pixels move by an affine map, also those without a ray.

    Shifts by whole pixels, flips and quarter turns copy pixels bit by bit. `matrix`, (2, 3) or (B, 2, 3) float64 and
    along the axes, maps source pixels (u, v, 1) to target pixels; `rotation` is its effect on rays.
    """

    moves_by_cameras = False
    seam = None
    map: Map
    matrix: Tensor

    def __init__(self, source: Camera, target: Camera, matrix: Map, rotation: Tensor | None, **options: Any):
        super().__init__(source, target, rotation, **options)
        self.map = matrix
        given = map_as_tensor(matrix)
        device = source.intrinsics.device
        dtype = torch.float32 if device.type in WITHOUT_FLOAT64 else given.dtype
        self.register_buffer("matrix", given.to(device, dtype), persistent=False)
        self.batch_shape: torch.Size = broadcast_shapes(self.batch_shape, given.shape[:-2])
        # an edit depends on numbers on the CPU alone: it is the same on every device, and waits for none
        self._numbers: list[Rows] = []
        if not isinstance(matrix, Tensor):
            self._numbers = [matrix]
        elif are_concrete(matrix):
            self._numbers = matrix.reshape(-1, 2, 3).tolist()

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "map": self.map.detach() if isinstance(self.map, Tensor) else self.map}

    def own_parts(self, index: list[int] | None = None) -> dict[str, Any]:
        if index is not None and isinstance(self.map, Tensor) and self.map.ndim == 3:
            return {"matrix": self.map[index]}
        return {"matrix": self.map}

    def inverse(self) -> Warp:
        """Return the inverse edit. Pixels that this edit cut off stay lost."""
        return AffineWarp(self.target, self.source, inverted(self.map), transposed(self.rotation), **self.options)

    def moved_depth(self, depth: Tensor) -> Tensor:
        """Return depths (B, 1, H, W) where the edit moves them: their values stay, as the camera does."""
        return self.moved_distance(depth)

    def pin(self) -> Warp:
        """Return this warp: pure copies need no sampling positions, others keep them from the first call."""
        return self

    def _edits_need_values(self, smooth: bool) -> bool:
        return not self._numbers

    def _edits(self, sampler: Sampler, smooth: bool, route: Route) -> list[ImageEdit] | None:
        least = math.inf  # how many source pixels become one where torch resizes
        if smooth and self.antialias is not False:
            least = 1.0 if self.antialias else SHRINKS
        sizes = self.source.size_for("Warp"), self.image_size
        may_halve = smooth and self.antialias is None and route == "kept"
        return [_edit_of(rows, *sizes, sampler.padding_mode, least, may_halve) for rows in self._numbers]

    @property
    def tensors(self) -> list[Tensor]:
        return [self.matrix]

    def locate(self, rows: range, padding: PaddingMode, tolerance: float) -> Positions:
        width = self.image_size[1]
        back = inverted(self.matrix.reshape(-1, 2, 3))  # from the target to the source
        side = back.new_tensor(self.source.size_for("Warp")[::-1])[:, None]
        # pixels to positions: (2 u + 1) / W - 1
        back = torch.cat((back[:, :, :2] * 2 / side, (2 * back[:, :, 2:] + 1) / side - 1), -1)
        dtype = torch.promote_types(self.source.intrinsics.dtype, torch.float32)
        if tolerance and not self.antialias and back.is_cpu and not is_unknown(back):
            return straight_lattice(back, rows, width, dtype)
        u = torch.arange(width, dtype=back.dtype, device=back.device)
        v = torch.arange(len(rows), dtype=back.dtype, device=back.device) + rows.start
        a, b, c = (w.unsqueeze(-1).unsqueeze(-1) for w in back.unbind(-1))
        grid = (a * u + b * v[:, None] + c).movedim(1, -1).to(dtype)
        mapped = torch.ones_like(grid[..., 0], dtype=torch.bool)
        if not self.antialias:
            return PixelPositions(grid, mapped, None)
        # undo 2 / W; how many source pixels lie between neighbours is the same all over the image
        scale = (back[:, :, :2] * side / 2).abs().sum(-1).amax(-1)
        return PixelPositions(grid, mapped, scale.to(dtype)[:, None, None].expand(mapped.shape).contiguous())

    def move(self, pixels: Numbers, back: bool = False, on_image: bool = False) -> tuple[Tensor, Tensor]:
        pixels = as_values(pixels, "pixels", "Warp", self.matrix.device)
        pixels = pixels if pixels.is_floating_point() else pixels.to(self.source.intrinsics.dtype)
        valid = torch.isfinite(pixels).all(-1)
        wide = torch.where(valid.unsqueeze(-1), pixels, 0.0).to(self.matrix.dtype)
        matrix = inverted(self.matrix) if back else self.matrix
        if matrix.ndim == 3:
            matrix = matrix.reshape(-1, *[1] * (pixels.ndim - 2), 2, 3)
        moved = (matrix[..., :2] * wide.unsqueeze(-2)).sum(-1) + matrix[..., 2]
        return placed(self.target, moved.to(torch.promote_types(pixels.dtype, torch.float32)), valid, on_image)


def made_like(
    warp: Warp, source: Camera, target: Camera, rotation: Tensor | None, options: Options, rows: list[int] | None = None
) -> Warp:
    """Return a warp like another one, or these rows of it, between other cameras; the rotation is not checked."""
    if warp.moves_by_cameras:
        return HalvingWarp(source, target, rotation, **options)
    return warp.between(source, target, rotation, **options, **warp.own_parts(rows))


def _copied(images: Tensor, move: tuple[int, ...], result: Tensor, fill: tuple[float, ...]) -> Tensor:
    """Copy pixels to where a map in whole numbers moves them, put `fill` elsewhere, and return the result."""
    # a quarter turn swaps the axes, and a negative sign along an axis flips it
    a, b, left, c, d, top = move
    view = images.mT if b else images
    flips = [dim for dim, sign in ((-1, a + b), (-2, c + d)) if sign < 0]
    if flips:  # torch cannot flip unsigned dtypes
        signed = SIGNED.get(view.dtype)  # a view by dtype, even the same one, drops the gradient
        view = view.flip(flips) if signed is None else view.view(signed).flip(flips).view(view.dtype)
    # where the first pixel of the view goes: the map says it of pixel (0, 0), which a flip moves to the end
    left -= view.shape[-1] - 1 if -1 in flips else 0
    top -= view.shape[-2] - 1 if -2 in flips else 0
    # the part of the result that the view covers, which may be empty
    height, width = result.shape[-2:]
    x, y = max(left, 0), max(top, 0)
    right, bottom = max(min(left + view.shape[-1], width), x), max(min(top + view.shape[-2], height), y)
    if (x, y, right, bottom) != (0, 0, width, height):
        result[:] = as_pixels(fill, result.dtype, result.device)
    result[:, :, y:bottom, x:right] = view[..., y - top : bottom - top, x - left : right - left]
    return result


def _resized(images: Tensor, size: Sequence[int], mode: str = "bilinear", flips: tuple[int, ...] = ()) -> Tensor:
    """Return images resized by torch with antialiasing, then flipped."""
    plain = images.dtype in _PLAIN_DTYPES
    made = F.interpolate(images if plain else widen(images), size, mode=mode, align_corners=False, antialias=True)
    made = made.flip(flips) if flips else made  # flip before narrowing: unsigned dtypes have no flip
    return made if plain else narrow(made, images.dtype)


def _edit_of(
    rows: Rows, source: tuple[int, int], target: tuple[int, int], padding: PaddingMode, least: float, may_halve: bool
) -> ImageEdit:
    """Return how a map edits images of one size into another; torch resizes if more than `least` pixels become one."""
    (a, b, left), (c, d, top) = rows
    move = _whole((a, b, left, c, d, top), _MAP_ROUNDING)
    if move and abs(a) + abs(b) == abs(c) + abs(d) == 1 and padding == "zeros":
        return ImageEdit(padding, move=move)
    # two opposite corners of the target, as places on the source from the outer corner of its first pixel
    (a, b, left), (c, d, top) = inverted(rows)
    corners = (-0.5, -0.5), (target[1] - 0.5, target[0] - 0.5)
    ends = [(a * u + b * v + left + 0.5, c * u + d * v + top + 0.5) for u, v in corners]
    (x, right), (y, bottom) = (sorted(places) for places in zip(*ends, strict=True))
    slack = _INVERSE_ROUNDING
    is_inside = min(x, y) > -slack and right < source[1] + slack and bottom < source[0] + slack
    # a box of whole pixels that shrinks is resized; others are sampled, and may be halved first
    box = _whole((x, y, right, bottom), slack)
    if box and is_inside and b == 0 and max(abs(a), abs(d)) > least:
        return ImageEdit(padding, box=box, flips=tuple(dim for dim, sign in ((-1, a), (-2, d)) if sign < 0))
    halvings = _halved((math.hypot(a, c) + math.hypot(b, d)) / 2) if may_halve else 0
    # a target inside of the source, up to the outer edges of its pixels, needs no padding
    return ImageEdit("border" if is_inside and padding == "zeros" else padding, halvings)


def _whole(numbers: Sequence[float], slack: float) -> tuple[int, ...]:
    """Return numbers that are whole up to a slack as integers; nothing if one of them is not."""
    whole = tuple(round(number) for number in numbers)
    return whole if all(abs(number - n) < slack for number, n in zip(numbers, whole, strict=True)) else ()


def _halved(scale: float) -> int:
    """Return how often to halve an image so that at most one and a half of its pixels become one."""
    return min(max(math.ceil(math.log2(max(scale / SHRINKS, 0.5))), 0), _MOST_HALVINGS)


def _halvings(where: Positions, source: Camera) -> list[int]:
    """Return for every camera how often to halve its image, measured at the same target pixels on all routes."""
    first, step = coarse(where.size)
    grid = where.every(first, step)
    seen = (grid.abs() <= 1).all(1)
    height, width = source.size_for("Warp")
    pixels = grid * grid.new_tensor([width / 2, height / 2])[:, None, None]
    # the mean step between neighbours that the source sees both, across and down
    total = count = grid.new_zeros(len(grid))
    for dim in (-1, -2):
        n = grid.shape[dim] - 1
        across, down = pixels.diff(dim=dim).unbind(1)
        u, v = grid.narrow(dim, 0, n).unbind(1)
        both = seen.narrow(dim, 0, n) & seen.narrow(dim, 1, n)
        total = total + (lengths(source, (across, down), (u, v)) * both).sum((1, 2))
        count = count + both.sum((1, 2))
    return [_halved(scale) for scale in (total / (count.clamp(min=1) * step)).tolist()]


@opaque(compiled.warp_shapes)
def _edited(
    images: Tensor, source: Camera, target: Camera, rotation: Tensor | None, tolerance: float, *options: Any
) -> tuple[Tensor]:
    """Return the images of an edit, as its values choose it; see `compiled.warped` for the options."""
    *texts, matrix, is_last = options
    antialias, _, sampler = compiled.read(*texts)
    how: Any = {**sampler._asdict(), "antialias": antialias, "tolerance": tolerance}
    warp: Warp = HalvingWarp(source, target, rotation, **how)
    if matrix is not None:
        warp = AffineWarp(source, target, matrix, rotation, **how)
    return (compiled.laid(warp(images), is_last),)


def map_as_tensor(matrix: Map) -> Tensor:
    """Return a map as a tensor (*B, 2, 3) in float64."""
    return matrix if isinstance(matrix, Tensor) else torch.tensor(matrix, dtype=torch.float64)


def inverted(matrix: Map) -> Any:
    """Return the inverse maps (*B, 2, 3)."""
    numbers: Any = matrix.flatten(-2).unbind(-1) if isinstance(matrix, Tensor) else (*matrix[0], *matrix[1])
    a, b, left, c, d, top = numbers
    scale = 1 / (a * d - b * c)
    a, b, c, d = d * scale, -b * scale, -c * scale, a * scale
    rows = (a, b, -(a * left + b * top)), (c, d, -(c * left + d * top))
    return torch.stack([*rows[0], *rows[1]], -1).unflatten(-1, (2, 3)) if isinstance(matrix, Tensor) else rows


def after(second: Map, first: Map) -> Map:
    """Return the maps (*B, 2, 3) that apply `first`, then `second`."""
    if isinstance(second, Tensor) or isinstance(first, Tensor):
        second, first = map_as_tensor(second), map_as_tensor(first)
        return second[..., :2] @ first + F.pad(second[..., 2:], (2, 0))
    (a, b, left), (c, d, top) = second
    (e, f, x), (g, h, y) = first
    return ((a * e + b * g, a * f + b * h, a * x + b * y + left), (c * e + d * g, c * f + d * h, c * x + d * y + top))
