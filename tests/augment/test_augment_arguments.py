"""What is no sample, option or camera of augmentations is refused: which field, what it was, what it should be."""

import math
import re

import numpy as np
import PIL.Image
import pytest
import torch

import camtorch as ct
import camtorch.augment.numpy
from camtorch.augment import (
    PRESETS,
    FaceNormalizer,
    HorizontalFlip,
    RandomCamera,
    RandomLens,
    RandomMount,
    names,
    outlines,
)
from camtorch.augment.fields import KINDS

SIZE, POINTS = (30, 40), torch.zeros(2, 5, 2)


@pytest.fixture
def camera():
    return ct.Pinhole([30.0, 30.0, 19.5, 14.5], image_size=SIZE).requires_grad_(False)


OPTIONS = [
    ({"yaw": (5, -5)}, r"yaw must be \(low, high\) with low <= high; got \(5, -5\)"),
    ({"yaw": (0, math.nan)}, "yaw must be finite"),
    ({"yaw": (0, 1, 2)}, r"yaw must be a range \(low, high\) or a number"),
    ({"yaw": "far"}, r"yaw must be a range \(low, high\) or a number; got 'far'"),
    ({"pitch": 400}, r"pitch must lie within \[-180, 180\]"),
    ({"p": 1.5}, r"p must be a probability in \[0, 1\]; got 1.5"),
    ({"mode": "lanczos"}, "mode must be one of"),
    ({"padding_mode": "wrap"}, "padding_mode must be one of"),
    ({"fill": math.inf}, "fill must be finite"),
    ({"fields": {"g": "stare"}}, "fields must map names to image, mask, .* or keep; got {'g': 'stare'}"),
    ({"camera": "pinhole"}, "camera must be a Camera; got str"),
    ({"image_size": (30, 0)}, "image_size must be positive"),
    ({"tolerance": -1}, "tolerance must be"),
    ({"rol": 20}, r"unknown keyword 'rol'; did you mean 'roll'\?"),
    ({"prob": 0.4}, "unknown keyword 'prob'; known are yaw"),
    ({"focal": (0.9, 1.1)}, "unknown keyword .focal.; .*RandomCamera has it"),
]
OF_LENSES = [
    (RandomCamera, {"crops": 0.9}, r"unknown keyword 'crops'; did you mean 'crop'\?"),
    (RandomLens, {"like": "fisheye"}, r"like must be .*got 'fisheye'\. Did you mean 'kannala_brandt'\?"),
    (RandomLens, {"xyz": 1}, "unknown keyword 'xyz'; known are like, fov, focal, .*min_filled"),
    (RandomLens, {"yaw": 5}, "unknown keyword .yaw.; .*RandomCamera has it"),
    (RandomCamera, {"like": "dms13"}, rf".*\({', '.join(PRESETS)}\) or a model .*; got 'dms13'. .*'dms130'\?"),
    (RandomLens, {"like": "kannala_brandt"}, "like must have an image_size, .* Pass fov="),
    (RandomLens, {"like": ct.Pinhole(torch.ones(2, 4))}, "like must be a single camera; got batch dims"),
    (RandomLens, {"vignetting": 2}, "vignetting must lie within"),
]


@pytest.mark.parametrize(("kind", "options", "text"), [*((RandomMount, *row) for row in OPTIONS), *OF_LENSES])
def test_options(kind, options, text):
    with pytest.raises((ValueError, TypeError), match=f"{kind.__name__}: {text}"):
        kind(**options)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("segment", "Did you mean 'segments'"),
        ("segmentation", "Did you mean 'mask'"),
        ("kpts", "Did you mean 'keypoints'"),
        ("logits", r"got real numbers\. Pass fields="),
        ("probs", r"got real numbers\. Pass fields="),
    ],
)
def test_an_unknown_field_is_close_to_one_that_is_known_or_to_none(camera, name, text):
    mount = RandomMount(camera=camera, fields={"segments": "polygons"})
    with pytest.raises(ValueError, match=text):
        mount({name: torch.zeros(2, 5, 2)})


