"""Dewarp: a Warp that chooses its own target."""

import math
from collections.abc import Callable, Sequence
from typing import Literal, Unpack

import torch
from torch import Tensor, nn

from camtorch.cameras.camera import Camera
from camtorch.cameras.image_sizes import warn_of_exchange
from camtorch.models import UCM, Cylindrical, Equirectangular, Pinhole
from camtorch.poses.rotations import as_rotation
from camtorch.rays.lattices import around_ends, image_lattice
from camtorch.values.arguments import as_fov, as_image_size, broadcast_shapes, check_devices, hinting, one_of, warn
from camtorch.warp.options import TolerantOptions
from camtorch.warp.warp import Warp, as_sized

Projection = Literal["perspective", "stereographic", "cylindrical", "equirectangular"]

_WIDEST_PERSPECTIVE = 2 * math.tan(math.radians(60))  # beyond 120 degrees the rim is stretched more than fourfold
_WIDEST_STEREOGRAPHIC = 4 * math.tan(math.radians(55))  # beyond 220 degrees it is stretched more than threefold


def _stereographic(intrinsics: Tensor, image_size: tuple[int, int] | None = None) -> UCM:
    """Return a unified camera of alpha = 1/2: r = 2 f tan(theta / 2)."""
    alpha = nn.Parameter(intrinsics.new_full((*intrinsics.shape[:-1], 1), 0.5), requires_grad=False)
    return UCM(intrinsics, alpha, image_size=image_size)


# projection: the model, and the widest and the tallest range of its plane that is chosen without a `fov`
_PROJECTIONS: dict[str, tuple[Callable[..., Camera], float, float]] = {
    "perspective": (Pinhole, _WIDEST_PERSPECTIVE, _WIDEST_PERSPECTIVE),
    "stereographic": (_stereographic, _WIDEST_STEREOGRAPHIC, _WIDEST_STEREOGRAPHIC),
    "cylindrical": (Cylindrical, 2 * math.pi, 2 * math.tan(math.radians(50))),
    "equirectangular": (Equirectangular, 2 * math.pi, math.pi),
}
_PLANES: dict[str, tuple[float, Callable[[float], float]]] = {
    "perspective": (180, lambda angle: 2 * math.tan(angle / 2)),
    "stereographic": (359, lambda angle: 4 * math.tan(angle / 4)),
}
"""Projections with an infinite plane: their limit of fov in degrees, and the plane's width for a fov in radians."""
_MIDDLE, _LEAST_SHARE = math.pi / 3, 0.1  # a wider fov warns: above 160 degrees in perspective, 278 in stereographic
_SEAM = 1e-3  # radians from a panorama's seam to the rays on both sides that are looked for


class Dewarp(Warp):
    """A `Warp` that undistorts images: from `camera` to an undistorted camera that it chooses, `dewarp.target`.

        >>> camera = ct.KannalaBrandt([80.0, 80.0, 63.5, 47.5], [0.02, -0.01, 0.0, 0.0], image_size=(96, 128))
        >>> ct.Dewarp(camera, fov=90)(torch.zeros(8, 3, 96, 128)).shape
        torch.Size([8, 3, 96, 128])

    Args:
        camera: the camera of the given images, with image_size; a batch of cameras gives a batch of targets.
        projection: "perspective" (straight lines stay straight; up to about 120 degrees), "stereographic" (small shapes
            such as faces keep their form at the rim; wide views), "cylindrical" (vertical lines stay straight; wide
            views) or "equirectangular" (everything).
        fov: horizontal field of view of the target in degrees, centred on its axis. By default the target shows
            what the image's middle row and column show, up to 120 degrees in perspective and 220 in stereographic.
            A panorama is then as wide as the middle row, or a whole turn, and its height follows from image_size.
            Above 160 degrees in perspective and 278 in stereographic the rim takes nearly all pixels, which warns.
        image_size: (height, width) of the target; default: the source's.
        rotation: (3, 3) or (B, 3, 3), `ray_target = R ray_source`: where the target looks.
        mode, padding_mode, fill, antialias, tolerance: as in `Warp`.

    The target has square pixels, is chosen once, and does not learn. It is finite for every camera, even if the
    lens folds inside the image or sees past 90 degrees.

    Raises:
        ValueError: If the projection is unknown, or fov is not below 180 degrees for perspective, below 359 for
            stereographic, up to 360 for others, or is up to 2 pi and may be in radians; and as `Warp`.
    """

    @hinting("It takes a camera, as ct.KannalaBrandt.from_matrix(K, D, image_size=size); fov is how much it shows")
    def __init__(
        self,
        camera: Camera,
        *,
        projection: Projection = "perspective",
        fov: float | None = None,
        image_size: Sequence[int] | None = None,
        rotation: Tensor | None = None,
        **options: Unpack[TolerantOptions],
    ):
        one_of(projection, tuple(_PROJECTIONS), "projection", "Dewarp")
        source_size = as_sized(camera, "camera", "Dewarp").size_for("Dewarp")
        size = as_image_size(image_size, "Dewarp") or source_size
        warn_of_exchange(source_size, size, "Dewarp", "warped")
        rotation = as_rotation(rotation, "Dewarp")
        check_devices("Dewarp", camera=camera.intrinsics, rotation=rotation)
        model = _PROJECTIONS[projection][0]
        with torch.no_grad():
            if fov is not None:
                height, width = size
                most, of_plane = _PLANES.get(projection, (360, lambda angle: angle))
                plane_width = of_plane(math.radians(as_fov(fov, "Dewarp", most, f" for {projection}")))
                share = of_plane(_MIDDLE) / plane_width
                if share < _LEAST_SHARE:
                    got = f"fov={fov:g} leaves {share * width:.0f} of {width} columns for the middle 60 degrees"
                    warn(f'Dewarp: {got}. Lower it, or choose projection="cylindrical" or "equirectangular"')
                focal = camera.intrinsics.new_tensor(width / plane_width)
                centre = camera.intrinsics.new_tensor([(width - 1) / 2, (height - 1) / 2])
                intrinsics = torch.cat((focal.expand(2), centre))
            else:
                intrinsics = _fitted(camera, projection, size, rotation)
        target = model(nn.Parameter(intrinsics, requires_grad=False), image_size=size)
        super().__init__(camera, target, rotation, **options)


