"""triangulate: points from cameras of any models, the optimum in pixels, and its derivatives."""

import functools
import pickle

import cv2
import numpy as np
import pytest
import torch
from boards import chessboard
from derivatives import check_slope

import camtorch as ct
from camtorch.rotations import rotation_matrix

SIZE = (960, 1280)
CAMERAS = [
    ct.KannalaBrandt.from_fov(190, image_size=SIZE, distortion=torch.tensor([0.01, -0.004, 1e-3, 0.0]).double()),
    ct.BrownConrady.from_fov(90, image_size=SIZE, distortion=torch.tensor([-0.1, 0.02, 1e-3, -5e-4]).double()),
    ct.DoubleSphere.from_fov(150, image_size=SIZE).double(),
]


def rig(seed=0):
    """Three cameras of different models, their poses, points, and the pixels of those that each sees."""
    g = torch.Generator().manual_seed(seed)
    cameras = [camera.requires_grad_(False) for camera in CAMERAS]
    poses = [(0.2 * torch.randn(3, generator=g).double(), torch.randn(3, generator=g).double()) for _ in cameras]
    extrinsics = [ct.Extrinsics(*pose).requires_grad_(False) for pose in poses]
    points = torch.randn(400, 3, generator=g).double() * 3 + torch.tensor([0.0, 0.0, 3.0])
    pixels = []
    for camera, pose in zip(cameras, extrinsics, strict=True):
        found, valid = camera.project(pose(points))
        pixels.append(torch.where((valid & camera.contains(found))[:, None], found, torch.nan))
    return cameras, extrinsics, points, torch.stack(pixels)


def rms_of(cameras, extrinsics, points, pixels):
    each = zip(cameras, extrinsics, pixels, strict=True)
    squares = [(camera.project(pose(points))[0] - seen).square().sum(-1) for camera, pose, seen in each]
    return torch.stack(squares).nanmean(0).sqrt()


def test_exact_pixels_give_the_points():
    cameras, extrinsics, points, pixels = rig()
    found, rms, valid = ct.triangulate(cameras, extrinsics, pixels)
    twice = (~pixels.isnan().any(-1)).sum(0) >= 2
    assert 100 < int(twice.sum()) < 400
    assert torch.equal(valid, twice)
    torch.testing.assert_close(found[valid], points[valid], rtol=1e-9, atol=1e-9)
    assert rms[valid].max() < 1e-8
    assert torch.isinf(rms[~valid]).all()
    assert torch.isfinite(found).all()
    # some of them are beyond 90 degrees
    behind = torch.stack([pose(points)[:, 2] < 0 for pose in extrinsics]) & ~pixels.isnan().any(-1)
    assert (behind & valid).any()


def test_the_reprojection_error_is_least():
    cameras, extrinsics, points, pixels = rig()
    pixels = pixels + torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1)).double()
    found, rms, valid = ct.triangulate(cameras, extrinsics, pixels)
    here = rms_of(cameras, extrinsics, found, pixels)
    torch.testing.assert_close(rms[valid], here[valid])
    assert (rms <= rms_of(cameras, extrinsics, points, pixels))[valid].all()
    for step in 1e-3 * torch.cat((torch.eye(3), -torch.eye(3))).double():
        assert (rms_of(cameras, extrinsics, found + step, pixels) >= rms)[valid].all()


def test_as_opencv_for_exact_pixels_of_pinholes():
    cameras = [ct.Pinhole([700.0, 700, 640, 480]).double() for _ in range(2)]
    extrinsics = [ct.Extrinsics([0.0, 0, 0], [0.0, 0, 0]).double(), ct.Extrinsics([0.0, 0.1, 0], [-0.5, 0, 0]).double()]
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)).double() + torch.tensor([-0.5, -0.5, 2])
    pixels = [c.project(e(points))[0].detach() for c, e in zip(cameras, extrinsics, strict=True)]
    matrices = [(c.K @ e.matrix()[:3]).detach().numpy() for c, e in zip(cameras, extrinsics, strict=True)]
    theirs = cv2.triangulatePoints(*matrices, *(p.numpy().T for p in pixels))
    found, _, valid = ct.triangulate(cameras, extrinsics, [p.numpy() for p in pixels])
    assert valid.all()
    np.testing.assert_allclose(found.detach().numpy(), (theirs[:3] / theirs[3]).T, atol=1e-9)


