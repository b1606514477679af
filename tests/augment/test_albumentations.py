"""The augmentations in albumentations' pipelines: the same as for arrays, in its conventions."""

import numpy as np
import pytest
import torch
from cameras import SIZE, fisheye

import camtorch as ct

A = pytest.importorskip("albumentations", reason="albumentations is not installed")

import camtorch.augment.albumentations  # noqa: E402
import camtorch.augment.numpy  # noqa: E402


def transform(**options):
    return ct.augment.albumentations.Transform(ct.augment.RandomCamera(yaw=8, pitch=8, roll=15, **options), fisheye())


def compose(*transforms, seed=3, **options):
    boxes = A.BboxParams(format="pascal_voc", label_fields=["names"])
    points = A.KeypointParams(format="xy", remove_invisible=False)
    return A.Compose(list(transforms), bbox_params=boxes, keypoint_params=points, seed=seed, **options)


def sample():
    rng = np.random.default_rng(0)
    return {
        "image": rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8),
        "mask": rng.integers(0, 9, SIZE, dtype=np.uint8),
        "bboxes": np.array([[20.0, 15, 42, 33]]),
        "names": ["face"],
        "keypoints": np.array([[30.0, 20.0], [40.0, 30.0], [500.0, 20.0]]),
    }


def test_seeds_and_replays():
    first, again, other = (compose(transform(), seed=seed)(**sample())["image"] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    replay = A.ReplayCompose([transform(), A.HorizontalFlip(p=0.5)], keypoint_params=A.KeypointParams(format="xy"))
    plain = {"image": sample()["image"], "keypoints": sample()["keypoints"][:2]}
    once = replay(**plain)
    twice = A.ReplayCompose.replay(once["replay"], **plain)
    np.testing.assert_array_equal(once["image"], twice["image"])


@pytest.mark.parametrize("data_format", ["json", "yaml"])  # YAML sorts keys, and ranges are drawn in their order
def test_pipelines_are_saved_as_plain_numbers(data_format, tmp_path):
    flip = ct.augment.HorizontalFlip(landmarks={"keypoints": [(0, 1)]}, p=1, fields={"class": "keep"})
    lens = ct.augment.RandomLens("dms130", fov="source", min_filled=0)
    lens.ranges["focal"] = ct.augment.Range(0.7, 0.8)
    parts = ct.augment.Compose([flip, lens, ct.augment.Resize((24, 32))])
    guessed = ct.augment.albumentations.Transform(ct.augment.RandomMount(yaw=9, camera=60), p=0.9)
    given = compose(ct.augment.albumentations.Transform(parts, fisheye()), guessed, seed=3)
    A.save(given, tmp_path / "pipeline", data_format=data_format)
    loaded = A.load(tmp_path / "pipeline", data_format=data_format)
    loaded.set_random_seed(3)
    expected, result = given(**sample()), loaded(**sample())
    np.testing.assert_array_equal(result["image"], expected["image"])
    np.testing.assert_array_equal(result["keypoints"], expected["keypoints"])
    assert torch.equal(result["camera"].intrinsics, expected["camera"].intrinsics)
    lens.table = torch.ones(3)
    with pytest.raises(TypeError, match=r"augmentations\[1\].table must be numbers.*; got Tensor.*Pickle the pipeline"):
        A.to_dict(given)
    unknown = A.to_dict(compose(guessed))
    unknown["transform"]["transforms"][0]["augmentation"]["__class__"] = "mine.Own"
    with pytest.raises(ValueError, match=r"class must be imported before A\.load; got 'mine\.Own'"):
        A.from_dict(unknown)


def test_what_has_no_place_is_where_its_params_look():
    wide = ct.KannalaBrandt([18.0, 18.0, 31.5, 23.5], image_size=SIZE).requires_grad_(False)
    mount = ct.augment.RandomCamera("pinhole", fov=60, yaw=(150, 150), pitch=0, roll=0, min_filled=0)
    one = ct.augment.albumentations.Transform(mount, wide)
    out = compose(one)(**sample())
    assert out["keypoints"].tolist() == [[-1, -1]] * 3
    assert (len(out["bboxes"]), out["names"]) == (0, [])
    flip = ct.augment.albumentations.Transform(ct.augment.HorizontalFlip(p=1))
    assert compose(one, flip)(**sample())["keypoints"].tolist() == [[-1, -1]] * 3
    away = A.Compose([one], keypoint_params=A.KeypointParams(format="xy", remove_invisible=True))
    assert len(away(image=sample()["image"], keypoints=sample()["keypoints"][:2])["keypoints"]) == 0


def test_p_and_chains_of_cameras():
    none = {"bboxes": [], "names": [], "keypoints": []}
    assert len(compose(transform())(**sample() | none)["bboxes"]) == 0
    never = compose(transform(p=0))(**sample())
    np.testing.assert_array_equal(never["image"], sample()["image"])
    assert torch.equal(never["camera"].intrinsics, fisheye().intrinsics)
    first, second = transform(), transform(image_size=(24, 32))
    out = compose(first, A.RandomBrightnessContrast(p=1), second)(**sample())
    assert out["image"].shape == (24, 32, 3)
    assert out["camera"].image_size == (24, 32)
    assert torch.equal(second.last.source.intrinsics, first.last.target.intrinsics)


def test_further_targets_and_lists():
    pipeline = A.Compose([transform()], additional_targets={"infrared": "image", "parts": "mask"}, seed=1)
    image, mask = sample()["image"], sample()["mask"]
    out = pipeline(image=image, infrared=image, mask=mask, parts=mask, masks=[mask, mask], images=np.stack([image] * 2))
    np.testing.assert_array_equal(out["image"], out["infrared"])
    np.testing.assert_array_equal(out["mask"], out["parts"])
    np.testing.assert_array_equal(out["masks"][1], out["mask"])
    np.testing.assert_array_equal(out["images"][1], out["image"])


def test_further_targets_have_the_kinds_that_fields_give():
    fields = {"lidar": "points", "scores": "keep"}
    pipeline = A.Compose([transform(fields=fields)], additional_targets={"behind": "lidar", "more": "scores"}, seed=1)
    points = np.random.default_rng(0).random((5, 3)).astype(np.float32) + 1
    out = pipeline(image=sample()["image"], lidar=points, behind=points, more=points)
    assert not np.array_equal(out["lidar"], points)
    np.testing.assert_array_equal(out["behind"], out["lidar"])
    np.testing.assert_array_equal(out["more"], points)


def test_what_is_wrong_is_told():
    with pytest.raises(TypeError, match="augmentation must be an Augmentation; got str"):
        ct.augment.albumentations.Transform("mount")
    with pytest.raises(ValueError, match=r"camera must be a Camera; got None\. Please give one here, in the sample,"):
        A.Compose([ct.augment.albumentations.Transform(ct.augment.RandomMount())])(image=sample()["image"])
    with pytest.raises(ValueError, match=r"image must be of the camera's image_size \(48, 64\); got \(47, 64\)"):
        A.Compose([transform()])(image=sample()["image"][1:])


def test_trainers_move_boxes_by_the_name_of_a_class():
    """As Ultralytics and RF-DETR make a pipeline: with boxes if the name of a transform is among those they know."""

    class OpticalDistortion(ct.augment.albumentations.Transform):
        """Of docs/guides/pipelines.md."""

    lens = ct.augment.RandomLens("kannala_brandt", fov=80, min_filled=0)
    one = OpticalDistortion(**{"augmentation": lens, "camera": 60, "p": 1.0})
    pipeline = A.Compose([one, A.Blur(p=0.1)], bbox_params=A.BboxParams(format="yolo", label_fields=["class_labels"]))
    pipeline.set_random_seed(0)
    for height, width in ((48, 64), (80, 50)):
        image, box = np.zeros((height, width, 3), np.uint8), np.array([[0.5, 0.5, 0.4, 0.5]])
        out = pipeline(image=image, bboxes=box, class_labels=np.array([[3.0]]))
        boxes = torch.tensor([[0.3 * width, 0.25 * height, 0.7 * width, 0.75 * height]]) - 0.5
        moved = lens.moved_by(one.augmentation.last, {"boxes": boxes})["boxes"][0].numpy() + 0.5
        assert out["image"].shape == image.shape
        assert out["camera"].image_size == (height, width)
        middle, sides = (moved[:2] + moved[2:]) / 2, moved[2:] - moved[:2]
        np.testing.assert_allclose(out["bboxes"][0], np.concatenate((middle, sides)) / ([width, height] * 2), atol=1e-3)
        assert np.abs(out["bboxes"][0] - box[0]).max() > 0.01


def test_images_of_a_list_tell_their_size():
    images = np.stack([sample()["image"]] * 2)
    flip = ct.augment.albumentations.Transform(ct.augment.HorizontalFlip(p=1))
    np.testing.assert_array_equal(flip(images=images)["images"], images[:, :, ::-1])
    guessed = ct.augment.albumentations.Transform(ct.augment.RandomMount(camera=60), p=1)
    assert guessed(images=images)["camera"].image_size == SIZE