def test_a_kind_of_almost_that_name_comes_before_the_beginning_of_a_name(monkeypatch):
    monkeypatch.setitem(KINDS, "segments", KINDS["polygons"])
    assert names._close_to.__wrapped__("segment") == ["segments"]


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"keypoints": torch.zeros(2, 5, 3)}, r"keypoints must be \(B, N, 2\) or .* x, y; got shape \(2, 5, 3\)"),
        ({"keypoints": torch.zeros(2, 2, 2, 5, 2)}, r"keypoints must be"),
        ({"boxes": torch.zeros(2, 3, 5)}, r"boxes must be \(B, M, 4\)"),
        ({"gaze": torch.zeros(2, 2)}, r"gaze must be \(B, \*N, 3\)"),
        ({"head_pose": torch.zeros(2, 3, 3)}, r"head_pose must be \(B, 4, 4\)"),
        ({"rvec": torch.zeros(2, 4)}, r"rvec must be \(B, 3\)"),
        ({"image": torch.zeros(2, 3, 20, 40)}, r"image must be of camera's image_size \(30, 40\); got \(20, 40\)"),
        ({"rvec": torch.zeros(2, 3), "keypoints": torch.zeros(3, 5, 2)}, "keypoints must be of 2 samples, .*; got 3"),
        ({"keypoints": POINTS, "keypoints_valid": torch.ones(2)}, r"keypoints_valid must be \(2, 5\); got \[\(2,\)\]"),
        ({"keypoints": torch.zeros(2, 5, 2, dtype=torch.complex64)}, "keypoints must be a tensor of real numbers"),
        ({"keypoints": 5}, "keypoints must be a tensor of real numbers, .*; got int"),
        ({"label": 3}, "the sample must have a field that moves; got none of image, mask"),
        ({"keypoints": [torch.zeros(3, 2), torch.zeros(3)]}, r"keypoints\[1\] must be"),
    ],
)
def test_fields(camera, fields, text):
    with pytest.raises((ValueError, TypeError), match=f"RandomMount: {text}"):
        RandomMount(camera=camera)(fields)


def test_cameras_and_draws(camera):
    mount, zooming, half = RandomMount(), RandomMount(zoom=(1, 2)), RandomMount(p=0.5, image_size=(15, 20))
    draw, given = mount.draw(2), {"keypoints": POINTS, "camera": camera}
    samples, turned = ([aug(given) for _ in range(2)] for aug in (zooming, mount))
    zooming.inverse(samples[1])
    mount.inverse(turned[1])
    some = {"apply": torch.tensor([True, False])}
    for call, text in (
        (lambda: mount(given | {"camera": ct.Pinhole([1.0, 1, 0, 0])}), "camera must have an image_size"),
        (lambda: mount(given | {"camera": {}}), "camera must be a Camera; got dict"),
        (lambda: mount(given | {"camera": camera.expand(3)}), r"no batch dims, or those of 2 samples; got \(3,\)"),
        (lambda: mount(given | {"camera": [camera]}), "camera must have one for each of 2 samples; got 1"),
        (lambda: mount(given | {"camera": [camera] * 3}), "camera must have one for each of 2 samples; got 3"),
        (lambda: mount(given, draw=mount.draw(3)), r"for 2 samples; got one for 3\. draw\(2\) makes one for each$"),
        (
            lambda: mount(given, draw=mount.draw(1)),
            r"got one for 1\. draw\(2\) makes .*, \{name: value.expand\(2, .* for all",
        ),
        (lambda: mount(given, draw=some), "draw must have yaw, pitch, roll, zoom; got apply"),
        (lambda: mount(given, draw={**draw, "yaw": draw["yaw"][:, None]}), r"\['yaw'\] must be \(2,\); .* \(2, 1\)"),
        (lambda: mount(given, draw={**draw, "yaw": ["a", "b"]}), r"draw\['yaw'\] must be numbers; got \['a', 'b'\]"),
        (lambda: mount.change([camera] * 3, draw), "draw must be for 3 samples, as the cameras; got one for 2"),
        (lambda: mount.change(camera, None), "draw must have apply, yaw, pitch, roll, zoom; got nothing"),
        (lambda: RandomMount().inverse(given), "must have a change to invert; got none. Call it first"),
        (lambda: zooming.inverse(samples[0]), r"must be those that this change made; got Pinhole\(.*another call"),
        (lambda: mount.inverse(turned[0]), r"camera and rotation of the sample must be those that this change made"),
        (lambda: half(given, draw=half.draw(2) | some), "with p < 1 the image_size must be that of the images"),
        (lambda: mount(torch.zeros(1, 3, *SIZE)), r"a dict of fields, .* as in image=...; got Tensor\. For PIL"),
        (lambda: mount(torch.zeros(1, 3, *SIZE), {}), r"3 were given\..* camtorch.augment.torchvision.Transform\("),
        (lambda: mount(image=PIL.Image.new("RGB", (4, 4))), r"got Image\..* camtorch.augment.torchvision.Transform\("),
    ):
        with pytest.raises((TypeError, ValueError), match=text):
            call()


