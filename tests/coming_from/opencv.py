"""The rows of the page on OpenCV."""

import functools

import cv2
import numpy as np
import pytest
import torch
from boards import chessboard, opencv_left
from cameras import GOLDEN

import camtorch as ct

from . import SIZE, as_images, close, equal, photograph, pixels, points, row, same_images, trap

WH = SIZE[::-1]
K = np.array([[75.0, 0, 79.5], [0, 77.5, 59.5], [0, 0, 1]])
P = np.array([[50.0, 0, 75.0], [0, 52.5, 55.0], [0, 0, 1]])
D5 = np.array([-0.28, 0.1, 1e-3, -5e-4, -0.01])
D4 = np.array([[0.02], [-0.01], [0.003], [-0.001]])
XI = np.array([1.2])
RVEC, TVEC = np.array([[0.1], [-0.2], [0.05]]), np.array([[0.1], [0.2], [1.0]])
TURN = cv2.Rodrigues(np.array([0.1, -0.05, 0.2]))[0]
FINE = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-14)


def brown():
    return ct.BrownConrady.from_matrix(K, D5, image_size=SIZE).requires_grad_(False)


def fisheye():
    return ct.KannalaBrandt.from_matrix(K, D4, image_size=SIZE).requires_grad_(False)


def mei():
    return ct.Mei.from_matrix(K, np.append(XI, D5[:4]), image_size=SIZE).requires_grad_(False)


def target():
    return ct.Pinhole.from_matrix(P, image_size=SIZE).requires_grad_(False)


def pose():
    return ct.Extrinsics(RVEC, TVEC).requires_grad_(False)


def tensor(array):
    return torch.from_numpy(np.asarray(array))


def warped(warp):
    return warp(as_images(photograph()))[0].permute(1, 2, 0).numpy()


def plane_points(rays):
    return rays[..., :2] / rays[..., 2:]


def seen(camera):
    return camera(pose()(tensor(points())))[0]


FLAT, SECOND = points()[:, :2], (np.array([[0.3], [0.1], [-0.2]]), np.array([[1.0], [2.0], [3.0]]))


def composed():
    return ct.Extrinsics(*(column[:, 0] for column in SECOND)).compose(pose())


equal({
    "cv2.projectPoints": lambda: ((seen(brown()), cv2.projectPoints(points(), RVEC, TVEC, K, D5)[0][:, 0]), 1e-9),
    "cv2.fisheye.projectPoints": lambda: (
        (seen(fisheye()), cv2.fisheye.projectPoints(points()[None], RVEC, TVEC, K, D4)[0][0]), 1e-9
    ),
    "cv2.fisheye.distortPoints": lambda: (
        (
            fisheye().project(tensor(np.concatenate([FLAT, np.ones((50, 1))], 1)))[0],
            cv2.fisheye.distortPoints(FLAT[None], K, D4)[0],
        ),
        1e-9,
    ),
    "cv2.Rodrigues": lambda: (
        (pose().matrix()[:3, :3], cv2.Rodrigues(RVEC)[0]),
        (ct.Extrinsics(cv2.Rodrigues(RVEC)[0], TVEC).rotation, RVEC[:, 0]),
        1e-9,
    ),
    "cv2.composeRT": lambda: (
        (composed().rotation, cv2.composeRT(RVEC, TVEC, *SECOND)[0][:, 0]),
        (composed().translation, cv2.composeRT(RVEC, TVEC, *SECOND)[1][:, 0]),
        1e-9,
    ),
    "cv2.omnidir.projectPoints": lambda: ((mei().project(tensor(points()))[0], spherical(points())), 1e-9),
    "cv2.omnidir.undistortPoints cv2.omnidir.initUndistortRectifyMap": lambda: (
        (plane_points(mei().unproject(tensor(spherical(points())))[0]), points()[:, :2] / points()[:, 2:]), 1e-9
    ),
})  # fmt: skip


