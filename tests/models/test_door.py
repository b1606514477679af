"""Bad input is refused at the door: the message names the argument and shows what was passed."""

import re
from collections import UserList

import numpy as np
import pytest
import torch
from cameras import KEYS, every_model, make, spread

import camtorch as ct

INTRINSICS = [300.0, 310.0, 320.0, 240.0]


def refuses(error, *words):
    """The error, and a message in which all the words appear in this order."""
    return pytest.raises(error, match=re.compile(".*".join(re.escape(word) for word in words), re.DOTALL))


@pytest.mark.parametrize("key", ["pinhole", "fisheye624"])
@pytest.mark.parametrize(
    ("intrinsics", "error", "words"),
    [
        ([300.0, 320.0, 240.0], ValueError, ["(3,)"]),
        (np.eye(3), ValueError, ["(3, 3)", "from_matrix"]),
        (5.0, ValueError, ["()"]),
        ([0.0, 300.0, 320.0, 240.0], ValueError, ["0.0"]),
        ([300.0, -310.0, 320.0, 240.0], ValueError, ["-310.0"]),
        ([[300.0, 310.0, 320.0, 240.0], [300.0, -1.0, 320.0, 240.0]], ValueError, ["-1.0"]),
        ([float("nan"), 300.0, 320.0, 240.0], ValueError, ["nan"]),
        ([300.0, 300.0, float("inf"), 240.0], ValueError, ["inf"]),
        (torch.tensor([float("nan"), 300.0, 320.0, 240.0], requires_grad=True), ValueError, ["nan"]),
        (torch.tensor([-300.0, 300.0, 320.0, 240.0], requires_grad=True), ValueError, ["-300.0"]),
        ("300 300 320 240", TypeError, ["str"]),
        (None, TypeError, ["NoneType"]),
        ({"fx": 300}, TypeError, ["dict"]),
        (torch.ones(4, dtype=torch.complex64), TypeError, ["complex64"]),
        (torch.ones(4, dtype=torch.bool), TypeError, ["bool"]),
    ],
)
def test_intrinsics(key, intrinsics, error, words):
    name = ct.MODELS[key].__name__
    with pytest.raises(error) as caught:
        ct.MODELS[key](intrinsics)
    message = str(caught.value)
    assert message.startswith(name)
    assert "intrinsics" in message or "focal lengths" in message
    for word in words:
        assert word in message


DISTORTED = [key for key in KEYS if ct.MODELS[key].distortion_names]
with_distortion = pytest.mark.parametrize("key", DISTORTED)


@with_distortion
def test_number_of_coefficients(key):
    model = ct.MODELS[key]
    refused = [n for n in range(20) if model.names_of(n) is None]
    assert refused
    for n in refused:
        # it says what the model takes, by name
        with refuses(ValueError, model.__name__, "distortion", model.distortion_names[0], f"({n},)"):
            model(INTRINSICS, [0.01] * n)


@pytest.mark.parametrize("key", [key for key in KEYS if key not in DISTORTED])
def test_coefficients_for_a_model_that_takes_none(key):
    with pytest.raises((TypeError, ValueError)):
        ct.MODELS[key](INTRINSICS, [0.01, 0.02, 0.03, 0.04])


@with_distortion
def test_values_of_coefficients(key):
    model = ct.MODELS[key]
    good = [0.01] * model.default_count
    for value in (float("nan"), float("inf")):
        with refuses(ValueError, model.__name__, "distortion", str(value)):
            model(INTRINSICS, [*good[1:], value])
    with refuses(TypeError, model.__name__, "distortion", "str"):
        model(INTRINSICS, "0.1 0.2")
    with refuses(ValueError, model.__name__, "distortion", "()"):
        model(INTRINSICS, 0.1)
    with refuses(ValueError, model.__name__, "intrinsics (2, 4)", f"distortion (3, {len(good)})"):
        model(torch.tensor([INTRINSICS] * 2), torch.tensor([good] * 3))