@pytest.mark.parametrize("name", ["zoom", "fov", "focal", "crop"])
def test_numbers_of_a_draw_that_make_no_camera(camera, name):
    augment = RandomCamera(zoom=(1, 2), fov=(50, 60), crop=(0.5, 1), camera=camera)
    both, draw = ct.augment.Compose([augment]), augment.draw(2)
    for value in (0.0, -1.0):
        wrong = {**draw, name: torch.tensor([1.0, value])}
        with pytest.raises(ValueError, match=rf"RandomCamera: draw\['{name}'\] must be positive; got \[1.0, {value}\]"):
            augment(image=torch.rand(2, 3, *SIZE), draw=wrong)
        wrong = {**both.draw(2), f"0.{name}": torch.tensor([1.0, value])}
        with pytest.raises(ValueError, match=rf"Compose: draw\['0.{name}'\] must be positive; got"):
            both(image=torch.rand(2, 3, *SIZE), draw=wrong)
    for value, says in ((0.0, "positive"), (torch.nan, "finite")):  # numbers of a graph too
        wrong = {**draw, name: torch.tensor([1.0, value], requires_grad=True)}
        with pytest.raises(ValueError, match=rf"RandomCamera: draw\['{name}'\] must be {says}; got"):
            augment(image=torch.rand(2, 3, *SIZE), draw=wrong)


@pytest.mark.parametrize("as_list", [False, True], ids=["batch", "models"])
def test_a_sample_with_other_coefficients_has_no_inverse(as_list):
    lenses = [ct.KannalaBrandt([30.0, 30, 19.5, 14.5], [0.01 * i, 0, 0, 0], image_size=SIZE) for i in range(2)]
    cameras = [*lenses, ct.Pinhole([30.0, 30, 19.5, 14.5], image_size=SIZE)] if as_list else lenses
    augment = RandomMount(min_filled=0)
    moved = augment(keypoints=torch.zeros(len(cameras), 5, 2), camera=cameras)
    augment.inverse(moved)
    moved["camera"][1] = ct.KannalaBrandt(moved["camera"][1].intrinsics, [0.2, 0, 0, 0], image_size=SIZE)
    with pytest.raises(ValueError, match="camera and rotation of the sample must be those that this change made"):
        augment.inverse(moved)


@pytest.mark.parametrize("learns", [False, True], ids=["by C", "by torch"])
def test_a_lens_that_cannot_be_so_wide_is_told_of_alike(camera, learns):
    wide, source = RandomLens("pinhole", fov=190), camera.clone().requires_grad_(learns)
    text = "RandomLens: fov must be within the reach of a pinhole lens of these coefficients; got 190 degrees"
    for images in (torch.zeros(3, *SIZE), torch.zeros(2, 3, *SIZE)):
        with pytest.raises(ValueError, match=f"^{text}$"):
            wide(image=images, camera=source)


def test_labels_that_are_no_numbers_are_invalid_and_finite(camera):
    keypoints = torch.tensor([[[5.0, 5.0], [math.nan, 3.0], [math.inf, 1.0], [10.0, 10.0]]]).requires_grad_()
    boxes = torch.tensor([[[1.0, 1.0, 5.0, 5.0], [math.nan, 0.0, 1.0, 1.0]]])
    out = RandomCamera("dms90", camera=camera, yaw=1, pitch=1, crop=None)(keypoints=keypoints, boxes=boxes)
    assert out["keypoints_valid"].tolist() == [[True, False, False, True]]
    assert torch.isfinite(out["keypoints"]).all()
    assert torch.isfinite(out["boxes"]).all()
    assert out["boxes_valid"].tolist() == [[True, False]]
    out["keypoints"].sum().backward()
    assert torch.isfinite(keypoints.grad).all()