@row("cv2.undistortPoints")
def undistort_points():
    rays, valid = brown().unproject(tensor(pixels()[:, None]))  # shaped as OpenCV's
    assert valid.all()
    close(rays.norm(dim=-1), torch.ones(50, 1), 1e-12)
    close(plane_points(rays), cv2.undistortPoints(pixels(), K, D5, criteria=FINE))
    moved, _ = ct.Warp(brown(), target()).transform_points(tensor(pixels()))
    close(moved, cv2.undistortPoints(pixels(), K, D5, P=P, criteria=FINE)[:, 0])

    same = ct.Pinhole.from_matrix(K, image_size=SIZE)
    moved, _ = ct.Warp(brown(), same).transform_points(tensor(pixels()))
    close(moved, cv2.undistortImagePoints(pixels(), K, D5)[:, 0], 0.05)  # which takes 5 steps


@row("cv2.undistort")
def undistort():
    same_images(warped(ct.Warp(brown(), target())), cv2.undistort(photograph(), K, D5, None, P))
    np.testing.assert_array_equal(cv2.undistort(photograph(), K, D5), cv2.undistort(photograph(), K, D5, None, K))


@row("cv2.initUndistortRectifyMap", "cv2.remap", "cv2.fisheye.initUndistortRectifyMap")
def rectify_map():
    for camera, lens, of in ((brown(), D5, cv2), (fisheye(), D4, cv2.fisheye)):
        maps = of.initUndistortRectifyMap(K, lens, TURN, P, WH, cv2.CV_32FC1)
        theirs = cv2.remap(photograph(), *maps, cv2.INTER_LINEAR)
        warp = ct.Warp(camera, target(), tensor(TURN))
        same_images(warped(warp), theirs)
        seen = warp.valid_mask()[0, 0].numpy()
        grid = warp.grid()[0].numpy()
        for i, (found, size) in enumerate(zip(maps, WH, strict=True)):
            np.testing.assert_allclose(((grid[..., i] + 1) * size - 1)[seen] / 2, found[seen], atol=2e-3)
        grid = (2 * tensor(np.stack(maps, -1)) + 1) / torch.tensor(WH) - 1  # as on the page
        ours = torch.nn.functional.grid_sample(as_images(photograph()).float(), grid[None], align_corners=False)
        same_images(ours[0].permute(1, 2, 0).numpy(), theirs)
    same_images(warped(ct.Warp(fisheye(), target())), cv2.fisheye.undistortImage(photograph(), K, D4, Knew=P))


@row("cv2.initInverseRectificationMap")
def inverse_map():
    maps = cv2.initInverseRectificationMap(K, D5, TURN, P, WH, cv2.CV_32FC1)
    ours = warped(ct.Warp(brown(), target(), tensor(TURN)).inverse())
    same_images(ours, cv2.remap(photograph(), *maps, cv2.INTER_LINEAR))


@row("cv2.convertMaps")
def convert_maps(tmp_path):
    warp = ct.Warp(brown(), target(), tensor(TURN))
    warp.save(tmp_path / "fixed.npz", format="opencv_fixed")
    with np.load(tmp_path / "fixed.npz") as read:
        ours = cv2.remap(photograph(), *(read[name] for name in read.files if read[name].ndim > 1), cv2.INTER_LINEAR)
    maps = cv2.initUndistortRectifyMap(K, D5, TURN, P, WH, cv2.CV_32FC1)
    same_images(ours, cv2.remap(photograph(), *cv2.convertMaps(*maps, cv2.CV_16SC2), cv2.INTER_LINEAR))


@row("cv2.getOptimalNewCameraMatrix", "cv2.fisheye.estimateNewCameraMatrixForUndistortRectify")
def new_matrix():
    new, _ = cv2.getOptimalNewCameraMatrix(K, D5, WH, 0.0)
    warp = ct.Warp(brown(), ct.Pinhole.from_matrix(new, image_size=SIZE).requires_grad_(False))
    same_images(warped(warp), cv2.undistort(photograph(), K, D5, None, new))
    assert torch.isfinite(ct.Dewarp(fisheye()).target.intrinsics).all()


