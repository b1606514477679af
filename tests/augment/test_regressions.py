"""What augmentations once did wrong, where several fields, options or cameras meet."""

import math

import numpy as np
import pytest
import torch

import camtorch as ct
from camtorch.augment import PRESETS, FaceNormalizer, HorizontalFlip, RandomCamera, RandomLens, RandomMount

# wide lenses for narrow images, on purpose
pytestmark = pytest.mark.filterwarnings("ignore:.*will show nothing")

SIZE = (60, 80)


@pytest.fixture
def camera():
    return ct.Pinhole([60.0, 60.0, 39.5, 29.5], image_size=SIZE).requires_grad_(False)


def test_a_lattice_invents_no_image():
    """A cubic through nodes off the image may swing onto it."""
    source = PRESETS["dms90"].camera()
    wide = {"fov": 200, "yaw": (-90, 90), "pitch": 20, "roll": 20, "image_size": (224, 224)}
    exact, close = (RandomCamera("kannala_brandt", camera=source, tolerance=t, **wide) for t in (0.0, 0.001))
    draw = exact.draw(12, torch.Generator().manual_seed(0))
    ones = torch.ones(12, 1, *source.image_size)
    difference = exact(image=ones, draw=draw)["image"] - close(image=ones, draw=draw)["image"]
    assert difference.abs().max() < 0.01


def test_a_face_goes_back_to_the_camera_it_came_from(camera):
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[:, 2, 3] = 0.7
    sample = {"head_pose": pose, "gaze": torch.tensor([[0.1, 0.2, -1.0]] * 2), "keypoints": torch.rand(2, 5, 2) * 50}
    turned = RandomMount(camera=camera, roll=40)(sample)
    normalizer = FaceNormalizer(distance=0.6)
    back = normalizer.inverse(normalizer(turned))
    for name in ("gaze", "keypoints", "rotation", "head_pose"):
        torch.testing.assert_close(back[name], turned[name], atol=2e-4, rtol=1e-5)
    with pytest.raises(TypeError, match="head_pose must be one tensor for all samples; got a list"):
        normalizer(head_pose=list(pose), camera=camera)


def test_what_is_no_number_stays_where_it_is_when_an_image_shrinks(camera):
    image = torch.rand(2, 1, *SIZE)
    image[0, 0, 30, 40] = math.nan
    shrunk = torch.tensor([[60.0, 60, 39.5, 29.5], [10.0, 10, 39.5, 29.5]])
    target = ct.Pinhole(shrunk, image_size=SIZE).requires_grad_(False)
    out = ct.Warp(camera, target, antialias=True)(image)
    assert out[0].isnan().sum() <= 36  # a rounding error above its size, it takes a share of the next level
    assert not out[1].isnan().any()


@pytest.mark.parametrize("zoom", [1.0, 0.3, 0.1])
def test_a_white_image_on_white_is_white(camera, zoom):
    mount = RandomMount(camera=camera, zoom=(zoom, zoom), antialias=True, fill=1.0)
    white = mount(image=torch.ones(1, 1, *SIZE))["image"]
    torch.testing.assert_close(white, torch.ones_like(white))


def test_a_list_of_images_shows_the_lens_as_a_batch_does(camera):
    lens = RandomLens(camera=camera, chromatic=0.03, vignetting=(0.3, 0.6))
    images, draw = torch.rand(3, 3, *SIZE), lens.draw(3)
    together, apart = lens(image=images, draw=draw)["image"], lens(image=list(images), draw=draw)["image"]
    torch.testing.assert_close(torch.stack(apart), together, atol=2e-3, rtol=0)