def test_outlines_follow_what_a_box_cannot(camera):
    box = torch.tensor([[[2.0, 3.0, 30.0, 25.0]]])
    polygons = outlines(box, samples=8)
    assert polygons.shape == (1, 1, 32, 2)
    assert torch.equal(polygons[0, 0, ::8], torch.tensor([[2.0, 3.0], [30.0, 3.0], [30.0, 25.0], [2.0, 25.0]]))
    out = RandomMount(camera=camera, roll=(45, 45))(polygons=polygons, boxes=box)
    moved, enclosing = out["polygons"][0, 0], out["boxes"][0, 0]
    assert out["polygons_valid"].shape == (1, 1, 32)
    assert (moved >= enclosing[:2] - 1e-3).all()
    assert (moved <= enclosing[2:] + 1e-3).all()
    with pytest.raises(ValueError, match=r"boxes must be \(..., 4\)"):
        outlines(torch.zeros(3))
    with pytest.raises(ValueError, match="samples must be at least 1; got 0"):
        outlines(box, 0)


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("boxes", [[5.0, 5.0, 9.0, 9.0], [20.0, 15.0, 8.0, 6.0]], r"boxes.*xyxy.*\[20.0, 15.0, 8.0, 6.0\].*x \+ width"),
        ("head_pose", torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0])).tolist(), "head_pose.*rotation.*det R = .-1.0"),
        ("head_pose", (2 * torch.eye(4)).tolist(), "head_pose must hold rotation matrices"),
        ("pitch_yaw", [10.0, -20.0], "pitch_yaw must be radians.*got 10, -20.*deg2rad"),
        ("rvec", [0.0, 90.0, 0.0], "rvec.*radians; got an angle of 90, which seems to be degrees"),
    ],
)
def test_labels_in_another_form_are_refused_by_their_name(camera, field, value, said, listed):
    value = torch.tensor(value)
    sample = {field: [value, value] if listed else value}
    said = said.replace(field, rf"{field}\[0\]", 1) if listed else f"RandomMount: {said}"
    with pytest.raises(ValueError, match=said):
        RandomMount(yaw=5, camera=camera)(sample)


def test_labels_that_are_missing_or_just_within_are_taken(camera):
    sample = {
        "boxes": torch.tensor([[3.0, 3.0, 3.0, 3.0], [math.nan] * 4, [-1.0] * 4]),
        "pitch_yaw": torch.tensor([math.pi / 2, -math.pi]).bfloat16(),
        "head_pose": ct.Extrinsics([0.3, -0.2, 0.5], [0.0, 0.0, 1.0]).matrix().detach().bfloat16(),
        "rvec": torch.tensor([0.0, 2 * math.pi, 0.0]),
    }
    RandomMount(yaw=5, camera=camera)(sample)
    RandomMount(yaw=5, camera=camera)(head_pose=torch.full((4, 4), math.nan))


def test_pitch_ends_at_a_right_angle_and_yaw_at_a_straight_one(camera):
    mount = RandomMount(camera=camera)
    assert mount(pitch_yaw=torch.tensor([[1.57, 3.14]]))["pitch_yaw"].shape == (1, 2)
    for angles in ([2.0, 0.0], [0.0, 3.3]):
        with pytest.raises(ValueError, match="pitch within pi / 2 and yaw within pi"):
            mount(pitch_yaw=torch.tensor([angles]))


def test_a_pattern_matches_no_shorter_name(camera):
    mount = RandomMount(camera=camera, fields={"lid*dar": "keep"})
    assert torch.equal(mount(keypoints=POINTS, lid_dar=torch.ones(2, 9, 3))["lid_dar"], torch.ones(2, 9, 3))
    with pytest.raises(ValueError, match="'lidar' must have a kind"):
        mount(keypoints=POINTS, lidar=torch.ones(2, 9, 3))


def test_each_star_of_a_pattern_stands_for_any_characters(camera):
    rays, names = torch.rand(2, 9, 3), ("obs.front.ray.0", "obs..ray.")
    mount = RandomMount(camera=camera, fields={"obs.*.ray.*": "points"})
    out = mount(points=rays, **dict.fromkeys(names, rays))
    assert all(torch.equal(out[name], out["points"]) for name in names)
    for other in ("obs.ray.0", "obs.front.ray", "obsxfront.ray.0", "my_obs.front.ray.0"):
        with pytest.raises(ValueError, match=f"'{other}' must have a kind"):
            mount(points=rays, **{other: rays})
    with pytest.raises(ValueError, match=r"'cam0' must have a kind"):  # no other characters are special
        RandomMount(camera=camera, fields={"cam[0-9]*": "points"})(points=rays, cam0=rays)


