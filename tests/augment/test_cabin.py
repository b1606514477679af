"""Mounts, regions and glances: what does not depend on the camera."""

import numpy as np
import pytest
import torch

import camtorch as ct
from camtorch.cabin import MOUNTS, REGIONS, Regions, head_share, mount


def glances(count, seed=0):
    """Eyes (count, 3) about where they usually are, and gaze (count, 3) in all directions, of the car's frame."""
    generator = torch.Generator().manual_seed(seed)
    eyes = 0.08 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return eyes, torch.randn(count, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("name", MOUNTS)
@pytest.mark.parametrize("right_hand_drive", [False, True])
def test_a_mount_looks_at_the_driver_upright(name, right_hand_drive):
    found = mount(name, right_hand_drive=right_hand_drive)
    camera_from_car = found.extrinsics
    driver = camera_from_car(torch.zeros(3, dtype=torch.float64))
    assert driver[:2].norm() < 1e-12
    assert 0.4 < driver[2] < 1.2
    above = camera_from_car(torch.tensor([0.0, 0, 0.1], dtype=torch.float64))
    assert above[1] < 0  # y is down
    assert above[0].abs() < 1e-12
    position = camera_from_car.position
    assert position.tolist() == pytest.approx(
        [MOUNTS[name][0][0], (-1) ** right_hand_drive * MOUNTS[name][0][1], MOUNTS[name][0][2]]
    )
    wide = ct.KannalaBrandt.from_fov(found.fov, image_size=(800, 1280))
    pixels, valid = wide.project(driver)
    assert valid
    assert wide.contains(pixels)


@pytest.mark.parametrize("name", MOUNTS)
def test_regions_are_those_of_the_car_after_every_draw(name):
    regions, camera_from_car = Regions(), mount(name).extrinsics
    count = 60
    eyes, gaze = glances(5 * count)
    want = regions.region_of(gaze, eyes)
    assert len(want.unique()) > len(REGIONS) / 2
    matrix = camera_from_car.matrix()
    camera = ct.KannalaBrandt.from_fov(130, image_size=(80, 128)).double().requires_grad_(False)
    augment = ct.augment.Compose(
        [
            ct.augment.RandomCamera("brown_conrady", fov=(50, 120), yaw=30, pitch=30, roll=180, min_filled=0),
            ct.augment.RandomCrop((64, 96)),
        ],
        camera=camera,
    )
    torch.manual_seed(0)
    for i in range(5):
        rows = slice(i * count, (i + 1) * count)
        sample = augment(
            gaze=gaze[rows] @ matrix[:3, :3].T,
            points=camera_from_car(eyes[rows]),
            pose=matrix.expand(count, 4, 4),
        )
        assert torch.equal(regions.region_of(sample["gaze"], sample["points"], sample["pose"]), want[rows])


def test_a_gaze_meets_the_nearest_region_by_numpy():
    regions = Regions()
    eyes, gaze = glances(400, 1)
    found = regions.region_of(gaze, eyes).numpy()
    for eye, ray, number in zip(eyes.numpy(), gaze.numpy(), found, strict=True):
        hits = {}
        for i, corners in enumerate(map(np.array, REGIONS.values())):
            a, u, v = corners[0], corners[1] - corners[0], corners[3] - corners[0]
            matrix = np.stack((ray, -u, -v), 1)
            if abs(np.linalg.det(matrix)) < 1e-12:
                continue
            distance, s, t = np.linalg.solve(matrix, a - eye)
            # convex quadrilaterals: by the side of each edge
            point = a + s * u + t * v
            sides = [
                np.dot(np.cross(d - c, point - c), np.cross(u, v))
                for c, d in zip(corners, np.roll(corners, -1, 0), strict=True)
            ]
            if distance > 0 and (min(sides) > 0 or max(sides) < 0):
                hits[i] = distance
        assert number == (min(hits, key=hits.get) if hits else -1)


def test_what_is_not_finite_or_meets_nothing_is_in_no_region():
    regions = Regions({"square": [[1.0, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]]})
    assert regions.region_of([1.0, 0, 0], [0.0, 0, 0]) == 0
    assert regions.region_of([-1.0, 0, 0], [0.0, 0, 0]) == -1
    assert regions.region_of([0.0, 0, 1], [0.0, 0, 0]) == -1
    assert regions.region_of([float("nan"), 0, 1], [0.0, 0, 0]) == -1
    assert regions.region_of(torch.zeros(2, 3), [0.0, 0, 0]).tolist() == [-1, -1]
    assert Regions(right_hand_drive=True).region_of([0.5, 0.4, 0.14], [0.0, 0, 0]) == Regions().region_of(
        [0.5, -0.4, 0.14], [0.0, 0, 0]
    )


def test_owls_turn_the_head_and_lizards_the_eyes():
    gaze = torch.tensor([[0.7, -0.7, 0.0], [0.7, -0.7, 0], [1.0, 0, 0]])  # 45 degrees to the right, and ahead
    # the head's frame: x to its left ear seen from the front, y down, the nose along -z
    straight = torch.tensor([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])
    turned = torch.tensor([[0.7071068, 0.7071068, 0], [-0.7071068, 0.7071068, 0], [0, 0, 1]]) @ straight
    share = head_share(gaze, torch.stack((turned, straight, straight)))
    torch.testing.assert_close(share, torch.tensor([1.0, 0, 0]).double(), atol=1e-6, rtol=0)
    camera_from_car = mount("mirror").extrinsics
    rotation = camera_from_car.matrix()[:3, :3]
    seen = head_share(
        gaze.double() @ rotation.T, rotation @ torch.stack((turned, straight, straight)).double(), camera_from_car
    )
    torch.testing.assert_close(seen, share, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mount("mirorr"), "Did you mean 'mirror'"),
        (lambda: Regions({"a": [[0.0, 0, 0], [1, 0, 0]]}), "K >= 3"),
        (lambda: Regions({"a": [[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]}), "not on a line"),
        (lambda: Regions({"a": [[0.0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]]}), "one plane"),
        (lambda: Regions().region_of([1.0, 0], [0.0, 0, 0]), "gaze must be"),
        (lambda: Regions().region_of([1.0, 0, 0], [0.0, 0, 0], torch.eye(3)), "4, 4"),
        (lambda: head_share([1.0, 0, 0], [1.0, 0, 0]), "3, 3"),
    ],
)
def test_what_fits_nothing_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
