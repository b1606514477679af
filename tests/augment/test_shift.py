"""A mount that moves, by the depth of the sample: against what a camera at the new place sees."""

from functools import partial

import pytest
import torch
from cameras import fisheye

import camtorch as ct
import camtorch.augment.numpy

CENTRE, RADIUS = (0.05, 0.02, 0.75), 0.17  # of a ball before a slanted wall
WALL, AWAY = (0.1, -0.05, 1.0), 1.3
lens = partial(fisheye, size=(120, 160), focal=0.45, dtype=torch.float64)


def seen(camera, start, rays):
    """Colours (..., 1) and distances (...) of unit rays from a place, all in the frame of the camera before."""
    centre, wall = (torch.tensor(v, dtype=torch.float64) for v in (CENTRE, WALL))
    along = (rays * (centre - start)).sum(-1)
    square = along**2 - ((centre - start) ** 2).sum() + RADIUS**2
    ball = torch.where(square > 0, along - square.clamp(min=0).sqrt(), torch.inf)
    slope = (rays * wall).sum(-1)
    flat = torch.where(slope > 0.05, (AWAY - (start * wall).sum()) / slope.clamp(min=0.05), torch.inf)
    distance = torch.minimum(ball, flat)
    at = start + distance[..., None] * rays
    colour = 0.5 + 0.2 * torch.sin(9 * at[..., 0]) + 0.2 * torch.cos(7 * at[..., 1] + 3 * at[..., 2])
    return torch.where(ball < flat, 1 - colour, colour), distance


def sample_of(camera):
    rays, valid = camera.rays()
    image, distance = seen(camera, torch.zeros(3, dtype=torch.float64), rays)
    known = valid & torch.isfinite(distance)
    image, distance = (torch.where(known, values, 0.0)[None] for values in (image, distance))
    return {"image": image, "distance": distance, "camera": camera}


@pytest.mark.parametrize("kind", ["distance", "depth"])
def test_the_image_is_what_a_camera_there_sees(kind):
    camera = lens(size=(240, 320))
    sample = sample_of(camera)
    if kind == "depth":
        sample["depth"] = sample.pop("distance") * camera.rays()[0][..., 2].clamp(min=0)
    directions = torch.randn(60, 3, dtype=torch.float64)
    points = torch.tensor(CENTRE) + RADIUS * torch.nn.functional.normalize(directions, dim=-1)
    facing = (points * (points - torch.tensor(CENTRE))).sum(-1) < -0.3 * RADIUS * points.norm(dim=-1)
    points = points[facing]
    sample |= {"points": points, "keypoints": camera.project(points)[0], "gaze": points, "boxes": torch.empty(0, 4)}
    sample["pose"] = torch.eye(4, dtype=torch.float64)
    ranges = (0.03, 0.04), (-0.03, -0.02), 0.02
    augment = ct.augment.RandomMount(yaw=5, pitch=5, roll=5, shift=ranges, valid_mask=True)
    out = augment(sample)
    rotation, target = out["rotation"], out["camera"]
    shift = augment.last.parts[0].warp.shift[0]
    assert 0.03 <= shift[0] <= 0.04
    rays = target.rays()[0]
    image, distance = seen(camera, shift, rays @ rotation)
    good = out["image_valid"][0]
    assert good.double().mean() > 0.8
    # pixels at the rim of the ball show both, in the two images each its own part
    pool = torch.nn.functional.max_pool2d
    edge = pool(distance[None, None], 3, 1, 1) + pool(-distance[None, None], 3, 1, 1)
    inner = good & (edge[0, 0] < 0.05)
    error = (out["image"][0] - image)[inner]
    assert -10 * (error**2).mean().log10() > 40
    moved = out[kind][0]
    want = distance if kind == "distance" else distance * rays[..., 2]
    assert (moved - want)[inner].abs().median() < 1e-3
    torch.testing.assert_close(out["points"], (points - shift) @ rotation.T)
    torch.testing.assert_close(out["gaze"], points @ rotation.T)
    torch.testing.assert_close(out["pose"][:3, 3], -rotation @ shift)
    pixels = target.project(out["points"])[0]
    assert out["keypoints_valid"].all()
    assert (out["keypoints"] - pixels).norm(dim=-1).max() < 0.1