@pytest.mark.parametrize(
    ("image_size", "error"),
    [
        (640, TypeError),
        ("480x640", TypeError),
        ((480.5, 640), TypeError),
        (("480", "640"), TypeError),
        ((None, 640), TypeError),
        ((480,), TypeError),
        ((480, 640, 3), TypeError),
        ((0, 640), ValueError),
        ((480, -640), ValueError),
    ],
)
def test_image_size(image_size, error):
    with pytest.raises(error) as caught:
        ct.KannalaBrandt(INTRINSICS, image_size=image_size)
    message = str(caught.value)
    assert "KannalaBrandt" in message
    assert "image_size" in message
    assert "height" in message
    assert str(image_size) in message


@pytest.mark.parametrize("size", [(np.int64(480), np.int32(640)), [480, 640], torch.Size([480, 640])])
def test_image_sizes_that_are_integers_are_taken(size):
    assert ct.Pinhole(INTRINSICS, image_size=size).image_size == (480, 640)


@every_model
@pytest.mark.parametrize(("method", "argument", "columns"), [("project", "points", 3), ("unproject", "pixels", 2)])
def test_values(key, method, argument, columns):
    camera = spread(key)
    name = type(camera).__name__

    def refused(error, values, *words, of=camera):
        with refuses(error, name, argument, *words):
            getattr(of, method)(values)

    for wrong in (torch.ones(7, 5 - columns), torch.ones(columns, 4), torch.tensor(1.0), torch.ones(5, 0)):
        refused(ValueError, wrong, str(tuple(wrong.shape)))
    refused(TypeError, torch.ones(7, columns, dtype=torch.complex64), "complex64")
    refused(TypeError, torch.ones(7, columns, dtype=torch.bool), "bool")
    refused(TypeError, "nothing to see", "str")
    refused(TypeError, None, "NoneType")

    batched = make(key, camera.intrinsics.detach().expand(3, 4), camera.distortion.detach())
    for wrong in (torch.ones(2, 7, columns), torch.ones(columns)):
        refused(ValueError, wrong, "(3,)", str(tuple(wrong.shape)), of=batched)
    deep = make(key, camera.intrinsics.detach().expand(2, 3, 4), camera.distortion.detach())
    for wrong in (torch.ones(3, 7, columns), torch.ones(7, columns), torch.ones(3, 2, columns)):
        refused(ValueError, wrong, "(2, 3)", str(tuple(wrong.shape)), of=deep)


@pytest.mark.parametrize(
    ("what", "call"),
    [
        ("pixel_grid", lambda c: c.pixel_grid()),
        ("pixel_grid", lambda c: c.rays()),
        ("contains", lambda c: c.contains(torch.zeros(2))),
        ("resize", lambda c: c.resize(10, 10)),
        ("pad", lambda c: c.pad(1, 1, 1, 1)),
        ("hflip", lambda c: c.hflip()),
        ("vflip", lambda c: c.vflip()),
    ],
)
def test_a_camera_without_image_size_where_one_is_needed(what, call):
    with refuses(ValueError, "Pinhole", what, "image_size"):
        call(ct.Pinhole(INTRINSICS))


@pytest.mark.parametrize(
    ("call", "error", "shown"),
    [
        (lambda c: c.resize(0, 10), ValueError, "(0, 10)"),
        (lambda c: c.resize(10, -1), ValueError, "(10, -1)"),
        (lambda c: c.resize(10.5, 10), TypeError, "(10.5, 10)"),
        (lambda c: c.crop(0, 0, 0, 10), ValueError, "(0, 10)"),
        (lambda c: c.crop(0, 0, 10.5, 10), TypeError, "(10.5, 10)"),
        (lambda c: c.pad(-700, 0, 0, 0), ValueError, "(480, -60)"),
    ],
)
def test_sizes_of_edited_images(call, error, shown):
    with refuses(error, "Pinhole", shown):
        call(ct.Pinhole(INTRINSICS, image_size=(480, 640)))


