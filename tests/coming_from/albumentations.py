"""The rows of the page on albumentations."""

import inspect

import albumentations as A  # noqa: N812 (everybody's name for it)
import cv2
import numpy as np
import torch

import camtorch as ct
from camtorch.augment.numpy import Transform

from . import SIZE, elsewhere, equal, photograph, row, trap

HEIGHT, WIDTH = SIZE
SPOT = np.array([[100.0, 30.0]])
BOX = np.array([[10.0, 20.0, 30.0, 40.0]])
PINHOLE = ct.Pinhole([75.0, 75.0, 79.5, 59.5], image_size=SIZE).requires_grad_(False)


def blob(x=100.0, y=30.0):
    """(H, W) float32, bright about a pixel."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.exp(-((u - x) ** 2 + (v - y) ** 2) / 32).astype(np.float32)


def centroid(image):
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(image * u).sum(), (image * v).sum()]) / image.sum()


def theirs(*transforms, keypoints=SPOT, seed=0, remove=False):
    params = {"keypoint_params": A.KeypointParams("xy", remove_invisible=remove)}
    pipeline = A.Compose(list(transforms), **params, bbox_params=A.BboxParams("pascal_voc"), seed=seed)
    return pipeline(image=blob(), keypoints=keypoints, bboxes=BOX)


def ours(augmentation, keypoints=SPOT, **options):
    return Transform(augmentation)(image=blob(), keypoints=keypoints, bboxes=BOX - 0.5, **options)


def same(augmentation, *transforms, boxes=False):
    mine, found = ours(augmentation), theirs(*transforms)
    yield mine["keypoints"], found["keypoints"], 1e-3
    yield mine["image"].shape, found["image"].shape
    yield centroid(mine["image"]), centroid(found["image"]), 0.01
    if boxes:
        yield mine["bboxes"] + 0.5, found["bboxes"], 1e-4


def mount(**options):
    still = {"yaw": None, "pitch": None, "roll": None}
    return ct.augment.RandomMount(camera=PINHOLE, min_filled=0, **(still | options))


def by_homography():
    turned, matrix = mount(yaw=(5, 5)), PINHOLE.K.numpy()
    spot = matrix @ ours(turned)["rotation"] @ np.linalg.inv(matrix) @ np.append(SPOT[0], 1)
    return ours(turned)["keypoints"][0], spot[:2] / spot[2], 1e-3


def coloured():
    """Red is scaled about the middle, by as much as is asked for."""
    still = {"focal": None, "centre": None, "distortion": None}
    lens = ct.augment.RandomLens(camera=PINHOLE, chromatic=(0.05, 0.05), **still)
    image = Transform(lens)(image=np.repeat(blob()[..., None], 3, 2))["image"]
    red, green, middle = centroid(image[..., 0]), centroid(image[..., 1]), np.array([79.5, 59.5])
    return red - middle, (green - middle) * 1.05, 0.02


def resized():
    """Ours go with the image; theirs scale as x s, and its image by edges."""
    for size in ((60, 80), (240, 320)):
        mine = ours(ct.augment.Resize(size))
        yield mine["image"].shape, size
        yield mine["keypoints"][0], centroid(mine["image"]), 0.01
    yield centroid(theirs(A.Resize(60, 80))["image"]), np.array([49.75, 14.75]), 1e-3


def resized_crops():
    mine, found = ct.augment.RandomResizedCrop((60, 80)), A.RandomResizedCrop((60, 80), p=1)
    for pair in ((mine, found), (ct.augment.RandomCrop((60, 80)), A.RandomCrop(60, 80))):
        yield ours(pair[0])["image"].shape, theirs(pair[1])["image"].shape
    for name in ("scale", "ratio"):
        yield inspect.signature(ct.augment.RandomResizedCrop).parameters[name].default, getattr(found, name)


def of_a_part():
    """What is left of keypoints after theirs removed those outside."""
    spots = np.array([[1.0, 1.0], [80.0, 60.0]])
    mine = ours(ct.augment.CenterCrop((60, 80)), spots)
    found = A.Compose([A.CenterCrop(60, 80)], keypoint_params=A.KeypointParams("xy"))(image=blob(), keypoints=spots)
    return found["keypoints"], mine["keypoints"][mine["keypoints_valid"]], 1e-6


FLIPS = ct.augment.HorizontalFlip(p=1.0), ct.augment.VerticalFlip(p=1.0)
equal("albumentations", {
    "Compose": lambda: same(ct.augment.Compose(list(FLIPS)), A.HorizontalFlip(p=1), A.VerticalFlip(p=1)),
    "HorizontalFlip": lambda: [
        *same(FLIPS[0], A.HorizontalFlip(p=1), boxes=True), *same(FLIPS[1], A.VerticalFlip(p=1), boxes=True)
    ],
    "Rotate": lambda: same(mount(roll=(20, 20)), A.Rotate((20, 20), p=1)),
    "RandomCrop": lambda: same(ct.augment.CenterCrop((60, 80)), A.CenterCrop(60, 80)),
    "PadIfNeeded": lambda: same(ct.augment.Pad(size=(140, 180)), A.PadIfNeeded(140, 180)),
    "Perspective": lambda: [by_homography()],
    "ChromaticAberration": lambda: [coloured()],
    "Resize": resized,
    "RandomResizedCrop": resized_crops,
    "KeypointParams": lambda: [of_a_part()],
})  # fmt: skip
elsewhere("albumentations", {
    "ReplayCompose Compose.set_random_seed": "augment/test_albumentations.py::test_seeds_and_replays"
})  # fmt: skip


def optical(mode, k=0.3):
    if mode == "fisheye":
        radius = np.hypot(WIDTH / 2, HEIGHT / 2)
        intrinsics, distortion = np.array([radius, radius, WIDTH / 2, HEIGHT / 2]), np.array([k, 0.0, 0.0, 0.0])
        target = intrinsics
    else:
        intrinsics, distortion = np.array([WIDTH, HEIGHT, WIDTH / 2, HEIGHT / 2.0]), np.array([k, k, 0.0, 0.0])
        target = np.array([WIDTH, HEIGHT, (WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    lens, flat = ct.BrownConrady(intrinsics, distortion, image_size=SIZE), ct.Pinhole(target, image_size=SIZE)
    return ct.Warp(lens.requires_grad_(False), flat.requires_grad_(False))


@row("albumentations.OpticalDistortion")
def optical_distortion():
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    x, y = u - WIDTH / 2, v - HEIGHT / 2
    factor = 1 + 0.3 * (x**2 + y**2) / ((WIDTH / 2) ** 2 + (HEIGHT / 2) ** 2)
    matrix = np.array([[WIDTH, 0, WIDTH / 2], [0, HEIGHT, HEIGHT / 2], [0, 0, 1]])
    by_opencv = cv2.initUndistortRectifyMap(matrix, np.array([0.3, 0.3, 0, 0, 0]), None, None, (WIDTH, HEIGHT), 5)
    documented = {"fisheye": (x * factor + WIDTH / 2, y * factor + HEIGHT / 2), "camera": by_opencv}
    for mode, maps in documented.items():
        warp = optical(mode)
        seen = warp.valid_mask()[0, 0].numpy()
        positions = ((warp.grid()[0].numpy() + 1) * [WIDTH, HEIGHT] - 1) / 2
        np.testing.assert_allclose(positions[seen], np.stack(maps, -1)[seen], atol=1e-3)
        image = photograph().astype(np.float32) / 255
        distorted = A.Compose([A.OpticalDistortion((0.3, 0.3), mode=mode, p=1)])(image=image)["image"]
        mine = warp(torch.from_numpy(image).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy()
        assert np.abs(mine - distorted)[seen].max() < 0.01


@row("albumentations.RandomRotate90")
def quarter_turns():
    turned = {tuple(theirs(A.RandomRotate90(p=1), seed=seed)["keypoints"][0]) for seed in range(12)}
    assert turned <= {tuple(np.round(ours(ct.augment.Rotate90(times))["keypoints"][0], 3)) for times in range(4)}


@trap
def how_likely():
    assert (FLIPS[0].__class__().p, ct.augment.RandomLens(camera=PINHOLE).p) == (0.5, 1)
    assert {getattr(A, name)().p for name in ("OpticalDistortion", "Rotate", "HorizontalFlip", "VerticalFlip")} == {0.5}