@row("cv2.solvePnP", "cv2.solvePnPRansac", "cv2.fisheye.solvePnP")
def solve_pnp():
    board = points(12)
    seen, around = (project(board[None], RVEC, TVEC, K, lens)[0].reshape(12, 1, 2)
                    for project, lens in ((cv2.projectPoints, D5), (cv2.fisheye.projectPoints, D4)))  # fmt: skip
    for camera, uv, (_, rvec, tvec) in (
        (brown(), seen, cv2.solvePnP(board, seen, K, D5)),
        (fisheye(), around, cv2.fisheye.solvePnP(board[None], around[:, 0][None], K, D4)),
    ):
        found, _, valid = ct.solve_pnp(camera, board, uv[:, 0])
        assert valid
        close(found.rotation, rvec[:, 0], 1e-5)
        close(found.translation, tvec[:, 0], 1e-5)
    seen[0] += 50.0
    pose = ct.solve_pnp(brown(), board, seen[:, 0], threshold=2)
    *_, inliers = cv2.solvePnPRansac(board, seen, K, D5, reprojectionError=2)
    assert pose.inliers.nonzero()[:, 0].tolist() == inliers[:, 0].tolist() == list(range(1, 12))
    close(pose.extrinsics.translation, TVEC[:, 0], 1e-5)


@row("cv2.triangulatePoints", slow=True)
def triangulate():
    first = ct.Extrinsics([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]).double().requires_grad_(False)
    world = tensor(points(20))
    seen = torch.stack([brown()(pose)[0] for pose in (first(world), pose()(world))])
    found, _, valid = ct.triangulate([brown(), brown()], [first, pose()], seen)
    assert valid.all()
    close(found, world, 1e-6)
    flat = [cv2.undistortPoints(uv.numpy(), K, D5, criteria=FINE)[:, 0].T for uv in seen]
    theirs = cv2.triangulatePoints(np.eye(3, 4), pose().matrix().numpy()[:3], *flat)
    close(found, (theirs[:3] / theirs[3]).T, 1e-6)


def views():
    """Thirteen of OpenCV's left camera: board, corners, (width, height)."""
    left, _ = opencv_left()
    board = left.object_points.numpy().astype(np.float32)
    return board, [uv.numpy().astype(np.float32)[:, None] for uv in left.image_points], left.image_size[::-1]


def same_calibrations(flags, options, guess):
    board, corners, wh = views()
    rms, matrix, distortion, *_ = cv2.calibrateCamera([board] * 13, corners, wh, *guess, flags=flags)
    ours = ct.calibrate("brown_conrady", board, corners, image_size=wh[::-1], **options)
    assert ours.rms == pytest.approx(rms, rel=1e-9)
    close(ours.camera.K, matrix, 1e-4)
    count = ours.camera.distortion.shape[-1]
    # of the standard deviations: eight coefficients that trade with each other are known to far fewer digits than two
    off = np.abs(ours.camera.distortion.detach().numpy() - distortion.ravel()[:count])
    assert (off <= 1e-3 * ours.std[4:].numpy() + 1e-7).all()
    assert not distortion.ravel()[count:].any()
    return ours


GUESS = np.array([[536.0, 0, 342], [0, 536.0, 235], [0, 0, 1]])


@row("cv2.calibrateCamera", "cv2.calibrateCameraExtended", "cv2.findChessboardCornersSB", slow=True)
def calibrate():
    ours = same_calibrations(0, {"count": 5}, (None, None))
    board, corners, wh = views()
    *_, deviations, _, _ = cv2.calibrateCameraExtended([board] * 13, corners, wh, None, None)
    std = ours.std.numpy()
    np.testing.assert_allclose(std / deviations[:9, 0], np.full(9, std[0] / deviations[0, 0]), rtol=1e-3)
    assert [tuple(residual.shape) for residual in ours.residuals] == [(54, 1, 2)] * 13
    with pytest.warns(UserWarning, match="6"):  # in which no board was found
        assert ct.calibrate("brown_conrady", board, [*corners[:6], None], image_size=wh[::-1], count=4).rms < 0.3


