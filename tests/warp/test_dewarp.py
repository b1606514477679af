"""The target that Dewarp chooses: sensible for every valid camera."""

import math

import pytest
import torch
from cameras import FEW_REAL, real

import camtorch as ct

PROJECTIONS = ("perspective", "stereographic", "cylindrical", "equirectangular")


@pytest.mark.parametrize("projection", PROJECTIONS)
@pytest.mark.parametrize(("key", "name"), FEW_REAL)
def test_real_lenses_fill_most_of_the_image(key, name, projection):
    dewarp = ct.Dewarp(real(key)[name].resize(75, 100), projection=projection)
    assert torch.isfinite(dewarp.target.intrinsics).all()
    assert not any(p.requires_grad for p in dewarp.target.parameters())
    assert dewarp.target.image_size == dewarp.source.image_size
    mask = dewarp.valid_mask()
    assert mask.double().mean() > 0.5
    if projection in PROJECTIONS[2:]:  # as wide as the lens: neither side is empty
        if abs(dewarp.source.cy - 37) < 2:  # else the middle row is not that of the principal point
            assert dewarp.target.fov[0].item() == pytest.approx(dewarp.source.fov[0].item(), rel=0.01)
        assert mask[..., 1:-1].any(-2).all()


@pytest.mark.parametrize("projection", PROJECTIONS[2:])
@pytest.mark.parametrize("roll", [0.0, 90.0])
def test_a_panorama_is_as_wide_as_a_lens_that_ends_within_the_image(projection, roll):
    camera = ct.KannalaBrandt([214.6, 214.6, 319.5, 239.5], [-0.1163], image_size=(480, 640))  # folds at 97 degrees
    rotation = ct.augment.mount_rotation(*torch.tensor([0.0, 0.0, roll]))
    dewarp = ct.Dewarp(camera, projection=projection, rotation=rotation)
    expected = camera.fov[1 if roll else 0].item()
    assert expected == pytest.approx(178.7 if roll else 194, rel=0.01)
    assert dewarp.target.fov[0].item() == pytest.approx(expected, rel=0.01)
    assert dewarp.valid_mask().double().mean() > 0.97


@pytest.mark.parametrize("projection", PROJECTIONS[2:])
@pytest.mark.parametrize("angles", [(0, 0, 0), (60, 0, 0), (0, 40, 0), (0, 0, 90)])
def test_a_whole_turn_stays_whole(projection, angles):
    rotation = ct.augment.mount_rotation(*torch.tensor(angles, dtype=torch.float64))
    for camera in (
        ct.Equirectangular.from_fov(360, image_size=(60, 120)),
        ct.KannalaBrandt([40 / math.pi, 40 / math.pi, 39.5, 39.5], [0.0], image_size=(80, 80)),
    ):
        target = ct.Dewarp(camera, projection=projection, rotation=rotation.float()).target
        assert target.fov[0].item() == pytest.approx(360, rel=1e-6)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_opencv_issue_23961(projection):
    """A lens that folds inside its image, for which OpenCV gives NaN."""
    matrix = [[1200.18, -0.14, 951.25], [0, 1199.43, 601.05], [0, 0, 1]]
    lens = (-0.99137, -0.12055, 0.36864, -1.06562)
    camera = ct.KannalaBrandt.from_matrix(matrix, lens, image_size=(1200, 1900), ignore_skew=True)
    dewarp = ct.Dewarp(camera, projection=projection)
    mask = dewarp.valid_mask()[0, 0]
    if projection in PROJECTIONS[:2]:
        assert 0.3 < mask.double().mean() < 0.8  # the disc that the lens sees, on black
    else:
        assert mask.double().mean() > 0.8  # from its left to its right
    assert 300 < float(dewarp.target.intrinsics[0]) < 3000
    assert torch.isfinite(dewarp(torch.ones(1, 1, 1200, 1900))).all()
    # no row is empty, and in perspective nothing that the lens sees lies beyond the target's top or bottom edge
    assert mask[600, 950]
    assert mask[1:-1].any(1).all()


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_a_lens_of_220_degrees(projection):
    focal = 640 / math.radians(220)
    camera = ct.KannalaBrandt([focal, focal, 319.5, 319.5], [0.0], image_size=(640, 640))
    dewarp = ct.Dewarp(camera, projection=projection)
    width = 640 / float(dewarp.target.intrinsics[0])
    # 120 degrees in perspective; the others show all that the lens sees
    planes = {"perspective": 2 * math.tan(math.radians(60)), "stereographic": 4 * math.tan(math.radians(55))}
    expected = planes.get(projection, math.radians(220))
    assert width == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("projection", "degrees"),
    [("perspective", 90), ("stereographic", 150), ("cylindrical", 200), ("equirectangular", 360)],
)
def test_fov_is_the_horizontal_field_of_view(projection, degrees):
    camera = ct.KannalaBrandt([200.0, 200.0, 319.5, 239.5], [0.0], image_size=(480, 640))
    target = ct.Dewarp(camera, projection=projection, fov=degrees, image_size=(300, 500)).target
    assert target.image_size == (300, 500)
    edges = torch.tensor([[-0.5, 149.5], [499.5, 149.5]])
    left, right = target.unproject(edges)[0].unbind(0)
    angle = math.atan2(right[0], right[2]) - math.atan2(left[0], left[2])
    assert angle % (2 * math.pi) == pytest.approx(math.radians(degrees) % (2 * math.pi), abs=1e-5)


