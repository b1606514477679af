"""Poses of known points from the rays that see them, in closed form, at any angle from the optical axis."""

from __future__ import annotations

import math
from itertools import permutations
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from camtorch.calibration.native_calls import from_rays
from camtorch.native.library import library
from camtorch.poses.rotations import nearest_rotation, small_turn

_PAIRS = ((0, 1, 2), (1, 3, 4), (2, 4, 5))  # where a symmetric matrix's entries are among its six numbers
_FLAT = 1e-6  # of the points' extent: less counts as flat
_SAME = 0.02  # radians between two rotations that are one minimum
_STARTS, _CONTINUED, _STEPS = 12, 4, 8  # rotations to start from, those continued, and steps
_LEAST, _TINY = 1e-15, 1e-300  # added to divisors


class RayPoses(NamedTuple):
    """S poses a row, best first: rotations (B, S, 3, 3), translations (B, S, 3), and whether each is valid (B, S)."""

    rotations: Tensor
    translations: Tensor
    valid: Tensor


def poses_from_rays(points: Tensor, rays: Tensor, weights: Tensor) -> RayPoses:
    """Return the poses, camera from object, at which known points lie on rays; those with the least angles first.

    With the best translation for a rotation, the sum of the points' squared distances from their rays is a quadratic
    form of the rotation's entries (C.-P. Lu, G. Hager and E. Mjolsness, TPAMI 2000). A fixed number of steps leads to
    its minima. Points on a plane have up to two, whose normals mirror each other at the line of sight: the starts are
    the two rotations that the homography from plane to rays allows (T. Collins and A. Bartoli, Infinitesimal
    Plane-Based Pose Estimation, IJCV 2014, here on rays). Points in space usually have one: further starts are the
    linear solution, the view from afar and turns by right angles. No formula divides by z, so rays may have any angle.

    Points and unit rays are (B, N, 3), weights (B, N) not negative, 0 for unseen; S = 2. A pose is valid if it is
    finite, four points or more are seen, not all on a line, and most lie ahead on their rays; the second pose must also
    be another minimum. Invalid poses are finite and have no meaning.
    """
    if library() is not None and points.is_cpu and rays.is_cpu and weights.is_cpu:
        return RayPoses(*from_rays(points, rays, weights))
    # points that are not finite, which a sum shows, get weight 0; points without weight are zero
    seen = torch.isfinite(points.sum(-1) + rays.sum(-1) + weights) & (weights > 0)
    points, rays = torch.where(seen[..., None], points, 0.0), torch.where(seen[..., None], rays, 0.0)
    weights = torch.where(seen, weights, 0.0)
    weights = weights / weights.sum(-1, keepdim=True).clamp(min=_TINY)
    centre = (weights[..., None] * points).sum(-2)
    centred = torch.where(weights[..., None] > 0, points - centre[:, None], 0.0)
    variances, axes = torch.linalg.eigh((weights[..., None] * centred).mT @ centred)
    extent = variances.clamp(min=0.0).sqrt()
    size = extent[:, 2].clamp(min=_TINY)
    axes = axes.flip(-1)  # the rotation from the frame of the plane, or of the points' main axes
    axes = torch.cat((axes[..., :2], torch.linalg.cross(axes[..., 0], axes[..., 1])[..., None]), -1)
    local = centred @ axes / size[:, None, None]
    enough = ((weights > 0).sum(-1) >= 4) & (extent[:, 1] > _FLAT * size)

    distances = _Distances.between(local, rays, weights)
    rotations = points.new_empty(len(points), 2, 3, 3)
    flat = extent[:, 0] <= _FLAT * size
    for chosen in (flat, ~flat):
        (rows,) = chosen.nonzero(as_tuple=True)
        if len(rows):
            some = _Distances(*(t[rows] for t in distances))
            if chosen is flat:
                rotations[rows] = some.descended(_planar_starts(rays[rows], weights[rows], some), _STEPS)
            else:
                rotations[rows] = _rotations_in_space(local[rows], rays[rows], weights[rows], some)
    translations = distances.translations(rotations)
    placed = local[:, None] @ rotations.mT + translations[:, :, None]
    cosines = (normalize(placed, dim=-1) * rays[:, None]).sum(-1)
    # a plane behind its rays fits them as well as its point reflection ahead of them
    side = torch.where(flat[:, None] & ((weights[:, None] * cosines.sign()).sum(-1) < 0), -1.0, 1.0).to(cosines)
    rotations = rotations * torch.stack((side, side, torch.ones_like(side)), -1)[:, :, None]
    translations, cosines = translations * side[..., None], cosines * side[..., None]
    ahead = (weights[:, None] * cosines.sign()).sum(-1) > 0
    # best first: 1 - cosine grows with the angle up to a half turn
    order = (weights[:, None] * (1 - cosines)).sum(-1).nan_to_num(torch.inf).argsort(-1)
    rotations, translations, ahead = (_take(t, order) for t in (rotations, translations, ahead))
    rotations = rotations @ axes.mT[:, None]
    translations = translations * size[:, None, None] - (rotations @ centre[:, None, :, None])[..., 0]
    finite = torch.isfinite(rotations).all(-1).all(-1) & torch.isfinite(translations).all(-1)
    valid = finite & ahead & enough[:, None]
    # by the trace of the turn from one to the other
    same = (rotations[:, 0] * rotations[:, 1]).sum((-1, -2)) > 1 + 2 * math.cos(_SAME)
    valid = torch.stack((valid[:, 0], valid[:, 1] & ~same), -1)
    rotations = torch.where(finite[..., None, None], rotations, torch.eye(3).to(rotations))
    return RayPoses(rotations, torch.where(finite[..., None], translations, 0.0), valid)


