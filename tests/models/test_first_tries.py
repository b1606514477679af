"""What people try first of edits, heads, losses and shutters: it works, or an error says what to do."""

import math

import numpy as np
import pytest
import torch

import camtorch as ct
import camtorch.augment.numpy
from camtorch.augment.landmarks import LANDMARKS

A = ct.augment
SIZE = (48, 64)
LENS = ct.KannalaBrandt.from_fov(120, image_size=SIZE).requires_grad_(False)
COCO = list(LANDMARKS["coco17"])
TABLES = {"keypoints": "coco17", "visibility": "coco17"}


def test_sizes_of_one_number_in_a_list_are_torchvisions():
    image = torch.rand(3, *SIZE)
    assert A.Resize([24])(image=image)["image"].shape == A.Resize(24)(image=image)["image"].shape == (3, 24, 32)
    assert A.CenterCrop((24,))(image=image)["image"].shape == (3, 24, 24)


def test_what_is_told_of_each_landmark_changes_places_with_it():
    flip = A.HorizontalFlip(1.0, landmarks=TABLES)
    image, keypoints, flags = torch.rand(2, 3, *SIZE), torch.rand(2, 17, 2) * 40, torch.arange(34).view(2, 17)
    swapped = flags[:, COCO]
    assert torch.equal(flip(image=image, keypoints=keypoints, visibility=flags)["visibility"], swapped)
    lists = flip(image=image, keypoints=list(keypoints), visibility=list(flags))["visibility"]
    assert torch.equal(torch.stack(lists), swapped)
    one = flip(image=image[0], keypoints=keypoints[0], visibility=flags[0])
    assert torch.equal(one["visibility"], swapped[0])
    given = {"keypoints": keypoints[0].numpy(), "visibility": flags[0].numpy()}
    arrays = camtorch.augment.numpy.Transform(flip)(image=np.zeros((*SIZE, 3), np.uint8), **given)
    np.testing.assert_array_equal(arrays["visibility"], swapped[0].numpy())
    still = A.HorizontalFlip(0.0, landmarks=TABLES)(image=image, keypoints=keypoints, visibility=flags)
    assert torch.equal(still["visibility"], flags)
    for wrong, error in ((flags[0], "must be"), (flags[:1], "must be of 2 samples, as others; got 1")):
        with pytest.raises(ValueError, match=error):
            flip(image=image, keypoints=keypoints, visibility=wrong)
    with pytest.raises(TypeError, match="visibility has a table"):
        flip(image=image[0], keypoints=keypoints[0], visibility=[2] * 17)


@pytest.mark.parametrize("model", ["pinhole", "kannala_brandt"])
def test_heads_of_no_features_and_on_the_meta_device(model):
    head = ct.CameraHead(8, model, image_size=SIZE)
    assert head(torch.randn(0, 8)).batch_shape == (0,)
    assert head.to("meta")(torch.randn(2, 8, device="meta")).batch_shape == (2,)


@pytest.mark.parametrize("size", [SIZE, (5, 9)])
def test_vignetting_of_small_images(size):
    camera = ct.Pinhole.from_fov(80, image_size=size).requires_grad_(False)
    exact = camera.rays()[0][..., 2] ** 4
    assert (ct.vignetting(camera)[0, 0] - exact).abs().max() < 1e-3


STEREO = LENS, LENS, ct.Extrinsics([0.0] * 3, [-0.1, 0.0, 0.0])
WIDE = {
    **{f"{key}.from_fov": lambda fov, key=key: ct.MODELS[key].from_fov(fov, image_size=SIZE) for key in ct.MODELS},
    "from_fov of a batch": lambda fov: ct.Pinhole.from_fov(torch.tensor([fov, 90.0]), image_size=SIZE),
    "Dewarp": lambda fov: ct.Dewarp(LENS, fov=fov),
    "a panorama": lambda fov: ct.Dewarp(LENS, fov=fov, projection="equirectangular"),
    "rectify": lambda fov: ct.rectify(*STEREO, fov=fov),
    "rectify, vertically": lambda fov: ct.rectify(*STEREO, fov=(90, fov)),
    "ring": lambda fov: ct.views.ring(LENS, 3, fov=fov),
    "RandomMount": lambda fov: A.RandomMount(fov=fov),
    "RandomLens": lambda fov: A.RandomLens("kannala_brandt", fov=(fov, 90)),
    "real": lambda fov: A.RandomCamera("real", fov=(fov, 100)),
    "CameraHead": lambda fov: ct.CameraHead(8, "pinhole", image_size=SIZE, fov=(fov, 80)),
}


@pytest.mark.parametrize("door", WIDE)
def test_a_field_of_view_is_in_degrees_at_every_door(door):
    for radians in (1, 2.1, 2 * math.pi):
        with pytest.raises(ValueError, match=f"must be in degrees; .*radians.* {math.degrees(radians):.4g} degrees"):
            WIDE[door](radians)
    WIDE[door](6.5 if "Camera" not in door else 60)