@pytest.mark.parametrize("apart", [0.0, pytest.param(1e-3, marks=pytest.mark.slow)])
def test_parallel_and_diverging_rays_are_invalid(apart):
    camera = ct.Pinhole([700.0, 700, 640, 480]).double().requires_grad_(False)
    poses = ct.Extrinsics(torch.zeros(2, 3).double(), torch.tensor([[0.0, 0, 0], [-1, 0, 0]]).double())
    ray = torch.tensor([[0.1, 0.2, 1.0], [0.1 + apart, 0.2, 1.0]]).double()
    pixels = camera.project(ray)[0][:, None].repeat(1, 2, 1)
    pixels[1, 1, 0] -= 10.0  # and a point that is seen well
    points, rms, valid = ct.triangulate(camera, poses, pixels)
    assert valid.tolist() == [False, True]
    assert torch.isfinite(points).all()
    assert torch.isinf(rms[0])


def test_gradients_are_those_of_the_optimum():
    cameras, extrinsics, _, pixels = rig()
    seen = (~pixels.isnan().any(-1)).all(0).nonzero()[:1, 0]
    pixels = pixels[:, seen] + torch.randn(3, 1, 2, generator=torch.Generator().manual_seed(1)).double()
    camera, pose = cameras[0], extrinsics[1]
    inputs = [
        w.detach().clone().requires_grad_()
        for w in (pixels, camera.intrinsics, camera.distortion, pose.rotation, pose.translation)
    ]

    def located(pixels, intrinsics, distortion, rotation, translation):
        mine = [ct.KannalaBrandt(intrinsics, distortion, image_size=SIZE), *cameras[1:]]
        poses = [extrinsics[0], ct.Extrinsics(rotation, translation), extrinsics[2]]
        points, rms, valid = ct.triangulate(mine, poses, pixels)
        assert valid.all()
        return points, rms

    check_slope(located, inputs)


def test_invalid_points_have_no_gradient():
    cameras, extrinsics, _, pixels = rig()
    pixels.requires_grad_()
    points, rms, valid = ct.triangulate(cameras, extrinsics, pixels)
    (points.sum() + rms[valid].sum()).backward()
    gradient = pixels.grad
    assert torch.isfinite(gradient).all()
    assert not gradient[:, ~valid].any()
    assert gradient[:, valid].any()


def test_shapes():
    cameras, extrinsics, points, pixels = rig()
    expected = ct.triangulate(cameras, extrinsics, pixels)
    found = ct.triangulate(cameras, extrinsics, pixels.view(3, 20, 20, 2))
    assert found.points.shape == (20, 20, 3)
    assert found.rms.shape == found.valid.shape == (20, 20)
    torch.testing.assert_close(found.points.flatten(0, 1), expected.points)
    one = int(expected.valid.nonzero()[0, 0])
    alone = ct.triangulate(cameras, extrinsics, pixels[:, one])
    assert alone.points.shape == (3,)
    torch.testing.assert_close(alone.points, points[one])
    empty = ct.triangulate(cameras, extrinsics, pixels[:, :0])
    assert empty.points.shape == (0, 3)
    single = ct.triangulate([c.float() for c in rig()[0]], [e.float() for e in rig()[1]], pixels.float())
    assert single.points.dtype == single.rms.dtype == torch.float32
    for camera in CAMERAS:
        camera.double()


def test_one_camera_that_moves():
    camera, points = CAMERAS[0], rig()[2][:40]
    poses = ct.Extrinsics(torch.zeros(4, 3).double(), torch.randn(4, 3).double())
    pixels = torch.stack([camera.project(pose(points))[0] for pose in poses]).detach()
    for cameras, extrinsics in ((camera, poses), ([camera] * 4, list(poses))):
        found, _, valid = ct.triangulate(cameras, extrinsics, pixels)
        torch.testing.assert_close(found[valid], points[valid])
        assert valid.double().mean() > 0.9


def test_covariance_is_that_of_refits():
    """Of 500: made white by it, their products are the identity to within four standard deviations of their mean."""
    cameras, extrinsics, _, pixels = rig()
    pixels = pixels[:, (~pixels.isnan().any(-1)).sum(0) >= 2][:, :60]
    found = ct.triangulate(cameras, extrinsics, pixels, sigma=0.4)
    assert found.covariance.shape == (60, 3, 3)
    noise = 0.4 * torch.randn(3, 500, 60, 2, generator=torch.Generator().manual_seed(0)).double()
    refits = ct.triangulate(cameras, extrinsics, pixels[:, None] + noise)
    assert refits.valid.all()
    root = torch.linalg.cholesky(found.covariance)
    white = torch.linalg.solve(root, (refits.points - found.points)[..., None])[..., 0].flatten(0, 1)
    torch.testing.assert_close(
        white.mT @ white / len(white), torch.eye(3).double(), rtol=0, atol=4 * (2 / 30000) ** 0.5
    )
    # without a sigma that of the residuals
    assert float((refits.covariance / found.covariance).median()) == pytest.approx(1, rel=0.02)


