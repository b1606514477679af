"""Rectification of any two cameras: rows correspond, disparities give the points, and it agrees with OpenCV's."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from cameras import KEYS, fisheye, one

import camtorch as ct
from camtorch.poses.rotations import rotation_matrix
from camtorch.stereo.rectification import Rectification

PROJECTIONS = ("perspective", "latlon", "cylindrical")
LENSES = {"left": ([500.0, 505, 320, 240], [-0.2, 0.05, 0.001, -0.001, 0.0])}
LENSES |= {"right": ([520.0, 515, 330, 235], [-0.1, 0.02, -0.001, 0.001, 0.0])}
TURN, SHIFT = [0.02, -0.05, 0.01], [-0.12, 0.005, 0.004]
WIDE = fisheye((480, 640), 0.28, torch.float64)


def sized(key):
    camera = one(key).double().requires_grad_(False)
    camera.image_size = camera.image_size or (480, 640)
    return camera


def pair():
    left, right = (ct.BrownConrady(*LENSES[side], image_size=(480, 640)).double() for side in LENSES)
    return left, right, ct.Extrinsics(TURN, SHIFT).double()


def fisheyes(pitch=0.0, **options):
    extrinsics = ct.Extrinsics([pitch, 0, 0], [-0.1, 0, 0]).double().requires_grad_(False)
    return ct.rectify(WIDE, WIDE, extrinsics, **options)


def random_pair(seed, vertical=False):
    """Two models, where they are, points around them, and these seen by both; the last in rectified frames."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    keys = [KEYS[int(i)] for i in torch.randint(len(KEYS), (2,), generator=generator)]
    turn, place = 0.3 * normal(3), normal(3) * torch.tensor([1, 0.2, 0.2])
    place = place[[1, 0, 2]] if vertical else place
    extrinsics = ct.Extrinsics(turn, -(rotation_matrix(turn) @ place)).double().requires_grad_(False)
    points = torch.nn.functional.normalize(normal(2000, 3), dim=-1) * place.norm() * (2 + 20 * normal(2000, 1).abs())
    return *map(sized, keys), extrinsics, points


def shift_of(found):
    return torch.tensor([1.0, 0, 0]).double() * found.baseline


def disparities(found, points):
    left, right = found.camera_left.project(points)[0], found.camera_right.project(points - shift_of(found))[0]
    return (left - right)[..., 0]


@pytest.mark.parametrize("vertical", [False, True])
@pytest.mark.parametrize("projection", PROJECTIONS)
@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 8), marks=pytest.mark.slow)])
def test_rows_correspond_and_disparities_give_the_points(projection, vertical, seeds):
    axis, across = (1, 0) if vertical else (0, 1)
    refused = 0
    for seed in seeds:
        left, right, extrinsics, points = random_pair(seed, vertical)
        try:
            found = ct.rectify(left, right, extrinsics, projection=projection, vertical=vertical)
        except ValueError as error:  # of a few narrow lenses that look apart
            if "what both cameras see" not in str(error):
                raise
            refused += 1
            continue
        camera = found.camera_left
        assert (camera.intrinsics[:2] > 0).all()
        of_left = points @ found.rotation_left.mT
        one, in_left = camera.project(of_left)
        other, in_right = camera.project(extrinsics(points) @ found.rotation_right.mT)
        both = in_left & in_right & (one.abs() < 1e4).all(-1) & (other.abs() < 1e4).all(-1)
        assert both.any()
        one, other, of_left = one[both], other[both], of_left[both]
        assert ((one - other)[:, across].abs() < 1e-6).all()
        disparity = (one - other)[:, axis]
        # points as a map of one row
        again, good = found._points(one[None], disparity[None])
        assert good.all()
        error = (again[0] - of_left).norm(dim=-1) / of_left.norm(dim=-1)
        # a pixel's rounding counts in the ratio of coordinate and disparity
        condition = one.abs().amax(-1) / disparity.abs() + camera.intrinsics[:2].max() / disparity.abs()
        assert (error < 1e-13 * condition.clamp(min=1e3)).all()
    assert refused <= 0.02 * len(seeds)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_exchanged_cameras_have_negative_disparities_and_upright_images(projection):
    left, right, extrinsics = pair()
    one = ct.rectify(left, right, extrinsics, projection=projection)
    two = ct.rectify(right, left, extrinsics.inverse(), projection=projection)
    torch.testing.assert_close(two.baseline, -one.baseline)
    torch.testing.assert_close(two.rotation_left, one.rotation_right)
    torch.testing.assert_close(two.rotation_right, one.rotation_left)
    points = torch.tensor([[0.1, 0.2, 1.0], [-0.3, 0.1, 2.0]]).double()
    first, second = disparities(one, points), disparities(two, points - shift_of(one))
    scale = (one.camera_left.intrinsics[0] / two.camera_left.intrinsics[0]).item()
    torch.testing.assert_close(second * scale, -first)
    assert two.rotation_left[1, 1].item() > 0.9


