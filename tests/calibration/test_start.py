"""Calibrations that start from nothing end where those end that start from the truth."""

import math
import random

import boards
import pytest
import torch

import camtorch as ct
from camtorch.poses.rotations import rotation_matrix

SIZE = (480, 640)
DISTORTION = {
    "pinhole": None,
    "brown_conrady": (-0.28, 0.08, 1e-3, -5e-4, 0.02),
    "kannala_brandt": (-0.04, 0.01, -0.004, 0.0005),
    "fisheye624": (0.02, -0.01, 0.003, -5e-4, 1e-4, -1e-5, 1e-3, -8e-4, 1e-3, -5e-4, 8e-4, 2e-4),
    "double_sphere": (-0.2, 0.58),
}


def a_camera(key, degrees, seed=0):
    """Of a field of view, with its principal point off the middle and pixels that are not quite square."""
    rng, values = random.Random(seed), DISTORTION[key]
    more = {} if values is None else {"distortion": torch.tensor(values, dtype=torch.float64)}
    camera = ct.MODELS[key].from_fov(degrees, image_size=SIZE, **more)
    fx, fy, cx, cy = camera.intrinsics.detach().double().tolist()
    intrinsics = [fx, fy * rng.uniform(0.99, 1.01), cx + rng.uniform(-15, 15), cy + rng.uniform(-10, 10)]
    return ct.MODELS[key](torch.tensor(intrinsics, dtype=torch.float64), image_size=SIZE, **more)


def seen_by(camera, degrees, views, noise, seed):
    """Views of a board that takes a third to two thirds of the image."""
    wide = math.radians(min(degrees, 90.0))
    reach = 0.12 / math.tan(wide / 4)
    placed = {"near": 0.9 * reach, "far": 2 * reach, "tilt": 50.0}
    seen, rotations, translations = boards.seen_by(camera, views, noise=noise, seed=seed, **placed)
    whole = (~seen.image_points.isnan().any(-1)).sum(-1) >= 20
    return seen._replace(image_points=seen.image_points[whole]), rotations[whole], translations[whole]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "key"), [(i % 2, key) for i, key in enumerate(DISTORTION)])
def test_nothing_has_to_be_known(seed, key):
    widest = {"pinhole": 115, "brown_conrady": 85}.get(key, 195)
    degrees, noise = random.Random(f"{key}{seed}").uniform(30, widest), (0.1, 0.8)[seed]
    camera = a_camera(key, degrees, seed)
    seen, _, _ = seen_by(camera, degrees, 14, noise, seed)
    found = ct.calibrate(key, *seen[:2], image_size=SIZE, count=len(camera.distortion_names))
    best = ct.calibrate(key, *seen[:2], start=camera, image_size=SIZE)
    assert found.converged
    # a search may end in a place that is better than the one next to the truth
    assert found.rms <= best.rms * (1 + 1e-6)
    assert found.rms < 1.1 * noise * 2**0.5


def test_a_model_that_errs_and_loses_a_few_corners_says_so():
    camera = a_camera("kannala_brandt", 190).requires_grad_(False)
    seen, _, _ = seen_by(camera, 190, 14, 0.2, 1)
    is_far = camera.unproject(seen.image_points.nan_to_num())[0][..., 2] < math.cos(math.radians(88))
    too_many = is_far & (is_far.flatten().cumsum(0).view(is_far.shape) > 4)
    pixels = seen.image_points.masked_fill(too_many[..., None], torch.nan)
    pixels = pixels[(~pixels.isnan().any(-1)).sum(-1) >= 20]
    with pytest.raises(ValueError, match=r"for all corners; got Pinhole, without \d+ of \d+\. Use"):
        ct.calibrate("pinhole", seen.object_points, pixels, image_size=SIZE)


def test_the_better_of_two_poses_that_look_alike():
    camera = a_camera("pinhole", 12).requires_grad_(False)
    seen, rotations, _ = seen_by(camera, 12, 30, 0.05, 3)
    found = ct.calibrate(camera, *seen[:2], image_size=SIZE, fixed="all").extrinsics
    cosine = (rotation_matrix(found.rotation.detach())[..., 2] * rotations[..., 2]).sum(-1)
    assert float(cosine.amin()) > math.cos(math.radians(3))


@pytest.mark.slow
def test_poses_are_looked_at_again_by_the_camera_that_was_found():
    """Pixels twice as high as wide: the search from nothing takes them as square, and a view's other pose with it."""
    intrinsics = a_camera("pinhole", 60, 2).intrinsics.detach() * torch.tensor([1.0, 2, 1, 1])
    camera = ct.Pinhole(intrinsics, image_size=SIZE)
    seen, _, _ = seen_by(camera, 60, 10, 0.3, 2)
    found = ct.calibrate("pinhole", *seen[:2], image_size=SIZE)
    assert found.converged
    assert found.rms < 0.45


@pytest.mark.slow
def test_wide_lenses_of_few_views():
    camera = a_camera("kannala_brandt", 185).requires_grad_(False)
    seen, _, _ = seen_by(camera, 185, 5, 0.2, 4)
    found = ct.calibrate("kannala_brandt", *seen[:2], image_size=SIZE, count=2, fixed=("cx", "cy")).camera
    assert found.intrinsics[2:].tolist() == [319.5, 239.5]
    assert abs(found.fx.item() / camera.fx.item() - 1) < 0.1