def test_covariance_of_invalid_points_and_of_shapes():
    cameras, extrinsics, _, pixels = rig()
    found = ct.triangulate(cameras, extrinsics, pixels.view(3, 20, 20, 2), sigma=1)
    assert found.covariance.shape == (20, 20, 3, 3)
    assert torch.equal(found.covariance.isnan().any(-1).any(-1), ~found.valid)
    points, _, _ = found
    assert torch.equal(points, found.points)
    assert torch.equal(pickle.loads(pickle.dumps(found)).covariance.nan_to_num(), found.covariance.nan_to_num())
    with pytest.raises(ValueError, match="triangulate: sigma must be px, not negative; got -1"):
        ct.triangulate(cameras, extrinsics, pixels, sigma=-1)
    with pytest.raises(TypeError, match=r"triangulate: calibration must be what ct\.calibrate_rig returns; got str"):
        ct.triangulate(cameras, extrinsics, pixels, calibration="rig.json")


@functools.cache
def calibrated_pair():
    """A rig by boards with noise of 0.3 px."""
    generator = torch.Generator().manual_seed(0)
    numbers = (
        ([600.0, 601, 321, 238], [-0.1, 0.03, 1e-3, -5e-4, 0.01]),
        ([620.0, 619, 315, 245], [-0.12, 0.02, -1e-3, 5e-4, 0.01]),
    )
    cameras = [
        ct.BrownConrady(*(torch.tensor(v).double() for v in of), image_size=(480, 640)).requires_grad_(False)
        for of in numbers
    ]
    right = ct.Extrinsics(torch.tensor([0.01, 0.05, -0.02]).double(), torch.tensor([-0.2, 0.01, 0.005]).double())
    board = chessboard(10, 10, 0.04)
    turns = rotation_matrix(0.9 * (torch.rand(20, 3, generator=generator).double() - 0.5))
    away = (torch.rand(20, 3, generator=generator).double() - 0.5) * torch.tensor([0.5, 0.4, 0.6]).double()
    points = board @ turns.mT + (torch.tensor([0.0, 0, 1]).double() + away - turns @ board.mean(0))[:, None]
    pixels = [cameras[0].project(points)[0], cameras[1].project(right(points))[0].detach()]
    pixels = [p + 0.3 * torch.randn(p.shape, generator=generator).double() for p in pixels]
    inside = torch.stack([((p > 0) & (p < torch.tensor([639.0, 479]))).all(-1) for p in pixels]).all(0)
    pixels = [torch.where(inside[..., None], p, torch.nan) for p in pixels]
    models = dict(zip(("left", "right"), cameras, strict=True))
    sizes = dict.fromkeys(models, (480, 640))
    return ct.calibrate_rig(models, board, dict(zip(models, pixels, strict=True)), image_sizes=sizes)


# drcal (of PyPI) on the same corners, triangulate(method=triangulate_geometric, stabilize_coords=False): by
# pixels of 0.5 px, and by the calibration with its 0.29879 px
DRCAL_PIXELS = [
    [0.00052674, 0.00047649, 0.0037183],
    [0.0037082, 0.0016715, 0.023315],
    [0.0063543, 0.0065394, 0.14434],
    [0.0083197, 0.0057878, 0.57713],
    [0.01735, 0.024898, 5.1937],
]
DRCAL_CALIBRATION = [
    [0.0010227, 0.00087192, 0.00099052],
    [0.0025811, 0.0021753, 0.0026824],
    [0.0063838, 0.0054658, 0.012852],
    [0.012779, 0.010817, 0.050296],
    [0.038238, 0.032635, 0.47865],
]


@pytest.mark.parametrize("world", [False, True])
def test_sigmas_are_those_of_drcal(world):
    calibration = calibrated_pair()
    frame = ct.Extrinsics([0.1, 0.2, 0.3], [0.5, -0.2, 0.1]).double().requires_grad_(False)
    points = torch.tensor([[0.05, 0.02, 0.8], [-0.2, 0.1, 2], [0.3, 0.2, 5], [0, 0, 10], [0.1, 0.1, 30]]).double()
    cameras = [camera.detach() for camera in calibration.rig.cameras.values()]
    poses = [pose.detach() for pose in calibration.rig.extrinsics.values()]
    if world:  # the same points in another frame, and the cameras the other way round
        points, poses = frame.inverse()(points), [pose.compose(frame) for pose in poses]
        cameras, poses = cameras[::-1], poses[::-1]
    pixels = torch.stack([c.project(e(points))[0] for c, e in zip(cameras, poses, strict=True)])
    for theirs, options in (
        (DRCAL_PIXELS, {"sigma": 0.5}),
        (DRCAL_CALIBRATION, {"sigma": 0.0, "calibration": calibration}),
    ):
        found = ct.triangulate(cameras, poses, pixels, **options).covariance
        if world:
            turn = frame.matrix()[:3, :3]
            found = turn @ found @ turn.mT
        std = found.diagonal(dim1=-2, dim2=-1).sqrt()
        torch.testing.assert_close(std, torch.tensor(theirs).double(), rtol=0.01, atol=0)


