"""Images of a plane, as another camera sees it or from above."""

from __future__ import annotations

import math
from typing import Any, Unpack

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.evaluate.tensors import as_own, known_false, values_of
from camtorch.poses.extrinsics import Extrinsics
from camtorch.poses.rotations import rotation_matrix, turn
from camtorch.values.arguments import Numbers, as_batch, as_coordinates, as_number, as_real, shown
from camtorch.warp.camera_pair import placed
from camtorch.warp.grid import scaled_rows
from camtorch.warp.lattice import PixelPositions, to_positions
from camtorch.warp.options import PaddingMode, WarpOptions
from camtorch.warp.panorama import off_poles
from camtorch.warp.reproject import beside, check_pose
from camtorch.warp.views import pinhole
from camtorch.warp.warp import Warp

_GRAZING = 1e-9  # a ray of a smaller cosine to the plane's normal does not meet the plane


class PlaneWarp(Warp):
    """A `Warp` of the image of a plane, from camera `source` to camera `target` at another place.

    Points on the plane are exact; objects above it are smeared, as in every such image. For pinholes it is the
    homography K_s (R + t n^T / d) K_t^-1; for other cameras it is exact as well. Points and boxes move along.
    Differentiable in both cameras, the extrinsics, the normal and the distance. A pixel is valid if its ray meets the
    plane ahead, and the source sees that point, on its image and from the same side of the plane as the target.

    Args:
        source: the camera of the given images.
        target: the camera of the images to make.
        extrinsics: source from target, `p_source = R p_target + t`.
        normal: (3,) or (B, 3) of the plane `normal . X = distance` in the target's frame, of any length except zero.
        distance: a number or (B,), in the unit of the extrinsics; not zero.
        mode, padding_mode, fill, antialias: as in `Warp`.

    Raises:
        ValueError: If the plane goes through a camera, or the source sees it from the other side; if shapes do not
            fit; and as `Warp`. TypeError: If a camera is no Camera, or extrinsics are no Extrinsics.
    """

    moves_by_cameras = False
    batch_shape: torch.Size
    normal: Tensor
    distance: Tensor

    def __init__(
        self,
        source: Camera,
        target: Camera,
        extrinsics: Extrinsics,
        normal: Numbers,
        distance: Numbers,
        **options: Unpack[WarpOptions],
    ):
        super().__init__(source, target, tolerance=0.0, **options)
        owner = type(self).__name__
        batch = check_pose(owner, extrinsics, "source from target", source=source, target=target)
        self.extrinsics = extrinsics
        device = source.intrinsics.device
        normal, distance = as_real(normal, "normal", owner, device), as_real(distance, "distance", owner, device)
        if normal.ndim not in (1, 2) or normal.shape[-1] != 3 or distance.ndim > 1:
            raise ValueError(
                f"{owner}: normal must be (3,) or (B, 3) and distance a number or (B,); got {tuple(normal.shape)} and "
                f"{tuple(distance.shape)}"
            )
        self.batch_shape = as_batch(owner, cameras=(*batch, 1), normal=normal.shape, distance=(*distance.shape, 1))
        for name, value in (("normal", normal), ("distance", distance)):
            self.put(name, as_own(value), persistent=True)
        self._check(owner)

    def _check(self, owner: str) -> None:
        """Raise a ValueError if the plane goes through a camera, or between them."""
        rotation, shift, normal, distance = map(values_of, (*self._pose(), self.normal, self.distance))
        if rotation is None or shift is None or normal is None or distance is None:
            return
        place = -(rotation.mT @ shift[..., None])[..., 0]
        if not bool((torch.linalg.vector_norm(normal, dim=-1) > 0).all() & (distance != 0).all()):
            raise ValueError(
                f"{owner}: normal must not be zero, nor distance, at the target; got {self.normal.tolist()} and "
                f"{self.distance.tolist()}"
            )
        if not bool(((distance - (normal * place).sum(-1)) * distance > 0).all()):
            raise ValueError(
                f"{owner}: source and target must be on the same side of the plane; got the source at {place.tolist()} "
                "in the target's frame. Check that the extrinsics are source from target"
            )

    def _pose(self) -> tuple[Tensor, Tensor]:
        """Return source from target: rotations (*B, 3, 3) and shifts (*B, 3)."""
        return rotation_matrix(self.extrinsics.rotation), self.extrinsics.translation

    def _plane_of_source(self) -> tuple[Tensor, Tensor]:
        """Return the normal (*B, 3) and the distance (*B,) in the source's frame."""
        rotation, shift = self._pose()
        dtype = torch.promote_types(rotation.dtype, self.normal.dtype)
        normal = (rotation.to(dtype) @ self.normal.to(dtype)[..., None])[..., 0]
        return normal, self.distance + (normal * shift).sum(-1)

    @property
    def tensors(self) -> list[Tensor]:
        pose = self.extrinsics.rotation, self.extrinsics.translation
        return [*self.source.tensors, *self.target.tensors, *pose, self.normal, self.distance]

    def transform_positions(self, points: Tensor) -> Tensor:
        raise TypeError(f"{type(self).__name__}: only pixels and rays of the plane move; got points")

    def moved_distance(self, distance: Tensor) -> Tensor:
        raise TypeError(f"{type(self).__name__}: only pixels and rays of the plane move; got distances")

    def locate(self, rows: range, padding: PaddingMode, tolerance: float) -> PixelPositions:
        if not self.antialias:
            return PixelPositions(*self._of_rows(rows), None)
        return scaled_rows(self.sampled.source, rows, self.image_size[0], self._of_rows)

    def _of_rows(self, rows: range) -> tuple[Tensor, Tensor]:
        pixels = self.pair.pixels_of(rows)
        batch = self.batch_shape or (1,)
        seen, mapped = self.move(pixels.expand(*batch, *pixels.shape), back=True)
        if self.seam is not None:
            seen = seen + seen.new_tensor(self.seam.rims[::2])
        return to_positions(seen, mapped, self.sampled.source.size_for("Warp")), mapped

    def move(self, pixels: Numbers, back: bool = False, on_image: bool = False) -> tuple[Tensor, Tensor]:
        source, target = (self.target, self.source) if back else (self.source, self.target)
        rays, has_ray = source.unproject(pixels)
        # the other camera sees the points that the rays meet in these directions
        rotation, shift = (t.to(rays.dtype) for t in self._pose())
        if not back:
            rotation, shift = rotation.mT, -(rotation.mT @ shift[..., None])[..., 0]
        normal, distance = (self.normal, self.distance) if back else self._plane_of_source()
        normal = beside(normal / distance[..., None], rays)
        near = (rays * normal).sum(-1)  # 1 / distance to the plane
        meets = near.detach() > _GRAZING * torch.linalg.vector_norm(normal.detach(), dim=-1)
        directions = turn(rotation, rays, "rays") + beside(shift, rays) * near[..., None]
        seen, mapped = target.project(off_poles(target, directions))
        return placed(target, seen, mapped & has_ray & meets, on_image)

    def transform_rays(self, rays: Numbers) -> Tensor:
        rays = as_coordinates(rays, "rays", 3, type(self).__name__, self.source.intrinsics.device, "B, *N")
        return turn(self._pose()[0].mT.to(rays.dtype), rays, "rays")

    def inverse(self) -> PlaneWarp:
        """Return the warp from target to source, of the same plane. Pixels outside the image stay lost."""
        normal, distance = self._plane_of_source()
        parts = {"extrinsics": self._source_from_target().inverse(), "normal": normal, "distance": distance}
        return self.between(self.target, self.source, None, **self.options, **parts)

    def between(self, source: Camera, target: Camera, rotation: Tensor | None, **options: Any) -> PlaneWarp:
        """Return the warp of this plane between other cameras at the same places; extrinsics hold the rotation."""
        if rotation is not None:
            raise ValueError(f"{type(self).__name__}: rotation must be None, as extrinsics hold it; got one")
        options = {**self.own_parts(), **options}
        options.pop("tolerance", None)
        return PlaneWarp(source, target, **options)

    def own_parts(self, index: list[int] | None = None) -> dict[str, Any]:
        assert index is None  # augmentations, which take rows, make no such warps
        return {"extrinsics": self.extrinsics, "normal": self.normal, "distance": self.distance}

    def _source_from_target(self) -> Extrinsics:
        return Extrinsics.from_matrix(self._pose()).freeze_like(self.extrinsics)


