"""How much of new images shows something: a warning with the number, and two ways to have them full."""

import re

import pytest
import torch

import camtorch as ct
import camtorch.augment.kornia
from camtorch.augment import PRESETS, RandomCamera, RandomLens, RandomMount
from camtorch.values.arguments import TOLD

SIZE = (120, 160)


def pinhole(degrees=70.0):
    return ct.Pinhole.from_fov(degrees, image_size=SIZE).requires_grad_(False)


def shares(augmentation, count=24, seed=0, **fields):
    """(count,): the part of each new image that shows something, of all of its pixels."""
    draw = augmentation.draw(count, torch.Generator().manual_seed(seed))
    change = augmentation.change(fields.get("camera"), draw)
    return change.valid_mask().flatten(1).float().mean(1)


@pytest.fixture
def untold():
    TOLD.clear()


def test_mostly_empty_images_are_told_once_with_the_number():
    augmentation = RandomCamera("dms130", camera=pinhole())
    empty = 1 - shares(RandomCamera("dms130", camera=pinhole(), min_filled=0), 200).mean()
    assert empty > 0.6
    state = torch.random.get_rng_state()
    with pytest.warns(UserWarning, match=r"RandomCamera: of the new images (\d+)% will show nothing") as told:
        augmentation(image=torch.rand(1, 3, *SIZE))
    assert abs(int(str(told[0].message).split("%")[0].split()[-1]) - 100 * empty) < 4
    torch.random.set_rng_state(state)
    moved = augmentation(image=torch.ones(1, 3, *SIZE))  # warnings are errors here: it says so once
    torch.random.set_rng_state(state)
    # and the draws of it cost no random numbers
    quiet = RandomCamera("dms130", camera=pinhole(), min_filled=0)(image=torch.ones(1, 3, *SIZE))
    assert torch.equal(moved["image"], quiet["image"])


@pytest.mark.parametrize(
    "augmentation",
    [
        RandomCamera("webcam", camera=pinhole(90)),
        RandomMount(),
        RandomCamera("dms130", min_filled=0.5),
        RandomCamera("dms130", p=0),
        RandomMount(yaw=2, pitch=2, camera=ct.OrthographicFisheye([50.0, 50, 79.5, 59.5], image_size=SIZE)),  # a circle
        # of a field of view
        RandomLens("kannala_brandt", fov="source", min_filled=0.9),  # asks for nothing
        RandomLens("kannala_brandt", fov=(60, 160), min_filled=0.9),  # 60 is not too much
        RandomCamera("dms130", min_filled=0.9),
        RandomMount(fov=60, zoom=(2, 3), yaw=0, pitch=0, min_filled=0.9),  # narrow, as asked
        RandomLens("kannala_brandt", fov=120, min_filled=0),
    ],
)
def test_what_is_full_or_meant_so_is_not_told(untold, augmentation):
    lens = {} if augmentation.camera else {"camera": pinhole()}
    augmentation(image=torch.rand(8, 3, *SIZE), **lens)


def test_front_ends_tell_it_too():
    aug = ct.augment.kornia.RandomCamera(pinhole(), "dms130")
    with pytest.warns(UserWarning, match="will show nothing"):
        aug(torch.rand(2, 3, *SIZE))
    aug(torch.rand(2, 3, *SIZE))


MAKERS = {
    "camera": lambda **options: RandomCamera("dms130", **options),
    "surround": lambda **options: RandomCamera("surround190", yaw=30, pitch=20, roll=180, **options),
    "crop": lambda **options: RandomCamera("tumvi", crop=(0.3, 1.0), **options),
    "mount": lambda **options: RandomMount(yaw=30, pitch=20, roll=45, **options),
    "away": lambda **options: RandomMount(yaw=(60, 80), pitch=(-40, 40), **options),
    "lens": lambda **options: RandomLens("kannala_brandt", fov=(60, 160), **options),
    "own": lambda **options: RandomLens(focal=(0.4, 1.0), **options),
}


@pytest.mark.parametrize("share", [0.5, 1.0])
@pytest.mark.parametrize("name", MAKERS)
def test_every_image_is_filled_as_asked(name, share):
    make = MAKERS[name]
    before = shares(make(camera=pinhole(), min_filled=0))
    after = shares(make(camera=pinhole(), min_filled=share))
    assert before.min() < share
    assert after.min() > share - (0.02 if share == 1 else 0.0)
    enough = before > min(share + 0.03, 1 - 1e-6)  # the estimate is careful
    torch.testing.assert_close(after[enough], before[enough], atol=1e-3, rtol=0)


def test_a_camera_that_is_not_turned_is_zoomed_as_far_as_it_takes(untold):
    with pytest.warns(UserWarning, match="fov must be 150 degrees"):  # five times as wide as it was
        assert shares(RandomLens("pinhole", fov=150, camera=pinhole(), min_filled=0.9), 2).min() >= 0.9


