"""The kinds of fields in a sample, a table: how each is recognised, checked and moved."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from camtorch.augment import wrong_fields
from camtorch.augment.change import Change
from camtorch.augment.matrices import SHAPE, SIDES, check_matrix, matrix_hint, moved_matrix
from camtorch.poses.gaze import from_pitch_yaw, to_pitch_yaw
from camtorch.poses.rotations import rotation_matrix, rotation_vector
from camtorch.values.arguments import check_radians
from camtorch.values.dtypes import widen
from camtorch.warp.options import Options, Sampler
from camtorch.warp.together import Label

Named = dict[str, tuple[str, Any]]
"""Maps a name to (kind, tensor or list of tensors)."""

FRONT_ENDS = (
    "For PIL images and torchvision write camtorch.augment.torchvision.Transform(augmentation); others are "
    "camtorch.augment.albumentations.Transform, numpy.Transform and kornia.CameraAugmentation"
)
"""The hint of errors about what other libraries pass."""
KEEP = "keep"

Move = Callable[[Change, Tensor, Mapping[str, float]], Any]


@dataclass(kw_only=True)
class Field:
    """A kind of field: how its values are recognised, checked and moved."""

    dims: int  # the least number of dims of a single sample
    most_dims: int = 0  # the most; by default as many
    ends: Sequence[tuple[int, ...]] = ()  # what its last dims may be; empty: anything
    shape: str  # in words, of a batch
    move: Move  # (change, batch, options) -> batch, or (batch, valid)
    together: Label | Callable[[Options, float], Sampler] | None = None
    """How one call for several fields moves it, as `move` would: (options, mask_fill) -> sampler for images. None: that
    call leaves it to `move`. Beside such an image C moves nothing: both would compute the position of each pixel."""
    is_image: bool = False  # whether its last dims are those of the camera's image, and whole numbers stay whole
    tells_batches: bool = False  # whether its number of dims distinguishes a batch from a sample
    in_pixels: bool = False  # whether it is warned of numbers that hardly are pixels of the image
    hint: Callable[[Tensor, str, bool], str] | None = None  # (value, name, batched) -> what to do about a wrong shape
    check: Callable[[Tensor, str, str], None] | None = None  # (value, name, owner); raises if values are not of it

    def __post_init__(self) -> None:
        self.most_dims = max(self.dims, self.most_dims)


def _by(method: Callable[..., Any], *forms: Callable[[Tensor], Tensor]) -> Move:
    """Return the move by a method of `Change`; forms: functions that read and write values of another form."""
    return lambda change, value, options: method(change, value, *forms)


def _planes(move: Move) -> Move:
    """Return a function like `move` that also takes values without channels, (B, H, W), such as masks."""

    def of(change: Change, value: Tensor, options: Mapping[str, float]) -> Tensor:
        moved: Tensor = move(change, value.unsqueeze(1) if value.ndim == 3 else value, options)
        return moved.squeeze(1) if value.ndim == 3 else moved

    return of


def _labels(change: Change, masks: Tensor, options: Mapping[str, float]) -> Tensor:
    return change.labels(masks, options["mask_fill"])


def _columns(matrix: Tensor) -> Tensor:
    return matrix.mT


def _pose(change: Change, pose: Tensor, options: Mapping[str, float]) -> Tensor:
    turned = change.rays(pose[..., :3, :], _columns, _columns)
    turned = torch.cat((turned[..., :3], change.positions(pose[..., :3, 3]).to(turned)[..., None]), -1)
    top = _mirrored_head(change, turned, options)
    return torch.cat((top, pose[..., 3:, :].to(top)), -2)


def _rvec(change: Change, rvec: Tensor, options: Mapping[str, float]) -> Tensor:
    if change.mirrored is None:
        return change.rays(rvec, lambda r: rotation_matrix(r).mT, lambda columns: rotation_vector(columns.mT))
    turned = _mirrored_head(change, change.rays(rotation_matrix(rvec), _columns, _columns), options)
    eye = torch.eye(3, dtype=change.rotation.dtype, device=change.rotation.device)
    still = (change.rotation == eye).all(-1).all(-1).to(rvec.device)
    return torch.where(still.unsqueeze(-1), rvec.to(turned), rotation_vector(turned))


def _mirrored_head(change: Change, matrix: Tensor, options: Mapping[str, float]) -> Tensor:
    """Return the columns (B, 3, n) of turned heads, whose sides a mirror exchanges without mirroring the pose."""
    mirrored = change.mirrored
    if mirrored is None:
        return matrix
    lateral = torch.arange(matrix.shape[-1], device=matrix.device) == options["lateral"]
    return torch.where(mirrored.to(matrix.device)[:, None, None] & lateral, -matrix, matrix)


_ANCHORS = {"boxes_xywh": 0.0, "boxes_cxcywh": 0.5}  # boxes by a point and sides: how far along these the point is


def as_corners(kind: str, boxes: Tensor) -> Tensor:
    """Return boxes (..., 4) of a kind as x1, y1, x2, y2."""
    if kind not in _ANCHORS:
        return boxes
    anchor, size = widen(boxes).split(2, -1)
    low = anchor - _ANCHORS[kind] * size
    return torch.cat((low, low + size), -1)


def _sided_boxes(kind: str, words: str) -> Field:
    """Return the field of boxes by a point, width and height; words: what their numbers are."""

    def write(corners: Tensor) -> Tensor:
        low, high = corners.split(2, -1)
        return torch.cat((low + _ANCHORS[kind] * (high - low), high - low), -1)

    shape = f"(B, M, 4) pixels {words}"
    return Field(
        dims=2,
        ends=[(4,)],
        shape=shape,
        move=_by(Change.boxes, functools.partial(as_corners, kind), write),
        tells_batches=True,
        in_pixels=True,
        hint=wrong_fields.boxes_hint,
        check=wrong_fields.sides_check(kind.removeprefix("boxes_").upper(), shape),
    )


def _image_sampler(options: Options, mask_fill: float) -> Sampler:
    return Sampler(options["mode"], options["padding_mode"], options["fill"])


def _mask_sampler(options: Options, mask_fill: float) -> Sampler:
    return Sampler("nearest", "zeros", (mask_fill,))


_MOST_DIMS = 16  # any number
_DIRECTIONS = Field(
    dims=1,
    most_dims=_MOST_DIMS,
    ends=[(3,)],
    shape="(B, *N, 3) directions of the camera frame",
    move=_by(Change.rays),
    together="rays",
    hint=wrong_fields.rays_hint,
)
_POSE = Field(
    dims=2,
    ends=[(4, 4), (3, 4)],
    shape="(B, 4, 4) or (B, 3, 4), camera from head",
    move=_pose,
    together="pose",
    tells_batches=True,
    hint=wrong_fields.pose_hint,
    check=wrong_fields.check_pose,
)
# the order counts where several kinds would do: whether a sample is a batch, and what a wrong name may have meant
KINDS = {
    "image": Field(
        dims=3,
        shape="(B, C, H, W)",
        move=_by(Change.images),
        together=_image_sampler,
        is_image=True,
        tells_batches=True,
        hint=wrong_fields.image_hint,
    ),
    "mask": Field(
        dims=2,
        most_dims=3,
        shape="(B, C, H, W) or (B, H, W)",
        move=_planes(_labels),
        together=_mask_sampler,
        is_image=True,
    ),
    "depth": Field(
        dims=2,
        most_dims=3,
        shape="(B, 1, H, W) or (B, H, W), along z",
        move=_planes(_by(Change.depth)),
        is_image=True,
    ),
    "distance": Field(
        dims=2,
        most_dims=3,
        shape="(B, 1, H, W) or (B, H, W), along the ray",
        move=_planes(_by(Change.distance)),
        is_image=True,
    ),
    "keypoints": Field(
        dims=2,
        most_dims=3,
        ends=[(2,)],
        shape="(B, N, 2) or (B, F, N, 2) pixels x, y",
        move=_by(Change.points),
        together="pixels",
        tells_batches=True,
        in_pixels=True,
        hint=wrong_fields.keypoints_hint,
    ),
    "polygons": Field(
        dims=3,
        ends=[(2,)],
        shape="(B, M, K, 2) corners x, y",
        move=_by(Change.points),
        together="pixels",
        tells_batches=True,
    ),
    "boxes": Field(
        dims=2,
        ends=[(4,)],
        shape=wrong_fields.CORNERS,
        move=_by(Change.boxes),
        together="boxes",
        tells_batches=True,
        in_pixels=True,
        hint=wrong_fields.boxes_hint,
        check=wrong_fields.check_corners,
    ),
    "boxes_xywh": _sided_boxes("boxes_xywh", "x, y, width, height"),
    "boxes_cxcywh": _sided_boxes("boxes_cxcywh", "x and y of the centre, width, height"),
    "landmarks": Field(
        dims=2,
        most_dims=3,
        ends=[(2,), (3,)],
        shape="(B, N, 2) pixels or (B, N, 3) points of the camera frame",
        move=lambda change, value, options: field_of("landmarks", value).move(change, value, options),
        tells_batches=True,
        in_pixels=True,
        hint=wrong_fields.landmarks_hint,
    ),
    "points": Field(
        dims=1,
        most_dims=_MOST_DIMS,
        ends=[(3,)],
        shape="(B, *N, 3) points of the camera frame",
        move=_by(Change.positions),
        together="rays",
        hint=wrong_fields.column_hint,
    ),
    "gaze": _DIRECTIONS,
    "directions": _DIRECTIONS,
    "pitch_yaw": Field(
        dims=1,
        most_dims=_MOST_DIMS,
        ends=[(2,)],
        shape="(B, *N, 2) pitch and yaw of a gaze in radians",
        move=_by(Change.rays, from_pitch_yaw, to_pitch_yaw),
        check=wrong_fields.check_pitch_yaw,
    ),
    "head_pose": _POSE,
    "pose": _POSE,
    "rvec": Field(
        dims=1,
        ends=[(3,)],
        shape="(B, 3), a rotation vector, camera from head",
        move=_rvec,
        together="rotation vectors",
        tells_batches=True,
        hint=wrong_fields.column_hint,
        check=check_radians,
    ),
    "tvec": Field(
        dims=1,
        ends=[(3,)],
        shape="(B, 3), a point of the camera frame",
        move=_by(Change.positions),
        together="rays",
        tells_batches=True,
        hint=wrong_fields.column_hint,
    ),
    "rotation": Field(
        dims=2,
        ends=[(3,)],
        shape="(B, 3, 3), turned so far",
        move=_by(Change.rays, _columns, _columns),
        together="columns",
        hint=wrong_fields.column_hint,
    ),
    "K": Field(
        dims=2, ends=SIDES, shape=SHAPE, move=moved_matrix, tells_batches=True, hint=matrix_hint, check=check_matrix
    ),
}
BOXES = "boxes", *_ANCHORS
IMAGES = tuple(kind for kind, field in KINDS.items() if field.is_image)
PLACE = "crop_place"
"""The field of where a crop looks, seen from the first camera; it follows from a sample's camera and rotation."""
OWN = ("camera", "source_camera", "source_rotation", "scale", PLACE)
"""These follow from the change: no kind moves them, unless `fields` gives one to a field of the same name."""


def field_of(kind: str, value: Tensor) -> Field:
    """Return the field by which values of a kind move: `landmarks` as keypoints or points, by their last dim."""
    if kind != "landmarks":
        return KINDS[kind]
    return KINDS["points" if value.shape[-1] == 3 else "keypoints"]
