"""head_angles and head_rotation: pitch, yaw and roll of heads."""

import math

import numpy as np
import torch

import camtorch as ct

STRAIGHT = torch.tensor([[math.pi / 2, 0.4, 0.0], [-math.pi / 2, -2.0, 0.0]], dtype=torch.float64)


def angles(count=200):
    drawn = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)).double() * 2 - 1
    return drawn * torch.tensor([math.pi / 2, math.pi, math.pi]) * 0.999


def by_axes(pitch, yaw, roll):
    """Ry(yaw) Rx(-pitch) Rz(roll)."""

    def about(axis, angle):
        skew = np.cross(np.eye(3), np.eye(3)[axis])
        return np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * skew @ skew

    return about(1, yaw) @ about(0, -pitch) @ about(2, roll)


def test_turns_are_those_about_the_axes():
    given = torch.cat((angles(), STRAIGHT))
    expected = np.array([by_axes(*row) for row in given.tolist()])
    np.testing.assert_allclose(ct.head_rotation(given), expected, atol=1e-15)
    np.testing.assert_allclose(ct.head_angles(expected), given, atol=1e-12)
    assert not ct.head_angles(torch.eye(3)).any()


def test_the_nose_has_the_angles_of_a_gaze():
    rotation = ct.head_rotation(angles())
    assert torch.allclose(ct.augment.to_pitch_yaw(-rotation[..., 2]), ct.head_angles(rotation)[:, :2])


def test_signs():
    """Seen in the image: up, to the image's left, clockwise."""
    pitch, yaw, roll = ct.head_rotation(0.1 * torch.eye(3))
    assert (-pitch[1, 2]) < 0
    assert (-yaw[0, 2]) < 0
    assert roll[1, 0] > 0


def test_what_goes_in():
    rotation = ct.head_rotation(angles(6))
    extrinsics = ct.Extrinsics.from_matrix(rotation, torch.zeros(6, 3).double())
    one = ct.Extrinsics(extrinsics.rotation[0], torch.zeros(4, 3).double())
    assert ct.head_angles(one).shape == (4, 3)
    for pose in (extrinsics, extrinsics.matrix(), rotation, [*rotation.numpy()], rotation.view(2, 3, 3, 3)):
        torch.testing.assert_close(ct.head_angles(pose).reshape(6, 3), angles(6))
    assert ct.head_angles(rotation.half()).dtype == torch.float32


def test_gradients():
    given = angles(5).requires_grad_()
    assert torch.autograd.gradcheck(lambda a: ct.head_angles(ct.head_rotation(a)), given)
    for rows in (STRAIGHT, torch.zeros(1, 3).double()):
        rotation = ct.head_rotation(rows).requires_grad_()
        ct.head_angles(rotation).sum().backward()
        assert torch.isfinite(rotation.grad).all()