def test_stereographic_keeps_small_shapes():
    """A small square of the scene is a square of the image wherever it is: the map is conformal."""
    camera = ct.KannalaBrandt.from_fov(180, image_size=(480, 640)).double()
    target = ct.Dewarp(camera, projection="stereographic").target
    rays = target.unproject(torch.tensor([[20.0, 240], [500, 100], [320, 240]], dtype=torch.float64))[0]
    for ray in rays:
        across = torch.linalg.cross(ray, torch.tensor([0.3, 0.8, 0.1], dtype=torch.float64))
        across = 1e-5 * across / across.norm()
        down = torch.linalg.cross(ray, across)
        first, second = (target.project(ray + step)[0] - target.project(ray - step)[0] for step in (across, down))
        assert abs(float(first @ second) / float(first @ first)) < 1e-4
        assert float(first.norm() / second.norm()) == pytest.approx(1, abs=1e-4)


def test_the_default_shows_an_undistorted_camera_as_it_is():
    camera = ct.BrownConrady(torch.tensor([500.0, 500.0, 300.0, 250.0], dtype=torch.float64), image_size=(480, 640))
    dewarp = ct.Dewarp(camera)
    torch.testing.assert_close(dewarp.target.intrinsics, camera.intrinsics, atol=1e-9, rtol=0)
    images = torch.rand(1, 1, 480, 640, dtype=torch.float64)
    torch.testing.assert_close(dewarp(images), images, atol=1e-9, rtol=0)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_awkward_cameras_get_a_finite_target(projection):
    wide = ct.KannalaBrandt([100.0, 100.0, 319.5, 239.5], [0.0], image_size=(480, 640))
    rim = wide.crop(top=200, left=600, height=40, width=40)  # sees nothing but what lies behind it
    awkward = [
        (rim, None),
        (ct.Pinhole([1e5, 1e5, -4e3, 9e3], image_size=(2, 3)), None),
        (ct.Pinhole([0.1, 0.1, 0.0, 0.0], image_size=(1, 1)), None),
        (ct.BrownConrady([10.0, 10.0, 3000.0, 300.0], [-0.3, 0.0, 0.0, 0.0], image_size=(480, 640)), None),
        (wide, torch.diag(torch.tensor([-1.0, 1.0, -1.0]))),
    ]
    for camera, rotation in awkward:
        dewarp = ct.Dewarp(camera, projection=projection, rotation=rotation)
        assert torch.isfinite(dewarp.target.intrinsics).all()
        assert (dewarp.target.intrinsics[:2] > 0).all()
        assert torch.isfinite(dewarp(torch.ones(1, 1, *camera.image_size))).all()


def test_a_batch_gets_a_target_each():
    intrinsics = torch.tensor([[200.0, 200.0, 320.0, 240.0], [400.0, 400.0, 300.0, 250.0]])
    camera = ct.KannalaBrandt(intrinsics, [0.0], image_size=(480, 640))
    batch = ct.Dewarp(camera)
    for i in range(2):
        single = ct.Dewarp(ct.KannalaBrandt(intrinsics[i], [0.0], image_size=(480, 640)))
        torch.testing.assert_close(batch.target.intrinsics[i], single.target.intrinsics)
    assert batch(torch.ones(2, 1, 480, 640)).shape == (2, 1, 480, 640)