def test_opencv_has_the_same_matrices():
    cv2 = pytest.importorskip("cv2")
    left, right, extrinsics = pair()
    found = ct.rectify(left, right, extrinsics, align="opencv", image_size=(480, 640))
    matrices = {name: value.detach().numpy() for name, value in found.opencv().items()}
    given = (m for camera in (left, right) for m in (camera.K.detach().numpy(), camera.distortion.detach().numpy()))
    rotation, shift = extrinsics.matrix()[:3, :3].detach().numpy(), np.array(SHIFT)[:, None]
    theirs = cv2.stereoRectify(*given, (640, 480), rotation, shift, flags=1024, alpha=0)
    np.testing.assert_allclose(matrices["R1"], theirs[0], atol=1e-12)
    np.testing.assert_allclose(matrices["R2"], theirs[1], atol=1e-12)
    # what the focal length does not change
    np.testing.assert_allclose(matrices["P2"][0, 3] / matrices["P2"][0, 0], theirs[3][0, 3] / theirs[3][0, 0])
    disparity = torch.rand(480, 640, generator=torch.Generator().manual_seed(0)).double() + 5
    points, valid = found.disparity_to_points(disparity)
    assert valid.all()
    by_q = cv2.reprojectImageTo3D(disparity.numpy().astype(np.float32), matrices["Q"])
    np.testing.assert_allclose(points.detach().numpy(), by_q, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_images_of_a_far_scene_are_the_same(projection):
    camera = WIDE
    extrinsics = ct.Extrinsics([0.05, 0.1, -0.03], [-0.1, 0.01, 0]).double().requires_grad_(False)
    found = ct.rectify(camera, camera, extrinsics, projection=projection)

    def scene(turn):
        rays = camera.unproject(camera.pixel_grid())[0] @ turn  # back to the left camera
        return (0.5 + 0.5 * torch.sin(9 * rays).prod(-1))[None, None]

    left, right = found(scene(torch.eye(3).double()), scene(extrinsics.matrix()[:3, :3]))
    both = found.left.valid_mask() & found.right.valid_mask()
    assert left.shape[-2:] == found.camera_left.image_size
    assert both.float().mean() > 0.5
    inner = torch.nn.functional.avg_pool2d(both.double(), 5, 1, 2) == 1
    assert (left - right)[inner].abs().max() < 0.02


def test_extrinsics_and_lenses_learn_through_both_images():
    left, right, extrinsics = pair()
    left.float(), right.float(), extrinsics.float()
    found = ct.rectify(left, right, extrinsics, image_size=(60, 80))
    one, other = found(torch.rand(1, 1, 480, 640), torch.rand(1, 1, 480, 640))
    (one.square().mean() + other.square().mean()).backward()
    for parameter in (*left.parameters(), *right.parameters(), *extrinsics.parameters()):
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().max() > 0
    with torch.no_grad():
        before = found.baseline
        extrinsics.translation *= 2
        torch.testing.assert_close(found.baseline, 2 * before)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_the_nearest_points_bound_disparities(projection):
    found = fisheyes(projection=projection, image_size=(240, 320))
    most = float(found.camera_left.fx * found.baseline / 0.5)
    rays, _ = found.camera_left.rays()
    depths = 0.5 + 0.1 * torch.rand(240, 320, generator=torch.Generator().manual_seed(0)).double()
    by_ray = rays[..., 2] if projection == "perspective" else torch.hypot(rays[..., 1], rays[..., 2])
    disparity = disparities(found, rays * (depths / by_ray)[..., None])
    assert float(disparity.min()) >= 0
    assert 0.9 * most < float(disparity.max()) <= most


def test_disparities_of_no_sense_are_invalid():
    found = fisheyes(image_size=(4, 5))
    disparity = torch.tensor([1.0, 0.0, -1.0, math.nan, math.inf]).double().expand(4, 5).contiguous()
    points, valid = found.disparity_to_points(disparity)
    assert valid.tolist() == [[True, False, False, False, False]] * 4
    assert points.isfinite().all()
    for known in (torch.zeros(4, 5, dtype=torch.bool), np.zeros((4, 5), bool)):
        points, valid = found.disparity_to_points(disparity, valid=known)
        assert not valid.any()
        assert not points.any()
    for shape in ((4, 5), (1, 4, 5), (2, 1, 4, 5)):
        points, valid = found.disparity_to_points(disparity.expand(shape))
        assert points.shape == (*shape, 3)
        assert valid.shape == shape


def test_a_batch_of_rigs_goes_pair_by_pair():
    left, right, _ = pair()
    left.requires_grad_(False), right.requires_grad_(False)
    turns, shifts = torch.tensor([[0.0, 0.05, 0], [0.02, 0, 0.01]]), torch.tensor([[-0.1, 0, 0], [-0.2, 0.01, 0]])
    extrinsics = ct.Extrinsics(turns, shifts).double().requires_grad_(False)
    many = ct.rectify(left, right, extrinsics, image_size=(60, 80))
    images = torch.rand(2, 3, 480, 640, generator=torch.Generator().manual_seed(0)).double()
    made = many(images, images)
    disparity = torch.full((2, 1, 60, 80), 7.0).double()
    points, valid = many.disparity_to_points(disparity)
    assert valid.all()
    for i in range(2):
        one = ct.rectify(left, right, extrinsics[i])
        one.camera_left = one.camera_right = many.camera_left[i]
        for whole, part in zip(made, one(images[i : i + 1], images[i : i + 1]), strict=True):
            torch.testing.assert_close(whole[i : i + 1], part, rtol=0, atol=1e-9)
        torch.testing.assert_close(one.disparity_to_points(disparity[i, 0])[0], points[i, 0])


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_field_of_view_and_size_are_as_asked(projection):
    found = fisheyes(projection=projection, fov=100, image_size=(300, 400))
    assert found.camera_left.image_size == (300, 400)
    assert found.camera_left.fov[0].item() == pytest.approx(100, rel=1e-6)
    both = fisheyes(projection=projection, fov=(86, 57))
    assert both.camera_left.fov[:2].tolist() == pytest.approx([86, 57], rel=0.01)
    # the height of the view is the default if one angle is given
    views = [fisheyes(projection=projection, fov=fov).camera_left for fov in (100, None)]
    wide, default = (view.image_size[0] / view.intrinsics[1].item() for view in views)
    assert wide == pytest.approx(default, rel=0.01)


# -- mrcal's, by numbers that its fork drcal gave; where its image is another, in that image

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "stereo" / "drcal.json").read_text())
CASES = {case["projection"].removeprefix("LENSMODEL_").lower(): case for case in GOLDEN["cases"]}
FOV = 80, 60


