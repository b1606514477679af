"""What the pages "Coming from" say of other libraries: all names exist, theirs and ours; every row holds in numbers.

A row of their tables is checked by the function that is registered for the first name in it, in `coming_from/`.
"""

import functools
import importlib.util
import inspect
import re
from pathlib import Path

import cv2
import pytest
from coming_from import CHECKS, TRAPS

import camtorch as ct
import camtorch.augment.kornia
import camtorch.augment.numpy
from camtorch.calibration.calibrate import Calibration
from camtorch.stereo.rectification import Rectification

PAGES = sorted((Path(__file__).parents[2] / "docs" / "coming-from").glob("*.md"))
LIBRARIES = [name for name in ("albumentations", "cv2", "kornia", "pycolmap") if importlib.util.find_spec(name)]
for _page in ("opencv", "kornia", "colmap", "pytorch3d", "nvtorchcam", *({"albumentations"} & {*LIBRARIES})):
    importlib.import_module(f"coming_from.{_page}")  # which registers its checks
INSTANCES = {
    "augment": ct.augment.Augmentation,
    "calibration": Calibration,
    "camera": ct.Camera,
    "pair": Rectification,
    "extrinsics": ct.Extrinsics,
    "pose": ct.Extrinsics,
    "rig": ct.Rig,
    "warp": ct.Warp,
}


def rows():
    """(names of theirs, ours) of every row of the tables whose first column is headed by a module of theirs."""
    for page in PAGES:
        tables = re.findall(r"^\| `([\w.]+)` \| camtorch \|.*\n\|[-| ]+\n((?:\|.*\n?)+)", page.read_text(), re.M)
        for module, body in tables:
            for line in body.splitlines():
                theirs, ours, *_ = line.split(" | ")
                spans = re.findall(r"`([^`]+)`", theirs)
                assert spans, f"{page.name}: no name in {line}"
                yield [f"{module}.{re.match(r'[A-Za-z_][.A-Za-z0-9_]*', span)[0]}" for span in spans], ours.strip()


def resolved(name):
    """What goes by that dotted name, a module or what is in it."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:end]))
        except ImportError:
            continue
        return functools.reduce(getattr, parts[end:], module)
    raise ImportError(name)


@pytest.mark.parametrize("library", LIBRARIES)
def test_their_names_exist(library):
    names = [name for names, _ in rows() for name in names if name.split(".")[0] == library]
    if not hasattr(cv2, "omnidir"):  # of opencv-contrib-python
        names = [name for name in names if not name.startswith("cv2.omnidir")]
    assert len(names) > 5
    for name in names:
        resolved(name)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_our_names_exist(page):
    found = 0
    for span in re.findall(r"`([^`\n]+)`", page.read_text()):
        for name in re.findall(r"(?<![\w.])((?:ct|camtorch)(?:\.[A-Za-z_]\w*)+)", span):
            found += 1
            if name.startswith("camtorch.augment.albumentations") and not importlib.util.find_spec("albumentations"):
                continue  # which it imports
            resolved(re.sub(r"^ct\.", "camtorch.", name))
        for owner, name in re.findall(rf"(?<![\w.])({'|'.join(INSTANCES)})\.([A-Za-z_]\w*)", span):
            known = dir(INSTANCES[owner]), getattr(INSTANCES[owner], "__annotations__", ())
            assert any(name in names for names in known), span
    assert found > 5 or page.stem == "index"


def test_every_row_has_a_check():
    """But for those without a counterpart, and those of libraries that are not installed, but for their cameras."""
    asked = {names[0] for names, ours in rows() if ours != "none"} - set(CHECKS)
    assert sorted(name for name in asked if name.split(".")[0] in LIBRARIES) == []
    assert sorted(set(CHECKS) - {names[0] for names, _ in rows()}) == []


@pytest.mark.parametrize("check", [*{id(param): param for param in CHECKS.values()}.values(), *TRAPS])
def test_a_row_or_a_trap_is_one(check, tmp_path):
    """Those that write files take a folder for them."""
    check(*[tmp_path] * len(inspect.signature(check).parameters))
