"""The kinds of fields in a sample, a table: how each is found by its name, checked, and moved."""

from __future__ import annotations

import difflib
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.change import Change
from camtorch.augment.matrices import NAMES, SHAPE, SIDES, check_matrix, matrix_hint, moved_matrix
from camtorch.cameras.camera import Camera
from camtorch.evaluate.door import may_look, pytree
from camtorch.evaluate.tensors import known_false, known_true
from camtorch.poses.rotations import are_rotations, check_rotation, is_right, rotation_matrix, rotation_vector
from camtorch.values.arguments import as_coordinates, check_angles, check_boxes, check_radians, warn
from camtorch.values.dtypes import widen
from camtorch.warp import arrays
from camtorch.warp.options import Options, Sampler
from camtorch.warp.samples import Label

Named = dict[str, tuple[str, Any]]
"""Maps a name to (kind, tensor or list of tensors)."""

FRONT_ENDS = (
    "For PIL images and torchvision write camtorch.augment.torchvision.Transform(augmentation); others are "
    "camtorch.augment.albumentations.Transform, numpy.Transform and kornia.CameraAugmentation"
)
"""The hint of errors about what other libraries pass."""
KEEP = "keep"
IMAGES = ("image", "mask", "depth", "distance")

Move = Callable[[Change, Tensor, Mapping[str, float]], Any]


def _no_hint(name: str, value: Tensor, batched: bool) -> str:
    return ""


def _no_check(value: Tensor, name: str, owner: str) -> None:
    pass


@dataclass(frozen=True)
class Field:
    """A kind of field: how its values are recognised, checked and moved."""

    dims: int  # the least number of dims of a single sample
    most_dims: int  # the most
    last: tuple[int, ...]  # what its last dim may be; empty: anything
    shape: str  # in words, of a batch
    move: Move  # (change, batch, options) -> batch, or (batch, valid)
    _: KW_ONLY
    sides: tuple[tuple[int, int], ...] = ()  # of matrices: what rows and columns may be
    decides: bool = False  # whether its number of dims distinguishes a batch from a sample
    in_pixels: bool = False  # whether it is warned of numbers that hardly are pixels of the image
    hint: Callable[[str, Tensor, bool], str] = _no_hint  # (name, value, batched) -> what to do about a wrong shape
    check: Callable[[Tensor, str, str], None] = _no_check  # (value, name, owner); raises if values are of no such kind
    way: Label | Callable[[Options, float], Sampler] | None = None
    """How the call of C for whole samples moves it, as `move` would: (options, mask_fill) -> sampler for images."""
    apart: bool = False  # whether it needs each pixel's position: that call then moves none of a sample's fields


def _by(method: Callable[..., Any], *forms: Callable[[Tensor], Tensor]) -> Move:
    """Return the move by a method of `Change`; forms: functions that read and write values of another form."""
    return lambda change, value, options: method(change, value, *forms)


def _planes(move: Move) -> Move:
    """Return a function like `move` that also takes values without channels, (B, H, W), such as masks."""

    def of(change: Change, value: Tensor, options: Mapping[str, float]) -> Tensor:
        moved: Tensor = move(change, value.unsqueeze(1) if value.ndim == 3 else value, options)
        return moved.squeeze(1) if value.ndim == 3 else moved

    return of


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


_PLACED = {"boxes_xywh": 0.0, "boxes_cxcywh": 0.5}  # boxes by place and sides: how far along them the place is


def as_corners(kind: str, boxes: Tensor) -> Tensor:
    """Return boxes (..., 4) of a kind as x1, y1, x2, y2."""
    if kind not in _PLACED:
        return boxes
    place, size = widen(boxes).split(2, -1)
    low = place - _PLACED[kind] * size
    return torch.cat((low, low + size), -1)


def _sided_boxes(kind: str, form: str) -> Field:
    """Return the field of boxes by place, width and height."""

    def write(corners: Tensor) -> Tensor:
        low, high = corners.split(2, -1)
        return torch.cat((low + _PLACED[kind] * (high - low), high - low), -1)

    def check_sides(value: Tensor, name: str, owner: str) -> None:
        _check_form(kind, value, name, owner)
        if not value.requires_grad and known_true((negative := (value[..., 2:] < 0).any(-1)).any()):
            raise ValueError(
                f"{owner}: {name} must be {shape}, with sides of 0 or more; got {value[negative][0].tolist()}. Boxes "
                "x1, y1, x2, y2 are of the kind 'boxes'"
            )

    shape, move = f"(B, M, 4) pixels {form}", _by(Change.boxes, functools.partial(as_corners, kind), write)
    return Field(2, 2, (4,), shape, move, decides=True, in_pixels=True, hint=_boxes_hint, check=check_sides)


