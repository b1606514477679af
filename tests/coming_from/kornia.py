"""The rows of the page on kornia."""

import cv2
import kornia.augmentation as K  # noqa: N812 (everybody's name for it)
import kornia.geometry as geometry
import kornia.sensors.camera as sensors
import numpy as np
import pytest
import torch
from kornia.geometry.vector import Vector3
from kornia.image import ImageSize

import camtorch as ct
import camtorch.augment.kornia as front_end

from . import SIZE, as_images, close, equal, photograph, pixels, points, row, trap

MATRIX = torch.tensor([[75.0, 0, 79.5], [0, 77.5, 59.5], [0, 0, 1]], dtype=torch.float64)
OTHER = torch.tensor([[60.0, 0, 75.0], [0, 62.0, 58.0], [0, 0, 1]], dtype=torch.float64)
NUMBERS = torch.tensor([75.0, 77.5, 79.5, 59.5], dtype=torch.float64)
D5 = torch.tensor([-0.28, 0.1, 1e-3, -5e-4, -0.01], dtype=torch.float64)
D4 = torch.tensor([0.02, -0.01, 0.003, -0.001], dtype=torch.float64)
POSE = ct.Extrinsics(np.array([0.1, -0.2, 0.05]), np.array([0.1, 0.2, 0.3])).requires_grad_(False)
POINTS, PIXELS = torch.from_numpy(points()), torch.from_numpy(pixels())


def pinhole(matrix=MATRIX):
    return ct.Pinhole.from_matrix(matrix, image_size=SIZE).requires_grad_(False)


def lens():
    return ct.BrownConrady.from_matrix(MATRIX, D5, image_size=SIZE).requires_grad_(False)


def fisheye():
    return ct.KannalaBrandt(NUMBERS, D4, image_size=SIZE).requires_grad_(False)


def theirs(pose=POSE):
    intrinsics = torch.eye(4, dtype=torch.float64)[None].clone()
    intrinsics[:, :3, :3] = MATRIX
    return geometry.PinholeCamera(intrinsics, pose.matrix()[None], torch.tensor([SIZE[0]]), torch.tensor([SIZE[1]]))


def image():
    return as_images(photograph()).double() / 255


def depth():
    return 2 + torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def lifted(camera=None, depth=2.5):
    """Points at a depth of the pixels."""
    rays, _ = (camera or pinhole()).unproject(PIXELS)
    return rays / rays[..., 2:] * depth


def flat(points=POINTS):
    return points[:, :2] / points[:, 2:]


def shown(warp, theirs):
    """The largest difference of the images where ours is valid."""
    return (warp(image()) - theirs).abs()[warp.valid_mask().expand_as(theirs)].max()


NUMBERS_AND_D4, ONE = torch.cat([NUMBERS, D4]), torch.full((50, 1), 2.5, dtype=torch.float64)
SECOND = ct.Extrinsics(np.array([0.3, 0.1, -0.2]), np.array([1.0, 2.0, 3.0])).requires_grad_(False)
NOWHERE = ct.Extrinsics(np.zeros(3), np.zeros(3)).requires_grad_(False)
UNIT, GRAPHICS = torch.tensor([1.0, 1, 0, 0]).double(), torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]).double())
TILTED = torch.cat([D5, torch.zeros(7), torch.tensor([0.02, -0.01])]).double()
calibration, camera, K3 = geometry.calibration, geometry.camera, sensors.KannalaBrandtK3
of_rig = "kornia.geometry.linalg"

