"""Cameras that look at boxes: `ct.views.look_at`, and `BoxCrop`, which moves whole samples by it."""

import math
from functools import partial

import albumentations
import numpy as np
import pytest
import torch
from cameras import every_model, fisheye, one
from kornia.augmentation import AugmentationSequential, RandomHorizontalFlip, VideoSequential

import camtorch as ct
import camtorch.augment.albumentations
import camtorch.augment.kornia
import camtorch.augment.numpy
from camtorch.warp.views import place_of

SIZE = (160, 120)
wide = partial(fisheye, (480, 640), 0.3125)


def boxes_of(camera, count, seed=0):
    """(count, 4): boxes of some pixels to a quarter of the image, whose middle is on it."""
    generator = torch.Generator().manual_seed(seed)
    sides = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    middle = torch.rand(count, 2, generator=generator, dtype=torch.float64) * (sides - 1)
    half = (0.01 + 0.12 * torch.rand(count, 2, generator=generator, dtype=torch.float64)) * sides
    return torch.cat((middle - half, middle + half), -1)


@every_model
def test_the_axis_is_the_middle_and_the_outline_touches_a_side(key):
    camera = one(key).requires_grad_(False)
    boxes, margin = boxes_of(camera, 40), 0.2
    rays, has_ray = camera.unproject((boxes[:, :2] + boxes[:, 2:]) / 2)
    moved = margin * (boxes[:, 2:] - boxes[:, :2])
    outer = torch.cat((boxes[:, :2] - moved, boxes[:, 2:] + moved), -1)
    around, seen = camera.unproject(ct.augment.outlines(outer[:, None], 500)[:, 0])
    angle = torch.acos((around * rays[:, None]).sum(-1).clamp(-1, 1))
    plain = has_ray & seen.any(-1) & (~seen | (angle < 1.5)).all(-1) & (rays[:, 1].abs() < 0.99)
    boxes, rays, around, seen = boxes[plain], rays[plain], around[plain], seen[plain]
    assert len(boxes) > 10
    warp = ct.views.look_at(camera, boxes, SIZE, margin=margin)
    fx, fy, cx, cy = warp.target.intrinsics.unbind(-1)
    assert torch.equal(fx, fy)
    assert (cx == (SIZE[1] - 1) / 2).all()
    assert (cy == (SIZE[0] - 1) / 2).all()
    axis = (warp.rotation @ rays[..., None])[..., 0]
    torch.testing.assert_close(axis, torch.tensor([0.0, 0, 1], dtype=axis.dtype).expand_as(axis), atol=1e-9, rtol=0)
    assert warp.rotation[:, 0, 1].abs().max() < 1e-12  # the source's y axis stays in the y-z plane
    assert (warp.rotation[:, 1, 1] > 0).all()
    pixels = warp.target.project(around @ warp.rotation.mT)[0]
    sides = pixels.new_tensor(SIZE[::-1])
    beyond = torch.where(seen[..., None], (pixels - (sides - 1) / 2).abs() - sides / 2, -torch.inf)
    assert beyond.max() < 1e-3
    # an outline that the lens cuts off may end between two samples of this test
    whole = seen.all(-1)
    assert beyond.amax((1, 2))[whole].min() > -1e-2


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        ([100, 100, 50, 120], r"xyxy.*x, y, width, height"),
        ([100, 100, 100, 100], "a width and a height"),
        ([900, 100, 950, 120], "on the image, 640 x 480"),
        ([[1, 1, 20, 20], [float("nan"), 1, 2, 3]], r"boxes\[1\]"),
        ([1, 2, 3], r"\(B, 4\)"),
        ([-300, 200, 940, 280], r"90 degrees .*boxes\[0\]"),
        ([-2000, -2000, 2700, 2600], r"an outline that .*boxes\[0\]"),
    ],
)
def test_boxes_that_are_none_are_refused(boxes, message):
    with pytest.raises(ValueError, match=message):
        ct.views.look_at(wide(), boxes, SIZE)