def _image_hint(name: str, value: Tensor, batched: bool) -> str:
    if value.ndim == 5:
        return f"The frames of clips go in as a batch, by {name}.flatten(0, 1)"
    return f"A grey image goes in as {name}[None]" if value.ndim == 2 else ""


def _rows_hint(name: str, value: Tensor, batched: bool) -> str:
    """Return the hint for pixels or boxes without the dim of their number."""
    if value.ndim - batched != 1:
        return ""
    shared = f", those that all samples share as {name}.expand(B, -1, -1)" if batched else ""
    return f"A single one for each sample goes in as {name}[..., None, :]{shared}"


def _keypoints_hint(name: str, value: Tensor, batched: bool) -> str:
    if value.ndim and value.shape[-1] == 3:
        return f"Pass visibility, [..., 2], as {name}_valid=..., a flag for each"
    return _rows_hint(name, value, batched) if value.shape[-1:] == (2,) else ""


def _boxes_hint(name: str, value: Tensor, batched: bool) -> str:
    return _rows_hint(name, value, batched) if value.shape[-1:] == (4,) else ""


def _column_hint(name: str, value: Tensor, batched: bool) -> str:
    return f"OpenCV's column goes in as {name}[..., 0]" if value.shape[-2:] == (3, 1) else ""


def _landmarks_hint(name: str, value: Tensor, batched: bool) -> str:
    return _column_hint(name, value, batched) or (_rows_hint(name, value, batched) if value.shape[-1] in (2, 3) else "")


def _rays_hint(name: str, value: Tensor, batched: bool) -> str:
    if value.ndim and value.shape[-1] == 2:
        return f"Pitch and yaw in radians go in as pitch_yaw, or with fields={{{name!r}: 'pitch_yaw'}}"
    return _column_hint(name, value, batched)


def _pose_hint(name: str, value: Tensor, batched: bool) -> str:
    if value.shape[-1:] != (3,):
        return ""
    return (
        "Rotations R (..., 3, 3) go in as torch.nn.functional.pad(R, (0, 1)), with zeros for the place; "
        "R = ct.head_rotation(angles), of pitch, yaw and roll in radians. OpenCV's go in as rvec=..., tvec=..."
    )


def _check_form(kind: str, value: Tensor, name: str, owner: str) -> None:
    form = getattr(getattr(value, "format", None), "value", None)  # of torchvision's BoundingBoxes
    if form not in (None, "XYXY" if kind == "boxes" else kind.removeprefix("boxes_").upper()):
        raise ValueError(
            f"{owner}: {name} must be {KINDS[kind].shape}; got BoundingBoxes of the format {form}. Use "
            "camtorch.augment.torchvision.Transform for them"
        )


def _check_corners(value: Tensor, name: str, owner: str) -> None:
    _check_form("boxes", value, name, owner)
    check_boxes(value, name, owner)


def _check_pose(value: Tensor, name: str, owner: str) -> None:
    if not value.is_cpu or value.requires_grad:
        return
    rotations = value[..., :3, :3]
    if value.ndim == 2 and is_right(rotations):
        return
    wrong = ~are_rotations(rotations) & torch.isfinite(rotations).flatten(-2).all(-1)
    if known_false(~wrong):
        check_rotation(rotations[wrong][:1], name, owner)


def _check_pitch_yaw(value: Tensor, name: str, owner: str) -> None:
    if not value.is_cpu or value.requires_grad:
        return
    # with room for the rounding of half precision
    beyond = value.abs() > value.new_tensor([math.pi / 2, math.pi]) * 1.01
    if known_false(~beyond):
        pitch, yaw = value[beyond.any(-1)][0].tolist()
        raise ValueError(
            f"{owner}: {name} must be radians, pitch within pi / 2 and yaw within pi; got {pitch:.6g}, {yaw:.6g}. "
            "Degrees are converted by torch.deg2rad() or math.radians()"
        )


