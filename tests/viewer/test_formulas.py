"""The page's formulas in node, and what `write_viewer` takes and writes."""

import base64
import json
import shutil
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from cameras import fisheye
from lenses_live import ANSWERS, KEYS, check, described, lenses_of

import camtorch as ct
from camtorch.lenses.collection import entries
from camtorch.viewer import viewer

FORMULAS = Path(viewer.__file__).with_name("formulas.js")
MOST_BYTES = 400_000
WIDE = fisheye((480, 640))


def test_formulas_are_those_of_python():
    """All lenses of every model by one process of node."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed here")
    lenses = {key: lenses_of(key) for key in KEYS}
    text = json.dumps({key: [described(camera) for camera in cameras] for key, cameras in lenses.items()})
    code = (
        f"const Formulas = require({json.dumps(str(FORMULAS))}); const answers = {ANSWERS};"
        "const asked = JSON.parse(require('fs').readFileSync(0));"
        "const found = Object.entries(asked).map(([key, lenses]) => [key, answers(lenses)]);"
        "console.log(JSON.stringify({ models: Formulas.MODELS, found: Object.fromEntries(found) }));"
    )
    run = subprocess.run([node, "-e", code], input=text, capture_output=True, text=True, check=True, encoding="utf-8")
    result = json.loads(run.stdout)
    assert sorted(result["models"]) == KEYS
    for key in KEYS:
        for camera, answer in zip(lenses[key], result["found"][key], strict=True):
            check(camera, answer)


@pytest.mark.parametrize("key", sorted(ct.MODELS))
def test_every_model_is_shown_or_refused_by_name(key, tmp_path):
    camera = ct.MODELS[key](torch.tensor([100.0, 100.0, 49.5, 39.5]), image_size=(80, 100))
    path = tmp_path / "lens.html"
    if key in KEYS:
        ct.write_viewer(camera, path)
        assert f'"model":"{key}"' in path.read_text()
    else:
        with pytest.raises(ValueError, match=f"known to the page; got {key}"):
            ct.write_viewer(camera, path)
        assert not path.exists()


def test_the_page_is_small_and_asks_for_nothing(tmp_path):
    path = tmp_path / "lens.html"
    ct.write_viewer(WIDE, path)
    text = path.read_text()
    assert path.stat().st_size < MOST_BYTES
    assert "@@" not in text
    assert "default-src 'none'" in text
    for outside in ("http://", "https://", "src=", "@import"):
        assert outside not in text
    assert '"distortion":[0.02,-0.01,0.004,-0.001]' in text  # numbers are as they were written


@pytest.mark.parametrize("kind", ["path", "array", "tensor", "grey"])
def test_a_photograph_is_kept_at_a_moderate_size(kind, tmp_path):
    from PIL import Image

    camera = WIDE.resize(2400, 3200)
    image = np.zeros((2400, 3200, 3), np.uint8)
    image[:, ::2] = 255
    if kind == "path":
        Image.fromarray(image).save(tmp_path / "photo.png", compress_level=1)
    given = {"path": str(tmp_path / "photo.png"), "array": image, "tensor": torch.from_numpy(image).movedim(-1, 0)}
    text = viewer.page(camera, given.get(kind, image[..., 0]))
    data = json.loads(text.split('id="data">')[1].split("</script>")[0])
    (tmp_path / "kept.jpg").write_bytes(base64.b64decode(data["photograph"].split(",")[1]))
    with Image.open(tmp_path / "kept.jpg") as kept:
        assert kept.size == (1920, 1440)


def unpacked(packed):
    planes = zlib.decompress(base64.b64decode(packed["numbers"]), -15)
    columns, at, count = [], 0, packed["count"]
    for width in packed["widths"]:
        rows = np.frombuffer(planes, np.uint8, count * width, at).reshape(width, count).astype(np.int64)
        code = sum(row << 8 * i for i, row in enumerate(rows))
        columns.append((code >> 1) ^ -(code & 1))
        at += width * count
    assert at == len(planes)
    return columns


def test_all_lenses_are_in_the_page_within_half_a_pixel():
    packed = viewer._lenses()
    there = [lens for lens in entries() if min(lens.intrinsics[:2]) > 0]
    assert packed["count"] == len(there) > 9700
    names = zlib.decompress(base64.b64decode(packed["names"]), -15).decode().split("\0")
    assert names[: len(there)] == [lens.brand for lens in there]
    fx, fy, cx, cy, *k = unpacked(packed)
    size = np.array([lens.image_size for lens in there], float)[:, ::-1]
    exact = np.array([lens.intrinsics for lens in there])
    focal, bend = packed["steps"]
    found = np.stack((fx, fx + fy, cx, cy), -1) * focal
    found[:, 2:] += size / 2
    assert np.abs(found - exact).max() <= focal
    # up to the corner of an equidistant lens of that focal length
    corner = np.hypot(*size.T) / 2 / found[:, 0]
    theta = corner[:, None] * np.linspace(0, 1, 9)
    radius = [f[:, None] * theta for f in (exact[:, 0], found[:, 0])]
    for i, exact_k in enumerate(np.array([lens.distortion for lens in there]).T):
        power = (theta / corner[:, None]) ** (2 * i + 3)
        radius[0] += (exact[:, 0] * exact_k * corner ** (2 * i + 3))[:, None] * power
        radius[1] += (k[i] * bend)[:, None] * power
    # what the focal length is rounded by moves the corner of a wide lens by as much, and its bends
    moved = 0.25 * (1 + np.abs(exact[:, 0] - found[:, 0]) * 4) + 1e-3 * np.abs(radius[0]).max(-1)
    assert (np.abs(radius[0] - radius[1]).max(-1) < moved).mean() > 0.999


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ((ct.Rig({"a": WIDE}),), TypeError, r"only camera is its .camera"),
        (("camera.yml",), TypeError, "camera of one model; got str"),
        ((WIDE.expand(2),), ValueError, r"a batch \(2,\)"),
        ((ct.Pinhole([100.0, 100.0, 50.0, 50.0]),), ValueError, "image_size"),
        ((ct.cat([WIDE, ct.Pinhole([1.0, 1, 2, 3], image_size=(480, 640))]),), TypeError, "Mixed"),
        ((WIDE, "lens.html", np.zeros((100, 100, 3), np.uint8)), ValueError, "640 x 480"),
        ((WIDE, "lens.html", "none.jpg"), OSError, "none.jpg"),
        ((WIDE, 3), TypeError, "path must name a file"),
    ],
)
def test_what_cannot_be_shown_is_told(arguments, error, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=text):
        ct.write_viewer(*arguments, *["lens.html"] * (len(arguments) == 1))
    assert not list(tmp_path.iterdir())
