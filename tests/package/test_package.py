"""How a wheel is built: with the library and without. What is in it and what it does, `.ci/package.py` tries."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from camtorch.native.build import LIBRARY, REASON

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.slow  # builds in an environment of its own, which takes a network


@pytest.fixture(scope="module")
def hatchling(tmp_path_factory):
    """Builds what `words` say of a folder, with the command that pip calls; what it says on the way."""
    tools = tmp_path_factory.mktemp("tools")
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--target", tools, "hatchling", "editables"]
    subprocess.run(words, check=True)

    def build(folder, *words, **environment):
        environment = {k: v for k, v in os.environ.items() if k not in ("CC", "CAMTORCH_NATIVE")} | environment
        environment["PYTHONPATH"] = str(tools)
        words = [sys.executable, "-m", "hatchling", "build", *words]
        done = subprocess.run(words, check=True, cwd=folder, env=environment, capture_output=True, text=True)
        return done.stdout + done.stderr

    return build


@pytest.fixture
def checkout(tmp_path):
    """A copy of what a wheel is made of, with a library that takes no time to compile, and an older library in it."""
    folder = tmp_path / "checkout"
    ignore = shutil.ignore_patterns("_sampler.*", "_objects", "__pycache__", "*.[ch]")
    shutil.copytree(ROOT / "camtorch", folder / "camtorch", ignore=ignore)
    for name in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE", ".gitignore"):
        shutil.copy(ROOT / name, folder)
    native = folder / "camtorch" / "native"
    (native / "sampler.c").write_text("int VARIANT;\n")
    (native / "dispatch.c").write_text("unsigned camtorch_sources(void) { return SOURCES; }\n")
    (native / LIBRARY).write_bytes(b"older")
    return folder


def held(folder):
    """The only wheel in there: its name's end, and what its `camtorch/native` has beside sources."""
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        found = {n.split("/")[-1]: archive.read(n) for n in archive.namelist() if "/_sampler." in n}
        told = next(archive.read(n) for n in archive.namelist() if n.endswith("/WHEEL")).decode()
    assert ("Root-Is-Purelib: true" in told) == path.name.endswith("-py3-none-any.whl")
    return path.name.split("-", 2)[2], found


@pytest.mark.parametrize(
    ("environment", "reason"),
    [
        ({"PATH": "/nowhere"}, "no C compiler: one of cc, gcc, clang must be on the PATH; got none"),
        ({"CAMTORCH_NATIVE": "0"}, "CAMTORCH_NATIVE=0 when it was installed"),
    ],
)
def test_without_a_sampler_the_wheel_is_for_all_and_says_why(checkout, tmp_path, hatchling, environment, reason):
    lines = hatchling(checkout, "-t", "wheel", "-d", tmp_path, **environment).splitlines()
    (line,) = (line for line in lines if "without its compiled library: " in line)
    name, found = held(tmp_path)
    assert name == "py3-none-any.whl"
    assert list(found) == [REASON]
    assert reason in found[REASON].decode()
    assert line.endswith(found[REASON].decode().strip())


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler is here")
def test_an_editable_install_has_it_in_place(checkout, tmp_path, hatchling):
    native = checkout / "camtorch" / "native"
    hatchling(checkout, "-t", "wheel:editable", "-d", tmp_path, PATH="/nowhere")
    assert not (native / LIBRARY).exists()
    assert (native / REASON).read_text().startswith("no C compiler")
    hatchling(checkout, "-t", "wheel:editable", "-d", tmp_path)
    assert b"camtorch_sources" in (native / LIBRARY).read_bytes()
    assert not (native / REASON).exists()
    assert held(tmp_path)[1] == {}
