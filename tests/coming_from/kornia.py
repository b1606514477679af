"""The rows of the page on kornia."""

import math

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

from . import SIZE, as_images, close, elsewhere, equal, photograph, pixels, plane, points, row, trap

MATRIX = torch.tensor([[75.0, 0, 79.5], [0, 77.5, 59.5], [0, 0, 1]], dtype=torch.float64)
OTHER = torch.tensor([[60.0, 0, 75.0], [0, 62.0, 58.0], [0, 0, 1]], dtype=torch.float64)
NUMBERS = torch.tensor([75.0, 77.5, 79.5, 59.5], dtype=torch.float64)
D5 = torch.tensor([-0.28, 0.1, 1e-3, -5e-4, -0.01], dtype=torch.float64)
D4 = torch.tensor([0.02, -0.01, 0.003, -0.001], dtype=torch.float64)
NUMBERS_AND_D4, ONE = torch.cat([NUMBERS, D4]), torch.full((50, 1), 2.5, dtype=torch.float64)
UNIT, GRAPHICS = torch.tensor([1.0, 1, 0, 0]).double(), torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]).double())
TILTED = torch.cat([D5, torch.zeros(7), torch.tensor([0.02, -0.01])]).double()
VECTORS = np.array([[0.1, -0.2, 0.05, 0.1, 0.2, 0.3], [0.3, 0.1, -0.2, 1.0, 2.0, 3.0], 6 * [0], [0, 0, 0, -0.12, 0, 0]])
POSE, SECOND, NOWHERE, BESIDE = (ct.Extrinsics(v[:3], v[3:]).requires_grad_(False) for v in VECTORS)
POINTS, PIXELS = torch.from_numpy(points()), torch.from_numpy(pixels())
PINHOLE, OTHERS = (ct.Pinhole.from_matrix(m, image_size=SIZE).requires_grad_(False) for m in (MATRIX, OTHER))
LENS = ct.BrownConrady.from_matrix(MATRIX, D5, image_size=SIZE).requires_grad_(False)
FISHEYE = ct.KannalaBrandt(NUMBERS, D4, image_size=SIZE).requires_grad_(False)
SCALES = torch.linspace(0.9, 1.1, len(POINTS)).double()[:, None]  # for a camera of each point, as theirs have batches
SQUARE = ct.Pinhole([75.0, 75.0, 79.5, 59.5], image_size=SIZE).requires_grad_(False)
DEPTH = 2 + torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
IMAGE = as_images(photograph()).double() / 255
SPOT = torch.tensor([[[100.0, 30.0]]])
calibration, camera = geometry.calibration, geometry.camera


def theirs(pose=POSE):
    intrinsics = torch.eye(4, dtype=torch.float64)[None].clone()
    intrinsics[:, :3, :3] = MATRIX
    return geometry.PinholeCamera(intrinsics, pose.matrix()[None], torch.tensor([SIZE[0]]), torch.tensor([SIZE[1]]))


def posed(numbers):
    """A batch of theirs from intrinsics, rotation and translation (B, 10)."""
    matrices, sides = torch.eye(4).double().repeat(len(numbers), 1, 1), (torch.full((len(numbers),), n) for n in SIZE)
    matrices[:, :3, :3] = ct.Pinhole(numbers[:, :4]).K
    return geometry.PinholeCamera(matrices, ct.Extrinsics(numbers[:, 4:7], numbers[:, 7:]).matrix(), *sides)


def both_ways(make, numbers):
    """Pixels, and gradients of numbers: of ours made of theirs, and of theirs, itself and made of ours."""
    theirs = make(numbers.requires_grad_())
    ours, pose = ct.from_kornia(theirs)
    if isinstance(theirs, geometry.PinholeCamera):
        points = POINTS.expand(len(numbers), -1, 3)
        found = [one.project(points) for one in (theirs, ours.to_kornia(pose))]
    else:
        points = POINTS
        found = [one.project(Vector3(points)).data for one in (theirs, ours.to_kornia())]
    found = [(p, torch.autograd.grad(p.sum(), numbers, retain_graph=True)[0]) for p in (ours(pose(points))[0], *found)]
    return [(mine, its, 1e-8) for other in found[1:] for mine, its in zip(found[0], other, strict=True)]


def lifted(camera=PINHOLE, depth=2.5):
    """Points at a depth of the pixels."""
    return torch.nn.functional.pad(plane(camera.unproject(PIXELS)[0]), (0, 1), value=1.0) * depth


def shown(warp, theirs, image=IMAGE):
    """The pair of images, where ours is valid."""
    valid = warp.valid_mask().expand_as(theirs)
    return warp(image)[valid], theirs[valid]


def both_see():
    return torch.stack([PINHOLE(pose(POINTS))[0] for pose in (NOWHERE, POSE)])


