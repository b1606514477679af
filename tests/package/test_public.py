"""What is public: errors about names that left, hints that are types, one version, a changelog of one form."""

import importlib
import inspect
import operator
import pickle
import re
import typing
from pathlib import Path

import pytest
import torch
import yaml

import camtorch as ct
from camtorch.cli.main import make_parser

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "leaving-0.3.md"


CAMERA = ct.Pinhole([300.0, 300.0, 319.5, 239.5], image_size=(480, 640))
TYPED = {
    "a name": lambda: ct.Windshield,
    "a name in a room": lambda: ct.augment.RandomElastic,
    "a method": lambda: ct.Warp(CAMERA, CAMERA).save,
    "a format": lambda: ct.save(CAMERA, "camera.json", format="carla"),
    "a format of maps": lambda: ct.save_map(ct.Warp(CAMERA, CAMERA), "map.exr", format="stmap"),
    "a format of labels": lambda: ct.data.read(".", format="lapa"),
    "a model": lambda: CAMERA.convert("cahvor"),
    "a command": lambda: make_parser().parse_args(["rectify"]),
}


def with_shutter():
    warp = ct.Warp(CAMERA, CAMERA)
    warp.add_module("shutter", ct.RollingShutter(0.03, [1.0, 2.0, 3.0]))
    return warp


def with_rates():
    augmentation = ct.augment.RandomMount(yaw=5)
    augmentation.ranges["rates"] = augmentation.ranges["yaw"]
    return augmentation


def with_exposure(seconds=0.01):
    shutter = ct.RollingShutter(0.03, [0.1, 0.2, 0.3])
    shutter.register_buffer("exposure", torch.tensor(seconds))
    return shutter


MADE = with_shutter, with_rates, with_exposure
TYPED |= {f"a pickle {made.__name__}": lambda made=made: copied(made()) for made in MADE}


def copied(module):
    return pickle.loads(pickle.dumps(module))


def test_a_pickled_shutter_without_an_exposure_loads():
    shutter = copied(with_exposure(0.0))
    shutter.load_state_dict(shutter.state_dict())


@pytest.mark.parametrize("use", TYPED.values(), ids=TYPED)
def test_an_error_about_an_old_name_leads_to_the_page(use):
    with pytest.raises((AttributeError, ValueError), match=re.escape(f"docs/{PAGE.name}")):
        use()


# -- hints are types, as pydantic, jsonargparse and beartype ask for them


ROOMS = ["augment", "augment.kornia", "augment.numpy", "data", "io", "lenses", "losses", "models", "optics", "plot"]
ROOMS += ["views"]
FRONT_ENDS = "augment.albumentations", "augment.torchvision"
"""The libraries that these need may not be installed."""


def public(names):
    return sorted(name for name in names if not name.startswith("_"))


def room_of(name):
    """The module of a room: some are imported by name, some are attributes."""
    if name == "ct":
        return ct
    try:
        return operator.attrgetter(name)(ct)
    except AttributeError:
        return importlib.import_module(f"camtorch.{name}")


def of_room(room):
    module = pytest.importorskip(f"camtorch.{room}", exc_type=ImportError) if room in FRONT_ENDS else room_of(room)
    for name in public(getattr(module, "__all__", vars(module))):
        value = getattr(module, name)
        if callable(value) and value.__module__.startswith("camtorch"):
            yield name, value
            for member in ["__init__", *public(dir(value))] if inspect.isclass(value) else ():
                attribute = inspect.getattr_static(value, member)
                attribute = getattr(attribute, "fget", getattr(attribute, "__func__", attribute))
                if inspect.isfunction(attribute) and attribute.__module__.startswith("camtorch"):
                    yield f"{name}.{member}", attribute


@pytest.mark.parametrize("room", ["ct", *ROOMS, *FRONT_ENDS])
def test_hints_of_all_that_is_public_are_types(room):
    checked = 0
    for name, value in of_room(room):
        try:
            assert isinstance(typing.get_type_hints(value), dict)
        except (NameError, TypeError) as error:
            pytest.fail(f"{room}: {name}: {error}")
        checked += 1
    assert checked or room == "models"


# -- a release: one version everywhere, a changelog of one form

FORMS = ROOT / ".github" / "ISSUE_TEMPLATE"
RELEASE = r"^## \[?(\d+\.\d+\.\d+)\]? - (\d{4}-\d\d-\d\d)$"


def test_version_and_date_are_the_same_everywhere():
    changes = (ROOT / "CHANGELOG.md").read_text()
    (version, date), *older = re.findall(RELEASE, changes, re.M)
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert version == citation["version"]
    number, _, dev = ct.__version__.partition(".dev")
    if dev:  # between two releases
        assert tuple(map(int, number.split("."))) > tuple(map(int, version.split(".")))
    else:
        assert number == version
    assert date == citation["date-released"].isoformat()
    assert f'placeholder: "camtorch {version}, torch ' in (FORMS / "defect.yml").read_text()
    order = [tuple(map(int, number.split("."))) for number, _ in ((version, date), *older)]
    assert order == sorted(order, reverse=True)


def test_the_changelog_has_the_sections_of_its_form():
    text = (ROOT / "CHANGELOG.md").read_text()
    headings = re.findall(r"^## (.+)$", text, re.M)
    assert headings[0] == "[Unreleased]"
    assert all(re.match(RELEASE, f"## {heading}") for heading in headings[1:])
    kinds = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    assert set(re.findall(r"^### (.+)$", text, re.M)) <= kinds
    for name in re.findall(r"^## \[(.+)\]", text, re.M):
        assert re.search(rf"^\[{re.escape(name)}\]: https://", text, re.M), f"{name} has no link"
