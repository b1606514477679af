"""Rotations as files write them, to rotation vectors and back; and poses that come back as they were written."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from camtorch.extrinsics import Extrinsics
from camtorch.io.record import Record
from camtorch.io.writing import Lossy
from camtorch.rig import Rig

Vector = Sequence[float]
Matrix = Sequence[Sequence[float]]

_ORTHOGONAL = 1e-3  # as Extrinsics.from_matrix
_FARTHEST = 1e100


def pose(record: Record, rotation: Vector, translation: Vector) -> Extrinsics:
    """Extrinsics in float64.

    Raises:
        CameraFileError: numbers too large to compute with, a rotation in degrees.
    """
    check_near(record, (*rotation, *translation))
    try:
        return Extrinsics(*(torch.tensor(list(v), dtype=torch.float64) for v in (rotation, translation)))
    except ValueError as error:
        return record.fail(error)


def check_near(record: Record, values: Vector) -> None:
    """Refuse numbers too large to compute with."""
    if any(abs(value) > _FARTHEST for value in values):
        record.fail(f"a number beyond {_FARTHEST:g}")


def keep(extrinsics: Extrinsics, kind: str, values: Any, *others: Extrinsics) -> Extrinsics:
    """Remember how a file wrote the pose, so that unless it changes it is written again to the last bit.

    Args:
        extrinsics: the pose.
        kind: what the values mean, a word for `written`.
        values: what stood in the file.
        others: the poses that the values depend on as well.
    """
    vars(extrinsics)[_KEPT] = kind, values, [numbers(e) for e in (extrinsics, *others)]
    return extrinsics


_KEPT, _KEPT_ROWS = "_as_written", "_rows_as_written"


def written(extrinsics: Extrinsics, kind: str, *others: Extrinsics) -> Any:
    """What a file said of this pose, or None: it did not, or since then the pose has changed."""
    was_kind, values, poses = vars(extrinsics).get(_KEPT, (None, None, None))
    return values if was_kind == kind and poses == [numbers(e) for e in (extrinsics, *others)] else None


def numbers(extrinsics: Extrinsics) -> tuple[list[float], list[float]]:
    """Rotation vector and translation."""
    return extrinsics.rotation.detach().double().tolist(), extrinsics.translation.detach().double().tolist()


def is_identity(extrinsics: Extrinsics | None) -> bool:
    """Whether the pose does nothing, to the last bit."""
    return extrinsics is None or not any(v for vector in numbers(extrinsics) for v in vector)


# -- the poses of many images, which are the rows of a batch


def from_quaternions(record: Callable[[int], Record], values: np.ndarray) -> Extrinsics:
    """A batch of finite (N, 7), quaternions w, x, y, z and translations; `record` gives the place of a row."""
    w, xyz, translation = values[:, 0], values[:, 1:4], values[:, 4:]
    with np.errstate(over="ignore"):
        norm = np.sqrt((values[:, :4] ** 2).sum(1))
    if (wrong := ~(np.abs(norm - 1) < _ORTHOGONAL)).any():
        row = int(wrong.argmax())
        record(row).fail(f"a quaternion of length {norm[row]:.6g}, which is no rotation")
    if (wrong := (np.abs(translation) > _FARTHEST).any(1)).any():
        record(int(wrong.argmax())).fail(f"a number beyond {_FARTHEST:g}")
    largest = np.abs(xyz).max(1).clip(np.finfo(float).tiny)
    sine = largest * np.sqrt(((xyz / largest[:, None]) ** 2).sum(1))
    with np.errstate(divide="ignore", invalid="ignore"):
        # near the identity 2 atan2(s, w) / s -> 2 / w
        scale = np.where(sine > 1e-150, 2 * np.arctan2(sine, np.abs(w)) / sine, 2 / np.abs(w))
    rotation = xyz * np.copysign(scale, w)[:, None]
    return batch(rotation, translation, "quaternion", values)


def batch(rotation: np.ndarray, translation: np.ndarray, kind: str, values: np.ndarray) -> Extrinsics:
    """The batch of (N, 3) rotation vectors and translations, with what a file wrote of each, for `written_rows`."""
    poses = Extrinsics(*(torch.tensor(v, dtype=torch.float64)[..., None] for v in (rotation, translation)))
    vars(poses)[_KEPT_ROWS] = kind, values, _both(poses)
    return poses


def written_rows(rig: Rig, kind: str) -> dict[str, Any]:
    """What a file said of the images that are rows of the rig's batch of poses, where they have not changed since."""
    poses = rig.extrinsics.batch
    if poses is None or _KEPT_ROWS not in vars(poses):
        return {}
    was_kind, values, then = vars(poses)[_KEPT_ROWS]
    if was_kind != kind or len(values) != len(poses):
        return {}
    rows, same = values.tolist(), (_both(poses) == then).all(1)
    places = ((name, rig.extrinsics.row(name)) for name in rig.extrinsics)
    return {name: rows[row] for name, row in places if row is not None and same[row]}


