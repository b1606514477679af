"""The rows of the page on albumentations."""

import functools
import inspect

import albumentations as A  # noqa: N812 (everybody's name for it)
import cv2
import numpy as np
import torch

import camtorch as ct
from camtorch.augment.numpy import Transform

from . import SIZE, photograph, row, trap

HEIGHT, WIDTH = SIZE
SPOT = np.array([[100.0, 30.0]])
BOX = np.array([[10.0, 20.0, 30.0, 40.0]])


def pinhole():
    return ct.Pinhole([75.0, 75.0, 79.5, 59.5], image_size=SIZE).requires_grad_(False)


def blob(x=100.0, y=30.0):
    """(H, W) float32, bright about a pixel."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.exp(-((u - x) ** 2 + (v - y) ** 2) / 32).astype(np.float32)


def centroid(image):
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(image * u).sum(), (image * v).sum()]) / image.sum()


def theirs(*transforms, keypoints=SPOT, seed=0, **options):
    pipeline = A.Compose(
        list(transforms),
        keypoint_params=A.KeypointParams("xy", remove_invisible=False),
        bbox_params=A.BboxParams("pascal_voc"),
        seed=seed,
    )
    return pipeline(image=blob(), keypoints=keypoints, bboxes=BOX, **options)


def ours(augmentation, keypoints=SPOT):
    return Transform(augmentation)(image=blob(), keypoints=keypoints, bboxes=BOX - 0.5)


def same(augmentation, transform, atol=1e-3):
    mine, found = ours(augmentation), theirs(transform)
    np.testing.assert_allclose(mine["keypoints"], found["keypoints"], atol=atol)
    assert mine["image"].shape == found["image"].shape
    np.testing.assert_allclose(centroid(mine["image"]), centroid(found["image"]), atol=0.01)
    return mine, found


@row("albumentations.Compose")
def compose():
    flips = ct.augment.HorizontalFlip(p=1.0), ct.augment.VerticalFlip(p=1.0)
    found = theirs(*[getattr(A, name)(p=1) for name in ("HorizontalFlip", "VerticalFlip")])
    np.testing.assert_allclose(ours(ct.augment.Compose(list(flips)))["keypoints"], found["keypoints"])


@row("albumentations.ReplayCompose", "albumentations.Compose.set_random_seed")
def replay():
    augment = ct.augment.RandomMount(camera=pinhole())
    transform, drawn = Transform(augment), augment.draw(1)
    once, twice = (transform(image=blob(), draw=drawn)["image"] for _ in range(2))
    np.testing.assert_array_equal(once, twice)
    seeded = [transform(image=blob(), generator=torch.Generator().manual_seed(3))["image"] for _ in range(2)]
    np.testing.assert_array_equal(*seeded)
    assert (once != seeded[0]).any()


def optical(mode, k=0.3):
    """As on the page."""
    if mode == "fisheye":
        radius = np.hypot(WIDTH / 2, HEIGHT / 2)
        intrinsics, distortion = np.array([radius, radius, WIDTH / 2, HEIGHT / 2]), np.array([k, 0.0, 0.0, 0.0])
        target = intrinsics
    else:
        intrinsics, distortion = np.array([WIDTH, HEIGHT, WIDTH / 2, HEIGHT / 2.0]), np.array([k, k, 0.0, 0.0])
        target = np.array([WIDTH, HEIGHT, (WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    lens, flat = ct.BrownConrady(intrinsics, distortion, image_size=SIZE), ct.Pinhole(target, image_size=SIZE)
    return ct.Warp(lens.requires_grad_(False), flat.requires_grad_(False))


def positions(warp):
    grid = warp.grid()[0].numpy()
    return [((grid[..., i] + 1) * size - 1) / 2 for i, size in enumerate((WIDTH, HEIGHT))]


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
        for found, wanted in zip(positions(warp), maps, strict=True):
            np.testing.assert_allclose(found[seen], wanted[seen], atol=1e-3)
        image = photograph().astype(np.float32) / 255
        distorted = A.Compose([A.OpticalDistortion((0.3, 0.3), mode=mode, p=1)])(image=image)["image"]
        mine = warp(torch.from_numpy(image).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy()
        assert np.abs(mine - distorted)[seen].max() < 0.01


@row("albumentations.ChromaticAberration")
def chromatic_aberration():
    image = np.repeat(blob()[..., None], 3, 2)
    still = {"focal": None, "centre": None, "distortion": None}
    lens = ct.augment.RandomLens(camera=pinhole(), chromatic=(0.05, 0.05), **still)
    red, green, _ = (centroid(channel) for channel in np.moveaxis(Transform(lens)(image=image)["image"], -1, 0))
    middle = np.array([79.5, 59.5])
    np.testing.assert_allclose(red - middle, (green - middle) * 1.05, atol=0.02)


@row("albumentations.Perspective")
def perspective():
    mount = ct.augment.RandomMount(yaw=(5, 5), pitch=(0, 0), roll=(0, 0), camera=pinhole(), min_filled=0)
    matrix = pinhole().K.numpy()
    spot = matrix @ ours(mount)["rotation"] @ np.linalg.inv(matrix) @ np.append(SPOT[0], 1)
    np.testing.assert_allclose(ours(mount)["keypoints"][0], spot[:2] / spot[2], atol=1e-3)


def leaning(roll):
    return ct.augment.RandomMount(yaw=None, pitch=None, roll=(roll, roll), camera=pinhole(), min_filled=0)


SAME = {
    "Rotate": lambda: (leaning(20), A.Rotate((20, 20), p=1)),
    "RandomCrop": lambda: (ct.augment.CenterCrop((60, 80)), A.CenterCrop(60, 80)),
    "PadIfNeeded": lambda: (ct.augment.Pad(size=(140, 180)), A.PadIfNeeded(140, 180)),
}
for _name, _pair in SAME.items():
    row(f"albumentations.{_name}")(functools.partial(lambda pair: same(*pair()), _pair))


@row("albumentations.HorizontalFlip")
def flips():
    for name in ("HorizontalFlip", "VerticalFlip"):
        mine, found = same(getattr(ct.augment, name)(p=1.0), getattr(A, name)(p=1))
        np.testing.assert_allclose(mine["bboxes"] + 0.5, found["bboxes"], atol=1e-4)


@row("albumentations.RandomRotate90")
def quarter_turns():
    turned = {tuple(theirs(A.RandomRotate90(p=1), seed=seed)["keypoints"][0]) for seed in range(12)}
    mine = {tuple(np.round(ours(ct.augment.Rotate90(times))["keypoints"][0], 3)) for times in range(4)}
    assert turned <= mine


@row("albumentations.Resize")
def resize():
    assert ours(ct.augment.Resize((60, 80)))["image"].shape == (60, 80)
    for size in ((60, 80), (240, 320)):
        mine = ours(ct.augment.Resize(size))
        np.testing.assert_allclose(mine["keypoints"][0], centroid(mine["image"]), atol=0.01)
    np.testing.assert_allclose(centroid(theirs(A.Resize(60, 80))["image"]), [49.75, 14.75], atol=1e-3)


@row("albumentations.RandomResizedCrop")
def resized_crops():
    mine, found = ct.augment.RandomResizedCrop((60, 80)), A.RandomResizedCrop((60, 80), p=1)
    for pair in ((mine, found), (ct.augment.RandomCrop((60, 80)), A.RandomCrop(60, 80))):
        assert ours(pair[0])["image"].shape == theirs(pair[1])["image"].shape
    for name in ("scale", "ratio"):
        usual = inspect.signature(ct.augment.RandomResizedCrop).parameters[name].default
        np.testing.assert_allclose(usual, getattr(found, name))


@row("albumentations.KeypointParams")
def keypoints():
    outside = np.array([[1.0, 1.0], [80.0, 60.0]])
    mine = ours(ct.augment.CenterCrop((60, 80)), outside)
    assert mine["keypoints_valid"].tolist() == [False, True]
    pipeline = A.Compose([A.CenterCrop(60, 80)], keypoint_params=A.KeypointParams("xy"))
    found = pipeline(image=blob(), keypoints=outside)["keypoints"]
    np.testing.assert_allclose(found, mine["keypoints"][mine["keypoints_valid"]])


@trap
def how_likely():
    assert ct.augment.HorizontalFlip().p == 0.5
    assert ct.augment.RandomLens(camera=pinhole()).p == 1
    assert [getattr(A, name)().p for name in ("OpticalDistortion", "Rotate", "HorizontalFlip", "VerticalFlip")] == [
        0.5
    ] * 4