def test_a_box_seen_straight_up_has_no_way_up():
    up = 60 * math.pi / 2
    camera = ct.KannalaBrandt([60.0, 60.0, 99.5, up], [0.0] * 4, image_size=(200, 200)).double().requires_grad_(False)
    with pytest.raises(ValueError, match=r"y axis.*boxes\[0\]"):
        ct.views.look_at(camera, [97.5, -2.0, 101.5, 2.0], SIZE)


def test_single_boxes_and_batches():
    camera = wide()
    assert ct.views.look_at(camera, (10, 10, 60, 90), SIZE).rotation.shape == (3, 3)
    boxes = boxes_of(camera, 3).numpy()
    warp = ct.views.look_at(camera, boxes, SIZE)
    assert warp(torch.zeros(1, 3, 480, 640)).shape == (3, 3, *SIZE)
    assert ct.views.look_at(camera.expand(3), boxes, SIZE).target.batch_shape == (3,)
    with pytest.raises(ValueError, match="boxes must be one for each camera"):
        ct.views.look_at(camera.expand(3), boxes[:2], SIZE)


def sample_of(camera, count=3):
    boxes, generator = boxes_of(camera, count), torch.Generator().manual_seed(1)
    shares = torch.rand(count, 9, 2, generator=generator, dtype=torch.float64)
    points = boxes[:, None, :2] + (boxes[:, 2:] - boxes[:, :2])[:, None] * shares
    gaze = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    both = torch.stack((boxes_of(camera, count, 5), boxes), 1)
    return {"boxes": both, "keypoints": points, "gaze": gaze, "points": camera.unproject(points)[0] * 0.7}


def test_labels_move_with_the_crop_and_back():
    camera = wide(dtype=torch.float64)
    crop = ct.augment.BoxCrop(SIZE, index=-1, margin=0.1, yaw=4, pitch=4, roll=9, zoom=(0.9, 1.1), camera=camera)
    sample = sample_of(camera)
    out = crop(sample)
    for i, rotation in enumerate(out["rotation"].numpy()):  # by numpy, from the pinhole that came out
        rays = camera.unproject(sample["keypoints"][i])[0].numpy() @ rotation.T
        fx, fy, cx, cy = out["camera"].intrinsics[i].numpy()
        want = {"keypoints": rays[:, :2] / rays[:, 2:] * [fx, fy] + [cx, cy]}
        want |= {name: sample[name][i].numpy() @ rotation.T for name in ("gaze", "points")}
        for name, value in want.items():
            np.testing.assert_allclose(out[name][i].numpy(), value, atol=1e-9)
    back = crop.inverse(out)
    torch.testing.assert_close(back["keypoints"], sample["keypoints"], atol=1e-9, rtol=0)
    torch.testing.assert_close(back["gaze"], sample["gaze"])


def test_in_a_chain_the_box_moves_with_what_comes_before():
    camera, A = wide(dtype=torch.float64), ct.augment  # noqa: N806
    sample, crop, flip = sample_of(camera), A.BoxCrop(SIZE, index=1), A.HorizontalFlip(p=1)
    mount, away = (A.RandomMount(yaw=(yaw, yaw), pitch=None, roll=None, min_filled=0) for yaw in (20, 95))
    want = flip(crop(mount(sample, camera=camera)))
    out = A.Compose([mount, crop, flip], camera=camera)(sample)
    for name in ("keypoints", "gaze", "points"):
        torch.testing.assert_close(out[name], want[name])
    torch.testing.assert_close(out["camera"].intrinsics, want["camera"].intrinsics)
    boxes = torch.tensor([[[10.0, 200, 60, 260]]]).expand(3, 2, 4)
    out = A.Compose([away, crop], camera=camera)(image=torch.rand(3, 1, 480, 640), boxes=boxes)
    assert not out["boxes_valid"].any()  # and nothing is raised
    assert torch.isfinite(out["boxes"]).all()