FLAGS = {
    "FIX_PRINCIPAL_POINT": {"count": 5, "fixed": ("cx", "cy")},
    "ZERO_TANGENT_DIST": {"count": 5, "fixed": ("p1", "p2")},
    "FIX_K3": {"count": 4},
    "RATIONAL_MODEL": {"count": 8},
}
for _flag, _options in FLAGS.items():
    row(f"cv2.CALIB_{_flag}", slow=True)(
        functools.partial(same_calibrations, getattr(cv2, f"CALIB_{_flag}"), _options, (None, None))
    )


@row("cv2.CALIB_USE_INTRINSIC_GUESS", "cv2.CALIB_FIX_FOCAL_LENGTH", slow=True)
def fixed_focal_length():
    start = ct.BrownConrady.from_matrix(GUESS, np.zeros(5), image_size=(480, 640))
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_FOCAL_LENGTH
    same_calibrations(flags, {"start": start, "fixed": ("fx", "fy")}, (GUESS.copy(), np.zeros(5)))


def boards(cameras, count=12):
    """A board (N, 3), and what cameras see of it in its poses: corners (V, N, 2) of each, float64, without noise.

    Args:
        cameras: (camera, from the first camera) of each.
        count: V.
    """
    board = chessboard(8, 6, 0.025)
    turns = torch.linspace(0, 6, count, dtype=torch.float64)
    lean = torch.stack([0.5 * turns.cos(), 0.5 * turns.sin(), 0.3 * turns], -1)
    place = torch.stack([0.05 * (2 * turns).sin() - 0.08, 0.04 * (2 * turns).cos() - 0.06, 0.25 + 0.02 * turns], -1)
    placed = ct.Extrinsics(lean, place).requires_grad_(False)(board[None])
    return board, [camera(pose(placed))[0] for camera, pose in cameras]


HERE = ct.Extrinsics(np.zeros(3), np.zeros(3)).requires_grad_(False)
RIGHT = ct.Extrinsics(np.array([0.01, 0.05, -0.02]), np.array([-0.12, 0.01, 0.005])).requires_grad_(False)


def float32(array, shape):
    return np.ascontiguousarray(array, np.float32).reshape(shape)


@row("cv2.stereoCalibrate", "cv2.fisheye.stereoCalibrate", slow=True)
def stereo_calibrate():
    board, seen = boards([(brown(), HERE), (brown(), RIGHT)])
    lists = [[float32(uv, (-1, 1, 2)) for uv in one] for one in seen]
    fixed = cv2.CALIB_FIX_INTRINSIC
    *_, turn, shift, _, _ = cv2.stereoCalibrate([float32(board, (-1, 3))] * 12, *lists, K, D5, K, D5, WH, flags=fixed)
    ours = ct.calibrate_rig(
        {"left": brown(), "right": brown()},
        board,
        dict(zip(("left", "right"), seen, strict=True)),
        image_sizes={"left": SIZE, "right": SIZE},
        fixed="all",
    )
    close(ours.rig.extrinsics["right"].matrix()[:3, :3], turn, 1e-4)
    close(ours.rig.extrinsics["right"].translation, shift[:, 0], 1e-4)


