"""The augmentations for numpy arrays and for torchvision: the same as for tensors, in other layouts."""

import importlib
import pickle
import sys
from functools import partial

import numpy as np
import PIL.Image
import pytest
import torch
from cameras import fisheye

import camtorch as ct
import camtorch.augment.numpy

# wide lenses for narrow images, on purpose
pytestmark = pytest.mark.filterwarnings("ignore:.*will show nothing")

SIZE = (24, 32)
camera = partial(fisheye, SIZE, 0.56)


def augmentation(**options):
    return ct.augment.RandomCamera(yaw=12, pitch=8, roll=15, chromatic=0.02, vignetting=(0.1, 0.3), **options)


def images(seed=0):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    mask = np.zeros(SIZE, np.int64)
    mask[9:17, 12:22] = 7
    points = np.array([[15.0, 11.0], [3.5, 20.0], [31.4, 0.0], [-90.0, 5.0]], np.float32)
    return image, mask, points, np.array([[11.5, 8.5, 21.5, 16.5]], np.float32)


def expected(image, seed=3, **fields):
    """What the augmentation gives for tensors, whose channels come last in memory as those of arrays do."""
    torch.manual_seed(seed)
    with torch.no_grad():
        return augmentation()(image=torch.from_numpy(image.copy()).permute(2, 0, 1), camera=camera(), **fields)


def test_layouts_lists_and_what_was_valid_before():
    image, mask, _, _ = images()
    grey = image[..., 0]
    transform = ct.augment.numpy.Transform(augmentation(camera=camera(), valid_mask=True, image_size=(20, 30)))
    out = transform(
        {"image": grey[:, ::-1], "images": [image[..., ::-1], grey]},
        masks=[mask, (mask > 0)[..., None]],
        mask_parts=[],
        keypoints=[(15, 11), (15, 11)],
        keypoints_valid=np.array([False, True]),
        bboxes=[],
        depth=mask.astype(np.float32),
        depth_valid=mask > 0,
        mask_parts_valid=True,
    )
    assert out["image"].shape == out["depth"].shape == out["image_valid"].shape == (20, 30)
    assert out["image_valid"].dtype == bool
    assert [one.shape for one in out["images"]] == [(20, 30, 3), (20, 30)]
    assert [(one.shape, one.dtype.name) for one in out["masks"]] == [((20, 30), "int64"), ((20, 30, 1), "bool")]
    np.testing.assert_array_equal(out["masks"][0] > 0, out["masks"][1][..., 0])
    np.testing.assert_array_equal(out["depth_valid"], out["masks"][1][..., 0])
    assert out["mask_parts_valid"] is True
    assert (out["mask_parts"], out["bboxes"].shape, out["keypoints"].dtype) == ([], (0, 4), np.float32)
    assert out["keypoints_valid"].tolist() == [False, True]
    draw = transform.augmentation.draw(1)
    stacked = transform(masks=np.stack([mask, mask]), draw=draw)["masks"]
    np.testing.assert_array_equal(stacked, [transform(mask=mask, draw=draw)["mask"]] * 2)
    empty = transform(masks=np.zeros((0, *SIZE), np.uint8), image=image)["masks"]
    assert (empty.shape, empty.dtype) == ((0, 20, 30), np.uint8)


@pytest.mark.parametrize("name", ["keypoints", "polygons", "boxes", "gaze", "points", "pitch_yaw"])
def test_an_empty_list_is_no_value_of_any_kind(name):
    transform = ct.augment.numpy.Transform(ct.augment.RandomMount(), camera())
    image = images()[0]
    moved = transform({"image": image, name: []})
    ends = {"polygons": (0, 0, 2), "boxes": (0, 4), "gaze": (0, 3), "points": (0, 3)}
    assert moved[name].shape == ends.get(name, (0, 2))
    assert transform.inverse(moved)[name].shape == moved[name].shape


def test_there_and_back():
    image, _, points, _ = images()
    transform = ct.augment.numpy.Transform(ct.augment.RandomMount(), camera())
    out = transform(image=image, keypoints=points[:2], gaze=[0.0, 0.6, -0.8])
    back = transform.inverse(**out)
    learns = ct.augment.numpy.Transform(ct.augment.RandomMount())
    learnt = learns(image=image.astype(np.float32), camera=camera().requires_grad_())
    assert learns.inverse(learnt)["image"].dtype == np.float32
    for name, value in (("keypoints", points[:2]), ("gaze", [0, 0.6, -0.8]), ("rotation", np.eye(3))):
        np.testing.assert_allclose(back[name], value, atol=1e-3 if name == "keypoints" else 1e-6)
    draw = transform.augmentation.draw(1, torch.Generator().manual_seed(5))
    moved = transform(keypoints=points, generator=torch.Generator().manual_seed(5))["keypoints"]
    np.testing.assert_array_equal(moved, transform(keypoints=points, draw=draw)["keypoints"])
    again = transform.inverse(keypoints=moved[:2], draw=draw)
    np.testing.assert_allclose(again["keypoints"], points[:2], atol=1e-3)