def from_pitch_yaw(angles: Tensor) -> Tensor:
    """Return unit gaze vectors (..., 3) of pitch and yaw (..., 2) in radians, as in MPIIGaze and ETH-XGaze.

    Zero looks into the camera, along -z. Source: Zhang et al., ETH-XGaze, 2020, and its code.

    Raises:
        ValueError: If the shape is wrong, or plain angles are more than a turn and so may be degrees.
    """
    angles = as_coordinates(angles, "angles", 2, "from_pitch_yaw")
    check_angles(angles, "from_pitch_yaw")
    pitch, yaw = angles.unbind(-1)
    return torch.stack((-pitch.cos() * yaw.sin(), -pitch.sin(), -pitch.cos() * yaw.cos()), -1)


def to_pitch_yaw(gaze: Tensor) -> Tensor:
    """Return pitch and yaw (..., 2) in radians of gaze vectors (..., 3): pitch = asin(-y), yaw = atan2(-x, -z)."""
    x, y, z = as_coordinates(gaze, "gaze", 3, "to_pitch_yaw").unbind(-1)
    return torch.stack((torch.atan2(-y, torch.hypot(x, z)), torch.atan2(-x, -z)), -1)


def _image_sampler(options: Options, mask_fill: float) -> Sampler:
    return Sampler(options["mode"], options["padding_mode"], options["fill"])


def _mask_sampler(options: Options, mask_fill: float) -> Sampler:
    return Sampler("nearest", "zeros", (mask_fill,))


_MOST_DIMS = 16
_points, _boxes, _positions, _rays = _by(Change.points), _by(Change.boxes), _by(Change.positions), _by(Change.rays)
_pitch_yaw, _rotation = _by(Change.rays, from_pitch_yaw, to_pitch_yaw), _by(Change.rays, _columns, _columns)
_labels = _planes(lambda change, masks, options: change.labels(masks, options["mask_fill"]))
_DIRECTIONS = Field(
    1, _MOST_DIMS, (3,), "(B, *N, 3) directions of the camera frame", _rays, hint=_rays_hint, way="rays"
)
_DEPTHS = "(B, 1, H, W) or (B, H, W), along"
_KEYPOINTS = "(B, N, 2) or (B, F, N, 2) pixels x, y"
_LANDMARKS = "(B, N, 2) pixels or (B, N, 3) points of the camera frame"
_BOXES = "(B, M, 4) pixels x1, y1, x2, y2"
_POSES = "(B, 4, 4) or (B, 3, 4), camera from head"
_RVEC = "(B, 3), a rotation vector, camera from head"
_TVEC = "(B, 3), a point of the camera frame"
_GAZE = "(B, *N, 2) pitch and yaw of a gaze in radians"
_POSE = Field(
    2, 2, (4,), _POSES, _pose, sides=((4, 4), (3, 4)), decides=True, hint=_pose_hint, check=_check_pose, way="pose"
)
KINDS = {
    "image": Field(3, 3, (), "(B, C, H, W)", _by(Change.images), decides=True, hint=_image_hint, way=_image_sampler),
    "mask": Field(2, 3, (), "(B, C, H, W) or (B, H, W)", _labels, way=_mask_sampler),
    "depth": Field(2, 3, (), f"{_DEPTHS} z", _planes(_by(Change.depth)), apart=True),
    "distance": Field(2, 3, (), f"{_DEPTHS} the ray", _planes(_by(Change.distance)), apart=True),
    "keypoints": Field(
        2, 3, (2,), _KEYPOINTS, _points, decides=True, in_pixels=True, hint=_keypoints_hint, way="pixels"
    ),
    "polygons": Field(3, 3, (2,), "(B, M, K, 2) corners x, y", _points, decides=True, way="pixels"),
    "boxes": Field(
        2, 2, (4,), _BOXES, _boxes, decides=True, in_pixels=True, hint=_boxes_hint, check=_check_corners, way="boxes"
    ),
    "boxes_xywh": _sided_boxes("boxes_xywh", "x, y, width, height"),
    "boxes_cxcywh": _sided_boxes("boxes_cxcywh", "x and y of the centre, width, height"),
    "landmarks": Field(2, 3, (2, 3), _LANDMARKS, _points, decides=True, in_pixels=True, hint=_landmarks_hint),
    "points": Field(
        1, _MOST_DIMS, (3,), "(B, *N, 3) points of the camera frame", _positions, hint=_column_hint, way="rays"
    ),
    "gaze": _DIRECTIONS,
    "directions": _DIRECTIONS,
    "pitch_yaw": Field(1, _MOST_DIMS, (2,), _GAZE, _pitch_yaw, check=_check_pitch_yaw),
    "head_pose": _POSE,
    "pose": _POSE,
    "rvec": Field(
        1, 1, (3,), _RVEC, _rvec, decides=True, hint=_column_hint, check=check_radians, way="rotation vectors"
    ),
    "tvec": Field(1, 1, (3,), _TVEC, _positions, decides=True, hint=_column_hint, way="rays"),
    "rotation": Field(2, 2, (3,), "(B, 3, 3), turned so far", _rotation, hint=_column_hint, way="columns"),
    "K": Field(2, 2, (3, 4), SHAPE, moved_matrix, sides=SIDES, decides=True, hint=matrix_hint, check=check_matrix),
}
BOXES = "boxes", *_PLACED
ALIASES = {"images": "image", "masks": "mask", "bboxes": "boxes", "point": "points", "face_center": "points"}
ALIASES |= {name: "K" for name in NAMES if name != "K"}
PLACE = "crop_place"
"""The place of a sample's crop, which follows its camera and rotation through all augmentations."""
OWN = ("camera", "source_camera", "source_rotation", "scale")  # these come with a change and do not move


