"""Warps to a camera at another place, by a depth map."""

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import are_plain, known_true
from camtorch.poses.extrinsics import Extrinsics
from camtorch.poses.rotations import rotation_matrix, turn
from camtorch.rays.depth import as_depth, depth_scale
from camtorch.values.arguments import Numbers, as_batch, check_devices, shown
from camtorch.values.dtypes import check_averaged
from camtorch.values.module import GeometryModule, typed_as
from camtorch.warp.lattice import PixelPositions, to_positions
from camtorch.warp.options import Fill, Mode, PaddingMode, Sampler, as_options
from camtorch.warp.panorama import off_poles, seam_of
from camtorch.warp.sampling import render
from camtorch.warp.warp import as_sized

_SNAP = {torch.float32: 4e-3, torch.float64: 1e-8}  # px, within which rounding may have moved a pixel


class Reproject(GeometryModule):
    """A warp from camera `source` to camera `target` at another place, by the target's depth.

    It is the backward warp of depth networks and stereo: the depth takes each target pixel to a point, and the source's
    image is sampled where the source sees that point. Differentiable in images, depth, extrinsics and both cameras.
    Depth is in the unit of the extrinsics. Cameras and extrinsics of a batch dim go sample by sample with the images.

        >>> camera = ct.Pinhole([40.0, 40.0, 31.5, 23.5], image_size=(48, 64))
        >>> warp = ct.Reproject(camera, camera, ct.Extrinsics([0.0, 0.0, 0.0], [-0.1, 0.0, 0.0]))
        >>> images, valid = warp(torch.zeros(2, 3, 48, 64), torch.ones(1, 1, 48, 64))
        >>> images.shape, valid.shape
        (torch.Size([2, 3, 48, 64]), torch.Size([2, 1, 48, 64]))

    Args:
        source: the camera of the given images.
        target: the camera of the images to make, and of the depth.
        extrinsics: source from target, `p_source = R p_target + t`.
        mode: "bilinear", "nearest" or "bicubic", as in `Warp`.
        padding_mode: "zeros", "border" or "reflection".
        fill: the value of pixels that show nothing.

    Raises:
        ValueError: If a camera has no image_size, batch dims do not fit, or an option is unknown.
        TypeError: If a camera is no Camera, or extrinsics are no Extrinsics.
    """

    source: Camera
    target: Camera
    batch_shape: torch.Size
    mode: Mode
    padding_mode: PaddingMode
    fill: tuple[float, ...]

    def __init__(
        self,
        source: Camera,
        target: Camera,
        extrinsics: Extrinsics,
        *,
        mode: Mode = "bilinear",
        padding_mode: PaddingMode = "zeros",
        fill: Fill = 0.0,
    ):
        super().__init__()
        owner = "Reproject"
        self.source, self.target = as_sized(source, "source", owner), as_sized(target, "target", owner)
        self.batch_shape = check_pose(owner, extrinsics, "source from target", source=source, target=target)
        self.extrinsics = extrinsics
        options = as_options(owner, mode, padding_mode, fill)
        self.mode, self.padding_mode, self.fill = options["mode"], options["padding_mode"], options["fill"]
        self._memo = Kept()
        seam_of(source)  # keep it while values can be read: traced code needs it too

    def forward(self, images: Tensor, depth: Numbers, kind: str = "z") -> tuple[Tensor, Tensor]:
        """Return the target's images and the mask of valid pixels.

        Args:
            images: (B, C, H, W) of the source's image_size, or features of that size.
            depth: (B, 1, H', W') of the target, or (B, D, H', W') for D depths to try at each pixel: planes of one
                depth each are `torch.linspace(near, far, D).view(1, D, 1, 1).expand(1, D, H', W')`.
            kind: the kind of depth: "z" along the optical axis, or "distance" from the camera.

        Returns:
            images (B, C, H', W'), and valid (B, 1, H', W') bool: the depth is valid, see `Camera.backproject`, and the
            source sees the point on its image. D > 1 depths give sweep volumes (B, C, D, H', W') and (B, 1, D, H', W').

        Raises:
            ValueError: If shapes do not fit, or the kind is unknown. TypeError: If depth is not numeric.
        """
        owner = "Reproject"
        size = self.source.size_for(owner)
        if not isinstance(images, Tensor) or images.ndim != 4 or tuple(images.shape[-2:]) != size:
            raise ValueError(f"{owner}: images must be a tensor (B, C, *image_size) of {size}; got {shown(images)}")
        check_devices(owner, images=images, source=self.source.intrinsics)
        check_averaged(images, self.mode, "images", owner)
        given = as_depth(depth, kind, self.target.size_for(owner), owner, self.target.intrinsics.device)
        given = given if given.ndim == 4 else given[None, None]
        counts = {"images": len(images), "depth": len(given), "cameras": self.batch_shape.numel()}
        count = max(counts.values())
        if any(n not in (1, count) for n in counts.values()):
            raise ValueError(f"{owner}: batch sizes must be 1 or equal; got {counts}")
        seen, valid = self._seen(given, kind)
        rows, steps = seen.shape[0], seen.shape[1]
        # an image that is shifted by whole pixels, or not at all, is copied to the bit
        plain = steps == 1 and are_plain(seen) and known_true((seen == seen.round()).all(-1) | ~valid)
        mode: Mode = "nearest" if plain else self.mode
        seam = seam_of(self.source)
        if seam is not None:  # the image goes on beyond its edges
            images, seen = seam.around(images), seen + seen.new_tensor(seam.rims[::2])
        positions = to_positions(seen.flatten(1, 2), valid.flatten(1, 2), (images.shape[-2], images.shape[-1]))
        valid = valid & (positions.detach().abs() <= 1).all(-1).view(valid.shape)
        where = PixelPositions(positions, valid.flatten(1, 2), None)
        result = render(images, where, Sampler(mode, self.padding_mode, self.fill))
        valid = valid.expand(max(rows, len(result)), *valid.shape[1:])[:, None]
        if steps == 1:
            return result, valid[:, :, 0]
        return result.unflatten(2, (steps, -1)), valid

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def _seen(self, depth: Tensor, kind: str) -> tuple[Tensor, Tensor]:
        """Return source pixels (B, D, H', W', 2), and whether they are valid."""
        target = self.target
        rays, has_ray = self._memo.unless_learning(target.tensors, target.form, target.rays)
        if rays.ndim == 3:
            rays, has_ray = rays[None], has_ray[None]
        scale, good = depth_scale(depth, rays[:, None], has_ray[:, None], kind)
        directions = turn(rotation_matrix(self.extrinsics.rotation).to(rays.dtype), rays, "rays")[:, None]
        shift = beside(self.extrinsics.translation, directions)
        # plane by plane is several times as fast
        parts = zip(shift.unbind(-1), directions.unbind(-1), strict=True)
        points = torch.stack([torch.addcmul(start, along, scale) for start, along in parts], -1)
        if self.source.batch_shape and len(points) != len(self.source.intrinsics):
            points = points.expand(len(self.source.intrinsics), *points.shape[1:])
        pixels, mapped = self.source.project(off_poles(self.source, points))
        # pixels that rounding moved off a pixel's centre are moved back, with their gradient
        near = pixels.detach().round()
        off = near - pixels.detach()
        off = torch.where(off.abs() <= _SNAP.get(pixels.dtype, 0.0), off, 0.0)
        return pixels + off, mapped & good

    def extra_repr(self) -> str:
        return f"mode={self.mode!r}, padding_mode={self.padding_mode!r}, fill={self.fill!r}"


