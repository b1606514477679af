"""What OpenCV's calibrations hand out is taken for what it is, whatever its shape, or refused with a hint."""

import itertools

import numpy as np
import pytest
import torch

import camtorch as ct

NUMBERS = [300.0, 310.0, 319.5, 239.5]
R, QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), [0.0, 0.0, np.pi / 2]
RVEC, TVEC = np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, 3.0])
K = np.array([[300.0, 0.0, 319.5], [0.0, 310.0, 239.5], [0.0, 0.0, 1.0]])
FISHEYE = np.array([0.01, -0.002, 0.0003, -0.0004])
LENSES = [(ct.KannalaBrandt, 4), *((ct.BrownConrady, count) for count in (4, 5, 14)), (ct.Mei, 5), (ct.FTheta, 3)]
LENSES += [(ct.UCM, 1), (ct.EUCM, 2)]
lenses = pytest.mark.parametrize(("model", "count"), LENSES)


def coefficients(count):
    return 0.5 + 0.01 * np.arange(count) if count < 3 else 0.01 * np.arange(1.0, count + 1) ** -2


@lenses
@pytest.mark.parametrize("as_tensor", [np.asarray, torch.as_tensor, np.ndarray.tolist])
def test_coefficients_beside_a_matrix_are_one_camera(model, count, as_tensor):
    D = coefficients(count)  # noqa: N806
    for shaped in (D, D.reshape(count, 1), D.reshape(1, count)):
        camera = model.from_matrix(K, as_tensor(shaped), image_size=(480, 640))
        assert camera.batch_shape == ()
        assert camera.distortion.tolist() == pytest.approx(D.tolist(), rel=1e-7)
        assert camera.intrinsics.tolist() == NUMBERS


@lenses
def test_a_column_of_coefficients_elsewhere_is_refused(model, count):
    if count == 1:
        pytest.skip("one coefficient is no column")
    column = coefficients(count).reshape(count, 1)
    for wrong in (
        lambda: model(NUMBERS, column),
        lambda: model(torch.tensor([NUMBERS]), column),
        lambda: model.from_matrix(K[None], column),
        lambda: model.from_matrix(np.stack([K] * count), column),
    ):
        with pytest.raises(ValueError, match=rf"{model.__name__}: distortion.*\({count}, 1\).*distortion\[\.\.\., 0\]"):
            wrong()


POSE, MATRIX, KB = ct.Extrinsics, ct.KannalaBrandt.from_matrix, FISHEYE.reshape(1, 4)
THREE, ONES, ROW = torch.tensor([NUMBERS] * 3), torch.full((3, 1), 0.1), torch.zeros(1, 3)
VECTORS, T = [np.full((1, 3), 0.1 * i) for i in range(4)], torch.tensor
SHAPES = [
    *((lambda model=model: model(THREE, ONES), (3,)) for model in (ct.UCM, ct.FOV, ct.KannalaBrandt)),
    *((lambda model=model: model(THREE, ONES, image_size=(480, 640)).hflip(), (3,)) for model in (ct.UCM, ct.FOV)),
    (lambda: ct.UCM.from_matrix(np.stack([K] * 3), ONES), (3,)),
    (lambda: ct.UCM(NUMBERS, ONES), (3,)),
    (lambda: MATRIX(K, torch.zeros(3, 4)), (3,)),
    (lambda: MATRIX(K[None], torch.zeros(1, 4)), (1,)),
    (lambda: MATRIX(np.stack([K, K]), np.stack([KB, KB])), (2,)),
    (lambda: MATRIX([K, K], [KB, KB]), (2,)),
    *((lambda shape=shape: MATRIX(K, KB.reshape(shape)), ()) for shape in ((4, 1, 1), (1, 1, 4))),
    (lambda: POSE(ROW, ROW), (1,)),
    (lambda: POSE(ROW[..., None], ROW), (1,)),
    (lambda: POSE(ROW.mT, ROW.mT), ()),
    (lambda: POSE(VECTORS, VECTORS), (4,)),
    (lambda: POSE(np.stack([R, R]), np.zeros((2, 1, 3))), (2,)),
    # three vectors are no rotation matrix
    (lambda: POSE(torch.rand(3, 3, 1), torch.rand(3, 3)), (3,)),
    (lambda: POSE(torch.rand(3, 3, 1), torch.rand(3)), (3,)),
    (lambda: POSE(T(R)[..., None], torch.rand(3, 3)), (3,)),
    (lambda: POSE.from_matrix([np.eye(4), np.eye(4)]), (2,)),
    (lambda: POSE.from_matrix(np.eye(4).tolist()), ()),
]


@pytest.mark.parametrize(("make", "batch_shape"), SHAPES)
def test_what_is_a_batch_and_what_is_one(make, batch_shape):
    assert make().batch_shape == batch_shape


def test_arrays_of_one_pose_and_of_views_of_a_calibration():
    for shape, other in itertools.product([(3,), (3, 1), (1, 3)], repeat=2):
        extrinsics, turned = POSE(RVEC.reshape(shape), TVEC.reshape(other)), POSE(R, TVEC.reshape(other))
        assert extrinsics.rotation.tolist() == RVEC.tolist()
        assert extrinsics.translation.tolist() == turned.translation.tolist() == TVEC.tolist()
        assert turned.rotation.tolist() == pytest.approx(QUARTER)
    rvecs, tvecs = (tuple(v.reshape(3, 1) * (1 + i) for i in range(3)) for v in (RVEC, TVEC))
    for convert in (tuple, list, np.array, lambda v: T(np.array(v))):
        extrinsics = POSE(convert(rvecs), convert(tvecs))
        assert extrinsics.batch_shape == (3,)
        torch.testing.assert_close(extrinsics.rotation[2].detach(), T(3 * RVEC))
        torch.testing.assert_close(extrinsics.translation[2].detach(), T(3 * TVEC))


@pytest.mark.parametrize("batch", [(), (1,), (2,), (3,), (5,), (2, 3)])
def test_a_rotation_matrix_is_no_three_vectors(batch):
    turn, move = T(R).expand(*batch, 3, 3), T(TVEC).expand(*batch, 3)
    both = (POSE.from_matrix(*given) for given in (((turn, move),), ([turn, move],), (turn, move)))
    for made in (POSE(turn, move), POSE(turn, TVEC), *both):
        assert made.batch_shape == batch
        matrix = made.matrix()
        torch.testing.assert_close(matrix[..., :3, :3].detach(), turn)
        torch.testing.assert_close(matrix[..., :3, 3].detach(), move)
    vectors = torch.rand(3, 3)
    assert torch.equal(POSE(vectors, vectors).rotation, vectors)
    predicted = POSE(T(RVEC), [0.0, 0, 0]).matrix()[:3, :3].detach().requires_grad_()
    POSE(predicted, torch.zeros(3))(torch.ones(3)).sum().backward()
    assert predicted.grad.any()


def test_arrays_of_any_layout_are_numbers():
    locked = FISHEYE[::-1]
    locked.setflags(write=False)
    for dtype in (">f8", np.longdouble):
        assert MATRIX(K.astype(dtype), locked).distortion.tolist() == locked.tolist()