_PLACES = {
    "roi": "boxes",
    **dict.fromkeys(("eye", "pupil", "nose", "mouth", "corner", "center", "centre"), "keypoints"),
}
_ANGLES = {"yaw", "pitch", "roll"}
_OFF = 0.1  # of the image's sides: keypoints so far outside of it are not of it
_RANKS = {kind: (not field.decides, i) for i, (kind, field) in enumerate(KINDS.items())}


def kind_of(name: str, value: object, own: Mapping[str, str], owner: str, single: bool = False) -> str | None:
    """Return a field's key in `KINDS`, None if it is not moved; raise if it may be geometry of unknown name.

    In this order: the name among the option `fields`; names that end with _valid do not move; a kind's name or an
    alias; a pattern with * among `fields`; the longest kind that begins the name; the forms of boxes that end it.
    """
    if not isinstance(name, str):
        raise TypeError(f"{owner}: a sample must have strings for names; got {name!r:.80}")
    if name in own:
        return None if own[name] == KEEP else own[name]
    if name.endswith("_valid"):
        return None
    base = name if name in KINDS else ALIASES.get(name)
    if base is None and (pattern := pattern_of(name, own)) is not None:
        return None if own[pattern] == KEEP else own[pattern]
    if base == "K":  # a number of things, or the path of a file, may be named so
        array = isinstance(value, (Tensor, np.ndarray)) and value.ndim > 1
        return base if array or _may_be_geometry(name, value, single) else None
    # image_path and mask_id, of a sample or a batch, are no images or masks
    if base is None and isinstance(value, (Tensor, np.ndarray, list, tuple)) and not is_text(value):
        # K_inv is no K; compilers do not know max with a key
        begins = sorted((k for k in KINDS if name.startswith(k + "_") and k != "K"), key=len)
        base = begins[-1] if begins else None
    if base == "boxes" and (form := f"boxes_{name.rpartition('_')[2]}") in _PLACED:  # as boxes_face_xywh
        base = form
    if base is None and _may_be_geometry(name, value, single):
        if isinstance(value, Mapping):
            raise ValueError(
                f"{owner}: fields that move must be at the top of samples; got real numbers in the dict {name!r}. "
                f"Put them there, or keep the dict with fields={{{name!r}: '{KEEP}'}}"
            )
        close = _close_to(name)
        meant = f"Did you mean {close[0]!r}? " if close else ""
        if _is_angle(name):
            meant = "A head's angles go in as head_pose, by ct.head_rotation(), a gaze's as pitch_yaw. "
        if not {"K", "intrinsics", "matrix"}.isdisjoint(name.split("_")):
            meant = "A camera goes in as camera=, as ct.BrownConrady.from_matrix(K, D, image_size=(height, width)). "
        raise ValueError(
            f"{owner}: {name!r} must have a kind, by which its numbers move with the camera; got real numbers. {meant}"
            f"Pass fields={{{name!r}: KIND}}, with KIND one of {', '.join(KINDS)} or {KEEP}, to leave it unchanged"
        )
    return base


