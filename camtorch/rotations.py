"""Rotations: vectors and matrices, applied to points."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from camtorch._arguments import Numbers, as_real, as_rows, as_values, check_devices
from camtorch._tracing import in_graph, is_concrete, may_look
from camtorch.optics.special import cosc_root, sinc_root


def rotation_matrix(rotation: Tensor) -> Tensor:
    """(*B, 3) rotation vectors to (*B, 3, 3) matrices.

    Rodrigues' formula with sin(angle)/angle and (1 - cos(angle))/angle^2 as analytic functions of the squared angle.
    kornia's axis_angle_to_rotation_matrix is off by 7e-14 at 0.01 radians, and its derivatives by more.
    """
    x, y, z = rotation.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    angle2 = xx + yy + zz
    s, c = sinc_root(angle2), cosc_root(angle2)
    xy, yz, zx = c * x * y, c * y * z, c * z * x
    x, y, z = s * x, s * y, s * z
    rows = (1 - c * (yy + zz), xy - z, zx + y, xy + z, 1 - c * (zz + xx), yz - x, zx - y, yz + x, 1 - c * (xx + yy))
    matrix: Tensor = torch.stack(rows, -1).unflatten(-1, (3, 3))
    return matrix


def rotation_vector(matrix: Tensor) -> Tensor:
    """(*B, 3, 3) rotation matrices to (*B, 3) rotation vectors with an angle up to pi.

    Of the quaternion that a matrix stands for, the products with its largest component: Shepperd, "Quaternion from
    rotation matrix", 1978. kornia's conversions, before its version 0.9, are off by 1e-9 and have NaN gradients at the
    identity.
    """
    a, b, c, d, e, f, g, h, i = matrix.flatten(-2).unbind(-1)
    x, y, z, xy, yz, zx = h - f, c - g, d - b, b + d, f + h, g + c
    squares = torch.stack((1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i), -1)
    ww, xx, yy, zz = squares.unbind(-1)
    products = torch.stack((ww, x, y, z, x, xx, xy, zx, y, xy, yy, yz, z, zx, yz, zz), -1).unflatten(-1, (4, 4))
    largest = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quaternion = products.gather(-2, largest).squeeze(-2)
    w, axis = quaternion[..., :1].abs(), torch.where(quaternion[..., :1] < 0, -1.0, 1.0) * quaternion[..., 1:]
    length2 = (axis * axis).sum(-1, keepdim=True)
    turns = length2 > 0
    length = torch.where(turns, length2, 1.0).sqrt()
    # at the identity, where w is the largest, the limit; its square root would have no derivative there
    vector: Tensor = axis * torch.where(turns, 2 * torch.atan2(length, w) / length, 2 / torch.where(turns, 1.0, w))
    return vector


def rotate_planes(matrix: Tensor, planes: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Apply (*B, 3, 3) to three planes (*B, N): by components, which autocast leaves in their precision.

    A point that is not finite becomes NaN, which has no part in the gradient of the matrix.
    """
    x, y, z = planes
    rows = [row.unsqueeze(-1).unbind(-2) for row in matrix.unbind(-2)]
    # a sum shows what is not finite: the whole planes are looked at once
    if may_look(x) and math.isfinite(x.detach().sum() + y.detach().sum() + z.detach().sum()):
        return tuple(torch.addcmul(torch.addcmul(a * x, b, y), c, z) for a, b, c in rows)
    finite = torch.isfinite(x) & torch.isfinite(y) & torch.isfinite(z)
    x, y, z = (torch.where(finite, plane, 0.0) for plane in planes)
    return tuple(torch.where(finite, a * x + b * y + c * z, torch.nan) for a, b, c in rows)


def check_rotation(matrix: Tensor, name: str, owner: str, hint: str = "") -> None:
    """Raise a ValueError unless (*B, 3, 3) are rotations, to the precision that files store them with."""
    if is_concrete(matrix) and not is_rotation(matrix):
        values = matrix.detach().double()
        error = _rotation_error(values).max().item()
        raise ValueError(
            f"{owner}: {name} must hold rotation matrices; R R^T misses the identity by {error:.2g} "
            f"and det R = {torch.linalg.det(values).tolist()}{hint}"
        )


