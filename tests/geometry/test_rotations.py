"""Rotations, apart from the points that they turn."""

import torch

from camtorch.rotations import are_rotations, nearest_rotation, rotation_matrix


def test_no_rotation_is_nearer_than_the_nearest():
    """Of any matrix, also of those that mirror."""
    draw = torch.Generator().manual_seed(0)
    matrices = torch.randn(40, 3, 3, generator=draw, dtype=torch.float64)
    found = nearest_rotation(matrices)
    assert are_rotations(found).all()
    others = rotation_matrix(3 * torch.randn(5000, 1, 3, generator=draw, dtype=torch.float64))
    off, least = ((matrices - turned).square().sum((-1, -2)) for turned in (found, others))
    assert (off <= least.amin(0)).all()
    assert bool((torch.linalg.det(matrices) < 0).any())
