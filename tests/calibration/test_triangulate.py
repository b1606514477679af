"""triangulate: points from cameras of any models, the optimum in pixels, and its derivatives."""

import pytest
import torch

import camtorch as ct

SIZE = (960, 1280)
CAMERAS = [
    ct.KannalaBrandt.from_fov(190, image_size=SIZE, distortion=torch.tensor([0.01, -0.004, 1e-3, 0.0]).double()),
    ct.BrownConrady.from_fov(90, image_size=SIZE, distortion=torch.tensor([-0.1, 0.02, 1e-3, -5e-4]).double()),
    ct.DoubleSphere.from_fov(150, image_size=SIZE).double(),
]


def rig(seed=0, far=1.0):
    """Three cameras of different models, their poses, points, and the pixels of those that each sees."""
    g = torch.Generator().manual_seed(seed)
    cameras = [camera.requires_grad_(False) for camera in CAMERAS]
    poses = [(0.2 * torch.randn(3, generator=g).double(), torch.randn(3, generator=g).double()) for _ in cameras]
    extrinsics = [ct.Extrinsics(*pose).requires_grad_(False) for pose in poses]
    points = torch.randn(400, 3, generator=g).double() * 3 * far + torch.tensor([0.0, 0.0, 3.0])
    pixels = []
    for camera, pose in zip(cameras, extrinsics, strict=True):
        found, valid = camera.project(pose(points))
        pixels.append(torch.where((valid & camera.contains(found))[:, None], found, torch.nan))
    return cameras, extrinsics, points, torch.stack(pixels)


def rms_of(cameras, extrinsics, points, pixels):
    each = zip(cameras, extrinsics, pixels, strict=True)
    squares = [(camera.project(pose(points))[0] - seen).square().sum(-1) for camera, pose, seen in each]
    return torch.stack(squares).nanmean(0).sqrt()


def test_exact_pixels_give_the_points_and_invalid_ones_have_no_gradient():
    cameras, extrinsics, points, pixels = rig()
    found, rms, valid = ct.triangulate(cameras, extrinsics, pixels.requires_grad_())
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
    (found.sum() + rms[valid].sum()).backward()
    assert torch.isfinite(pixels.grad).all()
    assert not pixels.grad[:, ~valid].any()
    assert pixels.grad[:, valid].any()


@pytest.mark.parametrize("far", [1.0, 100.0])
def test_the_reprojection_error_is_least_wherever_the_origin_is(far):
    cameras, extrinsics, points, pixels = rig(far=far)
    pixels = pixels + torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1)).double()
    found, rms, valid = ct.triangulate(cameras, extrinsics, pixels)
    here = rms_of(cameras, extrinsics, found, pixels)
    torch.testing.assert_close(rms[valid], here[valid])
    assert (rms <= rms_of(cameras, extrinsics, points, pixels))[valid].all()
    for step in 1e-3 * torch.cat((torch.eye(3), -torch.eye(3))).double():
        assert (rms_of(cameras, extrinsics, found + step, pixels) >= rms)[valid].all()
    origin = torch.tensor([1e5, -2e5, 1e5]).double()  # as on a map, where rounding moves pixels by some 1e-8
    moved = [ct.Extrinsics(pose.rotation, pose.translation - pose.matrix()[:3, :3] @ origin) for pose in extrinsics]
    there = ct.triangulate(cameras, moved, pixels)
    assert torch.equal(there.valid, valid)
    torch.testing.assert_close(there.rms[valid], rms[valid], rtol=0, atol=1e-8)
    torch.testing.assert_close((there.points - origin)[valid], found[valid], rtol=1e-5, atol=1e-5)


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
    inputs = [w.detach().clone().requires_grad_() for w in (pixels, *camera.parameters(), *pose.parameters())]

    def located(pixels, intrinsics, distortion, rotation, translation):
        mine = [ct.KannalaBrandt(intrinsics, distortion, image_size=SIZE), *cameras[1:]]
        poses = [extrinsics[0], ct.Extrinsics(rotation, translation), extrinsics[2]]
        points, rms, valid = ct.triangulate(mine, poses, pixels)
        assert valid.all()
        return points, rms

    assert torch.autograd.gradcheck(located, inputs, rtol=1e-4, atol=1e-6, fast_mode=True)


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


