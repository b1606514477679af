"""Boards on paper: pages in millimetres, as SVG and as PDF, both of filled outlines, so to scale everywhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import Board

Outline = list[tuple[float, float]]

PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "a2": (420.0, 594.0), "a1": (594.0, 841.0), "a0": (841.0, 1189.0)}
PAPERS |= {"letter": (215.9, 279.4), "legal": (215.9, 355.6), "tabloid": (279.4, 431.8)}
"""(width, height) in mm, upright."""

_MARGIN = 10.0
_FOOT = 16.0
"""Of the ruler and the words, below the board."""
_LETTER, _SMALLEST = 3.2, 0.8
_LINE = 0.2
_WIDTH = 0.52
"""Of Helvetica's characters, in the size of the letters: somewhat above the mean."""
_POINT = 25.4 / 72


class Text(NamedTuple):
    """A line of text, `size` mm high, whose baseline begins at (x, y)."""

    x: float
    y: float
    text: str
    size: float = _LETTER


class Page(NamedTuple):
    """A page, in mm from its top left corner: black outlines, whose holes are outlines too (even-odd), and words."""

    width: float
    height: float
    outlines: list[Outline]
    texts: list[Text]


def outlines(black: NDArray[np.bool_]) -> list[list[tuple[int, int]]]:
    """The borders of the black cells of a grid, as closed lines of cells' corners (x, y); holes have theirs."""
    padded = np.pad(black, 1)
    ends: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for y, x in np.argwhere(black).tolist():
        sides = (
            (padded[y, x + 1], (x, y), (x + 1, y)),
            (padded[y + 1, x + 2], (x + 1, y), (x + 1, y + 1)),
            (padded[y + 2, x + 1], (x + 1, y + 1), (x, y + 1)),
            (padded[y + 1, x], (x, y + 1), (x, y)),
        )
        for neighbour, start, end in sides:
            if not neighbour:
                ends.setdefault(start, []).append(end)
    lines = []
    while ends:
        start = at = min(ends)  # a corner
        line: list[tuple[int, int]] = []
        while not line or at != start:
            onward = ends[at].pop()
            if not ends[at]:
                del ends[at]
            if not line or not any(line[-1][axis] == at[axis] == onward[axis] for axis in (0, 1)):
                line.append(at)
            at = onward
        lines.append(line)
    return lines


def page(board: Board, paper: tuple[float, float] | None, words: Sequence[str]) -> Page:
    """A board, of lengths in metres, in the middle of paper, to scale, with a ruler and words below.

    paper: (width, height) in mm, turned if the board fits better so; or None, for paper that fits it.

    Raises:
        ValueError: the board is too large.
    """
    left, top, right, bottom = extent(board)
    wide, high = 1000 * (right - left), 1000 * (bottom - top)
    if paper is None:
        paper = wide + 2 * _MARGIN, high + 2 * _MARGIN + _FOOT
    else:
        paper = max(paper, paper[::-1], key=lambda sides: largest(board, sides))
        part = largest(board, paper)
        if part < 1:
            raise ValueError(
                f"board: {wide:.6g} x {high:.6g} mm does not fit on paper of {paper[0]:g} x {paper[1]:g} mm with "
                f"margins of {_MARGIN:g} mm: it would with its lengths times {math.floor(1000 * part) / 1000:g}"
            )
    x, y = (paper[0] - wide) / 2, (paper[1] - _FOOT - high) / 2
    shapes = [
        [(x + 1000 * (c.x + i * c.pitch - left), y + 1000 * (c.y + j * c.pitch - top)) for i, j in line]
        for c in board.cells()
        for line in outlines(c.black)
    ]
    ruler, texts = _foot(paper, words)
    return Page(*paper, [*shapes, *ruler], texts)


