"""Rotations: vectors and matrices, applied to points."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from camtorch.evaluate.tensors import are_free, as_own, known_false, known_true
from camtorch.native.structs import NEARLY_ROTATION
from camtorch.optics.special import angle_per_radius, cos_root, cosc_root, sinc_root
from camtorch.values.arguments import Numbers, as_real, as_rows, as_values, check_devices

_FEW_MATRICES = 16  # that plain numbers check faster than operators of torch do


def rotation_matrix(rotation: Tensor) -> Tensor:
    """Return matrices (*B, 3, 3) of rotation vectors (*B, 3): Rodrigues' formula, analytic in the squared angle."""
    x, y, z = rotation.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    angle2 = xx + yy + zz
    s, c = sinc_root(angle2), cosc_root(angle2)
    xy, yz, zx = c * x * y, c * y * z, c * z * x
    x, y, z = s * x, s * y, s * z
    rows = (1 - c * (yy + zz), xy - z, zx + y, xy + z, 1 - c * (zz + xx), yz - x, zx - y, yz + x, 1 - c * (xx + yy))
    return torch.unflatten(torch.stack(rows, -1), -1, (3, 3))


def small_turn(rotation: Tensor) -> Tensor:
    """Return rotations (*B, 3, 3) for rotation vectors (*B, 3) by Cayley's formula: fast, correct to second order."""
    half = rotation / 2
    skew = skew_matrix(half)
    eye = torch.eye(3, dtype=half.dtype, device=half.device)
    return eye + (2 / (1 + (half * half).sum(-1)))[..., None, None] * (skew + skew @ skew)


def skew_matrix(vectors: Tensor) -> Tensor:
    """Return the matrices (*B, 3, 3) that map x to the cross product v x, for vectors v (*B, 3)."""
    eye = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    matrix: Tensor = torch.linalg.cross(vectors[..., None, :], eye.expand(*vectors.shape, 3)).mT
    return matrix


def nearest_rotation(matrices: Tensor) -> Tensor:
    """Return the rotations R (*B, 3, 3) nearest to M by least squares: Kabsch's method, largest trace of R^T M."""
    u, _, v = torch.linalg.svd(matrices)
    last = u[..., 2:] * torch.linalg.det(u @ v)[..., None, None]
    rotations: Tensor = torch.cat((u[..., :2], last), -1) @ v
    return rotations