@row("cv2.stereoRectify", "cv2.fisheye.stereoRectify")
def stereo_rectify():
    turn, shift = cv2.Rodrigues(np.array([0.01, 0.05, -0.02]))[0], np.array([[-0.12], [0.01], [0.005]])
    r1, r2, p1, p2, q, *_ = cv2.stereoRectify(K, D5, K, D5, WH, turn, shift, flags=cv2.CALIB_ZERO_DISPARITY)
    extrinsics = ct.Extrinsics(turn, shift).requires_grad_(False)
    ours = ct.rectify(brown(), brown(), extrinsics, align="opencv").opencv()
    close(ours["R1"], r1, 1e-9)
    close(ours["R2"], r2, 1e-9)
    close(ours["P2"][0, 3] / ours["P2"][0, 0], p2[0, 3] / p2[0, 0], 1e-9)
    assert (ours["P1"].shape, ours["Q"].shape) == (p1.shape, q.shape)
    r1, *_ = cv2.fisheye.stereoRectify(K, D4, K, D4, WH, turn, shift[:, 0], cv2.CALIB_ZERO_DISPARITY)
    close(ct.rectify(fisheye(), fisheye(), extrinsics, align="opencv").rotation_left, r1, 1e-6)
    assert ct.rectify(fisheye(), fisheye(), extrinsics, projection="latlon").camera_left.key == "latlon"


@row("cv2.reprojectImageTo3D")
def disparities():
    shift = ct.Extrinsics(np.zeros(3), np.array([-0.12, 0.0, 0.0])).requires_grad_(False)
    pair = ct.rectify(brown(), brown(), shift)
    disparity = np.random.default_rng(0).uniform(5, 50, pair.camera_left.image_size).astype(np.float32)
    found, valid = pair.disparity_to_points(tensor(disparity).double())
    assert valid.all()
    close(found, cv2.reprojectImageTo3D(disparity, pair.opencv()["Q"].numpy()), 1e-4)


@row("cv2.StereoSGBM_create")
def matching():
    shift = ct.Extrinsics(np.zeros(3), np.array([-0.12, 0.0, 0.0])).requires_grad_(False)
    pair = ct.rectify(brown(), brown(), shift, image_size=(60, 80))
    left, right = (image[0, 0].numpy() for image in pair(*[as_images(photograph())] * 2))
    assert cv2.StereoSGBM_create(numDisparities=16, blockSize=5).compute(left, right).shape == (60, 80)


@row("cv2.warpPerspective", slow=True)
def homographies():
    here = ct.Pinhole.from_matrix(K, image_size=SIZE).requires_grad_(False)
    turn = P @ TURN @ np.linalg.inv(K)
    same_images(warped(ct.Warp(here, target(), tensor(TURN))), cv2.warpPerspective(photograph(), turn, WH))
    normal, distance = np.array([[0.1], [0.2], [1.0]]), 2.0
    to_plane = K @ (cv2.Rodrigues(RVEC)[0] + TVEC / 10 @ normal.T / distance) @ np.linalg.inv(P)
    plane = ct.PlaneWarp(here, target(), ct.Extrinsics(RVEC, TVEC / 10).requires_grad_(False), normal[:, 0], distance)
    theirs = cv2.warpPerspective(photograph(), to_plane, WH, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    same_images(warped(plane), theirs)


@row("cv2.resize")
def resize():
    image = np.zeros(SIZE, np.float32)
    image[:, 100:102] = 1.0  # a line whose middle is at column 100.5
    shrunk = cv2.resize(image, (80, 60), interpolation=cv2.INTER_AREA)[0]
    ray = brown().unproject(torch.tensor([100.5, 59.5], dtype=torch.float64))[0]
    assert brown().resize(60, 80).project(ray)[0][0].item() == pytest.approx(
        (shrunk * np.arange(80)).sum() / shrunk.sum()
    )


def moved_pixel(operation, pixel):
    """Where an operation of OpenCV takes a pixel (x, y)."""
    image = np.zeros(SIZE, np.uint8)
    image[pixel[1], pixel[0]] = 1
    row, column = np.argwhere(operation(image))[0]
    return [column, row]


@row("cv2.flip", "cv2.rotate")
def flip_and_rotate():
    x, y, z = brown().unproject(torch.tensor([100.0, 50.0], dtype=torch.float64))[0]
    for camera, ray, operation in (
        (brown().hflip(), (-x, y, z), lambda image: cv2.flip(image, 1)),
        (brown().vflip(), (x, -y, z), lambda image: cv2.flip(image, 0)),
        # the scene turns with the image: what was to the right is up, which is -y
        (brown().rot90(), (y, -x, z), lambda image: cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE)),
    ):
        close(camera.project(torch.stack(ray))[0], moved_pixel(operation, (100, 50)), 1e-6)


