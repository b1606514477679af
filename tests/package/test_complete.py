"""What is added in one place has its entries in the others: a test for each kind of list says what lacks what."""

import inspect
import re
from pathlib import Path

import pytest
import torch
from cameras import RANGES, STATED
from rigs import MANIFEST, load

import camtorch as ct
from camtorch.augment.fields import KINDS
from camtorch.cameras import operators
from camtorch.maps import formats as maps
from camtorch.values.stub import listed_names
from camtorch.viewer.viewer import models
from camtorch.warp.options import MODES

ROOT = Path(__file__).parents[2]


def classes(base):
    """The public classes of camtorch.augment that derive from a class."""
    for kind in base.__subclasses__():
        if kind.__module__.startswith("camtorch.augment.") and not kind.__name__.startswith("_"):
            yield kind
        yield from classes(kind)


def test_every_table_has_every_model():
    keys = {key for found in STATED.values() for key in found}
    assert len(keys) > 20
    kinds = {key: ct.MODELS[key] for key in keys & set(ct.MODELS)}
    listed = {*listed_names(str(ROOT / "camtorch" / "models")).values()}
    page = (ROOT / "docs" / "models.md").read_text()
    tables = {
        "camtorch/models/__init__.pyi": {key for key in keys if module_name(key) in listed},
        "RANGES in tests/cameras.py": {k for k in keys if k in RANGES or not getattr(kinds.get(k), "default_count", 0)},
        "camtorch/viewer/presets.json": set(models()),
        "docs/models.md": {k for k in keys if f"| `{k}` |" in page},
    }
    lacks = {name: sorted(keys - known) for name, known in tables.items() if keys - known}
    assert lacks == {}, f"entries of models are missing: {lacks}"


def module_name(key):
    return next(f"camtorch.models.{path.stem}" for path, keys in STATED.items() if key in keys)


def test_every_file_of_a_model_states_a_key():
    assert [path.name for path, keys in STATED.items() if not keys] == []


def test_every_format_has_a_sample():
    names = [*MANIFEST, "camtorch_0.2.0.json", "camtorch_0.4.0.json", "nuscenes/calibrated_sensor.json"]
    without = {"ocamcalib"}  # tests/models/test_ocamcalib.py writes its files
    assert {load(name).format for name in names} == set(ct.io.FORMATS) - without


@pytest.mark.parametrize("format", maps.FORMATS)
def test_every_format_of_maps_is_tried(format):
    texts = [path.read_text() for path in (ROOT / "tests" / "maps").glob("test_*.py")]
    assert any(f'"{format}"' in text for text in texts), f"tests/maps has no test of {format}"


def test_every_format_of_labels_is_tried():
    with pytest.raises(ValueError, match="format must be one of") as refused:
        ct.data.read(".", format="?")
    known = re.search(r"one of ([\w, ]+)", str(refused.value))[1].split(", ")
    sets = re.search(r"^SETS = {(.*)}$", (ROOT / "tests" / "data" / "test_labels.py").read_text(), re.M)[1]
    assert sorted(re.findall(r'"(\w+)":', sets)) == sorted(known)


@pytest.mark.parametrize(("base", "file"), [("Edit", "test_edits.py"), ("Augmentation", "test_state.py")])
def test_every_class_is_in_the_laws(base, file):
    text = (ROOT / "tests" / "augment" / file).read_text()
    names = {kind.__name__ for kind in classes(getattr(ct.augment, base))} - {"Edit", "CameraDrawer"}
    assert len(names) > 5
    assert sorted(name for name in names if not re.search(rf"A\.{name}\b", text)) == [], f"{file} lacks them"


def test_every_override_of_an_augmentation_is_in_its_table():
    base = ct.augment.Augmentation
    own = base.__mro__[: base.__mro__.index(torch.nn.Module)]
    inherited = {name for kind in own for name in (*vars(kind), *kind.__annotations__)}
    stated = {name for kind in classes(base) for name in vars(kind) if name in inherited and name[:2] != "__"}
    lines = re.findall(r"^    # (\w+(?:, \w+)*)  +\S", Path(inspect.getfile(base)).read_text(), re.M)
    assert sorted(", ".join(lines).split(", ")) == sorted(stated - {"new_camera", "extra_repr"})


def test_every_kind_of_field_is_on_its_page():
    page = (ROOT / "docs" / "guides" / "augment.md").read_text()
    table = page[page.index("## Fields of a sample") : page.index("### Which camera")]
    assert [kind for kind in KINDS if f"`{kind}`" not in table] == []


def test_every_augmentation_is_one_of_kornia():
    kornia = pytest.importorskip("camtorch.augment.kornia")
    names = {kind.__name__ for kind in classes(ct.augment.Augmentation)} - {"Edit", "CameraDrawer", "RandomShutter"}
    assert sorted(name for name in names if not hasattr(kornia, name)) == []


@pytest.mark.parametrize("mode", MODES)
def test_every_library_that_is_given_a_mode_has_it(mode, tmp_path):
    runtime, kornia = pytest.importorskip("onnxruntime"), pytest.importorskip("camtorch.augment.kornia")
    camera, half = ct.Pinhole.from_fov(60, image_size=(8, 12)), {"mode": mode, "antialias": True}
    images = torch.rand(1, 3, 8, 12, generator=torch.Generator().manual_seed(0))
    resized = ct.augment.Resize((4, 6), **half)(image=images)["image"]  # by torch's `interpolate`
    assert torch.equal(kornia.Resize(camera, (4, 6), **half)(images), resized)
    warp = ct.Warp(camera, ct.Pinhole.from_fov(50, image_size=(7, 9)), mode=mode)
    ct.save_map(warp, tmp_path / "warp.onnx")
    torch.testing.assert_close(ct.load_map(tmp_path / "warp.onnx")(images, mode), warp(images))
    session = runtime.InferenceSession(tmp_path / "warp.onnx", providers=["CPUExecutionProvider"])
    torch.testing.assert_close(torch.from_numpy(session.run(None, {"images": images.numpy()})[0]), warp(images))


def test_operators_keep_the_names_that_saved_programs_have():
    kept = {"camtorch.warp.compiled.positions", "camtorch.warp.compiled._warp", "camtorch.warp.affine._edited"}
    kept |= {"camtorch.lenses.drawing._drawn"}
    for name in kept:
        assert operators._FUNCTIONS[name], name  # imports the module if nobody has