@pytest.mark.parametrize("name", ["keypoints", "landmarks"])
def test_keypoints_keep_the_shape_of_opencv(name):
    image, _, array, _ = images()
    planes, points = torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(array)
    tensors = augmentation(camera=camera())
    for call, frame, flat, column in (
        (ct.augment.numpy.Transform(tensors), image, array, array[:, None]),
        (tensors, planes, points, points[:, None]),
        (tensors, planes[None], points[None], points[None, :, None]),
        (tensors, planes[None], [points], [points[:, None]]),
    ):
        outs = []
        for given in (flat, column):
            torch.manual_seed(1)
            outs.append(call({"image": frame, name: given}))
        for key, axis in ((name, -2), (f"{name}_valid", -1)):
            want, one = (torch.as_tensor(out[key][0] if isinstance(out[key], list) else out[key]) for out in outs)
            assert torch.equal(one, want.unsqueeze(axis))


def test_errors_name_the_field_and_its_shape():
    image, mask, points, _ = images()
    own, one, names = augmentation(camera=camera()), torch.from_numpy(image), ("image", "image_left")
    transform = ct.augment.numpy.Transform(own)
    last, first = r"{} must have its channels first.*channels last.*{}.permute\({}\)", image.T.swapaxes(1, 2)
    for call, text, fields in (
        (transform, r"image must be .* got shape \(3, 24, 32\)\. .*np.moveaxis\(image, ", {"image": first}),
        (transform, r"image must be of camera's image_size \(24, 32\); got \(23, 32\)", {"image": image[1:]}),
        (transform, r"masks\[1\] must be .* got shape \(32,\)", {"masks": [mask, mask[0]]}),
        (transform, r"keypoints must be \(N, 2\).* got shape \(4, 1\)", {"keypoints": points[:, :1]}),
        (transform, "image must be a numpy array .* got dtype object", {"image": image.astype(object)}),
        (transform, "mask must be a numpy array .* got Tensor", {"mask": torch.from_numpy(mask)}),
        (transform, "keypoints must be a numpy array .* got list", {"keypoints": [[1, 2], [3]]}),
        (transform, r"transform\(image=...\); got ndarray", image),
        (ct.augment.numpy.Transform, "must be an Augmentation or a FaceNormalizer; got str", "RandomMount"),
        *((own, last.format(n, n, "2, 0, 1"), {n: v}) for n in names for v in (image, one, [one, one])),
        *((own, last.format(n, n, "0, 3, 1, 2"), {n: one[None]}) for n in names),
    ):
        with pytest.raises((TypeError, ValueError), match=text):
            call(fields)
    assert own(image=image.transpose(2, 0, 1))["image"].shape == own(image=one.permute(2, 0, 1))["image"].shape


def test_nests_of_clips_and_of_names_that_are_there_twice(vision):
    front_end, tv = vision
    image, mask, points, _ = images()
    planes, mask, points = torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(mask), torch.from_numpy(points)
    gaze = torch.tensor([0.6, 0.0, 0.8]), torch.tensor([0.0, 0.0, 1.0])
    sides = {"gaze_left": gaze[0], "gaze_right": gaze[1], "marks": points, "seen": torch.tensor([0.0, 1, 2, 3])}
    sample = {
        "nested": [tv.Mask(mask.expand(2, -1, -1)), "text", torch.ones(3)],
        "video": tv.Video(planes.expand(2, 4, -1, -1, -1)),
        "points": tv.KeyPoints(points.reshape(2, 2, 2), canvas_size=SIZE),
        "driver": {**sides, "head_pose": torch.eye(4).expand(2, 4, 4, 4)},
        "passenger": {**sides, "array": np.ones((4, 2), np.float32)},
        "camera": camera(),
    }
    own = {"nested": "keep", "array": "keypoints", "marks": "keypoints", "seen": "keep"}
    own, landmarks = {"fields": own, "camera": camera()}, {key: [(0, 1)] for key in ("marks", "seen")}
    for augment in (augmentation(**own), ct.augment.HorizontalFlip(p=1, landmarks=landmarks, **own)):
        torch.manual_seed(3)
        out = front_end.Transform(augment)(sample)
        torch.manual_seed(3)
        pose = torch.eye(4)
        want = augment(image=planes, mask=mask, keypoints=points, head_pose=pose, **sides, array=torch.ones(4, 2))
        assert [type(value) for value in out.values()] == [type(value) for value in sample.values()]
        assert out["nested"][1:] == sample["nested"][1:]
        for moved, value in (
            (out["video"], want["image"].expand(2, 4, -1, -1, -1)),
            (out["nested"][0], want["mask"].expand(2, -1, -1)),
            (out["points"], want["keypoints"].reshape(2, 2, 2)),
            (out["driver"]["head_pose"], want["head_pose"].expand(2, 4, 4, 4)),
            *((out[who][name], want[name]) for who in ("driver", "passenger") for name in sides),
            (torch.from_numpy(out["passenger"]["array"]), want["array"]),
            (out["camera"].intrinsics, want["camera"].intrinsics),
        ):
            torch.testing.assert_close(moved.as_subclass(torch.Tensor), value, rtol=0, atol=0)