# drcal (of PyPI), triangulate(method=triangulate_geometric, stabilize_coords=False): by pixels of 0.5 px
DRCAL_PIXELS = [
    [0.00052674, 0.00047649, 0.0037183],
    [0.0037082, 0.0016715, 0.023315],
    [0.0063543, 0.0065394, 0.14434],
    [0.0083197, 0.0057878, 0.57713],
    [0.01735, 0.024898, 5.1937],
]
DRCAL_PAIR = [  # a calibration by boards with noise of 0.3 px
    ([600.83848, 601.842, 320.26552, 237.42932], [-0.097139533, 0.016916749, 9.3640413e-4, -8.8323821e-4, 0.010836651]),
    ([621.51872, 620.49674, 314.6629, 244.61452], [-0.11965627, 0.012830401, -1.1375895e-3, 2.4855722e-4, 0.028466723]),
]
DRCAL_POSE = [0.010354696, 0.049334616, -0.020189797], [-0.2001096, 0.010078093, 0.0058487069]


def test_a_point_beyond_the_end_of_a_surface_is_invalid():
    wide = ct.KannalaBrandt([300.0, 300, 319.5, 239.5], [0.02, -0.01, 0.003, -0.001], image_size=(480, 640)).double()
    surface = wide.requires_grad_(False).convert("splined").camera
    angles = torch.linspace(0.5, 1.6, 1000).double()
    across = torch.stack((angles.sin(), 0 * angles, angles.cos()), -1)
    end = angles[surface.project(across)[1]][-1]
    poses = ct.Extrinsics([[0.0] * 3] * 2, [[0.0] * 3, [0.0, -0.3, 0.0]]).double().requires_grad_(False)
    for past, has_pixel in ((-0.01, True), (0.01, False)):
        at = torch.stack([3 * torch.stack((a.sin(), 0 * a, a.cos())) for a in (end - 0.002, end + past)])
        pixels = surface.project(at[0])[0], wide.project(poses[1](at[1]))[0]
        points, rms, valid = ct.triangulate([surface, wide], poses, torch.stack(pixels))
        assert bool(valid) is bool(surface.project(points)[1]) is has_pixel
        assert bool(torch.isfinite(rms)) is has_pixel


def test_derivatives_give_the_sigmas_of_drcal():
    """As the page of what left says: no point depends on the pixels of another."""
    cameras = [ct.BrownConrady(*(torch.tensor(v).double() for v in of), image_size=(480, 640)) for of in DRCAL_PAIR]
    poses = [ct.Extrinsics(*pose).double() for pose in (([0.0] * 3, [0.0] * 3), DRCAL_POSE)]
    points = torch.tensor([[0.05, 0.02, 0.8], [-0.2, 0.1, 2], [0.3, 0.2, 5], [0, 0, 10], [0.1, 0.1, 30]]).double()
    pixels = torch.stack([c.project(e(points))[0] for c, e in zip(cameras, poses, strict=True)]).detach()
    found, _, valid = ct.triangulate(cameras, poses, pixels.requires_grad_())
    assert valid.all()
    rows = [torch.autograd.grad(found[:, i].sum(), pixels, retain_graph=True)[0] for i in range(3)]
    slopes = torch.stack(rows).permute(2, 0, 1, 3).flatten(2)
    std = (0.5**2 * slopes @ slopes.mT).diagonal(dim1=-2, dim2=-1).sqrt()
    torch.testing.assert_close(std, torch.tensor(DRCAL_PIXELS).double(), rtol=0.01, atol=0)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        (lambda c, e, p: (c[:2], e, p), ValueError, "same C >= 2 cameras; got 2 cameras, 3 extrinsics"),
        (lambda c, e, p: (c[:1], e[:1], p[:1]), ValueError, "same C >= 2 cameras; got 1 cameras"),
        (lambda c, e, p: (c, e, p[..., 0]), ValueError, "pixels must be"),
        (lambda c, e, p: (e, e, p), TypeError, "cameras must be Camera"),
        (lambda c, e, p: (c, c, p), TypeError, "extrinsics must be Extrinsics"),
        (lambda c, e, p: ([ct.Pinhole(torch.ones(2, 4))] * 3, e, p), ValueError, "no batch dims"),
    ],
)
def test_bad_arguments(change, error, says):
    cameras, extrinsics, _, pixels = rig()
    with pytest.raises(error, match=rf"triangulate: .*{says}"):
        ct.triangulate(*change(cameras, extrinsics, pixels))
