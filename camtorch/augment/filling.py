"""How much of a new image shows the old one, and the zoom and the rotation with which enough of it does."""

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from camtorch.augment.ranges import Range, draw_numbers, values_for
from camtorch.cameras.camera import Camera
from camtorch.cameras.operators import CameraNumbers, opaque
from camtorch.evaluate.tensors import known_false
from camtorch.native.structs import FAR_ZOOM, HALVINGS, LOOKED_AT, MOST_ZOOM, NEARLY_FILLED, SPREAD, TURN_PARTS
from camtorch.optics.radial_inverse import precise
from camtorch.poses.rotations import rotation_matrix, rotation_vector
from camtorch.values.arguments import TOLD, broadcast_shapes, warn
from camtorch.values.module import remade
from camtorch.warp.boxes import along_edges
from camtorch.warp.camera_pair import CameraPair

_ROOT = 1.324717957244746  # plastic number: a low-discrepancy sequence in 2D (R2)
_SHARE_ERROR = 0.01  # largest error of the share that points measure
_LEAST_SHOWN = 2 / 3  # of what an image shows of its own camera: with less than that, on average, it warns
_TRIES = 8
_LEAST_FOV_SHARE = 0.9  # of the least field of view that was asked for: below that a warning says so

NewCamera = Callable[[Camera, Mapping[str, Any]], tuple[Camera, Tensor | None]]
"""A camera and values -> the camera after and the rotation, as `Augmentation.new_camera`."""


def filled(source: Camera, target: Camera, rotation: Tensor | None) -> Tensor:
    """Return the part (*B,) of the target's image that shows the source's; 1 only if its whole rim shows it too."""
    return _part_shown(source, target, _points(target), rotation)


def _points(camera: Camera) -> Tensor:
    return looked_at((camera.height, camera.width), camera.intrinsics.dtype).to(camera.intrinsics.device)


