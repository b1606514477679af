"""Bad input is refused where it is passed: the message names the argument and shows what was passed."""

import math
import re
from collections import UserList

import numpy as np
import pytest
import torch
from cameras import every_model, make, spread

import camtorch as ct
from camtorch.networks.parametrize import PositiveFocal

INTRINSICS = [300.0, 310.0, 320.0, 240.0]
SIZE, K, EYE = (480, 640), np.array([[300.0, 0.0, 320.0], [0.0, 310.0, 240.0], [0.0, 0.0, 1.0]]), torch.eye(4)
CAMERA = ct.Pinhole(INTRINSICS, image_size=SIZE).requires_grad_(False)
LENS = ct.KannalaBrandt(INTRINSICS, [0.02, -0.01, 0.003, -0.001], image_size=SIZE).requires_grad_(False)
BARE, PAIR, MIXED = ct.Pinhole(INTRINSICS), CAMERA.expand(2), ct.Mixed([CAMERA, LENS])
GENERAL = ct.KannalaBrandt.from_general
POSE, FROM, TABLE = ct.Extrinsics, ct.Extrinsics.from_matrix, ct.Tabulated.from_table
R, RVEC, TVEC = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, 3.0])
OCAM, SS, CENTRE = ct.OCamCalib.from_ocamcalib, (-206.517, 0.0, 2.207161e-03), (241.8, 394.6)
NAN, A, REPROJECTION = math.nan, ct.augment, ct.losses.reprojection
SIZED = {"pixel_grid": (), "contains": ([0, 0],), "resize": (9, 9), "pad": (1, 1, 1, 1), "hflip": (), "vflip": ()}
FLIP, IMAGE, UV = A.HorizontalFlip(1.0, landmarks="coco17"), torch.rand(3, *SIZE), torch.rand(17, 2)


def leaf(*values):
    return torch.tensor(values, requires_grad=True)


def by_cde(kind, *cde):
    return kind.from_polynomial([320.0, 240.0], [300.0, 1.0, 2.0, 3.0], linear_cde=cde)


def grid(**options):
    return ct.Splined.with_grid(**{"columns": 8, "rows": 6, "fov_x": 120, **options})


def from_fov(fov, **options):
    return ct.Pinhole.from_fov(fov, **({"image_size": SIZE} | options))


def from_changed(row, column, value):
    matrix = K.copy()
    matrix[row, column] = value
    return ct.KannalaBrandt.from_matrix(matrix)


def of_size(size):
    return ct.KannalaBrandt(INTRINSICS, image_size=size)


def parametrized():
    camera = LENS.clone()
    torch.nn.utils.parametrize.register_parametrization(camera, "intrinsics", PositiveFocal())
    return camera


