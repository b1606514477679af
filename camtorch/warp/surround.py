"""Several cameras of a rig in one image: from above, or as a camera in their middle sees it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad

from camtorch._arguments import as_number, is_list
from camtorch._dtypes import narrow
from camtorch._module import GeometryModule, Memo, typed_as
from camtorch.camera import Camera
from camtorch.extrinsics import Extrinsics
from camtorch.rig import Rig
from camtorch.rotations import rotation_matrix
from camtorch.warp.plane import BirdsEye
from camtorch.warp.proxy import ProxyWarp, beside
from camtorch.warp.sampling import Mode, blended
from camtorch.warp.warp import Warp, as_sized

_BLEND = 1 / 8  # of the shorter side: how far from where a camera ends it begins to fade
_LEAST = 1e-6  # the weight of a pixel that a camera only just sees, beside none


class _SphereWarp(ProxyWarp):
    """What a target at a rig's origin sees of a sphere about it, by a camera of the rig within it."""

    def __init__(self, source: Camera, target: Camera, extrinsics: Extrinsics, radius: float, **options: Any):
        super().__init__(source, target, extrinsics, **options)
        self.radius = radius

    def _nearness(self, rays: Tensor, of_source: bool) -> tuple[Tensor, Tensor]:
        near = torch.full_like(rays[..., 0], 1 / self.radius)
        if of_source:
            shift = beside(self.extrinsics.translation, rays)  # of the origin, from the camera
            along = (rays * shift).sum(-1)
            near = 1 / ((along.square() + self.radius**2 - shift.square().sum(-1)).sqrt() + along)
        return near, torch.ones_like(near, dtype=torch.bool)

    def inverse(self) -> Warp:
        raise ValueError("Surround: the warp of a distance has no inverse; transform_points takes points to the target")


