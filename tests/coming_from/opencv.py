"""The rows of the page on OpenCV."""

import cv2
import numpy as np
import torch
from boards import chessboard
from cameras import GOLDEN, golden_camera

import camtorch as ct

from . import SIZE, as_images, close, elsewhere, equal, photograph, pixels, plane, points, row, trap, warped

WH = SIZE[::-1]
K = np.array([[75.0, 0, 79.5], [0, 77.5, 59.5], [0, 0, 1]])
BY_EDGES = K + 0.5 * np.eye(3)[2] * [[1], [1], [0]]  # the edges of the image are at 0 and its width
P = np.array([[50.0, 0, 75.0], [0, 52.5, 55.0], [0, 0, 1]])
D5 = np.array([-0.28, 0.1, 1e-3, -5e-4, -0.01])
D4 = np.array([[0.02], [-0.01], [0.003], [-0.001]])
XI = np.array([1.2])
RVEC, TVEC = np.array([[0.1], [-0.2], [0.05]]), np.array([[0.1], [0.2], [1.0]])
POSED, SECOND = (RVEC, TVEC), (np.array([[0.3], [0.1], [-0.2]]), np.array([[1.0], [2.0], [3.0]]))
R = cv2.Rodrigues(np.array([0.1, -0.05, 0.2]))[0]
MARKER = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
FINE = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-14)
X, UV = points(), pixels()
POSE = ct.Extrinsics(RVEC, TVEC).requires_grad_(False)
BROWN = ct.BrownConrady.from_matrix(K, D5, image_size=SIZE).requires_grad_(False)
FISHEYE = ct.KannalaBrandt.from_matrix(K, D4, image_size=SIZE).requires_grad_(False)
MEI = ct.Mei.from_matrix(K, np.append(XI, D5[:4]), image_size=SIZE).requires_grad_(False)
TARGET = ct.Pinhole.from_matrix(P, image_size=SIZE).requires_grad_(False)


def tensor(array):
    return torch.from_numpy(np.asarray(array))


def moved(target):
    return ct.Warp(BROWN, target).transform_points(tensor(UV))[0]


def remapped(maps):
    return cv2.remap(photograph(), *maps, cv2.INTER_LINEAR)


def rectified(module, lens):
    return module.initUndistortRectifyMap(K, lens, R, P, WH, cv2.CV_32FC1)


def by_grid(maps):
    grid = (2 * tensor(np.stack(maps, -1)) + 1) / torch.tensor(WH) - 1
    return torch.nn.functional.grid_sample(as_images(photograph()).float(), grid[None], align_corners=False)


def by_best_matrix():
    new, _ = cv2.getOptimalNewCameraMatrix(K, D5, WH, 0.0)
    target = ct.Pinhole.from_matrix(new, image_size=SIZE).requires_grad_(False)
    return warped(ct.Warp(BROWN, target)), cv2.undistort(photograph(), K, D5, None, new)


def spherical(xyz):
    """Pixels by the formula of omnidir's documentation."""
    x, y = (xyz / np.linalg.norm(xyz, axis=-1, keepdims=True)).T[:2] / (xyz[:, 2] / np.linalg.norm(xyz, axis=-1) + XI)
    k1, k2, p1, p2 = D5[:4]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2
    u = radial * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = radial * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([u, v], -1) @ K[:2, :2].T + K[:2, 2]


def by_fisheye(board):
    """Poses from what a fisheye sees: ours, and OpenCV's."""
    uv, _ = cv2.fisheye.projectPoints(board[None], RVEC, TVEC, K, D4)
    found, _, valid = ct.solve_pnp(FISHEYE, board[None], uv)
    assert valid.all()
    _, *theirs = cv2.fisheye.solvePnP(board[None], uv, K, D4)
    return [(found.rotation, theirs[0].T, 1e-5), (found.translation, theirs[1].T, 1e-5)]


def triangulated():
    poses = ct.Extrinsics(np.zeros(3), np.zeros(3)).requires_grad_(False), POSE
    uv = torch.stack([TARGET(pose(X))[0] for pose in poses])
    theirs = cv2.triangulatePoints(*(P @ pose.matrix()[:3].numpy() for pose in poses), *uv.mT.numpy())
    return ct.triangulate([TARGET] * 2, [*poses], uv)[0], (theirs[:3] / theirs[3]).T, 1e-6


