"""Augmentations whose camera turns while it takes its image, and whose lens darkens the rim."""

import copy
import itertools
from functools import partial

import pytest
import torch
from cameras import pinhole

import camtorch as ct
from camtorch.augment import RandomMount, RandomShutter

camera = partial(pinhole, (120, 160), 95.0)
STILL = {"yaw": None, "pitch": None, "roll": None, "zoom": None}


@pytest.mark.parametrize("direction", ["down", "left"])
def test_a_sample_moves_by_the_warp_of_its_shutter(direction):
    source = camera()
    augment = RandomShutter((0.02, 0.03), 120, direction=direction, camera=source)
    draw = augment.draw(3, torch.Generator().manual_seed(0))
    assert draw["rates"].shape == (3, 3)
    assert (draw["rates"].abs() <= 120).all()
    image, keypoints = torch.rand(3, 3, 120, 160), torch.rand(3, 5, 2) * 100
    gaze, mask = torch.randn(3, 3), torch.randint(0, 5, (3, 1, 120, 160))
    sample = augment(image=image, keypoints=keypoints, gaze=gaze, mask=mask, draw=draw)
    rates = torch.deg2rad(draw["rates"].float())
    shutter = ct.RollingShutter(draw["readout"].float(), rates, direction=direction)
    warp = ct.ShutterWarp(source, source, target_shutter=shutter, tolerance=0.001)
    assert torch.equal(sample["image"], warp(image))
    assert torch.equal(sample["mask"], warp(mask, mode="nearest"))
    assert torch.equal(sample["keypoints"], warp.transform_points(keypoints)[0])
    assert torch.allclose(sample["gaze"], gaze)
    assert (sample["keypoints"] - keypoints).abs().max() > 1
    back = augment.inverse(sample)
    seen = sample["keypoints_valid"]
    assert (back["keypoints"] - keypoints)[seen].abs().max() < 1e-3


def test_some_of_a_batch_and_cameras_of_several_models():
    cameras = [camera(), ct.KannalaBrandt.from_fov(90, image_size=(120, 160)).requires_grad_(False), camera()]
    augment = RandomShutter(0.03, 200, p=0.6)
    draw = augment.draw(3, torch.Generator().manual_seed(2))
    draw["apply"] = torch.tensor([True, True, False])
    images = torch.rand(3, 3, 120, 160)
    sample = augment(image=images, camera=cameras, draw=draw)
    change = augment.last
    assert torch.equal(sample["image"][2], images[2])
    for i in range(2):
        alone = augment(image=images[i : i + 1], camera=[cameras[i]], draw={n: v[i : i + 1] for n, v in draw.items()})
        assert torch.allclose(alone["image"][0], sample["image"][i], atol=1e-6)
    points = torch.full((3, 4, 2), 50.0)
    assert torch.equal(change.row(1).points(points[:1])[0], change.points(points)[0][1:2])
    assert torch.equal(change.row(-1).points(points[:1])[0], change.points(points)[0][2:])
    for of, outside in itertools.product((change, change.row(0)), (99, 3, -4)):
        with pytest.raises(IndexError, match=f"Change: row must be one of {of.count} samples; got {outside}"):
            of.row(outside)


