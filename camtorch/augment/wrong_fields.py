"""What is said of fields that are wrong: hints about their shapes, and checks of their values."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from camtorch.evaluate.tensors import known_some, known_true
from camtorch.poses.rotations import are_rotations, check_rotation, is_right
from camtorch.values.arguments import check_boxes

CORNERS = "(B, M, 4) pixels x1, y1, x2, y2"


def image_hint(value: Tensor, name: str, batched: bool) -> str:
    """Return the hint for images."""
    if value.ndim == 5:
        return f"The frames of clips go in as a batch, by {name}.flatten(0, 1)"
    return f"A grey image goes in as {name}[None]" if value.ndim == 2 else ""


def _rows_hint(value: Tensor, name: str, batched: bool) -> str:
    """Return the hint for pixels or boxes without the dim of their number."""
    if value.ndim - batched != 1:
        return ""
    shared = f", those that all samples share as {name}.expand(B, -1, -1)" if batched else ""
    return f"A single one for each sample goes in as {name}[..., None, :]{shared}"


def keypoints_hint(value: Tensor, name: str, batched: bool) -> str:
    """Return the hint for pixels."""
    if value.ndim and value.shape[-1] == 3:
        return f"Pass visibility, [..., 2], as {name}_valid=..., a flag for each"
    return _rows_hint(value, name, batched) if value.shape[-1:] == (2,) else ""


def boxes_hint(value: Tensor, name: str, batched: bool) -> str:
    """Return the hint for boxes of any form."""
    return _rows_hint(value, name, batched) if value.shape[-1:] == (4,) else ""


def column_hint(value: Tensor, name: str, batched: bool) -> str:
    """Return the hint for vectors of three numbers."""
    return f"OpenCV's column goes in as {name}[..., 0]" if value.shape[-2:] == (3, 1) else ""


def landmarks_hint(value: Tensor, name: str, batched: bool) -> str:
    """Return the hint for pixels or points."""
    return column_hint(value, name, batched) or (_rows_hint(value, name, batched) if value.shape[-1] in (2, 3) else "")


def rays_hint(value: Tensor, name: str, batched: bool) -> str:
    """Return the hint for directions."""
    if value.ndim and value.shape[-1] == 2:
        return f"Pitch and yaw in radians go in as pitch_yaw, or with fields={{{name!r}: 'pitch_yaw'}}"
    return column_hint(value, name, batched)


def pose_hint(value: Tensor, name: str, batched: bool) -> str:
    """Return the hint for poses."""
    if value.shape[-1:] != (3,):
        return ""
    return (
        "Rotations R (..., 3, 3) go in as torch.nn.functional.pad(R, (0, 1)), with zeros for the place; "
        "R = ct.head_rotation(angles), of pitch, yaw and roll in radians. OpenCV's go in as rvec=..., tvec=..."
    )


def _check_form(value: Tensor, form: str, shape: str, name: str, owner: str) -> None:
    """Raise a ValueError if torchvision's BoundingBoxes are not of the form that boxes of this shape have."""
    given = getattr(getattr(value, "format", None), "value", None)
    if given not in (None, form):
        raise ValueError(
            f"{owner}: {name} must be {shape}; got BoundingBoxes of the format {given}. Use "
            "camtorch.augment.torchvision.Transform for them"
        )


def check_corners(value: Tensor, name: str, owner: str) -> None:
    """Raise a ValueError if boxes are not x1, y1, x2, y2."""
    _check_form(value, "XYXY", CORNERS, name, owner)
    check_boxes(value, name, owner)


def sides_check(form: str, shape: str) -> Callable[[Tensor, str, str], None]:
    """Return the check of boxes by a point, width and height, whose form and shape these are."""

    def check(value: Tensor, name: str, owner: str) -> None:
        _check_form(value, form, shape, name, owner)
        if value.requires_grad:
            return
        negative = (value[..., 2:] < 0).any(-1)
        if known_true(negative.any()):
            raise ValueError(
                f"{owner}: {name} must be {shape}, with sides of 0 or more; got {value[negative][0].tolist()}. Boxes "
                "x1, y1, x2, y2 are of the kind 'boxes'"
            )

    return check


def check_pose(value: Tensor, name: str, owner: str) -> None:
    """Raise a ValueError if poses do not begin with a rotation."""
    if not value.is_cpu or value.requires_grad:
        return
    if value.shape[-2] == 4 and known_some(value[..., 3, :3].abs() > 0):  # a pose of NaN is missing
        rows = value[..., 3, :].reshape(-1, 4)
        raise ValueError(
            f"{owner}: {name} must have the place in the last column, above a row 0, 0, 0, 1; got the last row "
            f"{rows[(rows[:, :3].abs() > 0).any(-1)][0].tolist()}. A matrix for row vectors goes in as {name}.mT"
        )
    rotations = value[..., :3, :3]
    if value.ndim == 2 and is_right(rotations):
        return
    wrong = ~are_rotations(rotations) & torch.isfinite(rotations).flatten(-2).all(-1)
    if known_some(wrong):
        check_rotation(rotations[wrong][:1], name, owner)


def check_pitch_yaw(value: Tensor, name: str, owner: str) -> None:
    """Raise a ValueError if pitch is beyond a quarter of a turn, or yaw beyond half of one, as degrees mostly are."""
    if not value.is_cpu or value.requires_grad:
        return
    # with room for the rounding of half precision
    beyond = value.abs() > value.new_tensor([math.pi / 2, math.pi]) * 1.01
    if known_some(beyond):
        pitch, yaw = value[beyond.any(-1)][0].tolist()
        raise ValueError(
            f"{owner}: {name} must be radians, pitch within pi / 2 and yaw within pi; got {pitch:.6g}, {yaw:.6g}. "
            "Degrees are converted by torch.deg2rad() or math.radians()"
        )
