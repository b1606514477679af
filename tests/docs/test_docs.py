"""README and documentation: every Python block runs on its own, every command runs, every public name has a page."""

import doctest
import functools
import importlib
import importlib.util
import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from boards import STEREO, seen_by, stereo
from photographs import fisheye, photograph
from PIL import Image
from videos import write_video

import camtorch as ct
from camtorch.boards.boards import Chessboard
from camtorch.cli.main import main
from camtorch.io import formats

ROOT = Path(__file__).parents[2]
COLUMNS = 80  # of code: what a page shows without scrolling
FILES = ROOT / "tests" / "files"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]

FIRST = ("README.md", "AGENTS.md", "getting-started.md", "concepts.md")  # the others are tried by the slow tests


def blocks(language: str):
    for page in PAGES:
        for found in re.finditer(rf"^( *)```{language}\n(.*?)^ *```", page.read_text(), re.S | re.M):
            line = page.read_text()[: found.start()].count("\n") + 2
            code = re.sub(rf"^{found[1]}", "", found[2], flags=re.M)
            marks = () if page.name in FIRST else pytest.mark.slow
            yield pytest.param(page, line, code, id=f"{page.relative_to(ROOT)}:{line}", marks=marks)


def commands():
    for param in blocks("bash"):
        page, line, code = param.values
        lines = [part for part in re.split(r"\n| && ", code.replace("\\\n", "")) if part.startswith("camtorch ")]
        if lines:
            yield pytest.param(page, line, lines, id=param.id, marks=param.marks)


@functools.cache
def photographs():
    turns = ((0.5 * np.cos(a), 0.5 * np.sin(a), 0.1) for a in np.linspace(0, 6, 6))
    places = ((0.06 * np.sin(a) - 0.1, 0.05 * np.cos(a) - 0.07, 0.2 + 0.01 * a) for a in np.linspace(0, 6, 6))
    return [photograph(Chessboard(9, 6, 0.024), fisheye(), *pose)[0] for pose in zip(turns, places, strict=True)]


def write_calibration_data():
    """Corners of one camera and of a pair, poses of a robot, and photographs, as the pages on calibration have them."""
    pair, right, *_ = stereo(8)
    np.savez("stereo.npz", object_points=pair.object_points, left=pair.image_points, right=right)
    seen, turns, shifts = seen_by(STEREO["left"], 8)
    corners = {"object_points": seen.object_points, "image_points": seen.image_points}
    np.savez("corners.npz", **corners)
    hand = torch.eye(4).double().repeat(8, 1, 1)  # where the camera is, and the base is where the board is
    hand[:, :3, :3], hand[:, :3, 3] = turns, shifts
    np.savez("robot.npz", base_from_hand=hand.inverse(), **corners)
    Path("images").mkdir()
    for i, image in enumerate(photographs()):
        Image.fromarray(image).save(f"images/{i}.jpg", quality=95)


@pytest.fixture
def folder(tmp_path, monkeypatch, request):
    torch.manual_seed(0)
    monkeypatch.chdir(tmp_path)
    Path("examples").symlink_to(ROOT / "examples")
    shutil.copy(FILES / "opencv_fisheye.yml", "camera.yml")
    shutil.copy(FILES / "kalibr_camchain.yaml", "camchain.yaml")
    camera = ct.load("camera.yml").camera
    height, width = camera.image_size
    ct.save(camera, "other.yml", format="opencv")
    Image.fromarray(np.full((height, width, 3), 128, np.uint8)).save("photo.jpg")
    Image.new("RGB", (480, 270), (90, 120, 30)).save("gopro.jpg")
    text = request.getfixturevalue("page").read_text()
    if " drive/" in text:
        for name in ("drive/front/1.jpg", "drive/rear/1.jpg"):
            Path(name).parent.mkdir(parents=True)
            shutil.copy("photo.jpg", name)
    if "clip.mp4" in text:
        pytest.importorskip("av")
        write_video("drive/clip.mp4", range(3), size=(height, width))
    if '"sparse/0"' in text:
        Path("sparse/0").mkdir(parents=True)
        pose = ct.Extrinsics([0.0, 0.1, 0.0], [0.0, 0.0, 0.1]).double()
        ct.save(ct.Rig({"1": camera}, {"a.jpg": pose}, images={"a.jpg": "1"}), "sparse/0/cameras.bin", format="colmap")
    if "images/*.jpg" in text or "corners.npz" in text:
        write_calibration_data()
    if "import mediapipe" in text:  # it wants another NumPy: its stored result stands in for it
        found = json.loads((FILES / "detected_faces.json").read_text())["photograph"]["mediapipe"]
        face = SimpleNamespace(landmark=[SimpleNamespace(x=x, y=y) for x, y in found])
        mesh = SimpleNamespace(process=lambda image: SimpleNamespace(multi_face_landmarks=[face]))
        solutions = SimpleNamespace(face_mesh=SimpleNamespace(FaceMesh=lambda **options: nullcontext(mesh)))
        monkeypatch.setitem(sys.modules, "mediapipe", SimpleNamespace(solutions=solutions))
    known = dict(ct.MODELS)
    yield tmp_path
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
    # the models that pages define are theirs
    ct.MODELS.clear()
    ct.MODELS.update(known)