def check_pose(owner: str, extrinsics: Extrinsics, between: str, **cameras: Camera) -> torch.Size:
    """Return the batch dim, or none, of cameras and the pose between them; raise if they do not fit."""
    if not isinstance(extrinsics, Extrinsics):
        raise TypeError(
            f"{owner}: extrinsics must be Extrinsics, {between}; got {type(extrinsics).__name__}. "
            "ct.Extrinsics.from_matrix(R, T) makes one from OpenCV's R and T"
        )
    intrinsics = {name: camera.intrinsics for name, camera in cameras.items()}
    check_devices(owner, **intrinsics, extrinsics=extrinsics.rotation)
    parts = {**cameras, "extrinsics": extrinsics}
    batch = as_batch(owner, **{name: (*part.batch_shape, 1) for name, part in parts.items()})
    if len(batch) > 1:
        raise ValueError(f"{owner}: cameras and extrinsics must have one batch dim at most; got {tuple(batch)}")
    return batch


def beside(vectors: Tensor, rays: Tensor) -> Tensor:
    """Return vectors (3,) or (B, 3) in the dtype of rays (B, *N, 3) and in a shape that broadcasts against them."""
    vectors = vectors.to(rays.dtype)
    return vectors if vectors.ndim == 1 else vectors.view(len(vectors), *[1] * (rays.ndim - 2), 3)