def positions(warp):
    """(x, y) that a warp samples at, each (1, H, W)."""
    return (((warp.grid().double()[..., i] + 1) * size - 1) / 2 for i, size in enumerate(SIZE[::-1]))


def moved(augmentation):
    sample = augmentation(image=torch.zeros(1, 1, *SIZE), keypoints=SPOT)
    return sample["keypoints"], sample["image"].shape[-2:]


def kornias(name, *values, **options):
    augmentation = getattr(K, name)(*values, p=1.0, **options)
    pipeline = K.AugmentationSequential(augmentation, data_keys=["input", "keypoints"])
    image, spot = pipeline(torch.zeros(1, 1, *SIZE), SPOT)
    return spot, image.shape[-2:]


def turned(**options):
    return ct.augment.RandomMount(min_filled=0, **({"yaw": None, "pitch": None, "camera": SQUARE} | options))


def by_disparity():
    """Points of a rectified pair, by its own matrices."""
    pair = ct.rectify(PINHOLE, PINHOLE, BESIDE)
    found, (height, width) = pair.opencv(), pair.camera_left.image_size
    stereo = geometry.camera.StereoCamera(found["P1"][None], found["P2"][None])
    disparity = torch.linspace(5, 50, height * width, dtype=torch.float64).view(1, 1, height, width)
    ours, focal = pair.disparity_to_points(disparity)[0], found["P1"][0, 0].item()
    return [
        (ours[:, 0], stereo.reproject_disparity_to_3D(disparity.permute(0, 2, 3, 1))),
        (ours[..., 2], geometry.depth.depth_from_disparity(disparity, 0.12, focal), 1e-6),
    ]


def reprojected():
    ours, valid = ct.Reproject(PINHOLE, PINHOLE, POSE)(IMAGE, DEPTH)
    valid = valid.expand_as(ours)
    for same in (
        geometry.depth.warp_frame_depth(IMAGE, DEPTH, POSE.matrix()[None], MATRIX[None]),
        geometry.depth.depth_warp(theirs(POSE), theirs(NOWHERE), DEPTH, IMAGE, *SIZE),
    ):
        yield ours[valid], same[valid], 1e-6


def backprojected():
    for kind in ("z", "distance"):
        found, options = PINHOLE.backproject(DEPTH, kind=kind)[0], {"normalize_points": kind == "distance"}
        yield found, geometry.depth.depth_to_3d_v2(DEPTH[:, 0], MATRIX[None], **options)
        yield found.permute(0, 3, 1, 2), geometry.depth.depth_to_3d(DEPTH, MATRIX[None], **options)


def by_homography():
    sample = turned(camera=PINHOLE, yaw=5, pitch=5)(image=IMAGE, keypoints=SPOT.double())
    homography = sample["camera"].K[0] @ sample["rotation"][0] @ MATRIX.inverse()
    return sample["keypoints"], geometry.transform_points(homography[None], SPOT.double()), 1e-6


def crops():
    """Their sizes, and where the middle one lies."""
    for name in ("CenterCrop", "RandomResizedCrop", "RandomCrop"):
        yield moved(getattr(ct.augment, name)((60, 80)))[1], kornias(name, (60, 80))[1]
    yield moved(ct.augment.CenterCrop((60, 80)))[0], kornias("CenterCrop", (60, 80))[0], 1e-3


def resized():
    """Pixel edges scale, as OpenCV's; kornia's corners do unless it is told."""
    spot, _ = moved(ct.augment.Resize((60, 80)))
    small = cv2.resize(np.arange(160, dtype=np.float32)[None], (80, 1), interpolation=cv2.INTER_LINEAR)[0]
    yield spot, kornias("Resize", (60, 80), align_corners=False)[0], 1e-4
    yield spot[0, 0, 0], np.float32(49.75), 1e-4
    yield np.interp(100.0, small, np.arange(80.0)), np.float64(49.75), 1e-4
    yield kornias("Resize", (60, 80))[0][0, 0, 0], np.float32(100 * 79 / 159), 1e-3


def edited():
    """Where a pixel goes with its image, the camera of the edited image sees its ray."""
    ray, _ = PINHOLE.unproject(torch.tensor([100.0, 30.0], dtype=torch.float64))
    image = torch.zeros(1, 1, *SIZE)
    image[..., 30, 100] = 1
    for name, mirror in (("hflip", [-1, 1, 1]), ("vflip", [1, -1, 1])):
        place = getattr(geometry, name)(image)[0, 0].nonzero()[0].flip(0)
        yield getattr(PINHOLE, name)().project(ray * torch.tensor(mirror))[0], place.double()
    line = torch.zeros(1, 1, *SIZE)
    line[..., 100:102] = 1  # its middle is at column 100.5
    small = geometry.resize(line, (60, 80), align_corners=False, antialias=False)[0, 0, 30]
    ray, _ = PINHOLE.unproject(torch.tensor([100.5, 59.5], dtype=torch.float64))
    yield PINHOLE.resize(60, 80).project(ray)[0][0], (small * torch.arange(80)).sum() / small.sum(), 1e-5


