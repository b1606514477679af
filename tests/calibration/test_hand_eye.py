"""calibrate_hand_eye: a camera on a robot's hand, or beside the robot, is found where it is, with how sure that is."""

import math

import numpy as np
import pytest
import torch
from boards import seen_by
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import camtorch as ct

SIZE = (480, 640)
NUMBERS = [600.0, 602.0, 321.0, 238.0], [-0.1, 0.02, 1e-3, -5e-4, 0.0]
CAMERA = ct.BrownConrady(*(torch.tensor(v).double() for v in NUMBERS), image_size=SIZE).requires_grad_(False)
EYES = ("in_hand", "to_hand")
NAMES = ("wx", "wy", "wz", "tx", "ty", "tz")


def made(eye, views=8, noise=0.0, seed=0):
    """Corners, the poses that are looked for, and base from hand, (V, 4, 4)."""
    corners, turns, shifts = seen_by(CAMERA, views, noise=noise, seed=seed, near=0.2, far=0.45)
    boards = torch.eye(4).double().repeat(views, 1, 1)
    boards[:, :3, :3], boards[:, :3, 3] = turns, shifts
    draw = torch.randn(4, 3, generator=torch.Generator().manual_seed(seed + 100)).double()
    hand_eye, world = (ct.Extrinsics(*pair).requires_grad_(False) for pair in (draw[:2], draw[2:]))
    # camera from board is hand_eye, the robot's motion, world
    motions = torch.linalg.inv(hand_eye.matrix()) @ boards @ torch.linalg.inv(world.matrix())
    return corners, hand_eye, world, torch.linalg.inv(motions) if eye == "in_hand" else motions


def calibrated(corners, poses, eye, model="brown_conrady", **options):
    given = corners.object_points, corners.image_points, poses
    return ct.calibrate_hand_eye(model, *given, image_size=SIZE, eye=eye, **options)


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize("eye", EYES)
def test_exact_corners_give_the_exact_poses(eye, held):
    corners, hand_eye, world, poses = made(eye)
    found = calibrated(corners, poses, eye, CAMERA, fixed="all" if held else ())
    assert found.converged
    assert found.rms < 1e-8
    torch.testing.assert_close(found.hand_eye.matrix().detach(), hand_eye.matrix(), rtol=0, atol=1e-9)
    torch.testing.assert_close(found.world.matrix().detach(), world.matrix(), rtol=0, atol=1e-9)
    assert bool((found.std[:9] == 0).all()) == held
    # what the poses mean: base from hand, camera from hand or base
    motion = ct.Extrinsics.from_matrix(poses[0])
    motion = motion.inverse() if eye == "in_hand" else motion
    seen, _ = found.camera.project(found.hand_eye(motion(found.world(corners.object_points))))
    known = ~corners.image_points[0].isnan()
    torch.testing.assert_close(seen[known], corners.image_points[0][known], rtol=0, atol=1e-7)


def test_a_model_may_have_no_coefficients():
    corners, _, _, poses = made("in_hand")
    found = calibrated(corners, poses, "in_hand", "pinhole")
    assert found.camera.key == "pinhole"
    assert found.covariance.shape == (16, 16)


def test_a_surface_is_learnt_on_the_hand_in_the_frame_of_its_start():
    """Where nothing is seen its control points went beyond 1e8, and the hand turned with it by three degrees."""
    corners, hand_eye, _, poses = made("in_hand", views=12, noise=0.1)
    model = ct.Splined.with_grid(columns=8, rows=7, fov_x=75)
    found = calibrated(corners, poses, "in_hand", model, start=CAMERA)
    assert found.converged
    assert found.camera.distortion.abs().max() < 1
    torch.testing.assert_close(found.hand_eye.matrix().detach(), hand_eye.matrix(), rtol=0, atol=3e-3)


