"""Rectification: two warps after which a point of the scene lies in the same row of both images."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from camtorch._arguments import (
    Numbers,
    as_coordinates,
    as_flag,
    as_fov,
    as_image_size,
    as_number,
    as_points,
    as_values,
    check_path,
    fails,
    hinting,
    shown,
)
from camtorch._module import GeometryModule, Memo, typed_as
from camtorch.calibration.rig import RigCalibration
from camtorch.calibration.triangulate import moved_by_calibration
from camtorch.camera import Camera
from camtorch.extrinsics import Extrinsics
from camtorch.io.filestorage import Value, write
from camtorch.models import Cylindrical, Equirectangular, LatLon, Pinhole, TransverseCylindrical
from camtorch.native.sampler import Later, finish
from camtorch.rotations import rotation_matrix, skew_matrix
from camtorch.warp import routes
from camtorch.warp.dewarp import middle_lines
from camtorch.warp.proxy import check_pose
from camtorch.warp.warp import Warp, as_sized, checked

Projection = Literal["perspective", "latlon", "cylindrical"]
Align = Literal["mean", "opencv"]

_TURN = math.radians(170)  # up and down, that a panorama shows without being asked for more
_STEEP = math.tan(math.radians(60))  # beyond it the rim of a perspective image is stretched more than fourfold
_NEAR_POLE = math.radians(75)  # where a panorama about the baseline hardly resolves distances


class _Kind(NamedTuple):
    """A projection: the models whose rows, or columns, correspond, and how far its plane reaches along and across."""

    rows: type[Camera]
    columns: type[Camera]
    along: float
    across: float


_KINDS = {
    "perspective": _Kind(Pinhole, Pinhole, _STEEP, _STEEP),
    "latlon": _Kind(LatLon, Equirectangular, _NEAR_POLE, _TURN),
    "cylindrical": _Kind(TransverseCylindrical, Cylindrical, math.tan(_NEAR_POLE), _TURN),
}
_LINE = 129  # points along the middle of an image
_PARALLEL = 1e-6  # the part of the view direction across the baseline, below which there is none
_STEP = 1e-4  # on the plane of a projection, over which its scale is measured
_TOGETHER = 1 << 16  # points
_LARGEST = 8  # times the longest side of a camera, a side that nobody asked for


class Frame(NamedTuple):
    """Rotations (*B, 3, 3), `ray_rectified = R ray_camera`, and the right camera's place on the axis, (*B,)."""

    left: Tensor
    right: Tensor
    baseline: Tensor