def pattern_of(name: str, own: Mapping[str, str]) -> str | None:
    """Return the first pattern in `own`, with a * for any characters, that a name matches."""
    for key in own:
        head, star, tail = key.partition("*")
        if star and len(name) >= len(head + tail) and name.startswith(head) and name.endswith(tail):
            return key
    return None


def is_text(value: Any) -> bool:
    """Whether a value holds strings, at least one, and nothing else, in lists of any depth."""
    texts = pytree.tree_leaves(value.tolist() if isinstance(value, np.ndarray) and value.dtype.kind in "OSU" else value)
    return len(texts) > 0 and all(isinstance(text, (str, bytes)) for text in texts)


@functools.lru_cache(64)
def _close_to(name: str) -> list[str]:
    """Return the kind that a name may mean: of the whole, or of its last word, as in `face_bbox` and `left_eye`."""
    last = name.rpartition("_")[2].removesuffix("s")
    if name.startswith("seg") or "box" in last or last in _PLACES:
        return ["mask" if name.startswith("seg") else "boxes" if "box" in last else _PLACES[last]]
    return difflib.get_close_matches(name, KINDS, 1) or difflib.get_close_matches(last, KINDS, 1)


def _may_be_geometry(name: str, value: Any, single: bool, above: int = 0) -> bool:
    """Whether a value holds real numbers, or integers with more than a row per sample or with a name like a kind's.

    above: the number of lists around the value, which count as dims. A single number is geometry if its name is an
    angle's, as in `head_yaw`.
    """
    if isinstance(value, Mapping):
        return any(_may_be_geometry(str(key), item, single) for key, item in value.items())
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return any(_may_be_geometry(name, item, single, above + 1) for item in value)
    if isinstance(value, (np.ndarray, np.generic)):
        whole, known = value.dtype.kind in "iub", value.dtype.kind in "iubfcV"
    elif isinstance(value, Tensor):
        whole, known = not (value.is_floating_point() or value.is_complex()), True
    else:
        whole, known = not isinstance(value, float), isinstance(value, (int, float))
    dims, row = above + getattr(value, "ndim", 0), 1 if single else 2
    known_as = (dims == row and _close_to(name)) or (not whole and _is_angle(name))
    return known and (dims > (row if whole else 0) or bool(known_as))


def _is_angle(name: str) -> bool:
    return not _ANGLES.isdisjoint(name.lower().split("_"))


def field_of(kind: str, value: Tensor) -> Field:
    """Return the field of values of a kind: `landmarks` are keypoints or points, by their last dim."""
    if kind != "landmarks":
        return KINDS[kind]
    return KINDS["points" if value.shape[-1] == 3 else "keypoints"]