def _frame(direction: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) whose third column is the unit direction (..., 3)."""
    sign = torch.where(direction[..., 2] < 0, -1.0, 1.0)
    mirror = torch.cat((direction[..., :2], (direction[..., 2] + sign)[..., None]), -1)
    scale = 2 / mirror.square().sum(-1).clamp(min=_TINY)
    first = -(scale * mirror[..., 0])[..., None] * mirror
    first = torch.cat((1 + first[..., :1], first[..., 1:]), -1)
    return torch.stack((first, torch.linalg.cross(direction, first), direction), -1)


def _sight(rays: Tensor, weights: Tensor) -> Tensor:
    """Return the mean direction (B, 3) of rays (B, N, 3), the line of sight."""
    return normalize((weights[..., None] * rays).sum(-2), dim=-1)


def _homography(sight: Tensor, distances: _Distances) -> Tensor:
    """Return homographies (B, 3, 3) from the plane's points (x, y, 1) to rays of mean direction `sight` (B, 3)."""
    # the first two columns' entries across the line of sight, and along it, where narrow views hardly determine them
    frame = _frame(sight)
    basis = torch.stack((frame.mT, torch.zeros_like(frame)), -1)
    basis = torch.stack((basis, basis.flip(-1)), 2).flatten(1, 2)
    basis = torch.nn.functional.pad(basis, (0, 1)).flatten(2)
    small = basis @ distances.form @ basis.mT
    scale = small.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
    eye = torch.eye(2, dtype=small.dtype, device=small.device)
    along = torch.linalg.solve_ex(small[:, 4:, 4:] + (_LEAST * scale + _TINY) * eye, small[:, 4:, :4])[0]
    across = torch.linalg.eigh(small[:, :4, :4] - small[:, :4, 4:] @ along).eigenvectors[..., :1]
    entries = basis.mT @ torch.cat((across, -along @ across), 1)
    entries = torch.where((distances.to_depth[:, None] @ entries) < 0, -entries, entries)
    return torch.cat((entries.view(-1, 3, 3)[..., :2], distances.to_translation @ entries), -1)