def _fitted(camera: Camera, projection: str, size: tuple[int, int], rotation: Tensor | None) -> Tensor:
    """Return the intrinsics (*B, 4) of the target that shows all of the image's middle row and column."""
    model, widest, tallest = _PROJECTIONS[projection]
    plane = model(camera.intrinsics.new_tensor([1.0, 1.0, 0.0, 0.0]))
    limit = plane.intrinsics.new_tensor([widest, tallest]) / 2
    target = limit.new_tensor([size[1], size[0]])
    (across, of_across), (down, of_down) = middle_lines(camera, rotation, plane, limit, 257)
    if projection in _PLANES:  # both lines count both ways
        points, shown = torch.cat((across, down), -2), torch.cat((of_across, of_down), -1)
        shown = shown.unsqueeze(-1).expand(points.shape)
    else:  # over a pole the longitude jumps
        points = torch.stack((across[..., 0], down[..., 1]), -1)
        shown = torch.stack((of_across, of_down), -1)
    # a lens that shows nothing in this direction gets a quarter turn straight ahead
    some = shown.any(-2)
    low = torch.where(some, torch.where(shown, points, torch.inf).amin(-2), -1.0)
    high = torch.where(some, torch.where(shown, points, -torch.inf).amax(-2), 1.0)
    if projection not in _PLANES:
        # a panorama whose seam the image shows on both sides is a whole turn
        rays = camera.intrinsics.new_tensor([[-_SEAM, 0.0, -1.0], [_SEAM, 0.0, -1.0]])
        rays = rays if rotation is None else rays @ rotation.to(rays.dtype)
        batch = broadcast_shapes(camera.batch_shape, rays.shape[:-2])
        pixels, valid = camera.project(rays.expand(*batch, 2, 3))
        whole = (valid & camera.contains(pixels)).all(-1)
        ends = torch.stack((whole, torch.zeros_like(whole)), -1)
        low, high = torch.where(ends, -limit, low), torch.where(ends, limit, high)
    extent = torch.maximum(high - low, 1e-3 * limit)
    if projection in _PLANES:  # all that is shown fits, unless the target would be wider than the widest
        focal = torch.maximum((target / extent).amin(-1), (target / (2 * limit)).amax(-1)).unsqueeze(-1)
    else:
        focal = (target / extent)[..., :1]
    centre = (target - 1) / 2 - focal * (low + high) / 2
    return torch.cat((focal, focal, centre), -1)


def middle_lines(
    camera: Camera, rotation: Tensor | None, plane: Camera, limit: Tensor, samples: int
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Return the middle row and column on a projection's plane, (*B, N, 2) and shown (*B, N), the level one first.

    With corners, a wide lens would fill a panorama with rays of few pixels. Points are clamped to `limit` (2,).
    """
    found = []
    for line in (image_lattice(camera, 3, 3)[1], image_lattice(camera, 3, 3)[:, 1]):
        start, along = line[0], line[2] - line[0]
        share = torch.linspace(0, 1, samples).to(start).expand(*camera.batch_shape, samples)
        every = []
        for _ in range(4):  # the whole line, then around its ends: near a fold angles change fast
            rays, has_ray = camera.unproject(start + share[..., None] * along)
            rays = rays.to(plane.intrinsics.dtype)
            points, valid = plane.project(rays if rotation is None else rays @ rotation.mT.to(rays.dtype))
            every.append((torch.maximum(torch.minimum(points, limit), -limit), valid & has_ray))
            share = around_ends(share, has_ray)
        found.append((torch.cat([p for p, _ in every], -2), torch.cat([v for _, v in every], -1)))
    (row, of_row), (column, of_column) = found
    near = slice(samples // 2 - 1, samples // 2 + 2)
    turned = [(p[..., near, :][..., -1, :] - p[..., near, :][..., 0, :]).abs() for p in (row, column)]
    swapped = turned[0][..., :1] * turned[1][..., 1:] < turned[0][..., 1:] * turned[1][..., :1]
    across = torch.where(swapped[..., None], column, row), torch.where(swapped, of_column, of_row)
    down = torch.where(swapped[..., None], row, column), torch.where(swapped, of_row, of_column)
    return across, down