def rotation_vector(matrix: Tensor) -> Tensor:
    """Return rotation vectors (*B, 3) with an angle up to pi of rotation matrices (*B, 3, 3), by Shepperd's method."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y, z, xy, yz, zx = h - f, c - g, d - b, b + d, f + h, c + g
    products = (
        *(1 + a + e + i, x, y, z),
        *(x, 1 + a - e - i, xy, zx),
        *(y, xy, 1 - a + e - i, yz),
        *(z, zx, yz, 1 - a - e + i),
    )
    # columns of 4 q q^T, q the unit quaternion: that of the largest diagonal element has no cancellation
    columns = torch.stack(products, -1).unflatten(-1, (4, 4))
    largest = columns.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    return quaternion_vector(columns.take_along_dim(largest[..., None, None], -2).squeeze(-2))


def quaternion_vector(quaternion: Tensor) -> Tensor:
    """Return rotation vectors (*B, 3), angle up to pi, for quaternions w, x, y, z (*B, 4) of any length."""
    w, vector = quaternion[..., :1], quaternion[..., 1:]
    half = angle_per_radius((vector * vector).sum(-1, keepdim=True), w.abs())
    return torch.where(w < 0, -2 * half, 2 * half) * vector


def vector_quaternion(rotation: Tensor) -> Tensor:
    """Return unit quaternions w, x, y, z (*B, 4) for rotation vectors (*B, 3)."""
    half = rotation / 2
    angle2 = (half * half).sum(-1, keepdim=True)
    return torch.cat((cos_root(angle2), sinc_root(angle2) * half), -1)


def rotate_planes(matrix: Tensor, planes: tuple[Tensor, ...], whole: Tensor | None = None) -> Tensor:
    """Apply (*B, 3, 3) to three planes (*B, N), or to those of `whole`: (3, *B, N), NaN if a point is not finite."""
    x, y, z = planes
    matrix = matrix[(None,) * (x.ndim + 1 - matrix.ndim)]
    a, b, c = matrix.movedim((-1, -2), (0, 1)).unsqueeze(-1).unbind(0)
    # by components, whose precision autocast does not change; sums of whole planes show values that are not finite
    sums = [plane.detach().sum() for plane in (planes if whole is None else (whole,))]
    if x.is_cpu and known_true(torch.isfinite(sums[0] if len(sums) == 1 else torch.stack(sums))):
        return torch.addcmul(torch.addcmul(a * x, b, y), c, z)
    finite = torch.isfinite(x) & torch.isfinite(y) & torch.isfinite(z)
    x, y, z = (torch.where(finite, plane, 0.0) for plane in planes)
    return torch.where(finite, a * x + b * y + c * z, torch.nan)


def check_rotation(matrix: Tensor, name: str, owner: str, hint: str = "") -> None:
    """Raise a ValueError unless (*B, 3, 3) are rotations, to the precision that files store them with."""
    if known_false(are_rotations(matrix)):
        values = matrix.detach().double()
        error = rotation_error(values).max().item()
        raise ValueError(
            f"{owner}: {name} must hold rotation matrices; got R R^T that misses the identity by {error:.2g}, "
            f"and det R = {torch.linalg.det(values).tolist()}{hint}"
        )


def are_rotations(matrix: Tensor) -> Tensor:
    """Whether (*B, 3, 3) are rotations, (*B) bool, to the precision of files or of their dtype."""
    values, precision = matrix.detach().double(), 4 * torch.finfo(matrix.dtype).eps
    proper: Tensor = torch.linalg.det(values) > 0
    return (rotation_error(values) < max(NEARLY_ROTATION, precision)) & proper


def rotation_error(values: Tensor) -> Tensor:
    """Return the deviation (*B,) of R R^T from the identity for matrices (*B, 3, 3)."""
    return (values @ values.mT - torch.eye(3, dtype=values.dtype, device=values.device)).abs().amax((-1, -2))


def as_rotation(rotation: Numbers | None, owner: str) -> Tensor | None:
    """Return the checked rotation of a warp, (3, 3) or (B, 3, 3), or None."""
    if rotation is None:
        return None
    if type(rotation) is Tensor and rotation.ndim <= 3 and rotation.shape[-2:] == (3, 3) and is_right(rotation):
        return rotation if rotation.requires_grad else rotation.clone()
    rotation = as_real(rotation, "rotation", owner)
    if rotation.shape[-2:] != (3, 3) or rotation.ndim > 3:
        hint = ". Pass ct.Extrinsics(vector, (0, 0, 0)).matrix()[..., :3, :3].detach() for a rotation vector"
        hint = hint if rotation.shape[-1:] == (3,) or rotation.shape[-2:] == (3, 1) else ""
        hint = ". Pass T[..., :3, :3] of a pose T" if rotation.shape[-2:] == (4, 4) else hint
        raise ValueError(f"{owner}: rotation must be (3, 3) or (B, 3, 3); got shape {tuple(rotation.shape)}{hint}")
    check_rotation(rotation, "rotation", owner)
    return as_own(rotation)


def is_right(matrix: Tensor) -> bool:
    """Whether (3, 3), or few (B, 3, 3), are rotations, by plain numbers: in less time than one operator of torch takes.

    False for more than a few, and if values may not be read.
    """
    if not (
        matrix.dtype in (torch.float32, torch.float64) and matrix.numel() <= 9 * _FEW_MATRICES and are_free(matrix)
    ):
        return False
    for (a, b, c), (d, e, f), (g, h, i) in [matrix.tolist()] if matrix.ndim == 2 else matrix.tolist():
        squares = a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i
        products = a * d + b * e + c * f, d * g + e * h + f * i, g * a + h * b + i * c
        misses = max(max(squares) - 1, 1 - min(squares), max(products), -min(products))
        if not (misses < NEARLY_ROTATION and a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) > 0):
            return False
    return True


def turn(rotation: Tensor | None, rays: Tensor, name: str) -> Tensor:
    """Apply a rotation, if there is one, to rays (*B, *N, 3), which errors call `name`."""
    if rotation is None:
        return rays
    rows, lead, restore = as_rows(rays, name, rotation.shape[:-2], (rotation,), "Warp")
    rotation = rotation.to(rows.dtype).expand(*lead, 3, 3).reshape(-1, 3, 3)
    return restore(rotate_planes(rotation, rows.unbind(-1), rows))


def transposed(rotation: Tensor | None) -> Tensor | None:
    """Return the rotation back, (*B, 3, 3), or None for none."""
    return None if rotation is None else rotation.mT


def mount_rotation(yaw: Tensor, pitch: Tensor, roll: Tensor) -> Tensor:
    """Return rotations (*B, 3, 3) of a camera that turns right, then up, then leans right: `ray_after = R ray_before`.

    `ct.head_rotation` takes the angles of heads, in radians and in another order.

    Args:
        yaw: (*B,) degrees, about the camera's y axis.
        pitch: (*B,) degrees, about its new x axis.
        roll: (*B,) degrees, about its new z axis.
    """
    given = {"yaw": yaw, "pitch": pitch, "roll": roll}
    given = {name: as_values(value, name, "mount_rotation") for name, value in given.items()}
    try:
        angles = torch.deg2rad(torch.stack(torch.broadcast_tensors(*given.values())))
    except RuntimeError:
        check_devices("mount_rotation", **given)
        shapes = ", ".join(f"{name} {tuple(value.shape)}" for name, value in given.items())
        raise ValueError(f"mount_rotation: angles must broadcast to one shape (*B,); got {shapes}") from None
    elements = mount_elements(angles.cos().unbind(), angles.sin().unbind())
    return torch.unflatten(torch.stack(elements, -1), -1, (3, 3))


def mount_elements(cosines: Sequence[Any], sines: Sequence[Any]) -> tuple[Any, ...]:
    """Return the nine elements of `mount_rotation`, row by row, for the cosines and sines of yaw, pitch and roll."""
    (ca, cb, cc), (sa, sb, sc) = cosines, sines
    # the product of yaw, pitch and roll, each about the turned camera's axes, transposed
    right, ahead = sa * sb, ca * sb
    return (
        *(ca * cc + right * sc, cb * sc, ahead * sc - sa * cc),
        *(right * cc - ca * sc, cb * cc, sa * sc + ahead * cc),
        *(sa * cb, -sb, ca * cb),
    )
