"""Metric depth for any lens: a canonical focal length, for the images or for the depth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from torch import Tensor

from camtorch.augment.change import Change, by_models, one_or_batch
from camtorch.augment.part import Part
from camtorch.augment.plan import Batch
from camtorch.augment.sample import Sample, SampleTransform, on_samples
from camtorch.cameras.camera import Camera
from camtorch.cameras.editing import edited
from camtorch.cameras.mixed import Mixed
from camtorch.rays.lattices import slopes_at_axis
from camtorch.values.arguments import as_image_size, as_number, no_camera, shown
from camtorch.values.module import typed_as
from camtorch.warp.affine import AffineWarp


class CanonicalCamera(SampleTransform):
    """A transform of samples to one focal length, so that a network learns metric depth from many cameras.

    The size of a known object in an image determines its distance only if the focal length is known. With
    s = `focal` / the focal length of the camera, either

    * the depth becomes s times as large (`scales="depth"`), and so do all lengths in the camera's frame: distances, 3D
      points and landmarks, translations of poses. The scene is scaled, and its image in the camera is the same;
    * or the image becomes s times as large (`scales="image"`), and the depth keeps its values: the lens is the same,
      with exactly that focal length, and all labels of the image move with it.

    `inverse` moves predictions of a network back to the unit of depth, and to the image, of the original sample.

    The focal length of a camera of any model is its number of pixels per radian at the axis, the geometric mean of both
    directions: that of a pinhole camera, and for a lens independent of the model. It holds at the axis of a wide lens;
    a fisheye shows objects at its rim smaller, which a network can learn by their place.

    Source: Yin et al., "Metric3D: Towards zero-shot metric 3D prediction from a single image", ICCV 2023: the
    transforms of labels (CSTM_label) and of images (CSTM_image).

    Args:
        focal: Canonical focal length in pixels; 1000 in Metric3D.
        scales: "depth" or "image".
        image_size: (height, width) of the new images, with the same middle; the size of the image times s, rounded, if
            left out. Batches of several focal lengths need it.
        camera: Camera for samples without one.
        mode, padding_mode, fill, antialias, tolerance: See `Warp`; antialias=None is on if images shrink.
        fields, mask_fill, valid_mask: See `Augmentation`.

    A sample has the fields of an `Augmentation`; the result also has s as `scale` (B,), and "image" `source_camera`.

    Raises:
        ValueError: If the focal length is not positive, `scales` is another word, or a size is given with "depth".
    """

    _chooses_antialias = True
    _own_fields: ClassVar[Sequence[str]] = (*SampleTransform._own_fields, "scale", "source_camera")
    focal: float
    image_size: tuple[int, int] | None

    def __init__(
        self,
        focal: float,
        *,
        scales: Literal["depth", "image"] = "depth",
        image_size: Sequence[int] | None = None,
        antialias: bool | None = None,
        **options: Any,
    ):
        super().__init__(antialias=antialias, **options)
        focal = as_number(focal, "focal", self._name)
        if not 0 < focal < math.inf:
            raise ValueError(f"{self._name}: focal must be positive pixels; got {focal!r}")
        if not isinstance(scales, str) or scales not in ("depth", "image"):
            raise ValueError(f'{self._name}: scales must be "depth" or "image"; got {shown(scales)}')
        if image_size is not None and scales == "depth":
            raise ValueError(f'{self._name}: image_size must be None with scales="depth"; got {image_size}')
        self.focal, self.scales = focal, scales
        self.image_size = as_image_size(image_size, self._name)

    def scale(self, camera: Camera) -> Tensor:
        """Return s (*B,) for cameras (*B): `focal` divided by their focal length. fx and fy get its gradients."""
        if not isinstance(camera, Camera):
            raise TypeError(f"{self._name}.scale: camera must be a Camera; got {no_camera(camera)}")
        if isinstance(camera, Mixed):
            return camera._in_order(torch.cat([self.scale(group) for _, group in camera.groups]))
        k = camera.distortion.detach()
        batch, count = k.shape[:-1], k.shape[-1]
        slopes = slopes_at_axis(camera.optics, k.reshape(batch.numel(), count)).view(*batch, 2)
        return self.focal / ((camera.fx * camera.fy).sqrt() * slopes.prod(-1).sqrt())

    @on_samples
    def forward(self, sample: Mapping[str, Any] | None = None, **fields: Any) -> Sample:
        """Make a sample canonical: a dict or keyword arguments, single or a batch.

        Raises:
            ValueError: If there is no camera, images would get several sizes, or a field is wrong, see `Augmentation`.
        """
        sample = self._given(sample, fields)
        batch = self._batch(sample)
        camera, count = batch.camera, batch.plan.count
        scale = self.scale(camera).expand(count)
        if self.scales == "depth":
            moved = self._scale_sample(sample, batch, scale)
        else:
            moved = self._resize_sample(sample, batch, self._change(camera, count))
            source = camera.clone()
            moved["source_camera"] = list(source) if isinstance(sample.get("camera"), (list, tuple)) else source
        moved["scale"] = scale if batch.plan.batched else scale.squeeze(0)
        return moved

    @on_samples
    def inverse(self, sample: Mapping[str, Any] | None = None, **fields: Any) -> Sample:
        """Undo the forward call for a sample that it returned, or for predictions made from one.

        The sample has the `camera` of the images; with "image" instead the `source_camera` of the forward call.

        Raises:
            ValueError: If there is no such camera, or `forward` would raise.
        """
        sample = self._given(sample, fields)
        sample.pop("scale", None)
        if self.scales == "depth":
            batch = self._batch(sample, predicted=True)
            return self._scale_sample(sample, batch, 1 / self.scale(batch.camera).expand(batch.plan.count))
        source = sample.pop("source_camera", None)
        if source is None:
            raise ValueError(f"{self._name}: source_camera must be in the sample, as forward() returned it; got none")
        source = source if isinstance(source, Camera) else Mixed(source)
        change = self._change(source, len(source) if source.batch_shape else 1)
        # a batch dim would be the sample's
        target = change.target if source.batch_shape else one_or_batch(change.target)
        batch = self._batch(sample, target, predicted=True)
        change = change if change.count == batch.plan.count else self._change(source, batch.plan.count)
        return self._resize_sample(sample, batch, change.inverse())

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def _scale_sample(self, sample: Sample, batch: Batch, scale: Tensor) -> Sample:
        """Return the sample with every length of the camera's frame multiplied by `scale` (B,)."""
        moved, batched = dict(sample), batch.plan.batched
        for name, (found, value) in batch.rows().items():
            if isinstance(value, list):
                moved[name] = [self._lengths(found, v, s, name) for v, s in zip(value, scale, strict=True)]
            else:
                new = self._lengths(found, value, scale, name)
                moved[name] = new if batched else new.squeeze(0)
        return moved

    def _lengths(self, found: str, value: Tensor, scale: Tensor, name: str) -> Tensor:
        """Return `value` (*B, ...) of the kind `found`, with all its lengths multiplied by `scale` (*B)."""
        kind = "points" if found == "landmarks" and value.shape[-1] == 3 else found
        are_lengths = kind in ("depth", "distance", "points", "tvec")
        if not are_lengths and kind not in ("head_pose", "pose"):
            return value
        if not value.is_floating_point():
            raise ValueError(f"{self._name}: {name} must be floating point, to be scaled; got {value.dtype}")
        factor = scale.to(value).reshape(*scale.shape, *[1] * (value.ndim - scale.ndim))
        if are_lengths:
            return value * factor
        places = torch.zeros_like(value, dtype=torch.bool)
        places[..., :3, 3] = True
        return torch.where(places, value * factor, value)

    def _resize_sample(self, sample: Sample, batch: Batch, change: Change) -> Sample:
        moved = self._moved(sample, batch, change)
        if "rotation" not in sample:  # the sample is not rotated
            del moved["rotation"]
        return moved

    def _change(self, camera: Camera, count: int) -> Change:
        height, width = camera.height, camera.width
        size = self.image_size or (height, width)
        if self.image_size is None:
            scales = self.scale(camera).double().flatten().tolist()
            sizes = {(max(round(height * s), 1), max(round(width * s), 1)) for s in scales}
            if len(sizes) > 1:
                got = f"None, and sizes {sorted(sizes)}. image_size=(height, width) cuts or fills them to one"
                raise ValueError(f"{self._name}: image_size must be given for several focal lengths; got {got}")
            size = sizes.pop() if sizes else size

        def part(rows: list[int] | None, source: Camera) -> Part:
            scale = self.scale(source).double()
            zero = torch.zeros_like(scale)
            # the middle between the outer edges remains the middle
            sides = zip(size[::-1], (width, height), strict=True)
            left, top = ((new - 1) / 2 - (old - 1) / 2 * scale for new, old in sides)
            matrix = torch.stack((scale, zero, left, zero, scale, top), -1).unflatten(-1, (2, 3))
            return Part(source, AffineWarp(source, edited(source, matrix, size), matrix, None, **self.options))

        return by_models(count, camera, part)

    def extra_repr(self) -> str:
        size = "" if self.image_size is None else f", image_size={self.image_size}"
        return f"focal={self.focal:g}, scales={self.scales!r}{size}"