equal({
    "kornia.geometry.camera.PinholeCamera": lambda: (
        (pinhole(theirs().camera_matrix[0]).intrinsics, NUMBERS),
        (ct.Extrinsics.from_matrix(theirs().extrinsics).rotation, POSE.rotation[None]),
        1e-9,
    ),
    "kornia.geometry.camera.PinholeCamera.project": lambda: (
        (pinhole()(POSE(POINTS))[0], theirs().project(POINTS[None])[0]), 1e-9
    ),
    "kornia.geometry.camera.PinholeCamera.unproject": lambda: (
        (POSE.inverse()(lifted()), theirs().unproject(PIXELS[None], ONE[None])[0]), 1e-9
    ),
    "kornia.geometry.camera.PinholeCamera.scale": lambda: (
        (
            theirs().scale(torch.tensor([0.5]).double()).camera_matrix[0][[0, 1, 0, 1], [0, 1, 2, 2]],
            pinhole().resize(60, 80).intrinsics + torch.tensor([0, 0, 0.25, 0.25]),
        ),
        1e-9,
    ),
    "kornia.geometry.camera.project_points": lambda: (
        (pinhole().project(POINTS)[0], geometry.project_points(POINTS, MATRIX)), 1e-9
    ),
    "kornia.geometry.camera.unproject_points": lambda: (
        (lifted(), geometry.unproject_points(PIXELS, ONE, MATRIX)),
        (pinhole().unproject(PIXELS)[0] * ONE, geometry.unproject_points(PIXELS, ONE, MATRIX, normalize=True)),
        1e-9,
    ),
    "kornia.geometry.camera.distort_points_kannala_brandt": lambda: (
        (fisheye().project(POINTS)[0], camera.distort_points_kannala_brandt(flat(), NUMBERS_AND_D4)), 1e-9
    ),
    "kornia.geometry.camera.undistort_points_kannala_brandt": lambda: (
        (flat(lifted(fisheye())), camera.undistort_points_kannala_brandt(PIXELS, NUMBERS_AND_D4)), 1e-6
    ),
    "kornia.geometry.calibration.distort_points": lambda: (
        (ct.Warp(pinhole(), lens()).transform_points(PIXELS)[0], calibration.distort_points(PIXELS, MATRIX, D5)), 1e-9
    ),
    "kornia.geometry.calibration.tilt_projection": lambda: (
        (
            ct.BrownConrady(NUMBERS, TILTED).project(POINTS)[0],
            geometry.transform_points(
                calibration.tilt_projection(*TILTED[-2:])[None], ct.BrownConrady(UNIT, D5).project(POINTS)[0][None]
            )[0] * NUMBERS[:2] + NUMBERS[2:],
        ),
        1e-9,
    ),
    "kornia.geometry.conversions.axis_angle_to_rotation_matrix": lambda: (
        (POSE.matrix()[:3, :3], geometry.axis_angle_to_rotation_matrix(POSE.rotation[None])[0]), 1e-6
    ),
    "kornia.geometry.conversions.normalize_pixel_coordinates": lambda: (
        (geometry.normalize_pixel_coordinates(torch.tensor([[0.0, 0], [159, 119]]), *SIZE), [[-1.0, -1], [1, 1]]),
        (ct.Warp(pinhole(), pinhole()).grid()[0, 0, 0], [1 / SIZE[1] - 1, 1 / SIZE[0] - 1]),
        1e-5,
    ),
    "kornia.geometry.conversions.camtoworld_graphics_to_vision_4x4": lambda: (  # y up, z back
        (
            geometry.camtoworld_graphics_to_vision_4x4((POSE.inverse().matrix() @ GRAPHICS)[None])[0],
            POSE.inverse().matrix(),
        ),
        1e-9,
    ),
    f"{of_rig}.compose_transformations {of_rig}.relative_transformation": lambda: (
        (POSE.compose(SECOND).matrix(), geometry.compose_transformations(*matrices(POSE, SECOND))[0]),
        (POSE.inverse().compose(SECOND).matrix(), geometry.relative_transformation(*matrices(POSE, SECOND))[0]),
        1e-9,
    ),
    "kornia.sensors.camera.CameraModel": lambda: (
        (
            ct.BrownConrady(NUMBERS, TILTED[:8]).project(POINTS)[0],
            sensors.CameraModel(
                ImageSize(*SIZE), sensors.CameraModelType.BROWN_CONRADY, torch.cat([NUMBERS, TILTED[:8]])
            ).project(Vector3(POINTS)).data,
        ),
        1e-9,
    ),
    "kornia.sensors.camera.KannalaBrandtK3": lambda: (
        (fisheye().project(POINTS)[0], K3(ImageSize(*SIZE), NUMBERS_AND_D4).project(Vector3(POINTS)).data), 1e-9
    ),
    "kornia.sensors.camera.PinholeModel": lambda: (
        (pinhole().project(POINTS)[0], sensors.PinholeModel(ImageSize(*SIZE), NUMBERS).project(Vector3(POINTS)).data),
        1e-9,
    ),
    "kornia.augmentation.RandomHorizontalFlip": lambda: (
        (ours(ct.augment.HorizontalFlip(p=1.0))[0], kornias(K.RandomHorizontalFlip(p=1.0))[0]),
        (ours(ct.augment.VerticalFlip(p=1.0))[0], kornias(K.RandomVerticalFlip(p=1.0))[0]),
        1e-9,
    ),
    "kornia.augmentation.RandomRotation": lambda: (
        (ours(leaning(20.0))[0], kornias(K.RandomRotation((20.0, 20.0), p=1.0))[0]), 1e-3
    ),
})  # fmt: skip


