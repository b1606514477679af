import pytest
import torch
from scenes import driver
from scenes.cabin import CLASSES, LANDMARKS, Drivers, random_drivers, render, render_classes

import camtorch as ct


def pinhole(focal: float, height: int, width: int, centre=None) -> ct.Pinhole:
    x, y = centre or ((width - 1) / 2, (height - 1) / 2)
    return ct.Pinhole([focal, focal, x, y], image_size=(height, width)).requires_grad_(False)


def fisheye(focal: float, side: int) -> ct.KannalaBrandt:
    intrinsics = [focal, focal, (side - 1) / 2, (side - 1) / 2]
    return ct.KannalaBrandt(intrinsics, [0.02, -0.01, 0.003, -0.001], image_size=(side, side)).requires_grad_(False)


def seeded(count: int, seed: int = 0, **options) -> Drivers:
    return random_drivers(count, torch.Generator().manual_seed(seed), **options)


def named(points: torch.Tensor, *names: str) -> torch.Tensor:
    return points[..., [LANDMARKS.index(n) for n in names], :]


def centroid(weight: torch.Tensor) -> torch.Tensor:
    """(2) x and y of the middle of a weight (H, W)."""
    weight = weight.double()
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in weight.shape), indexing="ij")
    return torch.stack([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def close_ups(points: torch.Tensor, focal: float, side: int) -> ct.Pinhole:
    """Cameras whose images are around where they see points (N, 3)."""
    centre = (side - 1) / 2 - focal * points[:, :2] / points[:, 2:]
    return ct.Pinhole(torch.cat([torch.full_like(centre, focal), centre], -1), image_size=(side, side)).requires_grad_(
        False
    )


@pytest.fixture(scope="module")
def friendly() -> Drivers:
    return random_drivers(1, spread=0)


def test_drivers_have_plausible_poses_and_unit_gazes():
    drivers = seeded(60)
    pose, distance = drivers.pose[:, :3, :3], drivers.pose[:, 2, 3]
    torch.testing.assert_close(pose @ pose.mT, torch.eye(3, dtype=torch.float64).expand_as(pose))
    torch.testing.assert_close(drivers.gaze.norm(dim=-1), torch.ones(60, dtype=torch.float64))
    assert distance.min() > 0.49
    assert distance.max() < 0.86
    assert drivers.pose[:, :2, 3].abs().max() <= 0.12
    # eyes turn no further than eyes can
    assert (drivers.gaze * -pose[:, :, 2]).sum(-1).min() > 0.8
    assert drivers.landmarks().shape == (60, len(LANDMARKS), 3)
    assert drivers.eyes().shape == (60, 2, 3)
    assert bool(drivers.landmarks().isfinite().all())
    assert bool(drivers.face_box_points().isfinite().all())


def test_without_spread_all_are_the_driver_who_looks_into_the_camera():
    drivers = seeded(3, spread=0)
    eye = torch.eye(3, dtype=torch.float64).expand(3, 3, 3)
    assert torch.equal(drivers.pose[:, :3, :3], eye)
    assert torch.equal(drivers.looks[0], drivers.looks[2])
    torch.testing.assert_close(drivers.gaze[0], torch.tensor([0.0, 0, -1], dtype=torch.float64))


def test_seeds_decide():
    first, again, other = (seeded(2, seed) for seed in (1, 1, 2))
    for name in ("pose", "gaze", "looks"):
        assert torch.equal(getattr(first, name), getattr(again, name))
        assert not torch.equal(getattr(first, name), getattr(other, name))
    camera = pinhole(15, 16, 24)
    first, again, other = (
        render(camera, d, samples=1, generator=torch.Generator().manual_seed(s))
        for d, s in ((first, 0), (again, 0), (first, 1))
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert (first[0] - first[1]).abs().mean() > 0.01


def test_a_batch_is_its_images_one_by_one():
    drivers = seeded(2)
    intrinsics = torch.tensor([[40.0, 40, 19.5, 15.5], [60.0, 60, 15.5, 13.5]])
    first, second, both = (
        ct.Pinhole(numbers, image_size=(32, 40)).requires_grad_(False) for numbers in (*intrinsics, intrinsics)
    )
    shared, own = render(first, drivers, samples=1), render(both, drivers, samples=1)
    alone = [render(camera, drivers[1], samples=1)[0] for camera in (first, second)]
    for one, other in ((shared[0], own[0]), (shared[1], alone[0]), (own[1], alone[1])):
        # a ray that grazes an edge may fall on either side
        assert ((one - other).abs() > 1e-4).float().mean() < 1e-3


@pytest.mark.parametrize("grey", [False, True])
def test_every_ray_has_a_colour(grey):
    rays = ct.Equirectangular([40.0, 40, 125.2, 62.3], image_size=(126, 252)).requires_grad_(False)
    images = render(rays, seeded(3, spread=1.2), samples=1, grey=grey)
    assert bool(images.isfinite().all())
    assert images.min() >= 0
    assert images.max() <= 1
    has_ray = rays.unproject(rays.pixel_grid())[1]
    has_ray[:, [0, 1, -2, -1]] = has_ray[[0, 1, -2, -1]] = False
    assert images.amax(1)[:, has_ray].min() > 0
    if grey:
        assert torch.equal(images[:, 0], images[:, 2])


def test_no_ray_is_black_and_background():
    camera = fisheye(60, 200)
    image, classes = render(camera, seeded(1), samples=1), render_classes(camera, seeded(1))
    assert classes.shape == (1, 1, 200, 200)
    assert classes.dtype == torch.uint8
    no_ray = classes[0] == CLASSES.index("background")
    assert no_ray.any()
    assert torch.equal(no_ray, image[0].sum(0, keepdim=True) == 0)
    assert set(classes.unique().tolist()) == set(range(len(CLASSES)))


def test_classes_agree_with_colours(friendly):
    camera = pinhole(100, 90, 120)
    image, classes = render(camera, friendly, samples=1)[0], render_classes(camera, friendly)[0, 0]
    means = {name: image[:, classes == i].mean(1) for i, name in enumerate(CLASSES) if (classes == i).any()}
    red, green, blue = means["skin"]
    assert red > green > blue
    assert means["hair"].mean() < 0.6 * means["skin"].mean()
    assert means["clothes"][2] > means["clothes"][0]
    assert means["window"].mean() > means["seat"].mean() + 0.2


def test_the_iris_is_where_the_pupil_is_seen():
    gaze = torch.nn.functional.normalize(torch.tensor([[0.0, 0, -1], [0.12, 0.05, -1]], dtype=torch.float64), dim=-1)
    drivers = random_drivers(2, spread=0)
    drivers.gaze = gaze
    points = named(drivers.landmarks(), "right_iris", "left_iris").flatten(0, 1)
    cameras = close_ups(points, 4000, 60)
    images = render(cameras, drivers[[0, 0, 1, 1]], samples=4).amax(1)
    for image, pixel in zip(images, cameras.project(points[:, None])[0], strict=True):
        assert (centroid(image < 0.12) - pixel).abs().max() < 0.5


def test_the_mouth_ends_where_the_lips_do(friendly):
    points = named(friendly.landmarks()[0], "mouth_right", "mouth_left", "mouth_top", "mouth_bottom")
    camera = close_ups(points.mean(0, keepdim=True), 1500, 161)
    red, green, _ = render(camera, friendly, samples=2)[0]
    lips = red / green > 1.32
    x = lips.nonzero()[:, 1]
    pixels = camera.project(points)[0]
    assert abs(x.min() - pixels[0, 0]) < 5
    assert abs(x.max() - pixels[1, 0]) < 5
    middle = lips[:, round(pixels[2, 0].item())].nonzero()[:, 0]
    assert abs(middle.min() - pixels[2, 1]) < 2
    assert abs(middle.max() - pixels[3, 1]) < 2


def test_dots_are_centred_on_what_points_project_to():
    drivers = seeded(1, 4)[[0, 0]]
    points = drivers.landmarks()[0, [4, 13], None]
    cameras = close_ups(points[:, 0] + torch.tensor([5e-4, 3e-4, 0]), 550, 30)
    images = render(cameras, drivers, samples=12, dots=points, dot_radius=0.008)
    without = render(cameras, drivers, samples=12)
    shares = (without - images)[:, 0] / without[:, 0].clamp(min=1e-3)
    for share, pixel in zip(shares, cameras.project(points)[0], strict=True):
        assert (centroid(share) - pixel).abs().max() < 0.05


def test_a_turned_camera_sees_points_at_their_turned_place(friendly):
    camera = fisheye(70, 120)
    angle = torch.tensor(0.3, dtype=torch.float64)
    c, s = angle.cos(), angle.sin()
    turn = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    point = named(friendly.landmarks(), "nose_tip")
    turns = torch.stack([turn, torch.eye(3)])
    seen, plain = render(camera, friendly[[0, 0]], turns, samples=4, dots=point, dot_radius=0.04)
    for image, at in ((seen, point[0, 0] @ turn.T), (plain, point[0, 0])):
        green = image[1] - torch.maximum(image[0], image[2])
        assert (centroid(green.clamp(min=0.3) - 0.3) - camera.project(at)[0]).abs().max() < 0.1
    # the same ray meets the same thing wherever in the image it falls
    rays = torch.linspace(-0.3, 0.3, 40, dtype=torch.float64)
    rays = torch.stack([rays, rays.flip(0) * 0.5, torch.ones_like(rays)], -1)
    classes = render_classes(camera, friendly[[0, 0]], turns.flip(0))[:, 0]
    at = camera.project(rays)[0].round().long(), camera.project(rays @ turn.T)[0].round().long()
    same = classes[0][at[0][:, 1], at[0][:, 0]] == classes[1][at[1][:, 1], at[1][:, 0]]
    assert same.float().mean() > 0.85


def test_landmarks_are_on_the_surface_that_is_seen():
    drivers = seeded(4, 3, spread=0.4)
    front = ["right_eye_inner", "left_eye_inner", "nose_tip", "mouth_top", "mouth_bottom", "mouth_left", "mouth_right"]
    points = named(drivers.landmarks(), *front).float()
    local = (points - drivers.pose[:, None, :3, 3].float()) @ drivers.pose[:, :3, :3].float()
    shape = driver.Shape._make(c[:, None].float() for c in driver.shape_of(drivers.looks))
    assert driver.skin(tuple(local.unbind(-1)), shape).abs().max() < 5e-4
    pixels, _ = pinhole(160, 160, 160).project(points)
    classes = render_classes(pinhole(160, 160, 160), drivers)[:, 0]
    at = pixels.round().long()
    kinds = torch.stack([c[p[:, 1], p[:, 0]] for c, p in zip(classes, at, strict=True)])
    assert bool(((kinds == CLASSES.index("skin")) | (kinds == CLASSES.index("eye"))).all())


def test_the_face_box_is_around_the_face(friendly):
    camera = pinhole(270, 200, 200)
    box = camera.project(friendly.face_box_points())[0][0]
    low, high = box.amin(0), box.amax(0)
    marks = camera.project(friendly.landmarks())[0][0, :-4]
    assert bool(((marks > low - 1) & (marks < high + 1)).all())
    skin = render_classes(camera, friendly)[0, 0] == CLASSES.index("skin")
    row = skin[round((low[1] + 0.75 * (high[1] - low[1])).item())].nonzero()[:, 0]
    assert abs(row.min() - low[0]) < 10
    assert abs(row.max() - high[0]) < 10
