"""solve_pnp: poses of objects by any lens, at any angle, from no start; the optimum, and its derivatives."""

import math
from itertools import product

import cv2
import numpy as np
import pytest
import torch
from cameras import slow_unless

import camtorch as ct
from camtorch.poses.rotations import rotation_matrix

SIZE = (960, 1280)


def lens(fov):
    """A camera of that field of view in degrees; beyond 100 a fisheye."""
    k = [-0.1, 0.02, 1e-3, -5e-4] if fov <= 100 else [0.01, -0.004, 1e-3, 0]
    model = ct.BrownConrady if fov <= 100 else ct.KannalaBrandt
    return model.from_fov(fov, image_size=SIZE, distortion=torch.tensor(k).double()).double().requires_grad_(False)


def scenes(camera, fov, count, points, kind, seed=0):
    """Objects anywhere in the image: points (B, N, 3), poses (rotation, t) and the pixels they have."""
    g = torch.Generator().manual_seed(seed)
    parts = []
    while sum(len(part[0]) for part in parts) < count:
        many = 4 * count
        target = torch.rand(many, points, 3, generator=g).double() * 2 - 1
        target = target * torch.tensor([1.0, 1.0, 0.0 if kind == "planar" else 1.0])
        at = torch.rand(many, 2, generator=g).double() * torch.tensor([SIZE[1], SIZE[0]])
        sight, valid = camera.unproject(at)
        half = math.radians(fov) / 2 * 10 ** (-torch.rand(many, 1, generator=g).double())
        t = sight * 1.5 / torch.tan(half.clamp(max=1.2))
        axis = torch.nn.functional.normalize(torch.randn(many, 3, generator=g).double(), dim=-1)
        rotation = rotation_matrix(axis * math.pi * torch.rand(many, 1, generator=g).double())
        pixels, seen = camera.project(target @ rotation.mT + t[:, None])
        ok = valid & (seen & camera.contains(pixels)).all(-1)
        if kind == "planar":
            ok &= (rotation[..., 2] * sight).sum(-1).abs() > math.cos(math.radians(75))
        parts.append([w[ok] for w in (target, rotation, t, pixels)])
    return [torch.cat(w)[:count] for w in zip(*parts, strict=True)]


def rms_of(camera, extrinsics, target, pixels):
    found, valid = camera.project(extrinsics(target))
    assert valid.all()
    return (found - pixels).square().sum(-1).mean(-1).sqrt()


@pytest.mark.parametrize(
    ("fov", "kind"),
    slow_unless({(60, "planar"), (190, "space")}.__contains__, list(product((10, 60, 130, 190), ("planar", "space")))),
)
def test_exact_pixels_give_the_pose(fov, kind):
    camera = lens(fov)
    for points in (4, 5, 20):
        target, rotation, t, pixels = scenes(camera, fov, 20, points, kind)
        extrinsics, rms, valid = ct.solve_pnp(camera, target, pixels)
        assert valid.all()
        assert rms.max() < 1e-8
        # of four points another pose may explain the pixels as well
        found = extrinsics.matrix()
        right = (found[:, :3, :3] - rotation).abs().amax((-1, -2)) < 1e-6
        assert right.double().mean() > (0.9 if points < 6 else 0.99)
        torch.testing.assert_close(found[right, :3, 3], t[right], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", ["planar", "space"])
def test_pixels_that_are_nearly_exact_have_an_optimum(kind):
    """Where rounding hides what is left to gain, the search has ended."""
    camera = lens(60).resize(9600, 12800)
    target, _, _, pixels = scenes(lens(60), 60, 100, 10, kind)
    target, pixels = target.repeat(13, 1, 1), (10 * pixels + 4.5).repeat(13, 1, 1)
    noise = torch.logspace(-12, -6, 13, dtype=torch.float64).repeat_interleave(100)[:, None, None]
    pixels = pixels + noise * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(2)).double()
    pose = ct.solve_pnp(camera, target, pixels)
    assert pose.valid.all()
    assert bool((pose.rms < 5 * noise[:, 0, 0] + 1e-9).all())


def attempts(camera, fov, count, points, kind, noise, seed):
    """Whether noisy pixels are explained at least as well as by the true pose."""
    target, rotation, t, pixels = scenes(camera, fov, count, points, kind, seed)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(seed)).double()
    with torch.no_grad():
        found, rms, valid = ct.solve_pnp(camera, target, pixels)
        torch.testing.assert_close(rms_of(camera, found, target, pixels)[valid], rms[valid])
        near_truth = rms_of(camera, ct.Extrinsics.from_matrix(rotation, t), target, pixels)
    return valid & (rms <= near_truth + 1e-8)