def test_a_grey_picture_moves_as_a_mask_if_its_name_is_one_of_a_mask(vision):
    image, mask, *_ = images()
    labels = PIL.Image.fromarray((30 * mask).astype(np.uint8))
    transform = vision[0].Transform(augmentation(fields={"seg*": "mask"}), camera())
    names = "grey", "mask", "mask_iris", "seg_map"
    out = transform({"image": PIL.Image.fromarray(image), **dict.fromkeys(names, labels)})
    grey, *found = (set(np.unique(out[name]).tolist()) for name in names)
    assert ([out[name].mode for name in names], found) == (["L"] * 4, [{0, 210}] * 3)
    assert grey > {0, 210}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.int64])
@pytest.mark.parametrize("form", ["XYXY", "XYWH", "CXCYWH"])
def test_boxes_enclose_their_masks_in_every_format(vision, form, dtype):
    front_end, tv = vision
    mask = tv.Mask(torch.from_numpy(images()[1]))
    edges = {"XYXY": [12, 9, 22, 17], "XYWH": [12, 9, 10, 8], "CXCYWH": [17, 13, 10, 8]}[form]
    values = torch.tensor([edges, edges]).to(dtype)
    boxes = tv.BoundingBoxes(values, format=tv.BoundingBoxFormat[form], canvas_size=SIZE)
    transform = front_end.Transform(augmentation(image_size=(48, 60), tolerance=0), camera())
    for seed in range(5):
        torch.manual_seed(seed)
        moved, labels = transform(boxes, mask)
        assert (moved.format.value, moved.dtype, tuple(moved.canvas_size)) == (form, dtype, (48, 60))
        one, two = moved.as_subclass(torch.Tensor)[1].double().chunk(2)
        low = one - two / 2 if form == "CXCYWH" else one
        high = {"XYXY": two, "XYWH": one + two, "CXCYWH": one + two / 2}[form]
        seen = (labels.as_subclass(torch.Tensor) == 7).nonzero().flip(-1)
        # pixels are as wide as one, and labels keep to whole ones
        beyond = torch.cat((seen.amin(0) - low, high - seen.amax(0) - 1))
        assert (beyond > -0.55).all()
        assert (beyond < (1.1 if dtype.is_floating_point else 3.5)).all()


def test_what_has_no_place_keeps_its_row(vision):
    front_end, tv = vision
    wide = ct.KannalaBrandt([9.0, 9.0, 15.5, 11.5], image_size=SIZE)
    transform = front_end.Transform(ct.augment.RandomCamera("pinhole", fov=60, yaw=(150, 150)), wide)
    image = torch.zeros(3, *SIZE)
    values = torch.tensor([[14, 10, 3, 2]])
    boxes = tv.BoundingBoxes(values, format=tv.BoundingBoxFormat.XYWH, canvas_size=SIZE)
    points = tv.KeyPoints(torch.tensor([[15, 11], [16, 12]]), canvas_size=SIZE)
    _, boxes, points = transform(image, boxes, points)
    assert boxes.tolist() == [[-1, -1, 0, 0]]
    assert points.tolist() == [[-1, -1], [-1, -1]]
    none = tv.BoundingBoxes(torch.zeros(0, 4), format=tv.BoundingBoxFormat.XYXY, canvas_size=SIZE)
    _, none, masks = transform(image, none, tv.Mask(torch.zeros(0, *SIZE, dtype=torch.bool)))
    assert (none.shape, masks.shape) == ((0, 4), (0, *SIZE))


