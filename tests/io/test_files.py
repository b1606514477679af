"""Every format: what the files say, and that it comes back."""

import pytest
import torch
from rigs import FILES, MANIFEST, POINT, SAMPLES, SUFFIXES, assert_same, float64, load

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
    if reference := MANIFEST[name].get("check_pixel_of_point_0p1_m0p2_1"):
        pixel = found.project(float64(POINT))[0] + shift
        assert torch.allclose(pixel, float64(reference[label]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("suffix", ["txt", "bin"])
@pytest.mark.parametrize("entry", MANIFEST["cameras.txt"]["expected"], ids=lambda entry: entry["model"])
def test_each_model_of_colmap(entry, suffix, tmp_path):
    path, name, values = tmp_path / f"cameras.{suffix}", entry["model"], entry["params"]
    (tmp_path / "one.txt").write_text(f"7 {name} {entry['width']} {entry['height']} {' '.join(map(repr, values))}\n")
    key, fx, fy, cx, cy, *distortion = entry["ours"]  # but for the half pixel
    rest = (float64(distortion),) if distortion else ()
    core, size = float64([fx, fy, cx - 0.5, cy - 0.5]), (entry["height"], entry["width"])
    expected = ct.MODELS[key](core, *rest, image_size=size)
    rig = ct.load(tmp_path / "one.txt")
    ct.save(rig, path)
    assert_same(rig, ct.Rig({"7": expected}))
    assert_same(ct.load(path), rig)
    if suffix == "txt":
        assert path.read_text().splitlines()[-1].split()[1] == name


def test_texts_of_mrcal_may_have_escapes(tmp_path):
    text = (FILES / "mrcal_pinhole.cameramodel").read_text()
    path = tmp_path / "noted.cameramodel"
    path.write_text(text.replace("{", "{\n 'note': 'C:\\\\cam, it\\'s\\n', 'other': b'\\x00',\n", 1))
    assert_same(ct.load(path), load("mrcal_pinhole.cameramodel"))