MANY = 100, (4, 5, 8, 50), (0.0, 0.1, 1.0)


@pytest.mark.parametrize(
    ("fovs", "kind", "count", "points", "noises"),
    [
        ((10, 190), "planar", 12, (4, 12), (0.5,)),
        pytest.param((10,), "space", *MANY, marks=pytest.mark.slow),
        pytest.param((190,), "planar", *MANY, marks=pytest.mark.slow),
    ],
)
def test_poses_end_in_the_optimum(fovs, kind, count, points, noises):
    cases = product(fovs, points, noises)
    good = [attempts(lens(fov), fov, count, some, kind, noise, some) for fov, some, noise in cases]
    assert torch.cat(good).double().mean() > 0.998


def opencvs_rms(points, seen, matrix, k, *start):
    """What OpenCV's local search makes of a start."""
    r, t = cv2.solvePnPRefineLM(points, seen, matrix, k, *start)
    return np.sqrt(np.mean(np.sum((cv2.projectPoints(points, r, t, matrix, k)[0][:, 0] - seen) ** 2, -1)))


@pytest.mark.parametrize("kind", ["planar", "space"])
def test_the_cost_is_opencvs_or_less(kind):
    camera = lens(60)
    target, _, _, pixels = scenes(camera, 60, 30, 8, kind)
    pixels = pixels + 0.5 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1)).double()
    _, rms, valid = ct.solve_pnp(camera, target, pixels)
    assert valid.all()
    for row in range(len(target)):
        points, seen = target[row].numpy(), pixels[row].numpy()
        lens_of = camera.K.numpy(), camera.distortion.numpy()
        start = cv2.solvePnP(points, seen, *lens_of, flags=cv2.SOLVEPNP_SQPNP)[1:]
        assert rms[row] <= opencvs_rms(points, seen, *lens_of, *start) * (1 + 1e-6)


@pytest.mark.parametrize(
    ("fov", "size", "points", "noise"),
    [(10, 0.9, 4, 0.3), (60, 0.05, 4, 2), (60, 0.05, 6, 2), (60, 0.05, 9, 2), (60, 0.05, 70, 2)],
)
def test_the_better_of_a_planes_two_minima_is_returned(fov, size, points, noise):
    """Far away, from where both explain a plane nearly as well; of much noise they may begin alike, or end slowly."""
    camera, g = lens(fov), torch.Generator().manual_seed(0)
    target = torch.zeros(200, points, 3).double()
    target[..., :2] = size * (2 * torch.rand(200, points, 2, generator=g) - 1)
    turn = rotation_matrix(0.6 * torch.randn(200, 3, generator=g).double())
    pixels = camera.project(target @ turn.mT + torch.tensor([0.05, 0.02, 0.9]) * 600 / fov)[0]
    pixels = pixels + noise * torch.randn(pixels.shape, generator=g).double()
    found, rms, valid = ct.solve_pnp(camera, target, pixels)
    assert valid.all()
    # the mirror image of what was found, and what a local search makes of it
    sight = torch.nn.functional.normalize(found.translation, dim=-1)
    flip = torch.eye(3) - 2 * sight[:, :, None] * sight[:, None]
    other = flip @ found.matrix()[:, :3, :3] @ torch.diag(torch.tensor([1.0, 1, -1])).double()
    better = 0
    for row, start in product(range(len(pixels)), (turn, other)):
        vector = cv2.Rodrigues(start[row].numpy())[0]
        given = target[row].numpy(), pixels[row].numpy(), camera.K.numpy(), camera.distortion.numpy()
        theirs = opencvs_rms(*given, vector, found.translation[row].numpy()[:, None].copy())
        assert rms[row] <= theirs * (1 + 1e-5)
        better += bool(rms[row] < theirs * 0.999)
    assert better >= 20


