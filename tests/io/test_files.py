"""Every format: what the files say, and that it comes back."""

import math
from pathlib import Path

import pytest
import torch
from rigs import MANIFEST, POINT, SAMPLES, SUFFIXES, assert_same, float64, load

import camtorch as ct


@pytest.mark.parametrize("name", SAMPLES)
def test_a_calibration_is_a_measurement(name):
    rig = load(name)
    for module in (*rig.cameras.values(), *rig.extrinsics.values()):
        assert all(not p.requires_grad and p.dtype == torch.float64 for p in module.parameters())
        assert not any(t.requires_grad for t in module.buffers())
    for camera in rig.cameras.values():
        pixels, _ = camera.project(float64(POINT))
        assert not pixels.requires_grad
        pixels, _ = camera.requires_grad_().project(float64(POINT))
        pixels.sum().backward()
        assert camera.intrinsics.grad is not None


@pytest.mark.parametrize("format", SUFFIXES)
@pytest.mark.parametrize("name", SAMPLES)
def test_what_was_loaded_is_written_as_any_format_that_holds_it(name, format, tmp_path):
    rig = load(name)
    path = tmp_path / (name if format == rig.format else f"cameras{SUFFIXES[format]}")
    try:
        ct.save(rig, path, format)
    except ct.CameraFileError as error:
        assert str(error).startswith(f"{path}: ")  # noqa: PT017 (which error is not the point: see the test below)
        assert not path.exists()
        return
    first = ct.load(path)
    assert first.format == format
    if format == rig.format:
        assert_same(first, rig)
    point = float64(POINT)
    for before, after in zip(rig.cameras.values(), first.cameras.values(), strict=True):
        assert torch.allclose(before.project(point)[0], after.project(point)[0], rtol=0, atol=1e-9)
    for before, after in zip(rig.extrinsics.values(), first.extrinsics.values(), strict=False):
        assert torch.allclose(before(point), after(point), rtol=0, atol=1e-14)
    ct.save(first, path, format)
    assert_same(first, ct.load(path))


# -- the values of the manifest


CASES = [
    (name, label, camera)
    for name, entry in MANIFEST.items()
    if "cameras" in entry["expected"]
    for label, camera in entry["expected"]["cameras"].items()
]


@pytest.mark.parametrize(("name", "label", "expected"), CASES)
def test_values_of_the_manifest(name, label, expected):
    """Intrinsics in the file's convention, and the size as width and height."""
    found, shift = load(name).cameras[label], MANIFEST[name]["pixel_centre"]
    fx, fy, cx, cy = expected["intrinsics"]
    assert found.key == expected["model"]
    assert found.intrinsics.tolist() == [fx, fy, cx - shift, cy - shift]
    assert found.distortion.tolist() == expected["distortion"]
    assert found.image_size == tuple(expected["image_size"][::-1])
    pixel = found.project(float64(POINT))[0] + shift
    reference = MANIFEST[name].get("check_pixel_of_point_0p1_m0p2_1", {}).get(label)
    reference = reference or pixel_of(expected["model"], expected["intrinsics"], expected["distortion"])
    assert torch.allclose(pixel, float64(reference), rtol=0, atol=1e-9)


