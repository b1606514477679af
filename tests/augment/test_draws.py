"""Cameras that native code makes of drawn numbers are those of the formulas that torch records, and known as well."""

import pytest
import torch
from cameras import DISTINCT, KEYS, needs_library, slow_unless, spread

import camtorch as ct
from camtorch.augment.drawer import CameraDrawer
from camtorch.augment.filling import scaled, zoom_to_fill
from camtorch.augment.native_draws import Start
from camtorch.evaluate.kept import Kept
from camtorch.projection import native_cameras
from camtorch.projection.evaluation import camera_rows

A = ct.augment
pytestmark = needs_library
AUGMENTATIONS = {
    "mount": lambda: A.RandomMount(zoom=0.2, fov=(40, 60)),
    "lens": lambda: A.RandomLens(),
    "bent": lambda: A.RandomLens(distortion=1.0, focal=None, centre=0.2),
    "camera": lambda: A.RandomCamera(crop=(0.5, 1), image_size=(90, 140)),
    "family": lambda: A.RandomCamera("kannala_brandt", fov=(50, 130), distortion=0.1),
    "source": lambda: A.RandomCamera("fisheye624", fov="source", yaw=None),
    "filled": lambda: A.RandomMount(yaw=40, min_filled=0.9),
    "filled lens": lambda: A.RandomLens(focal=(0.5, 0.8), distortion=0.1, min_filled=0.8),
    "turned back": lambda: A.RandomCamera("pinhole", fov=(60, 80), yaw=(120, 130), min_filled=0.5),
    "real": lambda: A.RandomLens("real", fov=(60, 120), centre=0.1, distortion=0.2),
}
# Both dtypes and both counts for each model and augmentation; which go together alternates, for a row of a batch is
# computed like a single camera, and in its dtype
CASES = [
    (key, name, dtype, (1, 4)[(i + j + k) % 2])
    for i, key in enumerate(KEYS)
    for j, name in enumerate(AUGMENTATIONS)
    for k, dtype in enumerate((torch.float32, torch.float64))
]
EACH_LENS = {"bent", "filled"}
# Models with inverted charts and stages, with parameters that are no coefficients, or with an end that is one
WITHOUT_NATIVE_LENSES = {"brown_conrady", "f_theta_backward_sheared", "ocamcalib", "tabulated", "thin_prism_fisheye"}


@pytest.mark.parametrize(
    ("key", "name", "dtype", "count"),
    slow_unless(lambda c: (c[1] in EACH_LENS and c[0] in DISTINCT) or c[0] in ("brown_conrady", "mei"), CASES),
)
def test_as_the_formula(key, name, dtype, count, recwarn, monkeypatch):
    source = spread(key, torch.float32).requires_grad_(False).resize(120, 160).to(dtype)
    augmentation = AUGMENTATIONS[name]()
    draw = augmentation.draw(count, torch.Generator().manual_seed(count))
    change = augmentation.change(source, draw)
    values = {name: value if count > 1 else value[0] for name, value in draw.items() if name != "apply"}
    expected, rotation = augmentation.new_camera(source, values)
    if augmentation.min_filled:
        factor, turned, _ = zoom_to_fill(source, expected, rotation, augmentation.min_filled)
        expected, rotation = scaled(expected, factor), None if rotation is None else turned
    found = change.target if count > 1 else change.target[0]
    assert type(found) is type(expected)
    assert found.image_size == expected.image_size
    exact = {"rtol": 1e-6, "atol": 1e-6} if dtype == torch.float32 else {"rtol": 1e-12, "atol": 1e-12}
    torch.testing.assert_close(found.intrinsics, expected.intrinsics, **exact)
    torch.testing.assert_close(found.distortion, expected.distortion.expand_as(found.distortion), **exact)
    if rotation is not None:
        torch.testing.assert_close(change.rotation, rotation.expand_as(change.rotation), **exact)
    pixels = found.pixel_grid(10).reshape(-1, 2).expand(*found.batch_shape, -1, 2)
    known = found.unproject(pixels)
    monkeypatch.setattr(native_cameras, "_lenses", Kept(1))  # without what the draw found of the lenses
    for one, other in zip(known, found.clone().unproject(pixels), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("key", KEYS)
def test_native_code_makes_most_lenses(key, monkeypatch):
    made, of = [], Start.of
    monkeypatch.setattr(Start, "of", lambda wanted: made.append(of(wanted)))
    source = spread(key, torch.float32).requires_grad_(False).resize(120, 160)
    augmentation = A.RandomLens(distortion=0.1)
    augmentation.change(source, augmentation.draw(1))
    has_code = camera_rows(source, *source.tensors).native is not None  # which a model of torch alone lacks
    assert (made == [None]) is (key in WITHOUT_NATIVE_LENSES or not has_code)


@pytest.mark.parametrize(("key", "focal", "given"), [("fov", 300.0, [3.0]), ("eucm", 60.0, [0.5, 0.05])])
def test_coefficients_without_a_formula_are_not_drawn(key, focal, given):
    source = ct.MODELS[key]([focal, focal, 79.5, 59.5], given, image_size=(120, 160)).requires_grad_(False)
    augmentation = A.RandomLens(distortion=1.0, focal=None, centre=None)
    draw = augmentation.draw(40, torch.Generator().manual_seed(0))
    for one in range(40):
        of_one = {name: value[one : one + 1] for name, value in draw.items()}
        expected, _ = augmentation.new_camera(source, {"distortion": of_one["distortion"]})
        found = augmentation.change(source, of_one).target
        torch.testing.assert_close(found.distortion, expected.distortion, rtol=1e-5, atol=1e-6)


def test_a_range_that_native_code_does_not_know_is_drawn(monkeypatch):
    formula = CameraDrawer.new_camera

    def larger(self, source, values):
        camera, rotation = formula(self, source, values)
        return scaled(camera, values["factor"]), rotation

    monkeypatch.setattr(CameraDrawer, "new_camera", larger)
    augmentation = A.RandomMount(yaw=None, pitch=None, roll=None)
    augmentation.ranges = {**augmentation.ranges, "factor": A.Range(2, 2)}
    lens = ct.Pinhole.from_fov(70, image_size=(48, 64)).requires_grad_(False)
    out = augmentation(image=torch.zeros(1, 48, 64), camera=lens)
    assert out["camera"].intrinsics[0] == 2 * lens.intrinsics[0]


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(("name", "size"), [("distortion", 16), ("centre", 2), ("yaw", None)])
def test_a_range_that_is_set_must_draw_as_many_numbers(name, size, count):
    camera = ct.BrownConrady([40.0, 40.0, 31.5, 23.5], [-0.1, 0.02, 0.0, 0.0], image_size=(48, 64)).requires_grad_(
        False
    )
    augment = ct.augment.RandomCamera(camera=camera)
    images = torch.zeros(count, 3, 48, 64)
    augment(image=images)
    augment.ranges[name] = ct.augment.Range(-0.02, 0.02, 3 if size is None else None)
    with pytest.raises(ValueError, match=r"Range\(low, high"):
        augment(image=images)
    augment.ranges[name] = ct.augment.Range(-0.02, 0.02, size)
    augment(image=images)
