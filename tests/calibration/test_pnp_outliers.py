"""solve_pnp(threshold=...): poses among outliers, by any lens; which points they are of, and how far to trust them."""

import copy
import pickle

import pytest
import torch
from cameras import slow_unless
from test_pnp import SIZE, lens, scenes

import camtorch as ct

NOISE, THRESHOLD = 0.5, 2.5


def problems(fov, count, points, share, seed=0):
    """Noisy scenes, a share of whose points is anywhere: object points, pixels, which are outliers, exact pixels."""
    camera = lens(fov)
    target, _, _, exact = scenes(camera, fov, count, points, "space", seed)
    g = torch.Generator().manual_seed(seed)
    anywhere = torch.rand(exact.shape, generator=g).double() * torch.tensor([SIZE[1], SIZE[0]])
    outlier = torch.rand(count, points, generator=g) < share
    seen = exact + NOISE * torch.randn(exact.shape, generator=g).double()
    enough = (~outlier).sum(-1) >= 6
    seen = torch.where(outlier[..., None], anywhere, seen)
    return camera, *(w[enough] for w in (target, seen, outlier, exact))


def error(camera, pose, target, exact, outlier):
    """px, root mean square over the inliers, of the pose."""
    found, valid = camera.project(pose.extrinsics(target).detach())
    squares = torch.where(outlier | ~valid, 0.0, (found - exact).square().sum(-1))
    return (squares.sum(-1) / (~outlier).sum(-1)).sqrt()


def found_by(fov, count, points, share, seed=0):
    """Whether each pose is found, and its error over that of the pose by the inliers alone."""
    camera, target, seen, outlier, exact = problems(fov, count, points, share, seed)
    pose = ct.solve_pnp(camera, target, seen, threshold=THRESHOLD)
    known = ct.solve_pnp(camera, target, torch.where(outlier[..., None], torch.nan, seen))
    mine, best = (error(camera, p, target, exact, outlier) for p in (pose, known))
    return pose.valid & (mine < 3 * best.clamp(min=NOISE)), mine / best


MANY = 1000, (10, 60, 130, 190)
CASES = [
    *((10, (fov,), (points,), share, 1.0) for fov, points, share in ((10, 8, 0.3), (60, 30, 0.6), (190, 30, 0.6))),
    *((*MANY, (8, 12, 30, 68), 0.3, 0.99), (*MANY, (15, 20, 30, 68), 0.6, 0.99), (*MANY, (68,), 0.9, 0.95)),
]


@pytest.mark.parametrize(("problems", "fovs", "counts", "share", "least"), slow_unless(lambda c: c[0] == 10, CASES))
def test_outliers_do_not_matter(problems, fovs, counts, share, least):
    each = problems // (len(counts) * len(fovs))
    parts = [found_by(fov, each, points, share, seed) for points in counts for seed, fov in enumerate(fovs)]
    good, ratio = (torch.cat(part) for part in zip(*parts, strict=True))
    assert good.double().mean() >= least
    assert ratio.median() < 1.01
    assert ratio[good].mean() < 1.02 or problems == 10


def test_inliers_are_what_the_pose_is_of():
    camera, target, seen, outlier, _ = problems(130, 10, 20, 0.4)
    seen[0, 3] = torch.nan
    pose = ct.solve_pnp(camera, target, seen, threshold=THRESHOLD)
    assert pose.valid.all()
    assert not pose.inliers[0, 3]
    off = (camera.project(pose.extrinsics(target))[0] - seen).norm(dim=-1)
    assert torch.equal(pose.inliers, off < THRESHOLD)
    assert (pose.inliers == ~outlier).double().mean() > 0.98
    alone = ct.solve_pnp(camera, target, torch.where(pose.inliers[..., None], seen, torch.nan))
    torch.testing.assert_close(pose.extrinsics.matrix(), alone.extrinsics.matrix(), rtol=0, atol=1e-5)
    torch.testing.assert_close(pose.rms, alone.rms)
    torch.testing.assert_close(pose.covariance, alone.covariance, rtol=1e-3, atol=0)
    assert torch.equal(alone.inliers, pose.inliers)


def test_rows_are_alone_and_draws_are_always_the_same():
    camera, target, seen, *_ = problems(60, 6, 20, 0.6)
    state = torch.get_rng_state()
    whole = ct.solve_pnp(camera, target, seen, threshold=THRESHOLD)
    assert torch.equal(state, torch.get_rng_state())
    for row in range(len(seen)):
        one = ct.solve_pnp(camera, target[row], seen[row], threshold=THRESHOLD)
        torch.testing.assert_close(one.extrinsics.matrix(), whole.extrinsics[row].matrix())
        assert torch.equal(one.inliers, whole.inliers[row])


