"""The report of a calibration: complete, in one file that needs no other, whatever the names are."""

import base64
import io
import os
import re
import sys
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from boards import opencv_calibration, opencv_left, stereo
from PIL import Image

import camtorch as ct
from camtorch.report import report

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

SECTIONS = ("coverage", "residuals", "worst", "uncertainty", "parameters")
VOID = {"meta", "img", "br"}
HOSTILE = "<script>alert('$x^2$ & \"y\"')</script>\u202e\x07\udc80.jpg"


class Page(HTMLParser):
    """Elements of a page: (tag, attributes) in order, ids, references and the text outside of styles."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.open, self.text = [], [], ""
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += "" if self.open[-1:] == ["style"] else data

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]

    def values(self, key):
        return [attributes[key] for _, attributes in self.elements if key in attributes]

    def images(self, kind):
        """The files within it, of one kind."""
        parts = [image["src"].partition(",") for image in self.all("img")]
        return [base64.b64decode(data) for head, _, data in parts if head == f"data:{kind};base64"]


def read(path):
    return Page(path.read_text("utf-8"))


@pytest.fixture(scope="module")
def calibration():
    corners, _ = opencv_left()
    pixels = corners.image_points[:6].clone()
    pixels[4, 20:24] += 9.0
    return ct.calibrate(
        "brown_conrady", corners.object_points, pixels, image_size=corners.image_size, loss="huber", loss_scale=0.3
    )


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Photographs of the kinds that a report takes; one cannot be read, and one is missing."""
    folder = tmp_path_factory.mktemp("images")
    grey = np.full((480, 640), 90, np.uint8)
    Image.fromarray(grey).save(folder / "a.png")
    (folder / "broken.jpg").write_text("no photograph")
    colour = np.stack((grey, grey, grey), -1)
    return [
        folder / "a.png",
        str(folder / "broken.jpg"),
        None,
        grey,
        torch.from_numpy(colour).movedim(-1, 0) / 255,
        Image.fromarray(grey.astype(np.uint16) * 256),
    ]


def written(calibration, images, folder):
    names = [f"{number} {HOSTILE}" for number in range(6)]
    ct.write_report(calibration, folder / "report.html", images=images, names=names, title=HOSTILE)
    assert [file.name for file in folder.iterdir()] == ["report.html"]
    return read(folder / "report.html")


@pytest.fixture(scope="module")
def page(calibration, images, tmp_path_factory):
    """Without plots, which are dear to draw."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            report, "_drawn", lambda *_, **__: report._Figure("A title, and more", "data:image/svg+xml;base64,")
        )
        return written(calibration, images, tmp_path_factory.mktemp("report"))


def test_all_is_there(page, calibration):
    ids, links = page.values("id"), [reference[1:] for reference in page.values("href")]
    assert len(ids) == len(set(ids))
    assert links[: len(SECTIONS)] == list(SECTIONS)
    assert set(links) <= set(ids)
    for text in (f"{calibration.rms:.3g}", f"{calibration.sigma:.3g}", "324 corners, 4 outliers", "640 x 480"):
        assert text in page.text
    for name, std in zip(calibration.parameter_names, calibration.std.tolist(), strict=True):
        assert re.search(rf"{name}\s*[\u2212\d.e-]+{std:.2g}", page.text)
    assert calibration.verdict in page.text
    for text in calibration.warnings:
        assert text in page.text


def test_it_needs_nothing_else_whatever_names_are(page):
    assert all(reference.startswith("#") for reference in page.values("href"))
    assert all(source.startswith("data:image/") for source in page.values("src"))
    assert not page.all("script")
    assert not page.all("link")
    (policy,) = (meta["content"] for meta in page.all("meta") if "http-equiv" in meta)
    assert policy.startswith("default-src 'none'")
    shown = "".join("�" if c in "\x07\u202e\udc80" else c for c in HOSTILE)
    assert page.text.count(shown) >= 2 + 6 + 6  # title, a row and a photograph of each view


def test_photographs_of_all_kinds_are_within(page):
    photographs = page.images("image/jpeg")
    assert len(photographs) == 4
    assert page.text.count("no photograph: ") == 1
    for data in photographs:
        with Image.open(io.BytesIO(data)) as image:
            assert image.size == (640, 480)
            assert abs(np.asarray(image.convert("L"), int) - 90).max() <= (165 if image.mode == "L" else 2)


@pytest.mark.slow
def test_plots_are_within(calibration, images, tmp_path):
    plots = written(calibration, images, tmp_path).images("image/svg+xml")
    assert len(plots) == 7 + 6
    for plot in plots:
        root = ElementTree.fromstring(plot)
        references = [value for element in root.iter() for key, value in element.items() if key.endswith("href")]
        assert root.tag.endswith("svg")
        assert all(reference.startswith(("#", "data:image/png;base64,")) for reference in references)


@pytest.mark.slow
def test_a_report_is_replaced_as_a_whole(calibration, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("before")
    with pytest.raises(ValueError, match="20 x 10 pixels, and those of the camera have 640 x 480"):
        ct.write_report(calibration, path, images=[np.zeros((10, 20), np.uint8)] * 6)
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["report.html"]


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ({"images": [None, None]}, ValueError, "2 images for 13 views"),
        ({"names": ["a"]}, ValueError, "1 names for 13 views"),
        ({"names": "abcdefghijklm"}, TypeError, "names must be a list, one for each view; got 'abcdefghijklm'"),
        ({"images": "abcdefghijklm"}, TypeError, "images must be a list, one for each view; got 'abcdefghijklm'"),
        ({"images": [*[None] * 12, "nope.png"]}, FileNotFoundError, r"images\[12\] is no file: 'nope.png'"),
    ],
)
def test_bad_arguments(given, error, words, tmp_path):
    with pytest.raises(error, match=f"^write_report: {words}"):
        ct.write_report(opencv_calibration(), tmp_path / "report.html", **given)
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("package", ["matplotlib", "jinja2"])
def test_packages_that_are_not_there(package, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=r"pip install 'camtorch\[plot\]'"):
        ct.write_report(opencv_calibration(), tmp_path / "report.html")


@pytest.fixture(scope="module")
def rig():
    corners, seen, _, _ = stereo(views=8)
    points = {"left": corners.image_points, HOSTILE: seen}
    models, sizes = (dict.fromkeys(points, value) for value in ("kannala_brandt", (480, 640)))
    return ct.calibrate_rig(models, corners.object_points, points, image_sizes=sizes | {HOSTILE: (600, 800)})


@pytest.mark.slow
def test_of_a_rig_each_camera_has_its_part(rig, tmp_path):
    path = tmp_path / "report.html"
    names = [f"shot {number}" for number in range(8)]
    ct.write_report(rig, path, images={"left": [None] * 8}, names=names)
    page = read(path)
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    assert {f"camera-{i}-{section}" for i in range(2) for section in SECTIONS} <= set(ids)
    assert "shot 3" in page.text
    assert not page.all("script")
    baseline = float(rig.rig.extrinsics[HOSTILE].translation.detach().norm())
    assert f"{baseline:.3f}" in page.text
    with pytest.raises(TypeError, match="mapping from the names"):
        ct.write_report(rig, path, images=[None] * 8)
    with pytest.raises(ValueError, match="'middle'; the rig has 'left'"):
        ct.write_report(rig, path, images={"middle": [None] * 8})