@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning")  # torch's own, in torch.onnx.export
# Python 3.12 and later warn of forks beside threads, ray of itself; webdataset leaves its files to the collector
@pytest.mark.filterwarnings(
    "ignore:.*fork.*:DeprecationWarning", "ignore::DeprecationWarning:ray", "ignore:unclosed file:ResourceWarning"
)
@pytest.mark.parametrize(("page", "line", "code"), [*blocks("python")])
def test_a_block_runs_by_itself(page, line, code, folder):
    for name in ("albumentations", "h5py", "pycolmap", "ray"):
        if re.search(rf"^import {name}\b", code, re.M) and importlib.util.find_spec(name) is None:
            pytest.skip(f"{name} is not installed")
    exec(compile("\n" * (line - 1) + code, str(page), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize(("page", "line", "lines"), [*commands()])
def test_a_command_runs(page, line, lines, folder, capsys):
    for text in lines:
        words = shlex.split(text, comments=True)[1:]
        assert main(words) == 0, f"{page}:{line}: {text}\n{capsys.readouterr().err}"


def test_photographs_are_read_as_they_are_stored():
    """`cv2.imread` alone turns them by their Exif orientation, which calibrations do not know."""
    texts = [*PAGES, *(path for place in ("docs", "camtorch") for path in (ROOT / place).rglob("*.[ip]*y*"))]
    calls = [call for path in texts for call in re.findall(r"imread\([^()]*\)", path.read_text(errors="ignore"))]
    assert len(calls) >= 2
    assert [call for call in calls if "IMREAD_IGNORE_ORIENTATION" not in call] == []


def test_code_fits_into_the_width_of_a_page():
    for page in PAGES:
        blocks = re.findall(r"^( *)```.*\n((?:.*\n)*?)\1```$", page.read_text(), re.M)
        lines = [line.removeprefix(indent) for indent, block in blocks for line in block.splitlines()]
        long = [line for line in lines if len(line) > COLUMNS and not line.startswith("pip install torch")]
        assert long == [], page


def test_python_in_pages_has_the_format_of_their_width():
    """pyproject.toml leaves it to this test: the rest of the package is wider."""
    pages = [path for form in ("md", "ipynb") for path in (ROOT / "docs").rglob(f"*.{form}")]
    ruff = [sys.executable, "-m", "ruff", "format", "--no-cache", f"--line-length={COLUMNS}"]
    done = subprocess.run([*ruff, "--diff", *pages], capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(ruff[2:])} makes it so:\n{done.stdout}{done.stderr}"


def test_every_public_name_has_a_place_in_the_reference():
    reference = "\n".join(page.read_text() for page in (ROOT / "docs" / "api").glob("*.md"))
    rooms = (ct, ct.augment, ct.data, ct.io, ct.lenses, ct.losses, ct.views)
    values = [getattr(room, name) for room in rooms for name in room.__all__]
    assert [v for v in values if callable(v) and f".{v.__name__}\n" not in reference + "\n"] == []


def test_every_entry_of_the_reference_is_there():
    pages = (page.read_text() for page in (ROOT / "docs" / "api").glob("*.md"))
    entries = re.findall(r"^::: (camtorch\S*)\.(\w+)$", "\n".join(pages), re.M)
    assert len(entries) > 100
    for module, name in entries:
        if module not in ("camtorch.augment.albumentations", "camtorch.augment.torchvision"):  # not always installed
            assert hasattr(importlib.import_module(module), name), f"{module}.{name}"


def test_every_format_has_a_row():
    page = (ROOT / "docs" / "guides" / "files.md").read_text()
    assert [name for name in ct.io.FORMATS if f'| `"{name}"` |' not in page] == []


def test_every_format_is_in_the_docstrings():
    assert [names.title for names in formats.READ.values() if names.title.split()[0] not in ct.load.__doc__] == []
    assert [name for name in formats.WRITTEN if f'"{name}"' not in ct.save.__doc__] == []


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text()
    pages = [str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")]
    assert pages
    assert [page for page in pages if f" {page}\n" not in navigation] == []


def test_links_of_the_root_lead_somewhere():
    """The strict build of the site checks those of docs/."""
    form = re.compile(r"\]\((?!https?:)(\S+?)\)")
    links = [(page, link) for page in ROOT.glob("*.md") for link in form.findall(page.read_text())]
    assert links
    for page, link in links:
        path, _, anchor = link.partition("#")
        target = ROOT / path if path else page
        assert target.exists(), (page.name, link)
        if anchor:
            titles = re.findall(r"^#+ (.*)", target.read_text(), re.M)
            assert anchor in [re.sub(r"[^\w\s-]", "", title).lower().replace(" ", "-") for title in titles], link


@pytest.mark.parametrize("name", ["commands", pytest.param("accuracy", marks=pytest.mark.slow)])
def test_made_pages_are_those_made_now(name):
    """On another CPU a power of ten may be the next one."""
    made, power = runpy.run_path(str(ROOT / "docs" / f"make_{name}.py")), re.compile(r"\b1e(-\d+)")
    pages = made["PAGE"].read_text(encoding="utf-8"), made["text"]()
    assert len({power.sub("", page) for page in pages}) == 1, f"python docs/make_{name}.py makes it anew"
    assert all(abs(int(a) - int(b)) < 2 for a, b in zip(*map(power.findall, pages), strict=True))


CORE = "Camera Pinhole BrownConrady KannalaBrandt Fisheye62 Fisheye624 Extrinsics Warp Dewarp Mixed RandomMount"
CORE += " RandomLens RandomCamera Compose BoxCrop FaceNormalizer CameraHead load save calibrate solve_pnp rectify"
CORE += " triangulate fit"


@pytest.mark.parametrize("name", [*CORE.split(), "Reproject"])
def test_the_example_of_a_docstring_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = getattr(ct, name, getattr(ct.augment, name, None)).__doc__
    if ">>>" not in text:
        pytest.skip(f"{name} has no example")
    example = doctest.DocTestParser().get_doctest(text, {"ct": ct, "np": np, "torch": torch}, name, None, None)
    assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example).failed == 0