def test_no_more_is_zoomed_than_needed():
    """What is filled above the part that was asked for is what a coarse lattice cannot tell."""
    for name in ("camera", "mount", "lens"):
        before, after = (shares(MAKERS[name](camera=pinhole(), min_filled=m)) for m in (0, 0.8))
        moved = before < 0.78
        assert moved.any()
        assert after[moved].max() < 0.88, name


def test_gradients_pass_and_the_zoom_counts_as_given():
    camera = ct.Pinhole([100.0, 100.0, 79.5, 59.5], image_size=SIZE)
    out = RandomCamera("dms130", min_filled=0.9)(keypoints=torch.rand(2, 5, 2) * 50 + 40, camera=camera)
    out["keypoints"][out["keypoints_valid"]].sum().backward()
    assert torch.isfinite(camera.intrinsics.grad).all()
    assert camera.intrinsics.grad.abs().sum() > 0


def test_what_cannot_be_filled_is_said():
    """The camera of a strip at the side of an image: its axis lies off the strip."""
    strip = pinhole().crop(0, 0, 120, 40)
    augmentation = RandomCamera("dms130", camera=strip, yaw=1, pitch=1, roll=1, min_filled=0.9)
    says = r"min_filled must be within reach; got 0.9, and of . of 4 new images.* does not see along"
    with pytest.warns(UserWarning, match=says):
        augmentation(image=torch.rand(4, 1, 120, 40))
    augmentation(image=torch.rand(4, 1, 120, 40))
    with pytest.raises(ValueError, match=r"RandomMount: min_filled must be a part in \[0, 1\]; got 90"):
        RandomMount(min_filled=90)


# -- a field of view that was asked for and not made


ASKED = {
    "a model": lambda **options: RandomLens("kannala_brandt", fov=120, **options),
    "a preset": lambda **options: RandomCamera("dms130", fov=(110, 130), **options),
    "real": lambda **options: RandomLens("real", fov=(110, 150), **options),
    "own": lambda **options: RandomMount(fov=(110, 120), yaw=0, pitch=0, **options),
}


@pytest.mark.parametrize("name", ASKED)
def test_a_field_of_view_that_is_not_made_is_told_once(untold, name):
    options = {"camera": pinhole(60), "min_filled": 0.9}
    least = 110 if name != "a model" else 120
    says = rf"fov must be {least} degrees at least; got an image (\d+) degrees wide: min_filled=0.9 .* 60 degrees wide"
    with pytest.warns(UserWarning, match=says) as told:
        made = ASKED[name](**options)(keypoints=torch.rand(8, 5, 2))["camera"].fov[:, 0]
    assert made.max() < 0.9 * least
    assert abs(int(re.search(r"(\d+) degrees wide: ", str(told[0].message))[1]) - made.min()) < 1
    ASKED[name](**options)(keypoints=torch.rand(8, 5, 2))  # warnings are errors here


@pytest.mark.parametrize("like", [*PRESETS, "kannala_brandt", "pinhole"])
@pytest.mark.parametrize("degrees", [50, 90, 170])
def test_as_much_of_a_lens_as_the_source_fills(like, degrees):
    """A source that is wider leaves the lens as it is."""
    still = dict.fromkeys(("focal", "centre", "distortion"))
    source = ct.KannalaBrandt.from_fov(170, image_size=SIZE).requires_grad_(False) if degrees > 90 else pinhole(degrees)
    augmentation = RandomLens(like, camera=source, **still, fov="source")
    change = augmentation.change(None, augmentation.draw(1))
    narrower = change.target
    if degrees < 100:
        assert change.valid_mask().float().mean() > 0.995
    if like in PRESETS:
        whole = RandomLens(like, camera=source, **still)
        whole = whole.change(None, whole.draw(1)).target
        assert torch.equal(narrower.distortion, whole.distortion)
        ratio = narrower.intrinsics[..., :2] / whole.intrinsics[..., :2]
        assert (ratio > 1 - 1e-6).all()
        assert torch.allclose(ratio[..., 0], ratio[..., 1])
        assert degrees < 100 or like != "dms60" or ratio.max() == 1
        if ratio.max() > 1:  # a little wider, and something is missing
            wider = narrower.replace(intrinsics=narrower.intrinsics * torch.tensor([0.97, 0.97, 1, 1]))
            assert not ct.Warp(source, wider).valid_mask().all()


def test_every_source_has_its_own_fov():
    cameras = ct.augment.collate([pinhole(40), pinhole(80)]).requires_grad_(False)
    augmentation = RandomCamera("dms130", fov="source", min_filled=0.95)
    found = shares(augmentation, 2, camera=cameras)
    assert found.min() > 0.95
    focal = augmentation.change(cameras, augmentation.draw(2)).target.intrinsics[:, 0]
    assert focal[0] > 1.5 * focal[1]
