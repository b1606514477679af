"""Dewarp: a Warp that chooses its own target."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from camtorch._arguments import as_fov, as_image_size
from camtorch.camera import Camera
from camtorch.models import Cylindrical, Equirectangular, Pinhole
from camtorch.projection.rays import image_lattice
from camtorch.rotations import as_rotation, turn
from camtorch.warp.sampling import Fill, Mode, PaddingMode
from camtorch.warp.shutter import RollingShutter
from camtorch.warp.warp import Warp, as_sized

Projection = Literal["perspective", "cylindrical", "equirectangular"]

_WIDEST_PERSPECTIVE = 2 * math.tan(math.radians(60))  # beyond 120 degrees the rim is stretched more than fourfold
# projection: the model, and the widest and the tallest range of its plane that is chosen without being asked for
_PROJECTIONS: dict[str, tuple[type[Pinhole | Cylindrical | Equirectangular], float, float]] = {
    "perspective": (Pinhole, _WIDEST_PERSPECTIVE, _WIDEST_PERSPECTIVE),
    "cylindrical": (Cylindrical, 2 * math.pi, 2 * math.tan(math.radians(50))),
    "equirectangular": (Equirectangular, 2 * math.pi, math.pi),
}
_LINE_SAMPLES = 257


class Dewarp(Warp):
    """Undistort images: a `Warp` from `camera` to an undistorted camera that it chooses, `dewarp.target`.

    Args:
        camera: the camera of the given images, with image_size; with a batch dim the target gets one as well.
        projection: "perspective" (straight lines stay straight; up to about 120 degrees), "cylindrical" (vertical lines
            do, for wide views) or "equirectangular" (everything).
        fov: horizontal field of view of the target in degrees, centred on its axis. By default the target shows
            what the image's middle row and column show, and never more than 120 degrees in perspective.
        image_size: (height, width) of the target; the source's by default.
        rotation: (3, 3) or (B, 3, 3), `ray_target = R ray_source`: where the target looks.
        mode, padding_mode, fill, antialias, tolerance, shutter: as `Warp` takes them.

    The target has square pixels, is chosen once, and does not learn. It is finite for every camera, also where the
    lens folds inside the image or sees past 90 degrees.

    Raises:
        ValueError: an unknown projection, a fov that is not below 180 degrees for perspective, or up to 360, one up to
            2 pi, which seems to be in radians, and as `Warp`.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        projection: Projection = "perspective",
        fov: float | None = None,
        image_size: Sequence[int] | None = None,
        rotation: Tensor | None = None,
        mode: Mode = "bilinear",
        padding_mode: PaddingMode = "zeros",
        fill: Fill = 0.0,
        antialias: bool = False,
        tolerance: float | None = None,
        shutter: RollingShutter | None = None,
    ):
        if not isinstance(projection, str) or projection not in _PROJECTIONS:
            raise ValueError(f"Dewarp: projection must be one of {tuple(_PROJECTIONS)}; got {projection!r}")
        own = as_sized(camera, "camera", "Dewarp")._size("Dewarp")
        size = as_image_size(image_size, "Dewarp") or own
        rotation = as_rotation(rotation, "Dewarp")
        model = _PROJECTIONS[projection][0]
        with torch.no_grad():
            if fov is not None:
                height, width = size
                most = 180 if projection == "perspective" else 360
                angle = math.radians(as_fov(fov, "Dewarp", most, f" for {projection}"))
                plane_width = 2 * math.tan(angle / 2) if projection == "perspective" else angle
                focal = camera.intrinsics.new_tensor(width / plane_width)
                centre = camera.intrinsics.new_tensor([(width - 1) / 2, (height - 1) / 2])
                intrinsics = torch.cat((focal.expand(2), centre))
            else:
                intrinsics = _fitted(camera, projection, size, rotation)
        target = model(nn.Parameter(intrinsics, requires_grad=False), image_size=size)
        super().__init__(
            camera,
            target,
            rotation,
            mode=mode,
            padding_mode=padding_mode,
            fill=fill,
            antialias=antialias,
            tolerance=tolerance,
            shutter=shutter,
        )


def _fitted(camera: Camera, projection: str, size: tuple[int, int], rotation: Tensor | None) -> Tensor:
    """(*B, 4): the target that shows what the middle row and column of the camera's image show."""
    model, widest, tallest = _PROJECTIONS[projection]
    row = image_lattice(camera, 3, _LINE_SAMPLES)[1]
    column = image_lattice(camera, _LINE_SAMPLES, 3)[:, 1]
    pixels = torch.cat((row, column)).expand(*camera.batch_shape, -1, -1)
    rays, has_ray = camera.unproject(pixels)
    if rotation is not None:
        while rays.ndim - 2 < rotation.ndim - 2:
            rays, has_ray = rays.unsqueeze(0), has_ray.unsqueeze(0)
    plane, shown = model(camera.intrinsics.new_tensor([1.0, 1.0, 0.0, 0.0])).project(turn(rotation, rays, "rays"))
    shown = (shown & has_ray).unsqueeze(-1)
    limit = plane.new_tensor([widest, tallest]) / 2
    plane = torch.maximum(torch.minimum(plane, limit), -limit)
    if projection != "perspective":
        # over a pole the longitude jumps: across counts what the row shows, up and down what the column does
        is_row = torch.arange(2 * _LINE_SAMPLES, device=plane.device).unsqueeze(-1) < _LINE_SAMPLES
        shown = shown & torch.cat((is_row, ~is_row), -1)
    shown = shown.expand(plane.shape)
    # a lens that shows nothing in this direction gets a quarter turn straight ahead
    some = shown.any(-2)
    low = torch.where(some, torch.where(shown, plane, torch.inf).amin(-2), -1.0)
    high = torch.where(some, torch.where(shown, plane, -torch.inf).amax(-2), 1.0)
    extent = torch.maximum(high - low, 1e-3 * limit)
    target = plane.new_tensor([size[1], size[0]])
    # all that is shown fits in, unless that takes a wider image than the widest
    sides = slice(None) if projection == "perspective" else slice(1)
    focal = torch.maximum((target / extent).amin(-1), (target / (2 * limit))[sides].amax(-1)).unsqueeze(-1)
    centre = (target - 1) / 2 - focal * (low + high) / 2
    return torch.cat((focal, focal, centre), -1)
