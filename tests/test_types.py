"""What a type checker sees of the public surface."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mypy")

ROOT = Path(__file__).parent.parent

USE = """
from typing_extensions import assert_type

import torch

import camtorch as ct

images = torch.rand(1, 3, 480, 640)
camera = ct.KannalaBrandt([300.0, 300, 320, 240], torch.zeros(4), image_size=(480, 640))
assert_type(camera, ct.KannalaBrandt)
assert_type(camera.crop(0, 0, 100, 100), ct.KannalaBrandt)
assert_type(camera.project(torch.rand(5, 3)), tuple[torch.Tensor, torch.Tensor])
assert_type(camera.convert(ct.Fisheye624), ct.Conversion[ct.Fisheye624])
assert_type(camera.convert(ct.Fisheye624, max_angle=1.0).camera, ct.Fisheye624)
assert_type(camera.convert("fisheye624").camera, ct.Camera)
assert_type(camera.convert(ct.Pinhole).rms, torch.Tensor)
assert_type(ct.Dewarp(camera, projection="cylindrical")(images), torch.Tensor)
assert_type(ct.Warp(camera, camera).inverse()(images, mode="nearest"), torch.Tensor)
"""


def checked(tmp_path, text):
    """What mypy says of a user's file, strictly."""
    file = tmp_path / "use.py"
    file.write_text(text)
    options = ["--strict", "--no-incremental", "--follow-imports=silent", "--config-file=", "--python-version=3.10"]
    result = subprocess.run([sys.executable, "-m", "mypy", *options, file], capture_output=True, text=True, cwd=ROOT)
    return result.stdout


@pytest.mark.slow
def test_what_users_get_has_types(tmp_path):
    found = checked(tmp_path, USE)
    assert found.startswith("Success"), found


@pytest.mark.slow
def test_a_wrong_use_is_found(tmp_path):
    other = "other: ct.Pinhole = camera.convert(ct.Fisheye624).camera\n"
    text = 'camera.convert(ct.Fisheye624, count="many")\n'
    projection = 'ct.Dewarp(camera, projection="flat")\n'
    found = checked(tmp_path, USE + other + text + projection)
    assert 'expression has type "Fisheye624", variable has type "Pinhole"' in found
    assert 'No overload variant of "convert"' in found
    assert 'to "Dewarp" has incompatible type' in found
    assert "Found 3 errors" in found