def pixel_of(model, core, distortion):
    """The pixel of POINT by the formulas of OpenCV's documentation, in the convention of the file."""
    x, y, _ = POINT
    d = distortion + [0.0] * 12
    r2 = x * x + y * y
    if model == "kannala_brandt":
        r = math.sqrt(r2)
        theta = math.atan(r)
        scale = theta / r * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(distortion)))
        x, y = x * scale, y * scale
    elif model == "double_sphere":
        xi, alpha = distortion
        d1 = math.sqrt(r2 + 1)
        d2 = math.sqrt(r2 + (xi * d1 + 1) ** 2)
        scale = 1 / (alpha * d2 + (1 - alpha) * (xi * d1 + 1))
        x, y = x * scale, y * scale
    elif model == "woodscape":
        theta = math.atan(math.sqrt(r2))
        scale = (theta + sum(k * theta ** (i + 2) for i, k in enumerate(distortion))) / math.sqrt(r2)
        x, y = x * scale, y * scale
    elif model in ("brown_conrady", "mei"):
        if model == "mei":  # cv2.omnidir: onto a plane above the unit sphere first
            scale = 1 / (1 + d[0] * math.sqrt(r2 + 1))
            x, y, d = x * scale, y * scale, d[1:]
            r2 = x * x + y * y
        radial = 1 + d[0] * r2 + d[1] * r2**2 + d[4] * r2**3
        radial /= 1 + d[5] * r2 + d[6] * r2**2 + d[7] * r2**3
        tangential = 2 * d[2] * x * y + d[3] * (r2 + 2 * x * x), d[2] * (r2 + 2 * y * y) + 2 * d[3] * x * y
        x, y = x * radial + tangential[0], y * radial + tangential[1]
    return [core[0] * x + core[2], core[1] * y + core[3]]


COLMAP = {
    "SIMPLE_PINHOLE": ("pinhole", 1, 0),
    "PINHOLE": ("pinhole", 2, 0),
    "SIMPLE_RADIAL": ("brown_conrady", 1, 3),
    "RADIAL": ("brown_conrady", 1, 2),
    "OPENCV": ("brown_conrady", 2, 0),
    "FULL_OPENCV": ("brown_conrady", 2, 0),
    "OPENCV_FISHEYE": ("kannala_brandt", 2, 0),
    "FOV": ("fov", 2, 0),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("fisheye624", 2, 0),
    "EUCM": ("eucm", 2, 0),
    "SIMPLE_DIVISION": ("division", 1, 0),
}


@pytest.mark.parametrize("suffix", ["txt", "bin"])
@pytest.mark.parametrize("entry", MANIFEST["cameras.txt"]["expected"], ids=lambda entry: entry["model"])
def test_each_model_of_colmap(entry, suffix, tmp_path):
    path, name, values = tmp_path / f"cameras.{suffix}", entry["model"], entry["params"]
    (tmp_path / "one.txt").write_text(f"7 {name} {entry['width']} {entry['height']} {' '.join(map(repr, values))}\n")
    if name == "EQUIRECTANGULAR":
        expected = ct.Equirectangular(float64([1024 / math.pi, 1024 / math.pi, 1023.5, 511.5]), image_size=(1024, 2048))
    else:
        key, focals, zeros = COLMAP[name]
        core = float64([values[0], values[focals - 1], values[focals] - 0.5, values[focals + 1] - 0.5])
        rest = (float64(values[focals + 2 :] + [0.0] * zeros),) if len(values) > focals + 2 else ()
        expected = ct.MODELS[key](core, *rest, image_size=(entry["height"], entry["width"]))
    rig = ct.load(tmp_path / "one.txt")
    ct.save(rig, path)
    assert_same(rig, ct.Rig({"7": expected}))
    assert_same(ct.load(path), rig)
    if expected.key in ("pinhole", "brown_conrady", "kannala_brandt"):
        found = expected.project(float64(POINT))[0] + 0.5
        theirs = (expected.intrinsics + float64([0, 0, 0.5, 0.5])).tolist()
        reference = pixel_of(expected.key, theirs, expected.distortion.tolist())
        assert torch.allclose(found, float64(reference), rtol=0, atol=1e-9)
    if suffix == "txt":
        assert path.read_text().splitlines()[-1].split()[1] == name


def test_texts_of_mrcal_may_have_escapes(tmp_path):
    given = Path(__file__).parents[1] / "files" / "mrcal_pinhole.cameramodel"
    text = given.read_text()
    before, after = text.split("{", 1)
    path = tmp_path / "noted.cameramodel"
    path.write_text(before + "{\n 'note': 'C:\\\\cam, it\\'s\\n', 'other': b'\\x00',\n" + after)
    assert torch.equal(ct.load(path).camera.intrinsics, ct.load(given).camera.intrinsics)
