"""What is installed: the wheel, and the archive of sources."""

import os
import platform
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from camtorch.native.build import LIBRARY, REASON

ROOT = Path(__file__).parent.parent
FISHEYE = (
    "%YAML:1.0\n---\nimage_width: 96\nimage_height: 64\nfisheye_model: 1\n"
    "K: [28, 0, 47, 0, 28, 32, 0, 0, 1]\nD: [-0.02, 0.004, -0.003, 0.0006]\n"
)
WITHOUT_SCENES = "git clone https://github.com/camtorch/camtorch"

pytestmark = pytest.mark.slow  # builds in an environment of its own, which takes a network


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    words = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, ROOT]
    subprocess.run(words, check=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A folder with the wheel's files and nothing else."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def camtorch(installed, folder, *words):
    """The status and what the command prints, on stdout and stderr."""
    environment = os.environ | {"PYTHONPATH": str(installed)}
    words = [sys.executable, "-m", "camtorch", *words]
    done = subprocess.run(words, capture_output=True, text=True, cwd=folder, env=environment)
    return done.returncode, done.stdout, done.stderr


def test_the_wheel_holds_no_scenes(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = (archive.read(name).decode() for name in names if name.endswith("METADATA"))
    assert "camtorch/camera.py" in names
    assert "camtorch/py.typed" in names
    assert "camtorch/native/kernel.c" in names  # `python -m camtorch.native.build` where a compiler came later
    tops = {name.split("/")[0] for name in names}
    assert all(top == "camtorch" or top.endswith(".dist-info") for top in tops)
    assert not [name for name in names if name.startswith("camtorch/demo/") or not name.isascii()]
    needed = {line.split()[1].split(">")[0] for line in metadata.splitlines() if line.startswith("Requires-Dist:")}
    assert {"torch", "kornia", "numpy", "pillow", "pyyaml"} <= needed


def test_what_is_installed_dewarps_a_photograph(installed, tmp_path):
    from PIL import Image

    (tmp_path / "camera.yml").write_text(FISHEYE)
    Image.new("RGB", (96, 64), "red").save(tmp_path / "photo.jpg")
    status, told, error = camtorch(installed, tmp_path, "dewarp", "photo.jpg", "--camera", "camera.yml", "-o", "o.png")
    assert (status, error) == (0, "")
    assert "kannala_brandt dewarped to perspective" in told
    with Image.open(tmp_path / "o.png") as image:
        assert image.size == (96, 64)


def test_no_module_of_the_wheel_lacks_another(installed, tmp_path):
    code = """
import importlib, pkgutil
import camtorch
print(camtorch.__file__)
for module in pkgutil.walk_packages(camtorch.__path__, "camtorch."):
    # the first one runs the command; the others are for libraries that may not be there
    if module.name.split(".")[-1] not in ("__main__", "albumentations", "torchvision"):
        importlib.import_module(module.name)
"""
    environment = os.environ | {"PYTHONPATH": str(installed)}
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=tmp_path, env=environment)
    assert Path(done.stdout.strip()).parent.parent == installed


@pytest.mark.parametrize("words", [["demo"], ["demo", "training"], ["augment"]])
def test_what_needs_the_repository_says_so(installed, tmp_path, words):
    status, told, error = camtorch(installed, tmp_path, *words)
    assert (status, told) == (2, "")
    assert WITHOUT_SCENES in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


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


def test_the_archive_of_sources_holds_them(tmp_path, hatchling):
    hatchling(ROOT, "-t", "sdist", "-d", tmp_path)
    (path,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.split("/", 1)[-1] for name in archive.getnames()}
    sources = {f"camtorch/native/{name}" for name in ("build.py", "dispatch.c", "kernel.c", "sampler.h")}
    assert {"camtorch/demo/cabin.py", "hatch_build.py", *sources} <= names
    assert not [name for name in names if "/_sampler." in name]


@pytest.fixture
def checkout(tmp_path):
    """A copy of what a wheel is made of, with a sampler that takes no time to compile, and an older library in it."""
    folder = tmp_path / "checkout"
    ignore = shutil.ignore_patterns("_sampler.*", "__pycache__", "demo")
    shutil.copytree(ROOT / "camtorch", folder / "camtorch", ignore=ignore)
    for name in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE", ".gitignore"):
        shutil.copy(ROOT / name, folder)
    native = folder / "camtorch" / "native"
    (native / "kernel.c").write_text("int VARIANT;\n")
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


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler is here")
def test_a_wheel_has_the_sampler_and_is_for_this_machine(checkout, tmp_path, hatchling):
    assert "without" not in hatchling(checkout, "-t", "wheel", "-d", tmp_path)
    name, found = held(tmp_path)
    assert name.startswith("py3-none-")  # of any Python, on this
    assert name.endswith(f"_{platform.machine().lower()}.whl")
    assert list(found) == [LIBRARY]
    assert b"camtorch_sources" in found[LIBRARY]
    assert (checkout / "camtorch" / "native" / LIBRARY).read_bytes() == b"older"


@pytest.mark.parametrize(
    ("environment", "reason"),
    [
        ({"PATH": "/nowhere"}, "no C compiler: none of cc, gcc, clang is on the PATH, and CC names none"),
        ({"CC": "no-such-cc"}, "the C compiler 'no-such-cc', which CC or the caller names, is not there"),
        ({"CC": "cc --no-such-option"}, "no-such-option"),
        ({"CAMTORCH_NATIVE": "0"}, "CAMTORCH_NATIVE=0 when it was installed"),
    ],
)
def test_without_a_sampler_the_wheel_is_for_all_and_says_why(checkout, tmp_path, hatchling, environment, reason):
    lines = hatchling(checkout, "-t", "wheel", "-d", tmp_path, **environment).splitlines()
    (line,) = (line for line in lines if "without its native sampler: " in line)
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