class Rectification(GeometryModule):
    """Two warps into images whose rows correspond, or whose columns do: what `rectify` makes.

    `left` and `right` are `Warp`s; the call makes both images. Disparity is u_left - u_right in pixels, v_left -
    v_right where columns correspond. Both images have the same camera, turned the same way: its x axis (y axis, where
    columns correspond) lies along the baseline, and the right one stands at `baseline` on it.

    Where the cameras or the extrinsics learn, the warps are made anew each time, and gradients reach them.
    """

    source_left: Camera
    source_right: Camera
    extrinsics: Extrinsics
    camera_right: Camera
    vertical: bool

    def __init__(
        self,
        source_left: Camera,
        source_right: Camera,
        extrinsics: Extrinsics,
        camera: Camera,
        projection: Projection,
        vertical: bool,
        align: Align,
    ):
        super().__init__()
        self.source_left, self.source_right, self.extrinsics = source_left, source_right, extrinsics
        self.camera_left = self.camera_right = camera
        self.projection, self.vertical, self.align = projection, vertical, align
        self._axis, self._memo = int(vertical), Memo()

    @property
    def frame(self) -> Frame:
        """How both cameras are turned, and how far they are apart; with a graph where the extrinsics learn."""
        return frame_of(self.extrinsics, self.vertical, self.align)

    @property
    def baseline(self) -> Tensor:
        """(*B,) the right camera's place on the axis of the rectified left one; negative where it stands to the left
        (above).
        """
        return self.frame.baseline

    @property
    def rotation_left(self) -> Tensor:
        """(*B, 3, 3), `ray_rectified = R ray_left`: OpenCV's R1."""
        return self.frame.left

    @property
    def rotation_right(self) -> Tensor:
        """(*B, 3, 3), `ray_rectified = R ray_right`: OpenCV's R2."""
        return self.frame.right

    @property
    def left(self) -> Warp:
        """From the left camera's image to its rectified one."""
        return self._warps()[0]

    @property
    def right(self) -> Warp:
        """From the right camera's image to its rectified one."""
        return self._warps()[1]

    def _warps(self) -> tuple[Warp, Warp]:
        inputs = self.extrinsics.rotation, self.extrinsics.translation
        if torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
            return self._made()
        warps: tuple[Warp, Warp] = self._memo(inputs, (), self._made)
        return warps

    def _made(self) -> tuple[Warp, Warp]:
        frame, target, left, right = self.frame, self.camera_left, self.source_left, self.source_right
        return (
            Warp(left, target, frame.left.to(left.intrinsics.dtype)),
            Warp(right, target, frame.right.to(right.intrinsics.dtype)),
        )

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        """Both images, (B, C, H, W) each, rectified."""
        later: Later = []  # threads share both: they are waited for once
        of_left, of_right = (
            routes.warped(warp, images, checked(warp, images, None, None, None), later)
            for warp, images in zip(self._warps(), (left, right), strict=True)
        )
        finish(later)
        return of_left, of_right

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def valid_masks(self) -> tuple[Tensor, Tensor, Tensor]:
        """(B or 1, 1, H, W) bool: pixels that the left camera sees, that the right one sees, that both do."""
        left, right = (warp.valid_mask() for warp in self._warps())
        return left, right, left & right

    # -- depth

    def disparity_to_points(self, disparity: Numbers, valid: Numbers | None = None) -> tuple[Tensor, Tensor]:
        """The points of the scene that have these disparities, in the frame of the rectified left camera.

        Args:
            disparity: (B, 1, H, W), (1, H, W) or (H, W) pixels, of the rectified left image; OpenCV's matchers give
                sixteen times as much in integers.
            valid: bool, in the same shape: the disparities that count.

        Returns:
            points (..., 3) after the shape of the disparities, in the unit of the extrinsics, and valid in their shape:
            the disparity is finite and has the sign of the baseline. What is not valid is (0, 0, 0).

        Raises:
            ValueError: another shape.
        """
        owner, camera = "disparity_to_points", self.camera_left
        size = camera._size_for(owner)
        d = as_values(disparity, "disparity", owner, camera.intrinsics.device)
        shape, count = tuple(d.shape), self.extrinsics.batch_shape.numel()
        if d.ndim not in (2, 3, 4) or shape[-2:] != size or (d.ndim > 2 and shape[-3] != 1):
            raise ValueError(f"{owner}: disparity must be (B, 1, H, W), (1, H, W) or (H, W) of {size}; got {shape}")
        if not d.is_floating_point():
            raise ValueError(
                f"{owner}: disparity must be floating point pixels; got {d.dtype}. Of OpenCV's matchers "
                "disparity.astype(np.float32) / 16 is"
            )
        batched = bool(self.extrinsics.batch_shape or camera.batch_shape)
        if batched and (d.ndim != 4 or len(d) not in (1, count, camera.batch_shape.numel())):
            raise ValueError(f"{owner}: disparity must be (B, 1, H, W) for {count} pairs; got {shape}")
        try:
            known = torch.as_tensor(True if valid is None else valid, device=d.device).to(torch.bool)
        except (TypeError, ValueError, RuntimeError):
            raise TypeError(f"{owner}: valid must be a mask in the shape of disparity; got {shown(valid)}") from None
        if valid is not None and tuple(known.shape) != shape:
            raise ValueError(f"{owner}: valid must have the shape of disparity, {shape}; got {tuple(known.shape)}")
        points, good = self._points(self._pixels(), d.reshape(-1, *size))
        good = good.reshape((len(good), 1, *size) if batched else shape)
        points, good = points.reshape(*good.shape, 3), good & known
        return torch.where(good[..., None], points, 0.0), good

    def range_sigma(
        self,
        disparity: Numbers,
        sigma: Numbers,
        *,
        valid: Numbers | None = None,
        calibration: RigCalibration | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The standard deviations of the ranges of points, their distances from the left camera, to first order.

        Args:
            disparity: as in `disparity_to_points`.
            sigma: px, the standard deviation of disparities: a number, or a map in their shape.
            valid: as in `disparity_to_points`.
            calibration: of `calibrate_rig`, that the cameras and the extrinsics of this one pair are of: what it does
                not know of them is added.

        Returns:
            sigma of the range in the shape of the disparities, in the unit of the extrinsics, and valid as in
            `disparity_to_points`; 0 where invalid. No graph.

        Raises:
            ValueError: another shape, a negative sigma, a calibration of other cameras, or beside a batch of pairs.
        """
        owner = "range_sigma"
        with torch.inference_mode(False), torch.enable_grad():
            leaf = as_values(disparity, "disparity", owner, self.camera_left.intrinsics.device).detach().clone()
            dtype = leaf.dtype
            if leaf.is_floating_point():  # others are refused below
                leaf = leaf.double().requires_grad_()
            points, good = self.disparity_to_points(leaf, valid)
            distance = torch.linalg.vector_norm(torch.where(good[..., None], points, 1.0), dim=-1)
            (slope,) = torch.autograd.grad(torch.where(good, distance, 0.0).sum(), leaf)
        points, distance = points.detach(), distance.detach()
        noise = as_values(sigma, "sigma", owner, leaf.device).detach().double()
        if noise.ndim and noise.shape != leaf.shape:
            raise ValueError(
                f"{owner}: sigma must be a number, or of shape {tuple(leaf.shape)}; got {tuple(noise.shape)}"
            )
        if fails((noise >= 0) | ~good):
            raise ValueError(f"{owner}: sigma must be px, not negative or NaN; got {shown(sigma)}")
        variance = (slope * noise).square().expand(good.shape).clone()
        if calibration is not None:
            if self.extrinsics.batch_shape or self.camera_left.batch_shape:
                raise ValueError(f"{owner}: calibration is of one pair; this is a batch")
            pose = self.extrinsics.matrix().detach().double()
            poses = torch.stack((torch.eye(4).to(pose), pose))
            rig = (self.source_left, self.source_right), poses[:, :3, :3], poses[:, :3, 3]
            parts = []
            for some in (points[good] @ self.frame.left.detach()).split(_TOGETHER):  # in the left camera's frame
                seen = torch.ones(2, len(some), dtype=torch.bool, device=some.device)
                moved = moved_by_calibration(calibration, *rig, some, seen, owner)
                along = some / torch.linalg.vector_norm(some, dim=-1, keepdim=True)
                parts.append((along[:, None] @ moved).square().sum((-1, -2)))
            variance[good] += torch.cat(parts) if parts else 0.0
        return torch.where(good & torch.isfinite(variance), variance, 0.0).sqrt().to(dtype), good

    def _pixels(self) -> Tensor:
        """(*B, H, W, 2)."""
        camera = self.camera_left
        return camera.pixel_grid().expand(*camera.batch_shape, -1, -1, -1)

    def _points(self, pixels: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Where the rays of both images meet, of pixels (*B, H, W, 2) and disparities (B, H, W)."""
        camera, baseline = self.camera_left.each(Tensor.double), self.baseline[..., None, None]
        good = torch.isfinite(d) & (d * baseline > 0)
        step = torch.where(good, d, 1.0).double()[..., None] * _unit(self._axis, pixels.double())[:2]
        (left, one), (right, other) = camera.unproject(pixels.double()), camera.unproject(pixels - step)
        # in the plane of both, along the baseline and away from it
        a, b = left[..., self._axis], self.distance(left)
        c, e = right[..., self._axis], self.distance(right)
        sine = a * e - b * c
        good = good & one & other & (sine * baseline > 0)
        scale = torch.where(good, baseline * e / torch.where(good, sine, 1.0), 0.0)
        return (left * scale[..., None]).to(d.dtype), good & (scale > 0) & torch.isfinite(scale)

    def disparity(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The disparity of points (*B, *N, 3) of the frame of the rectified left camera, and whether both see them."""
        numbers, baseline = self.camera_left.intrinsics, self.baseline  # float64, which points need not become
        points, _ = as_points(points, "points", 3, baseline.shape, (numbers,), "Rectification.disparity")
        shift = baseline.to(points.dtype)[..., None] * _unit(self._axis, points)
        moved = points - shift.reshape(*baseline.shape, *[1] * (points.ndim - 1 - baseline.ndim), 3)
        (left, one), (right, other) = self.camera_left.project(points), self.camera_right.project(moved)
        return (left - right)[..., self._axis], one & other

    def disparity_range(self, near: float, far: float = math.inf) -> tuple[float, float]:
        """The least and the greatest disparity that points of a range of depths have, over all pixels and pairs.

        Args:
            near: the least depth: z in perspective, the distance from the baseline in the panoramas about it.
            far: the greatest.
        """
        near, far = (as_number(v, name, "disparity_range") for v, name in ((near, "near"), (far, "far")))
        if not 0 < near < far:
            raise ValueError(f"disparity_range: depths must be 0 < near < far; got near={near}, far={far}")
        found = torch.cat([self._at(near), self._at(far)])
        return float(found.min()), float(found.max())

    def depth_range(self, least: float, most: float) -> tuple[float, float]:
        """The other way: the least and the greatest depth that disparities between two have; infinite for zero."""
        least, most = (as_number(v, name, "depth_range") for v, name in ((least, "least"), (most, "most")))
        if not least < most:
            raise ValueError(f"depth_range: disparities must be least < most; got least={least}, most={most}")
        with torch.no_grad():
            ends = self.camera_left.intrinsics.new_tensor([least, most])[:, None, None]
            size = self.camera_left._size_for("depth_range")
            parts = [self._points(self._pixels(), end.expand(1, *size)) for end in ends]
            found = torch.cat([points[good] for points, good in parts])
            found = self._depth(found)
        if not len(found):
            return math.inf, math.inf
        return float(found.min()), math.inf if least <= 0 <= most else float(found.max())

    def distance(self, points: Tensor) -> Tensor:
        """Of points (..., 3) of the frame of the rectified left camera, from the baseline: depth in a panorama."""
        points = as_coordinates(points, "points", 3, "Rectification.distance")
        return torch.hypot(points[..., 1 - self._axis], points[..., 2])

    @torch.no_grad()
    def _at(self, depth: float) -> Tensor:
        """The disparities of all pixels at a depth."""
        if math.isinf(depth):
            return self.camera_left.intrinsics.new_zeros(1)
        rays, _ = self.camera_left.unproject(self._pixels())
        points = rays * (depth / self._depth(rays))[..., None]
        disparity, seen = self.disparity(points.expand(*self.baseline.shape, *points.shape[-3:]))
        return disparity[seen]

    def _depth(self, points: Tensor) -> Tensor:
        return points[..., 2] if self.projection == "perspective" else self.distance(points)

    def opencv(self) -> dict[str, Tensor]:
        """R1, R2, P1, P2 and Q, as `cv2.stereoRectify` returns them, for a perspective pair without batch.

        Raises:
            ValueError: another projection, or a batch.
        """
        if self.projection != "perspective" or self.extrinsics.batch_shape or self.camera_left.batch_shape:
            raise ValueError(f"Rectification.opencv: of one perspective pair alone; this is {self.projection}")
        frame, first = self.frame, torch.nn.functional.pad(self.camera_left.K, (0, 1))
        fx, fy, cx, cy = self.camera_left.intrinsics.unbind(-1)
        focal, zero = (fx, fy)[self._axis], torch.zeros_like(fx)
        shift = torch.zeros_like(first)
        shift[self._axis, 3] = -focal * frame.baseline
        # d = f b / z, and rows of Q are x, y, f and 1 / b times it
        q = torch.stack((zero + 1, fx / fy, zero, zero)).diag()
        q[:2, 3], q[2, 3] = -torch.stack((cx, cy * fx / fy)), fx
        q[3, 2] = fx / focal / frame.baseline.to(fx.dtype)
        return {"R1": frame.left, "R2": frame.right, "P1": first, "P2": first + shift, "Q": q}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file for `cv2.FileStorage`, .yml, .json or .xml: what `opencv` gives, the R and T of the pair, and
        image_width and image_height of the rectified images.

        Raises:
            ValueError: as `opencv`; another suffix. OSError: it cannot be written.
        """
        check_path(path, "Rectification.save")
        matrices, pose = self.opencv(), self.extrinsics.matrix()
        height, width = self.camera_left._size_for("Rectification.save")
        values: dict[str, Value] = {"image_width": width, "image_height": height}
        for name, matrix in {"R": pose[:3, :3], "T": pose[:3, 3:], **matrices}.items():
            values[name] = matrix.detach().double().tolist()
        write(path, values)

    def extra_repr(self) -> str:
        """How the images lie."""
        baseline = self.baseline.detach()
        far = f"of {baseline.numel()} pairs" if baseline.ndim else f"{float(baseline):.6g}"
        return f"{self.projection}, {'columns' if self.vertical else 'rows'} correspond, baseline {far}"


@hinting("OpenCV's K1, D1, K2, D2, R, T are ct.rectify(left, right, ct.Extrinsics(R, T)), of cameras from_matrix(K, D)")
def rectify(
    left: Camera,
    right: Camera,
    extrinsics: Extrinsics,
    *,
    projection: Projection = "perspective",
    fov: float | tuple[float, float] | None = None,
    image_size: Sequence[int] | None = None,
    vertical: bool = False,
    align: Align = "mean",
) -> Rectification:
    """Warps of two cameras' images into images whose rows correspond.

    The x axis of both lies along the baseline, from left to right; both look where the two cameras look on average.
    Cameras of any models and sizes will do. Without further wishes the images show, up and down, what both see, to
    the sides what either does, as finely as the sharper camera sees the middle of it.

    Args:
        left: the first camera, with image_size.
        right: the second one.
        extrinsics: right from left, `p_right = R p_left + t`, as OpenCV's stereoCalibrate gives R and T.
        projection: "perspective" up to 120 degrees; "latlon" and "cylindrical", panoramas about the baseline, for more.
        fov: degrees, horizontal, or (horizontal, vertical), of the rectified images, about their axis.
        image_size: (height, width) of the rectified images.
        vertical: for cameras that stand above each other: columns correspond, not rows.
        align: "mean" for the mean of both optical axes, orthogonal to the baseline; "opencv" halves the rotation
            between the cameras, as `cv2.stereoRectify` does.

    Raises:
        ValueError: cameras at one place, or that look along the baseline or away from each other; images of more than
            eight times the longest side of a camera, where no image_size is given; a projection or alignment that
            does not exist, a fov out of range or up to 2 pi, as in radians, cameras without image_size.
        TypeError: no cameras.
    """
    owner = "rectify"
    left, right = as_sized(left, "left", owner), as_sized(right, "right", owner)
    for value, name, known in ((projection, "projection", tuple(_KINDS)), (align, "align", ("mean", "opencv"))):
        if not isinstance(value, str) or value not in known:
            raise ValueError(f"{owner}: {name} must be one of {known}; got {shown(value)}")
    size, vertical = as_image_size(image_size, owner), as_flag(vertical, "vertical", owner)
    check_pose(owner, extrinsics, "right from left", left=left, right=right)
    with torch.no_grad():
        frame = frame_of(extrinsics, vertical, align)
        model = _KINDS[projection].columns if vertical else _KINDS[projection].rows
        views = [(left, frame.left), (right, frame.right)]
        low, high, focal = _extent(views, model, _KINDS[projection], vertical, owner)
        if fov is not None:
            high = _half(fov, projection, vertical, (high - low) / 2, owner)
            low = -high
        if size is None:
            size = _sides(high - low, focal, _LARGEST * max(left.height, left.width, right.height, right.width))
        camera = _target(model, low, high, size, fov)
    dtype = torch.promote_types(left.intrinsics.dtype, right.intrinsics.dtype)
    return Rectification(left, right, extrinsics, camera.to(dtype), projection, vertical, align)


def frame_of(extrinsics: Extrinsics, vertical: bool, align: Align) -> Frame:
    """The common frame of both cameras; in float64, with a graph where the extrinsics learn.

    Raises:
        ValueError: no baseline, or a view along it.
    """
    owner = "rectify"
    rotation = rotation_matrix(extrinsics.rotation.double())
    translation = extrinsics.translation.double()
    length = torch.linalg.vector_norm(translation, dim=-1)
    if fails(length > 0):
        raise ValueError(f"{owner}: the cameras stand at one place; extrinsics.translation is {translation.tolist()}")
    axis = int(vertical)
    if align == "opencv":
        half = rotation_matrix(-extrinsics.rotation.double() / 2)
        across = (half @ translation[..., None])[..., 0] / length[..., None]
        # the shortest turn that brings the baseline to its axis
        sign = torch.where(across[..., axis] > 0, 1.0, -1.0).to(across)
        aim = sign[..., None] * _unit(axis, across)
        skew, cosine = skew_matrix(torch.linalg.cross(across, aim, dim=-1)), (across * aim).sum(-1)
        turn = torch.eye(3).to(skew) + skew + skew @ skew / (1 + cosine)[..., None, None]
        return Frame(turn @ half.mT, turn @ half, -sign * length)
    toward = -(rotation.mT @ translation[..., None])[..., 0] / length[..., None]  # of the right camera, from the left
    view, upright = rotation[..., 2, :] + _unit(2, rotation), rotation[..., axis, :] + _unit(axis, rotation)
    sign = torch.where((toward * upright).sum(-1) < 0, -1.0, 1.0).to(toward)
    along = toward * sign[..., None]
    ahead = view - (view * along).sum(-1, keepdim=True) * along
    size = torch.linalg.vector_norm(ahead, dim=-1)
    if fails(size > _PARALLEL):
        raise ValueError(
            f"{owner}: the cameras look along their baseline, or away from each other: no direction lies before both"
        )
    ahead = ahead / size[..., None]
    third = torch.linalg.cross(along, ahead, dim=-1) if vertical else torch.linalg.cross(ahead, along, dim=-1)
    rows = (third, along, ahead) if vertical else (along, third, ahead)
    turned = torch.stack(rows, -2)
    return Frame(turned, turned @ rotation.mT, sign * length)


def _unit(axis: int, like: Tensor) -> Tensor:
    """(3,)."""
    return like.new_tensor([float(i == axis) for i in range(3)])


def _extent(
    views: list[tuple[Camera, Tensor]], model: type[Camera], kind: _Kind, vertical: bool, owner: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Lows and highs (*B, 2) on the plane of a projection, and (*B,) the focal length that loses nothing in the middle.

    Raises:
        ValueError: nothing that both see.
    """
    plane = model(torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64, device=views[0][1].device))
    limit = torch.tensor([kind.across, kind.along] if vertical else [kind.along, kind.across]).to(views[0][1])
    ends = []
    for camera, rotation in views:  # what the middle row and column of the image show
        lines = middle_lines(camera, rotation, plane, limit, _LINE)
        for end in (torch.inf, -torch.inf):
            one, other = (torch.where(valid, p[..., i], end) for i, (p, valid) in enumerate(lines))
            ends.append(torch.stack([w.amin(-1) if end > 0 else w.amax(-1) for w in (one, other)], -1))
    low_left, high_left, low_right, high_right = ends
    is_across = torch.tensor([vertical, not vertical], device=limit.device)
    low = torch.where(is_across, torch.maximum(low_left, low_right), torch.minimum(low_left, low_right))
    high = torch.where(is_across, torch.minimum(high_left, high_right), torch.maximum(high_left, high_right))
    if not bool((low < high).all()):
        raise ValueError(
            f"{owner}: no {'columns' if vertical else 'rows'} show what both cameras see; are the extrinsics right "
            "from left?"
        )
    middle = (low + high) / 2
    focal = torch.stack([_scale(*view, plane, middle) for view in views]).amax(0)
    if not bool((focal > 0).all()):
        raise ValueError(f"{owner}: neither camera sees the middle of the rectified images; give fov and image_size")
    return low, high, focal


def _scale(camera: Camera, rotation: Tensor, plane: Camera, middle: Tensor) -> Tensor:
    """(*B,) pixels of a camera per unit of the plane of a projection, at a point of it; 0 where it does not see it."""
    offsets = _STEP * middle.new_tensor([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    rays, _ = plane.unproject(middle[..., None, :] + offsets)
    pixels, valid = camera.project((rays @ rotation).to(camera.intrinsics.dtype))
    (a, b), (c, d) = (side.unbind(-1) for side in pixels.double()[..., 1::2, :].sub(pixels[..., ::2, :]).unbind(-2))
    return torch.where(valid.all(-1), (a * d - b * c).abs().sqrt() / (2 * _STEP), 0.0)


def _half(fov: float | tuple[float, float], projection: str, vertical: bool, usual: Tensor, owner: str) -> Tensor:
    """(*B, 2): half the width and the height of the plane of a projection.

    Raises:
        ValueError: angles that it does not reach.
    """
    angles = fov if isinstance(fov, (tuple, list)) else (fov,)
    if len(angles) not in (1, 2):
        raise ValueError(f"{owner}: fov must be horizontal, or (horizontal, vertical) degrees; got {fov!r}")
    half = usual.clone()
    for i, angle in enumerate(angles):
        is_along = (i == 1) == vertical
        most = 360 if not is_along and projection != "perspective" else 180
        angle = math.radians(as_fov(angle, owner, most, f" for {projection}"))
        straight = projection == "perspective" or (projection == "cylindrical" and is_along)
        half[..., i] = math.tan(angle / 2) if straight else angle / 2
    return half


def _sides(extent: Tensor, focal: Tensor, most: int) -> tuple[int, int]:
    """Height and width of images of that extent that lose nothing.

    Raises:
        ValueError: a side is longer than `most`.
    """
    width, height = (int(side) for side in (extent * focal[..., None]).reshape(-1, 2).amax(0).round().clamp(min=2))
    if max(height, width) > most:
        raise ValueError(
            f"rectify: as fine as the sharper camera the images would be {(height, width)}; give image_size=(height, "
            "width), and perhaps fov. Such sizes come of cameras that look along their baseline, or of extrinsics that "
            "are not right from left"
        )
    return height, width


def _target(model: type[Camera], low: Tensor, high: Tensor, size: tuple[int, int], fov: Any) -> Camera:
    """The camera of both images: square pixels, unless two angles and a size say otherwise."""
    extent, (height, width) = high - low, size
    shape = extent.new_tensor([width, height])
    both = shape / extent
    if fov is None:
        both = both.amin(-1, keepdim=True).expand_as(both)
    elif not (isinstance(fov, (tuple, list)) and len(fov) == 2):
        both = both[..., :1].expand_as(both)
    centre = (shape - 1) / 2 - both * (low + high) / 2
    return model(nn.Parameter(torch.cat((both, centre), -1), requires_grad=False), image_size=(height, width))