FOUR = [  # in a camera's frame; from two starts none of them ended in the pose
    ("pinhole", 600, [], "-0.09 -0.92 6.41 0.84 1.76 5.23 -1.57 2.1 5.99 -0.89 -0.54 6.31"),
    ("brown_conrady", 500, [-0.2, 0.05, 1e-3, -5e-4], "0.46 1.8 4.99 0.02 -0.37 5.24 -0.3 0.56 4.96 -1.19 0.69 4.24"),
    ("kannala_brandt", 200, [0.02, -0.01, 3e-3, -1e-3], "2.74 3.4 7.32 1.74 5.53 5.18 1.16 4.62 6.98 -0.58 4.59 7.64"),
    ("double_sphere", 200, [-0.2, 0.6], "-1.09 -1.71 2.69 -0.33 -1.39 3.78 0.14 -1.47 3.92 -1.02 0.82 4.66"),
]


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize(("model", "focal", "distortion", "seen"), FOUR)
def test_four_exact_points_end_in_the_pose(model, focal, distortion, seen, compiled, monkeypatch):
    if not compiled:
        monkeypatch.setattr("camtorch.calibration.pnp._solve_compiled", lambda given, threshold: None)
        monkeypatch.setattr("camtorch.calibration.rays.library", lambda: None)
    numbers = [focal, focal, 319.5, 239.5], *[distortion] * bool(distortion)
    camera = ct.MODELS[model](*numbers, image_size=(480, 640)).double().requires_grad_(False)
    points = torch.tensor([float(number) for number in seen.split()]).double().view(4, 3)
    assert ct.solve_pnp(camera, points - points.mean(0).round(decimals=1), camera.project(points)[0]).rms < 1e-6


def test_gradients_are_those_of_the_optimum():
    camera = lens(130)
    target, _, _, pixels = scenes(camera, 130, 1, 5, "planar")
    pixels = pixels + 2 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1)).double()
    weights = torch.rand(1, 5, generator=torch.Generator().manual_seed(2)).double() + 0.5
    inputs = [w.clone().requires_grad_() for w in (target, pixels, weights, camera.intrinsics, camera.distortion)]

    def pose(target, pixels, weights, intrinsics, distortion):
        camera = ct.KannalaBrandt(intrinsics, distortion, image_size=SIZE)
        found, rms, valid = ct.solve_pnp(camera, target, pixels, weights=weights)
        assert valid.all()
        return found.rotation, found.translation, rms

    assert torch.autograd.gradcheck(pose, inputs, rtol=1e-4, atol=1e-6, fast_mode=True)


def test_what_is_unseen_does_not_matter():
    camera = lens(190)
    target, _, _, pixels = scenes(camera, 190, 5, 9, "space")
    pixels = pixels + 0.5 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1)).double()
    expected = ct.solve_pnp(camera, target[:, :6], pixels[:, :6])
    hidden = torch.arange(9) >= 6
    blind = torch.tensor([1e5, 1e5]).double()
    assert not camera.unproject(blind)[1]
    for found in (
        ct.solve_pnp(camera, target, torch.where(hidden[:, None], torch.nan, pixels)),
        ct.solve_pnp(camera, target, torch.where(hidden[:, None], blind, pixels)),
        ct.solve_pnp(camera, target, pixels, weights=1.0 - hidden.double()),
        ct.solve_pnp(camera, torch.where(hidden[:, None], torch.inf, target), pixels),
    ):
        torch.testing.assert_close(found.extrinsics.matrix(), expected.extrinsics.matrix())
        torch.testing.assert_close(found.rms, expected.rms)


def test_bad_rows_are_invalid_and_leave_the_others_alone():
    camera = lens(60)
    target, _, _, pixels = scenes(camera, 60, 6, 6, "planar")
    expected = ct.solve_pnp(camera, target, pixels)
    target, pixels = target.clone(), pixels.clone()
    pixels[0, 3:] = torch.nan  # three points
    target[1] = target[1, :, :1]  # a line
    target[2] = torch.inf
    pixels[3] = pixels[3, :1]  # one pixel
    target[4] = 1e200  # too large to be squared
    target.requires_grad_(), pixels.requires_grad_()
    extrinsics, rms, valid = ct.solve_pnp(camera, target, pixels)
    assert not valid[[0, 1, 2, 4]].any()
    assert valid[5]
    assert torch.isinf(rms[[0, 1, 2, 4]]).all()
    torch.testing.assert_close(extrinsics.matrix()[5], expected.extrinsics.matrix()[5])
    assert torch.isfinite(extrinsics.matrix()).all()
    (extrinsics.matrix().sum() + rms[valid].sum()).backward()
    for given in (target, pixels):
        assert torch.isfinite(given.grad).all()
        assert not given.grad[[0, 1, 2, 4]].any()
        assert given.grad[5].any()


