"""What is installed: the wheel, and the archive of sources."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

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


def test_the_archive_of_sources_holds_them(tmp_path):
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--target", tmp_path / "tools", "hatchling"]
    subprocess.run(words, check=True)
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "tools")}
    words = [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", tmp_path]
    subprocess.run(words, check=True, cwd=ROOT, env=environment)
    (path,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = archive.getnames()
    assert any(name.endswith("camtorch/demo/cabin.py") for name in names)