def matrices(*poses):
    return [pose.matrix()[None] for pose in poses]


def leaning(roll):
    camera = ct.Pinhole([75.0, 75.0, 79.5, 59.5], image_size=SIZE).requires_grad_(False)
    return ct.augment.RandomMount(yaw=None, pitch=None, roll=(roll, roll), camera=camera, min_filled=0)


@row("kornia.geometry.camera.StereoCamera", "kornia.geometry.depth.depth_from_disparity")
def stereo_camera():
    shift = ct.Extrinsics(np.zeros(3), np.array([-0.12, 0.0, 0.0])).requires_grad_(False)
    pair = ct.rectify(pinhole(), pinhole(), shift)
    found = pair.opencv()
    stereo = geometry.camera.StereoCamera(found["P1"][None], found["P2"][None])
    height, width = pair.camera_left.image_size
    disparity = torch.linspace(5, 50, height * width, dtype=torch.float64).view(1, 1, height, width)
    points, valid = pair.disparity_to_points(disparity)
    assert valid.all()
    close(points[:, 0], stereo.reproject_disparity_to_3D(disparity.permute(0, 2, 3, 1)))
    focal = found["P1"][0, 0].item()
    close(points[..., 2], geometry.depth.depth_from_disparity(disparity, 0.12, focal), 1e-6)


@row("kornia.geometry.calibration.undistort_points")
def undistort_points():
    found, _ = ct.Warp(lens(), pinhole(OTHER)).transform_points(PIXELS)
    close(found, calibration.undistort_points(PIXELS, MATRIX, D5, OTHER, num_iters=200), 1e-6)
    assert (found - calibration.undistort_points(PIXELS, MATRIX, D5, OTHER)).abs().max() > 1e-3


@row("kornia.geometry.calibration.undistort_image", "kornia.geometry.transform.remap")
def undistort_image():
    warp = ct.Warp(lens(), pinhole())
    assert shown(warp, calibration.undistort_image(image(), MATRIX[None], D5[None])) < 1e-9
    assert warp(as_images(photograph())).dtype == torch.uint8
    maps = (((warp.grid().double()[..., i] + 1) * size - 1) / 2 for i, size in enumerate(SIZE[::-1]))
    assert shown(warp, geometry.remap(image(), *maps, align_corners=True)) < 1e-3


@row("kornia.geometry.calibration.solve_pnp_dlt", slow=True)
def solve_pnp():
    seen, _ = pinhole()(POSE(POINTS))
    found, _, valid = ct.solve_pnp(pinhole(), POINTS[None], seen[None])
    assert valid.all()
    close(found.matrix()[:, :3], geometry.solve_pnp_dlt(POINTS[None], seen[None], MATRIX[None]), 1e-6)
    flat = POINTS[:4] * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, 0.0, 2.0])
    found, _, valid = ct.solve_pnp(fisheye(), flat, fisheye()(POSE(flat))[0])
    assert valid
    close(found.matrix(), POSE.matrix(), 1e-6)


@row("kornia.geometry.transform.warp_perspective")
def warp_perspective():
    turn = POSE.matrix()[:3, :3]
    warp = ct.Warp(pinhole(), pinhole(OTHER), turn)
    theirs = geometry.warp_perspective(image(), (OTHER @ turn @ MATRIX.inverse())[None], SIZE)
    assert shown(warp, theirs) < 1e-3