@row("cv2.calibrationMatrixValues")
def field_of_view():
    middle = K.copy()
    middle[:2, 2] = 80.0, 60.0  # OpenCV takes the edges of the image to be at 0 and its width
    found = cv2.calibrationMatrixValues(middle, WH, 1.0, 1.0)
    camera = ct.Pinhole.from_matrix(K, image_size=SIZE)
    np.testing.assert_allclose(camera.fov[:2].detach().numpy(), found[:2], atol=1e-9)


@row("cv2.FileStorage")
def file_storage(tmp_path):
    path = str(tmp_path / "camera.yml")
    storage = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
    for name, value in (
        ("image_width", 640),
        ("image_height", 480),
        ("camera_matrix", K),
        ("distortion_coefficients", D5),
    ):
        storage.write(name, value)
    storage.release()
    camera = ct.load(path).camera
    close(camera.K, K)
    close(camera.distortion, D5)
    ct.save(camera, tmp_path / "again.yml", format="opencv")
    storage = cv2.FileStorage(str(tmp_path / "again.yml"), cv2.FILE_STORAGE_READ)
    close(K, storage.getNode("camera_matrix").mat())


@row("cv2.fisheye.undistortPoints")
def fisheye_undistort():
    rays, valid = fisheye().unproject(tensor(pixels()))
    assert valid.all()
    close(plane_points(rays), cv2.fisheye.undistortPoints(pixels()[None], K, D4, criteria=FINE)[0], 1e-6)
    back, _ = fisheye().unproject(torch.tensor([[79.5 + 125, 59.5]], dtype=torch.float64))
    assert back[0, 2] < 0


@row("cv2.fisheye.calibrate", slow=True)
def fisheye_calibrate():
    board, (seen,) = boards([(fisheye(), HERE)])
    flags = cv2.CALIB_FIX_SKEW | cv2.CALIB_RECOMPUTE_EXTRINSIC
    objects, corners = [board.numpy()[None]] * 12, [uv.numpy()[None] for uv in seen]
    _, matrix, distortion, *_ = cv2.fisheye.calibrate(objects, corners, WH, np.eye(3), np.zeros(4), flags=flags)
    ours = ct.calibrate("kannala_brandt", board, seen, image_size=SIZE)
    close(ours.camera.K, matrix, 1e-3)
    close(ours.camera.distortion, distortion.ravel(), 1e-4)


def spherical(xyz):
    """Pixels by the formula of omnidir's documentation."""
    x, y = (xyz / np.linalg.norm(xyz, axis=-1, keepdims=True)).T[:2] / (xyz[:, 2] / np.linalg.norm(xyz, axis=-1) + XI)
    k1, k2, p1, p2 = D5[:4]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2
    u = radial * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = radial * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([u, v], -1) @ K[:2, :2].T + K[:2, 2]


@row("cv2.omnidir.RECTIFY_LONGLATI")
def omnidir_panorama():
    longlati = np.array([[40.0, 0, 10.0], [0, 35.0, 5.0], [0, 0, 1]])
    quarter = np.array([40.0, 35.0, 10.0 + 20 * np.pi, 5.0 + 17.5 * np.pi])
    panorama = ct.LatLon(quarter, image_size=SIZE).requires_grad_(False)
    rays, valid = panorama.rays()
    x, y = ((panorama.pixel_grid().numpy() - longlati[:2, 2]) / [40.0, 35.0]).transpose(2, 0, 1)
    documented = np.stack([-np.cos(x), -np.sin(x) * np.cos(y), np.sin(x) * np.sin(y)], -1)
    close(rays[valid], documented[valid.numpy()])


