"""The scenes: what is seen where, and that their labels are true."""

import pytest
import torch
from scenes import car_park, driver, room
from scenes.cabin import CLASSES, LANDMARKS, Drivers, random_drivers, render, render_classes

import camtorch as ct


def pinhole(focal: float, height: int, width: int) -> ct.Pinhole:
    numbers = [focal, focal, (width - 1) / 2, (height - 1) / 2]
    return ct.Pinhole(numbers, image_size=(height, width)).requires_grad_(False)


def fisheye(side: int) -> ct.KannalaBrandt:
    lens = [0.02, -0.01, 0.003, -0.001]
    return ct.KannalaBrandt.from_fov(190, image_size=(side, side), distortion=lens).requires_grad_(False)


def seeded(count: int, seed: int = 0, **options) -> Drivers:
    return random_drivers(count, torch.Generator().manual_seed(seed), **options)


def named(points: torch.Tensor, *names: str) -> torch.Tensor:
    return points[..., [LANDMARKS.index(n) for n in names], :]


def test_drivers_are_plausible_and_their_seeds_decide():
    drivers, again, other = seeded(60), seeded(60), seeded(60, 1)
    for name in ("pose", "gaze", "looks"):
        assert torch.equal(getattr(drivers, name), getattr(again, name))
        assert not torch.equal(getattr(drivers, name), getattr(other, name))
    pose, distance = drivers.pose[:, :3, :3], drivers.pose[:, 2, 3]
    torch.testing.assert_close(pose @ pose.mT, torch.eye(3, dtype=torch.float64).expand_as(pose))
    torch.testing.assert_close(drivers.gaze.norm(dim=-1), torch.ones(60, dtype=torch.float64))
    assert distance.min() > 0.49
    assert distance.max() < 0.86
    # eyes turn no further than eyes can
    assert (drivers.gaze * -pose[:, :, 2]).sum(-1).min() > 0.8


def test_every_ray_has_a_colour_and_no_ray_is_black_background():
    camera, drivers = fisheye(100), seeded(1)
    image, classes = render(camera, drivers, samples=1), render_classes(camera, drivers)
    assert bool(image.isfinite().all())
    assert image.min() >= 0
    assert image.max() <= 1
    no_ray = classes[0] == CLASSES.index("background")
    assert no_ray.any()
    assert torch.equal(no_ray, image[0].sum(0, keepdim=True) == 0)
    assert {*classes.unique().tolist(), CLASSES.index("eye")} == set(range(len(CLASSES)))  # eyes are small


def test_landmarks_are_on_the_surface_that_is_seen():
    drivers = seeded(4, 3, spread=0.4)
    front = ["right_eye_inner", "left_eye_inner", "nose_tip", "mouth_top", "mouth_bottom", "mouth_left", "mouth_right"]
    points = named(drivers.landmarks(), *front).float()
    local = (points - drivers.pose[:, None, :3, 3].float()) @ drivers.pose[:, :3, :3].float()
    shape = driver.Shape._make(c[:, None].float() for c in driver.shape_of(drivers.looks))
    assert driver.skin(tuple(local.unbind(-1)), shape).abs().max() < 5e-4
    camera = pinhole(80, 80, 80)
    classes, at = render_classes(camera, drivers)[:, 0], camera.project(points)[0].round().long()
    kinds = torch.stack([c[p[:, 1], p[:, 0]] for c, p in zip(classes, at, strict=True)])
    assert bool(((kinds == CLASSES.index("skin")) | (kinds == CLASSES.index("eye"))).all())
    for low, marks in zip(camera.project(drivers.face_box_points())[0], camera.project(points)[0], strict=True):
        assert bool(((marks > low.amin(0) - 1) & (marks < low.amax(0) + 1)).all())


def test_the_room_is_where_it_says():
    # around every corner of the test chart opposite squares are alike and neighbours are not
    camera = pinhole(400, 480, 640).double()
    points = room.keypoints()
    points = points[room.visible(points) & (points[:, 2] == points[:, 2].max())]
    assert len(points) == 12
    corners = camera.project(points)[0][:, None] + torch.tensor([[-3.0, -3.0], [3, -3], [3, 3], [-3, 3]]).double()
    a, b, c, d = room.radiance(camera.unproject(corners)[0]).unbind(1)
    assert (a - c).abs().max() < 0.1
    assert (b - d).abs().max() < 0.1
    assert (a - b).abs().amax(-1).min() > 0.3


@pytest.mark.parametrize("scene", ["room", "car park"])
def test_no_rays_no_light(scene):
    # a fold of this lens lies inside the image
    camera = ct.BrownConrady([100.0, 100, 79.5, 59.5], [-0.6, 0.0, 0.0, 0.0], image_size=(120, 160))
    if scene == "room":
        image = room.render(camera, samples=1)
    else:
        image = car_park.render(camera, car_park.rig().extrinsics["front"], samples=1)
    _, valid = camera.rays()
    assert not valid.all()
    assert (image[:, ~valid] == 0).all()
    assert (image[:, 60, 80] > 0).all()