def _both(poses: Extrinsics) -> np.ndarray:
    vectors = (t.detach().double().cpu().expand(len(poses), 3) for t in (poses.rotation, poses.translation))
    return torch.cat(list(vectors), 1).numpy()


def quaternions(rig: Rig, lossy: Lossy) -> dict[str, list[float]]:
    """The quaternion w, x, y, z and translation, seven numbers, of each pose of a rig; those of a file as it had them.

    Raises:
        CameraFileError: batches, or numbers that are not finite.
    """
    found, kept = {}, written_rows(rig, "quaternion")
    for name in rig.extrinsics:
        values = kept.get(name)
        if values is None:
            lossy.pose(name, rig.extrinsics[name])
            quaternion, translation = to_quaternion(rig.extrinsics[name])
            values = [*quaternion, *translation]
        found[name] = values
    return found


# -- quaternions, as w, x, y, z


def vector_of_quaternion(record: Record, quaternion: Vector) -> list[float]:
    """The rotation vector, of at most pi, of a quaternion; of one that is not unit length, its direction's."""
    w, *xyz = quaternion
    norm = math.hypot(w, *xyz)
    if not abs(norm - 1) < _ORTHOGONAL:
        record.fail(f"a quaternion of length {norm:.6g}, which is no rotation")
    return _vector_of_quaternion(w, xyz)


def _vector_of_quaternion(w: float, xyz: Vector) -> list[float]:
    if w < 0:
        w, xyz = -w, [-v for v in xyz]
    sine = math.hypot(*xyz)
    # near the identity 2 atan2(s, w) / s -> 2 / w
    scale = 2 * math.atan2(sine, w) / sine if sine > 1e-150 else 2 / w
    return [scale * v for v in xyz]


def quaternion_of_vector(vector: Vector) -> list[float]:
    """The unit quaternion w, x, y, z of a rotation vector."""
    angle = math.hypot(*vector)
    scale = math.sin(angle / 2) / angle if angle > 1e-150 else 0.5
    return [math.cos(angle / 2), *(scale * v for v in vector)]


# -- matrices


def vector_of_matrix(record: Record, matrix: Matrix) -> list[float]:
    """The rotation vector of a rotation matrix, to the precision that files store it with."""
    a, b, c = matrix
    if any(abs(value) > 2 for row in matrix for value in row):
        record.fail(f"no rotation, whose numbers are within 1: {max((v for row in matrix for v in row), key=abs):.6g}")
    error = max(
        abs(math.fsum(x * y for x, y in zip(p, q, strict=True)) - (p is q)) for p in (a, b, c) for q in (a, b, c)
    )
    determinant = (
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    if not (error < _ORTHOGONAL and determinant > 0):
        record.fail(f"no rotation: R R^T misses the identity by {error:.2g}, and det R = {determinant:.6g}")
    # Shepperd: divide by the largest of the four
    trace = a[0] + b[1] + c[2]
    candidates = (
        (trace, (1 + trace, c[1] - b[2], a[2] - c[0], b[0] - a[1])),
        (a[0], (c[1] - b[2], 1 + 2 * a[0] - trace, a[1] + b[0], c[0] + a[2])),
        (b[1], (a[2] - c[0], a[1] + b[0], 1 + 2 * b[1] - trace, b[2] + c[1])),
        (c[2], (b[0] - a[1], c[0] + a[2], b[2] + c[1], 1 + 2 * c[2] - trace)),
    )
    _, (w, *xyz) = max(candidates, key=lambda candidate: candidate[0])
    return _vector_of_quaternion(w, xyz)


def matrix_of_vector(vector: Vector) -> list[list[float]]:
    """The rotation matrix of a rotation vector."""
    x, y, z = vector
    angle = math.hypot(x, y, z)
    if angle > 1e-150:
        s, half = math.sin(angle) / angle, math.sin(angle / 2) / angle
        c = 2 * half * half
    else:
        s, c = 1.0, 0.5
    return [
        [1 - c * (y * y + z * z), c * x * y - s * z, c * z * x + s * y],
        [c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x],
        [c * z * x - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)],
    ]