def test_what_was_hidden_is_empty_and_not_valid():
    camera = lens(size=(360, 480))
    sample = sample_of(camera)
    still, shift = dict.fromkeys(("yaw", "pitch", "roll")), ((0.05, 0.05), (0, 0), (0, 0))
    augment = ct.augment.RandomMount(**still, shift=shift, valid_mask=True, fill=-1)
    out = augment(sample)
    rays, _ = camera.rays()
    shift = torch.tensor([0.05, 0, 0], dtype=torch.float64)
    distance = seen(camera, shift, rays)[1]
    points = shift + distance[..., None] * rays
    before = seen(camera, torch.zeros(3, dtype=torch.float64), torch.nn.functional.normalize(points, dim=-1))[1]
    hidden = points.norm(dim=-1) > before + 0.1
    # pixels at the rim show both
    hidden = -torch.nn.functional.max_pool2d(-hidden.double()[None, None], 3, 1, 1)[0, 0] > 0
    assert hidden.sum() > 20
    assert out["image_valid"][0][hidden].double().mean() < 0.1
    assert (out["image"][0][~out["image_valid"][0]] == -1).all()


def test_batches_half_precision_and_arrays():
    camera = lens()
    sample = sample_of(camera)
    batch = {name: torch.stack((value, value)).float() for name, value in sample.items() if name != "camera"}
    augment = ct.augment.RandomMount(yaw=3, pitch=None, roll=None, shift=(0.02,) * 3, p=0.5, camera=camera.float())
    for seed in range(4):
        torch.manual_seed(seed)
        out = augment(batch, keypoints=torch.full((2, 1, 2), 80.0), boxes=torch.tensor([[[70.0, 50, 90, 70]]] * 2))
        assert out["image"].shape == batch["image"].shape
        assert torch.isfinite(out["keypoints"]).all()
        assert out["boxes_valid"].all()
    arrays = {name: value[0].numpy() for name, value in batch.items()}
    out = ct.augment.numpy.Transform(augment)(image=arrays["image"][0], distance=arrays["distance"][0])
    assert out["image"].shape == (120, 160)


def test_without_depth_it_says_so():
    mount, camera, image = ct.augment.RandomMount, lens(), torch.zeros(1, 120, 160)
    augment, whole = mount(shift=(0.02, 0.02, 0), camera=camera), torch.full((1, 120, 160), 600, dtype=torch.int32)
    out = augment(sample_of(camera))
    for call, text in (
        (lambda: augment(image=image), "must have depth"),
        (lambda: augment.change(None, augment.draw(1)), "depth"),
        (lambda: augment(image=image, depth=whole), "floating point"),
        (lambda: ct.augment.Compose([augment]), "goes before"),
        (lambda: mount(shift=0.02), "three lengths"),
        (lambda: mount(shift=(0.02, 0, 0), chromatic=0.01), "chromatic"),
        (lambda: augment.inverse(out), "no inverse"),
    ):
        with pytest.raises((TypeError, ValueError), match=text):
            call()


def test_errors_name_the_augmentation_that_raises_them():
    class Trolley(ct.augment.RandomMount):
        """A mount of one's own."""

    camera = lens()
    augment = Trolley(shift=(0.02, 0.02, 0), camera=camera)
    out = augment(sample_of(camera))
    with pytest.raises(ValueError, match=r"^Trolley: a shift has no inverse"):
        augment.inverse(out)
    with pytest.raises(ValueError, match=r"^Trolley: depth must be \(B, 1, H, W\)"):
        augment.change(camera, {**augment.draw(1), "of_depth": torch.ones(1, 1, 20, 30)})