WRONG = [
    # intrinsics
    (lambda: ct.Fisheye624([300.0, 320.0, 240.0]), ValueError, r"^Fisheye624: intrinsics .*\(3,\)"),
    (lambda: ct.Fisheye624(np.eye(3)), ValueError, r"^Fisheye624: intrinsics .*\(3, 3\).*from_matrix"),
    (lambda: ct.Pinhole([0.0, 300.0, 320.0, 240.0]), ValueError, r"^Pinhole: focal lengths .*0\.0"),
    (lambda: ct.Pinhole([INTRINSICS, [300.0, -1.0, 320.0, 240.0]]), ValueError, r"^Pinhole: focal lengths .*-1\.0"),
    (lambda: ct.Pinhole(leaf(NAN, 300.0, 320.0, 240.0)), ValueError, r"^Pinhole: intrinsics .*nan"),
    (lambda: ct.Pinhole(leaf(-300.0, 300.0, 320.0, 240.0)), ValueError, r"^Pinhole: focal lengths .*-300\.0"),
    (lambda: ct.Fisheye624("300 300 320 240"), TypeError, r"^Fisheye624: intrinsics .*str"),
    (lambda: ct.Fisheye624(torch.ones(4, dtype=torch.complex64)), TypeError, r"intrinsics .*complex64"),
    (lambda: ct.Pinhole(np.array(INTRINSICS)[:, None]), ValueError, r"intrinsics\[\.\.\., 0\]"),
    # matrices
    (lambda: from_changed(0, 1, 0.25), ValueError, r"KannalaBrandt.*skew.*0\.25.*ignore_skew"),
    (lambda: from_changed(2, 2, 2.0), ValueError, r"KannalaBrandt.*K.*2\.0"),
    (lambda: from_changed(2, 0, 0.5), ValueError, r"KannalaBrandt.*K.*0\.5"),
    (lambda: from_changed(1, 0, 0.75), ValueError, r"KannalaBrandt.*K.*0\.75"),
    (lambda: from_changed(0, 0, -300.0), ValueError, r"KannalaBrandt.*focal.*-300\.0"),
    (lambda: ct.Pinhole.from_matrix("K"), TypeError, "K"),
    # sizes
    (lambda: of_size((480.5, 640)), TypeError, r"image_size .*height.*\(480\.5, 640\)"),
    (lambda: of_size((0, 640)), ValueError, r"image_size .*height.*\(0, 640\)"),
    (lambda: CAMERA.resize(0, 10), ValueError, r"^Pinhole.*\(0, 10\)"),
    (lambda: CAMERA.resize(10.5, 10), TypeError, r"^Pinhole.*\(10\.5, 10\)"),
    (lambda: CAMERA.crop(0, 0, 0, 10), ValueError, r"^Pinhole.*\(0, 10\)"),
    (lambda: CAMERA.pad(-700, 0, 0, 0), ValueError, r"^Pinhole.*\(480, -60\)"),
    *(
        (lambda name=name, given=given: getattr(BARE, name)(*given), ValueError, f"^Pinhole.*image_size.*{name}")
        for name, given in SIZED.items()
    ),
    (lambda: BARE.width, ValueError, r"^Pinhole: image_size must be .* for width"),
    (lambda: BARE.fov, ValueError, "image"),
    (lambda: CAMERA.rays(stride=14), ValueError, r"got 14\. .* \.crop if .*, \.pad"),
    (lambda: CAMERA.rays(0), ValueError, "at least 1"),
    # other numbers of models
    (lambda: GENERAL(INTRINSICS, [0.0, 0.1]), ValueError, r"^KannalaBrandt.*coefficient.*0\.0"),
    (lambda: GENERAL(INTRINSICS, [1.0, NAN]), ValueError, "^KannalaBrandt.*coefficients.*nan"),
    (lambda: GENERAL(INTRINSICS, []), ValueError, r"^KannalaBrandt.*coefficients.*\(0,\)"),
    (lambda: GENERAL(INTRINSICS, "1 2"), TypeError, "^KannalaBrandt.*coefficients.*str"),
    (lambda: GENERAL([1.0, 2.0, 3.0], [1.0, 0.1]), ValueError, r"intrinsics.*\(3,\)"),
    (lambda: ct.Pinhole.from_matrix(K, np.zeros((1, 5))), ValueError, r"must be left out.*\(1, 5\).*BrownConrady"),
    (lambda: ct.KannalaBrandt(INTRINSICS, np.zeros((4, 1, 1))), ValueError, "coefficients of one lens"),
    (lambda: ct.FTheta.from_polynomial([1.0], [1.0, 2]), ValueError, "centre"),
    (lambda: ct.FTheta.from_polynomial([1.0, 2], [1.0]), ValueError, "n >= 2"),
    (lambda: ct.FTheta.from_polynomial([1.0, 2], [-1.0, 2]), ValueError, "must be positive"),
    (lambda: by_cde(ct.FTheta, 1.0, 0.0), ValueError, r"linear_cde must be \(\*B, 3\)"),
    (lambda: by_cde(ct.FTheta, 0.0, 0.0, 0.0), ValueError, "c > 0.*zeros mean 1, 0, 0"),
    (lambda: by_cde(ct.FTheta, 1.0, 2.0, 0.6), ValueError, "c > d e"),
    (lambda: by_cde(ct.FTheta, 1.0, NAN, 0.0), ValueError, "linear_cde must be finite"),
    (lambda: by_cde(ct.WoodScape, 1.0, 0.1, 0.0), ValueError, "WoodScape: d and e must be 0"),
    (lambda: TABLE([1.0, 2.0], [0, 0.1, 0.2], [0.1, 1, 2]), ValueError, "two nodes"),
    (lambda: TABLE([1.0, 2.0], [0.1, 0.2], [1.0]), ValueError, "shapes"),
    (lambda: TABLE([1.0, 2.0], [10.0, 90.0], [1.0, 2.0]), ValueError, r"at most pi radians; got 90\.0. Use rad"),
    (lambda: ct.Tabulated(INTRINSICS, [0.3, 0.2, 1.0, 2.0]), ValueError, "ascend"),
    (lambda: OCAM([0.0, 0, 1e-3], CENTRE), ValueError, "must not be zero"),
    (lambda: OCAM([-200.0], CENTRE), ValueError, r"polynomial must be \(n,\), n >= 2"),
    (lambda: OCAM(SS, (1.0, 2, 3)), ValueError, r"centre \(2,\)"),
    (lambda: OCAM(SS, CENTRE, (-1.0, 0, 0)), ValueError, r"c must be positive; got .* c = -1\.0"),
    (lambda: grid(order=4), ValueError, "order must be 2 or 3; got 4"),
    (lambda: grid(columns=3), ValueError, "columns must be from 4"),
    (lambda: grid(rows=1000), ValueError, "to 999"),
    (lambda: grid(fov_x=360), ValueError, "from 1 to 359; got 360"),
    (lambda: ct.Splined.with_grid(16, 11, 120), TypeError, r"given\. Call .*columns=16, rows=11, fov_x=120"),
    (lambda: grid(fov_x=170.5), TypeError, "fov_x must be a whole number; got 170.5"),
    (lambda: CAMERA.convert("splined:16x11"), ValueError, "a grid must be written as"),
    # fields of view
    (lambda: from_fov(0), ValueError, r"^Pinhole\.from_fov: .*above 0"),
    (lambda: from_fov(180), ValueError, r"horizontal fov must .* got 180.*179\.9"),
    (lambda: from_fov(60, axis="x"), ValueError, "axis must be one of .*'x'"),
    (lambda: from_fov(60, image_size=None), ValueError, r"^Pinhole\.from_fov: .*image_size"),
    (lambda: from_fov(NAN), ValueError, r"^Pinhole\.from_fov: .*finite"),
    # parts, values, polylines
    (lambda: CAMERA[0], TypeError, "Pinhole: it must have batch dims"),
    (lambda: len(CAMERA), TypeError, "Pinhole: it must have batch dims"),
    (lambda: PAIR[3], IndexError, r"within a batch \(2,\); got 3"),
    (lambda: PAIR[::-1], TypeError, r"got slice\(None, None, -1\)\. Slices go forwards"),
    (lambda: MIXED[::-1], TypeError, r"got slice\(None, None, -1\)\. Slices go forwards"),
    (lambda: LENS.replace(intrinsics=[1.0, 2.0]), ValueError, r"KannalaBrandt: intrinsics must be \(\*B, 4\)"),
    (lambda: LENS.replace(distortion=[[]]), ValueError, r"distortion must be \(\*B, n\)"),
    (lambda: LENS.replace(image_size=(0, 3)), ValueError, r"image_size must be positive .*\(0, 3\)"),
    (lambda: PAIR.expand(3), ValueError, r"fit dims \(2,\); got \(3,\)"),
    (lambda: ct.cat([]), ValueError, "cat: .*; got an empty list"),
    (lambda: torch.stack([LENS, LENS], 1), ValueError, "cameras must be joined along dim 0, without out; got 1"),
    (lambda: torch.stack([LENS.expand(2)]), ValueError, r"stack: cameras\[0\] must be single; .*torch.cat joins"),
    (lambda: torch.sum(LENS), TypeError, "must be torch.stack or torch.cat; got sum. Pass a tensor, like camera.in"),
    (lambda: ct.cat(LENS, LENS), TypeError, r"cat: cameras must be one list, as in cat\(\[a, b\]\)"),
    (lambda: ct.cat([LENS, 3]), TypeError, r"cat: cameras\[1\] must be a Camera; got int"),
    (lambda: ct.cat([LENS, LENS.crop(0, 0, 5, 5)]), ValueError, r"cat: .* one size; got \(480, 640\), \(5, 5\)"),
    (lambda: ct.cat([LENS.expand(2, 2)]), ValueError, r"cat: cameras\[0\] must be .* got batch dims \(2, 2\)"),
    (lambda: CAMERA.project_polyline([[0.0, 0, 1]]), ValueError, "two or more"),
    (lambda: CAMERA.project_polyline([[0.0, 1], [1, 1]]), ValueError, "3"),
    (lambda: CAMERA.project_polyline([[0.0, 0, 1], [NAN, 0, 1]]), ValueError, "finite"),
    (lambda: PAIR.project_polyline([[0.0, 0, 1], [1, 0, 1]]), ValueError, "must be single; got batch dims"),
    (lambda: CAMERA.freeze("k1"), ValueError, "names must be among fx, fy, cx, cy; got 'k1'"),
    (lambda: MIXED.freeze("k1"), TypeError, "Mixed"),
    (lambda: parametrized().freeze("fx"), TypeError, "parametrized"),
    # several models
    (lambda: ct.Mixed([]), ValueError, "empty list"),
    (lambda: ct.Mixed(3), TypeError, "list of cameras; got int"),
    (lambda: ct.Mixed([CAMERA, 3]), TypeError, r"cameras\[1\] must be a Camera; got int"),
    (lambda: ct.Mixed({"left": CAMERA}), TypeError, "values"),
    (lambda: ct.Mixed([CAMERA, LENS.resize(10, 20)]), ValueError, r"one size; got \(480, 640\), \(10, 20\)"),
    (lambda: ct.Mixed([CAMERA.expand(2, 3)]), ValueError, r"batch dims \(2, 3\)"),
    (lambda: ct.Mixed([PAIR], order=[0, 2]), ValueError, "order must be places among 2"),
    (lambda: ct.Mixed.of_groups([([0, 2], PAIR)]), ValueError, "every row once"),
    *((lambda index=index: MIXED[index], IndexError, "Mixed") for index in (2, -3, [7], torch.zeros(1, 2).long(), [])),
    (lambda: MIXED.distortion, TypeError, r"camera\[i\]\.distortion"),
    (lambda: MIXED.replace(distortion=[0.0]), TypeError, "one model to have a distortion"),
    (lambda: MIXED.replace(image_size="a"), TypeError, "Mixed: image_size must be two integers"),
    (lambda: MIXED.convert("fisheye624"), TypeError, r"by_groups\(lambda group: group.convert"),
    (lambda: ct.Mixed.from_matrix(torch.eye(3)), TypeError, r"ct.Mixed\(\[...\]\)"),
    (lambda: ct.Mixed.from_fov(60, image_size=SIZE), TypeError, r"ct.Mixed\(\[...\]\)"),
    (lambda: ct.save(MIXED, "mixed.json"), TypeError, "must be of one model; got a Mixed"),
    (lambda: MIXED.project(torch.rand(3, 5, 3)), ValueError, r"points must be .* with batch dims \*B = \(2,\)"),
    (
        lambda: ct.solve_pnp(MIXED, torch.rand(12, 3), torch.rand(2, 12, 2)),
        TypeError,
        "one model; got a Mixed. Call it",
    ),
    (lambda: MIXED.plucker(POSE(torch.rand(3, 3), torch.rand(3, 3))), ValueError, "of extrinsics must broadcast"),
    (lambda: CAMERA.plucker(EYE), TypeError, r"Extrinsics.from_matrix\(T\)"),
    (lambda: MIXED.perspective_field((0, 0, 0)), ValueError, "gravity must have a direction"),
    # poses
    (lambda: POSE([0.0, 0.0, 0.0], [0.0, NAN, 0.0]), ValueError, "translation .*finite"),
    (lambda: POSE(torch.zeros(2, 3), torch.zeros(3, 3)), ValueError, "dims must fit"),
    (lambda: FROM(EYE[:3, :3]), ValueError, r"\(3, 3\).*from_matrix\(R, t\)"),
    (lambda: FROM(2 * EYE), ValueError, "last row"),
    (lambda: FROM(torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]))), ValueError, "rotation matrices"),
    (lambda: FROM(torch.full((4, 4), NAN)), ValueError, "matri"),
    (lambda: POSE(RVEC, TVEC)(torch.zeros(4, 2)), ValueError, r"points_world .*\(4, 2\)"),
    (lambda: POSE(R, np.zeros((3, 3))), ValueError, r"from_matrix\(rotation, tr.*rotation\[\.\.\., None\]"),
    (lambda: POSE(np.ones((3, 3)), TVEC), ValueError, r"rotation matrices.*rotation\[\.\.\., None\]"),
    (lambda: FROM(RVEC, TVEC), ValueError, r"\(3,\).*Extrinsics\(rotation, translation\)"),
    (lambda: POSE(RVEC, np.zeros((4, 1))), ValueError, r"translation .*\(4, 1\)"),
    (lambda: POSE(torch.nn.Parameter(torch.zeros(3, 1)), TVEC), ValueError, r"Parameter rotation .*\(3, 1\)"),
    (lambda: POSE([0, 90, 0], TVEC), ValueError, "rotation must be.*radians; got an angle of .* seems to be degrees"),
    (lambda: ct.Warp(CAMERA, CAMERA, RVEC), ValueError, r"rotation must be .*Extrinsics\(vector.*\.detach\(\)"),
    (lambda: ct.head_angles(EYE[:2, :2]), ValueError, r"^head_angles: .*\(\.\.\., 3, 3\); got shape \(2, 2\)"),
    (lambda: ct.head_angles(np.diag([1.0, 1, -1])), ValueError, "^head_angles: .*must hold rotation matrices"),
    (lambda: ct.head_angles(np.full((3, 3), NAN)), ValueError, "^head_angles: .*pose"),
    (lambda: ct.head_angles("left"), TypeError, "^head_angles: pose must be numbers"),
    (lambda: ct.head_angles(RVEC), ValueError, r"^head_angles: .*ct\.Extrinsics\(rvec, \(0, 0, 0\)\)"),
    (lambda: ct.head_rotation([0.0, 1.0]), ValueError, r"head_rotation: angles must be \(..., 3\), pitch, yaw"),
    (lambda: ct.head_rotation([-30.0, 20.0, 5.0]), ValueError, "must be radians; got 30, which seems"),
    # what people try first of edits, losses and shutters
    (lambda: A.Resize([]), TypeError, r"size must be two integers \(height, width\)"),
    (lambda: A.Rotate90(90), ValueError, "quarter turns, one number or .*; got 90"),
    (lambda: A.RandomResizedCrop(32, scale=0.5), TypeError, "scale must be a range"),
    (lambda: ct.vignetting(MIXED, torch.ones(3)), ValueError, "one for each of 2 cameras"),
    (lambda: REPROJECTION(LENS, UV, torch.rand(9, 3)), ValueError, r"of target and .* must broadcast; got \(17, 2\)"),
    (lambda: FLIP(image=IMAGE, keypoints=torch.rand(17, 3)), ValueError, r"\[..., 2\], as keypoints_valid"),
]


