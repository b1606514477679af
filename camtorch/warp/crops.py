"""Several crops of each image of a batch: a warp whose cameras have two batch dims."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Unpack, cast

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.evaluate.door import keeps_graph
from camtorch.evaluate.kept import Kept
from camtorch.values.arguments import Numbers, as_values
from camtorch.warp.lattice import PixelPositions
from camtorch.warp.options import Fill, Mode, PaddingMode, TolerantOptions, as_options
from camtorch.warp.sampling import render
from camtorch.warp.warp import Warp, checked


def flattened(camera: Camera, batch: Sequence[int]) -> Camera:
    """Return one camera for each of the rows B * F of a batch (B, F); a single camera serves all.

    camera: a single one, one for each of B, or (B, F).
    """
    if len(camera.batch_shape) == 2:
        return camera.each(lambda t: t.expand(*batch, t.shape[-1]).flatten(0, 1))
    return camera[[i for i in range(batch[0]) for _ in range(batch[1])]] if camera.batch_shape else camera


class CropsWarp(Warp):
    """A `Warp` of cameras with batch dims (B, F), such as F crops of each of B images, as `ct.views.look_at` returns.

    Images (B, C, H, W), or (1, C, H, W) for all, give (B, F, C, H', W'), without a copy of an image for each crop.
    Images (B, F, C, H, W) go one by one, as crops do by `warp.inverse()`; so do frames (B, T, C, H, W) with a box for
    each. Arrays (H, W, C) or (N, H, W, C) give (F, H', W', C) of one image, or (B, F, H', W', C). Points, boxes and
    rays have the leading dims (B, F), as the grid and the mask have: points that all crops of an image share go in as
    `points[:, None].expand(-1, F, -1, -1)`.
    """

    def __init__(self, source: Camera, target: Camera, rotation: Tensor, **options: Unpack[TolerantOptions]):
        """Make it of valid cameras, single, (B,) or (B, F), and rotations (B, F, 3, 3); options as of `Warp`."""
        self.set_up(source, target, as_options("Warp", **options), rotation.shape[:-2])
        self.turned_by(rotation)
        self._rows = Kept()

    @property
    def by_rows(self) -> Warp:
        """The same as a warp of B * F rows, with its graph."""

        def made() -> Warp:
            source, target = (flattened(camera, self.batch_shape) for camera in (self.source, self.target))
            rotation = cast("Tensor", self.rotation).flatten(0, 1)
            return Warp.of_valid(source, target, self.options).turned_by(rotation)

        return self._rows.unless_learning(self.tensors, (*self.form, *self.options.values()), made)

    def _of_tensor(
        self, images: Tensor, mode: Mode | None, padding_mode: PaddingMode | None, fill: Fill | None
    ) -> Tensor:
        batch, lead, rows = self.batch_shape, images.shape[:-3], self.by_rows
        if lead not in (batch, batch[:1], (1,)) or images.ndim < 4:
            b, f = batch
            raise ValueError(
                f"Warp: images must be ({b}, C, H, W), or ({b}, {f}, C, H, W), as the cameras have the batch dims "
                f"({b}, {f}); got shape {tuple(images.shape)}. One image for all goes in as image[None]"
            )
        if len(lead) == 2 or len(images) == 1:
            one_by_one = images.flatten(0, 1) if len(lead) == 2 else images
            made = rows.forward(one_by_one, mode=mode, padding_mode=padding_mode, fill=fill)
            return torch.unflatten(made, 0, batch)
        sampler = checked(rows, images[:1], mode, padding_mode, fill)
        # the crops of an image are sampled as one, the first on top
        where = rows.by_pixel()
        parts = [None if part is None else part.unflatten(0, batch).flatten(1, 2) for part in where]
        made = render(rows.lengthened(images), PixelPositions(*parts), sampler)  # type: ignore[arg-type]
        return torch.unflatten(made, 2, (batch[1], self.target.height)).movedim(2, 1).contiguous()

    def strips(self, *args: Any, **options: Any) -> Iterator[Any]:
        """Raise: `warp.by_rows`, a warp for images (B * F, C, H, W), has strips."""
        raise ValueError(f"Warp: cameras must have one batch dim for strips; got {tuple(self.batch_shape)}")

    def grid(self) -> Tensor:
        """Return positions (B, F, H', W', 2); see `Warp.grid`."""
        return torch.unflatten(self.by_rows.grid(), 0, self.batch_shape)

    def valid_mask(self) -> Tensor:
        """Return (B, F, 1, H', W') bool; see `Warp.valid_mask`."""
        return torch.unflatten(self.by_rows.valid_mask(), 0, self.batch_shape)

    def pin(self) -> Warp:
        """Compute the grid now, unless it learns; return the warp."""
        if not keeps_graph(*self.tensors):
            self.by_rows.pin()
        return self

    def transform_points(self, pixels: Numbers) -> tuple[Tensor, Tensor]:
        """Move pixels (B, F, *N, 2); see `Warp.transform_points`."""
        return self._rowwise(self.by_rows.transform_points, pixels, "pixels")

    def transform_boxes(self, boxes: Numbers) -> tuple[Tensor, Tensor]:
        """Move boxes (B, F, *N, 4); see `Warp.transform_boxes`."""
        return self._rowwise(self.by_rows.transform_boxes, boxes, "boxes")

    def enclose(self, corners: Tensor) -> tuple[Tensor, Tensor]:
        """Move closed polygons (B, F, *N, K, 2); see `Warp.enclose`."""
        return self._rowwise(self.by_rows.enclose, corners, "corners")

    def transform_rays(self, rays: Numbers) -> Tensor:
        """Turn directions (B, F, *N, 3); see `Warp.transform_rays`."""
        turned: Tensor = self._rowwise(lambda rows: (self.by_rows.transform_rays(rows),), rays, "rays")[0]
        return turned

    def _rowwise(self, move: Callable[[Tensor], tuple[Tensor, ...]], values: Numbers, name: str) -> tuple[Any, ...]:
        """Return the results of `move` for values with the leading dims (B, F), with these dims."""
        values, batch = as_values(values, name, "Warp", self.source.intrinsics.device), self.batch_shape
        if values.shape[:2] != batch or values.ndim < 3:
            b, f = batch
            raise ValueError(
                f"Warp: {name} must be ({b}, {f}, ...), as the cameras have these batch dims; got shape "
                f"{tuple(values.shape)}. {name}[:, None].expand(-1, {f}, ...) gives each crop of an image the same"
            )
        return tuple(moved.unflatten(0, batch) for moved in move(values.flatten(0, 1)))

    def between(self, source: Camera, target: Camera, rotation: Tensor | None, **options: Any) -> Warp:
        """Return a warp like this one between other cameras."""
        return CropsWarp(source, target, cast("Tensor", rotation), **options)
