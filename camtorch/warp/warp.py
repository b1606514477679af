"""Every image operation between two cameras: one Warp."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from camtorch._arguments import as_values, broadcast_shapes
from camtorch._module import GeometryModule, Memo
from camtorch._tracing import in_transform, is_concrete, may_look
from camtorch.camera import Camera
from camtorch.rotations import as_rotation, turn
from camtorch.warp import compiled, minify
from camtorch.warp.grid import OUTSIDE, in_strips, on_lattice
from camtorch.warp.polygons import EDGE_SAMPLES, along_edges, corners_of
from camtorch.warp.sampling import MODES, PADDINGS, as_fill, as_options, coverage, narrow, one_of, sample, widen

_FAR = 100.0  # positions beyond are drawn in: grid_sample casts them to integers


class Warp(GeometryModule):
    """The image that `target` would see, made from the image of `source`, both at one place.

    Convention: `ray_target = R ray_source` (OpenCV's rectification R). Images are (B, C, H, W). Points, boxes and
    rays move from source to target. A batch of cameras or rotations, of size B, goes sample by sample with
    the images; cameras without batch dims serve all of them.

    Args:
        source: the camera of the given images.
        target: the camera of the images to make; its `image_size` is theirs.
        rotation: (3, 3) or (B, 3, 3) rotation matrix; may require grad. None is no rotation.
        mode: "bilinear", "nearest" (masks, labels) or "bicubic".
        padding_mode: "zeros", "border" or "reflection", for pixels that the source sees outside its
            image. A pixel without a ray, or whose ray the source cannot map, always takes `fill`.
        fill: the value of pixels that show nothing, blended in at the rim of "zeros"; one, or one for each channel.
        antialias: where the image shrinks, a pixel takes the mean of what it covers, as wide in all directions as in
            the widest; compiled down to a sixteenth. "nearest" does not.
        tolerance: pixels of the source by which sampling positions may be off, as far as fourth differences tell. From
            0.01 on they come from a lattice, several times as fast. Zero is exact; so are labels always, warps
            with a graph, and those on a GPU.

    The sampling grid is kept while nothing that it depends on can learn or has changed.

    Raises:
        ValueError: a mode that does not exist, cameras without image_size, a rotation of another shape or that is
            none, batch dims that do not fit, a fill or a tolerance that is none.
        TypeError: source or target is not a Camera.
    """

    def __init__(
        self,
        source: Camera,
        target: Camera,
        rotation: Tensor | None = None,
        *,
        mode: str = "bilinear",
        padding_mode: str = "zeros",
        fill: float | Sequence[float] = 0.0,
        antialias: bool = False,
        tolerance: float = 0.0,
    ):
        super().__init__()
        for name, camera in (("source", source), ("target", target)):
            if not isinstance(camera, Camera):
                raise TypeError(f"Warp: {name} must be a Camera; got {type(camera).__name__}")
            if camera.image_size is None:
                raise ValueError(f"Warp: the {name} camera needs an image_size=(height, width)")
        self.source, self.target = source, target
        options = as_options("Warp", mode, padding_mode, fill, antialias, tolerance)
        self.mode, self.padding_mode, self.fill, self.antialias, self.tolerance = options.values()
        self._set_rotation(as_rotation(rotation, "Warp"))
        shapes = [source.batch_shape, target.batch_shape, () if rotation is None else self.rotation.shape[:-2]]
        try:
            self.batch_shape = broadcast_shapes(*shapes)
        except ValueError:
            self.batch_shape = None
        if self.batch_shape is None or len(self.batch_shape) > 1:
            raise ValueError(
                "Warp: source, target and rotation may each have one batch dim, of one size; "
                f"got {', '.join(str(tuple(s)) for s in shapes)}"
            )
        self._memo, self._pinned = Memo(), None

    def _set_rotation(self, rotation: Tensor | None) -> None:
        if isinstance(rotation, nn.Parameter):
            self.register_parameter("rotation", rotation)
        else:
            self.register_buffer("rotation", rotation, persistent=rotation is not None and not rotation.requires_grad)

    # -- images

    def forward(
        self,
        images: Tensor,
        *,
        mode: str | None = None,
        padding_mode: str | None = None,
        fill: float | Sequence[float] | None = None,
    ) -> Tensor:
        """Warp images.

        Args:
            images: (B, C, H, W) of the source's image_size, floating point, integer or bool.
            mode: instead of the warp's own, for example "nearest" for a mask.
            padding_mode: likewise.
            fill: likewise.

        Returns:
            (B, C, H', W') of the target's image_size and of the same dtype. Half precision is sampled in float32;
            integers are rounded and stay in their range, bool is true from one half on.

        Raises:
            ValueError: another shape or size. TypeError: complex images.
        """
        if not isinstance(images, Tensor) or images.is_complex():
            what = getattr(images, "dtype", type(images).__name__)
            raise TypeError(f"Warp: images must be a tensor (B, C, H, W) of real numbers; got {what}")
        if images.ndim != 4:
            hint = "One image goes in as image[None], masks without channels as masks[:, None]"
            raise ValueError(f"Warp: images must be (B, C, H, W); got shape {tuple(images.shape)}. {hint}")
        size, expected = tuple(images.shape[-2:]), self.source.image_size
        if size != expected:
            raise ValueError(
                f"Warp: images are {size} (height, width), but the source camera's image_size is {expected}"
            )
        mode = self.mode if mode is None else one_of(mode, MODES, "mode", "Warp")
        padding_mode = (
            self.padding_mode if padding_mode is None else one_of(padding_mode, PADDINGS, "padding_mode", "Warp")
        )
        fill = self.fill if fill is None else as_fill(fill, "Warp")
        grid, mapped, scale = self._sampling()
        if grid.shape[0] == 1:
            grid = grid.expand(images.shape[0], -1, -1, -1)
        elif images.shape[0] == 1:
            images = images.expand(grid.shape[0], -1, -1, -1)
        elif images.shape[0] != grid.shape[0]:
            raise ValueError(f"Warp: {images.shape[0]} images do not fit {grid.shape[0]} cameras")
        dtype, minifies = images.dtype, scale is not None and mode != "nearest"
        if minifies or any(fill):
            images = widen(images)
        if minifies:
            # what lies beyond the rim is left out by coverage: at small levels the rim's pixels are wide
            beyond = "border" if padding_mode == "zeros" else padding_mode
            result = minify.sample_minified(images, grid, scale, mode, beyond)
        else:
            result = sample(images, grid, mode, padding_mode)
        if any(fill) or padding_mode != "zeros" or minifies:
            if len(fill) not in (1, result.shape[1]):
                raise ValueError(f"Warp: fill has {len(fill)} values, but the images have {result.shape[1]} channels")
            value = result.new_tensor(fill)[:, None, None]
            if padding_mode == "zeros":
                covered = coverage(images, grid, mode)
                result = torch.where(covered != 0, result * covered, 0) if minifies else result
                result = result + value * (1 - covered)
            else:
                result = torch.where(mapped.unsqueeze(1), result, value)
        return narrow(result, dtype)

    def grid(self) -> Tensor:
        """(B or 1, H', W', 2): positions for `grid_sample(..., align_corners=False)`; -9 where there is none."""
        return self._sampling()[0].clone()

    def valid_mask(self) -> Tensor:
        """(B or 1, 1, H', W') bool: the pixel has a ray, and the source sees it on its image."""
        grid, mapped, _ = self._sampling()
        pixels = (grid.detach() + 1) * grid.new_tensor(self.source.image_size[::-1]) / 2 - 0.5
        return (mapped & self.source.contains(pixels)).unsqueeze(1)

    def _sampling(self) -> tuple[Tensor, Tensor, Tensor | None]:
        """The grid, where a ray was mapped at all, and with antialias the local scale."""
        if self._pinned is not None:
            return self._pinned
        inputs = [t for t in self._inputs() if t is not None]
        if torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
            return self._with_scale(*self._positions(self.target.pixel_grid()))
        cameras = [(type(camera), camera.image_size) for camera in (self.source, self.target)]
        options = (*cameras, self.rotation is None, self.antialias, self.tolerance)
        return self._memo(inputs, options, lambda: self._with_scale(*self._tabulate()))

    def pin(self) -> Warp:
        """Have the grid computed once and for all, with its graph: for a warp whose cameras are not to change."""
        # what a transform makes dies with it; what inference mode makes could not be used in a graph later
        if not in_transform() and not torch.is_inference_mode_enabled():
            self._pinned = self._sampling()
        return self

    def _with_scale(self, grid: Tensor, mapped: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        size = self.source.image_size
        return grid, mapped, minify.local_scale(grid.detach(), mapped, size) if self.antialias else None

    def _inputs(self) -> tuple[Tensor | None, ...]:
        s, t = self.source, self.target
        return s.intrinsics, s.distortion, t.intrinsics, t.distortion, self.rotation

    def _tabulate(self) -> tuple[Tensor, Tensor]:
        """`_positions` of all pixels."""
        pixels = self.target.pixel_grid()
        if torch.compiler.is_compiling() and self.tolerance and pixels.is_cpu:
            return compiled.positions(self)
        if in_transform() or not is_concrete(pixels):
            return self._positions(pixels)
        if self.tolerance and pixels.is_cpu:
            sizes = self.target.image_size, self.source.image_size
            found = on_lattice(self._positions, *sizes, self.tolerance, pixels)
            if found is not None:
                return found
        return in_strips(self._positions, pixels, math.prod(self.batch_shape))

    def _positions(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Where the source sees target pixels (h, w, 2) or (B, h, w, 2): see `positions.Exact`."""
        if pixels.ndim == 3:
            pixels = pixels.expand(*self.target.batch_shape, *pixels.shape)
        rays, has_ray = self.target.unproject(pixels)
        if rays.ndim == 3:
            rays, has_ray = rays.unsqueeze(0), has_ray.unsqueeze(0)
        rotation = None if self.rotation is None else self.rotation.mT
        seen, mapped = self.source.project(turn(rotation, rays, "rays"))
        mapped = mapped & has_ray
        position = torch.stack(
            [
                (plane * (2 / size) + (1 / size - 1)).clamp(-_FAR, _FAR)
                for plane, size in zip(seen.unbind(-1), self.source.image_size[::-1], strict=True)
            ]
        )
        if not (may_look(mapped) and bool(mapped.all())):
            position = torch.where(mapped, position, OUTSIDE)
        return position.movedim(0, -1), mapped

    # -- labels

    def transform_points(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Move pixels (B, *N, 2), or (*N, 2) for cameras without batch, from the source's to the target's image.

        Returns:
            pixels of the same shape, and valid (B, *N) bool: the source pixel has a ray, and the target sees
            it on its image. Pixels off the image keep their place; those without one get (-1, -1).
        """
        moved, mapped = self._move(pixels)
        return moved, mapped & self.target.contains(moved)

    def _move(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        rays, has_ray = self.source.unproject(pixels)
        moved, mapped = self.target.project(turn(self.rotation, rays, "pixels"))
        valid = mapped & has_ray
        return torch.where(valid.unsqueeze(-1), moved, -1.0), valid

    def transform_boxes(self, boxes: Tensor) -> tuple[Tensor, Tensor]:
        """Move boxes (B, *N, 4), or (*N, 4): x1, y1, x2, y2 in pixel-centre coordinates.

        Returns:
            the boxes that enclose the moved outlines (curved: the edges are sampled), not clipped to the
            image, and valid (B, *N) bool: some part of the outline lies on the target's image. A box
            none of whose outline can be mapped is (-1, -1, -1, -1).
        """
        boxes = as_values(boxes, "boxes", "Warp", self.source.intrinsics.device)
        if boxes.ndim == 0 or boxes.shape[-1] != 4:
            raise ValueError(f"Warp: boxes must be (B, *N, 4) = x1, y1, x2, y2; got shape {tuple(boxes.shape)}")
        if not boxes.is_floating_point():
            boxes = boxes.to(self.source.intrinsics.dtype)
        return self.enclose(corners_of(boxes))

    def enclose(self, corners: Tensor) -> tuple[Tensor, Tensor]:
        """As `transform_boxes`, of closed polygons (B, *N, K, 2), or (*N, K, 2)."""
        moved, mapped = self._move(along_edges(corners, EDGE_SAMPLES))
        mapped = mapped & torch.isfinite(corners).flatten(-2).all(-1, keepdim=True)
        some = mapped.any(-1, keepdim=True)
        low = torch.where(mapped.unsqueeze(-1), moved, torch.inf).amin(-2)
        high = torch.where(mapped.unsqueeze(-1), moved, -torch.inf).amax(-2)
        enclosing = torch.where(some, torch.cat((low, high), -1), -1.0)
        return enclosing, (mapped & self.target.contains(moved)).any(-1)

    def transform_rays(self, rays: Tensor) -> Tensor:
        """Turn directions (B, *N, 3), or (*N, 3), from the source's to the target's frame; lengths stay."""
        rays = as_values(rays, "rays", "Warp", self.source.intrinsics.device)
        if rays.ndim == 0 or rays.shape[-1] != 3:
            raise ValueError(f"Warp: rays must be (B, *N, 3); got shape {tuple(rays.shape)}")
        return turn(self.rotation, rays, "rays")

    def inverse(self) -> Warp:
        """The warp from target to source. What lay outside the image, or between its pixels, stays lost."""
        rotation = None if self.rotation is None else self.rotation.mT
        return Warp(self.target, self.source, rotation, **self.options)

    @property
    def options(self) -> dict:
        """What another Warp takes to sample in the same way."""
        return {name: getattr(self, name) for name in ("mode", "padding_mode", "fill", "antialias", "tolerance")}

    def __getstate__(self):
        return {**super().__getstate__(), "_pinned": None}

    def extra_repr(self) -> str:
        """The options."""
        options = ", ".join(f"{name}={value!r}" for name, value in self.options.items())
        return f"{options}, rotation={self.rotation is not None}"
