"""Laws of the rigid pose."""

import copy
import math

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

import camtorch as ct
from camtorch.poses.rotations import are_rotations, nearest_rotation, rotation_matrix

F64 = torch.float64
ROTATIONS = {
    "zero": [0.0, 0.0, 0.0],
    "tiny": [1e-12, -2e-12, 1e-13],
    "small": [1e-3, 2e-3, -5e-4],
    "series edge": [0.06, -0.05, 0.063],  # angle 0.1, where the series ends
    "some": [0.4, -0.3, 0.9],
    "half turn": [math.pi, 0.0, 0.0],
    "nearly half a turn": [0.0, math.pi - 1e-9, 0.0],
}


def pose(rotation, translation=(0.3, -0.2, 1.5)):
    return ct.Extrinsics(torch.tensor(rotation, dtype=F64), torch.tensor(translation, dtype=F64))


@pytest.mark.parametrize("rotation", ROTATIONS.values(), ids=ROTATIONS)
def test_rotation_is_the_matrix_exponential_and_back(rotation):
    x, y, z = rotation
    generator = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=F64)
    matrix = pose(rotation).matrix()
    torch.testing.assert_close(matrix[:3, :3], torch.linalg.matrix_exp(generator), atol=4e-15, rtol=0)
    assert matrix[3].tolist() == [0, 0, 0, 1]
    assert matrix[:3, 3].tolist() == [0.3, -0.2, 1.5]
    again = ct.Extrinsics.from_matrix(matrix * (1 - 2e-16))  # as an inverse rounds the last row
    torch.testing.assert_close(again.matrix(), matrix, atol=1e-12, rtol=0)
    torch.testing.assert_close(ct.Extrinsics.from_matrix(matrix[:3]).matrix(), again.matrix())


def test_inverse_compose_position_and_points():
    a, b = pose(ROTATIONS["some"]), pose([-1.2, 0.3, 0.1], (1.0, 2.0, -0.5))
    points = torch.randn(5, 4, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(a.compose(b)(points), a(b(points)))
    torch.testing.assert_close(a.inverse()(a(points)), points)
    torch.testing.assert_close(a(a.position), torch.zeros(3, dtype=F64))
    matrix = a.matrix()
    torch.testing.assert_close(a(points), points @ matrix[:3, :3].T + matrix[:3, 3])


@pytest.mark.parametrize("rotation", ROTATIONS.values(), ids=ROTATIONS)
def test_derivatives_also_at_zero_rotation(rotation):
    points = torch.randn(3, 3, dtype=F64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    inputs = tuple(torch.tensor(v, dtype=F64, requires_grad=True) for v in (rotation, (0.3, -0.2, 1.5)))

    def transform(r, t, p):
        return ct.Extrinsics(r, t)(p)

    assert gradcheck(transform, (*inputs, points))
    assert gradgradcheck(transform, (*inputs, points), fast_mode=True)


def test_composition_at_the_identity_has_finite_gradients():
    zero = pose(ROTATIONS["zero"])
    zero.compose(zero).rotation.sum().backward()
    torch.testing.assert_close(zero.rotation.grad, torch.full((3,), 2.0, dtype=F64))


@pytest.mark.parametrize("point_dims", [(), (4,), (2, 3)])
def test_batch_equals_loop(point_dims):
    points = torch.randn(6, *point_dims, 3, dtype=F64)
    batch = ct.Extrinsics(*torch.randn(2, 6, 3, dtype=F64))
    for i, single in enumerate(batch):
        torch.testing.assert_close(batch(points)[i], single(points[i]))
        torch.testing.assert_close(batch.inverse().matrix()[i], single.inverse().matrix())
        torch.testing.assert_close(batch.compose(batch).matrix()[i], single.compose(single).matrix())


def test_a_point_that_is_not_finite_leaves_the_gradient_of_the_pose_alone():
    layer = torch.nn.Sequential(pose(ROTATIONS["some"]), ct.Pinhole([300.0, 300.0, 320.0, 240.0]).double())
    points = torch.rand(4, 3, dtype=F64)
    layer(points[1:])[0].sum().backward()
    expected = layer[0].rotation.grad.clone()
    layer.zero_grad()
    points[0, 1] = math.nan
    pixels, valid = layer(points)
    pixels.sum().backward()
    assert valid.tolist() == [False, True, True, True]
    torch.testing.assert_close(layer[0].rotation.grad, expected)


def test_a_shared_parameter_stays_one_and_what_comes_of_a_frozen_pose_is_frozen():
    rotation, translation = torch.rand(4, 3), torch.nn.Parameter(torch.zeros(3))
    extrinsics = ct.Extrinsics(rotation, translation)
    assert extrinsics.translation is translation
    extrinsics(torch.rand(4, 2, 3)).sum().backward()
    torch.testing.assert_close(translation.grad, torch.full((3,), 8.0))
    assert extrinsics.matrix().shape == (4, 4, 4)
    frozen = pose(ROTATIONS["some"]).requires_grad_(False)
    for derived in (frozen.position, *frozen.inverse().parameters(), *frozen.compose(frozen).parameters()):
        assert not derived.requires_grad
    assert pose(ROTATIONS["some"]).position.requires_grad


def test_what_learnt_large_angles_is_not_refused(tmp_path):
    ct.Extrinsics([0.0, 2 * math.pi, 0.0], [0.0, 0.0, 0.0])
    pose = ct.Extrinsics([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])
    with torch.no_grad():
        pose.rotation += 20
    for one in (pose, copy.deepcopy(pose).requires_grad_(False)):
        torch.testing.assert_close(one.inverse().matrix() @ one.matrix(), torch.eye(4), atol=1e-5, rtol=0)
        assert one.inverse().rotation.requires_grad == one.rotation.requires_grad
        one.compose(one)
    ct.save(ct.Rig({"a": ct.Pinhole.from_fov(90, image_size=(48, 64))}, {"a": pose}), tmp_path / "rig.json")
    assert torch.equal(ct.load(tmp_path / "rig.json").extrinsics["a"].rotation, pose.rotation.double())


STRAIGHT = torch.tensor([[math.pi / 2, 0.4, 0.0], [-math.pi / 2, -2.0, 0.0]], dtype=torch.float64)


def angles(count=200):
    drawn = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)).double() * 2 - 1
    return drawn * torch.tensor([math.pi / 2, math.pi, math.pi]) * 0.999


