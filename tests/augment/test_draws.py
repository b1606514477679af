"""Cameras that native code makes of drawn numbers are those of the formulas that torch records, and known as well."""

import pytest
import torch
from cameras import DISTINCT, KEYS, needs_library, slow_unless, spread

import camtorch as ct
from camtorch.augment.drawer import CameraDrawer
from camtorch.augment.filling import scaled, zoom_to_fill
from camtorch.evaluate.kept import Kept
from camtorch.projection import native_cameras

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