@row("cv2.omnidir.calibrate", slow=True)
def omnidir_calibrate():
    board, (seen,) = boards([(mei(), HERE)])
    ours = ct.calibrate("mei", board, seen, image_size=SIZE)
    assert ours.rms < 1e-6
    rays, _ = mei().unproject(tensor(pixels()))
    close(ours.camera.project(rays)[0], pixels(), 0.1)


@row("cv2.aruco.ArucoDetector.detectMarkers")
def markers():
    square = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
    corners = cv2.fisheye.projectPoints(square[None], RVEC, TVEC, K, D4)[0]  # (1, 4, 2), as of a marker
    found, _, valid = ct.solve_pnp(fisheye(), square[None], corners)
    assert valid.all()
    close(found.translation, TVEC.T, 1e-6)


@row("cv2.aruco.CharucoBoard.matchImagePoints", slow=True)
def charuco():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((9, 7), 0.025, 0.018, dictionary)
    corners, (seen,) = boards([(fisheye(), HERE)])
    close(corners + 0.025 * torch.tensor([1, 1, 0]), board.getChessboardCorners(), 1e-6)
    rng = np.random.default_rng(0)
    matched = [
        board.matchImagePoints(
            float32(uv[i:], (-1, 1, 2)) + rng.normal(0, 0.01, (len(uv) - i, 1, 2)).astype(np.float32),
            np.arange(i, len(uv), dtype=np.int32)[:, None],
        )
        for i, uv in enumerate(seen)
    ]
    ours = ct.calibrate("kannala_brandt", *map(list, zip(*matched, strict=True)), image_size=SIZE)
    close(ours.camera.K, K, 0.2)


@trap
def behind_the_camera():
    ahead, behind = np.array([[0.5, 0.2, 1.0]]), np.array([[-0.5, -0.2, -1.0]])
    nothing = np.zeros(3), np.zeros(3), K
    close(cv2.projectPoints(ahead, *nothing, D5)[0], cv2.projectPoints(behind, *nothing, D5)[0])
    seen, mirrored = (cv2.fisheye.projectPoints(one[None], *nothing, D4)[0] for one in (ahead, behind))
    close(seen, mirrored)
    assert not brown().project(tensor(behind))[1]
    assert np.abs(fisheye().project(tensor(behind))[0].numpy() - mirrored[0]).max() > 100


@trap
def steps_of_undistort_points():
    def off(name):
        case = GOLDEN[name]
        parameters = tensor(case["parameters"])
        camera = ct.BrownConrady(parameters[:4], parameters[4:], image_size=case["image_size"]).requires_grad_(False)
        rim = camera.pixel_grid(stride=40).double().reshape(-1, 2)
        flat = cv2.undistortPoints(rim.numpy(), camera.K.numpy(), parameters[4:].numpy())[:, 0]
        back, _ = camera.project(torch.cat([tensor(flat), torch.ones(len(flat), 1)], 1))
        return (back - rim).norm(dim=-1)[camera.unproject(rim)[1]].max().item()

    assert 0.001 < off("cv2__projectpoints_d5_opencv_left_published") < 0.004
    assert 0.5 < off("cv2__projectpoints_d14_tilted") < 1.2
    assert off("cv2__projectpoints_d12_auto_front_120") > 100


@trap
def as_it_is_made():
    assert ct.BrownConrady.from_matrix(K, D5).intrinsics.requires_grad
    assert ct.KannalaBrandt.from_matrix(K.tolist(), D4.tolist()).intrinsics.dtype == torch.float32
    skewed = K + np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]])
    with pytest.raises(ValueError, match="skew"):
        ct.BrownConrady.from_matrix(skewed, D5)
    ct.BrownConrady.from_matrix(skewed, D5, ignore_skew=True)
    assert brown()(tensor(points()[:, None]))[0].shape == (50, 1, 2)
