"""Every image operation between two cameras: one Warp."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from camtorch._arguments import (
    Numbers,
    as_coordinates,
    as_values,
    as_whole,
    broadcast_shapes,
    check_boxes,
    check_devices,
    is_predicted,
    no_camera,
)
from camtorch._module import GeometryModule, Memo, is_constant, typed_as, with_values
from camtorch._tracing import (
    in_graph,
    in_jit_trace,
    in_transform,
    is_concrete,
    is_exporting,
    is_for_here,
    keeps_graph,
    may_look,
    set_aside,
)
from camtorch.camera import Camera
from camtorch.native.sampler import empty
from camtorch.rotations import as_rotation, turn
from camtorch.warp import compiled
from camtorch.warp.grid import Lattice, Sampling, locate, scaled, tabulate
from camtorch.warp.panorama import PANORAMAS, rays_of, seam_of, seen_by
from camtorch.warp.sampling import (
    MODES,
    PADDINGS,
    Fill,
    Mode,
    Options,
    PaddingMode,
    Pyramid,
    as_fill,
    as_options,
    one_of,
    render,
)
from camtorch.warp.shutter import RollingShutter, Shutters, averaged, in_motion

if TYPE_CHECKING:
    from typing_extensions import Self

    from camtorch.maps.report import MapReport

_MOST_KEPT = 1 << 25  # pixels of a grid; longer ones, of 256 MB in float32, are made by strips and not kept
_STRIP = 1 << 21  # pixels of such a strip
_SINGLE = 1e-3  # pixels: some ulps of a position in an image a thousand pixels wide, computed in float32


def as_sized(camera: Camera, name: str, owner: str) -> Camera:
    """The camera, if it is one and knows the size of its image."""
    if not isinstance(camera, Camera):
        raise TypeError(f"{owner}: {name} must be a Camera; got {no_camera(camera)}")
    if camera.image_size is None:
        raise ValueError(f"{owner}: the {name} needs an image_size=(height, width)")
    return camera


_EDGE_SAMPLES = 64  # per edge: one of 500 px bent to a radius of 300 px is then enclosed to 0.03 px
_LATTICE = 16  # steps across and down the target, between points that are looked for in what an outline encloses


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
        tolerance: pixels of the source by which sampling positions may be off at most. Above zero they come from a
            lattice of every eighth pixel, several times as fast where cameras are new, and what it does not reach is
            computed. By default 0.001 between cameras in float32, whose rounding costs as much, and zero in
            float64. Zero is exact; so are points, boxes and rays always, warps with a graph, and those on a GPU.
        shutter: the `RollingShutter` by which the given images were taken: undone along with the lens. Both cameras and
            the rotation are then those of the middle of the readout.
        target_shutter: the one by which the images to make are taken: put on.

    The image of a panorama of a whole turn goes on beyond its seam and its poles: of an `Equirectangular` or
    `Cylindrical` source as wide as 2 pi, or a `LatLon` or `TransverseCylindrical` one as tall, to 0.05 pixels, all of a
    batch. That takes a slightly larger copy of it. Behind a `shutter`, or in a `Mixed`, it ends at its edges.

    The sampling grid is kept while nothing that it depends on can learn or has changed.

    Raises:
        ValueError: a mode that does not exist, cameras without image_size, a rotation of another shape or that is
            none, batch dims that do not fit, a fill or a tolerance that is none.
        TypeError: source or target is not a Camera.
    """

    _decides = False  # for itself where to antialias
    is_an_operator: ClassVar[bool] = True
    """Whether compiled code calls it as one: the cameras and the rotation are all there is to it."""
    source: Camera
    target: Camera
    rotation: Tensor | None
    _pinned: Sampling | Lattice | None
    fill: tuple[float, ...]
    antialias: bool
    shutter: RollingShutter | None
    target_shutter: RollingShutter | None
    batch_shape: torch.Size

    def __init__(
        self,
        source: Camera,
        target: Camera,
        rotation: Tensor | None = None,
        *,
        mode: Mode = "bilinear",
        padding_mode: PaddingMode = "zeros",
        fill: Fill = 0.0,
        antialias: bool = False,
        tolerance: float | None = None,
        shutter: RollingShutter | None = None,
        target_shutter: RollingShutter | None = None,
    ):
        super().__init__()
        self.source, self.target = as_sized(source, "source", "Warp"), as_sized(target, "target", "Warp")
        options = as_options("Warp", mode, padding_mode, fill, antialias, tolerance)
        self.mode, self.padding_mode, self.fill = options["mode"], options["padding_mode"], options["fill"]
        self.antialias, self._tolerance = options["antialias"], options["tolerance"]
        if target is not source:
            check_devices("Warp", source=source.intrinsics, target=target.intrinsics)
        self._set_rotation(as_rotation(rotation, "Warp"))
        turned = () if self.rotation is None else self.rotation.shape[:-2]
        self.shutter, self.target_shutter = as_shutter(shutter, "shutter"), as_shutter(target_shutter, "target_shutter")
        shapes = [tuple(shape) for shape in (source.batch_shape, target.batch_shape, turned)]
        shapes += [tuple(each.batch_shape) for each in (shutter, target_shutter) if each is not None]
        batch: tuple[int, ...] | None
        try:
            batch = broadcast_shapes(*shapes)
        except ValueError:
            batch = None
        if batch is None or len(batch) > 1:
            raise ValueError(
                "Warp: source, target, rotation and shutters may each have one batch dim, of one size; "
                f"got {', '.join(map(str, shapes))}"
            )
        self.batch_shape = torch.Size(batch)
        self._memos, self._pinned = {padding: Memo() for padding in PADDINGS}, None
        self._constants = Memo()
        seam_of(source)  # while its values may be looked at: traced code asks for it too

    @property
    def tolerance(self) -> float:
        """Pixels of the source by which sampling positions may be off."""
        if self._tolerance is not None:
            return self._tolerance
        single = all(camera.intrinsics.dtype == torch.float32 for camera in (self.source, self.target))
        return _SINGLE if single else 0.0

    def _set_rotation(self, rotation: Tensor | None) -> None:
        if isinstance(rotation, nn.Parameter):
            self.register_parameter("rotation", rotation)
        else:
            self.register_buffer("rotation", rotation, persistent=rotation is not None and not rotation.requires_grad)

    def turned_by(self, rotation: Tensor | None) -> Self:
        """This warp, made without a rotation, with one that is not checked: (3, 3) or (B, 3, 3)."""
        self._set_rotation(rotation)
        if rotation is not None:
            self.batch_shape = broadcast_shapes(self.batch_shape, rotation.shape[:-2])
        return self

    # -- images

    def forward(
        self,
        images: Tensor,
        *,
        mode: Mode | None = None,
        padding_mode: PaddingMode | None = None,
        fill: Fill | None = None,
    ) -> Tensor:
        """Warp images.

        Args:
            images: (B, C, H, W) of the source's image_size, floating point, integer or bool.
            mode: instead of the warp's own, for example "nearest" for a mask.
            padding_mode: likewise.
            fill: likewise.

        Returns:
            (B, C, H', W') of the target's image_size and of the same dtype. Images whose channels come last in memory
            give such results. Half precision is sampled in float32; integers are rounded and stay in their range, bool
            is true from one half on. The nearest integers are exactly those of the image. Integers and bool have no
            gradient, and learning cameras cost them nothing.

        Raises:
            ValueError: another shape or size. TypeError: no tensor, or a complex one.
        """
        sampled = self._checked(images, mode, padding_mode, fill)
        if sampled[0] != "nearest" and self.target_shutter is not None and (moments := self._moments()):
            return averaged(images, [self._at(moment) for moment in moments], self.target_shutter.gamma, *sampled)
        inputs = self._inputs()
        learns = images.dtype.is_floating_point and self._learns(inputs)
        if self._is_operator() and not learns and compiled.takes(images, inputs):
            options = self.tolerance, self.antialias, self._reach(sampled[1]), *sampled
            return compiled.warped(images, self.source, self.target, self.rotation, *options)
        if self._is_long() and not (learns or in_graph(images)):
            result = empty(images, self._count(images), self.target.size_for("Warp"))
            kept: dict[int, Pyramid] = {}
            for rows in self._rows(None):
                with torch.no_grad():
                    render(images, self._strip(rows, sampled[1]), *sampled, kept, result[:, :, rows.start : rows.stop])
            return result
        return render(images, self._learned() if learns else self._kept(inputs, sampled[1]), *sampled)

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def strips(
        self,
        images: Tensor,
        *,
        rows: int | None = None,
        mode: Mode | None = None,
        padding_mode: PaddingMode | None = None,
        fill: Fill | None = None,
    ) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Warp images by strips of the target, from top to bottom, for images so large that memory is short.

        Each strip has its own part of the grid, which is not kept, and of images that are not float32 or float64 it
        copies no more than a tile of it reads. No gradients. Pixels are those of `forward`, up to the rounding of
        positions in float32, a thousandth of a pixel in an image 10,000 pixels wide.

            result = torch.empty(3, *warp.target.image_size, dtype=torch.uint8)
            for rows, part, valid in warp.strips(image[None]):
                result[:, rows] = part[0]
                progress(rows.stop / len(result[0]), filled=valid.sum())

        `forward` does so by itself, on a CPU and without gradients, for grids of more than 32 million pixels.

        Args:
            images: as of `forward`.
            rows: of a strip; by default those of two million pixels.
            mode: as of `forward`.
            padding_mode: as of `forward`.
            fill: as of `forward`.

        Yields:
            the rows of the target, a slice; these rows of `forward`'s result (B, C, n, W'); and of `valid_mask`
            (B or 1, 1, n, W').
        """
        rows = None if rows is None else as_whole(rows, "rows", "Warp", least=1)
        return self._strips(images, rows, *self._checked(images, mode, padding_mode, fill))

    def _strips(
        self, images: Tensor, count: int | None, mode: Mode, padding_mode: PaddingMode, fill: tuple[float, ...]
    ) -> Iterator[tuple[slice, Tensor, Tensor]]:
        kept: dict[int, Pyramid] = {}
        for rows in self._rows(count):
            with torch.no_grad():
                where = self._strip(rows, padding_mode)
                part, valid = render(images, where, mode, padding_mode, fill, kept), self._on_image(where)
            yield slice(rows.start, rows.stop), part, valid

    def _checked(
        self, images: Tensor, mode: Mode | None, padding_mode: PaddingMode | None, fill: Fill | None
    ) -> tuple[Mode, PaddingMode, tuple[float, ...]]:
        """The options of one call, if they and the images are as they should be."""
        if not isinstance(images, Tensor) or images.dtype.is_complex:
            what = getattr(images, "dtype", "") if isinstance(images, Tensor) else type(images).__name__
            hint = _way_in(images, self.source.size_for("Warp")) if hasattr(images, "__array_interface__") else ""
            raise TypeError(f"Warp: images must be a tensor (B, C, H, W) of real numbers; got {what}{hint}")
        shape, expected = tuple(images.shape), self.source.size_for("Warp")
        if images.ndim in (3, 4) and shape[-3:-1] == expected and shape[-2:] != expected:
            to = "(2, 0, 1)[None]" if len(shape) == 3 else "(0, 3, 1, 2)"
            raise ValueError(
                f"Warp: images must be (B, C, H, W); got shape {shape}, with the channels last. "
                f"It goes in as image.permute{to}"
            )
        if images.ndim != 4:
            hint = "One image goes in as image[None], masks without channels as masks[:, None]"
            raise ValueError(f"Warp: images must be (B, C, H, W); got shape {shape}. {hint}")
        if shape[-2:] != expected:
            raise ValueError(
                f"Warp: images are {shape[-2:]} (height, width), but the source camera's image_size is {expected}; "
                "camera.crop makes that of a part of it, camera.resize that of another resolution"
            )
        if images.device != self.source.intrinsics.device:
            check_devices("Warp", images=images, source=self.source.intrinsics)
        cameras = math.prod(self.batch_shape)
        if cameras != 1 and images.shape[0] not in (1, cameras):
            raise ValueError(f"Warp: {images.shape[0]} images do not fit {cameras} cameras")
        values = self.fill if fill is None else as_fill(fill, "Warp")
        if len(values) not in (1, shape[1]):
            raise ValueError(f"Warp: fill has {len(values)} values, but the images have {shape[1]} channels")
        return (
            self.mode if mode is None else one_of(mode, MODES, "mode", "Warp"),
            self.padding_mode if padding_mode is None else one_of(padding_mode, PADDINGS, "padding_mode", "Warp"),
            values,
        )

    def _count(self, images: Tensor) -> int:
        cameras = math.prod(self.batch_shape)
        return images.shape[0] if cameras == 1 else cameras

    def grid(self) -> Tensor:
        """(B or 1, H', W', 2): positions for `grid_sample(..., align_corners=False)`; -9 where there is none."""
        return self._sampling().grid.clone(memory_format=torch.contiguous_format)

    def valid_mask(self) -> Tensor:
        """(B or 1, 1, H', W') bool: the pixel has a ray, and the source sees it on its image."""
        if self._is_long():
            with torch.no_grad():
                return torch.cat([self._on_image(self._strip(rows)) for rows in self._rows(None)], 2)
        return self._on_image(self._kept(self._inputs()))

    def _on_image(self, where: Sampling | Lattice) -> Tensor:
        where = where.pixels if isinstance(where, Lattice) else where
        grid = where.grid.detach()
        grid = grid if where.seam is None else where.seam.drawn_in(grid)
        pixels = (grid + 1) * grid.new_tensor(self.source.size_for("Warp")[::-1]) / 2 - 0.5
        return (where.mapped & self.source.contains(pixels)).unsqueeze(1)

    # -- where the images are sampled

    def _sampling(self) -> Sampling:
        inputs = self._inputs()
        where = self._learned() if self._learns(inputs) else self._kept(inputs)
        return where.pixels if isinstance(where, Lattice) else where

    def _learns(self, inputs: list[Tensor]) -> bool:
        """Whether there is to be a graph of the grid that is not there yet."""
        return self._pinned is None and keeps_graph(*inputs)

    def _learned(self) -> Sampling:
        """With a graph."""
        if in_jit_trace():
            raise RuntimeError(
                "Warp: torch.jit.trace and torch.onnx.export(dynamo=False) cannot record cameras that learn; "
                "torch.onnx.export(dynamo=True) and torch.export can. Or warp.requires_grad_(False), and one call "
                "before, make its map a constant"
            )
        return self._with_scale(*tabulate(*self._seen_by, self.rotation))

    def _with_scale(self, grid: Tensor, mapped: Tensor) -> Sampling:
        if self.antialias:
            return scaled(self.source, grid, mapped)
        return Sampling(grid, mapped, None, seam_of(self.source))

    def _reach(self, padding: PaddingMode | None) -> PaddingMode:
        """The padding that positions are for which serve the warp's own, and this one."""
        return max(self.padding_mode, padding or "zeros", key=PADDINGS.index)

    def _kept(self, inputs: list[Tensor], padding: PaddingMode | None = None) -> Sampling | Lattice:
        """Without a graph, until something changes; or what is pinned."""
        if is_exporting() and not torch.compiler.is_dynamo_compiling() and (constant := self._constant(padding)):
            return constant
        reach = self._reach(padding)
        if self._pinned is not None and (reach == self.padding_mode or isinstance(self._pinned, Sampling)):
            return self._pinned
        forms = [None if each is None else each.form for each in (self.shutter, self.target_shutter)]
        options = (self.source.form, self.target.form, self.rotation is None, self.antialias, self.tolerance, *forms)
        memo = self._memos[reach if self.tolerance else "zeros"]  # what is exact serves all
        kept: Sampling | Lattice = memo(inputs, options, lambda: self._whole(reach))
        return kept

    def _constant(self, padding: PaddingMode | None) -> Sampling | None:
        """The positions as a constant of an exported program, unless they depend on what it is given."""
        if self._pinned is None and not is_constant(self):
            return None

        def whole() -> Sampling:
            where = self._kept(inputs, padding)
            where = where.pixels if isinstance(where, Lattice) else where
            # a constant has memory of its own
            own = (t.detach().clone(memory_format=torch.contiguous_format) for t in (where.grid, where.mapped))
            return where._replace(grid=next(own), mapped=next(own))

        with set_aside() if self._pinned is not None else with_values(self):
            inputs = self._inputs()
            if self._pinned is not None:
                return whole()
            constant: Sampling = self._constants(inputs, (self._reach(padding), self.antialias, self.tolerance), whole)
            return constant

    def _is_operator(self) -> bool:
        """Whether code is compiled that calls this warp as one; it knows cameras of one model, and no shutters."""
        plain = self.shutter is None and self.target_shutter is None
        plain = plain and not (self.source.is_mixed or self.target.is_mixed)
        return is_for_here() and self.is_an_operator and plain

    def _whole(self, padding: PaddingMode) -> Sampling | Lattice:
        may = self._is_operator() and self.tolerance and self.target.intrinsics.is_cpu
        if may:
            where = self.source, self.target, self.rotation
            return self._with_scale(*compiled.positions(*where, self.tolerance, padding))
        return self._strip(range(self.target.size_for("Warp")[0]), padding)

    def _strip(self, rows: range, padding: PaddingMode | None = None) -> Sampling | Lattice:
        """Of some rows of the target."""
        reach = self._reach(padding)
        return locate(*self._seen_by, self.rotation, self.tolerance, self.antialias, rows, reach)

    @property
    def _seen_by(self) -> tuple[Camera, Camera]:
        """Source and target, each behind its shutter."""
        return in_motion(self.source, self.shutter), in_motion(self.target, self.target_shutter)

    def _moments(self) -> list[RollingShutter]:
        """Of an exposure that blurs."""
        return [] if self.target_shutter is None else self.target_shutter.moments()

    def _at(self, shutter: RollingShutter) -> Warp:
        """This warp at a moment of the exposure."""
        shutters: Shutters = {"shutter": self.shutter, "target_shutter": shutter}
        return self.between(self.source, self.target, self.rotation, **self.options, **shutters)

    def _rows(self, count: int | None) -> Iterator[range]:
        height, width = self.target.size_for("Warp")
        step = count or max(_STRIP // (max(math.prod(self.batch_shape), 1) * width), 1)
        return (range(top, min(top + step, height)) for top in range(0, height, step))

    def _is_long(self) -> bool:
        """Whether the grid is not to be made at once, nor kept."""
        # compared first, sizes that a program leaves open would be bounded in it
        if self._pinned is not None or torch.compiler.is_compiling():
            return False
        if math.prod((*self.batch_shape, *self.target.size_for("Warp"))) <= _MOST_KEPT:
            return False
        return not in_transform() and all(t.is_cpu and is_concrete(t) for t in self._inputs())

    def pin(self) -> Warp:
        """Have the grid computed once and for all, with its graph: for a warp whose cameras are not to change."""
        # what a transform makes dies with it; what inference mode makes could not be used in a graph later; the
        # operator of compiled code keeps its own
        if self._is_operator() and compiled.takes(self.target.intrinsics.detach(), self._inputs()):
            return self
        if not in_transform() and not torch.is_inference_mode_enabled():
            inputs = self._inputs()
            self._pinned = self._learned() if self._learns(inputs) else self._kept(inputs)
        return self

    def _inputs(self) -> list[Tensor]:
        turned = [] if self.rotation is None else [self.rotation]
        shutters = [t for each in (self.shutter, self.target_shutter) if each is not None for t in each.tensors]
        return [*self.source.tensors, *self.target.tensors, *turned, *shutters]

    # -- labels

    def transform_points(self, pixels: Numbers) -> tuple[Tensor, Tensor]:
        """Move pixels (B, *N, 2), or (*N, 2) for cameras without batch, from the source's to the target's image.

        Returns:
            pixels of the same shape, and valid (B, *N) bool: the source pixel has a ray, and the target sees
            it on its image. Pixels off the image keep their place; those without one get (-1, -1).
        """
        moved, mapped = self._move(pixels)
        return moved, mapped & self.target.contains(moved)

    def _move(self, pixels: Numbers, back: bool = False) -> tuple[Tensor, Tensor]:
        """Pixels of the source to the target's image, or back, and whether they have a place there, on it or not."""
        (source, target), rotation = self._seen_by, self.rotation
        if back:
            source, target, rotation = target, source, None if rotation is None else rotation.mT
        rays, has_ray = rays_of(source, pixels)
        moved, mapped = seen_by(target, turn(rotation, rays, "pixels"))
        valid = mapped & has_ray
        return torch.where(valid.unsqueeze(-1), moved, -1.0), valid

    def transform_boxes(self, boxes: Numbers) -> tuple[Tensor, Tensor]:
        """Move boxes (B, *N, 4), or (*N, 4): x1, y1, x2, y2 in pixel-centre coordinates.

        Returns:
            the boxes that enclose the moved outlines (curved: the edges are sampled), not clipped to the image, and
            valid (B, *N) bool: some part of what the box encloses is on the target's image, if only its inside. Of an
            outline only a part of which can be mapped, the box encloses that part and what the image shows of the
            inside, found in steps of a sixteenth of the image. Without either, or with x2 < x1 or y2 < y1, it is
            (-1, -1, -1, -1).

        Raises:
            ValueError: x2 < x1 or y2 < y1 in plain boxes, which seem to be x, y, width, height; not in those that a
                network predicted, in a graph or under `torch.no_grad`.
        """
        boxes = as_values(boxes, "boxes", "Warp", self.source.intrinsics.device)
        if boxes.ndim == 0 or boxes.shape[-1] != 4:
            raise ValueError(f"Warp: boxes must be (B, *N, 4) = x1, y1, x2, y2; got shape {tuple(boxes.shape)}")
        if not boxes.dtype.is_floating_point:
            boxes = boxes.to(self.source.intrinsics.dtype)
        if not is_predicted(boxes):
            check_boxes(boxes, "boxes", "Warp")
        enclosing, valid = self.enclose(corners_of(boxes))
        ordered = in_order(boxes)
        return torch.where(ordered.unsqueeze(-1), enclosing, -1.0), valid & ordered

    def enclose(self, corners: Tensor) -> tuple[Tensor, Tensor]:
        """As `transform_boxes`, of closed polygons (B, *N, K, 2), or (*N, K, 2)."""
        corners = as_coordinates(corners, "corners", 2, "Warp", self.source.intrinsics.device, "B, *N, K")
        if corners.ndim < 2:
            raise ValueError(f"Warp: corners must be (B, *N, K, 2); got shape {tuple(corners.shape)}")
        finite = torch.isfinite(corners).flatten(-2).all(-1, keepdim=True)
        moved, mapped = self._move(along_edges(corners, _EDGE_SAMPLES))
        mapped = mapped & finite
        low = torch.where(mapped.unsqueeze(-1), moved, torch.inf).amin(-2)
        high = torch.where(mapped.unsqueeze(-1), moved, -torch.inf).amax(-2)
        some, valid = mapped.any(-1), (mapped & self.target.contains(moved)).any(-1)
        whole = mapped.all(-1)
        # an outline about a direction that the target does not map is turned inside out
        plain = valid & whole & (_area(corners) * _area(moved) > 0)
        if not may_look(valid) or isinstance(self.target, PANORAMAS) or not bool(plain.all()):
            lattice, inside = self._inside(corners, moved)
            inside = inside & finite
            some, valid = some | inside.any(-1), valid | inside.any(-1)
            inside = inside.unsqueeze(-1)
            low = torch.minimum(low, torch.where(inside, lattice, torch.inf).amin(-2))
            high = torch.maximum(high, torch.where(inside, lattice, -torch.inf).amax(-2))
        return torch.where(some.unsqueeze(-1), torch.cat((low, high), -1), -1.0), valid

    def _inside(self, corners: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
        """Points (N, 2) of a lattice from edge to edge of the target, and (B, *M, N): which show what polygons enclose.

        They find what encloses the whole image, or such parts of it as show the source, and has no outline there.
        """
        height, width = self.target.size_for("Warp")
        share = torch.linspace(0, 1, _LATTICE + 1, dtype=like.dtype, device=like.device)
        lattice = torch.cartesian_prod(share * width, share * height) - 0.5
        with torch.no_grad():
            shown, seen = self._move(lattice.expand(*self.batch_shape, *lattice.shape), back=True)
            if self.batch_shape:
                lead = len(shown), *[1] * (corners.ndim - 3), len(lattice)
                shown, seen = shown.reshape(*lead, 2), seen.reshape(lead)
            return lattice, within(corners, shown) & seen

    def transform_rays(self, rays: Numbers) -> Tensor:
        """Turn directions (B, *N, 3), or (*N, 3), from the source's to the target's frame; lengths stay.

        With shutters both frames are those of the middle of the readout.
        """
        rays = as_coordinates(rays, "rays", 3, "Warp", self.source.intrinsics.device, "B, *N")
        return turn(self.rotation, rays, "rays")

    def inverse(self) -> Warp:
        """The warp from target to source. What lay outside the image, or between its pixels, stays lost."""
        rotation = None if self.rotation is None else self.rotation.mT
        shutters: Shutters = {"shutter": self.target_shutter, "target_shutter": self.shutter}
        return self.between(self.target, self.source, rotation, **self.options, **shutters)

    def between(self, source: Camera, target: Camera, rotation: Tensor | None, **options: Any) -> Warp:
        """A warp as this one is, mirrored or not, between other cameras."""
        return Warp(source, target, rotation, **options)

    @property
    def shutters(self) -> Shutters:
        """Of source and target, as another Warp takes them."""
        return {"shutter": self.shutter, "target_shutter": self.target_shutter}

    @property
    def options(self) -> Options:
        """What another Warp takes to sample in the same way."""
        return {
            "mode": self.mode,
            "padding_mode": self.padding_mode,
            "fill": self.fill,
            "antialias": None if self._decides else self.antialias,  # type: ignore[typeddict-item]
            "tolerance": self._tolerance,
        }

    # -- for other runtimes

    def save(
        self,
        path: str | os.PathLike[str],
        format: str | None = None,
        *,
        step: int | None = None,
        v: Literal["up", "down"] | None = None,
        order: Literal["yx", "xy"] | None = None,
        block: tuple[int, int] | None = None,
        dtype: Literal["float32", "uint8"] | None = None,
        clip: bool | None = None,
    ) -> MapReport:
        """Write where each pixel of the target is taken from, for another runtime, and measure what was written.

        What the file holds is read back, interpolated as its runtime does, and compared with the exact positions, at
        every pixel that shows the source's image. A map holds positions alone: mode, padding, fill and antialias are
        the runtime's, but for "onnx", which holds all but the last.

        Args:
            path: of the file, replaced as a whole or not at all. Bare tables get a description beside them, PATH.json.
            format: "opencv" (.yml, .xml, .npz), "opencv_fixed" (the same), "stmap" (.exr, .tif), "dw100", "ti_ldc",
                "depthai", "obj", "gltf" (.glb, .gltf) or "onnx"; by default what the suffix says.
            step: pixels of the target between the nodes of a mesh: 16 by default for "depthai", "obj" and "gltf", 8 for
                "ti_ldc", where it is a power of two up to 128.
            v: "stmap": "up", as Nuke has it and by default, or "down".
            order: "depthai": "yx" for loadMeshFiles, the default, or "xy" for setWarpMesh.
            block: "ti_ldc": (height, width) of the blocks of the target; by default the largest that can be had.
            dtype: "onnx": of the images, "float32" by default.
            clip: "dw100", "ti_ldc": draw in positions that the format cannot hold, rather than refuse them.

        Raises:
            CameraFileError: a format that cannot hold this warp; it says why. ValueError: a batch of warps, an unknown
                format, an option that it does not have. ImportError: a library that it needs is missing; the error
                names the extra. OSError: the file cannot be written.
        """
        from camtorch.maps.formats import save_map  # all formats of maps: only when needed

        return save_map(self, path, format, step=step, v=v, order=order, block=block, dtype=dtype, clip=clip)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_pinned": None}

    def extra_repr(self) -> str:
        """The options."""
        options = ", ".join(
            f"{name}={value!r}" for name, value in {**self.options, "tolerance": self.tolerance}.items()
        )
        return f"{options}, rotation={self.rotation is not None}"


def as_shutter(shutter: RollingShutter | None, name: str) -> RollingShutter | None:
    """A shutter of a warp, if it is one."""
    if shutter is not None and not isinstance(shutter, RollingShutter):
        raise TypeError(
            f"Warp: {name} must be a RollingShutter; got {type(shutter).__name__}. ct.RollingShutter(readout, rates) "
            "makes one, of seconds and radians per second"
        )
    return shutter


_WAYS = {
    "(H, W)": ("[None, None]", "[0, 0]"),
    "(H, W, C)": (".permute(2, 0, 1)[None]", "[0].permute(1, 2, 0)"),
    "(C, H, W)": ("[None]", "[0]"),
    "(B, H, W, C)": (".permute(0, 3, 1, 2)", ".permute(0, 2, 3, 1)"),
    "(B, C, H, W)": ("", ""),
}


def _way_in(images: Any, size: tuple[int, int]) -> str:
    """In words, how an array of images, or what numpy takes for one, becomes a tensor, and an array again."""
    array = np.asarray(images)
    taken = "np.array(image)" if array is not images else "array"
    if any(step < 0 for step in array.strides):
        taken = "array.copy()"  # torch takes no negative strides
    last = array.shape[-2:] != size or array.shape[-3:-1] == size
    shape = {2: "(H, W)", 3: "(H, W, C)" if last else "(C, H, W)", 4: "(B, H, W, C)" if last else "(B, C, H, W)"}
    if array.ndim not in shape:
        return ""
    there, back = _WAYS[shape[array.ndim]]
    name = "An array" if taken != "np.array(image)" else "An image"
    return (
        f". {name} {shape[array.ndim]} goes in as torch.from_numpy({taken}){there}, and what comes out becomes one by "
        f"result{back}.numpy()"
    )


# -- outlines of boxes and polygons: enough points along the edges to follow them where a lens bends them


def corners_of(boxes: Tensor) -> Tensor:
    """(..., 4, 2): the corners of boxes (..., 4) of x1 y1 x2 y2, clockwise from (x1, y1)."""
    x1, y1, x2, y2 = boxes.unbind(-1)
    corners: Tensor = torch.stack((x1, y1, x2, y1, x2, y2, x1, y2), -1).unflatten(-1, (4, 2))
    return corners


def in_order(boxes: Tensor) -> Tensor:
    """(...) bool: whether boxes (..., 4) have x1 <= x2 and y1 <= y2; those of x, y, width, height seldom do."""
    ordered: Tensor = (boxes[..., :2] <= boxes[..., 2:]).all(-1)
    return ordered


def along_edges(corners: Tensor, samples: int) -> Tensor:
    """(..., samples * K, 2): even steps along the edges of closed polygons (..., K, 2), the corners among them."""
    share = torch.linspace(0, 1, samples + 1, dtype=corners.dtype, device=corners.device)[:-1, None]
    start, end = corners.unsqueeze(-2), corners.roll(-1, -2).unsqueeze(-2)
    return (start + (end - start) * share).flatten(-3, -2)


def _area(corners: Tensor) -> Tensor:
    """(...): of polygons (..., K, 2), negative for those that go round the other way."""
    (x, y), (next_x, next_y) = corners.unbind(-1), corners.roll(-1, -2).unbind(-1)
    return (x * next_y - next_x * y).sum(-1) / 2


def within(corners: Tensor, points: Tensor) -> Tensor:
    """(..., N) bool: whether points (..., N, 2) are inside closed polygons (..., K, 2), by the edges to their right."""
    x, y = points.unsqueeze(-2).unbind(-1)
    x1, y1 = corners.unsqueeze(-3).unbind(-1)
    across, down = x1.roll(-1, -1) - x1, y1.roll(-1, -1) - y1
    above = y1 <= y
    crossed = above != above.roll(-1, -1)
    to_the_right = ((x - x1) * down < across * (y - y1)) == (down > 0)
    inside: Tensor = (crossed & to_the_right).sum(-1) % 2 == 1
    return inside


def outlines(boxes: Tensor, samples: int = 16) -> Tensor:
    """The outlines of boxes, as polygons that an augmentation moves point by point.

    At the rim of a fisheye a box that encloses its warped outline is mostly background; the outline is not.

    Args:
        boxes: (..., 4) of x1 y1 x2 y2.
        samples: points on each edge.

    Returns:
        (..., 4 * samples, 2).
    """
    boxes = as_coordinates(boxes, "boxes", 4, "outlines", means=" = x1, y1, x2, y2")
    return along_edges(corners_of(boxes), as_whole(samples, "samples", "outlines", least=1))