@lru_cache(maxsize=16)
def looked_at(size: tuple[int, int], dtype: torch.dtype) -> Tensor:
    """Return the pixels (N, 2) that `filled` tests on images of a size: spread over the image, then on its rim."""
    height, width = size
    with torch.inference_mode(False):
        steps = torch.arange(1, SPREAD + 1, dtype=torch.float64, device="cpu")[:, None]
        spread = (steps / steps.new_tensor([_ROOT, _ROOT**2])).frac()
        corners = spread.new_tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
        # half a pixel in, at the centres of the outermost pixels
        rim = along_edges(corners * spread.new_tensor([width - 1, height - 1]), (LOOKED_AT - SPREAD) // 4)
        return torch.cat((spread * spread.new_tensor([width, height]) - 0.5, rim)).to(dtype)


def _part_shown(
    source: Camera, target: Camera, pixels: Tensor, rotation: Tensor | None, zoom: Tensor | None = None
) -> Tensor:
    """Return `filled`, measured at `pixels`, for a target whose focal lengths are multiplied by a zoom (*B,)."""
    shapes = [source.batch_shape, target.batch_shape, *([] if rotation is None else [rotation.shape[:-2]])]
    if zoom is not None:  # the camera without the zoom has the same rays at other pixels
        shapes.append(zoom.shape)
        centre = target.intrinsics[..., None, 2:]
        pixels = centre + (pixels - centre) / zoom[..., None, None]
    pixels = pixels.expand(*broadcast_shapes(*shapes), *pixels.shape[-2:])
    _, shown = CameraPair(source, target, rotation).back.move(pixels, on_image=True)
    part = shown[..., :SPREAD].to(pixels.dtype).mean(-1)
    return torch.where(shown[..., SPREAD:].all(-1), part, part.clamp(max=NEARLY_FILLED))


def scaled(camera: Camera, factor: Tensor) -> Camera:
    """Return the camera with focal lengths times a factor (*B,)."""
    one = torch.ones_like(factor)
    scale = torch.stack((factor, factor, one, one), -1)
    return remade(camera, intrinsics=camera.intrinsics * scale)


def zoom_to_fill(
    source: Camera, target: Camera, rotation: Tensor | None, share: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the zoom (*B,) and the rotation (*B, 3, 3), turned less far, that fill `share`, and the part filled."""
    with torch.no_grad():
        if rotation is None:
            rotation = torch.eye(3, dtype=target.intrinsics.dtype, device=target.intrinsics.device)
        factor, turned, found = _zoom_to_fill(source.detach(), target.detach(), rotation, with_care(share))
        return factor, turned, found


def with_care(share: float) -> float:
    """Return the share of points for which `share` of the image is surely filled."""
    return min(share + _SHARE_ERROR, 1.0)


def _shapes(
    source: CameraNumbers, target: CameraNumbers, rotation: Tensor, share: float
) -> tuple[Tensor, Tensor, Tensor]:
    batch = broadcast_shapes(*(t.shape[:-1] for camera in (source, target) for t in camera[:2]), rotation.shape[:-2])
    like = target.intrinsics
    return like.new_empty(batch), rotation.new_empty(*batch, 3, 3), like.new_empty(batch)


@opaque(_shapes)
def _zoom_to_fill(source: Camera, target: Camera, rotation: Tensor, share: float) -> tuple[Tensor, Tensor, Tensor]:
    part_shown = partial(_part_shown, source, target, _points(target))
    found = part_shown(rotation)
    factor = torch.ones_like(found)
    done = found >= share
    drawn = turned = rotation.expand(*found.shape, 3, 3)
    vector = None
    straight = bool((rotation == torch.eye(3, dtype=rotation.dtype, device=rotation.device)).all())
    for part in TURN_PARTS[-1:] if straight else TURN_PARTS:
        if bool(done.all()):
            break
        if part != 1:
            vector = rotation_vector(precise(drawn)) if vector is None else vector
            turned = rotation_matrix(part * vector).to(rotation.dtype)
        at_first = found if part == 1 or straight else part_shown(turned)
        zoom, now = _least_zoom(partial(part_shown, turned), at_first, share, MOST_ZOOM if part else FAR_ZOOM)
        better = ~done & (now > found)
        factor, found = torch.where(better, zoom, factor), torch.where(better, now, found)
        rotation = torch.where(better[..., None, None], turned, rotation)
        done = found >= share
    return factor, rotation.expand(*found.shape, 3, 3).clone(), found


def _least_zoom(
    part_shown: Callable[[Tensor], Tensor], at_first: Tensor, share: float, most: float
) -> tuple[Tensor, Tensor]:
    """Return the least factor (*B,) from 1 to `most`, and the part of the image that is filled with it."""
    low, high = torch.ones_like(at_first), torch.full_like(at_first, most)
    high, at_high = torch.where(at_first >= share, low, high), at_first
    for _ in range(HALVINGS):
        middle = (low * high).sqrt()
        at_middle = part_shown(middle)
        is_enough = at_middle >= share
        low, high = torch.where(is_enough, low, middle), torch.where(is_enough, middle, high)
        at_high = torch.where(is_enough, at_middle, at_high)
    if bool((high == most).any()):  # not measured yet
        at_high = torch.where(high == most, part_shown(high), at_high)
    return high, at_high


def warn_if_empty(owner: str, camera: Camera, ranges: Mapping[str, Range], new_camera: NewCamera) -> None:
    """Warn if new images of `camera` will be mostly empty; draws from a generator of its own show it."""
    draw = draw_numbers(ranges, _TRIES, 1.0, False, torch.Generator().manual_seed(0))
    with torch.no_grad():
        first = camera.detach()
        first = first[[0] * _TRIES] if first.batch_shape else first
        shares = filled(first, *new_camera(first, values_for(first, draw)))
        most = filled(first, first, None)  # less than 1 if a fisheye shows a circle
    if shares.mean() < _LEAST_SHOWN * most.mean():
        warn(
            f"{owner}: of the new images {1 - float(shares.mean()):.0%} will show nothing, and of some "
            f"{1 - float(shares.min()):.0%}, as the camera of the images does not see so far. min_filled=0.9 zooms "
            "until that much of every image shows something; fov='source', in lenses, takes one as wide as the "
            "images are; min_filled=0 says that it is meant so"
        )


def warn_of_unfilled(owner: str, share: float, found: Tensor) -> None:
    """Warn that the parts `found` (*B,) of new images that show something are less than `min_filled`, a `share`."""
    few = int((found < share).sum())
    warn(
        f"{owner}: min_filled must be within reach; got {share:g}, and of {few} of {found.numel()} new images "
        f"down to {float(found.min()):.0%} shows something: the camera of the images does not see along the axis "
        "of the new one. Turn it less, or use less of min_filled"
    )


def tell_of_narrow_images(
    owner: str, fov: float, share: float, source: Camera, target: Callable[[], Camera], factor: Tensor, found: Tensor
) -> None:
    """Warn, once a process, if the zoom for `share`, and not a draw, left less than a `fov` that was asked for.

    target: returns the cameras that were zoomed by factors (*B,), and are filled to the parts `found` (*B,).
    """
    key = "less than fov", owner, fov, share
    if key in TOLD or not known_false(factor <= 1):
        return
    zoomed = target()
    made = _across(zoomed).expand_as(factor)
    least = torch.minimum(_across(scaled(zoomed, 1 / factor)), torch.full_like(made, fov))
    # what cannot be filled at all has a warning of its own
    less = (made < _LEAST_FOV_SHARE * least) & (factor > 1) & (found >= share)
    if not bool(less.any()):
        return
    TOLD.add(key)
    warn(
        f"{owner}: fov must be {fov:g} degrees at least; got an image {float(made[less].min()):.0f} degrees "
        f"wide: min_filled={share:g} zooms until so much of it is filled, and the camera of the images, "
        f"{float(source.fov[..., 0].max()):.0f} degrees wide, shows no more in that direction. Pass fov='source' "
        "for as much as it has, or min_filled=0 to leave the rest empty"
    )


def _across(camera: Camera) -> Tensor:
    """Return the degrees (*B,) from the left to the right edge of the image, at the height of the principal point."""
    cy = camera.intrinsics[..., 3].detach()
    u = torch.stack((torch.full_like(cy, -0.5), torch.full_like(cy, camera.width - 0.5)), -1)
    pixels = torch.stack((u, cy[..., None].expand_as(u)), -1)
    with torch.no_grad():
        rays = camera.unproject(pixels.expand(*camera.batch_shape, 2, 2))[0]
    return torch.atan2(rays[..., 0].abs(), rays[..., 2]).sum(-1).rad2deg()