@pytest.mark.parametrize("name", ["camera", "rotation", "crop_place", "scale", "source_camera", "source_rotation"])
def test_fields_gives_no_kind_to_what_a_transform_returns(camera, name):
    transforms = {RandomMount: 3, ct.CanonicalCamera: 5, FaceNormalizer: 6}  # how many they return
    names = ["camera", "rotation", "crop_place", "scale", "source_camera", "source_rotation"]
    for transform, count in transforms.items():
        options = {"focal": 500.0} if transform is ct.CanonicalCamera else {}
        for kind in ("keep", "points"):
            if name not in names[:count]:
                transform(fields={name: kind}, **options)
                continue
            with pytest.raises(ValueError, match=f"fields must not name .*{transform.__name__}.*got {{'{name}': "):
                transform(fields={name: kind}, **options)
    RandomMount(fields={"rotation": "rotation"})


def test_kinds_that_are_set_later_are_checked(camera):
    mount = RandomMount(camera=camera, fields={"lidar": "points", "b*": "keep"})
    for key, name in (("lidar", "lidar"), ("b*", "bits")):
        mount.fields[key] = "pts"
        with pytest.raises(ValueError, match=f"fields must map names to image,.*got {{'{re.escape(key)}': 'pts'}}"):
            mount(keypoints=POINTS, **{name: torch.ones(2, 9, 3)})


def test_what_is_set_later_is_checked_as_by_the_constructor(camera):
    mount = RandomMount(camera=camera, p=0.5)
    for name, value, text in (
        ("p", 7, r"RandomMount: p must be a probability in \[0, 1\]; got 7"),
        ("p", "half", "RandomMount: p must be a number"),
        ("min_filled", -3, r"RandomMount: min_filled must be a part in \[0, 1\]; got -3"),
        ("same_on_batch", 3, "RandomMount: same_on_batch must be"),
        ("mask_fill", "none", "RandomMount: mask_fill must be a number; got 'none'"),
        ("valid_mask", 3, "RandomMount: valid_mask must be True or False; got 3"),
        ("mode", "nearst", r"RandomMount: mode must be one of \('nearest', .* got 'nearst'"),
        ("padding_mode", None, "RandomMount: padding_mode must be one of"),
        ("fill", "x", "RandomMount: fill must be a number"),
        ("antialias", "x", "RandomMount: antialias must be True or False"),
        ("tolerance", -1, "RandomMount: tolerance must be a number of pixels"),
    ):
        with pytest.raises((TypeError, ValueError), match=text):
            setattr(mount, name, value)
    assert (mount.p, mount.min_filled, mount.mask_fill, mount.valid_mask) == (0.5, None, 0, False)
    mount.p, mount.min_filled = 1, 0.5
    assert mount(keypoints=POINTS)["keypoints"].shape == POINTS.shape


@pytest.mark.parametrize("kind", [RandomMount, HorizontalFlip, ct.augment.Compose])
def test_options_of_images_may_be_set_later(camera, kind):
    options = {"mode": "nearest", "padding_mode": "border", "fill": 0.5, "antialias": True, "tolerance": 0.0}
    parts = [[RandomMount(yaw=(5, 5))]] if kind is ct.augment.Compose else []
    later, image = kind(*parts, camera=camera, p=1.0), torch.rand(1, 3, *SIZE)
    draw = later.draw(1)
    later(image=image, draw=draw)  # what this call keeps is not used after a change
    for name, value in options.items():
        setattr(later, name, value)
        made = kind(*parts, camera=camera, p=1.0, **{key: getattr(later, key) for key in options})
        assert made.options == later.options
        assert torch.equal(later(image=image, draw=draw)["image"], made(image=image, draw=draw)["image"])


