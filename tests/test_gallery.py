"""The galleries of the documentation: everything public has its place, its picture and its code there."""

import sys
from pathlib import Path

import pytest

import camtorch as ct

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