def is_rotation(matrix: Tensor) -> bool:
    """Whether all of (*B, 3, 3) are rotations, to the precision that files store them with."""
    return bool(are_rotations(matrix).all())


def are_rotations(matrix: Tensor) -> Tensor:
    """(*B) bool: which of (*B, 3, 3) are rotations; see `is_rotation`. Half precision stores them less precisely."""
    values, precision = matrix.detach().double(), 4 * torch.finfo(matrix.dtype).eps
    proper: Tensor = torch.linalg.det(values) > 0
    return (_rotation_error(values) < max(1e-3, precision)) & proper


def _rotation_error(values: Tensor) -> Tensor:
    return (values @ values.mT - torch.eye(3, dtype=values.dtype, device=values.device)).abs().amax((-1, -2))


def as_rotation(rotation: Numbers | None, owner: str) -> Tensor | None:
    """A checked rotation of a warp, (3, 3) or (B, 3, 3), or None."""
    if rotation is None:
        return None
    rotation = as_real(rotation, "rotation", owner)
    if rotation.shape[-2:] != (3, 3) or rotation.ndim > 3:
        hint = ". ct.Extrinsics(vector, (0, 0, 0)).matrix()[..., :3, :3] is the matrix of a rotation vector"
        hint = hint if rotation.shape[-1:] == (3,) or rotation.shape[-2:] == (3, 1) else ""
        raise ValueError(f"{owner}: rotation must be (3, 3) or (B, 3, 3); got shape {tuple(rotation.shape)}{hint}")
    check_rotation(rotation, "rotation", owner)
    return rotation if isinstance(rotation, nn.Parameter) or in_graph(rotation) else rotation.detach().clone()


def turn(rotation: Tensor | None, rays: Tensor, name: str) -> Tensor:
    """Apply a rotation, if there is one, to (*B, *N, 3); `name` is what an error calls them."""
    if rotation is None:
        return rays
    rows, lead, restore = as_rows(rays, name, 3, rotation.shape[:-2], (rotation,), "Warp")
    rotation = rotation.to(rows.dtype).expand(*lead, 3, 3).reshape(-1, 3, 3)
    return restore(torch.stack(rotate_planes(rotation, rows.unbind(-1))))


def mount_rotation(yaw: Tensor, pitch: Tensor, roll: Tensor) -> Tensor:
    """(*B, 3, 3), `ray_after = R ray_before`, of a camera that turns right, then looks up, then leans right.

    Args:
        yaw: (*B,) degrees, about the camera's y axis; pitch about its new x axis, roll about its new z axis.
        pitch: likewise.
        roll: likewise.
    """
    given = {"yaw": yaw, "pitch": pitch, "roll": roll}
    given = {name: as_values(value, name, "mount_rotation") for name, value in given.items()}
    try:
        angles = torch.deg2rad(torch.stack(torch.broadcast_tensors(*given.values())))
    except RuntimeError:
        check_devices("mount_rotation", **given)
        shapes = ", ".join(f"{name} {tuple(value.shape)}" for name, value in given.items())
        raise ValueError(f"mount_rotation: the angles must be of one shape (*B,); got {shapes}") from None
    (ca, cb, cc), (sa, sb, sc) = angles.cos().unbind(), angles.sin().unbind()
    # the turn, the look and the lean multiplied out, each about the turned camera's axes, and transposed
    right, ahead = sa * sb, ca * sb
    rows = (
        *(ca * cc + right * sc, cb * sc, ahead * sc - sa * cc),
        *(right * cc - ca * sc, cb * cc, sa * sc + ahead * cc),
        *(sa * cb, -sb, ca * cb),
    )
    matrix: Tensor = torch.stack(rows, -1).unflatten(-1, (3, 3))
    return matrix