@every_model
def test_matrix(key):
    model = ct.MODELS[key]
    K = torch.tensor([[300.0, 0, 320], [0, 310, 240], [0, 0, 1]])  # noqa: N806

    def changed(row, column, value):
        wrong = K.clone()
        wrong[row, column] = value
        return wrong

    with refuses(ValueError, model.__name__, "skew", "0.25", "ignore_skew"):
        model.from_matrix(changed(0, 1, 0.25))
    with refuses(ValueError, model.__name__, "K", "(2, 3)"):
        model.from_matrix(K[:2])
    for row, column, value in ((2, 2, 2.0), (2, 0, 0.5), (1, 0, 0.75)):
        with refuses(ValueError, model.__name__, "K", str(value)):
            model.from_matrix(changed(row, column, value))
    with refuses(ValueError, model.__name__, "focal", "-300.0"):
        model.from_matrix(changed(0, 0, -300.0))
    for wrong in ("K", None):
        with pytest.raises(TypeError, match="K"):
            model.from_matrix(wrong)


def test_general_kannala_brandt():
    make_general = ct.KannalaBrandt.from_general
    with refuses(ValueError, "KannalaBrandt", "coefficient", "-1.0"):
        make_general(INTRINSICS, [-1.0, 0.1])
    with refuses(ValueError, "KannalaBrandt", "coefficient", "0.0"):
        make_general(INTRINSICS, [0.0, 0.1])
    with refuses(ValueError, "KannalaBrandt", "coefficients", "nan"):
        make_general(INTRINSICS, [1.0, float("nan")])
    with refuses(ValueError, "KannalaBrandt", "coefficients", "(0,)"):
        make_general(INTRINSICS, [])
    with refuses(TypeError, "KannalaBrandt", "coefficients", "str"):
        make_general(INTRINSICS, "1 2")
    with refuses(ValueError, "intrinsics", "(3,)"):
        make_general([1.0, 2.0, 3.0], [1.0, 0.1])


# -- what is not refused


@pytest.mark.parametrize("yes", [1, np.bool_(True), np.int64(1), np.array(True), torch.tensor(True), torch.tensor(1)])
def test_flags_may_be_those_of_numpy_and_torch(yes):
    assert ct.augment.HorizontalFlip(same_on_batch=yes).same_on_batch is True
    assert ct.augment.HorizontalFlip(same_on_batch=yes ^ yes).same_on_batch is False


@pytest.mark.parametrize("no", ["False", 2, 1.0, None, torch.tensor([True])])
def test_what_is_no_flag(no):
    with refuses(TypeError, "same_on_batch must be True or False"):
        ct.augment.HorizontalFlip(same_on_batch=no)


@pytest.mark.parametrize("count", [5, 8, 12, 14])
@pytest.mark.parametrize("model", [ct.KannalaBrandt, ct.Equisolid])
def test_a_fisheye_takes_no_coefficients_of_calibrate_camera_beside_a_matrix(model, count):
    for D in (np.zeros((1, count)), np.zeros(count), np.zeros((2, 1, count))):  # noqa: N806
        K = np.eye(3) if D.ndim < 3 else np.stack([np.eye(3)] * 2)  # noqa: N806
        with refuses(ValueError, f"{count} coefficients", "calibrateCamera", "BrownConrady"):
            model.from_matrix(K, D)
        assert ct.BrownConrady.from_matrix(K, D).distortion.shape[-1] == count
    assert model(np.ones(4), np.zeros(count)).distortion.shape == (count,)
    assert model.from_matrix(np.eye(3), np.zeros(6)).distortion.shape == (6,)


WIDE, SWAPPED = (480, 640), (640, 480)
as_passed = pytest.mark.parametrize("as_passed", [list, np.array, torch.tensor, lambda v: torch.tensor([v, v])])