def test_a_gate_of_numbers_is_a_gate(camera):
    mount, points = RandomMount(camera=camera), torch.rand(2, 4, 2) * 50
    draw = mount.draw(2)
    for gate in (torch.tensor([0.9, 0.2]), torch.tensor([255, 0], dtype=torch.uint8), [1, 0]):
        out = mount(keypoints=points, draw={**draw, "apply": gate})["keypoints"]
        assert out.shape == points.shape
        assert torch.equal(out[1], points[1])
        assert not torch.equal(out[0], points[0])
    with pytest.raises(ValueError, match=r"draw\['yaw'\] must be finite"):
        mount(keypoints=points, draw={**draw, "yaw": torch.tensor([math.nan, 0.0])})
    expected = r"RandomMount: draw\['apply'\] must be \(B,\), which of B samples move; got "
    for image in (torch.rand(2, 1, *SIZE), torch.rand(2, 3, 1, *SIZE)):  # frames, and clips of them
        for gate, got in ((True, "True"), (torch.tensor(True), "tensor"), (torch.ones(2, 1), "Tensor of shape")):
            with pytest.raises(ValueError, match=expected + got):
                mount(image=image, draw={**draw, "apply": gate})
        with pytest.raises(TypeError, match=r"draw must be a dict, as .*; got 5"):
            mount(image=image, draw=5)
    with pytest.raises(ValueError, match="count must not be negative; got -1"):
        mount.draw(-1)


def test_a_gate_that_may_not_be_read_holds_for_lists_too(camera):
    mount, images = RandomMount(camera=camera, p=0.5), torch.rand(3, 1, *SIZE)
    points = [torch.rand(n, 2) * 50 for n in (2, 4, 1)]
    draw, gates = mount.draw(3), torch.tensor([[True, False, True], [False, True, False]])

    def moved(gate):
        out = mount(image=images, keypoints=points, draw={**draw, "apply": gate})
        return out["image"], out["keypoints"]

    expected = [moved(gate) for gate in gates]
    for given, *each in zip(torch.func.vmap(moved)(gates)[1], *(labels for _, labels in expected), strict=True):
        torch.testing.assert_close(given, torch.stack(each))


def test_a_gate_that_may_not_be_read_keeps_the_camera_model(camera):
    lens = RandomLens("kannala_brandt", fov=60, p=0.5, min_filled=0)
    source = ct.BrownConrady(camera.intrinsics, [0.1, 0, 0, 0], image_size=SIZE).requires_grad_(False)

    draw, images = lens.draw(2), torch.rand(2, 1, *SIZE)

    def moved(gate):
        return lens(image=images, camera=source, draw={**draw, "apply": gate})["image"]

    with pytest.raises(ValueError, match=r"the camera model must stay .*; got KannalaBrandt for BrownConrady"):
        torch.func.vmap(moved)(torch.tensor([[True, False]]))


def test_a_gate_that_may_not_be_read_holds_for_all_frames(camera, vision):
    module, tv = vision
    transform = module.Transform(RandomMount(yaw=(20, 20), camera=camera, p=0.5, min_filled=0))
    video, points = torch.rand(5, 1, *SIZE), torch.rand(5, 3, 2) * 50

    def moved(_):
        out = transform({"video": tv.Video(video), "keypoints": points})
        return out["video"].as_subclass(torch.Tensor), out["keypoints"]

    pairs = zip(torch.func.vmap(moved, randomness="different")(torch.zeros(8)), (video, points), strict=True)
    of_images, of_points = (((result - given).abs().flatten(1).amax(1) > 0.01).tolist() for result, given in pairs)
    assert of_images == of_points
    assert {*of_images} == {True, False}


def test_a_camera_in_a_batch_of_one_serves_all(camera):
    one = ct.Pinhole(torch.tensor([[60.0, 60, 39.5, 29.5]]), image_size=SIZE).requires_grad_(False)
    mount, points = RandomMount(p=0.5), torch.rand(6, 4, 2) * 50
    draw = mount.draw(6, torch.Generator().manual_seed(0))
    ours, alone = mount(keypoints=points, camera=one, draw=draw), mount(keypoints=points, camera=camera, draw=draw)
    torch.testing.assert_close(ours["keypoints"], alone["keypoints"])


