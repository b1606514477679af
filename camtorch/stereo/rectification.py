"""Rectification: two warps after which a point of the scene lies in the same row of both images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import known_false
from camtorch.models import Cylindrical, Equirectangular, LatLon, Pinhole, TransverseCylindrical
from camtorch.poses.extrinsics import Extrinsics
from camtorch.poses.rotations import rotation_matrix, skew_matrix
from camtorch.values.arguments import Numbers, as_flag, as_fov, as_image_size, as_values, hinting, one_of
from camtorch.values.module import GeometryModule, typed_as
from camtorch.warp.arrays import Image
from camtorch.warp.dewarp import middle_lines
from camtorch.warp.reproject import check_pose
from camtorch.warp.warp import Warp, as_sized

Projection = Literal["perspective", "latlon", "cylindrical"]
Align = Literal["mean", "opencv"]

_TURN = math.radians(170)  # up and down, at most, that a panorama shows by default
_STEEP = math.tan(math.radians(60))  # a perspective image is stretched more than fourfold beyond it
_NEAR_POLE = math.radians(75)  # from there a panorama about the baseline hardly resolves distances

# models for corresponding rows and for corresponding columns; the reach of their plane along the baseline and across it
_KINDS: dict[str, tuple[tuple[type[Camera], type[Camera]], tuple[float, float]]] = {
    "perspective": ((Pinhole, Pinhole), (_STEEP, _STEEP)),
    "latlon": ((LatLon, Equirectangular), (_NEAR_POLE, _TURN)),
    "cylindrical": ((TransverseCylindrical, Cylindrical), (math.tan(_NEAR_POLE), _TURN)),
}
_PARALLEL = 1e-6  # the part of the view direction across the baseline below which it counts as zero
_STEP = 1e-4  # on the plane of a projection, for finite differences of its scale
_MOST_ENLARGED = 8  # times the longest side of a camera, at most, for a default image_size


class Rectification(GeometryModule):
    """Two warps into images whose rows, or columns, correspond: the result of `rectify`.

    `left` and `right` are `Warp`s; the call returns both images. Disparity is u_left - u_right in pixels, or v_left -
    v_right if columns correspond. Both images have the same camera, turned the same way: its x axis (y axis if columns
    correspond) lies along the baseline, and the right one stands at `baseline` on it.

    If the cameras or the extrinsics learn, each call makes the warps again, and gradients reach them.
    """

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
        self.source_left = source_left
        self.source_right = source_right
        self.extrinsics = extrinsics
        self.camera_left = camera
        self.camera_right = camera
        self.vertical = vertical
        self.projection, self.align = projection, align
        self._axis, self._memo = int(vertical), Kept()

    def _frame(self) -> tuple[Tensor, Tensor, Tensor]:
        return _frame(self.extrinsics, self.vertical, self.align)

    @property
    def rotation_left(self) -> Tensor:
        """Rotation (*B, 3, 3), `ray_rectified = R ray_left`: OpenCV's R1."""
        return self._frame()[0]

    @property
    def rotation_right(self) -> Tensor:
        """Rotation (*B, 3, 3), `ray_rectified = R ray_right`: OpenCV's R2."""
        return self._frame()[1]

    @property
    def baseline(self) -> Tensor:
        """Position (*B,) of the right camera on the axis of the rectified left one; negative to the left (above)."""
        return self._frame()[2]

    @property
    def left(self) -> Warp:
        """Warp from the left camera's image to its rectified one."""
        return self._warps()[0]

    @property
    def right(self) -> Warp:
        """Warp from the right camera's image to its rectified one."""
        return self._warps()[1]

    def _warps(self) -> tuple[Warp, Warp]:
        def make() -> tuple[Warp, Warp]:
            left, right = self.source_left, self.source_right
            turn, other, _ = self._frame()
            return (
                Warp(left, self.camera_left, turn.to(left.intrinsics.dtype)),
                Warp(right, self.camera_right, other.to(right.intrinsics.dtype)),
            )

        return self._memo.unless_learning((self.extrinsics.rotation, self.extrinsics.translation), (), make)

    def forward(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Rectify both images, of the kinds that `Warp` takes."""
        to_left, to_right = self._warps()
        return to_left(left), to_right(right)

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def disparity_to_points(self, disparity: Numbers, valid: Numbers | None = None) -> tuple[Tensor, Tensor]:
        """Return the points of the scene for disparities, in the frame of the rectified left camera.

        Args:
            disparity: (B, 1, H, W), (1, H, W) or (H, W) pixels of the left image, 1/16 of OpenCV's integers.
            valid: Bool, in the same shape: the disparities that count.

        Returns:
            points (..., 3) after the shape of the disparities, in the unit of the extrinsics, and valid in their shape:
            whether the disparity is finite and has the sign of the baseline. Invalid points are (0, 0, 0).

        Raises:
            ValueError: If a shape is wrong.
        """
        owner, camera = "disparity_to_points", self.camera_left
        size = camera.size_for(owner)
        d = as_values(disparity, "disparity", owner, camera.intrinsics.device)
        shape, batched = tuple(d.shape), bool(self.extrinsics.batch_shape or camera.batch_shape)
        if d.ndim not in ((4,) if batched else (2, 3, 4)) or shape[-2:] != size or (d.ndim > 2 and shape[-3] != 1):
            some = "" if batched else ", (1, H, W) or (H, W)"
            raise ValueError(f"{owner}: disparity must be (B, 1, H, W){some} of {size}; got {shape}")
        if not d.is_floating_point():
            raise ValueError(
                f"{owner}: disparity must be floating point pixels; got {d.dtype}. Pass "
                "disparity.astype(np.float32) / 16 for OpenCV's matchers"
            )
        known = torch.as_tensor(True if valid is None else valid, device=d.device).bool()
        if valid is not None and tuple(known.shape) != shape:
            raise ValueError(f"{owner}: valid must have the shape of disparity, {shape}; got {tuple(known.shape)}")
        pixels = camera.pixel_grid().expand(*camera.batch_shape, -1, -1, -1)
        points, good = self._points(pixels, d.reshape(-1, *size))
        good = good.reshape((len(good), 1, *size) if batched else shape)
        points, good = points.reshape(*good.shape, 3), good & known
        return torch.where(good[..., None], points, 0.0), good

    def _points(self, pixels: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Intersect the rays of both images for pixels (*B, H, W, 2) and disparities (B, H, W)."""
        camera, baseline = self.camera_left.each(Tensor.double), self.baseline[..., None, None]
        good = torch.isfinite(d) & (d * baseline > 0)
        step = torch.where(good, d, 1.0).double()[..., None] * _unit(self._axis, pixels.double())[:2]
        (left, one), (right, other) = camera.unproject(pixels.double()), camera.unproject(pixels - step)
        # both rays in their plane, along the baseline and away from it
        across = 1 - self._axis
        (a, b), (c, e) = ((t[..., self._axis], torch.hypot(t[..., across], t[..., 2])) for t in (left, right))
        sine = a * e - b * c
        good = good & one & other & (sine * baseline > 0)
        scale = torch.where(good, baseline * e / torch.where(good, sine, 1.0), 0.0)
        return (left * scale[..., None]).to(d.dtype), good & (scale > 0) & torch.isfinite(scale)

    def opencv(self) -> dict[str, Tensor]:
        """Return R1, R2, P1, P2 and Q, as `cv2.stereoRectify` does, for a perspective pair without batch.

        Raises:
            ValueError: If the projection is another one, or there is a batch.
        """
        if self.projection != "perspective" or self.extrinsics.batch_shape or self.camera_left.batch_shape:
            raise ValueError(f"Rectification.opencv: pair must be a single perspective one; got {self.projection}")
        fx, fy, cx, cy = self.camera_left.intrinsics.unbind(-1)
        baseline, focal, zero = self.baseline, (fx, fy)[self._axis], torch.zeros_like(fx)
        first = torch.nn.functional.pad(self.camera_left.K, (0, 1))
        shift = torch.zeros_like(first)
        shift[self._axis, 3] = -focal * baseline
        # d = f b / z; the rows of Q are x, y, f and d / b, times a common factor
        q = torch.stack((zero + 1, fx / fy, zero, zero)).diag()
        q[:2, 3] = -torch.stack((cx, cy * fx / fy))
        q[2, 3] = fx
        q[3, 2] = fx / focal / baseline.to(fx.dtype)
        return {"R1": self.rotation_left, "R2": self.rotation_right, "P1": first, "P2": first + shift, "Q": q}

    def extra_repr(self) -> str:
        return f"{self.projection}, {'columns' if self.vertical else 'rows'} correspond"


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
    """Return warps of two cameras' images, of any models and sizes, into images whose rows correspond.

    The x axis of both lies along the baseline, from left to right, and the view direction is the mean of the cameras'.
    By default images show what both cameras see up and down, and either sees to the sides, at the finer resolution.

    Args:
        left: The first camera, with image_size.
        right: The second camera, with image_size.
        extrinsics: Right from left, `p_right = R p_left + t`, as OpenCV's stereoCalibrate gives R and T.
        projection: "perspective" up to 120 degrees; "latlon" and "cylindrical", panoramas about the baseline, for more.
        fov: Degrees, horizontal or (horizontal, vertical), of the rectified images, about their axis.
        image_size: (height, width) of the rectified images.
        vertical: Whether columns correspond instead of rows, for cameras above each other.
        align: "mean" for the mean of both optical axes, orthogonal to the baseline; "opencv" halves the rotation
            between the cameras, as `cv2.stereoRectify` does.

    Raises:
        ValueError: If cameras are at one place, or look along the baseline or away from each other; if default images
            exceed eight times a camera's side, a word is unknown, a fov is out of range, or an image_size is missing.
        TypeError: If `left` or `right` is not a camera.

    Example:
        >>> camera = ct.KannalaBrandt([300.0, 300.0, 319.5, 239.5], [0.1, 0.0, 0.0, 0.0], image_size=(480, 640))
        >>> pair = ct.rectify(camera, camera, ct.Extrinsics([0.0, 0.0, 0.0], [-0.1, 0.0, 0.0]), projection="latlon")
        >>> pair.camera_left
        LatLon(fx=299.996, fy=299.996, cx=292, cy=226.5, image_size=(454, 585), float32, frozen)
    """
    left, right = as_sized(left, "left", "rectify"), as_sized(right, "right", "rectify")
    one_of(projection, tuple(_KINDS), "projection", "rectify")
    one_of(align, ("mean", "opencv"), "align", "rectify")
    size = as_image_size(image_size, "rectify")
    vertical = as_flag(vertical, "vertical", "rectify")
    angles = [*fov] if isinstance(fov, (tuple, list)) else [fov]
    if fov is None:
        angles = []
    elif len(angles) not in (1, 2):
        raise ValueError(f"rectify: fov must be horizontal, or (horizontal, vertical) degrees; got {fov!r}")
    check_pose("rectify", extrinsics, "right from left", left=left, right=right)
    with torch.no_grad():
        turns = _frame(extrinsics, vertical, align)
        low, high, focal = _extent([(left, turns[0]), (right, turns[1])], projection, vertical)
        if angles:
            high = (high - low) / 2  # the default if an angle is not given
            for i, given in enumerate(angles):
                is_along = (i == 1) == vertical
                most = 180 if is_along or projection == "perspective" else 360
                angle = math.radians(as_fov(given, "rectify", most, f" for {projection}")) / 2
                straight = projection == "perspective" or (projection == "cylindrical" and is_along)
                high[..., i] = math.tan(angle) if straight else angle
            low = -high
        extent = high - low
        if size is None:
            sides = (extent * focal[..., None]).reshape(-1, 2).amax(0).round().clamp(min=2)
            size = int(sides[1]), int(sides[0])
            if max(size) > _MOST_ENLARGED * max(left.height, left.width, right.height, right.width):
                raise ValueError(
                    f"rectify: image_size must be given, as the default is too large; got {size}. Pass (height, width) "
                    "and check that extrinsics are right from left, and that no camera looks along the baseline"
                )
        # square pixels, unless two angles and a size are given
        sides = extent.new_tensor([size[1], size[0]])
        focals = sides / extent
        if len(angles) < 2:
            focals = (focals[..., :1] if angles else focals.amin(-1, keepdim=True)).expand_as(focals)
        intrinsics = torch.cat((focals, (sides - 1) / 2 - focals * (low + high) / 2), -1)
        camera = _KINDS[projection][0][vertical](nn.Parameter(intrinsics, requires_grad=False), image_size=size)
    dtype = torch.promote_types(left.intrinsics.dtype, right.intrinsics.dtype)
    return Rectification(left, right, extrinsics, camera.to(dtype), projection, vertical, align)


def _frame(extrinsics: Extrinsics, vertical: bool, align: Align) -> tuple[Tensor, Tensor, Tensor]:
    """Return rotations (*B, 3, 3) of both cameras to the common frame, and the right one's position (*B,), float64."""
    vector, translation = extrinsics.rotation.double(), extrinsics.translation.double()
    length = torch.linalg.vector_norm(translation, dim=-1)
    if known_false(length > 0):
        raise ValueError(f"rectify: extrinsics.translation must not be zero; got {translation.tolist()}")
    axis, rotation = int(vertical), rotation_matrix(vector)
    if align == "opencv":
        to_middle, upright = rotation_matrix(vector / 2), _unit(axis, rotation)
    else:
        to_middle, upright = torch.eye(3).to(rotation), rotation[..., axis, :] + _unit(axis, rotation)
    # the direction from the left camera to the right one, in the left one's frame or the middle of both
    toward = -(to_middle @ rotation.mT @ translation[..., None])[..., 0] / length[..., None]
    sign = torch.where((toward * upright).sum(-1) < 0, -1.0, 1.0).to(toward)
    along = toward * sign[..., None]
    if align == "opencv":  # the shortest turn that brings the baseline to its axis
        skew = skew_matrix(torch.linalg.cross(along, upright.expand_as(along), dim=-1))
        turn = torch.eye(3).to(skew) + skew + skew @ skew / (1 + along[..., axis])[..., None, None]
        return turn @ to_middle, turn @ to_middle.mT, sign * length
    view = rotation[..., 2, :] + _unit(2, rotation)
    ahead = view - (view * along).sum(-1, keepdim=True) * along
    if known_false(torch.linalg.vector_norm(ahead, dim=-1) > _PARALLEL):
        why = "got cameras that look along it, or away from each other"
        raise ValueError(f"rectify: cameras must look to one side of their baseline; {why}")
    ahead = normalize(ahead, dim=-1)
    third = torch.linalg.cross(along, ahead, dim=-1) if vertical else torch.linalg.cross(ahead, along, dim=-1)
    turned = torch.stack((third, along, ahead) if vertical else (along, third, ahead), -2)
    return turned, turned @ rotation.mT, sign * length


def _unit(axis: int, like: Tensor) -> Tensor:
    return like.new_tensor([float(i == axis) for i in range(3)])


def _extent(views: list[tuple[Camera, Tensor]], projection: str, vertical: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Return lows and highs (*B, 2) on the plane, and the focal length (*B,) with full resolution in the middle."""
    like, (models, reach) = views[0][1], _KINDS[projection]
    plane = models[vertical](like.new_tensor([1.0, 1.0, 0.0, 0.0]))
    limit = torch.tensor(reach[::-1] if vertical else reach).to(like)
    lows, highs = list[Tensor](), list[Tensor]()
    for view in views:  # the extent of the image's middle row and column
        (row, of_row), (column, of_column) = middle_lines(*view, plane, limit, 129)
        places, valid = torch.stack((row[..., 0], column[..., 1]), -1), torch.stack((of_row, of_column), -1)
        lows.append(torch.where(valid, places, torch.inf).amin(-2))
        highs.append(torch.where(valid, places, -torch.inf).amax(-2))
    is_across = torch.tensor([vertical, not vertical], device=limit.device)
    low = torch.where(is_across, torch.maximum(*lows), torch.minimum(*lows))
    high = torch.where(is_across, torch.minimum(*highs), torch.maximum(*highs))
    if not bool((low < high).all()):
        raise ValueError(
            "rectify: cameras must see a part in common; got none. Check that extrinsics are right from left"
        )
    focal = torch.stack([_scale(*view, plane, (low + high) / 2) for view in views]).amax(0)
    if not bool((focal > 0).all()):
        raise ValueError("rectify: a camera must see the images' middle; got none that does. Pass fov and image_size")
    return low, high, focal


def _scale(camera: Camera, rotation: Tensor, plane: Camera, middle: Tensor) -> Tensor:
    """Return a camera's pixels (*B,) per unit of the projection plane at a point of it; 0 if the point is unseen."""
    offsets = _STEP * middle.new_tensor([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    rays, _ = plane.unproject(middle[..., None, :] + offsets)
    pixels, valid = camera.project((rays @ rotation).to(camera.intrinsics.dtype))
    slopes = (pixels.double()[..., 1::2, :] - pixels[..., ::2, :]) / (2 * _STEP)
    return torch.where(valid.all(-1), torch.linalg.det(slopes).abs().sqrt(), 0.0)
