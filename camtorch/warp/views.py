"""A wide image as several pinhole images, and back: the faces of a cube, or a ring of views around."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from camtorch._arguments import as_fov, as_number, as_whole, shown
from camtorch._dtypes import narrow, widen
from camtorch._module import GeometryModule, typed_as
from camtorch.camera import Camera
from camtorch.models import Pinhole
from camtorch.projection.rays import slopes_at_axis
from camtorch.rotations import mount_rotation
from camtorch.warp.panorama import rays_of
from camtorch.warp.sampling import Mode, blended
from camtorch.warp.warp import Warp, as_sized

__all__ = ["FACES", "Views", "cube", "ring"]

FACES = ("front", "right", "back", "left", "up", "down")
"""Of a cube, as the camera sees them from within; its own axis goes through the middle of the front."""
_HALF = 0.5  # px, that a view reaches beyond the middle of its outermost pixels
_EDGE = 1e-3  # px
_OVERLAP = 1.25  # the width of a view in a ring over the step to the next one


class Views(GeometryModule):
    """Pinhole views of one camera's image: what `cube` and `ring` make.

    `views(images)` makes them, `views.back(...)` puts what a network made of them together again. `warps[i]` moves
    points and boxes to view i, `warps[i].inverse()` back; `rotations[i]` is `ray_view = R ray_camera`.

    Args:
        camera: of the wide images.
        view: the pinhole camera of every view.
        rotations: (N, 3, 3), `ray_view = R ray_camera`.
        names: of the views.
        mode: as `Warp` takes it; "nearest" for labels, there and back.
    """

    rotations: Tensor
    camera: Camera
    view: Pinhole
    names: tuple[str, ...]
    mode: Mode
    warps: nn.ModuleList
    backs: nn.ModuleList

    def __init__(
        self, camera: Camera, view: Pinhole, rotations: Tensor, names: tuple[str, ...], mode: Mode = "bilinear"
    ):
        super().__init__()
        self.camera, self.view, self.names = as_sized(camera, "camera", "Views"), view, names
        self.mode = mode
        self.register_buffer("rotations", rotations, persistent=False)
        self.warps = nn.ModuleList([Warp(camera, view, rotation, mode=mode) for rotation in rotations])
        self.backs = nn.ModuleList(
            [Warp(view, camera, rotation.mT, mode=mode, padding_mode="border") for rotation in rotations]
        )

    def __len__(self) -> int:
        """The number of views."""
        return len(self.names)

    def __iter__(self) -> Iterator[Warp]:
        """Over the warps."""
        return iter(self.warps)  # type: ignore[arg-type]

    def forward(self, images: Tensor) -> Tensor:
        """(B, C, H, W) to (B, N, C, S, S)."""
        return torch.stack([warp(images) for warp in self], 1)

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def valid_masks(self) -> Tensor:
        """(1, N, 1, S, S) bool: what of each view the camera sees."""
        return torch.stack([warp.valid_mask() for warp in self], 1)

    @torch.no_grad()
    def weights(self) -> Tensor:
        """(N, H, W): the part that each view has in each pixel of the wide image; where any has one, they add up to 1.

        It falls linearly to the border of a view.
        """
        rays, has_ray = rays_of(self.camera, self.camera.pixel_grid())
        height, width = self.view._size_for("Views")
        parts = []
        for rotation in self.rotations:
            pixels, valid = self.view.project((rays @ rotation.mT.to(rays.dtype)).to(self.view.intrinsics.dtype))
            inner = torch.minimum(pixels.amin(-1), (pixels.new_tensor([width - 1.0, height - 1.0]) - pixels).amin(-1))
            # a ray between two faces is on both
            near = valid & has_ray & (inner > -_HALF - _EDGE)
            parts.append(torch.where(near, (inner + _HALF).clamp(min=_EDGE), 0.0))
        whole = torch.stack(parts)
        if self.mode == "nearest":  # what a view fills in at its rim is no label
            masks = self.valid_masks()
            whole = whole * torch.cat([warp(masks[:, i]) for i, warp in enumerate(self.backs)])[:, 0]
        total = whole.sum(0)
        return whole / torch.where(total > 0, total, 1.0)

    def back(self, views: Tensor) -> tuple[Tensor, Tensor]:
        """Views, or what was made of them, in the wide image.

        Args:
            views: (B, N, C, S, S).

        Returns:
            (B, C, H, W) of the same dtype, and valid (1, 1, H, W) bool: some view shows the pixel. Views are averaged
            by their weights, and integers rounded; with mode="nearest" a pixel is that of the view with the largest
            weight, as labels have no mean.

        Raises:
            ValueError: another shape.
        """
        size = self.view._size_for("Views")
        if not isinstance(views, Tensor) or views.ndim != 5 or views.shape[1] != len(self) or views.shape[-2:] != size:
            raise ValueError(
                f"Views: views must be a tensor (B, {len(self)}, C, {size[0]}, {size[1]}); got {shown(views)}"
            )
        weights = self.weights()
        images = views if self.mode == "nearest" else widen(views)
        parts = (warp(images[:, i]) for i, warp in enumerate(self.backs))
        valid = (weights.sum(0) > 0)[None, None]
        return narrow(blended(parts, weights, self.mode), views.dtype), valid

    def extra_repr(self) -> str:
        """The views."""
        return f"{', '.join(self.names)}"


def cube(camera: Camera, size: int | None = None, *, mode: Mode = "bilinear") -> Views:
    """The six faces of a cube about a camera, of 90 degrees each: front, right, back, left, up, down.

    Args:
        camera: of the wide images, with image_size.
        size: pixels along the sides of a face; as fine in its middle as the image at the axis by default.
        mode: as `Warp` takes it.
    """
    size = _size(camera, size, math.pi / 2, "cube")
    angles = torch.tensor([[0, 0], [90, 0], [180, 0], [-90, 0], [0, 90], [0, -90]], dtype=torch.float64)
    rotations = mount_rotation(angles[:, 0], angles[:, 1], torch.zeros(6, dtype=torch.float64))
    return _views(camera, size, math.pi / 2, rotations, FACES, mode)


def ring(
    camera: Camera,
    count: int,
    *,
    fov: float | None = None,
    size: int | None = None,
    pitch: float = 0.0,
    mode: Mode = "bilinear",
) -> Views:
    """Views side by side from left to right, over what a camera sees.

    Args:
        camera: of the wide images, with image_size.
        count: of the views.
        fov: degrees, of a view; by default a quarter more than the step from one to the next.
        size: pixels along the sides of a view; as fine in its middle as the image at the axis by default.
        pitch: degrees that all look up.
        mode: as `Warp` takes it.

    Raises:
        ValueError: no views, or a field of view that no pinhole has.
    """
    count, pitch = as_whole(count, "count", "ring", least=1), as_number(pitch, "pitch", "ring")
    seen = float(as_sized(camera, "camera", "ring").field_of_view.detach()[..., 0].max())
    step = seen / count
    widest = math.radians(150)
    wide = min(_OVERLAP * step, widest) if fov is None else math.radians(as_fov(fov, "ring", 180))
    yaws = torch.rad2deg((torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * step)
    rotations = mount_rotation(yaws, torch.full_like(yaws, pitch), torch.zeros_like(yaws))
    size = _size(camera, size, wide, "ring")
    return _views(camera, size, wide, rotations, tuple(f"{yaw:.4g} degrees" for yaw in yaws.tolist()), mode)


def _size(camera: Camera, size: int | None, fov: float, owner: str) -> int:
    as_sized(camera, "camera", owner)
    if camera.batch_shape:
        raise ValueError(f"{owner}: takes one camera; got batch_shape={tuple(camera.batch_shape)}")
    if size is not None:
        return as_whole(size, "size", owner, least=1)
    with torch.no_grad():
        slope = slopes_at_axis(camera.optics, camera.distortion[None])
        focal = float((camera.intrinsics[:2] * slope[0]).max())
    return max(2, round(2 * focal * math.tan(fov / 2)))


def _views(camera: Camera, size: int, fov: float, rotations: Tensor, names: tuple[str, ...], mode: Mode) -> Views:
    focal, centre = size / 2 / math.tan(fov / 2), (size - 1) / 2
    intrinsics = camera.intrinsics.detach().new_tensor([focal, focal, centre, centre])
    view = Pinhole(nn.Parameter(intrinsics, requires_grad=False), image_size=(size, size))
    return Views(camera, view, rotations.to(intrinsics), names, mode)