equal("kornia.geometry", {
    "camera.PinholeCamera": lambda: both_ways(posed, torch.cat([NUMBERS.expand(2, 4), torch.tensor(VECTORS[:2])], 1)),
    "camera.PinholeCamera.project camera.PinholeCamera.unproject": lambda: [
        (PINHOLE(POSE(POINTS))[0], theirs().project(POINTS[None])[0]),
        (POSE.inverse()(lifted()), theirs().unproject(PIXELS[None], ONE[None])[0]),
    ],
    "camera.PinholeCamera.scale": lambda: [(
        theirs().scale(torch.tensor([0.5]).double()).camera_matrix[0][[0, 1, 0, 1], [0, 1, 2, 2]],
        PINHOLE.resize(60, 80).intrinsics + torch.tensor([0, 0, 0.25, 0.25]),
    )],
    "camera.project_points camera.unproject_points": lambda: [
        (PINHOLE.project(POINTS)[0], geometry.project_points(POINTS, MATRIX)),
        (lifted(), geometry.unproject_points(PIXELS, ONE, MATRIX)),
        (PINHOLE.unproject(PIXELS)[0] * ONE, geometry.unproject_points(PIXELS, ONE, MATRIX, normalize=True)),
    ],
    "camera.distort_points_kannala_brandt camera.undistort_points_kannala_brandt": lambda: [
        (FISHEYE.project(POINTS)[0], camera.distort_points_kannala_brandt(plane(POINTS), NUMBERS_AND_D4)),
        (plane(lifted(FISHEYE)), camera.undistort_points_kannala_brandt(PIXELS, NUMBERS_AND_D4), 1e-6),
    ],
    "camera.StereoCamera depth.depth_from_disparity": by_disparity,
    "calibration.distort_points": lambda: [
        (ct.Warp(PINHOLE, LENS).transform_points(PIXELS)[0], calibration.distort_points(PIXELS, MATRIX, D5))
    ],
    "calibration.undistort_points": lambda: [(
        ct.Warp(LENS, OTHERS).transform_points(PIXELS)[0],
        calibration.undistort_points(PIXELS, MATRIX, D5, OTHER, num_iters=200), 1e-6,
    )],
    "calibration.undistort_image transform.remap": lambda: [
        shown(ct.Warp(LENS, PINHOLE), calibration.undistort_image(IMAGE, MATRIX[None], D5[None])),
        (*shown(ct.Warp(LENS, PINHOLE),
                geometry.remap(IMAGE, *positions(ct.Warp(LENS, PINHOLE)), align_corners=True)), 1e-3),
    ],
    "calibration.tilt_projection": lambda: [(
        ct.BrownConrady(NUMBERS, TILTED).project(POINTS)[0],
        geometry.transform_points(
            calibration.tilt_projection(*TILTED[-2:])[None], ct.BrownConrady(UNIT, D5).project(POINTS)[0][None]
        )[0] * NUMBERS[:2] + NUMBERS[2:],
    )],
    "transform.warp_perspective": lambda: [(*shown(
        ct.Warp(PINHOLE, OTHERS, POSE.matrix()[:3, :3]),
        geometry.warp_perspective(IMAGE, (OTHER @ POSE.matrix()[:3, :3] @ MATRIX.inverse())[None], SIZE),
    ), 1e-3)],
    "transform.resize": edited,
    "depth.depth_to_3d": backprojected,
    "depth.warp_frame_depth depth.depth_warp": reprojected,
    "conversions.axis_angle_to_rotation_matrix": lambda: [
        (POSE.matrix()[:3, :3], geometry.axis_angle_to_rotation_matrix(POSE.rotation[None])[0], 1e-6)
    ],
    "conversions.normalize_pixel_coordinates": lambda: [
        (geometry.normalize_pixel_coordinates(torch.tensor([[0.0, 0], [159, 119]]), *SIZE), [[-1.0, -1], [1, 1]], 1e-5),
        (ct.Warp(PINHOLE, PINHOLE).grid()[0, 0, 0], [1 / SIZE[1] - 1, 1 / SIZE[0] - 1], 1e-5),
    ],
    "conversions.camtoworld_graphics_to_vision_4x4": lambda: [(  # y up, z back
        geometry.camtoworld_graphics_to_vision_4x4((POSE.inverse().matrix() @ GRAPHICS)[None])[0],
        POSE.inverse().matrix(),
    )],
    "linalg.compose_transformations linalg.relative_transformation": lambda: [
        (p.compose(SECOND).matrix(), theirs(POSE.matrix()[None], SECOND.matrix()[None])[0])
        for p, theirs in ((POSE, geometry.compose_transformations), (POSE.inverse(), geometry.relative_transformation))
    ],
})  # fmt: skip
equal("kornia.geometry", {
    "calibration.solve_pnp_dlt": lambda: [(
        ct.solve_pnp(PINHOLE, POINTS[None], PINHOLE(POSE(POINTS))[0][None])[0].matrix()[:, :3],
        geometry.solve_pnp_dlt(POINTS[None], PINHOLE(POSE(POINTS))[0][None], MATRIX[None]), 1e-6,
    )],
    "epipolar.triangulate_points": lambda: [(
        ct.triangulate([PINHOLE] * 2, [NOWHERE, POSE], both_see())[0],
        geometry.epipolar.triangulate_points(
            *((MATRIX @ p.matrix()[:3])[None] for p in (NOWHERE, POSE)), *both_see()[:, None]
        )[0], 1e-6,
    )],
}, slow=True)  # fmt: skip
BROWN = sensors.CameraModelType.BROWN_CONRADY
equal("kornia.sensors.camera", {
    name: lambda make=make, numbers=numbers: both_ways(make, numbers) + both_ways(make, numbers * SCALES)
    for name, make, numbers in (
        ("CameraModel", lambda n: sensors.CameraModel(ImageSize(*SIZE), BROWN, n), torch.cat([NUMBERS, TILTED[:8]])),
        ("KannalaBrandtK3", lambda n: sensors.KannalaBrandtK3(ImageSize(*SIZE), n), NUMBERS_AND_D4),
        ("PinholeModel", lambda n: sensors.PinholeModel(ImageSize(*SIZE), n), NUMBERS),
    )
})  # fmt: skip
equal("kornia.augmentation", {
    "RandomHorizontalFlip": lambda: [
        (moved(ct.augment.HorizontalFlip(p=1.0))[0], kornias("RandomHorizontalFlip")[0]),
        (moved(ct.augment.VerticalFlip(p=1.0))[0], kornias("RandomVerticalFlip")[0]),
    ],
    "RandomRotation": lambda: [(moved(turned(roll=(20, 20)))[0], kornias("RandomRotation", (20.0, 20.0))[0], 1e-3)],
    "RandomRotation90": lambda: [  # about the same middle; kornia keeps the size
        (moved(ct.augment.Rotate90(1))[0] + torch.tensor([20, -20]), kornias("RandomRotation90", (1, 1))[0], 1e-3),
        (moved(ct.augment.Rotate90(1))[1], kornias("RandomRotation90", (1, 1))[1][::-1]),
    ],
    "RandomPerspective": lambda: [by_homography()],
    "RandomResizedCrop": crops,
    "Resize": resized,
})  # fmt: skip
elsewhere("kornia.augmentation", {
    "AugmentationSequential": "augment/test_kornia.py::test_replays_are_bit_identical",
    "AugmentationSequential.inverse": "augment/test_kornia.py::test_inverse",
})  # fmt: skip