def test_a_chain_moves_images_once_and_ends_with_its_shutter():
    """Edits, the colours and the light of a lens go before it."""
    source, image = camera(), torch.rand(2, 1, 120, 160).expand(-1, 3, -1, -1)
    first = [ct.augment.HorizontalFlip(p=1.0), RandomMount(**STILL, chromatic=(0.0, 0.0), vignetting=0.4)]
    rolls = RandomShutter(0.03, 200)
    chain = ct.augment.Compose([*first, rolls], camera=source)
    draw = chain.draw(2, torch.Generator().manual_seed(0))
    points = torch.rand(2, 5, 2) * 80 + 30
    once = chain(image=image, keypoints=points, draw=draw)
    plain = ct.augment.Compose(first, camera=source)(
        image=torch.ones_like(image), keypoints=points, draw={k: v for k, v in draw.items() if k[0] != "2"}
    )
    own = {key[2:]: value for key, value in draw.items() if key.startswith("2.")}
    second = rolls(keypoints=plain["keypoints"], image=image.flip(-1), camera=plain["camera"], draw=own)
    assert (once["keypoints"] - second["keypoints"]).abs().max() < 1e-3
    assert (once["image"] - second["image"] * plain["image"]).abs().max() < 2e-3
    for part, name in ((rolls, "RandomShutter"), (ct.augment.Compose([rolls]), "Compose")):
        with pytest.raises(ValueError, match=f"{name} goes last; got {name} at place 0"):
            ct.augment.Compose([part, first[0]], camera=source)


@pytest.mark.parametrize("fov", [60, 120, 170])
def test_natural_vignetting_is_of_the_true_angle(fov):
    lens = ct.KannalaBrandt.from_fov(fov, image_size=(240, 320)).double().requires_grad_(False)
    rays, valid = lens.rays()
    light = ct.vignetting(lens)
    assert light.shape == (1, 1, 240, 320)
    cosine = torch.where(valid, rays[..., 2], 0.1).clamp(min=0.1)
    torch.testing.assert_close(light[0, 0], cosine**4, rtol=1e-14, atol=0)
    # in float32 the cosine is interpolated, to 0.0001
    assert (ct.vignetting(copy.deepcopy(lens).float())[0, 0] ** 0.25 - cosine).abs().max() < 1.1e-4
    # on and off again is nothing, and so is the power 0
    image = torch.rand(2, 3, 240, 320, dtype=torch.float64)
    assert torch.allclose(image * light * ct.vignetting(lens, -1.0), image, atol=1e-12)
    assert torch.equal(ct.vignetting(lens, 0.0), torch.ones_like(light))
    batch = ct.vignetting(lens, torch.tensor([0.5, 1.0], dtype=torch.float64))
    assert torch.allclose(batch[1:], light)
    assert torch.allclose(batch[:1] ** 2, light)


@pytest.mark.parametrize("size", [(48, 64), (5, 9)])
def test_vignetting_of_small_images(size):
    camera = ct.Pinhole.from_fov(80, image_size=size).requires_grad_(False)
    exact = camera.rays()[0][..., 2] ** 4
    assert (ct.vignetting(camera)[0, 0] - exact).abs().max() < 1e-3


def test_a_rim_beyond_ninety_degrees_keeps_its_light():
    lens = ct.KannalaBrandt.from_fov(220, image_size=(120, 160)).requires_grad_(False)
    light = ct.vignetting(lens)
    assert light.min() > 0.99e-4
    assert abs(float(light.max()) - 1) < 1e-3


def test_an_augmentation_darkens_the_rim():
    source, image = camera(), torch.ones(4, 1, 120, 160)
    augment = RandomMount(**STILL, cos4=(0.2, 1), vignetting=0.3, camera=source)
    draw = augment.draw(4, torch.Generator().manual_seed(0))
    result = augment(image=image, draw=draw)["image"]
    plain = RandomMount(**STILL, vignetting=0.3, camera=source)(image=image, draw=draw)["image"]
    expected = plain * ct.vignetting(source, draw["cos4"].float())
    assert torch.allclose(result, expected, atol=1e-6)


def test_wrong_arguments_are_told():
    for call, text in (
        (lambda: RandomShutter(33, 30), r"readout must lie within \[-1, 1\]"),
        (lambda: RandomShutter(0.03, 30, direction="top"), "direction must be one of"),
        (lambda: ct.vignetting(camera(), "1"), "vignetting: power must be"),
        (lambda: ct.CanonicalCamera("1000"), "CanonicalCamera: focal must be a number; got '1000'"),
    ):
        with pytest.raises((TypeError, ValueError), match=text):
            call()
