"""Every public name of 0.3 works as before, or stands on the page about what left."""

import json
import pickle
import re
from pathlib import Path

import pytest
import torch
from public_names import names

import camtorch as ct
from camtorch.cli.main import make_parser

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "leaving-0.3.md"
OLD = json.loads(Path(__file__).with_name("names-0.3.json").read_text())


@pytest.fixture(scope="module")
def new():
    return set(names())


def on_the_page():
    """Names in the first column of the page's tables."""
    cells = [line.replace(r"\|", "").split("|")[1] for line in PAGE.read_text().splitlines() if line.startswith("| ")]
    return {re.sub(r"^camtorch\.", "ct.", span) for cell in cells for span in re.findall(r"`([^`]+)`", cell)}


def with_holders(name):
    """The name, and those of what it belongs to: `ct.Warp.save(step=)`, `ct.Warp.save`, `ct.Warp`."""
    name = name.replace("ct.models.", "ct.")
    while name:
        yield name
        cut = name.rfind("(") if name.endswith(")") else max(name.rfind("."), name.rfind(" "))
        name = name[: max(cut, 0)]


def test_every_name_that_went_stands_on_the_page(new):
    known = on_the_page()
    assert len(OLD) > 2000
    assert [name for name in OLD if name not in new and known.isdisjoint(with_holders(name))] == []


def test_the_page_names_nothing_that_is_there(new):
    there = {holder for name in new for holder in with_holders(name)}
    assert sorted(on_the_page() & there) == []


def words():
    for line in Path(__file__).with_name("words-gone.txt").read_text().splitlines():
        word, *places = line.partition("#")[0].split() or [""]
        if word:
            yield pytest.param(word, places, id=word)


@pytest.mark.parametrize(("word", "places"), [*words()])
def test_a_word_that_left_is_nowhere_in_the_package(word, places):
    files = [ROOT / name for name in ("README.md", "pyproject.toml", "mkdocs.yml", ".ci/run")]
    files += [
        file for file in (ROOT / "camtorch").rglob("*") if file.suffix in (".py", ".c", ".h", ".js", ".html", ".json")
    ]
    assert len(files) > 200
    found = [str(file.relative_to(ROOT)) for file in files if word in file.read_text("utf-8").lower()]
    assert sorted(set(found) - set(places)) == []
    assert word in PAGE.read_text("utf-8").lower()


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


TYPED |= {
    f"a pickle {made.__name__}": lambda made=made: copied(made()) for made in (with_shutter, with_rates, with_exposure)
}


def copied(module):
    return pickle.loads(pickle.dumps(module))


def test_a_pickled_shutter_without_an_exposure_loads():
    shutter = copied(with_exposure(0.0))
    shutter.load_state_dict(shutter.state_dict())


@pytest.mark.parametrize("use", TYPED.values(), ids=TYPED)
def test_an_error_about_an_old_name_leads_to_the_page(use):
    with pytest.raises((AttributeError, ValueError), match=re.escape(f"docs/{PAGE.name}")):
        use()