def test_samples_without_the_box_are_refused():
    image, boxes = torch.zeros(2, 1, 480, 640), [torch.tensor([[1.0, 1, 9, 9]]), torch.empty(0, 4)]
    crop = ct.augment.BoxCrop(SIZE, camera=wide())
    for call, text in (
        (lambda: crop(image=image), "must have boxes"),
        (lambda: crop(image=image, boxes=boxes), "sample 1 must have a box of index 0; got 0 boxes"),
        (lambda: ct.augment.BoxCrop(SIZE, margin=-0.5), "margin"),
        (lambda: ct.augment.BoxCrop(SIZE, margin=float("nan")), "margin"),
    ):
        with pytest.raises(ValueError, match=text):
            call()


def test_kornia_crops_the_same():
    camera, kornia, images = wide(), ct.augment.kornia, torch.rand(1, 3, 480, 640)
    boxes = sample_of(camera)["boxes"][1].float()
    aug = kornia.BoxCrop(camera, SIZE)
    params = aug.forward_parameters(images.shape)
    with pytest.raises(ValueError, match="with_boxes"):
        aug(images, params=params)
    moved = aug(images, params=kornia.with_boxes(params, boxes[None, 0]))
    torch.testing.assert_close(moved, ct.augment.BoxCrop(SIZE)(image=images, boxes=boxes[None], camera=camera)["image"])


def test_the_place_of_the_crop_is_a_field():
    camera, A = wide(dtype=torch.float64), ct.augment  # noqa: N806
    sample, crop = sample_of(camera), A.BoxCrop(SIZE, yaw=3, zoom=0.1, place=True)
    out = crop(sample, camera=camera)
    want = ct.views.crop_place(ct.Warp(camera, out["camera"], out["rotation"]))
    torch.testing.assert_close(out["crop_place"], want)
    flip = A.HorizontalFlip(p=1)
    mirror = torch.tensor([-1.0, 1, 1, 1, 1], dtype=torch.float64)
    torch.testing.assert_close(flip(out)["crop_place"], want * mirror)
    assert "crop_place" not in crop.inverse(out)
    with pytest.raises(ValueError, match="crop_place must have the rotation"):
        flip({name: value for name, value in out.items() if name != "rotation"})
    chain = A.Compose([A.BoxCrop(SIZE, place=True), flip], camera=camera)
    alone = chain({name: value[0] for name, value in sample.items()})
    torch.testing.assert_close(chain(sample)["crop_place"][0], alone["crop_place"])
    arrays = A.numpy.Transform(chain)({name: value[0].numpy() for name, value in sample.items()})
    np.testing.assert_allclose(arrays["crop_place"], alone["crop_place"].numpy())
    assert A.collate([alone, alone])["crop_place"].shape == (2, 5)


def sample_with_a_place():
    boxes = torch.tensor([[240.0, 180.0, 300.0, 250.0]])
    crop = ct.augment.BoxCrop(SIZE, place=True)
    return crop, {"image": torch.rand(3, 480, 640), "boxes": boxes, "camera": wide().requires_grad_(False)}


def test_the_place_goes_on_in_torchvision(vision):
    (crop, sample), flip = sample_with_a_place(), ct.augment.HorizontalFlip(p=1)
    Transform = vision[0].Transform  # noqa: N806
    apply, front = (lambda one, given: Transform(one)(given)), Transform(crop, sample["camera"])
    cropped = crop(sample)
    want = flip(cropped)["crop_place"]
    without = {name: value for name, value in sample.items() if name != "camera"}
    for out in (front(sample), front(without)):
        assert {"crop_place", "rotation", "camera"} <= out.keys()
        torch.testing.assert_close(apply(flip, out)["crop_place"], want)
    hand = {"keypoints": torch.tensor([[260.0, 200.0]])}
    out = apply(flip, front({**sample, "left": hand, "right": hand}))  # names are there twice
    torch.testing.assert_close(out["crop_place"], want)
    arrays = cropped | {name: cropped[name].numpy() for name in ("crop_place", "rotation")}
    np.testing.assert_allclose(apply(flip, {"a": arrays})["a"]["crop_place"], want, atol=1e-6)
    with pytest.raises(ValueError, match="crop_place must have the rotation"):
        apply(flip, {name: value for name, value in cropped.items() if name != "rotation"})
    several = crop({name: torch.stack([without[name]] * 2) for name in without}, camera=sample["camera"])
    labels = {name: several[name] for name in ("crop_place", "rotation")}  # the place is no image
    labels["camera"] = several["camera"][0]
    torch.testing.assert_close(apply(flip, labels)["crop_place"], torch.stack([want] * 2))
    with pytest.raises(ValueError, match="must have one crop_place; got 2"):
        apply(flip, {**cropped, "other": {"crop_place": want}})