def turned_plane():
    """The homography of a plane, and what warps it."""
    normal, here = np.array([[0.1, 0.2, 1.0]]), ct.Pinhole.from_matrix(K, image_size=SIZE).requires_grad_(False)
    from_plane = P @ np.linalg.inv(cv2.Rodrigues(RVEC)[0] + TVEC / 10 @ normal / 2.0) @ np.linalg.inv(K)
    pose = ct.Extrinsics(RVEC, TVEC / 10).requires_grad_(False)
    ours = ct.PlaneWarp(here, TARGET, pose, normal[0], 2.0), ct.Warp(here, TARGET, tensor(R))
    for warp, matrix in zip(ours, (from_plane, P @ R @ np.linalg.inv(K)), strict=True):
        yield warped(warp), cv2.warpPerspective(photograph(), matrix, WH)


def panorama():
    """LatLon, and the rays that the documentation of RECTIFY_LONGLATI gives its pixels."""
    fx, fy, cx, cy = 40.0, 35.0, 10.0, 5.0
    ours = ct.LatLon(np.array([fx, fy, cx + fx * np.pi / 2, cy + fy * np.pi / 2]), image_size=SIZE)
    rays, valid = ours.rays()
    x, y = ((ours.pixel_grid().numpy() - [cx, cy]) / [fx, fy]).transpose(2, 0, 1)
    return rays[valid], np.stack([-np.cos(x), -np.sin(x) * np.cos(y), np.sin(x) * np.sin(y)], -1)[valid.numpy()]


equal("cv2", {
    "projectPoints": lambda: [(BROWN(POSE(X))[0], cv2.projectPoints(X, RVEC, TVEC, K, D5)[0][:, 0])],
    "undistortPoints": lambda: [
        # shaped as OpenCV's, whose undistortImagePoints takes 5 steps
        (plane(BROWN.unproject(tensor(UV[:, None]))[0]), cv2.undistortPoints(UV, K, D5, criteria=FINE)),
        (moved(TARGET), cv2.undistortPoints(UV, K, D5, P=P, criteria=FINE)[:, 0]),
        (moved(ct.Pinhole.from_matrix(K, image_size=SIZE)), cv2.undistortImagePoints(UV, K, D5)[:, 0], 0.05),
    ],
    "undistort": lambda: [
        (warped(ct.Warp(BROWN, TARGET)), cv2.undistort(photograph(), K, D5, None, P)),
        (cv2.undistort(photograph(), K, D5), cv2.undistort(photograph(), K, D5, None, K)),
    ],
    "initUndistortRectifyMap remap fisheye.initUndistortRectifyMap": lambda: [
        *((warped(ct.Warp(camera, TARGET, tensor(R))), remapped(rectified(module, lens)))
          for camera, module, lens in ((BROWN, cv2, D5), (FISHEYE, cv2.fisheye, D4))),
        (by_grid(rectified(cv2, D5)).byte()[0].permute(1, 2, 0), remapped(rectified(cv2, D5))),
        (warped(ct.Warp(FISHEYE, TARGET)), cv2.fisheye.undistortImage(photograph(), K, D4, Knew=P)),
    ],
    "initInverseRectificationMap": lambda: [(
        warped(ct.Warp(BROWN, TARGET, tensor(R)).inverse()),
        remapped(cv2.initInverseRectificationMap(K, D5, R, P, WH, cv2.CV_32FC1)),
    )],
    "getOptimalNewCameraMatrix": lambda: [by_best_matrix()],
    "triangulatePoints": lambda: [triangulated()],
    "Rodrigues": lambda: [
        (POSE.matrix()[:3, :3], cv2.Rodrigues(RVEC)[0]),
        (ct.Extrinsics(cv2.Rodrigues(RVEC)[0], TVEC).rotation, RVEC[:, 0]),
    ],
    "composeRT": lambda: [
        (getattr(ct.Extrinsics(*SECOND).compose(POSE), name), cv2.composeRT(RVEC, TVEC, *SECOND)[i][:, 0])
        for i, name in enumerate(("rotation", "translation"))
    ],
    "warpPerspective": turned_plane,
    "calibrationMatrixValues": lambda: [
        (ct.Pinhole.from_matrix(K, image_size=SIZE).fov[:2], cv2.calibrationMatrixValues(BY_EDGES, WH, 1, 1)[:2])
    ],
    "aruco.ArucoDetector.detectMarkers": lambda: by_fisheye(MARKER),
    "fisheye.projectPoints": lambda: [(FISHEYE(POSE(X))[0], cv2.fisheye.projectPoints(X[None], *POSED, K, D4)[0][0])],
    "fisheye.distortPoints": lambda: [(FISHEYE.project(X)[0], cv2.fisheye.distortPoints(plane(X)[None], K, D4)[0])],
    "fisheye.undistortPoints": lambda: [
        (plane(FISHEYE.unproject(UV)[0]), cv2.fisheye.undistortPoints(UV[None], K, D4, criteria=FINE)[0], 1e-6)
    ],
    "fisheye.solvePnP": lambda: by_fisheye(points(12)),
    "omnidir.projectPoints": lambda: [(MEI.project(X)[0], spherical(X))],
    "omnidir.undistortPoints omnidir.initUndistortRectifyMap": lambda: [
        (plane(MEI.unproject(spherical(X))[0]), plane(X))
    ],
    "omnidir.RECTIFY_LONGLATI": lambda: [panorama()],
})  # fmt: skip