def test_all_tensors_of_a_list_are_on_one_device(camera):
    rows = [torch.ones(2, 2), torch.ones(3, 2, device="meta"), torch.ones(2, 2)]
    with pytest.raises(ValueError, match=r"on one device; got keypoints\[0\] on cpu, keypoints\[1\] on meta"):
        RandomMount(camera=camera)(keypoints=rows)


@pytest.mark.parametrize("options", [{"mode": "nearest"}, {"p": 0.0}, {"min_filled": 0.9}, {"fields": {"a": "keep"}}])
def test_an_option_in_a_call_is_no_field(camera, options):
    (name,) = options
    mount, image = RandomMount(camera=camera), torch.rand(1, 3, *SIZE)
    for call in (mount, lambda **given: ct.augment.numpy.Transform(mount)(**given | {"image": np.zeros((*SIZE, 3))})):
        with pytest.raises(TypeError, match=rf"RandomMount: {name} is an option and no field; got {name}="):
            call(image=image, **options)
    assert mount({"image": image, **options})[name] == options[name]  # as a field of a dict, it stays


def test_a_pose_for_row_vectors_is_refused(camera):
    pose = torch.eye(4)
    pose[3, :3] = torch.tensor([0.1, 0.2, 0.5])
    for fields in ({"head_pose": pose}, {"head_pose": pose.expand(2, 4, 4), "image": torch.rand(2, 3, *SIZE)}):
        with pytest.raises(ValueError, match=r"place in the last column, above a row 0, 0, 0, 1; .* head_pose\.mT"):
            RandomMount(camera=camera)(fields)
    assert RandomMount(camera=camera)(head_pose=pose.mT)["head_pose"].shape == (4, 4)


def test_a_chain_tells_of_a_camera_that_it_does_not_use(camera):
    ct.augment.Compose([RandomMount(camera=camera), RandomMount(camera=60)], camera=camera)
    with pytest.warns(UserWarning, match="of one camera, .*; that of RandomMount is another one, and is not used"):
        ct.augment.Compose([RandomMount(camera=ct.Pinhole.from_fov(50, image_size=SIZE))], camera=camera)


@pytest.mark.parametrize("given", [ct.augment.Range(0, 0), ct.augment.Range(60, 80, 1)])
def test_a_range_that_is_set_later_has_to_make_a_camera(camera, given):
    lens = ct.augment.RandomLens("kannala_brandt", fov=(60, 80), camera=camera)
    lens(keypoints=POINTS)
    lens.ranges["fov"] = given
    with pytest.raises(ValueError, match=r"RandomLens: the range 'fov' must be .*; got Range\("):
        lens(keypoints=POINTS)


NONE = dict.fromkeys(("camera", "rotation", "crop_place", "source_rotation", "keypoints"))
POSE = {"rvec": torch.zeros(3), "tvec": torch.tensor([0.0, 0.0, 600.0])}
MOUNT = RandomMount(yaw=(5, 5), pitch=None, roll=None)


@pytest.mark.parametrize("transform", [HorizontalFlip(p=1.0), MOUNT, FaceNormalizer(image_size=SIZE)])
@pytest.mark.parametrize("form", ["single", "clips", "arrays"])
def test_none_stands_for_a_field_that_is_not_given(camera, transform, form):
    image = torch.rand(3, *SIZE)
    image = {"single": image, "clips": image.expand(1, 2, -1, -1, -1), "arrays": image.movedim(0, -1).numpy()}[form]
    fields = {"image": image}
    if isinstance(transform, FaceNormalizer):
        if form == "clips":
            pytest.skip("faces of frames are normalised one by one")
        fields |= {name: value.numpy() if form == "arrays" else value for name, value in POSE.items()}
    if not isinstance(transform, HorizontalFlip):
        transform.camera = camera
    move = ct.augment.numpy.Transform(transform) if form == "arrays" else transform
    out, want = move(fields), move({**fields, **NONE})
    known = {name: value for name, value in want.items() if value is not None}
    assert known.keys() == out.keys()
    back = move.inverse(want)
    assert np.array_equal(back["image"], move.inverse(out)["image"])
    assert all(np.array_equal(known[name], value) for name, value in out.items() if "camera" not in name)


def test_a_face_needs_more_than_none_to_go_back(camera):
    with pytest.raises(ValueError, match="must have camera, rotation; got none"):
        FaceNormalizer().inverse(gaze=torch.rand(3), camera=None, rotation=None, source_camera=camera)
