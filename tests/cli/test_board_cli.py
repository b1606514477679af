"""Boards to print: to scale, and found where they are drawn."""

import re
from itertools import product
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from cameras import slow_unless
from photographs import raster

from camtorch.boards import printing
from camtorch.boards.boards import AprilGrid, Charuco, Chessboard
from camtorch.boards.detection import detect
from camtorch.cli.main import main

WORDS = {
    "--board 9x6 --square 24mm": Chessboard(9, 6, 0.024),
    "--type charuco --board 8x5 --square 3cm --marker 0.022 --dictionary 4X4_50": Charuco(8, 5, 0.03, 0.022, "4X4_50"),
    "--type aprilgrid --board 5x4 --square 30mm": AprilGrid(5, 4, 0.03),
}


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def board(words, expect=0):
    assert main(["board", *words.split()]) == expect


def lines_of_svg(path):
    """The page's (width, height) in mm, and its outlines, as any reader of SVG has them."""
    root = ElementTree.parse(path).getroot()
    width, height = (float(root.get(side).removesuffix("mm")) for side in ("width", "height"))
    assert root.get("viewBox") == f"0 0 {width:g} {height:g}"
    path = next(root.iter("{http://www.w3.org/2000/svg}path"))
    assert path.get("fill-rule") == "evenodd"
    loops = [loop.strip("Z ").split() for loop in path.get("d").split("M")[1:]]
    return (width, height), [[tuple(map(float, p.split(","))) for p in loop] for loop in loops]


def lines_of_pdf(path):
    content = Path(path).read_bytes()
    width, height = map(float, re.search(rb"/MediaBox \[0 0 (\S+) (\S+)\]", content).groups())
    loops = [line.split(b"h")[0] for line in content.split(b"stream")[1].split(b"\n") if line.endswith(b" h")]
    mm = 25.4 / 72
    points = [np.array(re.findall(rb"(\S+) (\S+) [ml]", loop), float) for loop in loops]
    return (width * mm, height * mm), [[(x * mm, (height - y) * mm) for x, y in loop] for loop in points]


@pytest.mark.parametrize(
    ("number", "kind"), slow_unless({(0, "pdf"), (1, "svg")}.__contains__, list(product(range(3), ("svg", "pdf"))))
)
def test_what_is_drawn_is_found_to_scale(number, kind):
    words = list(WORDS)[number]
    board(f"{words} -o board.{kind}")
    size, loops = (lines_of_svg if kind == "svg" else lines_of_pdf)(f"board.{kind}")
    assert sorted(size) == pytest.approx([210, 297], abs=1e-3)
    image = raster(printing.Page(*size, loops, []), 3.0)
    found = detect(WORDS[words], image)
    assert np.isfinite(found.pixels).all()
    # a similarity without a change of scale: what is measured on paper is what was asked for
    truth, shown = 1000 * WORDS[words].points()[:, :2], (found.pixels + 0.5) / 3.0
    assert np.abs((shown - shown.mean(0)) - (truth - truth.mean(0))).max() < 0.1


def test_cross_references_of_a_pdf_are_right():
    board("--board 9x6 -o board.pdf")
    content = Path("board.pdf").read_bytes()
    start = int(re.search(rb"startxref\n(\d+)\n%%EOF\n$", content)[1])
    assert content[start:].startswith(b"xref\n0 6\n")
    for number, place in enumerate(re.findall(rb"(\d{10}) 00000 n ", content[start:]), 1):
        assert content[int(place) :].startswith(b"%d 0 obj\n" % number)
    length = int(re.search(rb"/Length (\d+)", content)[1])
    begin = content.index(b"stream\n") + 7
    assert content[begin + length :].startswith(b"\nendstream")


def test_the_page_says_what_it_is(capsys):
    board("--type aprilgrid --board 4x5 --square 30mm --spacing 0.25 --border 1 --paper letter -o board.svg")
    text = Path("board.svg").read_text()
    assert "aprilgrid, 4x5 tags, tags of 30 mm, spacing 0.25, APRILTAG_36h11 with a border of 1" in text
    assert "--type aprilgrid --board 4x5 --square 0.03 --spacing 0.25 --dictionary APRILTAG_36h11 --border 1" in text
    assert "100 mm" in text
    out = capsys.readouterr().out
    assert out.startswith("board.svg: aprilgrid, 4x5 tags")
    assert "on 215.9 x 279.4 mm" in out


def test_without_a_square_it_fills_the_paper(capsys):
    board("--board 9x6 -o a4.pdf")
    assert "squares of 24 mm, on 297 x 210 mm" in capsys.readouterr().out
    board("--type charuco --board 7x5 --paper 400x300mm -o own.pdf")
    assert "squares of 52 mm, markers of 39 mm" in capsys.readouterr().out


def test_a_file_is_overwritten_when_that_is_said():
    board("--board 9x6 -o b.svg")
    board("--board 9x6 -o b.svg", expect=2)
    board("--board 9x6 -o b.svg --force")