class _Distances(NamedTuple):
    """The weighted sum of the squared distances of points from rays, a quadratic form of the rotation's entries."""

    form: Tensor  # (B, 9, 9)
    to_translation: Tensor  # (B, 3, 9)
    to_depth: Tensor  # (B, 9), to the points' mean distance along their rays

    @classmethod
    def between(cls, local: Tensor, rays: Tensor, weights: Tensor) -> _Distances:

        def products(vectors: Tensor) -> Tensor:
            x, y, z = vectors.unbind(-1)
            return torch.stack((x * x, x * y, x * z, y * y, y * z, z * z), -1)

        # the sums (B, 3, 3, 3, 3) of (I - r r^T) x p p^T over points p with unit rays r
        pairs = products(local) * weights[..., None]
        along = products(rays).mT @ pairs
        across = pairs.sum(-2)[:, None] * pairs.new_tensor([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])[:, None] - along
        index = torch.tensor(_PAIRS, device=rays.device)
        form = across[:, index[:, :, None, None], index].transpose(2, 3).reshape(-1, 9, 9)
        eye = torch.eye(3, dtype=rays.dtype, device=rays.device)
        weighted = weights[..., None] * rays
        # rays that are all the same leave the distance open
        total = (weights.sum(-1)[:, None, None] + _LEAST) * eye - weighted.mT @ rays
        along = weighted.mT @ (rays[..., :, None] * local[..., None, :]).flatten(2)
        centre = (weights[..., None] * local).sum(-2)
        moved = (eye[..., None] * centre[:, None, None]).flatten(2) - along
        solution = torch.linalg.solve_ex(total, moved)[0]
        to_depth = (weighted.mT @ local).flatten(1) - (weighted.sum(1)[:, None] @ solution)[:, 0]
        return cls(form - moved.mT @ solution, -solution, to_depth)

    def translations(self, rotations: Tensor) -> Tensor:
        """Return the best translations (B, S, 3) for rotations (B, S, 3, 3)."""
        return rotations.flatten(2) @ self.to_translation.mT

    def of_rotations(self, rotations: Tensor) -> Tensor:
        """Return the costs (B, S) of rotations (B, S, 3, 3)."""
        entries = rotations.flatten(2)
        return ((entries @ self.form) * entries).sum(-1)

    def depths(self, rotations: Tensor) -> Tensor:
        """Return the points' mean depths (B, S) for rotations (B, S, 3, 3)."""
        return (rotations.flatten(2) @ self.to_depth[..., None])[..., 0]

    def descended(self, rotations: Tensor, steps: int) -> Tensor:
        """Return rotations (B, S, 3, 3) after Levenberg-Marquardt steps of three unknowns, which read no points."""
        costs = self.of_rotations(rotations)
        damping = torch.full_like(costs, 1e-2)
        eye = torch.eye(3, dtype=costs.dtype, device=costs.device)
        turns = torch.linalg.cross(eye[:, None], eye[None]).mT.flatten(0, 1)
        for _ in range(steps):
            slopes = (turns @ rotations).unflatten(2, (3, 3)).flatten(3)
            mapped = (slopes.flatten(1, 2) @ self.form).view_as(slopes)
            gradient = mapped @ rotations.flatten(2)[..., None]
            normal = mapped @ slopes.mT
            normal = normal + (damping * normal.diagonal(dim1=-2, dim2=-1).sum(-1) + _TINY)[..., None, None] * eye
            turned = small_turn(-torch.linalg.solve_ex(normal, gradient)[0][..., 0]) @ rotations
            turned_costs = self.of_rotations(turned)
            better = turned_costs < costs
            rotations = torch.where(better[..., None, None], turned, rotations)
            costs = torch.where(better, turned_costs, costs)
            damping = torch.where(better, damping / 10, damping * 10).clamp(1e-9, 1e3)
        return rotations