def turn(matrix: Matrix, vector: Vector) -> list[float]:
    """The product of a matrix and a vector."""
    return [math.fsum(a * b for a, b in zip(row, vector, strict=True)) for row in matrix]


def transposed(matrix: Matrix) -> list[list[float]]:
    """Rows to columns."""
    return [list(column) for column in zip(*matrix, strict=True)]


def inverse(rotation: Vector, translation: Vector) -> tuple[list[float], list[float]]:
    """The pose that undoes this one."""
    back = turn(transposed(matrix_of_vector(rotation)), translation)
    return [0.0 - v for v in rotation], [0.0 - v for v in back]


def compose(second: Extrinsics, first: Extrinsics) -> tuple[list[list[float]], list[float]]:
    """Rotation matrix and translation of the one after the other."""
    (r2, t2), (r1, t1) = numbers(second), numbers(first)
    matrix, columns = matrix_of_vector(r2), transposed(matrix_of_vector(r1))
    moved = turn(matrix, t1)
    return transposed([turn(matrix, column) for column in columns]), [a + b for a, b in zip(moved, t2, strict=True)]


# -- as records


def rows_of(record: Record) -> list[list[float]]:
    """A 4 x 4 or 3 x 4 matrix of a pose as 4 x 4."""
    rows = record.rows(4 if len(record) == 4 else 3, 4)
    if rows[3:] and rows[3] != [0, 0, 0, 1]:
        record.fail(f"the last row is not 0 0 0 1, but {rows[3]}")
    return [*rows[:3], [0.0, 0.0, 0.0, 1.0]]


def from_rows(record: Record, undo: bool = False) -> Extrinsics:
    """A 4 x 4 or 3 x 4 matrix as a pose, or as the pose that undoes it."""
    rows = rows_of(record)
    rotation, translation = vector_of_matrix(record, [row[:3] for row in rows[:3]]), [row[3] for row in rows[:3]]
    if undo:
        pose(record, rotation, translation)
        back = turn(transposed([row[:3] for row in rows[:3]]), translation)
        rotation, translation = [0.0 - v for v in rotation], [0.0 - v for v in back]
    return keep(pose(record, rotation, translation), "undone rows" if undo else "rows", rows)


def to_rows(extrinsics: Extrinsics, undo: bool = False) -> list[list[float]]:
    """The 4 x 4 matrix of a pose, or of what undoes it."""
    rows: list[list[float]] | None = written(extrinsics, "undone rows" if undo else "rows")
    if rows is None:
        rotation, translation = inverse(*numbers(extrinsics)) if undo else numbers(extrinsics)
        rows = as_rows(matrix_of_vector(rotation), translation)
    return rows


def as_rows(matrix: Matrix, translation: Vector) -> list[list[float]]:
    """The 4 x 4 matrix of a rotation matrix and a translation."""
    rows = [[*row, t] for row, t in zip(matrix, translation, strict=True)]
    return [*rows, [0.0, 0.0, 0.0, 1.0]]


def from_quaternion(record: Record, quaternion: Vector, translation: Vector, undo: bool = False) -> Extrinsics:
    """A quaternion w, x, y, z and a translation as a pose, or as the pose that undoes it."""
    rotation = vector_of_quaternion(record, quaternion)
    if undo:
        pose(record, rotation, translation)
        rotation, moved = inverse(rotation, translation)
        return keep(pose(record, rotation, moved), "undone quaternion", (list(quaternion), list(translation)))
    return keep(pose(record, rotation, translation), "quaternion", (list(quaternion), list(translation)))


def to_quaternion(extrinsics: Extrinsics, undo: bool = False) -> tuple[list[float], list[float]]:
    """Quaternion w, x, y, z and translation of a pose, or of what undoes it."""
    kept: tuple[list[float], list[float]] | None = written(extrinsics, "undone quaternion" if undo else "quaternion")
    if kept is not None:
        return kept
    rotation, translation = inverse(*numbers(extrinsics)) if undo else numbers(extrinsics)
    return quaternion_of_vector(rotation), translation