def float64(values):
    return torch.tensor(values, dtype=torch.float64)


def drcals_pair():
    made = []
    for camera in GOLDEN["cameras"]:
        width, height = camera["width_height"]
        parameters = float64(camera["parameters"])
        pose = float64(camera["rotation_vector_and_translation_from_reference"])
        lens = ct.BrownConrady(parameters[:4], parameters[4:], image_size=(height, width)).requires_grad_(False)
        made.append((lens, ct.Extrinsics(pose[:3], pose[3:]).requires_grad_(False)))
    (left, first), (right, second) = made
    return left, right, second.compose(first.inverse())


def rectification(name):
    case = CASES[name]
    width, height = case["width_height"]
    if name == "latlon":
        return ct.rectify(*drcals_pair(), projection="latlon", fov=FOV, image_size=(height, width))
    # theirs takes the resolution of the middle for wider images; the choice of a camera is free
    camera = ct.Pinhole(float64(case["intrinsics"]), image_size=(height, width)).requires_grad_(False)
    return Rectification(*drcals_pair(), camera, "perspective", False, "mean")


@pytest.mark.parametrize("name", CASES)
def test_frames_maps_and_points_are_theirs(name):
    found, case = rectification(name), CASES[name]
    torch.testing.assert_close(found.camera_left.intrinsics, float64(case["intrinsics"]), rtol=1e-12, atol=1e-9)
    assert found.baseline.item() == pytest.approx(case["baseline"], rel=1e-13)
    for side in ("left", "right"):
        rotation, source = getattr(found, f"rotation_{side}"), getattr(found, f"source_{side}")
        torch.testing.assert_close(rotation.mT, float64(case[f"{side}_from_rectified"]), rtol=0, atol=1e-13)
        rays, valid = getattr(found, f"camera_{side}").unproject(float64(case["pixels"]))
        assert valid.all()
        # also outside the image, as far as the lens is one-to-one
        pixels, valid = source.project(rays @ rotation)
        assert valid.sum() >= 15
        torch.testing.assert_close(pixels[valid], float64(case[side])[valid], rtol=0, atol=1e-6)
    points, valid = found._points(float64(case["pixels"])[None], float64(case["disparity"])[None])
    assert valid.all()
    torch.testing.assert_close(points[0], float64(case["points"]), rtol=1e-9, atol=1e-9)
