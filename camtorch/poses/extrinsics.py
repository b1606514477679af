"""Rigid poses as a layer: world points to points of the camera frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from camtorch.evaluate.tensors import known_false, values_of
from camtorch.poses.rotations import are_rotations, check_rotation, rotate_planes, rotation_matrix, rotation_vector
from camtorch.values.arguments import (
    Numbers,
    as_batch,
    as_coordinates,
    as_real,
    as_rows,
    as_vectors,
    broadcast_shapes,
    check_angles,
    check_devices,
    check_radians,
    hinting,
    shown,
)
from camtorch.values.module import BatchedModule, remade, typed_as


class Extrinsics(BatchedModule):
    """Camera from world: `p_camera = R p_world + t`, as OpenCV's rvec and tvec. `nn.Sequential(extrinsics, camera)`
    is a world-to-pixel layer.

    Args:
        rotation: (*B, 3) rotation vectors, axis times angle in radians, or (*B, 3, 3) rotation matrices.
        translation: (*B, 3): the world's origin in the camera's frame. The camera's `position` is -R^T t.

    Vectors may have OpenCV's shapes: columns (*B, 3, 1), an array (1, 3), a list of V such arrays as a batch of V. A
    tensor (1, 3) is a batch of one. A value with the shape of matrices is taken as matrices if they are rotations, or
    the translation has one dim less. An ambiguous shape raises an error, which shows how to pass the values.

    Plain values become new Parameters; a tensor that requires grad is used without copying. Gradients are exact.

    Raises:
        ValueError: If a shape is wrong, plain rotation vectors exceed two turns, which seem to be degrees, a matrix
            is not a rotation, batch dims do not fit, or a value is NaN or infinite.
        TypeError: If values are not numeric.

    Example:
        >>> ct.Extrinsics([0.0, 0.0, 0.0], [0.0, 0.0, 2.0])([1.0, 2.0, 3.0]).tolist()
        [1.0, 2.0, 5.0]
    """

    tensor_names: ClassVar[tuple[str, ...]] = ("rotation", "translation")
    rotation: Tensor
    translation: Tensor

    @hinting(
        "It takes ct.Extrinsics([rx, ry, rz], [tx, ty, tz]), a rotation vector in radians; from_matrix(T) a matrix"
    )
    def __init__(self, rotation: Numbers, translation: Numbers | None = None):
        super().__init__()
        if translation is None:
            raise TypeError(
                f"Extrinsics: translation must be given; got rotation {shown(rotation)} only. Pass [0.0, 0, 0] for "
                "none, rt[:3], rt[3:] for mrcal's rt, and ct.Extrinsics.from_matrix(T) for a matrix (4, 4)"
            )
        device = rotation.device if isinstance(rotation, Tensor) else None
        translation = as_vectors(translation, "translation", "Extrinsics", device)
        # columns (3, 3, 1) are always vectors
        undecided = as_real(rotation, "rotation", "Extrinsics").shape[-2:] == (3, 3)
        rotation = as_vectors(rotation, "rotation", "Extrinsics", translation.device)
        if undecided and _are_matrices(rotation, translation):
            rotation = rotation_vector(rotation)
        check_radians(rotation, "rotation", "Extrinsics")
        shape = (*as_batch("Extrinsics", rotation=rotation.shape, translation=translation.shape), 3)
        self.hold("rotation", rotation, shape)
        self.hold("translation", translation, shape)

    @property
    def batch_shape(self) -> torch.Size:
        """Batch dims *B of the pose."""
        return broadcast_shapes(self.rotation.shape, self.translation.shape)[:-1]

    def forward(self, points_world: Numbers) -> Tensor:
        """Move world points (*B, *N, 3) to the camera frame, same shape."""
        parameters = (self.rotation, self.translation)
        rows, lead, restore = as_rows(points_world, "points_world", self.batch_shape, parameters, "Extrinsics")
        rotation, translation = (t.expand(*lead, 3).reshape(-1, 3) for t in parameters)
        turned = rotate_planes(rotation_matrix(rotation), rows.unbind(-1))
        return restore(turned + translation.mT.unsqueeze(-1))

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def matrix(self) -> Tensor:
        """Return the matrices (*B, 4, 4) [[R, t], [0, 1]]."""
        rotation, translation = (t.expand(*self.batch_shape, 3) for t in (self.rotation, self.translation))
        top = torch.cat((rotation_matrix(rotation), translation.unsqueeze(-1)), -1)
        bottom = top.new_tensor([[0.0, 0.0, 0.0, 1.0]]).expand(*self.batch_shape, 1, 4)
        return torch.cat((top, bottom), -2)

    @classmethod
    def from_matrix(cls, matrix: Numbers | tuple[Numbers, Numbers], translation: Numbers | None = None) -> Extrinsics:
        """Make poses from matrices.

        Args:
            matrix: (*B, 4, 4) or (*B, 3, 4) matrices [[R, t], ...]; or R (*B, 3, 3), with a translation or in a pair.
            translation: (*B, 3), or in OpenCV's shapes.

        Raises:
            ValueError: If a shape is wrong, a last row is not (0, 0, 0, 1), or an R is not a rotation.
        """
        given: Any
        given, translation = _pair(matrix) if translation is None else (matrix, translation)
        if translation is not None:
            rotation = as_real(given, "rotation", "Extrinsics")
            if rotation.shape[-2:] != (3, 3):
                raise ValueError(
                    "Extrinsics: the R of from_matrix(R, t) must be matrices (*B, 3, 3); got shape "
                    f"{tuple(rotation.shape)}. Pass a rotation vector as Extrinsics(rotation, translation)"
                )
        else:
            matrix = as_real(given, "matrix", "Extrinsics")
            if matrix.shape[-2:] not in ((4, 4), (3, 4)):
                is_turn = matrix.shape[-2:] == (3, 3)
                hint = ". Pass a rotation with its translation: from_matrix(R, t)" if is_turn else ""
                raise ValueError(
                    f"Extrinsics: matrix must be (*B, 4, 4) or (*B, 3, 4); got shape {tuple(matrix.shape)}{hint}"
                )
            bottom = matrix[..., 3:, :].detach()
            if known_false((bottom - bottom.new_tensor([0, 0, 0, 1])).abs() < 1e-5):  # rounding of an inverse
                raise ValueError(f"Extrinsics: the last row of matrix must be 0 0 0 1; got {bottom.tolist()}")
            rotation, translation = matrix[..., :3, :3], matrix[..., :3, 3]
        check_rotation(rotation, "matrix", "Extrinsics")
        return cls(rotation_vector(rotation).unsqueeze(-1), translation)

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Extrinsics:
        """Return the frozen pose described by a dict from `to_dict`.

        Raises:
            ValueError: If a key is missing, unknown or has a wrong value.
        """
        import camtorch  # as in `Camera.load`

        return camtorch.io.made_of(cls, d)

    def inverse(self) -> Extrinsics:
        """Return the inverse pose: world from camera."""
        # learnt rotation vectors may have any length
        rotation = -self.rotation.expand(*self.batch_shape, 3)
        return remade(self, rotation=rotation, translation=self.position).learn_like(self)

    def compose(self, other: Extrinsics) -> Extrinsics:
        """Return the pose that applies `other` first, then this one: `a.compose(b)(p) == a(b(p))`."""
        if not isinstance(other, Extrinsics):
            raise TypeError(f"Extrinsics: other must be Extrinsics; got {type(other).__name__}")
        check_devices("Extrinsics", this=self.rotation, other=other.rotation)
        as_batch("Extrinsics", this=(*self.batch_shape, 3), other=(*other.batch_shape, 3))
        mine, its = rotation_matrix(self.rotation), rotation_matrix(other.rotation)
        product = rotate_planes(mine, its.unbind(-2)).movedim(0, -2)
        moved = rotate_planes(mine, other.translation.unsqueeze(-1).unbind(-2)).squeeze(-1).movedim(0, -1)
        return Extrinsics(rotation_vector(product).unsqueeze(-1), moved + self.translation).freeze_like(self, other)

    @property
    def position(self) -> Tensor:
        """Position (*B, 3) of the camera in the world, -R^T t."""
        turned_back = rotate_planes(rotation_matrix(-self.rotation), self.translation.unsqueeze(-1).unbind(-2))
        return -turned_back.squeeze(-1).movedim(0, -1)

    def extra_repr(self) -> str:
        """Return the batch shape, or the numbers of a single pose, in words."""
        rotation, translation = values_of(self.rotation), values_of(self.translation)
        if self.batch_shape or rotation is None or translation is None:
            return f"batch_shape={tuple(self.batch_shape)}"
        return f"rotation={rotation.tolist()}, translation={translation.tolist()}"


def head_angles(pose: Extrinsics | Numbers) -> Tensor:
    """Return pitch, yaw and roll (..., 3) in radians for heads that a camera sees.

    The head's frame has x to the image's right, y down and z away from the camera when the head faces it, so that the
    identity faces the camera. R = Ry(yaw) Rx(-pitch) Rz(roll), right-handed turns about the camera's axes. The nose
    points along R (0, 0, -1), the gaze with this pitch and yaw in `ct.augment.to_pitch_yaw` (the signs of ETH-XGaze),
    and a positive roll leans clockwise in the image about that axis. If the nose points straight up or down, roll is 0.
    Values and gradients are finite everywhere. `ct.augment.mount_rotation` has another order, in degrees.

    Args:
        pose: Camera from head: Extrinsics, a `Pose` of `ct.solve_pnp`, or matrices (..., 4, 4) or (..., 3, 3).

    Raises:
        TypeError: If `pose` is not numeric. ValueError: If the shape is wrong or a matrix is not a rotation.
    """
    pose = getattr(pose, "extrinsics", pose)
    if isinstance(pose, Extrinsics):
        matrix = rotation_matrix(pose.rotation.expand(*pose.batch_shape, 3))
    else:
        matrix = as_real(pose, "pose", "head_angles")
        if matrix.shape[-2:] not in ((3, 3), (4, 4)):
            raise ValueError(
                "head_angles: pose must be Extrinsics, a Pose, (..., 4, 4) or (..., 3, 3); "
                f"got shape {tuple(matrix.shape)}. Pass a rotation vector as ct.Extrinsics(rvec, (0, 0, 0))"
            )
        matrix = matrix[..., :3, :3]
        check_rotation(matrix, "pose", "head_angles")
    matrix = matrix.to(torch.promote_types(matrix.dtype, torch.float32))
    cosine2 = matrix[..., 1, 0].square() + matrix[..., 1, 1].square()
    straight = cosine2 <= (8 * torch.finfo(matrix.dtype).eps) ** 2
    cosine = torch.where(straight, 1.0, cosine2).sqrt()
    pitch = torch.atan2(matrix[..., 1, 2], torch.where(straight, 0.0, cosine))
    # the direction of a short vector is inaccurate, so another vector is used
    over = torch.where(straight, -matrix[..., 2, 0], matrix[..., 0, 2])
    yaw = torch.atan2(over, torch.where(straight, matrix[..., 0, 0], matrix[..., 2, 2]))
    lean = torch.where(straight, 0.0, matrix[..., 1, 0])
    roll = torch.atan2(lean, torch.where(straight, 1.0, matrix[..., 1, 1]))
    return torch.stack((pitch, yaw, roll), -1)


def head_rotation(angles: Numbers) -> Tensor:
    """Return rotations (..., 3, 3), camera from head, for pitch, yaw and roll (..., 3) in radians: undo `head_angles`.

    Raises:
        TypeError: If `angles` is not numeric. ValueError: If the shape is wrong, or plain angles exceed a turn.
    """
    angles = as_coordinates(angles, "angles", 3, "head_rotation", means=", pitch, yaw and roll in radians")
    check_angles(angles, "head_rotation")
    angles = angles.to(torch.promote_types(angles.dtype, torch.float32))
    (cp, cy, cr), (sp, sy, sr) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    rows = (
        *(cy * cr - sy * sp * sr, -cy * sr - sy * sp * cr, sy * cp),
        *(cp * sr, cp * cr, sp),
        *(-sy * cr - cy * sp * sr, sy * sr - cy * sp * cr, cy * cp),
    )
    return torch.unflatten(torch.stack(rows, -1), -1, (3, 3))


def _are_matrices(rotation: Tensor, translation: Tensor) -> bool:
    """Whether `rotation` holds matrices (*B, 3, 3) and not three vectors each, by its values and `translation`."""
    beside = translation.ndim == rotation.ndim - 1
    if values_of(rotation) is None:
        return beside
    if bool(are_rotations(rotation).all()):
        if translation.shape[-2:] == (3, 3) and not beside:
            raise ValueError(
                "Extrinsics: rotation must be matrices or vectors; got an ambiguous shape "
                f"{tuple(rotation.shape)}, three vectors each or rotation matrices, with translation "
                f"{tuple(translation.shape)}. Use Extrinsics.from_matrix(rotation, translation) for matrices, or pass "
                "rotation[..., None] for vectors"
            )
        return True
    if beside:
        hint = ". Pass three rotation vectors that share a translation as rotation[..., None]"
        check_rotation(rotation, "rotation", "Extrinsics", hint)
    return False


def _pair(matrix: Any) -> tuple[Any, Any]:
    """Return (R, t) if `matrix` is such a pair; otherwise (also for a list of two matrices) `matrix` and None."""
    if not isinstance(matrix, (list, tuple)) or len(matrix) != 2:
        return matrix, None
    try:
        shapes = [tuple(v.shape) if isinstance(v, Tensor) else np.shape(v) for v in matrix]
    except ValueError:  # a ragged list
        return matrix, None
    return (matrix[0], matrix[1]) if shapes[0][-2:] == (3, 3) and shapes[0] != shapes[1] else (matrix, None)
