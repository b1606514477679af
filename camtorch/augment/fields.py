"""The fields of a sample: what each holds, how it is checked at the door, and how it moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.change import Change
from camtorch.camera import Camera
from camtorch.rotations import rotation_matrix, rotation_vector

KEEP = "keep"
PICTURES = ("image", "mask", "depth", "distance")


@dataclass(frozen=True)
class Field:
    """A kind of data."""

    dims: int
    """The least number of dims of a single sample."""
    most_dims: int
    """The most."""
    last: tuple[int, ...]
    """What its last dim may be; empty: anything."""
    shape: str
    """In words, of a batch."""
    move: Callable
    """(change, batch, options) -> batch, or (batch, valid)."""
    decides: bool = False
    """Whether its number of dims tells a batch from a single sample."""


def _image(change: Change, images: Tensor, options: Mapping) -> Tensor:
    return change.images(images)


def _mask(change: Change, masks: Tensor, options: Mapping) -> Tensor:
    flat = masks.ndim == 3
    moved = change.labels(masks.unsqueeze(1) if flat else masks, options["mask_fill"])
    return moved.squeeze(1) if flat else moved


def _depth(change: Change, depth: Tensor, options: Mapping) -> Tensor:
    flat = depth.ndim == 3
    moved = change.depth(depth.unsqueeze(1) if flat else depth)
    return moved.squeeze(1) if flat else moved


def _distance(change: Change, distance: Tensor, options: Mapping) -> Tensor:
    return _mask(change, distance, {"mask_fill": 0.0})


def _pixels(change: Change, pixels: Tensor, options: Mapping) -> tuple[Tensor, Tensor]:
    return change.points(pixels)


def _boxes(change: Change, boxes: Tensor, options: Mapping) -> tuple[Tensor, Tensor]:
    return change.boxes(boxes)


def _rays(change: Change, rays: Tensor, options: Mapping) -> Tensor:
    return change.rays(rays)


def _pitch_yaw(change: Change, angles: Tensor, options: Mapping) -> Tensor:
    return change.rays(angles, from_pitch_yaw, to_pitch_yaw)


def _pose(change: Change, pose: Tensor, options: Mapping) -> Tensor:
    top = change.rays(pose[..., :3, :], _columns, _columns)
    return torch.cat((top, pose[..., 3:, :].to(top)), -2)


def _columns(matrix: Tensor) -> Tensor:
    return matrix.mT


def _rotation_vector(change: Change, rvec: Tensor, options: Mapping) -> Tensor:
    return change.rays(rvec, lambda r: rotation_matrix(r).mT, lambda columns: rotation_vector(columns.mT))


def _rotation(change: Change, rotation: Tensor, options: Mapping) -> Tensor:
    return change.rays(rotation, _columns, _columns)


_MANY = 16
_RAYS = Field(1, _MANY, (3,), "(B, *N, 3) directions of the camera frame", _rays)
_POSE = Field(2, 2, (4,), "(B, 4, 4) or (B, 3, 4), camera from head", _pose)
KINDS = {
    "image": Field(3, 3, (), "(B, C, H, W)", _image, True),
    "mask": Field(2, 3, (), "(B, C, H, W) or (B, H, W)", _mask),
    "depth": Field(2, 3, (), "(B, 1, H, W) or (B, H, W), along z", _depth),
    "distance": Field(2, 3, (), "(B, 1, H, W) or (B, H, W), along the ray", _distance),
    "keypoints": Field(2, 2, (2,), "(B, N, 2) pixels x, y", _pixels, True),
    "polygons": Field(3, 3, (2,), "(B, M, K, 2) corners x, y", _pixels, True),
    "boxes": Field(2, 2, (4,), "(B, M, 4) pixels x1, y1, x2, y2", _boxes, True),
    "landmarks": Field(2, 2, (2, 3), "(B, N, 2) pixels or (B, N, 3) points of the camera frame", _pixels, True),
    "points": Field(1, _MANY, (3,), "(B, *N, 3) points of the camera frame", _rays),
    "gaze": _RAYS,
    "directions": _RAYS,
    "pitch_yaw": Field(1, _MANY, (2,), "(B, *N, 2) pitch and yaw of a gaze in radians", _pitch_yaw),
    "head_pose": _POSE,
    "pose": _POSE,
    "rvec": Field(1, 1, (3,), "(B, 3), a rotation vector, camera from head", _rotation_vector),
    "tvec": Field(1, 1, (3,), "(B, 3), a point of the camera frame", _rays),
    "rotation": Field(2, 2, (3,), "(B, 3, 3), turned so far", _rotation),
}
_ALIASES = {"images": "image", "masks": "mask", "bboxes": "boxes", "point": "points", "face_center": "points"}
OWN = ("camera", "source_camera", "source_rotation", "scale")  # these come with a change and do not move


def kind_of(name: str, value, own: Mapping[str, str], owner: str) -> str | None:
    """The key in `KINDS` of a field, or None if it stays as it is.

    Raises:
        ValueError: numbers of an unknown name, which might be geometry.
    """
    if name in own:
        return None if own[name] == KEEP else own[name]
    if name.endswith("_valid"):
        return None
    base = name if name in KINDS else _ALIASES.get(name)
    if base is None:
        base = max((k for k in KINDS if name.startswith(k + "_")), key=len, default=None)
        if base is not None and not isinstance(value, (Tensor, np.ndarray, list, tuple)):
            return None  # image_path, mask_id
    if base is None and _holds_reals(value):
        raise ValueError(
            f"{owner}: {name!r} holds real numbers, and whether they move with the camera is not known. "
            f"fields={{{name!r}: KIND}} says so, where KIND is {', '.join(KINDS)} or {KEEP}"
        )
    return base


def _holds_reals(value) -> bool:
    """Whether there are real numbers in it that might be geometry; a number alone is none."""
    if isinstance(value, Mapping):
        return any(map(_holds_reals, value.values()))
    if isinstance(value, (list, tuple)):
        return any(isinstance(item, float) or _holds_reals(item) for item in value)
    if isinstance(value, np.ndarray):
        return value.ndim > 0 and np.issubdtype(value.dtype, np.floating)
    return isinstance(value, Tensor) and value.ndim > 0 and value.is_floating_point()


def moves(kind: str, value: Tensor) -> Callable:
    """How values of a kind move."""
    return _rays if kind == "landmarks" and value.shape[-1] == 3 else KINDS[kind].move


def as_tensor(value, name: str, kind: str, owner: str) -> Tensor:
    """The value of a field as a tensor.

    Raises:
        TypeError: it is neither a tensor nor an array of real numbers.
    """
    if isinstance(value, np.ndarray) and value.dtype != object:
        value = torch.from_numpy(value)
    if not isinstance(value, Tensor) or value.is_complex():
        what = f"dtype {value.dtype}" if isinstance(value, Tensor) else type(value).__name__
        raise TypeError(
            f"{owner}: {name} must be a tensor of real numbers, {KINDS[kind].shape}; got {what}{_hint(name)}"
        )
    if kind not in PICTURES and not value.is_floating_point():
        value = value.to(torch.get_default_dtype())  # whole pixels do not stay whole
    return value


def _hint(name: str) -> str:
    return "" if name in KINDS else f". If it is something else, fields={{{name!r}: '{KEEP}'}} leaves it as it is"


def check(kind: str, name: str, value: Tensor, batched: bool, owner: str) -> None:
    """Raise a ValueError unless a kind takes this shape."""
    field = KINDS[kind]
    dims = value.ndim - batched
    least, most = field.dims, field.most_dims
    if not least <= dims <= most or (field.last and value.shape[-1] not in field.last):
        what = field.shape if batched else field.shape.replace("(B, ", "(")
        raise ValueError(f"{owner}: {name} must be {what}; got shape {tuple(value.shape)}{_hint(name)}")
    if kind in ("head_pose", "pose") and value.shape[-2] not in (3, 4):
        raise ValueError(f"{owner}: {name} must be {field.shape}; got shape {tuple(value.shape)}")


def is_batch(named: Mapping[str, tuple[str, object]], camera) -> bool:
    """Whether a sample of name -> (kind, value) is a batch of samples.

    The field that decides is the first of: an image, pixels, boxes; else cameras with a batch dim, and else any
    field with more dims than one sample has.
    """
    if isinstance(camera, (list, tuple)):
        return True
    order = list(KINDS)
    for kind, value in sorted(named.values(), key=lambda pair: (not KINDS[pair[0]].decides, order.index(pair[0]))):
        if isinstance(value, (list, tuple)):
            return True
        if KINDS[kind].decides:
            return value.ndim > KINDS[kind].dims
    if isinstance(camera, Camera) and camera.batch_shape:
        return True
    return any(value.ndim > KINDS[kind].dims for kind, value in named.values())


def from_pitch_yaw(angles: Tensor) -> Tensor:
    """Unit gaze vectors (..., 3) of pitch and yaw (..., 2) in radians, as in MPIIGaze and ETH-XGaze.

    Zero looks into the camera, along -z. Source: Zhang et al., ETH-XGaze, 2020, and its code.
    """
    pitch, yaw = angles.unbind(-1)
    return torch.stack((-pitch.cos() * yaw.sin(), -pitch.sin(), -pitch.cos() * yaw.cos()), -1)


def to_pitch_yaw(gaze: Tensor) -> Tensor:
    """Pitch and yaw (..., 2) in radians of gaze vectors (..., 3): pitch = asin(-y), yaw = atan2(-x, -z)."""
    x, y, z = gaze.unbind(-1)
    return torch.stack((torch.atan2(-y, torch.hypot(x, z)), torch.atan2(-x, -z)), -1)