class BirdsEye(PlaneWarp):
    """A `PlaneWarp` of the plane z = 0: the ground from above, to scale, made from a camera's image.

    Rows go from the largest y to the smallest, so that +y is up in the image, columns from the smallest x to the
    largest; pixel (0, 0) is the middle of its cell. Any lens works, also beyond 90 degrees.

    Args:
        camera: the camera of the given images.
        extrinsics: camera from ground, whose z axis points up; the camera is above it.
        x: (from, to) that the image shows across, in units of the ground.
        y: (from, to) that it shows from bottom to top.
        resolution: units of the ground per pixel.
        mode, padding_mode, fill, antialias: as in `Warp`.

    Raises:
        ValueError: If the camera is not above the ground, a range does not ascend, or the resolution is not positive;
            and as `Warp`. TypeError: If camera is no Camera, or extrinsics are no Extrinsics.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    resolution: float

    def __init__(
        self,
        camera: Camera,
        extrinsics: Extrinsics,
        *,
        x: tuple[float, float],
        y: tuple[float, float],
        resolution: float,
        **options: Unpack[WarpOptions],
    ):
        x, y = _as_ends(x, "x"), _as_ends(y, "y")
        resolution = as_number(resolution, "resolution", "BirdsEye")
        if not (math.isfinite(resolution) and resolution > 0):
            raise ValueError(f"BirdsEye: resolution must be positive units of the ground per pixel; got {resolution}")
        height, width = (round((high - low) / resolution) for low, high in (y, x))
        if min(height, width) < 1:
            raise ValueError(f"BirdsEye: x and y must span a pixel; got {x} and {y} at {resolution} units per pixel")
        # a camera that looks straight down from one unit above the origin
        like = camera.intrinsics.detach() if isinstance(camera, Camera) else torch.zeros(1)
        focal = 1 / resolution
        intrinsics = like.new_tensor([focal, focal, -x[0] * focal - 0.5, y[1] * focal - 0.5])
        down = pinhole(intrinsics, (height, width))
        super().__init__(camera, down, extrinsics, (0.0, 0.0, 1.0), 1.0, **options)
        self.x, self.y, self.resolution = x, y, resolution

    def _check(self, owner: str) -> None:
        place = self.extrinsics.position.detach()
        if known_false(place[..., 2] > 0):
            raise ValueError(
                f"{owner}: the camera must be above the ground, whose z points up; got position {place.tolist()}. "
                "Check that the extrinsics are camera from ground"
            )

    def _pose(self) -> tuple[Tensor, Tensor]:
        """Return camera from a camera at (0, 0, 1) that looks down: its x, y and z are the ground's x, -y and -z."""
        rotation, shift = super()._pose()
        return rotation * rotation.new_tensor([1.0, -1.0, -1.0]), shift + rotation[..., 2]

    def own_parts(self, index: list[int] | None = None) -> dict[str, Any]:
        return {**super().own_parts(index), "extrinsics": self._source_from_target()}  # of a `PlaneWarp` to any target

    def detach(self) -> BirdsEye:
        options: Any = {name: value for name, value in self.options.items() if name != "tolerance"}
        options |= {"x": self.x, "y": self.y, "resolution": self.resolution}
        return BirdsEye(self.source.detach(), self.extrinsics.detach(), **options).share(self)

    @property
    def grid_points(self) -> Tensor:
        """The ground's x and y (H, W, 2) in the middle of each pixel."""
        return self.to_ground(self.target.pixel_grid())

    def to_ground(self, pixels: Tensor) -> Tensor:
        """Return x and y on the ground for pixels (..., 2) of the image from above."""
        u, v = (as_coordinates(pixels, "pixels", 2, "BirdsEye") + 0.5).unbind(-1)
        return torch.stack((self.x[0] + u * self.resolution, self.y[1] - v * self.resolution), -1)

    def from_ground(self, points: Tensor) -> Tensor:
        """Return pixels of the image from above for x and y (..., 2) on the ground."""
        x, y = as_coordinates(points, "points", 2, "BirdsEye").unbind(-1)
        return torch.stack(((x - self.x[0]) / self.resolution - 0.5, (self.y[1] - y) / self.resolution - 0.5), -1)


def _as_ends(ends: tuple[float, float], name: str) -> tuple[float, float]:
    try:
        low, high = map(float, ends)
    except (TypeError, ValueError):
        low = high = math.nan
    if not -math.inf < low < high < math.inf:
        raise ValueError(f"BirdsEye: {name} must be (from, to), ascending; got {shown(ends)}")
    return low, high