@pytest.mark.parametrize(("call", "error", "says"), WRONG, ids=[says[:40] for _, _, says in WRONG])
def test_wrong_calls_are_told_in_words(call, error, says):
    with pytest.raises(error, match=f"(?s){says}"):
        call()


def refuses(error, *words):
    """The error, and a message in which all the words appear in this order."""
    return pytest.raises(error, match=re.compile(".*".join(re.escape(word) for word in words), re.DOTALL))


@every_model
def test_coefficients(key):
    model = ct.MODELS[key]
    if not model.distortion_names:
        with pytest.raises((TypeError, ValueError)):
            model(INTRINSICS, [0.01, 0.02, 0.03, 0.04])
        return
    refused = [n for n in range(20) if model.names_of(n) is None]
    assert refused
    for n in refused:
        # it says what the model takes, by name
        with refuses(ValueError, model.__name__, "distortion", model.distortion_names[0], f"({n},)"):
            model(INTRINSICS, [0.01] * n)
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


@pytest.mark.parametrize("size", [(np.int64(480), np.int32(640)), [480, 640], torch.Size([480, 640])])
def test_image_sizes_that_are_integers_are_taken(size):
    assert ct.Pinhole(INTRINSICS, image_size=size).image_size == (480, 640)


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
    with pytest.warns(UserWarning, match=r"image_size=\(640, 480\) is taken as \(height, width\).*camera.crop"):
        ct.Pinhole(as_passed(good), image_size=SWAPPED)
    with pytest.warns(UserWarning, match=r"fx, cx, fy, cy\. Pass both focal lengths first"):
        ct.KannalaBrandt(as_passed([500.0, 315.0, 501.0, 243.0]), image_size=WIDE)
    with pytest.warns(UserWarning, match=r"seem to be parts of the image's width and height\. Multiply fx and cx by"):
        ct.Pinhole(as_passed([0.78, 1.04, 0.5, 0.52]), image_size=WIDE)
    ct.Pinhole(as_passed([1.0, 1.0, 0.5, 0.5]), image_size=(4, 4))


