"""The `Warp`: images and labels from one camera to another.

Other kinds of warps are subclasses, but for `Reproject`, which samples by a depth that comes with the images.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from camtorch.cameras.camera import Camera
from camtorch.native.structs import OUTSIDE
from camtorch.poses.rotations import as_rotation, transposed, turn
from camtorch.values.arguments import (
    LEFT,
    Numbers,
    as_coordinates,
    as_whole,
    broadcast_shapes,
    check_devices,
    no_camera,
    one_of,
)
from camtorch.values.dtypes import check_averaged, narrow, widen
from camtorch.values.module import typed_as
from camtorch.warp.arrays import Image, warped_alike
from camtorch.warp.boxes import enclosed, moved_boxes
from camtorch.warp.lattice import PixelPositions
from camtorch.warp.options import MODES, PADDINGS, Fill, Mode, Options, PaddingMode, Sampler, as_fill, as_options
from camtorch.warp.routes import KeptPositions, RoutedWarp


def as_sized(camera: Camera, name: str, owner: str) -> Camera:
    """Return the camera; raise if it is no camera or has no image_size."""
    if not isinstance(camera, Camera):
        raise TypeError(f"{owner}: {name} must be a Camera; got {no_camera(camera)}")
    if camera.image_size is None:
        how = "camera.replace(image_size=(height, width))"
        raise ValueError(f"{owner}: {name} must have an image_size; got None. Pass {how}")
    return camera


class Warp(RoutedWarp):
    """A layer that turns images of camera `source` into images of camera `target`, both at one place.

    Convention: `ray_target = R ray_source` (OpenCV's rectification R). Images are tensors (..., C, H, W), NumPy arrays
    (H, W, C) or PIL images, and the same kind comes back. Points, boxes and rays move from source to target. A batch of
    B cameras or rotations goes sample by sample with the images; a single one serves all.

        >>> source = ct.KannalaBrandt([80.0, 80.0, 63.5, 47.5], [0.02, -0.01, 0.0, 0.0], image_size=(96, 128))
        >>> warp = ct.Warp(source, ct.Pinhole([60.0, 60.0, 63.5, 47.5], image_size=(96, 128)))
        >>> images = warp(torch.zeros(8, 3, 96, 128))
        >>> pixels, valid = warp.transform_points([[100.0, 47.5], [63.5, 47.5]])

    Args:
        source: the camera of the given images.
        target: the camera of the images to make; its `image_size` is theirs.
        rotation: (3, 3) or (B, 3, 3) rotation matrix; may require grad. None is no rotation.
        mode: "bilinear", "nearest" (masks, labels) or "bicubic".
        padding_mode: "zeros", "border" or "reflection", for pixels that the source sees outside its image. A pixel
            without a ray, or whose ray the source cannot map, always takes `fill`.
        fill: the value of empty pixels, blended in at the rim of "zeros"; one, or one for each channel.
        antialias: if the image shrinks, a pixel is the mean of the area it covers, as wide in all directions as in the
            widest; compiled down to a sixteenth. Not for "nearest".
        tolerance: the largest error of sampling positions, in pixels of the source. Above zero they come from a lattice
            of every eighth pixel, several times as fast for new cameras; positions out of its reach are computed. By
            default 0.001 between cameras in float32, whose rounding costs as much, and zero in float64. Points, boxes
            and rays, and warps on a GPU, but those of augmentations, are always exact.

    A panorama of a whole turn goes on beyond its seam and poles: an `Equirectangular` or `Cylindrical` source as wide
    as 2 pi, or a `LatLon` or `TransverseCylindrical` one as tall, to 0.05 pixels, for all cameras of a batch; this
    copies the image. In a `Mixed`, or a `ShutterWarp`, it ends at its edges.

    The sampling grid is kept until something that it depends on changes or can learn. In a network the cameras are
    part of it: `warp.requires_grad_(False)` keeps an optimizer from moving them, `warp.source.freeze("fx")` one number.
    `print(warp)` shows "learns" if a camera or the rotation requires grad, and "fixed" if none does.

    Raises:
        ValueError: If a mode is unknown, a camera has no image_size, the rotation is no rotation or has a wrong shape,
            batch dims do not fit, or fill or tolerance is not valid.
        TypeError: If source or target is no Camera.
    """

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
    ):
        options = as_options("Warp", mode, padding_mode, fill, antialias, tolerance)
        rotation = None if rotation is None else as_rotation(rotation, "Warp")
        as_sized(source, "source", "Warp")
        as_sized(target, "target", "Warp")
        check_devices("Warp", source=source.intrinsics, target=target.intrinsics, rotation=rotation)
        shapes = [tuple(source.batch_shape), tuple(target.batch_shape)]
        shapes += [] if rotation is None else [tuple(rotation.shape[:-2])]
        try:
            batch = broadcast_shapes(*shapes)
        except ValueError:
            batch = torch.Size((0, 0))  # no valid batch
        if len(batch) > 1:
            got = ", ".join(map(str, shapes))
            raise ValueError(f"Warp: source, target and rotation must share one batch dim, or have none; got {got}")
        self.set_up(source, target, options, batch)
        self.turned_by(rotation)

    def forward(
        self,
        images: Image,
        *,
        mode: Mode | None = None,
        padding_mode: PaddingMode | None = None,
        fill: Fill | None = None,
    ) -> Image:
        """Warp images, and return the same kind: a tensor, a NumPy array or a PIL image.

        Args:
            images: a tensor (..., C, H, W) of the source's image_size: an image, a batch, or clips (B, T, C, H, W). Or
                an array (H, W), (H, W, C) or (N, H, W, C), or a PIL image. Floating point, uint8, uint16 or bool;
                labels, also of uint8, need mode="nearest", which takes any real dtype. With several cameras a tensor
                needs its batch dim; the camera of a clip serves all its frames.
            mode: overrides the warp's own, for example "nearest" for a mask.
            padding_mode: overrides the warp's own.
            fill: overrides the warp's own.

        Returns:
            Images of the target's image_size, of the same kind and dtype. Images with channels last in memory give
            results with channels last. Half precision is sampled in float32; integers are rounded and stay in range;
            bool is true from one half on; "nearest" copies integers exactly. Integers and bool have no gradient, and no
            cost if cameras learn; arrays and PIL images have no gradient. Of one array B cameras make (B, H', W', C).

        Raises:
            ValueError: If the shape or the size is wrong, channels come last in a tensor or first in an array, the
                colours of a PIL image are a palette's, several come of one, or other integers would be averaged.
            TypeError: If images are none of these kinds, or complex.
        """
        made: Any  # of the kind of the images
        call: Any = self.ready(images, mode, padding_mode) if fill is None else None
        if call is not None:
            made = call(images)
        elif isinstance(images, Tensor):
            made = self._of_tensor(images, mode, padding_mode, fill)
        else:
            warp = partial(self.forward, mode=mode, padding_mode=padding_mode, fill=fill)
            made = warped_alike(images, self.source.size_for("Warp"), "Warp", warp, self.source.intrinsics.device)
        return made  # type: ignore[no-any-return]

    def _of_tensor(
        self, images: Tensor, mode: Mode | None, padding_mode: PaddingMode | None, fill: Fill | None
    ) -> Tensor:
        """Return the result of `forward` for a tensor that no kept call fits."""
        sampler = checked(self, images, mode, padding_mode, fill)
        if images.ndim == 4:
            return self.warped(images, sampler)
        lead, cameras = images.shape[:-3], math.prod(self.batch_shape)
        if cameras == 1:
            made = self.forward(images[None].flatten(0, -4), mode=mode, padding_mode=padding_mode, fill=fill)
            return made.view(*lead, *made.shape[1:])
        # the frames of a clip are channels for its camera
        each = sampler.fill if len(sampler.fill) == 1 else sampler.fill * math.prod(lead[1:])
        made = self.warped(images.flatten(1, -3), sampler._replace(fill=each))
        return torch.unflatten(made, 1, images.shape[1:-2])

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
        """Warp images by strips of the target, from top to bottom, for images too large for the memory.

        Each strip has its own part of the grid, which is not kept; of images that are not float32 or float64 only
        the part that a tile reads is copied. No gradients. Pixels are those of `forward`, up to the rounding of
        positions in float32, a thousandth of a pixel in an image 10,000 pixels wide.

            result = torch.empty(3, *warp.target.image_size, dtype=torch.uint8)
            for rows, part, valid in warp.strips(image[None]):
                result[:, rows] = part[0]
                progress(rows.stop / len(result[0]), filled=valid.sum())

        On a CPU and without gradients, `forward` does this automatically for grids of more than 32 million pixels.

        Args:
            images: (B, C, H, W), a tensor.
            rows: number of rows of a strip; default: those of two million pixels.
            mode: as in `forward`.
            padding_mode: as in `forward`.
            fill: as in `forward`.

        Yields:
            the rows of the target, a slice; these rows of `forward`'s result (B, C, n, W'); and of `valid_mask`
            (B or 1, 1, n, W').
        """
        rows = None if rows is None else as_whole(rows, "rows", "Warp", least=1)
        if isinstance(images, Tensor) and images.ndim != 4:
            raise ValueError(f"Warp: images must be (B, C, H, W) for strips; got shape {tuple(images.shape)}")
        strips = self.in_strips(images, checked(self, images, mode, padding_mode, fill), rows)
        return ((rows, strip, self.on_image(where)) for rows, strip, where in strips)

    def grid(self) -> Tensor:
        """Return positions (B or 1, H', W', 2) for `grid_sample(..., align_corners=False)`; -9 for none."""
        where, seam = self.by_pixel(), self.seam
        if seam is None:
            return where.grid.clone(memory_format=torch.contiguous_format)
        grid = seam.on_image(where.grid, self.source.size_for("Warp"))
        return torch.where(where.mapped.unsqueeze(-1), grid, OUTSIDE)

    def valid_mask(self) -> Tensor:
        """Return (B or 1, 1, H', W') bool: whether the pixel has a ray, and the source sees it on its image."""
        with torch.no_grad():
            if self.route() == "strips":
                return torch.cat([self.on_image(where) for _, where in self.strip_positions()], 2)
            return self.on_image(self.positions("kept"))

    def pin(self) -> Warp:
        """Compute the grid once, with its graph, for a warp whose cameras will not change; return the warp."""
        # the operator of a compiled graph keeps its own; what inference mode makes could not be used in a graph later
        if self.is_pinned or self.goes_by_operator() or torch.is_inference_mode_enabled():
            return self
        learns = self.route() == "graph"
        every = range(self.target.size_for("Warp")[0])
        where = self.locate(every, self.padding_mode, 0.0) if learns else self.positions("kept")
        # a lattice serves one padding, and so do positions that were made of one on the CPU
        is_exact = learns or (isinstance(where, PixelPositions) and self.host is None)
        self._kept.renew(lambda: KeptPositions(where, PADDINGS if is_exact else [self.padding_mode]))
        return self

    def transform_points(self, pixels: Numbers) -> tuple[Tensor, Tensor]:
        """Move pixels (B, *N, 2), or (*N, 2) for cameras without batch, from the source's to the target's image.

        Returns:
            pixels of the same shape, and valid (B, *N) bool: the source pixel has a ray, and the target sees
            it on its image. Pixels off the image keep their place; pixels that cannot be mapped are (-1, -1).
        """
        return self.move(pixels, on_image=True)

    def transform_boxes(self, boxes: Numbers) -> tuple[Tensor, Tensor]:
        """Move boxes (B, *N, 4), or (*N, 4): x1, y1, x2, y2 in pixel-centre coordinates.

        Returns:
            boxes that enclose the moved outlines, whose edges are sampled, not clipped to the image, and valid (B, *N)
            bool: the target's image shows a part of what the box encloses. If only a part of an outline can be mapped,
            the box encloses it and the inside that the image shows, found in steps of a sixteenth of the image. Boxes
            that cannot be mapped, or have x2 < x1 or y2 < y1, are (-1, -1, -1, -1).

        Raises:
            ValueError: If plain boxes have x2 < x1 or y2 < y1, and so may be x, y, width, height; predicted boxes, in a
                graph or under `torch.no_grad`, are not checked.
        """
        return moved_boxes(self, boxes)

    def enclose(self, corners: Tensor) -> tuple[Tensor, Tensor]:
        """Move closed polygons (B, *N, K, 2), or (*N, K, 2), and return boxes as `transform_boxes` does."""
        return enclosed(self, corners)

    def transform_rays(self, rays: Numbers) -> Tensor:
        """Turn directions (B, *N, 3), or (*N, 3), from the source's to the target's frame; lengths stay."""
        rays = as_coordinates(rays, "rays", 3, "Warp", self.source.intrinsics.device, "B, *N")
        return turn(self.rotation, rays, "rays")

    def transform_positions(self, points: Tensor) -> Tensor:
        """Return points (B, *N, 3) of the source's frame in the target's."""
        return turn(self.rotation, points, "points")

    def moved_distance(self, distance: Tensor) -> Tensor:
        """Return distances (B, C, H, W) from the source as distances (B, C, H', W') from the target, 0 for none."""
        return self.pin()(distance, mode="nearest", padding_mode="zeros", fill=0.0)

    def moved_depth(self, depth: Tensor) -> Tensor:
        """Return depths along the source's z (B, 1, H, W) as those along the target's z (B, 1, H', W'), 0 for none."""
        wide = widen(depth)
        before, after = _ahead(self.source, wide), _ahead(self.target, wide)
        distance = torch.where(before.abs() > 1e-6, wide / before, 0.0)
        return narrow(self.moved_distance(distance) * after, depth.dtype)

    def __getattr__(self, name: str) -> Tensor | nn.Module:
        try:
            return super().__getattr__(name)
        except AttributeError as error:
            raise AttributeError(f"{error}. {LEFT}") from None

    def inverse(self) -> Warp:
        """Return the warp from target to source. Pixels outside the image, or between its pixels, stay lost."""
        return self.between(self.target, self.source, transposed(self.rotation), **self.options)

    def between(self, source: Camera, target: Camera, rotation: Tensor | None, **options: Any) -> Warp:
        """Return a warp like this one between other cameras.

        A kind of warp that is made of more than cameras, such as a shutter, keeps that unless `options` have another.
        """
        return Warp(source, target, rotation, **options)

    def own_parts(self, index: list[int] | None = None) -> dict[str, Any]:
        """Return what the warp, or these rows of a batch, is made of besides cameras, rotation and options.

        Names are those that `between` takes. A kind that has parts overrides both.
        """
        return {}

    def detach(self) -> Warp:
        """Return the same warp without a graph: it shares all numbers with this one, and does not learn."""
        parts = {"rotation": self.rotation, **self.own_parts()}
        parts = {name: part.detach() if hasattr(part, "detach") else part for name, part in parts.items()}
        return self.between(self.source.detach(), self.target.detach(), **self.options, **parts).share(self)

    @property
    def options(self) -> Options:
        """Options with which another `Warp` samples in the same way."""
        return {
            "mode": self.mode,
            "padding_mode": self.padding_mode,
            "fill": self.fill,
            "antialias": self.antialias,
            "tolerance": self._tolerance,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        if state.pop("_decides", False):  # an attribute before 0.5
            state["antialias"] = None
        super().__setstate__(state)
        for name in ("shutter", "target_shutter"):
            if self._modules.get(name) is not None and name not in self.own_parts():
                raise ValueError(f"{type(self).__name__}: a saved warp must have no {name}; got one of 0.3. {LEFT}")

    def extra_repr(self) -> str:
        """Return the options, then "learns" if a camera or the rotation requires grad, else "fixed"."""
        said = {**self.options, "tolerance": self.tolerance, "rotation": self.rotation is not None}
        learns = any(t.requires_grad for t in (*self.parameters(), *self.buffers()))
        return ", ".join([*(f"{name}={value!r}" for name, value in said.items()), "learns" if learns else "fixed"])


def _ahead(camera: Camera, like: Tensor) -> Tensor:
    """Return the z of every pixel's ray, (B or 1, 1, H, W); 0 without a ray."""
    rays, valid = camera.rays()
    z = (rays[..., 2] * valid).to(like)
    return z.reshape(-1, 1, *z.shape[-2:])


def checked(
    warp: Warp, images: Tensor, mode: Mode | None, padding_mode: PaddingMode | None, fill: Fill | None
) -> Sampler:
    """Return how a warp samples images in one call; raise if images or options are wrong."""
    expected = warp.source.size_for("Warp")
    if not isinstance(images, Tensor) or images.dtype.is_complex:
        what = images.dtype if isinstance(images, Tensor) else type(images).__name__
        raise TypeError(f"Warp: images must be a tensor (B, C, H, W) of real numbers; got {what}")
    shape, cameras = tuple(images.shape), math.prod(warp.batch_shape)
    if images.ndim > 2 and shape[-3:-1] == expected and shape[-2:] != expected:
        raise ValueError(
            f"Warp: images must be (..., C, H, W); got shape {shape}, with the channels last. "
            "A tensor goes in as images.movedim(-1, -3), an array as it is"
        )
    if images.ndim < 3 or (images.ndim == 3 and cameras != 1):
        hint = "One image goes in as image[None], masks without channels as masks[:, None]"
        forms = "(..., C, H, W)" if cameras == 1 else f"(..., C, H, W) for {cameras} cameras, with a batch dim"
        raise ValueError(f"Warp: images must be {forms}; got shape {shape}. {hint}")
    if shape[-2:] != expected:
        raise ValueError(
            f"Warp: images must have the source's image_size {expected} (height, width); got {shape[-2:]}. "
            "camera.crop returns the camera of a part of its image, camera.resize that of another resolution"
        )
    if images.device != warp.source.intrinsics.device:
        check_devices("Warp", images=images, source=warp.source.intrinsics)
    if cameras != 1 and images.shape[0] not in (1, cameras):
        raise ValueError(f"Warp: images must be 1 or {cameras}, one for each camera; got {images.shape[0]}")
    values = warp.fill if fill is None else as_fill(fill, "Warp")
    if len(values) not in (1, shape[-3]):
        raise ValueError(f"Warp: fill must have 1 value or {shape[-3]}, one for each channel; got {len(values)}")
    mode = warp.mode if mode is None else one_of(mode, MODES, "mode", "Warp")
    check_averaged(images, mode, "images", "Warp")
    padding = warp.padding_mode if padding_mode is None else one_of(padding_mode, PADDINGS, "padding_mode", "Warp")
    return Sampler(mode, padding, values)