@row("kornia.augmentation.RandomFisheye")
def random_fisheye():
    sample = ct.augment.RandomLens("kannala_brandt", fov=80.0, camera=PINHOLE.float(), min_filled=0)(keypoints=SPOT)
    assert isinstance(sample["camera"], ct.KannalaBrandt)
    assert (sample["keypoints"] - SPOT).abs().max() > 0.1


@trap
def behind_and_past():
    behind = torch.tensor([[0.1, 0.2, -1.0]], dtype=torch.float64)
    close(geometry.project_points(behind, MATRIX), geometry.project_points(-behind, MATRIX))
    assert not PINHOLE.project(behind)[1]
    weak = torch.tensor([0.01, 0.0, 0.0, 0.0], dtype=torch.float64)
    lens = ct.KannalaBrandt(NUMBERS, weak, image_size=SIZE).requires_grad_(False)
    ray = torch.tensor([math.sin(2), 0.0, math.cos(2)], dtype=torch.float64)
    uv, _ = lens.project(ray)
    close(camera.undistort_points_kannala_brandt(uv, torch.cat([NUMBERS, weak]))[0], -ray[0] / ray[2], 1e-6)
    close(lens.unproject(uv)[0], ray, 1e-9)
    close(lens.to_kornia().project(Vector3(ray)).data, lens.project(-ray)[0])


@trap
def few_steps_and_whole_numbers():
    found, _ = ct.Warp(LENS, OTHERS).transform_points(PIXELS)
    assert (found - calibration.undistort_points(PIXELS, MATRIX, D5, OTHER)).abs().max() > 1e-3
    with pytest.raises(TypeError, match="uint8"):
        K.RandomHorizontalFlip(p=1.0)(torch.zeros(1, 3, 8, 8, dtype=torch.uint8))