def test_a_calibration_of_other_cameras_or_poses_is_refused():
    calibration = calibrated_pair()
    cameras = [camera.detach() for camera in calibration.rig.cameras.values()]
    poses = [pose.detach() for pose in calibration.rig.extrinsics.values()]
    pixels = torch.full((2, 1, 2), 300.0)
    with pytest.raises(ValueError, match=r"cameras\[1\] is none of these"):
        ct.triangulate([cameras[0], CAMERAS[1]], poses, pixels, calibration=calibration)
    with pytest.raises(ValueError, match="do not stand to each other as in"):
        ct.triangulate(cameras, [poses[0], poses[1].inverse()], pixels, calibration=calibration)


@pytest.mark.parametrize("projection", ["perspective", "latlon", "cylindrical"])
def test_range_sigma_of_a_rectified_pair(projection):
    calibration = calibrated_pair()
    (left, right), pose = calibration.rig.cameras.values(), calibration.rig.extrinsics["right"].detach()
    left, right = left.detach(), right.detach()
    pair = ct.rectify(left, right, pose, projection=projection, image_size=(24, 32))
    disparity = torch.linspace(-1, 4, 24 * 32).double().view(24, 32)
    sigma, valid = pair.range_sigma(disparity, 0.1)
    points, good = pair.disparity_to_points(disparity)
    assert torch.equal(valid, good)
    assert not sigma[~valid].any()
    near, far = (pair.disparity_to_points(disparity + step)[0].norm(dim=-1) for step in (1e-6, -1e-6))
    inner = valid & (disparity > 1e-3)
    torch.testing.assert_close(sigma[inner], (0.1 * (far - near).abs() / 2e-6)[inner], rtol=1e-5, atol=0)
    both, _ = pair.range_sigma(disparity, torch.full_like(disparity, 0.1), calibration=calibration)
    # what the calibration adds is what it adds to a triangulated point
    row, column = (int(i) for i in (inner & (points.norm(dim=-1) < 10)).nonzero()[40])
    point = points[row, column] @ pair.rotation_left
    still = ct.Extrinsics([0.0, 0, 0], [0.0, 0, 0]).double()
    pixels = torch.stack([left.project(point)[0], right.project(pose(point))[0]]).detach()
    found = ct.triangulate([left, right], [still, pose], pixels, sigma=0, calibration=calibration).covariance
    along = point / point.norm()
    added = (both.square() - sigma.square())[row, column]
    torch.testing.assert_close(added, along @ found @ along, rtol=1e-5, atol=0)
    for bad, says in ((-1.0, "not negative"), (torch.ones(3, 3), "of shape")):
        with pytest.raises(ValueError, match=f"range_sigma: sigma must be .*{says}"):
            pair.range_sigma(disparity, bad)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        (lambda c, e, p: (c[:2], e, p), ValueError, "as many cameras as extrinsics"),
        (lambda c, e, p: (c, e, p[:2]), ValueError, "as many cameras as extrinsics"),
        (lambda c, e, p: (c[:1], e[:1], p[:1]), ValueError, "two cameras at least"),
        (lambda c, e, p: (c, e, p[..., 0]), ValueError, "pixels must be"),
        (lambda c, e, p: (c, e, [p[0], p[1], p[2][:5]]), ValueError, "one shape"),
        (lambda c, e, p: (e, e, p), TypeError, "cameras must be Camera"),
        (lambda c, e, p: (c, c, p), TypeError, "extrinsics must be Extrinsics"),
        (lambda c, e, p: ([ct.Pinhole(torch.ones(2, 4))] * 3, e, p), ValueError, "no batch dims"),
    ],
)
def test_bad_arguments(change, error, says):
    cameras, extrinsics, _, pixels = rig()
    with pytest.raises(error, match=rf"triangulate: .*{says}"):
        ct.triangulate(*change(cameras, extrinsics, pixels))