def test_a_batch_is_of_one_size(camera):
    cameras, two = [camera, camera.resize(50, 70)], "the images of a batch must be of one size; got {} of .*one by one"
    images = [torch.rand(3, 60, 80), torch.rand(3, 50, 70)]
    with pytest.raises(ValueError, match=two.format("camera")):
        RandomMount(image_size=(30, 40))(image=images, camera=cameras, keypoints=torch.rand(2, 3, 2) * 40)
    with pytest.raises(ValueError, match=two.format("image")):
        HorizontalFlip()(image=images)
    alike = [image[:, :50, :70] for image in images]
    assert [tuple(image.shape) for image in HorizontalFlip(p=1.0)(image=alike)["image"]] == [(3, 50, 70)] * 2
    with pytest.raises(ValueError, match="camera must be a camera or a list of some; got an empty list"):
        RandomMount()(keypoints=torch.zeros(0, 3, 2), camera=[])


@pytest.mark.parametrize("dtype", [torch.uint16, torch.uint8, torch.float16])
def test_depth_of_any_kind_of_number(camera, dtype):
    depth = torch.full((1, *SIZE), 100).to(dtype)
    out = RandomMount(camera=camera, yaw=0, pitch=0)(depth=depth)["depth"]
    assert out.dtype == dtype
    known = out.float()[out.float() != 0]
    assert ((known - 100).abs() <= 1).all()  # the nearest pixel may lie half a pixel aside


@pytest.mark.parametrize("lead", [(), (1,)])
def test_what_inference_mode_saw_can_be_inverted_in_training(camera, lead):
    mount, image = RandomMount(camera=camera), torch.rand(*lead, 3, *SIZE)
    mount(image=image)
    with torch.inference_mode():
        assert not mount(image=image)["camera"].intrinsics.is_inference()
    weight = torch.ones(1, requires_grad=True)
    mount.inverse(image=image * weight)["image"].sum().backward()
    assert torch.isfinite(weight.grad).all()


@pytest.mark.parametrize(("name", "value"), [("boxes", [[0.1, 0.2, 0.5, 0.9]]), ("landmarks", [[0.4, 0.5, -0.02]] * 2)])
def test_parts_of_an_image_are_no_labels(camera, name, value):
    with pytest.warns(UserWarning, match=rf"{name} must be p.* within \[0, 1\].* 0\.5"):
        RandomMount(camera=camera)({"image": torch.rand(3, *SIZE), name: torch.tensor(value)})


def test_fields_that_only_sound_like_geometry(camera):
    mount = RandomMount(camera=camera)
    sample = {"keypoints": torch.zeros(1, 1, 2), "image_path": "a.png", "mask_path": [("a",), []], "mask_id": 7}
    sample["boxes_note"] = None
    out = mount(sample)
    assert (out["image_path"], out["mask_path"], out["mask_id"]) == ("a.png", [("a",), []], 7)
    for hidden in (
        *({"meta": {"boxes": torch.zeros(1, 4)}}, {"meta": {"deeper": {"mask": torch.ones(1, 3, 4).long()}}}),
        *({"scores": [0.5, 0.25]}, {"views": [torch.ones(3, 4, 5, dtype=torch.uint8)]}, {"image_meta": {"k": [1.5]}}),
        {"ragged": np.array([np.ones(2), None], object)},
    ):
        with pytest.raises(ValueError, match=rf"got real numbers.*fields={{'{next(iter(hidden))}'"):
            mount(sample, **hidden)
        own = RandomMount(camera=camera, fields=dict.fromkeys(hidden, "keep"))
        assert own(sample, **hidden)[next(iter(hidden))] is next(iter(hidden.values()))
    with pytest.raises(TypeError, match="a sample must have strings for names; got 3"):
        mount({3: torch.zeros(1, 2)})
    with pytest.raises(ValueError, match=r"fields=\{'boxes_label': 'keep'\} keeps it unchanged"):
        mount(sample, boxes_label=torch.zeros(1, 3))
