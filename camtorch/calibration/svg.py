"""Plots as SVG within a page, whose colours are those of the page, light or dark."""

from __future__ import annotations

import io
import itertools
import re
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from camtorch.plot.axes import COLOURS, GREY, INK, LEVELS, NO_RAYS, PALE, level_colours, require_matplotlib

_WIDTH = 5.6  # inches, which a page shows as wide as a column
_DARK = {
    INK: "#ece7dd",
    GREY: "#a39c90",
    PALE: "#2b2930",
    NO_RAYS: "#3a3840",
    **dict(zip(COLOURS, ("#7ba5ff", "#ff6f8d", "#41c79a", "#eba945", "#b995f2", "#9fabbb"), strict=True)),
    "#ffffff": "#201f24",  # of legends
    "#cccccc": "#46434b",
}
_DARK_ENDS = {"counts": (0.98, 0.62), "residuals": (0.2, 0.95), "uncertainty": (0.12, 0.95)}
_STYLE: dict[Any, Any] = {
    "axes.edgecolor": GREY,
    "axes.facecolor": "none",
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.left": False,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.facecolor": "none",
    "font.family": "sans-serif",
    "font.size": 9.0,
    "legend.facecolor": "#ffffff",
    "svg.fonttype": "none",
    "text.color": INK,
    "text.parse_math": False,
    "xtick.color": GREY,
    "xtick.labelcolor": INK,
    "xtick.labelsize": 8.5,
    "xtick.major.size": 2.5,
    "ytick.color": GREY,
    "ytick.labelcolor": INK,
    "ytick.labelsize": 8.5,
    "ytick.major.size": 2.5,
}


def palette() -> list[tuple[str, str, str]]:
    """The colours of plots: name of the variable, its value on a light page, and on a dark one."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    pairs = dict(_DARK)
    for name, (source, _, _, count) in LEVELS.items():
        start, end = _DARK_ENDS[name]
        places = [start + (end - start) * i / (count - 1) for i in range(count)]
        pairs.update(zip(level_colours(name), (to_hex(colormaps[source](x)) for x in places), strict=True))
    return [(f"--p{i}", light, dark) for i, (light, dark) in enumerate(pairs.items())]


def _shortened(number: re.Match[str]) -> str:
    return f"{float(number[0]):.2f}".rstrip("0").rstrip(".")


class Plots:
    """Makes plots of one page: their marks have names that no other plot of it has.

    Raises:
        ImportError: no matplotlib.
    """

    def __init__(self) -> None:
        require_matplotlib()
        self._variables = {light: f"var({name})" for name, light, _ in palette()}
        self._numbers: Iterator[int] = itertools.count()

    def draw(self, plot: Callable[[Any], object], *, ratio: float = 0.72, fill: bool = False) -> tuple[str, str]:
        """A plot's SVG, and its title, which is not drawn.

        Args:
            plot: draws on the Axes that it gets.
            ratio: of height to width.
            fill: whether the Axes are all of it, without labels.
        """
        from matplotlib import rc_context
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure

        with rc_context(_STYLE | {"svg.hashsalt": str(next(self._numbers))}), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph .* missing from font")  # the browser has other fonts
            figure = Figure(figsize=(_WIDTH, _WIDTH * ratio), layout=None if fill else "constrained")
            canvas = FigureCanvasSVG(figure)
            ax = figure.add_axes((0, 0, 1, 1)) if fill else figure.add_subplot()
            plot(ax)
            title = ax.get_title()
            ax.set_title("")
            if fill:
                ax.set_axis_off()
            file = io.BytesIO()
            canvas.print_svg(file, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
            # all of the width, so that all texts of a page have one size
            low, high = (0.0, _WIDTH * ratio) if fill else figure.get_tightbbox().intervaly
        margin = 0.0 if fill else 0.03
        top, tall = _WIDTH * ratio - high - margin, high - low + 2 * margin
        box = " ".join(f"{72 * value:.2f}" for value in (0.0, top, _WIDTH, tall))
        return f'<svg viewBox="{box}" role="img">{self._inline(file.getvalue().decode())}', title

    def _inline(self, text: str) -> str:
        """What is within a file's svg element, and its end."""
        body = text[text.index(">", text.index("<svg")) + 1 :]
        body = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>|<style.*?</style>", "", body, flags=re.S)
        body = body.replace("xlink:href", "href")
        used = set(re.findall(r"#([\w-]+)[\")]", body))
        body = re.sub(r' id="([^"]*)"', lambda m: m[0] if m[1] in used else "", body)
        body = re.sub(r'="[^"]*"', lambda m: re.sub(r"-?\d+\.\d{3,}", _shortened, m[0]), body)
        body = re.sub(r"#[0-9a-f]{6}\b", lambda m: self._variables.get(m[0], m[0]), body)
        body = re.sub(r"font-family: [^;\"]*;? ?", "", body)
        return re.sub(r">\s+<", "><", body).strip()
