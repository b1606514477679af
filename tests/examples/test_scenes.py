"""The landmarks of drivers lie on the surface that is seen."""

import torch
from scenes import driver
from scenes.cabin import CLASSES, LANDMARKS, Drivers, random_drivers, render_classes

import camtorch as ct


def pinhole(focal: float, height: int, width: int) -> ct.Pinhole:
    numbers = [focal, focal, (width - 1) / 2, (height - 1) / 2]
    return ct.Pinhole(numbers, image_size=(height, width)).requires_grad_(False)


def seeded(count: int, seed: int = 0, **options) -> Drivers:
    return random_drivers(count, torch.Generator().manual_seed(seed), **options)


def named(points: torch.Tensor, *names: str) -> torch.Tensor:
    return points[..., [LANDMARKS.index(n) for n in names], :]


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
