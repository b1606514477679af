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


def cases():
    """File, camera, model, intrinsics in the file's convention, distortion, size (width, height)."""
    for name, entry in MANIFEST.items():
        expected = entry["expected"]
        if name.startswith(("opencv_camera", "ros")):
            core = [expected[k] for k in ("fx", "fy", "cx", "cy")] if "fx" in expected else None
            core = core or [expected["K"][0][0], expected["K"][1][1], expected["K"][0][2], expected["K"][1][2]]
            model = "kannala_brandt" if expected.get("distortion_model") == "equidistant" else "brown_conrady"
            yield name, None, model, core, expected["D"], (expected["width"], expected["height"])
        elif name == "opencv_fisheye.yml":
            values = expected["params"]
            yield name, None, "kannala_brandt", values[:4], values[4:], (expected["width"], expected["height"])
        elif name.startswith("nerfstudio"):
            core = [expected[k] for k in ("fl_x", "fl_y", "cx", "cy")]
            fisheye = expected["camera_model"] == "OPENCV_FISHEYE"
            names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
            model = "kannala_brandt" if fisheye else "brown_conrady"
            yield name, None, model, core, [expected[k] for k in names], (expected["w"], expected["h"])
        elif name.startswith("kalibr"):
            for key, model in (("cam0", "brown_conrady"), ("cam1", "kannala_brandt")):
                size = (1280, 800) if key == "cam0" else (1920, 1280)
                yield name, key, model, expected[key]["intrinsics"], expected[key]["D"], size
        elif name.startswith("basalt"):
            for i, (model, camera) in enumerate(zip(("double_sphere", "kannala_brandt"), expected, strict=True)):
                values = list(camera["intrinsics"].values())
                yield name, f"cam{i}", model, values[:4], values[4:], tuple(MANIFEST[name]["resolution"][i])
        elif name.startswith("mrcal"):
            values = expected["intrinsics"]
            model = "brown_conrady" if values[4:] else "pinhole"
            yield name, None, model, values[:4], values[4:], tuple(expected["imagersize"])
        elif name.startswith("aria"):
            models = {"FisheyeRadTanThinPrism": "fisheye624", "Fisheye62": "fisheye62"}
            for label, camera in expected.items():
                values = camera["params"]
                if camera["name"] in models:
                    values = values[:1] + values
                model = models.get(camera["name"], "kannala_brandt")
                yield name, label, model, values[:4], values[4:], tuple(camera["image_size"])
        elif "cameras" in expected:
            for label, camera in expected["cameras"].items():
                yield name, label, *(camera[key] for key in ("model", "intrinsics", "distortion", "image_size"))


@pytest.mark.parametrize(("name", "camera", "model", "core", "distortion", "size"), list(cases()))
def test_values_of_the_manifest(name, camera, model, core, distortion, size):
    rig = load(name)
    found = rig.cameras[camera] if camera else rig.camera
    assert found.key == model
    shift = MANIFEST[name]["pixel_centre"]
    assert found.intrinsics.tolist() == [core[0], core[1], core[2] - shift, core[3] - shift]
    assert found.distortion.tolist() == distortion
    assert found.image_size == (size[1], size[0])
    pixel = found.project(float64(POINT))[0] + shift
    reference = MANIFEST[name].get("check_pixel_of_point_0p1_m0p2_1", {}).get(camera)
    reference = reference or pixel_of(model, core, distortion)
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
    elif model == "brown_conrady":
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