def test_what_would_not_move_or_be_misread_is_refused(vision):
    front_end, tv = vision
    image = torch.zeros(3, *SIZE)
    boxes = tv.BoundingBoxes(torch.tensor([[2.0, 3, 9, 8]]), format=tv.BoundingBoxFormat.XYWH, canvas_size=SIZE)
    formats = {tv.BoundingBoxFormat[name]: count for name, count in (("XYWHR", 5), ("CXCYWHR", 5), ("XYXYXYXY", 8))}
    turned = [tv.BoundingBoxes(torch.ones(2, count), format=f, canvas_size=SIZE) for f, count in formats.items()]
    transform = front_end.Transform(augmentation(), camera())
    two = front_end.Transform(augmentation(), ct.Pinhole(torch.ones(2, 4), image_size=SIZE))
    size = r"KeyPoints must be of the camera's image_size \(24, 32\); got \(5, 6\) \(height, width\)"
    for call, sample, text in (
        (transform, (tv.Image(image), torch.ones(4, 3)), r"'\[1\]' must have a kind.*fields="),
        (transform, (image, image), r"'\[1\]' must have a kind"),
        (transform, {"image": image, "target": [torch.ones(3)]}, "'target' must have a kind"),
        (transform, {"image": image, "tvec": torch.ones(2, 4)}, "tvec must be"),
        (transform, {"image": image, "gaze": [0.0, 0.0, 1.0]}, "gaze must be a tensor of real numbers"),
        (transform, tv.KeyPoints(torch.ones(1, 2), canvas_size=(5, 6)), size),
        (transform, torch.ones(3, 7, 8), r"Tensor must be of .* got \(7, 8\)"),
        (transform, PIL.Image.new("P", SIZE[::-1]), "mode 'P'"),
        (front_end.Transform(augmentation()), image, "camera must be a Camera; got None"),
        (two, image, r"batch dims \(2,\)"),
        (front_end.Transform, ct.augment.FaceNormalizer(), "got FaceNormalizer"),
        (augmentation(camera=camera()), {"image": image, "boxes": boxes}, "must be .* x1, y1, x2, y2; got .*XYWH"),
        *((transform, {"box": one}, f"format {one.format.value}.*, pass their corners as keypoints") for one in turned),
    ):
        with pytest.raises((TypeError, ValueError), match=text):
            call(sample)
    with pytest.raises(TypeError, match=r"a sample must be given, as in transform\(image, target\) or .*; got nothing"):
        transform()
    torch.manual_seed(0)  # one draw in twenty leaves no pixel empty
    # as v2 has it, but for names that say something else
    out = transform({"gaze": torch.tensor([[0.0, 0.0, 1.0]]), "frame": image + 1, "weight": 0.5, "label": 3})
    assert out["gaze"].shape == (1, 3)
    assert (out["frame"] == 0).any()
    kept = front_end.Transform(augmentation(fields={"[1]": "keep"}), camera())(image, torch.ones(4, 3))
    assert torch.equal(kept[1], torch.ones(4, 3))


def test_plain_tensors_and_pil_images(vision):
    front_end, _ = vision
    transform, plain = front_end.Transform(augmentation(), camera()), torch.from_numpy(images()[0]).permute(2, 0, 1)
    torch.manual_seed(3)  # as `expected` does
    moved, label = transform(plain, 5)
    torch.testing.assert_close(moved, expected(images()[0])["image"], rtol=0, atol=0)
    assert label == 5
    for mode in ("RGB", "L", "RGBA", "CMYK", "F", "I;16"):
        source = PIL.Image.new(mode, SIZE[::-1], 9 if mode in ("L", "F", "I;16") else (9,) * len(mode))
        source.info["exif"] = b"turned"
        moved, label = transform(source, 5)
        assert (moved.mode, moved.size, moved.info, label) == (mode, source.size, source.info, 5)
        assert np.asarray(moved).max() > 5
    assert not transform(plain.float()).requires_grad
    assert transform(plain.float().requires_grad_()).requires_grad
    copy = pickle.loads(pickle.dumps(front_end.Transform(augmentation(p=0), camera())))
    assert torch.equal(copy(plain, 1)[0], plain)
    assert copy.last.target.image_size == SIZE


def test_a_torchvision_that_does_not_load_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    with pytest.raises(ImportError, match=r"torchvision must be installed, and be built for torch \d.* got"):
        importlib.import_module("camtorch.augment.torchvision")