@as_passed
def test_numbers_of_images_of_another_size_are_told_with_it(as_passed):
    for numbers, size, about in (
        ([900.0, 900.0, 640.0, 360.0], WIDE, (720, 1280)),
        ([905.0, 903.0, 655.0, 348.0], (360, 640), (720, 1280)),
        ([900.0, 900.0, 359.5, 639.5], (1920, 1080), (1280, 720)),
        ([500.0, 500.0, 103.0, 120.0], WIDE, (240, 208)),
    ):
        way = re.escape(f"(height, width) = {about}. Pass image_size={about}, then scale that camera by .resize{size}.")
        with pytest.warns(UserWarning, match=f"BrownConrady: .*seem to be of images of about {way}"):
            ct.BrownConrady(as_passed(numbers), image_size=size)
    for numbers in ([900.0, 900.0, 640.0, 300.0], [900.0, 900.0, 400.0, 310.0], [1.0, 1.0, 0.0, 0.0]):
        ct.BrownConrady(as_passed(numbers), image_size=WIDE)


def test_a_matrix_and_a_file_without_a_size_are_told_if_one_does_not_fit(tmp_path):
    K, crop = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]), [500.0, 500.0, 600.0, 470.0]  # noqa: N806
    np.savez(tmp_path / "K.npz", K=K)
    for call in (
        lambda: ct.KannalaBrandt.from_matrix(K, np.zeros((4, 1)), image_size=WIDE),
        lambda: ct.Pinhole.from_matrix(torch.tensor(K), image_size=WIDE),
        lambda: ct.load(tmp_path / "K.npz").camera.replace(image_size=WIDE),
        lambda: ct.loads({"K": K, "image_size": [640, 480]}),
    ):
        with pytest.warns(UserWarning, match="then scale that camera by"):
            call()
    ct.Pinhole([[900.0, 900.0, 640.0, 360.0], [900.0, 900.0, 330.0, 250.0]], image_size=WIDE)  # of which one fits
    made = ct.Pinhole(torch.nn.Parameter(torch.tensor(crop)), image_size=WIDE).requires_grad_(False)
    ct.Camera.from_dict(made.replace([*crop[:2], 601.0, 471.0]).to_dict())
    ct.data.from_columns(ct.data.to_columns(made))


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


STEREO = LENS, LENS, ct.Extrinsics([0.0] * 3, [-0.1, 0.0, 0.0])
IN_DEGREES = {
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


@pytest.mark.parametrize("door", IN_DEGREES)
def test_a_field_of_view_is_in_degrees_at_every_door(door):
    for radians in (1, 2.1, 2 * math.pi):
        with pytest.raises(ValueError, match=f"must be in degrees; .*radians.* {math.degrees(radians):.4g} degrees"):
            IN_DEGREES[door](radians)
    IN_DEGREES[door](6.5 if "Camera" not in door else 60)