def as_tensor(value: object, name: str, kind: str, owner: str) -> Tensor:
    """Return the value of a field as a tensor of real numbers."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        value = arrays.as_tensor(value, name, owner)
    if not isinstance(value, Tensor) or value.dtype.is_complex:
        what = f"dtype {value.dtype}" if isinstance(value, (Tensor, np.ndarray)) else type(value).__name__
        hint = _hint(name)
        if isinstance(value, (list, tuple, int, float)):
            hint = ". Plain numbers go in as torch.tensor(numbers); a list has a tensor for each sample"
        elif kind == "image" and hasattr(value, "mode"):
            hint = f". {FRONT_ENDS}"
        raise TypeError(f"{owner}: {name} must be a tensor of real numbers, {KINDS[kind].shape}; got {what}{hint}")
    if kind not in IMAGES and not value.dtype.is_floating_point:
        value = value.to(torch.get_default_dtype())  # whole pixels do not stay whole
    return value


def _hint(name: str) -> str:
    return "" if name in KINDS else f". If it is something else, fields={{{name!r}: '{KEEP}'}} keeps it unchanged"


def check_shape(kind: str, name: str, value: Tensor, batched: bool, owner: str) -> None:
    """Raise a ValueError if a kind does not take this shape."""
    field, shape = KINDS[kind], tuple(value.shape)
    fits = field.dims <= len(shape) - batched <= field.most_dims and (not field.last or shape[-1] in field.last)
    if not fits or (field.sides and shape[-2:] not in field.sides):
        what = field.shape if batched else field.shape.replace("(B, ", "(")
        hint = f". {hint}" if (hint := field.hint(name, value, batched)) else _hint(name)
        raise ValueError(f"{owner}: {name} must be {what}; got shape {shape}{hint}")


def warn_of_numbers(kind: str, name: str, value: Tensor, flags: Any, size: Sequence[int], owner: str) -> None:
    """Warn of labels that seem to be parts of an image's sides, of an image of another size, or to mean "not seen"."""
    if not KINDS[kind].in_pixels or not value.is_cpu:
        return
    are_points = value.shape[-1] == 2
    pixels = value[..., :2] if value.shape[-1] == 3 else value
    if are_points and _are_off(value, flags, size):
        warn(
            f"{owner}: {name} must be pixels of the image, of (height, width) = {tuple(size)}; got most of them far "
            "outside of it, as of an image of another size. Scale x by (x + 0.5) * width / old width - 0.5, and so y. "
            f"For points that are not seen pass NaN, or {name}_valid=..., a flag for each"
        )
    if are_points and flags is None and known_true((pixels == -1).all(-1).any()):
        warn(
            f"{owner}: {name} has points at (-1, -1), which move as any pixels. If these are not seen, pass NaN, or "
            f"{name}_valid=..., a flag for each"
        )
    if value.numel() <= 3 or not known_true((pixels == pixels.clamp(0, 1)).all() & (pixels % 1 != 0).any()):
        return
    if value.shape[-1] != 3:
        form = "pixels" if are_points else KINDS[kind].shape.partition(") ")[2]
        places = " from x and y" if kind in _PLACED else ""
        warn(
            f"{owner}: {name} must be {form}; got values within [0, 1], as parts of an image's sides. Multiply them by "
            f"width and height, and subtract 0.5{places}"
        )
    elif known_true((value[..., 2] <= 0).any()):
        warn(
            f"{owner}: {name} must be points of the camera frame, in front of it; got x and y within [0, 1] and z of 0 "
            f"or less, as a detector's. Pass pixels, {name}[..., :2] times width and height, less 0.5"
        )


def _are_off(points: Tensor, flags: Any, size: Sequence[int]) -> bool:
    """Whether most points (..., 2), of those that are seen, are off the image by more than a tenth of its sides."""
    if not points.numel() or not may_look(points):
        return False
    places, sides = points.detach().reshape(-1, 2), (size[1], size[0])
    ends = zip(places.amin(0).tolist(), places.amax(0).tolist(), sides, strict=True)
    if all(-_OFF * side < low and high < (1 + _OFF) * side - 1 for low, high, side in ends):  # as in most samples
        return False
    seen = torch.isfinite(places).all(-1)
    if flags is not None and (given := torch.as_tensor(flags)).numel() == len(seen):
        seen = seen & (given.reshape(-1) != 0)
    off = ((places + 0.5) / places.new_tensor(sides) - 0.5).abs().amax(-1) > 0.5 + _OFF
    return int((off & seen).sum()) > int(seen.sum()) / 2


def is_batch(named: Named, camera: object) -> bool:
    """Whether `named` is a batch, by its first image, pixels, boxes or pose, else by cameras, else any field."""
    if isinstance(camera, (list, tuple)):
        return True
    for kind, value in sorted(named.values(), key=lambda pair: _RANKS[pair[0]]):
        if isinstance(value, (list, tuple)):
            return True
        if KINDS[kind].decides:
            return bool(value.ndim > KINDS[kind].dims)
    if isinstance(camera, Camera) and camera.batch_shape:
        return True
    return any(value.ndim > KINDS[kind].dims for kind, value in named.values())


def in_range(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Return values in a dtype, which may be narrower: finite values stay finite."""
    if dtype == torch.float16 != values.dtype:
        most = torch.finfo(dtype).max
        values = values.clamp(-most, most)
    return values.to(dtype)
