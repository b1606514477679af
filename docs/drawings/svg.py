"""Line drawings as SVG, on paper, so that they are read on light and dark pages alike."""

import math
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

PAPER, INK, GREY, RIM = "#faf5eb", "#2b2a2e", "#7a7064", "#d6cab6"
RED, GREEN, BLUE, VIOLET, PALE = "#c8203f", "#0b7a54", "#1e64f0", "#7a3fc2", "#e9dfcb"
Point = Sequence[float]


class Drawing:
    """What is drawn, in the units of a page of `width` x `height`."""

    def __init__(self, width: int, height: int):
        self.width, self.height = width, height
        self._parts: list[str] = []

    def line(
        self,
        points: Iterable[Point],
        colour: str = INK,
        width: float = 2.5,
        *,
        dash: str = "",
        fill: str = "none",
        closed: bool = False,
    ) -> None:
        """Straight pieces from point to point; with a `fill`, an area."""
        places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        shape = "polygon" if closed else "polyline"
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        self._parts.append(
            f'<{shape} points="{places}" fill="{fill}" stroke="{colour}" stroke-width="{width}"{dashes} '
            'stroke-linejoin="round" stroke-linecap="round"/>'
        )

    def arrow(self, start: Point, end: Point, colour: str = INK, width: float = 3.5) -> None:
        """An arrow."""
        self.head(start, end, colour, width)
        length = math.dist(start, end)
        along = [(b - a) / length for a, b in zip(start, end, strict=True)]
        self.line((start, [b - 3 * width * d for b, d in zip(end, along, strict=True)]), colour, width)

    def head(self, start: Point, end: Point, colour: str = INK, width: float = 3.5) -> None:
        """The head of an arrow that comes from `start`."""
        length = math.dist(start, end)
        x, y = ((b - a) / length for a, b in zip(start, end, strict=True))
        size, half = 5 * width, 2 * width
        back = end[0] - size * x, end[1] - size * y
        corners = (end, (back[0] + half * y, back[1] - half * x), (back[0] - half * y, back[1] + half * x))
        self.line(corners, colour, 1, fill=colour, closed=True)

    def dot(self, at: Point, colour: str = INK, radius: float = 6, *, fill: str | None = None) -> None:
        """A disc; a ring, if it is filled with another colour."""
        self._parts.append(
            f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius}" fill="{fill or colour}" stroke="{colour}" '
            'stroke-width="2.5"/>'
        )

    def text(
        self, at: Point, text: str, colour: str = INK, size: int = 26, *, anchor: str = "start", bold: bool = False
    ) -> None:
        """A line of text that begins, has its middle, or ends ("start", "middle", "end") on a baseline."""
        weight = ' font-weight="bold"' if bold else ""
        self._parts.append(
            f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" fill="{colour}" font-size="{size}" text-anchor="{anchor}"{weight}>'
            f"{escape(text)}</text>"
        )

    def save(self, path: Path, title: str) -> None:
        """Write it; the title is what screen readers say."""
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" width="{self.width}" '
            f'height="{self.height}" font-family="Helvetica, Arial, sans-serif" role="img">'
        )
        paper = f'<rect width="{self.width}" height="{self.height}" rx="6" fill="{PAPER}"/>'
        path.write_text("\n".join((head, f"<title>{escape(title)}</title>", paper, *self._parts, "</svg>")) + "\n")