def test_objects_far_from_their_origin():
    """Of coordinates of a map, whose rounding is a hundredth of a micrometre."""
    camera = lens(60)
    target, rotation, _, pixels = scenes(camera, 60, 6, 6, "space")
    moved = target + torch.tensor([4e5, 5e6, 300.0])
    expected = ct.solve_pnp(camera, target, pixels)
    found = ct.solve_pnp(camera, moved, pixels)
    assert found.valid.all()
    torch.testing.assert_close(rotation_matrix(found.extrinsics.rotation), rotation, rtol=0, atol=1e-7)
    torch.testing.assert_close(found.extrinsics(moved), expected.extrinsics(target), rtol=0, atol=1e-7)


def test_shapes():
    camera = lens(60)
    target, _, _, pixels = scenes(camera, 60, 3, 6, "space")
    one = ct.solve_pnp(camera, target[0], pixels[0])
    assert one.extrinsics.batch_shape == one.rms.shape == one.valid.shape == ()
    assert isinstance(one.extrinsics.rotation, torch.nn.Parameter)
    columns = pixels[0].numpy()[:, None]
    for points in (target[0].numpy(), target[0].numpy()[:, None], target[0].numpy()[None], target[0].tolist()):
        for seen in (columns, pixels[0].tolist()):
            found = ct.solve_pnp(camera, points, seen).extrinsics.matrix().reshape(4, 4)
            torch.testing.assert_close(found, one.extrinsics.matrix(), rtol=0, atol=1e-4)
    several = ct.solve_pnp(camera, [x.numpy() for x in target], [p.numpy()[:, None] for p in pixels])
    assert several.extrinsics.batch_shape == (3,)
    torch.testing.assert_close(several.extrinsics[0].matrix(), one.extrinsics.matrix())
    shared = ct.solve_pnp(camera, target[0], pixels[:1].expand(2, 5, 6, 2))
    assert shared.extrinsics.batch_shape == (2, 5)
    cameras = ct.BrownConrady(camera.intrinsics.repeat(3, 1), camera.distortion.repeat(3, 1))
    found = ct.solve_pnp(cameras, target, pixels).extrinsics.matrix()
    torch.testing.assert_close(found, several.extrinsics.matrix(), rtol=1e-6, atol=1e-6)
    assert ct.solve_pnp(ct.Pinhole(camera.intrinsics.repeat(3, 1)), target, pixels).rms.shape == (3,)
    empty = ct.solve_pnp(camera, target[:0], pixels[:0])
    assert empty.extrinsics.batch_shape == empty.rms.shape == (0,)
    assert not ct.solve_pnp(camera, target, pixels * torch.nan).valid.any()
    single = ct.solve_pnp(camera.float(), target.float(), pixels.float())
    assert single.rms.dtype == single.extrinsics.translation.dtype == torch.float32


SIX, SEEN, LENS = torch.rand(6, 3), torch.rand(6, 2), lens(60)
BAD = [
    ((None, SIX, SEEN), {}, "camera must be a camera"),
    ((LENS, SIX, SIX), {}, "pixels must be"),
    ((LENS, SEEN, SEEN), {}, "object_points must be"),
    ((LENS, SIX, SEEN[:5]), {}, "must be as many points, 4 or more"),
    ((LENS, SIX[:3], SEEN[:3]), {}, "4 or more"),
    ((LENS, SIX.expand(2, 6, 3), SEEN.expand(3, 6, 2)), {}, "batch dims must broadcast"),
    ((LENS, "points", SEEN), {}, "object_points must be"),
    ((LENS, SIX, SEEN), {"weights": -torch.ones(6)}, "weights must be .*, and not negative"),
    ((LENS, SIX, SEEN), {"weights": torch.ones(5)}, "weights must be"),
    ((LENS, SIX, SEEN), {"threshold": 0}, "threshold must be positive"),
    ((LENS, SIX, SEEN), {"threshold": -1.0}, "threshold must be positive"),
    ((LENS, SIX, SEEN), {"threshold": "2 px"}, "threshold"),
]


@pytest.mark.parametrize(("arguments", "options", "says"), BAD)
def test_bad_arguments(arguments, options, says):
    is_kind = arguments[0] is None or isinstance(arguments[1], str) or "2 px" in options.values()
    with pytest.raises(TypeError if is_kind else ValueError, match=rf"solve_pnp: .*{says}"):
        ct.solve_pnp(*arguments, **options)