elsewhere("cv2", {
    "convertMaps": "maps/test_maps.py::test_what_another_decoder_reads_is_as_far_off_as_the_report_says",
    "solvePnP": "calibration/test_pnp.py::test_the_cost_is_opencvs_or_less",
    "calibrateCamera calibrateCameraExtended CALIB_RATIONAL_MODEL":
        "calibration/test_calibration.py::test_opencvs_optimum_from_nothing",
    "CALIB_FIX_PRINCIPAL_POINT CALIB_ZERO_TANGENT_DIST CALIB_FIX_K3":
        "calibration/test_calibration.py::test_fixed_coefficients",
    "CALIB_USE_INTRINSIC_GUESS CALIB_FIX_FOCAL_LENGTH":
        "calibration/test_calibration.py::test_what_is_held_or_frozen_at_its_best_value_changes_no_other",
    "omnidir.calibrate": "calibration/test_calibration.py::test_corners_without_noise_have_an_optimum",
    "stereoCalibrate fisheye.stereoCalibrate":
        "calibration/test_calibration_rig.py::test_cameras_and_poses_are_found_within_their_sigma",
    "stereoRectify reprojectImageTo3D": "stereo/test_rectify.py::test_opencv_has_the_same_matrices",
    "findChessboardCornersSB":
        "boards/test_detection.py::test_noisy_and_blurred_chessboards_are_found_no_worse_than_by_their_sectors",
    "FileStorage": "io/test_files.py::test_opencv",
})  # fmt: skip


@row("cv2.solvePnPRansac")
def ransac():
    board = points(12)
    uv = cv2.projectPoints(board, RVEC, TVEC, K, D5)[0]
    uv[0] += 50.0
    pose = ct.solve_pnp(BROWN, board, uv[:, 0], threshold=2)
    *_, inliers = cv2.solvePnPRansac(board, uv, K, D5, reprojectionError=2)
    assert pose.inliers.nonzero()[:, 0].tolist() == inliers[:, 0].tolist() == list(range(1, 12))
    close(pose.extrinsics.translation, TVEC[:, 0], 1e-5)


@row("cv2.fisheye.stereoRectify")
def fisheye_stereo():
    turn, shift = cv2.Rodrigues(np.array([0.01, 0.05, -0.02]))[0], np.array([-0.12, 0.01, 0.005])
    theirs, *_ = cv2.fisheye.stereoRectify(K, D4, K, D4, WH, turn, shift, cv2.CALIB_ZERO_DISPARITY)
    ours = ct.rectify(FISHEYE, FISHEYE, ct.Extrinsics(turn, shift), align="opencv")
    close(ours.rotation_left, theirs, 1e-6)