@row("kornia.geometry.transform.resize")
def edits():
    ray, _ = pinhole().unproject(torch.tensor([100.0, 30.0], dtype=torch.float64))
    spot = torch.zeros(1, 1, *SIZE)
    spot[..., 30, 100] = 1
    for function, camera, mirror in (
        (geometry.hflip, pinhole().hflip(), [-1, 1, 1]),
        (geometry.vflip, pinhole().vflip(), [1, -1, 1]),
    ):
        place = function(spot)[0, 0].nonzero()[0].flip(0)
        close(camera.project(ray * torch.tensor(mirror))[0], place.double(), 1e-9)
    line = torch.zeros(1, 1, *SIZE)
    line[..., 100:102] = 1  # its middle is at column 100.5
    small = geometry.resize(line, (60, 80), align_corners=False, antialias=False)[0, 0, 30]
    ray, _ = pinhole().unproject(torch.tensor([100.5, 59.5], dtype=torch.float64))
    middle = (small * torch.arange(80)).sum() / small.sum()
    assert pinhole().resize(60, 80).project(ray)[0][0].item() == pytest.approx(middle.item(), abs=1e-5)


@row("kornia.geometry.depth.depth_to_3d")
def depth_to_3d():
    for kind in ("z", "distance"):
        found, _ = pinhole().backproject(depth(), kind=kind)
        by_distance = kind == "distance"
        close(found, geometry.depth.depth_to_3d_v2(depth()[:, 0], MATRIX[None], normalize_points=by_distance))
        channels = geometry.depth.depth_to_3d(depth(), MATRIX[None], normalize_points=by_distance)
        close(found.permute(0, 3, 1, 2), channels)


@row("kornia.geometry.depth.warp_frame_depth", "kornia.geometry.depth.depth_warp")
def reproject():
    found, valid = ct.Reproject(pinhole(), pinhole(), POSE)(image(), depth())
    assert valid.float().mean() > 0.3
    for same in (
        geometry.depth.warp_frame_depth(image(), depth(), POSE.matrix()[None], MATRIX[None]),
        geometry.depth.depth_warp(theirs(POSE), theirs(NOWHERE), depth(), image(), *SIZE),
    ):
        assert (found - same).abs()[valid.expand_as(found)].max() < 1e-6


@row("kornia.geometry.epipolar.triangulate_points", slow=True)
def triangulate():
    seen = torch.stack([pinhole()(pose(POINTS))[0] for pose in (NOWHERE, POSE)])
    found, _, valid = ct.triangulate([pinhole(), pinhole()], [NOWHERE, POSE], seen)
    assert valid.all()
    projections = [(MATRIX @ pose.matrix()[:3])[None] for pose in (NOWHERE, POSE)]
    close(found, geometry.epipolar.triangulate_points(*projections, *seen[:, None])[0], 1e-6)


SPOT = torch.tensor([[[100.0, 30.0]]])


def kornias(augmentation, size=SIZE):
    """What becomes of SPOT, and the size of the image."""
    image, spot = K.AugmentationSequential(augmentation, data_keys=["input", "keypoints"])(
        torch.zeros(1, 1, *size), SPOT
    )
    return spot, image.shape[-2:]


def ours(augmentation):
    sample = augmentation(image=torch.zeros(1, 1, *SIZE), keypoints=SPOT)
    return sample["keypoints"], sample["image"].shape[-2:]


@row("kornia.augmentation.AugmentationSequential", "kornia.augmentation.AugmentationSequential.inverse")
def sequential():
    camera = pinhole().float()
    augmentation = front_end.RandomMount(camera, yaw=(5, 5), pitch=(0, 0), roll=(0, 0))
    pipeline = K.AugmentationSequential(augmentation, data_keys=["input", "keypoints"])
    image = torch.rand(1, 3, *SIZE)
    moved, spot = pipeline(image, SPOT)
    close(pipeline(image, SPOT, params=pipeline._params)[0], moved, 0)
    close(pipeline.inverse(moved, spot)[1], SPOT, 1e-3)
    assert augmentation.keypoints_valid.tolist() == [[True]]
    assert pipeline.transform_matrix.isnan().any()
    alone = ct.augment.RandomMount(camera=camera, yaw=(5, 5), pitch=(0, 0), roll=(0, 0))
    drawn = alone.draw(1)
    sample = ct.augment.Compose([alone], camera=camera)(image=image, keypoints=SPOT)
    close(sample["keypoints"], spot, 1e-3)
    close(alone.inverse(alone(image=image, keypoints=SPOT, draw=drawn))["keypoints"], SPOT, 1e-3)