@pytest.mark.parametrize(
    ("eye", "held"), [("in_hand", False), ("to_hand", True), pytest.param("to_hand", False, marks=pytest.mark.slow)]
)
def test_optimum_and_covariance_are_those_of_scipy(eye, held):
    """By SciPy's own search, formulas and differences, from another start."""
    corners, hand_eye, world, poses = made(eye, noise=0.3)
    found = calibrated(corners, poses, eye, CAMERA, fixed="all" if held else ())
    motions = np.linalg.inv(poses.numpy()) if eye == "in_hand" else poses.numpy()
    board, pixels = corners.object_points.numpy(), corners.image_points.numpy()
    known, numbers = ~np.isnan(pixels), np.concatenate(NUMBERS)

    def residuals(x):
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers if held else x[12:]
        points = Rotation.from_rotvec(x[6:9]).apply(board) + x[9:12]
        points = np.einsum("vij,nj->vni", motions[:, :3, :3], points) + motions[:, None, :3, 3]
        points = points @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:6]
        a, b = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
        r = a * a + b * b
        radial = 1 + r * (k1 + r * (k2 + r * k3))
        u = fx * (a * radial + 2 * p1 * a * b + p2 * (r + 2 * a * a)) + cx
        v = fy * (b * radial + p1 * (r + 2 * b * b) + 2 * p2 * a * b) + cy
        return (np.stack((u, v), -1) - pixels)[known]

    truth = [hand_eye.rotation, hand_eye.translation, world.rotation, world.translation]
    start = np.concatenate([*(t.numpy() + 0.003 for t in truth), *([] if held else [numbers])])
    best = least_squares(residuals, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    count = known.sum() // 2
    assert found.rms == pytest.approx(math.sqrt(2 * best.cost / count), abs=1e-9)
    mine = [p.detach().numpy() for pose in (found.hand_eye, found.world) for p in (pose.rotation, pose.translation)]
    mine += [] if held else [found.camera.intrinsics.detach().numpy(), found.camera.distortion.detach().numpy()]
    spread = np.linalg.inv(best.jac.T @ best.jac) * 2 * best.cost / (2 * count - len(best.x))
    off = (np.concatenate(mine) - best.x) / np.sqrt(np.diag(spread))
    np.testing.assert_allclose(off, 0, atol=1e-4)  # both searches end nearer than that
    # translations, which both describe alike; turns are about other axes
    shifts = [*range(3, 6), *range(9, 12)]
    rows = [len(found.parameter_names) - 12 + i for i in shifts]
    theirs = spread[np.ix_(shifts, shifts)]
    scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
    np.testing.assert_allclose(found.covariance[rows][:, rows].numpy() / scale, theirs / scale, rtol=0, atol=1e-5)
    if not held:
        np.testing.assert_allclose(found.std[:9], np.sqrt(np.diag(spread))[12:], rtol=1e-4)


def test_a_batch_is_a_loop_over_it():
    sets = [made("in_hand", noise=0.2, seed=seed) for seed in range(3)]
    pixels = torch.stack([corners.image_points for corners, *_ in sets])
    pixels[1, 2] = math.nan  # a view that one of them did not see
    poses = torch.stack([poses for *_, poses in sets])
    board = sets[0][0].object_points
    with pytest.warns(UserWarning, match="nothing was seen in view 10"):
        whole = ct.calibrate_hand_eye(CAMERA, board, pixels, poses, image_size=SIZE)
    assert whole.converged
    assert whole.residuals.shape == pixels.shape
    for i in (0, 2):
        alone = ct.calibrate_hand_eye(CAMERA, board, pixels[i], poses[i], image_size=SIZE)
        assert float(whole.rms[i]) == pytest.approx(alone.rms, abs=1e-9)
        for name in ("rotation", "translation"):
            for pose in ("hand_eye", "world"):
                mine, its = (getattr(getattr(f, pose), name).detach() for f in (whole, alone))
                torch.testing.assert_close(mine[i], its, rtol=0, atol=1e-8)
        torch.testing.assert_close(whole.covariance[i], alone.covariance, rtol=1e-4, atol=1e-12)
        torch.testing.assert_close(whole.camera[i].intrinsics, alone.camera.intrinsics, rtol=1e-8, atol=0)


@pytest.mark.slow
def test_errors_over_many_sets_are_as_the_covariance_says():
    sets = [made("in_hand", noise=0.3, seed=seed) for seed in range(200)]
    pixels, poses = (torch.stack(parts) for parts in zip(*((s[0].image_points, s[3]) for s in sets), strict=True))
    found = ct.calibrate_hand_eye(CAMERA, sets[0][0].object_points, pixels, poses, image_size=SIZE)
    off = torch.stack([(found.hand_eye[i].translation - s[1].translation).detach() for i, s in enumerate(sets)])
    spread = found.covariance[:, 12:15, 12:15]
    distances = (torch.linalg.solve(spread, off[..., None])[..., 0] * off).sum(-1)
    assert float(distances.mean()) == pytest.approx(3.0, abs=4 * math.sqrt(6 / 200))


FORMS = {
    "extrinsics": ct.Extrinsics.from_matrix,
    "list of extrinsics": lambda poses: [ct.Extrinsics.from_matrix(pose) for pose in poses],
    "array": lambda poses: poses.numpy(),
    "list of arrays": lambda poses: [pose.numpy() for pose in poses],
    "numbers": lambda poses: poses.tolist(),
    "OpenCV's": lambda poses: ([p[:3, :3].numpy() for p in poses], [p[:3, 3:].numpy() for p in poses]),
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_forms_of_poses(form):
    corners, hand_eye, _, poses = made("in_hand")
    found = calibrated(corners, form(poses), "in_hand", CAMERA, fixed="all")
    torch.testing.assert_close(found.hand_eye.matrix().detach(), hand_eye.matrix(), rtol=0, atol=1e-9)


def test_a_wrong_pose_of_one_view_and_wrong_corners():
    corners, hand_eye, _, poses = made("in_hand", views=12, noise=0.1)
    pixels = corners.image_points.clone()
    pixels[3] = pixels[4]  # a photograph that was taken before the robot moved
    pixels[3] += 0.3 * torch.randn(pixels[3].shape, generator=torch.Generator().manual_seed(0)).double()
    found = calibrated(corners._replace(image_points=pixels), poses, "in_hand", CAMERA, fixed="all", loss="cauchy")
    torch.testing.assert_close(found.hand_eye.matrix().detach(), hand_eye.matrix(), rtol=0, atol=5e-3)
    assert not found.inliers[3].any()
    assert found.inliers[4].any()


def turned_about_one_axis(poses):
    angles = torch.linspace(0, 1, len(poses)).double()
    shifts = poses[:, :3, 3]
    return ct.Extrinsics(torch.stack((0 * angles, angles, 0 * angles), -1), shifts)


@pytest.mark.parametrize(
    ("change", "options", "says"),
    [
        (lambda p: p[:-1], {}, "robot_poses are 7, and image_points 8"),
        (lambda p: p[:2], {}, "of 3 views at least"),
        (lambda p: 2 * p, {}, "rigid poses"),
        (lambda p: p[:, :3, :3], {}, "rigid poses"),
        (lambda p: p * math.nan, {}, "rigid poses"),
        (turned_about_one_axis, {}, "about one axis alone"),
        (torch.linalg.inv, {}, "base from hand"),
        (lambda p: p, {"eye": "to_hand"}, "base from hand"),
        (lambda p: p, {"eye": "on_hand"}, "eye must be"),
        (lambda p: p, {"fixed": "fz"}, "fixed names"),
        (lambda p: p[None], {}, "image_points must be"),
    ],
)
def test_bad_arguments(change, options, says):
    corners, _, _, poses = made("in_hand")
    with pytest.raises(ValueError, match=rf"calibrate_hand_eye: .*{says}"):
        calibrated(corners, change(poses), **{"eye": "in_hand", "model": CAMERA, **options})


def test_a_frozen_camera_keeps_its_names_and_what_it_says():
    corners, _, _, poses = made("in_hand", noise=0.2)
    start = ct.BrownConrady(*NUMBERS, image_size=SIZE).double().freeze("k3", "p1", "p2")
    found = calibrated(corners, poses, "in_hand", start)
    assert found.camera.distortion[4] == 0
    assert dict(zip(found.parameter_names, found.std.tolist(), strict=True))["k3"] == 0
    assert found.parameter_names[-12:] == tuple(f"{p}.{i}" for p in ("hand_eye", "world") for i in NAMES)
    assert "camera from hand" in repr(found)