@row("cv2.fisheye.calibrate", slow=True)
def fisheye_calibrate():
    board, turns = chessboard(8, 6, 0.025), torch.linspace(0, 6, 12, dtype=torch.float64)
    lean = torch.stack([0.5 * turns.cos(), 0.5 * turns.sin(), 0.3 * turns], -1)
    place = torch.stack([0.05 * (2 * turns).sin() - 0.08, 0.04 * (2 * turns).cos() - 0.06, 0.25 + 0.02 * turns], -1)
    uv = FISHEYE(ct.Extrinsics(lean, place).requires_grad_(False)(board[None]))[0]
    flags = cv2.CALIB_FIX_SKEW | cv2.CALIB_RECOMPUTE_EXTRINSIC
    given = [board.numpy()[None]] * 12, [view.numpy()[None] for view in uv]
    _, matrix, distortion, *_ = cv2.fisheye.calibrate(*given, WH, np.eye(3), np.zeros(4), flags=flags)
    ours = ct.calibrate("kannala_brandt", board, uv, image_size=SIZE)
    close(ours.camera.K, matrix, 1e-3)
    close(ours.camera.distortion, distortion.ravel(), 1e-4)


@row("cv2.resize", "cv2.flip", "cv2.rotate")
def edits():
    uv = np.array([100.0, 50.0])
    x, y, z = BROWN.unproject(uv)[0]
    image = np.zeros(SIZE, np.float32)
    image[50:52, 100:102] = 1.0  # its middle is half a pixel further
    for camera, ray, operation, half in (
        (BROWN.hflip(), (-x, y, z), lambda image: cv2.flip(image, 1), (-0.5, 0.5)),
        (BROWN.vflip(), (x, -y, z), lambda image: cv2.flip(image, 0), (0.5, -0.5)),
        # the scene turns with the image: what was to the right is up, which is -y
        (BROWN.rot90(), (y, -x, z), lambda image: cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE), (0.5, -0.5)),
        (BROWN.resize(60, 80), (x, y, z), lambda image: cv2.resize(image, (80, 60), interpolation=3), (0.25, 0.25)),
    ):
        made = operation(image)
        rows, columns = np.mgrid[: made.shape[0], : made.shape[1]]
        middle = np.array([(made * columns).sum(), (made * rows).sum()]) / made.sum()
        close(camera.project(torch.stack(ray))[0], middle - half, 1e-5)


@trap
def behind_the_camera():
    ahead, behind = np.array([[0.5, 0.2, 1.0]]), np.array([[-0.5, -0.2, -1.0]])
    nothing = np.zeros(3), np.zeros(3), K
    close(cv2.projectPoints(ahead, *nothing, D5)[0], cv2.projectPoints(behind, *nothing, D5)[0])
    mirrored, _ = cv2.fisheye.projectPoints(behind[None], *nothing, D4)
    close(cv2.fisheye.projectPoints(ahead[None], *nothing, D4)[0], mirrored)
    assert not BROWN.project(behind)[1]
    assert np.abs(FISHEYE.project(behind)[0].numpy() - mirrored[0]).max() > 100
    back, _ = FISHEYE.unproject(np.array([[79.5 + 125, 59.5]]))
    assert back[0, 2] < 0


@trap
def steps_of_undistort_points():
    def off(name):
        camera = golden_camera(GOLDEN[name]).requires_grad_(False)
        rim = camera.pixel_grid(stride=40).double().reshape(-1, 2)
        flat = cv2.undistortPoints(rim.numpy(), camera.K.numpy(), camera.distortion.numpy())[:, 0]
        back, _ = camera.project(np.c_[flat, np.ones(len(flat))])
        return (back - rim).norm(dim=-1)[camera.unproject(rim)[1]].max().item()

    assert 0.001 < off("cv2__projectpoints_d5_opencv_left_published") < 0.004
    assert 0.5 < off("cv2__projectpoints_d14_tilted") < 1.2
    assert off("cv2__projectpoints_d12_auto_front_120") > 100
