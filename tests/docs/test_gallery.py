"""The galleries of the documentation: everything public has its place, its image and its code there."""

import importlib
import inspect
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

import camtorch as ct
from camtorch.warp.dewarp import Projection

DOCS = Path(__file__).parents[2] / "docs"
LARGEST = 150_000  # bytes of an image


@pytest.fixture(scope="module")
def pages():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(DOCS)
        return importlib.import_module("drawings.pages")


def own_models():
    return {model.__name__: key for key, model in ct.MODELS.items() if model.__module__.startswith("camtorch.")}


def check_image(section, name):
    assert f"(../images/{name})" in section
    assert 1000 < (DOCS / "images" / name).stat().st_size < LARGEST


def test_every_model_has_its_place_and_image(pages):
    found = pages.sections("models.md")
    assert sorted(found) == sorted(own_models())
    table = (DOCS / "models.md").read_text()
    for name, key in own_models().items():
        check_image(found[name], f"models/{key}.jpg")
        assert f"| [`{name}`](gallery/models.md#{name.lower()}) | `{key}` |" in table


def test_the_code_of_a_model_makes_one(pages):
    for name, section in pages.sections("models.md").items():
        made = {}
        exec(pages.code(section), made)
        assert type(made["camera"]).__name__ == name
        assert made["camera"].image_size is not None


# whose formulas go the other way, or are none
INVERSE = ("Division", "FThetaBackward", "FThetaBackwardSheared", "OCamCalib", "Splined", "Tabulated")
ALL_TERMS = [0.05, -0.02, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003, 0.001, 0.002, -0.001, 0.003]


def computed(formula, values):
    """The assignments of a printed formula, carried out; ... is what had the name before, or the rest of a series."""
    formula = re.sub(r"\n +", " ", formula)
    for name, expression in re.findall(r"(?:^|  )(\w+) = (.+?)(?=   *\w+ = |$)", formula, re.M):
        code = re.sub(r"^\.\.\.", name, expression.strip()).replace(" + ...", "").replace("^", "**")
        values[name] = eval(re.sub(r"(?<=[\w)]) (?=[\w(])", " * ", code), values)
    return values


def test_printed_formulas_are_what_models_compute(pages):
    found = pages.sections("models.md")
    x, y = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 100))
    ray = {"x": x, "y": y, "z": np.ones(100), "d": np.sqrt(x**2 + y**2 + 1), "phi": np.arctan2(y, x)}
    named = {"atan2": np.arctan2, "atan": np.arctan, "asin": np.arcsin}
    functions = {name: getattr(np, name) for name in ("hypot", "sqrt", "sin", "cos", "tan")} | named
    for name in found.keys() - set(INVERSE):
        formula = re.search(r"```\n(.*?)```", found[name], re.S)[1]
        if name == "Fisheye624":
            formula = re.search(r"```\n(.*?)```", found["Fisheye62"], re.S)[1] + formula
        made = {}
        exec(pages.code(found[name]), made)
        camera = made["camera"].double()
        if not {*re.findall(r"\b[ks]\d\b", formula)} <= {*camera.distortion_names}:
            more = ALL_TERMS if name == "BrownConrady" else ALL_TERMS[:2]
            camera = type(camera)(camera.intrinsics.data, more, image_size=camera.image_size).double()
        shown = {*re.findall(r"\w+", formula)}  # of a series only its first coefficients
        with torch.no_grad():
            camera.distortion *= torch.tensor([float(coefficient in shown) for coefficient in camera.distortion_names])
        coefficients = dict(zip(camera.distortion_names, camera.distortion.tolist(), strict=True))
        values = functions | ray | {"theta": np.arctan(np.hypot(x, y))} | coefficients
        values = computed(formula, values)
        pixels, valid = camera.project(np.stack([x, y, np.ones(100)], -1))
        fx, fy, cx, cy = camera.intrinsics.tolist()
        printed = np.stack([fx * values["a"] + cx, fy * values["b"] + cy], -1)
        assert valid.sum() > 50, name
        np.testing.assert_allclose(pixels[valid].detach(), printed[valid], rtol=0, atol=1e-6, err_msg=name)


def test_every_augmentation_has_its_place_and_image(pages):
    found = pages.sections("augmentations.md")
    values = {name: getattr(ct.augment, name) for name in set(ct.augment.__all__) - {"Augmentation", "Edit"}}
    modules = {name for name, value in values.items() if inspect.isclass(value) and issubclass(value, torch.nn.Module)}
    assert {title.split()[0] for title in found} == modules
    for section in found.values():
        assert "ct.augment." in pages.code(section)
        (name,) = re.findall(r"\(\.\./images/(augment/.*?)\)", section)
        check_image(section, name)


def test_every_option_of_cameras_is_shown(pages):
    shown = " ".join(pages.code(section) for section in pages.sections("augmentations.md").values())
    options = inspect.signature(ct.augment.RandomCamera).parameters.keys() - {"like", "options"}
    assert [name for name in options if not re.search(rf'\b{name}"?[=:]', shown)] == []


def test_every_plot_is_shown(pages):
    found = pages.sections("views.md")
    for section in found.values():
        (name,) = re.findall(r"\(\.\./images/(views/.*?)\)", section)
        check_image(section, name)
    page = (DOCS / "gallery" / "views.md").read_text()
    assert [name for name in ct.plot.__all__ if f"ct.plot.{name}(" not in page] == []
    projections = get_args(Projection)
    assert [name for name in projections if f"{name}.jpg" not in page] == []


def test_every_image_is_small_and_shown():
    text = "".join(page.read_text() for page in (*DOCS.rglob("*.md"), DOCS.parent / "mkdocs.yml"))
    for image in filter(Path.is_file, (DOCS / "images").rglob("*")):
        assert image.relative_to(DOCS).as_posix() in text
        assert image.stat().st_size < (10 if image.suffix == ".webp" else 1.3) * LARGEST