def test_the_distances_of_a_sample_replace_those_of_a_draw():
    camera = lens()
    sample = sample_of(camera)
    depth = sample["distance"] * camera.rays()[0][..., 2].clamp(min=0)
    augment, points = ct.augment.RandomMount(shift=(0.03, 0.03, 0.03)), torch.rand(9, 2) * 100
    draw, wrong = augment.draw(1), {name: torch.full((1, 1, 120, 160), 0.3) for name in ("of_depth", "of_distance")}
    for fields in (sample, {**sample, "depth": depth}, {"image": sample["image"], "depth": depth, "camera": camera}):
        alone, *beside = (
            augment(fields, keypoints=points, draw={**draw, **given})["keypoints"]
            for given in ({}, *({name: value} for name, value in wrong.items()), wrong)
        )
        assert all(torch.equal(moved, alone) for moved in beside)
    # without a sample, as in one, depth comes before distance
    both = augment.change(camera, {**draw, **wrong, "of_distance": sample["distance"][None]}).points(points[None])[0]
    assert torch.equal(both, augment.change(camera, {**draw, "of_depth": wrong["of_depth"]}).points(points[None])[0])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_labels_in_half_precision_have_the_depth_of_their_place(dtype):
    pixels, mount = (torch.rand(50, 2) * 110).to(dtype), ct.augment.RandomMount(shift=(0.03, 0.03, 0.03))
    draw = mount.draw(1)
    narrow, wide = (mount(sample_of(lens()), keypoints=points, draw=draw) for points in (pixels, pixels.double()))
    torch.testing.assert_close(narrow["keypoints"], wide["keypoints"].to(dtype))
    assert torch.equal(narrow["keypoints_valid"], wide["keypoints_valid"])


@pytest.mark.parametrize("plane", [(slice(None),), (0,)])  # with a channel and without
def test_depths_in_a_list_move_as_those_of_single_samples(plane):
    sample = sample_of(lens())
    camera, augment = sample.pop("camera"), ct.augment.RandomMount(shift=(0.02, 0.02, 0.02))
    samples = [{name: share * value for name, value in sample.items()} for share in (1.0, 0.9)]
    listed = {"image": [one["image"] for one in samples], "distance": [one["distance"][plane] for one in samples]}
    draw = augment.draw(2)
    out = augment(listed, camera=camera, draw=draw)
    for i, one in enumerate(samples):
        alone = augment(one, camera=camera, draw={name: value[i : i + 1] for name, value in draw.items()})
        torch.testing.assert_close(out["image"][i], alone["image"])
        torch.testing.assert_close(out["distance"][i], alone["distance"][plane])


def shifted_warp(camera, distance):
    augment = ct.augment.RandomMount(shift=((0.02, 0.03),) * 3)
    return augment.change(camera, {**augment.draw(1), "of_distance": distance}).parts[0].warp


def test_a_pinned_warp_keeps_the_surface_that_its_images_show():
    camera = lens()
    distance = sample_of(camera)["distance"][None]
    warp = shifted_warp(camera, distance).pin()
    before = warp(distance), warp.moved_distance(distance)
    warp.source.intrinsics.data.mul_(1.2)
    assert torch.equal(warp(distance), before[0])
    assert torch.equal(warp.moved_distance(distance) > 0, before[1] > 0)


def test_a_state_of_0_5_looks_for_its_surface():
    camera = lens()
    distance = sample_of(camera)["distance"][None]
    warp = shifted_warp(camera, distance)
    state = {**warp.__getstate__(), "_found": None}  # which 0.5 kept, and nothing else of a surface
    state.pop("_surfaces", None)
    old = type(warp).__new__(type(warp))
    old.__setstate__(state)
    assert torch.equal(old.moved_distance(distance), warp.moved_distance(distance))


def test_when_the_numbers_of_a_warp_change_it_looks_for_the_surface_again():
    camera = lens()
    sample = sample_of(camera)
    augment, distance = ct.augment.RandomMount(shift=((0.02, 0.03),) * 3), sample["distance"][None]
    change = augment.change(camera, {**augment.draw(1), "of_distance": distance})
    warp, before = change.parts[0].warp, change.distance(distance)
    numbers = warp.source.intrinsics, warp.target.intrinsics, warp.rotation, warp.shift, warp.distance
    for number in numbers:
        given = number.detach().clone()
        number.data.mul_(1.01)
        moved = change.distance(distance)
        assert not torch.equal(moved, before)
        assert torch.equal(moved, warp.detach().moved_distance(distance))
        number.data.copy_(given)
        assert torch.equal(change.distance(distance), before)
    warp.float()
    assert torch.equal(change.distance(distance.float()), warp.detach().moved_distance(distance.float()))