@as_passed
def test_a_size_and_numbers_in_another_order_are_told(as_passed):
    good = [500.0, 501.0, 315.0, 243.0]
    ct.Pinhole(as_passed(good), image_size=WIDE)
    with pytest.warns(UserWarning, match=r"image_size=\(640, 480\) is \(height, width\).*camera.crop"):
        ct.Pinhole(as_passed(good), image_size=SWAPPED)
    with pytest.warns(UserWarning, match=r"fx, cx, fy, cy; both focal lengths come first"):
        ct.KannalaBrandt(as_passed([500.0, 315.0, 501.0, 243.0]), image_size=WIDE)


def test_what_is_off_centre_for_a_reason_is_not_warned_of(tmp_path):
    camera = ct.Pinhole([500.0, 500.0, 319.5, 239.5], image_size=WIDE)
    portrait = camera.crop(0, 0, 640, 480)  # whose centre is where that of the whole image is
    ct.save(portrait, tmp_path / "camera.json")
    kept = [ct.load(tmp_path / "camera.json").camera, portrait.convert(ct.BrownConrady).camera, camera.rot90().rot90()]
    ct.save(portrait, tmp_path / "camera.yml", format="opencv")
    kept += [ct.load(tmp_path / "camera.yml").camera, portrait.hflip()]
    assert kept[0].image_size == (640, 480)
    ct.augment.RandomMount(yaw=(1, 1), camera=portrait)(image=torch.zeros(3, 640, 480))
    ct.Dewarp(portrait)
    for numbers in ([500.0, 501.0, 700.0, 239.5], [500.0, 250.0, 319.5, 239.5], [800.0, 400.0, 10.0, 479.0]):
        ct.Pinhole(numbers, image_size=WIDE)
    ct.Pinhole(torch.tensor([500.0, 500.0, 319.5, 239.5], requires_grad=True), image_size=SWAPPED)
    ct.Pinhole([500.0, 500.0, 255.0, 240.0], image_size=(512, 480))


class Options(UserList):
    """A list of files of options, which is none of Python's."""


def test_sequences_and_mappings_need_not_be_python_s():
    left, right = (ct.MODELS[key].from_fov(90, image_size=(12, 16)).requires_grad_(False) for key in ("pinhole", "ucm"))
    rig = ct.Rig(torch.nn.ModuleDict({"left": left, "right": right}))
    assert list(rig.cameras) == ["left", "right"]
    assert rig.cameras["right"] is right
    batch = ct.augment.collate(Options([{"image": torch.ones(3)}, {"image": torch.zeros(3)}]))
    assert batch["image"].tolist() == [[1.0] * 3, [0.0] * 3]
    with refuses(TypeError, "collate: samples must be a list"):
        ct.augment.collate("samples")
    moves = ct.data.MapBatches(ct.augment.RandomCamera("webcam", camera=left), key=Options(["path"]))
    image = np.zeros((1, *left.image_size, 3), np.uint8)
    assert moves({"image": image, "path": np.array(["a"])})["image"].shape == image.shape


def test_images_of_a_surround_may_be_stacked():
    camera = ct.Pinhole.from_fov(90, image_size=(12, 16)).requires_grad_(False)
    poses = [ct.Extrinsics.from_matrix(torch.eye(4)) for _ in range(2)]
    rig = ct.Rig({"a": camera, "b": camera}, dict(zip("ab", poses, strict=True)))
    surround = ct.surround(rig, ct.Pinhole.from_fov(60, image_size=(8, 8)))
    images = torch.rand(2, 1, 3, 12, 16)
    (stacked, _), (listed, _) = surround(images), surround(list(images))
    assert stacked.equal(listed)
    assert surround(Options(images))[0].equal(listed)
    with refuses(TypeError, "Surround: images must be tensors"):
        surround(images[:, 0])
