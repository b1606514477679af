"""Types of the public surface, as a project sees them that installed camtorch, by mypy and by pyright."""

import importlib
import importlib.util
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
import typing
import venv
from pathlib import Path

import pytest
from test_docs import blocks

import camtorch as ct

ROOT = Path(__file__).parents[2]

# what pages write for short, and no type of ours
UNTYPED = ("--allow-untyped-defs", "--allow-incomplete-defs", "--allow-untyped-calls", "--allow-any-generics")
TOLERATED = (
    r"MatLike|StereoSGBM_create",  # cv2's
    r"ndarray\[.*\] \| None\" has no attribute|\"shape\" is not a known attribute of \"None\"",  # cv2's, of imread
    r"\"(findChessboardCornersSB|remap)\"",  # likewise
    r"\"Tensor \| None\" has no attribute|\"(isfinite|abs)\" is not a known attribute of \"None\"",  # torch's, of .grad
    r"parameter \"dataset\"|\"DataLoader\" has incompatible type|annotation for \"sampler\"",  # torch's, of DataLoader
    r"webdataset|onnxruntime|h5py|\"ray|albumentations|mediapipe|torchvision|tqdm|driver_monitoring",  # without types
    r"\"NDArray\[float64\] \| None\"|\"allclose\"",  # pycolmap's
)

# of models, whose types are those of `Camera`
CONSTANTS = re.compile(
    r"\.(special_cases|fit_(starts|counts|bounds)|odd_in_[xy]|quarter_turn|turn_axis|has_poles)$|Mixed\.from_fov$"
)
ROOMS = ct, ct.augment, importlib.import_module("camtorch.augment.kornia"), ct.data, ct.io, ct.losses, ct.views
NAMES = [getattr(room, name) for room in ROOMS for name in room.__all__]
NAMES += [typing.get_type_hints(name).get("return") for name in NAMES if inspect.isfunction(name)]
PUBLIC = tuple(f"{name.__module__}.{name.__qualname__}." for name in NAMES if hasattr(name, "__qualname__"))
"""Classes and functions that users import, or get from those; mypy alone checks what is inside."""


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A folder of scripts beside an environment in which camtorch lies as a wheel puts it there."""
    folder = tmp_path_factory.mktemp("project")
    venv.create(folder / ".venv", symlinks=os.name != "nt")
    packages = next((folder / ".venv").rglob("site-packages"))
    shutil.copytree(ROOT / "camtorch", packages / "camtorch", ignore=shutil.ignore_patterns("__pycache__"))
    (packages / "others.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    for name in ("uses", "pages"):
        (folder / name).mkdir()
    for name in ("typed_uses.py", "wrong_uses.py"):
        shutil.copy(Path(__file__).with_name(name), folder / "uses")
    for param in blocks("python"):
        page, line, code = param.values
        name = re.sub(r"\W", "_", str(page.relative_to(ROOT).with_suffix("")))
        (folder / "pages" / f"{name}_{line}.py").write_text(code)
    return folder


def run(project, checker, *arguments):
    if importlib.util.find_spec(checker) is None:
        pytest.skip(f"{checker} is not installed; .ci/run installs it")
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    path = f"{project / '.venv' / 'bin'}{os.pathsep}{os.environ['PATH']}"
    environment = {**kept, "PATH": path, "PYRIGHT_PYTHON_IGNORE_WARNINGS": "1"}
    command = [sys.executable, "-m", checker, *arguments]
    return subprocess.run(command, cwd=project, env=environment, capture_output=True, text=True).stdout


def pyright(project, *arguments, **settings):
    settings = {"venvPath": ".", "venv": ".venv", "pythonVersion": "3.11", **settings}
    (project / "pyrightconfig.json").write_text(json.dumps(settings))
    return run(project, "pyright", *arguments)


def is_of_others(line):
    """Whether an error has its cause in another library; the page that it is on may be called like one."""
    said = line.partition("error: ")[2]
    return any(re.search(pattern, said) for pattern in TOLERATED)


@pytest.mark.slow
def test_mypy_finds_what_is_wrong_and_no_error_on_any_page(project):
    python, cache = project / ".venv" / "bin" / "python", ROOT / ".mypy_cache" / "project"  # kept, for torch
    options = ["--strict", "--python-version=3.11", f"--python-executable={python}", "--config-file="]
    said = run(project, "mypy", *options, f"--cache-dir={cache}", *UNTYPED, "uses", "pages")
    assert re.search(r"\d\d+ source files", said), said
    found = [line for line in said.splitlines() if "error:" in line]
    assert [line for line in found if line.startswith("uses") or not is_of_others(line)] == []


@pytest.mark.slow
def test_pyright_finds_what_is_wrong_and_nothing_else(project):
    strict = {"typeCheckingMode": "strict", "enableTypeIgnoreComments": False}
    said = pyright(project, include=["uses"], reportUnnecessaryTypeIgnoreComment="error", **strict)
    assert said.startswith("0 errors"), said


@pytest.mark.slow
def test_all_that_is_public_has_a_type(project):
    report = json.loads(pyright(project, "--verifytypes", "camtorch", "--ignoreexternal", "--outputjson"))
    symbols = [symbol for symbol in report["typeCompleteness"]["symbols"] if symbol["isExported"]]
    assert len(symbols) > 3000
    # what is partially unknown is so because of another symbol
    unknown = [
        symbol["name"]
        for symbol in symbols
        if not symbol["isTypeKnown"] or symbol["isTypeAmbiguous"]
        if any("partially unknown" not in diagnostic["message"] for diagnostic in symbol["diagnostics"])
    ]
    assert [name for name in unknown if f"{name}.".startswith(PUBLIC) and not CONSTANTS.search(name)] == []
