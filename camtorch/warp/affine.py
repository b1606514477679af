"""Warps of edited images: mirrored ones, and those whose pixels move by crops, scales, flips and quarter turns."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch._arguments import Numbers, as_values, broadcast_shapes
from camtorch._dtypes import SIGNED, as_pixels, narrow, widen
from camtorch._tracing import in_transform, is_concrete, may_look
from camtorch.camera import Camera
from camtorch.native import sampler
from camtorch.warp.grid import Lattice, Sampling, straight_lattice
from camtorch.warp.panorama import lengths
from camtorch.warp.routes import lengthened, positions, route_of
from camtorch.warp.sampling import SHRINKS, SURELY, Mode, PaddingMode, Sampler, render
from camtorch.warp.warp import Warp, checked

_MOST = 8  # times that an image is halved
_PLAIN = (torch.uint8, torch.float32, torch.float64)  # that torch interpolates as they are
_WHOLE = 1e-9  # pixels by which the numbers of a map may miss whole ones
_NEARLY = 1e-6  # and those of the way back


class MirrorWarp(Warp):
    """A `Warp` whose rotation, not checked, may be a mirror as well: `ray_target = Q ray_source`, Q orthogonal.

    With antialias=None images that shrink by more than one and a half are halved before, which takes less time.
    """

    def __init__(
        self, source: Camera, target: Camera, rotation: Tensor | None, *, antialias: bool | None = False, **options: Any
    ):
        super().__init__(source, target, None, antialias=bool(antialias), **options)
        self.turned_by(rotation)
        self._decides = antialias is None
        self._halvings: list[int] | None = None

    def forward(self, images: Tensor, **how: Any) -> Tensor:
        """Warped images, as of `Warp.forward`; smaller ones of them where they shrink."""
        plain = not (torch.compiler.is_compiling() or in_transform()) and is_concrete(self.target.intrinsics)
        if self._decides and plain and (self._halvings is None or any(self._halvings)):
            sampler = checked(self, images, **how)
            smooth = sampler.mode != "nearest" and images.dtype != torch.bool
            if smooth and route_of(self, images) == "kept":
                where = positions(self, "kept", sampler.padding_mode)
                if self._halvings is None:
                    self._halvings = _halvings(where, self._sampled)
                if any(self._halvings):
                    return self._smoothed(images, where, self._halvings, sampler)
        return super().forward(images, **how)

    def _smoothed(self, images: Tensor, where: Sampling | Lattice, halvings: list[int], sampler: Sampler) -> Tensor:
        """Sampled from images that torch's antialiased interpolation halved so many times, for each camera."""
        result = self._empty(images)
        images = lengthened(self, images)
        images = images.expand(len(result), -1, -1, -1)
        halvings = halvings * (len(result) // len(halvings))
        every = len(set(halvings)) == 1
        for k in sorted(set(halvings)):
            rows = torch.tensor([i for i, n in enumerate(halvings) if n == k], device=images.device)
            here = images if every else images[rows]
            if k:
                size = [max(-(-side >> k), 1) for side in images.shape[-2:]]
                plain = images.dtype in _PLAIN
                small = F.interpolate(here if plain else widen(here), size, mode="bilinear", antialias=True)
                here = small if plain else narrow(small, images.dtype)
            made = render(here, where if every else where.cameras(rows), *sampler)
            if every:
                return made
            for row, one in zip(rows.tolist(), made, strict=True):  # unsigned integers have no index_put
                result[row] = one
        return result

    def _empty(self, images: Tensor) -> Tensor:
        cameras, size = self.batch_shape.numel(), self.target._size_for("Warp")
        count = len(images) if cameras == 1 else cameras
        if images.requires_grad or not images.is_cpu:
            return images.new_empty(count, images.shape[1], *size)
        return sampler.empty(images, count, size)

    def between(self, source: Camera, target: Camera, rotation: Tensor | None, **options: Any) -> Warp:
        """See `Warp.between`."""
        return MirrorWarp(source, target, rotation, **options)


class AffineWarp(MirrorWarp):
    """The image of `source` edited: its pixels move by an affine map, also those that see nothing.

    Whole steps, flips and quarter turns copy pixels, bit by bit. `matrix`, (2, 3) or (B, 2, 3) in float64 and along the
    axes, maps pixels (u, v, 1) of the source to those of the target, `rotation` is what that does to rays.
    """

    is_an_operator = False
    _seam = None
    matrix: Tensor

    def __init__(self, source: Camera, target: Camera, matrix: Tensor, rotation: Tensor | None, **options: Any):
        super().__init__(source, target, rotation, **options)
        self.register_buffer("matrix", matrix, persistent=False)
        self.batch_shape: torch.Size = broadcast_shapes(self.batch_shape, matrix.shape[:-2])

    def between(self, source: Camera, target: Camera, rotation: Tensor | None, **options: Any) -> Warp:
        """See `Warp.between`; the map of pixels stays."""
        return AffineWarp(source, target, self.matrix, rotation, **options)

    def rows_of(self, source: Camera, target: Camera, rotation: Tensor | None, index: list[int]) -> Warp:
        """See `Warp.rows_of`."""
        matrix = self.matrix if self.matrix.ndim == 2 else self.matrix[index]
        return AffineWarp(source, target, matrix, rotation, **self.options)

    def inverse(self) -> Warp:
        """The edit back. What it cut off stays lost."""
        rotation = None if self.rotation is None else self.rotation.mT
        return AffineWarp(self.target, self.source, inverted(self.matrix), rotation, **self.options)

    def pin(self) -> Warp:
        """Nothing: copied and shrunk images ask for no positions, and the others' are kept as they are asked for."""
        return self

    # -- images

    def forward(self, images: Tensor, **how: Any) -> Tensor:
        """Edited images, as of `Warp.forward`."""
        mode, padding_mode, values = checked(self, images, **how)
        if images.ndim == 4 and may_look(self.matrix) and not in_transform():
            made = self._copied(images, values) if padding_mode == "zeros" else None
            made = self._shrunk(images, mode) if made is None else made
            if made is not None:
                return made
            if self._halvings is None and bool((self._scale < SURELY * SHRINKS).all()):
                self._halvings = [0] * len(self._maps)
            if padding_mode == "zeros" and self._is_inside:
                padding_mode = "border"  # up to the outer edges of its pixels an image ends nowhere
        return super().forward(images, mode=mode, padding_mode=padding_mode, fill=values)

    @cached_property
    def _is_inside(self) -> bool:
        """Whether the edited images show nothing but the image."""
        low, high = self._edges.amin(1), self._edges.amax(1)
        size = self._edges.new_tensor(self.source._size_for("Warp")[::-1])
        return bool((low > -_NEARLY).all() & (high < size + _NEARLY).all())

    @cached_property
    def _back(self) -> Tensor:
        """(B or 1, 2, 3): the maps back, without a graph."""
        return inverted(self._maps.detach())

    @cached_property
    def _scale(self) -> Tensor:
        """(B or 1, 2): the pixels of the image, across and down, that come to one of the result."""
        return self._back[:, :, :2].abs().sum(-1)

    @cached_property
    def _edges(self) -> Tensor:
        """(B or 1, 2, 2): where two opposite corners of the edited image lie, from the corner of the image's pixels."""
        height, width = self.target._size_for("Warp")
        back = self._back
        ends = back.new_tensor([[-0.5, -0.5], [width - 0.5, height - 0.5]])
        return (back[:, None, :, :2] * ends[None, :, None]).sum(-1) + back[:, None, :, 2] + 0.5

    def _copied(self, images: Tensor, fill: tuple[float, ...]) -> Tensor | None:
        """By pixels copied, if the map brings whole pixels to whole pixels."""
        matrices = self._maps
        linear = matrices[:, :, :2]
        if not bool((linear.abs().sum(-1) == 1).all() & ((matrices - matrices.round()).abs() < _WHOLE).all()):
            return None
        height, width = self.target._size_for("Warp")
        moves = [tuple(tuple(map(round, row)) for row in matrix) for matrix in matrices.tolist()]
        result = self._empty(images)
        images = images.expand(len(result), -1, -1, -1)
        for row, ((a, b, left), (c, d, top)) in _alike(moves):
            view = images[row]
            if b:
                view = view.mT
            dims = [dim for dim, sign in ((-1, a + b), (-2, c + d)) if sign < 0]
            if dims:  # torch flips none of those without a sign
                signed = SIGNED.get(view.dtype)  # a view by a dtype, be it the same, has no gradient
                view = view.flip(dims) if signed is None else view.view(signed).flip(dims).view(view.dtype)
            # of the first pixel of the view
            left -= (view.shape[-1] - 1) * (a + b < 0)
            top -= (view.shape[-2] - 1) * (c + d < 0)
            x, y, right, bottom = max(left, 0), max(top, 0), left + view.shape[-1], top + view.shape[-2]
            right, bottom = max(min(right, width), x), max(min(bottom, height), y)
            if (x, y, right, bottom) != (0, 0, width, height):
                result[row] = as_pixels(fill, result.dtype, result.device)
            result[row, :, y:bottom, x:right] = view[..., y - top : bottom - top, x - left : right - left]
        return result

    def _shrunk(self, images: Tensor, mode: Mode) -> Tensor | None:
        """Return what torch's antialiased resize makes of boxes of whole pixels; None for others."""
        if not (self.antialias or self._decides) or mode == "nearest" or images.dtype == torch.bool:
            return None
        height, width = self.target._size_for("Warp")
        back, least = self._back, 1 if self.antialias else SHRINKS
        if not bool((back[:, 0, 1] == 0).all() & (self._scale > least).any()):
            return None
        edges = self._edges
        if not (self._is_inside and bool((edges - edges.round()).abs().max() < _NEARLY)):
            return None
        boxes = torch.cat((edges.amin(1), edges.amax(1)), 1).round().long().tolist()
        flips = [[dim for dim, sign in ((-1, a), (-2, d)) if sign < 0] for ((a, *_), (_, d, _)) in back.tolist()]
        images = images.expand(len(boxes), -1, -1, -1) if len(boxes) > len(images) else images
        plain = images.dtype in _PLAIN
        results = []
        for part, ((left, top, right, bottom), flip) in _alike(
            [*zip(map(tuple, boxes), map(tuple, flips), strict=True)]
        ):
            view = images[part, :, top:bottom, left:right]
            view = view if plain else widen(view)
            view = F.interpolate(view, (height, width), mode=mode, align_corners=False, antialias=True)
            view = view.flip(flip) if flip else view  # before it is of an unsigned dtype, which has no flip
            results.append(view if plain else narrow(view, images.dtype))
        return results[0] if len(results) == 1 else torch.cat(results)

    @property
    def _maps(self) -> Tensor:
        """(B or 1, 2, 3)."""
        return self.matrix.reshape(-1, 2, 3)

    # -- positions

    def _inputs(self) -> list[Tensor]:
        return [self.matrix]

    def _locate(self, rows: range, padding: PaddingMode, tolerance: float) -> Sampling | Lattice:
        width = self.target._size_for("Warp")[1]
        back = inverted(self._maps)
        side = back.new_tensor(self.source._size_for("Warp")[::-1])[:, None]
        # pixels to positions: (2 u + 1) / W - 1
        back = torch.cat((back[:, :, :2] * 2 / side, (2 * back[:, :, 2:] + 1) / side - 1), -1)
        dtype = torch.promote_types(self.source.intrinsics.dtype, torch.float32)
        if tolerance and not self.antialias and back.is_cpu and is_concrete(back) and not in_transform():
            return straight_lattice(back, rows, width, dtype)
        v, u = (torch.arange(n, dtype=back.dtype, device=back.device) for n in (len(rows), width))
        v = v + rows.start
        a, b, c = (w.unsqueeze(-1).unsqueeze(-1) for w in back.unbind(-1))
        grid = (a * u + b * v[:, None] + c).movedim(1, -1).to(dtype)
        mapped = torch.ones_like(grid[..., 0], dtype=torch.bool)
        if not self.antialias:
            return Sampling(grid, mapped, None)
        scale = (back[:, :, :2] * side / 2).abs().sum(-1).amax(-1)
        return Sampling(grid, mapped, scale.to(dtype)[:, None, None].expand(mapped.shape).contiguous())

    # -- labels

    def _move(self, pixels: Numbers, back: bool = False, on_image: bool = False) -> tuple[Tensor, Tensor]:
        pixels = as_values(pixels, "pixels", "Warp", self.matrix.device)
        pixels = pixels if pixels.is_floating_point() else pixels.to(self.source.intrinsics.dtype)
        valid = torch.isfinite(pixels).all(-1)
        wide = torch.where(valid.unsqueeze(-1), pixels, 0.0).to(self.matrix.dtype)
        matrix = inverted(self.matrix) if back else self.matrix
        if matrix.ndim == 3:
            matrix = matrix.reshape(-1, *[1] * (pixels.ndim - 2), 2, 3)
        moved = (matrix[..., :2] * wide.unsqueeze(-2)).sum(-1) + matrix[..., 2]
        dtype = torch.promote_types(pixels.dtype, torch.float32)
        moved = torch.where(valid.unsqueeze(-1), moved, -1.0).to(dtype)
        return moved, valid & self.target.contains(moved) if on_image else valid


def _alike(kinds: list[Any]) -> list[tuple[slice, Any]]:
    """The rows of a batch that are treated alike: all of them, or each alone."""
    if all(kind == kinds[0] for kind in kinds):
        return [(slice(None), kinds[0])]
    return [(slice(i, i + 1), kind) for i, kind in enumerate(kinds)]


def _halvings(where: Sampling | Lattice, source: Camera) -> list[int]:
    """For every camera, how often to halve its image so that at most one and a half pixels of it come to one."""
    apart, every = (8, 4) if isinstance(where, Lattice) else (1, 32)
    planes = where.nodes if isinstance(where, Lattice) else where.grid.detach().movedim(-1, 1)
    planes = planes[:, :, ::every, ::every]
    seen = (planes.abs() <= 1).all(1)
    height, width = source._size_for("Warp")
    grid, planes = planes, planes * planes.new_tensor([width / 2, height / 2])[:, None, None]
    total, count = planes.new_zeros(len(planes)), planes.new_zeros(len(planes))
    for dim in (-1, -2):
        n = planes.shape[dim] - 1
        (across, down), (u, v) = planes.diff(dim=dim).unbind(1), grid.narrow(dim, 0, n).unbind(1)
        steps = lengths(source, (across, down), (u, v))
        both = seen.narrow(dim, 0, n) & seen.narrow(dim, 1, n)
        total, count = total + (steps * both).sum((1, 2)), count + both.sum((1, 2))
    scale = total / (count.clamp(min=1) * apart * every)
    return (scale / SHRINKS).clamp(min=0.5).log2().ceil().long().clamp(min=0, max=_MOST).tolist()


def inverted(matrix: Tensor) -> Tensor:
    """(*B, 2, 3): the maps back."""
    (a, b, left), (c, d, top) = (row.unbind(-1) for row in matrix.unbind(-2))
    scale = 1 / (a * d - b * c)
    a, b, c, d = d * scale, -b * scale, -c * scale, a * scale
    rows = a, b, -(a * left + b * top), c, d, -(c * left + d * top)
    back: Tensor = torch.stack(rows, -1).unflatten(-1, (2, 3))
    return back


def after(second: Tensor, first: Tensor) -> Tensor:
    """(*B, 2, 3): the first map, then the second."""
    return second[..., :2] @ first + F.pad(second[..., 2:], (2, 0))


def on_rays(matrix: Tensor) -> Tensor:
    """(*B, 3, 3): what maps of pixels do to rays, a mirror or a turn about the axis: their signs."""
    signs = matrix[..., :2].sign()
    return F.pad(signs, (0, 1, 0, 1)) + signs.new_tensor([0.0, 0.0, 1.0]).diag()