def extent(board: Board) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of what is black, in the board's frame."""
    corners = [(c.x, c.y, c.x + c.pitch * c.black.shape[1], c.y + c.pitch * c.black.shape[0]) for c in board.cells()]
    left, top, right, bottom = zip(*corners, strict=True)
    return min(left), min(top), max(right), max(bottom)


def largest(board: Board, paper: tuple[float, float]) -> float:
    """How many times as large the board could be on this paper, held this way."""
    left, top, right, bottom = extent(board)
    room = paper[0] - 2 * _MARGIN, paper[1] - 2 * _MARGIN - _FOOT
    # a board that fills the room to the last bit fits
    return min(room[0] / (1000 * (right - left)), room[1] / (1000 * (bottom - top))) * (1 + 1e-9)


def _foot(paper: tuple[float, float], words: Sequence[str]) -> tuple[list[Outline], list[Text]]:
    """A ruler of whole centimetres, its length above it, and the words in lines beside it that fit on the page."""

    def rectangle(x: float, y: float, width: float, height: float) -> Outline:
        return [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]

    length = 100 if paper[0] >= 140 else max(10 * int((paper[0] - 2 * _MARGIN) / 20), 10)
    x, y = _MARGIN, paper[1] - _MARGIN
    ruler = [rectangle(x, y - _LINE / 2, length, _LINE)]
    for mark in range(0, length + 1, 5):
        high = 3.0 if mark % 50 == 0 else 2.0 if mark % 10 == 0 else 1.2
        ruler.append(rectangle(x + mark - _LINE / 2, y - high, _LINE, high - _LINE / 2))
    found = [Text(x, y - 4, f"{length} mm, or the print is not to scale", 2.6)]
    x = _MARGIN + max(length, 45) + 6
    size = min(_LETTER, (paper[0] - _MARGIN - x) / (_WIDTH * max(map(len, words), default=1)))
    if size >= _SMALLEST:  # else nobody could read anything
        found += [Text(x, y - 1.3 * _LETTER * line, text, size) for line, text in enumerate(reversed(words))]
    return ruler, found


def as_svg(page: Page) -> str:
    """An SVG file."""
    path = " ".join("M" + " ".join(f"{x:.6g},{y:.6g}" for x, y in line) + "Z" for line in page.outlines)
    texts = "".join(
        f'<text x="{t.x:.6g}" y="{t.y:.6g}" font-size="{t.size:.4g}">{escape(t.text)}</text>\n' for t in page.texts
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{page.width:.6g}mm" height="{page.height:.6g}mm" '
        f'viewBox="0 0 {page.width:.6g} {page.height:.6g}">\n'
        f'<rect width="100%" height="100%" fill="white"/>\n<path fill-rule="evenodd" d="{path}"/>\n'
        f'<g font-family="Helvetica, Arial, sans-serif">\n{texts}</g>\n</svg>\n'
    )


def as_pdf(page: Page) -> bytes:
    """A PDF file of one page, which asks not to be scaled when it is printed."""

    def at(x: float, y: float) -> str:
        return f"{x / _POINT:.5f} {(page.height - y) / _POINT:.5f}"

    drawn = [f"{at(*line[0])} m " + " ".join(f"{at(*p)} l" for p in line[1:]) + " h" for line in page.outlines]
    drawn.append("f*")
    for text in page.texts:
        shown = text.text.encode("cp1252", "replace").decode("latin-1")
        shown = shown.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        drawn.append(f"BT /F {text.size / _POINT:.4f} Tf {at(text.x, text.y)} Td ({shown}) Tj ET")
    content = "\n".join(drawn).encode("latin-1")
    box = f"[0 0 {page.width / _POINT:.5f} {page.height / _POINT:.5f}]"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
        "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    file, places = bytearray(b"%PDF-1.6\n"), []
    for number, body in enumerate(objects, 1):
        places.append(len(file))
        file += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    start = len(file)
    file += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    file += b"".join(b"%010d 00000 n \n" % place for place in places)
    file += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start)
    return bytes(file)
