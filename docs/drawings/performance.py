"""The picture of the page on performance: bars of who is faster, and by how much."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from drawings.svg import BLUE, GREY, INK, RIM, Drawing

WIDTH, ROW, TOP, BOTTOM = 640, 48, 78, 40
LEFT, RIGHT, MARGIN = 262, 628, 44  # where bars are, and the room for a number beside the longest


class Bar(NamedTuple):
    """A row: times of the fastest `other` over camtorch's, with the compiled library and without it."""

    title: str
    other: str
    ratio: float
    without: float | None


def comparison(bars: Sequence[Bar], kind: str, note: str) -> Drawing:
    """Draw the rows on a logarithmic axis: to the right camtorch is faster, to the left the others are."""
    logs = [math.log10(ratio) for bar in bars for ratio in (1, bar.ratio, bar.without) if ratio]
    low, high = min(logs), max(logs)
    scale = (RIGHT - LEFT - 2 * MARGIN) / (high - low)
    end = TOP + ROW * len(bars)
    drawing = Drawing(WIDTH, end + BOTTOM)

    def place(ratio: float) -> float:
        return LEFT + MARGIN + scale * (math.log10(ratio) - low)

    def box(left: float, right: float, top: float, height: float, colour: str) -> None:
        corners = ((left, top), (right, top), (right, top + height), (left, top + height))
        drawing.line(corners, colour, 1, fill=colour, closed=True)

    for x, colour, text in ((14, BLUE, f"with its library, {kind}"), (300, GREY, "without its library")):
        box(x, x + 22, 14, 14, colour)
        drawing.text((x + 30, 28), text, size=18)
    drawing.text((place(1) - 12, 62), "others faster", size=18, anchor="end")
    drawing.text((place(1) + 12, 62), "camtorch faster", size=18)
    for tick in (t for t in (0.01, 0.1, 10, 100) if low <= math.log10(t) <= high):
        drawing.line(((place(tick), TOP - 4), (place(tick), end)), RIM, 1.5, dash="3 5")
    for at, bar in enumerate(bars):
        top = TOP + ROW * at
        drawing.text((14, top + 20), bar.title, size=20, bold=True)
        drawing.text((14, top + 39), f"next best: {bar.other}", GREY, 16)
        for ratio, y, height, colour in ((bar.ratio, top + 6, 17, BLUE), (bar.without, top + 26, 13, GREY)):
            if ratio:
                start, stop = sorted((place(1), place(ratio)))
                box(start, stop, y, height, colour)
                side, anchor = (stop + 6, "start") if ratio >= 1 else (start - 6, "end")
                factor = max(ratio, 1 / ratio)
                text = f"{factor:.1f}x" if factor < 9.95 else f"{factor:.0f}x"
                drawing.text((side, y + height - 1), text, colour, 17, anchor=anchor, bold=colour == BLUE)
    drawing.line(((place(1), TOP - 28), (place(1), end)), INK, 2)
    drawing.text((14, end + 26), f"{note}; from line to line 10 times", GREY, 16)
    return drawing