class Surround(GeometryModule):
    """Images of several cameras blended into one: what `surround` makes.

    Each camera's weight falls smoothly to nothing where it ceases to see the target, and the weights of all that see a
    pixel add up to one.
    """

    warps: nn.ModuleDict
    names: tuple[str, ...]

    def __init__(self, warps: Mapping[str, Warp], blend: float | None, fill: float):
        super().__init__()
        self.fill = fill
        self.names = tuple(warps)
        self.warps = nn.ModuleDict({f"camera {i}": warp for i, warp in enumerate(warps.values())})
        self.blend = blend
        self._memo = Memo()

    @property
    def target(self) -> Camera:
        """The camera of the image that is made."""
        target: Camera = self._warps[0].target
        return target

    @property
    def _warps(self) -> list[Any]:
        return list(self.warps.values())

    def warp(self, name: str) -> Warp:
        """That of one camera."""
        if name not in self.names:
            raise ValueError(f"Surround: no camera is called {name!r}; there are {list(self.names)}")
        made: Warp = self._warps[self.names.index(name)]
        return made

    def weights(self) -> dict[str, Tensor]:
        """(1, 1, H, W) by the name of a camera; they add up to one where any camera sees something, else to zero."""
        return {name: kept.clone() for name, kept in zip(self.names, self._weights(), strict=True)}

    @torch.no_grad()
    def _weights(self) -> tuple[Tensor, ...]:
        inputs = [t for warp in self._warps for t in warp._inputs()]
        weights: tuple[Tensor, ...] = self._memo(inputs, (self.blend,), self._made)
        return weights

    def _made(self) -> tuple[Tensor, ...]:
        masks = [warp.valid_mask().to(torch.float32) for warp in self._warps]
        height, width = self.target._size_for("Surround")
        reach = _BLEND * min(height, width) if self.blend is None else self.blend
        faded = [_faded(mask, max(1, round(reach))) for mask in masks]
        total = torch.stack(faded).sum(0)
        return tuple([one / torch.where(total > 0, total, 1.0) for one in faded])

    def forward(self, images: Mapping[str, Tensor] | Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """The blended images, and where some camera sees something.

        Args:
            images: by the name of a camera, or in their order, in a list or stacked: (B, C, H, W) each of its camera's
                image_size.

        Returns:
            (B, C, H', W') of the dtype of the images, and valid (1, 1, H', W') bool. Images are averaged by their
            weights, and integers rounded; with mode="nearest" a pixel is that of the camera with the largest weight, as
            labels have no mean.

        Raises:
            ValueError: other names, or another number of images.
        """
        if isinstance(images, Mapping):
            if set(images) != set(self.names):
                raise ValueError(f"Surround: images must be of the cameras {list(self.names)}; got {list(images)}")
            images = [images[name] for name in self.names]
        listed = is_list(images) or (isinstance(images, Tensor) and images.ndim == 5)
        if not listed or not all(isinstance(image, Tensor) for image in images):
            given = [type(one).__name__ for one in images] if listed else type(images).__name__
            raise TypeError(f"Surround: images must be tensors (B, C, H, W) by name, or in a list; got {given}")
        if len(images) != len(self.names):
            raise ValueError(f"Surround: {len(self.names)} cameras, {list(self.names)}; got {len(images)} images")
        counts = {name: len(image) for name, image in zip(self.names, images, strict=True)}
        if len(set(counts.values()) - {1}) > 1:
            raise ValueError(f"Surround: images must be as many of each camera; got {counts}")
        weights = self._weights()
        dtype, mode = images[0].dtype, self._warps[0].mode
        parts = (warp(image) for warp, image in zip(self._warps, images, strict=True))
        result = narrow(blended(parts, weights, mode), dtype)
        valid = torch.stack(weights).sum(0) > 0
        fill = narrow(torch.tensor(self.fill, dtype=torch.float64), dtype).to(result.device)
        return torch.where(valid, result, fill), valid

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def extra_repr(self) -> str:
        """The cameras."""
        return f"cameras {', '.join(self.names)}"


def _faded(mask: Tensor, reach: int) -> Tensor:
    """A mask (1, 1, H, W) of ones that falls smoothly to zero at its border within, not at that of the image."""
    size = 2 * reach + 1
    for _ in range(2):
        # twice the mean less one is 0 on a straight border, and 1 as far away as the mean reaches
        wide = pad(mask, (reach,) * 4, mode="replicate")
        mean = avg_pool2d(avg_pool2d(wide, (size, 1), 1), (1, size), 1)
        mask = mask * (2 * mean - 1).clamp(min=_LEAST)
    return mask * mask * (3 - 2 * mask)


def surround(
    rig: Rig,
    target: Camera | None = None,
    *,
    x: tuple[float, float] | None = None,
    y: tuple[float, float] | None = None,
    resolution: float | None = None,
    distance: float = math.inf,
    blend: float | None = None,
    mode: Mode = "bilinear",
    fill: float = 0.0,
) -> Surround:
    """The images of a rig's cameras in one: from above, or as a camera at the rig's origin sees it.

    Args:
        rig: cameras with image_size, each with extrinsics, camera from rig. For a view from above the rig's frame is
            that of the ground: z up, the ground at z = 0.
        target: a camera at the rig's origin, of the rig's axes: a panorama (`Cylindrical`, `Equirectangular`), a face
            of a cube, a pinhole. None for the view from above.
        x: (from, to) of the ground, as `BirdsEye` takes it; likewise y and resolution.
        y: (from, to).
        resolution: units of the ground per pixel.
        distance: of a target's scene from the origin; infinite by default, so that only directions count. What is
            nearer or farther is doubled or lost where two cameras meet.
        blend: pixels of the target over which a camera fades out; an eighth of the shorter side by default.
        mode: as `Warp` takes it.
        fill: the value of pixels that no camera shows.

    Raises:
        ValueError: a rig without cameras or with one that has no pose; neither a target nor a ground, or both; a
            distance nearer than a camera. TypeError: no rig.
    """
    owner = "surround"
    if not isinstance(rig, Rig):
        raise TypeError(f"{owner}: rig must be a Rig; got {type(rig).__name__}. ct.Rig(cameras, extrinsics) makes one")
    missing = [name for name in rig if name not in rig.extrinsics]
    if missing or not len(rig):
        what = f"cameras without extrinsics: {', '.join(missing)}" if missing else "a rig without cameras"
        raise ValueError(f"{owner}: every camera needs its extrinsics, camera from rig; got {what}")
    ground: dict[str, Any] = {"x": x, "y": y, "resolution": resolution}
    given = [name for name, value in ground.items() if value is not None]
    if (target is None and len(given) < 3) or (target is not None and given):
        raise ValueError(f"{owner}: give a target, or x, y and resolution of the ground; got target={target}, {ground}")
    distance, fill = as_number(distance, "distance", owner), as_number(fill, "fill", owner)
    if not distance > 0:
        raise ValueError(f"{owner}: distance must be positive; got {distance}")
    if blend is not None:
        blend = as_number(blend, "blend", owner)
        if not 0 <= blend < math.inf:
            raise ValueError(f"{owner}: blend must be pixels, zero or more; got {blend}")
    warps: dict[str, Warp] = {}
    # what a camera does not see has no weight; the last half pixel that it sees is not darkened
    options: dict[str, Any] = {"mode": mode, "padding_mode": "border"}
    for name, camera in rig.items():
        pose = rig.extrinsics[name]
        if target is None:
            warps[name] = BirdsEye(camera, pose, **ground, **options)
            continue
        as_sized(target, "target", owner)
        if math.isinf(distance):
            turn = rotation_matrix(pose.rotation).mT
            warps[name] = Warp(camera, target, turn.to(camera.intrinsics.dtype), **options)
            continue
        far = float(torch.linalg.vector_norm(pose.position.detach(), dim=-1).max())
        if far >= distance:
            raise ValueError(f"{owner}: the camera {name!r} stands {far:.4g} from the origin; distance is {distance}")
        warps[name] = _SphereWarp(camera, target, pose, distance, **options)
    return Surround(warps, blend, fill)