def _planar_starts(rays: Tensor, weights: Tensor, distances: _Distances) -> Tensor:
    """Return the two rotations (B, 2, 3, 3) that the homography allows."""
    homography = _homography(_sight(rays, weights), distances)
    frame = _frame(normalize(homography[..., 2], dim=-1))
    # the columns' parts across the line of sight are known up to a scale: the larger singular value of such a part of
    # a rotation is one
    across = frame[..., :2].mT @ homography[..., :2]
    (a, b), (c, d) = ((across[:, i, 0], across[:, i, 1]) for i in range(2))
    largest = (torch.hypot(a + d, b - c) + torch.hypot(a - d, b + c)) / 2
    across = across / largest.clamp(min=_TINY)[:, None, None]
    rest = -across.mT @ across
    along_x, along_y = (1 + rest[:, 0, 0]).clamp(min=0.0).sqrt(), (1 + rest[:, 1, 1]).clamp(min=0.0).sqrt()
    along = torch.stack((along_x, torch.where(rest[:, 0, 1] < 0, -along_y, along_y)), -1)
    candidates = []
    for sign in (1, -1):
        first, second = torch.cat((across, sign * along[:, None]), 1).unbind(-1)
        candidates.append(frame @ torch.stack((first, second, torch.linalg.cross(first, second)), -1))
    return torch.stack(candidates, 1)


def _rotations_in_space(local: Tensor, rays: Tensor, weights: Tensor, distances: _Distances) -> Tensor:
    """Return rotations (B, 2, 3, 3) for points in space whose main axes are the coordinate axes."""
    frame = _frame(_sight(rays, weights))
    linear = torch.linalg.eigh(distances.form).eigenvectors[..., 0].view(-1, 1, 3, 3)
    linear = torch.where(distances.depths(linear)[..., None, None] < 0, -linear, linear)
    # from afar, the two rows across the line of sight, up to the distance
    rows = (weights[..., None] * (rays @ frame[..., :2])).mT @ local
    rows = normalize(rows / (weights[..., None] * local.square()).sum(-2).clamp(min=_TINY)[:, None], dim=-1)
    from_afar = frame @ torch.cat((rows, torch.linalg.cross(rows[:, :1], rows[:, 1:])), 1)
    nearest = nearest_rotation(torch.cat((linear, from_afar[:, None]), 1))
    planar = _planar_starts(rays, weights, distances)
    # (24, 3, 3): the rotations that map axes to axes
    matrices = torch.eye(3, dtype=frame.dtype, device=frame.device)[torch.tensor([*permutations(range(3))])]
    signs = torch.cartesian_prod(*[frame.new_tensor([1.0, -1.0])] * 3)
    matrices = (matrices[:, None] * signs[:, None]).flatten(0, 1)
    rotations = torch.cat((nearest, planar, frame[:, None] @ matrices[torch.linalg.det(matrices) > 0]), 1)

    def costs(rotations: Tensor) -> Tensor:
        return torch.where(distances.depths(rotations) > 0, distances.of_rotations(rotations), torch.inf)

    # four points have up to four minima near each other, which two steps do not separate
    few = _STARTS if bool(((weights > 0).sum(-1) <= 4).any()) else _CONTINUED
    for count, steps in ((_STARTS, 2), (few, _STEPS)):
        rotations = distances.descended(_take(rotations, costs(rotations).argsort(-1)[:, :count]), steps)
    cost = costs(rotations)
    best = _take(rotations, cost.argmin(-1, keepdim=True))
    same = (rotations * best).sum((-1, -2)) > 1 + 2 * math.cos(_SAME)
    other = torch.where(same, torch.inf, cost).argmin(-1, keepdim=True)
    return torch.cat((best, _take(rotations, other)), 1)


def _take(values: Tensor, index: Tensor) -> Tensor:
    """Return the values (B, S, ...) at an index (B, T)."""
    return torch.take_along_dim(values, index.view(*index.shape, *[1] * (values.ndim - 2)), 1)