def test_the_place_goes_on_in_kornia():
    crop, sample = sample_with_a_place()
    cropped = crop({name: value if name == "camera" else value[None] for name, value in sample.items()})
    del cropped["boxes_valid"]
    kornia = ct.augment.kornia
    parts = [kornia.HorizontalFlip(cropped["camera"][0], p=1), kornia.RandomMount(cropped["camera"][0], roll=(20, 20))]
    for part in parts:
        container = AugmentationSequential(part, data_keys=None)
        out = container(cropped)
        place = place_of(out["camera"], out["rotation"])
        torch.testing.assert_close(out["crop_place"], place)
        assert not torch.equal(out["crop_place"], cropped["crop_place"])
        assert "crop_place" not in container.inverse(out)
        clips = {name: cropped[name].expand(2, *cropped[name].shape) for name in ("crop_place", "rotation")}
        clips["image"] = cropped["image"].expand(2, -1, -1, -1, -1)
        videos = AugmentationSequential(VideoSequential(part), data_keys=None)(clips)["crop_place"]
        assert videos.shape == (2, 1, 5)
        assert part is parts[1] or torch.equal(videos[1], out["crop_place"])
        with pytest.raises(ValueError, match="crop_place must have the rotation"):
            container({name: value for name, value in cropped.items() if name != "rotation"})


def test_the_place_goes_on_in_pipelines_of_albumentations():
    (crop, sample), flip = sample_with_a_place(), ct.augment.HorizontalFlip(p=1)
    transform, arrays = ct.augment.albumentations.Transform, {"boxes": sample["boxes"].numpy()}
    arrays["image"] = sample["image"].permute(1, 2, 0).numpy()
    pipeline = albumentations.Compose([transform(crop, sample["camera"]), transform(flip)])
    np.testing.assert_allclose(pipeline(**arrays)["crop_place"], flip(crop(sample))["crop_place"], atol=1e-6)


def test_gradients_reach_the_boxes_of_samples():
    camera = wide(dtype=torch.float64)
    sample, crop = sample_of(camera), ct.augment.BoxCrop(SIZE, place=True, camera=camera)

    def of(boxes):
        out = crop({**sample, "boxes": boxes})
        return out["keypoints"].square().mean() + out["gaze"][:, 0].sum() + out["crop_place"].square().sum()

    boxes = sample["boxes"].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(of(boxes), boxes)
    step = torch.zeros_like(boxes.detach())
    step[1, 0, 2] = 1e-5
    number = (of(boxes.detach() + step) - of(boxes.detach() - step)) / 2e-5
    torch.testing.assert_close(gradient[1, 0, 2], number, rtol=1e-3, atol=1e-6)
    with pytest.raises(TypeError, match=r"repeat_interleave\(F, 0\)"):
        ct.augment.BoxCrop(SIZE, index=[0, 1])


def test_boxes_that_begin_alike_have_gradients_of_their_own():
    camera = wide(dtype=torch.float64)
    box = torch.tensor([[200.0, 120, 300, 260]], dtype=torch.float64)
    images, factors = torch.zeros(3, 1, 480, 640), torch.tensor([[1.0], [10], [100]])
    for parts in ([ct.augment.BoxCrop(SIZE)], [ct.augment.BoxCrop(SIZE), ct.augment.HorizontalFlip(p=1.0)]):
        boxes = box.repeat(3, 1, 1).requires_grad_()
        new = ct.augment.Compose(parts, camera=camera)(image=images, boxes=boxes)["camera"]
        (gradient,) = torch.autograd.grad((new.intrinsics * factors).sum(), boxes)
        assert gradient[0].abs().min() > 0
        torch.testing.assert_close(gradient, gradient[:1] * factors[..., None])