@row("kornia.augmentation.RandomFisheye")
def random_fisheye():
    sample = ct.augment.RandomLens("kannala_brandt", fov=80.0, camera=pinhole().float(), min_filled=0)(keypoints=SPOT)
    assert isinstance(sample["camera"], ct.KannalaBrandt)
    assert (sample["keypoints"] - SPOT).abs().max() > 0.1


@row("kornia.augmentation.RandomPerspective")
def random_perspective():
    camera = pinhole()
    sample = ct.augment.RandomMount(camera=camera)(image=image(), keypoints=SPOT.double())
    homography = sample["camera"].K[0] @ sample["rotation"][0] @ MATRIX.inverse()
    close(sample["keypoints"], geometry.transform_points(homography[None], SPOT.double()), 1e-6)


@row("kornia.augmentation.RandomRotation90")
def quarter_turns():
    (spot, size), (theirs, kept) = ours(ct.augment.Rotate90(1)), kornias(K.RandomRotation90((1, 1), p=1.0))
    assert (tuple(size), tuple(kept)) == (SIZE[::-1], SIZE)
    # about the same middle, in images of other shape
    close(spot - torch.tensor([59.5, 79.5]), theirs - torch.tensor([79.5, 59.5]), 1e-3)


@row("kornia.augmentation.RandomResizedCrop")
def crops():
    (spot, size), (theirs, kept) = ours(ct.augment.CenterCrop((60, 80))), kornias(K.CenterCrop((60, 80), p=1.0))
    assert size == kept
    close(spot, theirs, 1e-3)
    for name in ("RandomResizedCrop", "RandomCrop"):
        assert ours(getattr(ct.augment, name)((60, 80)))[1] == kornias(getattr(K, name)((60, 80), p=1.0))[1]


@row("kornia.augmentation.Resize")
def resize():
    spot, _ = ours(ct.augment.Resize((60, 80)))
    close(spot, kornias(K.Resize((60, 80), align_corners=False))[0], 1e-4)
    close(spot[0, 0, 0], torch.tensor(49.75), 1e-4)
    close(kornias(K.Resize((60, 80)))[0][0, 0, 0], torch.tensor(100 * 79 / 159), 1e-3)
    found = cv2.resize(np.arange(160, dtype=np.float32)[None], (80, 1), interpolation=cv2.INTER_LINEAR)[0]
    np.testing.assert_allclose(np.interp(100.0, found, np.arange(80.0)), 49.75, atol=1e-4)


@trap
def behind_and_past():
    behind = torch.tensor([[0.1, 0.2, -1.0]], dtype=torch.float64)
    close(geometry.project_points(behind, MATRIX), geometry.project_points(-behind, MATRIX))
    assert not pinhole().project(behind)[1]
    weak = torch.tensor([0.01, 0.0, 0.0, 0.0], dtype=torch.float64)
    camera = ct.KannalaBrandt(NUMBERS, weak).requires_grad_(False)
    angle = torch.tensor(2.0, dtype=torch.float64)
    uv, valid = camera.project(torch.stack([angle.sin(), 0 * angle, angle.cos()]))
    found = geometry.camera.undistort_points_kannala_brandt(uv, torch.cat([NUMBERS, weak]))
    close(found[0], -angle.tan(), 1e-6)
    assert valid
    close(camera.unproject(uv)[0], torch.stack([angle.sin(), 0 * angle, angle.cos()]), 1e-9)


@trap
def whole_numbers():
    with pytest.raises(TypeError, match="uint8"):
        K.RandomHorizontalFlip(p=1.0)(torch.zeros(1, 3, 8, 8, dtype=torch.uint8))
    flip = ct.augment.HorizontalFlip(p=1.0)
    assert flip(image=torch.zeros(1, 3, 8, 8, dtype=torch.uint8))["image"].dtype == torch.uint8