def test_compiled_rounds_are_those_of_torch(monkeypatch):
    camera, target, seen, *_ = problems(130, 6, 20, 0.6)
    seen[0, 3:] = torch.nan
    seen[1, ::3] = torch.nan
    compiled = ct.solve_pnp(camera, target, seen, threshold=THRESHOLD)
    monkeypatch.setattr("camtorch.calibration.ransac.library", lambda: None)
    pose = ct.solve_pnp(camera, target, seen, threshold=THRESHOLD)
    assert torch.equal(pose.inliers, compiled.inliers)
    assert torch.equal(pose.valid, compiled.valid)
    found = pose.extrinsics.matrix()[1:], compiled.extrinsics.matrix()[1:]
    torch.testing.assert_close(*found, rtol=0, atol=1e-6)


def test_what_does_not_agree_is_invalid():
    camera, target, seen, *_ = problems(60, 5, 12, 0.0)
    target, seen = target.clone(), seen.clone()
    seen[0] = torch.nan
    seen[1, 3:] = torch.nan
    target[2] = target[2, :, :1]  # a line
    seen[3] = torch.rand(12, 2, generator=torch.Generator().manual_seed(3)).double() * 900
    pose = ct.solve_pnp(camera, target, seen, threshold=0.1 * NOISE)
    pose_of_all = ct.solve_pnp(camera, target[4:], seen[4:], threshold=THRESHOLD)
    assert not pose.valid[:4].any()
    assert not pose.inliers[:4].any()
    assert torch.isinf(pose.rms[:4]).all()
    assert torch.isnan(pose.covariance[:4]).all()
    assert torch.isfinite(pose.extrinsics.matrix()).all()
    assert pose_of_all.valid.all()
    assert pose_of_all.inliers.all()
    assert ct.solve_pnp(camera, target[:0], seen[:0], threshold=THRESHOLD).inliers.shape == (0, 12)


def test_many_points_without_a_pose_come_to_an_end():
    camera = ct.Pinhole.from_fov(60, image_size=(480, 640)).double().requires_grad_(False)
    points = torch.rand(300, 3, dtype=torch.float64)
    pixels = 400 * torch.rand(300, 2, dtype=torch.float64)
    pose = ct.solve_pnp(camera, points, pixels, threshold=0.5)
    assert torch.isfinite(pose.extrinsics.translation).all()
    assert pose.inliers.sum() < 30


def test_a_pose_is_three_with_two_beside():
    camera, target, seen, *_ = problems(60, 3, 12, 0.0)
    pose = ct.solve_pnp(camera, target, seen)
    extrinsics, rms, valid = pose
    assert len(pose) == 3
    assert pose[0] is pose.extrinsics is extrinsics
    assert rms.shape == valid.shape == (3,)
    assert pose.inliers.all()
    assert pose.covariance.shape == (3, 6, 6)
    for again in (copy.deepcopy(pose), pickle.loads(pickle.dumps(pose))):
        assert torch.equal(again.covariance, pose.covariance)
        assert torch.equal(again.rms, rms)
    assert ct.head_angles(pose).shape == (3, 3)
    unseen = ct.solve_pnp(camera, target, seen.where(torch.arange(12)[:, None] < 3, torch.nan))
    assert torch.isnan(unseen.covariance).all()
    assert ct.solve_pnp(camera.float(), target.float(), seen.float()).covariance.dtype == torch.float32


@pytest.mark.parametrize("far", [0.0, 3.0])
def test_covariance_is_that_of_refits(far):
    camera, target, _, _, exact = problems(130, 1, 12, 0.0)
    target = target + far
    truth = ct.solve_pnp(camera, target, exact).extrinsics.matrix()[0]
    seen = exact + NOISE * torch.randn(2000, 12, 2).double()
    pose = ct.solve_pnp(camera, target, seen)
    found = pose.extrinsics.matrix()
    w = ct.Extrinsics.from_matrix(found[:, :3, :3] @ truth[:3, :3].mT, torch.zeros(2000, 3).double()).rotation
    moved = torch.cat((w, found[:, :3, 3] - truth[:3, 3]), -1).detach()
    # lengths along the axes of what is expected: 1
    root = torch.linalg.cholesky(pose.covariance.mean(0))
    spread = torch.linalg.solve_triangular(root, moved.mT, upper=False).std(-1)
    assert ((spread > 0.93) & (spread < 1.07)).all()


def test_gradients_are_those_of_the_inliers():
    camera, target, seen, *_ = problems(60, 2, 20, 0.4)
    grads = []
    for hidden in (False, True):
        pixels = seen.clone().requires_grad_()
        pose = ct.solve_pnp(camera, target, pixels, threshold=THRESHOLD)
        if hidden:
            pose = ct.solve_pnp(camera, target, pixels, weights=pose.inliers.double())
        (pose.extrinsics.matrix().sum() + pose.rms.sum()).backward()
        grads.append(pixels.grad)
    torch.testing.assert_close(*grads, rtol=1e-4, atol=1e-6)
    assert not grads[0][~pose.inliers].any()