def test_several_cameras_of_a_sample_are_flattened():
    camera, images = wide(), torch.zeros(2, 3, 1, 480, 640)
    mount = ct.augment.RandomMount(yaw=2)
    for cameras, way in ((camera.expand(2, 3), r"ct\.cat\(list\(camera\)\)"), (camera.expand(6), "one for each")):
        with pytest.raises(ValueError, match=rf"flattened to \(B N\): image\.flatten\(0, 1\).*{way}"):
            mount(image=images, camera=cameras)
    with pytest.raises(ValueError, match=r"Flatten cameras \(B, N\).*ct\.cat"):
        mount(image=images.flatten(0, 1), camera=camera.expand(2, 3))
    out = mount(image=images.flatten(0, 1), camera=ct.cat(list(camera.expand(2, 3))))
    assert out["image"].unflatten(0, (2, 3)).shape == images.shape


def test_a_crop_turns_away_by_its_own_angles():
    camera, box = wide().requires_grad_(False), torch.tensor([[100.0, 90, 160, 150]])
    sample = {"image": torch.zeros(3, *camera.image_size), "boxes": box, "camera": camera}
    straight = ct.augment.BoxCrop((64, 64))(**sample)["rotation"]
    turns = dict.fromkeys(("yaw", "pitch", "roll"), (0.0, 0.0))
    for name in turns:
        crop = ct.augment.BoxCrop((64, 64), **{**turns, name: (20.0, 20.0)})(**sample)["rotation"]
        mount = ct.augment.RandomMount(**{**turns, name: (20.0, 20.0)}, min_filled=0)(**sample)["rotation"]
        torch.testing.assert_close(crop, mount @ straight)


def test_a_mount_after_a_crop_shows_what_the_first_camera_sees(recwarn):
    camera = wide().float().requires_grad_(False)
    crop, mount = ct.augment.BoxCrop((40, 40)), partial(ct.augment.RandomMount, yaw=(25, 25), pitch=None, roll=None)
    sample = {"image": torch.ones(1, 1, 480, 640), "boxes": torch.tensor([[[290.0, 200, 370, 280]]]), "camera": camera}
    assert ct.augment.Compose([crop, mount()], valid_mask=True)(sample)["image_valid"].all()
    assert not recwarn
    with pytest.warns(UserWarning, match="RandomMount: of the new images .* will show nothing"):
        mount()(crop(sample))


@pytest.mark.parametrize("more", [{}, {"gaze": torch.rand(2, 3)}])
def test_the_place_comes_out_of_kornia(more):
    kornia, camera, images = ct.augment.kornia, wide().requires_grad_(False), torch.rand(2, 3, 480, 640)
    boxes = sample_of(camera)["boxes"][:2, 0].float()
    want = ct.augment.BoxCrop(SIZE, place=True)(image=images, boxes=boxes[:, None], camera=camera)
    crop, mount = kornia.BoxCrop(camera, SIZE, place=True), kornia.RandomMount(want["camera"][0], roll=(20, 20))
    for container in (
        AugmentationSequential(crop, data_keys=None),
        AugmentationSequential(crop, mount, data_keys=None),
    ):
        params = kornia.with_boxes(container.forward_parameters(images.shape), boxes)
        out = container({"image": images, **more}, params=params)
        assert out.keys() == {"image", "camera", "rotation", "crop_place", *more}
        torch.testing.assert_close(out["crop_place"], place_of(out["camera"], out["rotation"]))
        if len(container) == 1:
            assert torch.equal(out["crop_place"], want["crop_place"])
            assert "crop_place" not in container.inverse(out, params=params)
    alone = AugmentationSequential(crop, data_keys=None, keepdim=True)
    params = kornia.with_boxes(alone.forward_parameters(images[:1].shape), boxes[:1])
    assert alone({"image": images[0]}, params=params)["crop_place"].shape == (5,)
    flip = AugmentationSequential(crop, RandomHorizontalFlip(), data_keys=None)
    with pytest.raises(ValueError, match="must move crop_place too"):
        flip({"image": images}, params=params)
