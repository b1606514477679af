"""How much of a new image shows something of the old one, and the zoom and the turn with which enough of it does."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from camtorch._arguments import broadcast_shapes
from camtorch.augment.change import frozen, remade, size_of
from camtorch.camera import Camera, from_values
from camtorch.rotations import rotation_matrix, rotation_vector
from camtorch.warp.warp import Warp, along_edges

_POINTS, _RIM = 1000, 16  # over the image, and along each of its edges
_ROOT = 1.324717957244746
_CARE = 0.01  # what the points may miss by
_NEARLY = 0.999
_ZOOM = 4.0  # at most, before the camera turns back
_FAR_ZOOM = 1000.0  # of a camera that is not turned
_TURNS = 1.0, 0.5, 0.25, 0.0
_HALVINGS = 10


def filled(source: Camera, target: Camera, rotation: Tensor | None) -> Tensor:
    """(*B,): the part of the target's image that shows something of the source's; 1 where its whole rim does.

    As told by points that are spread evenly without rows, which a rim might run along: multiples of the inverse powers
    of the root of x^3 = x + 1, modulo 1.
    """
    height, width = size_of(target)
    like = target.intrinsics
    steps = torch.arange(1, _POINTS + 1, dtype=torch.float64)[:, None]
    spread = (steps / torch.tensor([_ROOT, _ROOT**2], dtype=torch.float64)).frac()
    corners = spread.new_tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
    # half a pixel in, at the centres of the outermost pixels
    rim = along_edges(corners * spread.new_tensor([width - 1, height - 1]), _RIM)
    pixels = torch.cat((spread * spread.new_tensor([width, height]) - 0.5, rim)).to(like)
    back = Warp(target, source, None if rotation is None else rotation.mT)
    shown = back.transform_points(pixels.expand(*(back.batch_shape or ()), -1, -1))[1]
    part = shown[..., :_POINTS].to(like.dtype).mean(-1)
    return torch.where(shown[..., _POINTS:].all(-1), part, part.clamp(max=_NEARLY))


def scaled(camera: Camera, factor: Tensor) -> Camera:
    """The camera with focal lengths times a factor (*B,)."""
    one = torch.ones_like(factor)
    scale = torch.stack((factor, factor, one, one), -1)
    return remade(camera, camera.intrinsics * scale, camera.distortion, camera.image_size)


def enough(source: Camera, target: Camera, rotation: Tensor | None, share: float) -> tuple[Tensor, Tensor, Tensor]:
    """The least that is to be done so that a `share` of the target's image shows something of the source's.

    First the target zooms, up to four times. Where that is not enough it turns half as far from the source, a quarter
    as far, or not at all.

    Returns:
        factor (*B,) on the target's focal lengths, at least 1; the rotation (*B, 3, 3); and the part (*B,) that is
        filled then, which is below `share` where the source does not even see the target's axis. Graph-free.
    """
    share = min(share + _CARE, 1.0)
    with torch.no_grad():
        if rotation is None:
            rotation = torch.eye(3, dtype=target.intrinsics.dtype, device=target.intrinsics.device)
        if torch.compiler.is_compiling():
            numbers = (
                (camera._model, camera.intrinsics, camera.distortion, list(size_of(camera)))
                for camera in (source, target)
            )
            factor, rotation, found = _opaque_enough(*next(numbers), *next(numbers), rotation, share)
            return factor, rotation, found
        return _enough(frozen(source, source.image_size), frozen(target, target.image_size), rotation, share)


def _enough(source: Camera, target: Camera, rotation: Tensor, share: float) -> tuple[Tensor, Tensor, Tensor]:
    found = filled(source, target, rotation)
    factor = torch.ones_like(found)
    done = found >= share
    drawn = turned = rotation.expand(*found.shape, 3, 3)
    straight = bool((rotation == torch.eye(3, dtype=rotation.dtype, device=rotation.device)).all())
    for part in _TURNS[-1:] if straight else _TURNS:
        if bool(done.all()):
            break
        if part != 1:
            turned = rotation_matrix(part * rotation_vector(drawn))
        zoom = _least_zoom(source, target, turned, share, _ZOOM if part else _FAR_ZOOM)
        now = filled(source, scaled(target, zoom), turned)
        better = ~done & (now > found)
        factor, found = torch.where(better, zoom, factor), torch.where(better, now, found)
        rotation = torch.where(better[..., None, None], turned, rotation)
        done = found >= share
    return factor, rotation.expand(*found.shape, 3, 3), found


def _least_zoom(source: Camera, target: Camera, rotation: Tensor, share: float, most: float) -> Tensor:
    """(*B,): the least factor of at least 1, or `most`."""
    batch = filled(source, target, rotation)
    low, high = torch.ones_like(batch), torch.full_like(batch, most)
    high = torch.where(batch >= share, low, high)
    for _ in range(_HALVINGS):
        middle = (low * high).sqrt()
        is_enough = filled(source, scaled(target, middle), rotation) >= share
        low, high = torch.where(is_enough, low, middle), torch.where(is_enough, middle, high)
    return high


@torch.library.custom_op("camtorch::enough", mutates_args=())
def _opaque_enough(
    source: str,
    source_intrinsics: Tensor,
    source_distortion: Tensor,
    source_size: Sequence[int],
    target: str,
    target_intrinsics: Tensor,
    target_distortion: Tensor,
    target_size: Sequence[int],
    rotation: Tensor,
    share: float,
) -> tuple[Tensor, Tensor, Tensor]:
    before = from_values(source, source_intrinsics, source_distortion, source_size)
    after = from_values(target, target_intrinsics, target_distortion, target_size)
    factor, turned, found = _enough(before, after, rotation, share)
    return factor.clone(), turned.clone(), found.clone()


@_opaque_enough.register_fake
def _(
    source: str,
    source_intrinsics: Tensor,
    source_distortion: Tensor,
    source_size: Sequence[int],
    target: str,
    target_intrinsics: Tensor,
    target_distortion: Tensor,
    target_size: Sequence[int],
    rotation: Tensor,
    share: float,
) -> tuple[Tensor, Tensor, Tensor]:
    numbers = source_intrinsics, source_distortion, target_intrinsics, target_distortion
    batch = broadcast_shapes(*(t.shape[:-1] for t in numbers), rotation.shape[:-2])
    like = target_intrinsics
    return like.new_empty(batch), rotation.new_empty(*batch, 3, 3), like.new_empty(batch)
