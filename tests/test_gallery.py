"""The galleries of the documentation: everything public has its place, its picture and its code there."""

import inspect
import re
import sys
from pathlib import Path
from typing import get_args

import pytest
import torch

import camtorch as ct
from camtorch.warp.dewarp import Projection

DOCS = Path(__file__).parent.parent / "docs"
LARGEST = 150_000  # bytes of a picture


@pytest.fixture(scope="module")
def pages():
    """The module by which pictures are made from pages."""
    sys.path.insert(0, str(DOCS))
    try:
        from drawings import pages
    finally:
        sys.path.remove(str(DOCS))
    return pages


def own_models():
    return {model.__name__: key for key, model in ct.MODELS.items() if model.__module__.startswith("camtorch.")}


def check_picture(section, name):
    assert f"(../images/{name})" in section
    assert 1000 < (DOCS / "images" / name).stat().st_size < LARGEST


def test_every_model_has_its_place_and_picture(pages):
    found = pages.sections("models.md")
    assert sorted(found) == sorted(own_models())
    table = (DOCS / "models.md").read_text()
    for name, key in own_models().items():
        check_picture(found[name], f"models/{key}.jpg")
        assert f"| [`{name}`](gallery/models.md#{name.lower()}) | `{key}` |" in table


def test_the_code_of_a_model_makes_one(pages):
    for name, section in pages.sections("models.md").items():
        made = {}
        exec(pages.code(section), made)
        assert type(made["camera"]).__name__ == name
        assert made["camera"].image_size is not None


def augmentations():
    """Those that are no base of others."""
    bases = {ct.augment.Augmentation, ct.augment.Edit}
    found = {name: getattr(ct.augment, name) for name in ct.augment.__all__}
    return {name for name, value in found.items() if _moves_samples(value) and value not in bases}


def _moves_samples(value):
    return isinstance(value, type) and issubclass(value, torch.nn.Module)


def test_every_augmentation_has_its_place_and_picture(pages):
    found = pages.sections("augmentations.md")
    assert {title.split()[0] for title in found} == augmentations()
    for section in found.values():
        assert "ct.augment." in pages.code(section)
        (name,) = re.findall(r"\(\.\./images/(augment/.*?)\)", section)
        check_picture(section, name)


def test_every_option_of_cameras_is_shown(pages):
    shown = " ".join(pages.code(section) for section in pages.sections("augmentations.md").values())
    options = [
        name for name in inspect.signature(ct.augment.RandomCamera).parameters if name not in ("like", "options")
    ]
    assert [name for name in options if not re.search(rf'\b{name}"?[=:]', shown)] == []


def test_every_plot_is_shown(pages):
    found = pages.sections("views.md")
    for section in found.values():
        (name,) = re.findall(r"\(\.\./images/(views/.*?)\)", section)
        check_picture(section, name)
    page = (DOCS / "gallery" / "views.md").read_text()
    assert [name for name in ct.plot.__all__ if f"ct.plot.{name}(" not in page] == []
    projections = get_args(Projection)
    assert [name for name in projections if f"{name}.jpg" not in page] == []


def test_every_picture_is_small_and_shown():
    text = "".join(page.read_text() for page in (*DOCS.rglob("*.md"), DOCS.parent / "mkdocs.yml"))
    for picture in filter(Path.is_file, (DOCS / "images").rglob("*")):
        assert picture.relative_to(DOCS).as_posix() in text
        assert picture.stat().st_size < 1.3 * LARGEST
