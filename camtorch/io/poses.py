"""Conversion of poses in files, matrices or quaternions, to `Extrinsics` in float64 and back."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.cameras.rig import Rig
from camtorch.io.record import Record
from camtorch.io.writing import Lossy
from camtorch.poses.extrinsics import Extrinsics
from camtorch.poses.rotations import quaternion_vector, rotation_error, rotation_vector, vector_quaternion

Place = Record | Callable[[int], Record]  # place of a pose in a file; for a batch a function of the row

_ORTHOGONAL = 1e-3  # as Extrinsics.from_matrix
_FARTHEST = 1e100
UPRIGHT = np.array([1.0, -1.0, -1.0, 1.0])  # scales columns of world from camera: for cameras that look along -z, y up


def as_float64(values: Any) -> Tensor:
    """Return numbers of a file as a tensor."""
    return torch.as_tensor(values, dtype=torch.float64)


def _check(place: Place, right: Tensor, reason: Callable[[int], str]) -> None:
    """Refuse the first pose of a batch (*B,) that is not right."""
    if not bool(right.all()):
        row = int((~right).flatten().int().argmax())
        (place if isinstance(place, Record) else place(row)).fail(reason(row))


def check_near(place: Place, values: Any) -> None:
    """Refuse values (*B, n) with numbers too large to compute with."""
    right = (as_float64(values).abs() <= _FARTHEST).all(-1)
    _check(place, right, lambda row: f"numbers must be up to {_FARTHEST:g}; got a larger one, or NaN")


# -- reading: single poses, or a batch; with `undo` the inverse pose. All raise CameraFileError


@torch.no_grad()
def pose(place: Place, rotation: Any, translation: Any, undo: bool = False) -> Extrinsics:
    """Return the pose of rotation vectors and translations (*B, 3)."""
    for values in (rotation, translation):
        check_near(place, values)
    try:
        there = Extrinsics(as_float64(rotation)[..., None], as_float64(translation))
    except ValueError as error:
        return (place if isinstance(place, Record) else place(0)).fail(error)
    return there.inverse() if undo else there


def from_matrices(place: Place, rows: Any, undo: bool = False) -> Extrinsics:
    """Return the pose of matrices (*B, 4, 4) or (*B, 3, 4)."""
    rotations, translations = as_float64(rows)[..., :3, :3], as_float64(rows)[..., :3, 3]
    error, det = rotation_error(rotations).flatten(), torch.linalg.det(rotations).flatten()
    right = (error < _ORTHOGONAL) & (det > 0)
    why = "must be a rotation; got R R^T that misses the identity by {:.2g}, and det R = {:.6g}"
    _check(place, right, lambda row: why.format(error[row], det[row]))
    return pose(place, rotation_vector(rotations), translations, undo)


def matrix_rows(record: Record) -> list[list[float]]:
    """Return a 4 x 4 or 3 x 4 matrix of a pose as 4 x 4."""
    if len(record) not in (3, 4):
        record.fail(f"must have 3 rows; got {len(record)}")
    rows = [row.numbers(4) for row in record]
    if rows[3:] and max(abs(a - b) for a, b in zip(rows[3], (0, 0, 0, 1), strict=True)) > 1e-5:
        record.fail(f"the last row must be 0 0 0 1; got {rows[3]}")
    return [*rows[:3], [0.0, 0.0, 0.0, 1.0]]


def from_quaternions(place: Place, values: Any, undo: bool = False) -> Extrinsics:
    """Return the pose of (*B, 7): unit quaternions w, x, y, z and translations."""
    quaternions, translations = as_float64(values).tensor_split([4], -1)
    norm = quaternions.norm(dim=-1).flatten()
    right = (norm - 1).abs() < _ORTHOGONAL
    _check(place, right, lambda row: f"a quaternion must have length 1; got {norm[row]:.6g}")
    return pose(place, quaternion_vector(quaternions), translations, undo)


def _in_float64(extrinsics: Extrinsics, undo: bool) -> Extrinsics:
    rotation, translation = (t.detach().double().cpu() for t in (extrinsics.rotation, extrinsics.translation))
    copy = Extrinsics(rotation[..., None], translation)
    return copy.inverse() if undo else copy


@torch.no_grad()
def matrices(extrinsics: Extrinsics, undo: bool = False) -> Tensor:
    """Return the (*B, 4, 4) matrices of a pose, or of its inverse, in float64."""
    return _in_float64(extrinsics, undo).matrix() + 0.0  # turns -0.0 into zero


@torch.no_grad()
def quaternions(extrinsics: Extrinsics, undo: bool = False) -> Tensor:
    """Return quaternions w, x, y, z and translations (*B, 7) of a pose, or of its inverse."""
    there = _in_float64(extrinsics, undo)
    return torch.cat((vector_quaternion(there.rotation), there.translation), -1) + 0.0


def is_identity(extrinsics: Extrinsics) -> bool:
    """Whether the pose is exactly the identity."""
    return not bool(extrinsics.rotation.any() or extrinsics.translation.any())


def all_of(rig: Rig, lossy: Lossy) -> Extrinsics:
    """Return all poses of a rig as one batch in float64, in the order of their names; batches are refused."""
    batch, rows, values = rig.extrinsics.batch, list[list[float]](), []
    if batch is not None:  # faster than one by one for many images
        vectors = [t.detach().double().cpu().expand(len(batch), 3) for t in (batch.rotation, batch.translation)]
        rows = torch.cat(vectors, -1).tolist()
    for name in rig.extrinsics:
        row = rig.extrinsics.row(name)
        if row is None or not all(map(math.isfinite, rows[row])):
            values.append([number for vector in lossy.pose(name, rig.extrinsics[name]) for number in vector])
        else:
            values.append(rows[row])
    rotations, translations = as_float64(values).reshape(-1, 6).tensor_split(2, -1)
    return Extrinsics(rotations[..., None], translations)