def by_axes(pitch, yaw, roll):
    """Ry(yaw) Rx(-pitch) Rz(roll)."""
    vectors = torch.diag(torch.tensor([-pitch, yaw, roll], dtype=F64))
    x, y, z = torch.linalg.matrix_exp(torch.linalg.cross(vectors[:, None], torch.eye(3, dtype=F64)[None]).mT)
    return y @ x @ z


def test_turns_are_those_about_the_axes():
    given = torch.cat((angles(), STRAIGHT))
    expected = torch.stack([by_axes(*row) for row in given.tolist()])
    torch.testing.assert_close(ct.head_rotation(given), expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(ct.head_angles(expected), given, rtol=0, atol=1e-12)
    assert not ct.head_angles(torch.eye(3)).any()


def test_the_nose_has_the_angles_of_a_gaze():
    rotation = ct.head_rotation(angles())
    assert torch.allclose(ct.augment.to_pitch_yaw(-rotation[..., 2]), ct.head_angles(rotation)[:, :2])


def test_what_goes_in():
    rotation = ct.head_rotation(angles(6))
    extrinsics = ct.Extrinsics.from_matrix(rotation, torch.zeros(6, 3).double())
    one = ct.Extrinsics(extrinsics.rotation[0], torch.zeros(4, 3).double())
    assert ct.head_angles(one).shape == (4, 3)
    for pose in (extrinsics, extrinsics.matrix(), rotation, [*rotation.numpy()], rotation.view(2, 3, 3, 3)):
        torch.testing.assert_close(ct.head_angles(pose).reshape(6, 3), angles(6))
    assert ct.head_angles(rotation.half()).dtype == torch.float32


def test_gradients_of_angles():
    given = angles(5).requires_grad_()
    assert torch.autograd.gradcheck(lambda a: ct.head_angles(ct.head_rotation(a)), given)
    for rows in (STRAIGHT, torch.zeros(1, 3).double()):
        rotation = ct.head_rotation(rows).requires_grad_()
        ct.head_angles(rotation).sum().backward()
        assert torch.isfinite(rotation.grad).all()


def test_no_rotation_is_nearer_than_the_nearest():
    """Of any matrix, also of those that mirror."""
    matrices = torch.randn(40, 3, 3, dtype=torch.float64)
    found = nearest_rotation(matrices)
    assert are_rotations(found).all()
    others = rotation_matrix(3 * torch.randn(5000, 1, 3, dtype=torch.float64))
    off, least = ((matrices - turned).square().sum((-1, -2)) for turned in (found, others))
    assert (off <= least.amin(0)).all()
    assert bool((torch.linalg.det(matrices) < 0).any())
