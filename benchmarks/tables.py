"""Records of what was measured, and tables of them in markdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Record:
    """One figure.

    Args:
        case: what it was measured on, for example the model.
        contestant: who was measured.
        operation: what was done.
        quantity: "seconds", "first call", ... Values are in SI units and bytes, shares between 0 and 1.
    """

    case: str
    contestant: str
    operation: str
    quantity: str
    value: float


def only(records: Iterable[Record], quantity: str, contestants: Callable[[str], bool] = lambda _: True) -> list[Record]:
    """The records of one quantity, of some contestants."""
    return [r for r in records if r.quantity == quantity and contestants(r.contestant)]


def table(title: str, records: Sequence[Record], *, scale: float = 1.0, beside: str = "") -> str:
    """Markdown: a row per case and contestant, a column per operation, "-" where there is no figure.

    Args:
        scale: multiplies every value, for example 1e3 for milliseconds.
        beside: the contestant whose value each figure is put in relation to, as "(2.0x)" for twice as much.
    """
    if not records:
        return ""
    values = {(r.case, r.contestant, r.operation): r.value for r in records}
    rows = list(dict.fromkeys((r.case, r.contestant) for r in records))
    columns = list(dict.fromkeys(r.operation for r in records))

    def cell(case: str, contestant: str, operation: str) -> str:
        value = values.get((case, contestant, operation))
        if value is None:
            return "-"
        reference = values.get((case, beside, operation))
        return number(value * scale) + (f" ({number(value / reference)}x)" if reference else "")

    lines = [["", "", *columns], *([case, who, *(cell(case, who, c) for c in columns)] for case, who in rows)]
    for i in range(len(lines) - 1, 1, -1):  # a case is named once
        if lines[i][0] == lines[i - 1][0]:
            lines[i][0] = ""
    return f"\n### {title}\n\n{markdown(lines)}\n"


def relative(records: Sequence[Record], contestant: str) -> list[Record]:
    """The records divided by those of one contestant, which is left out."""
    base = {(r.case, r.operation): r.value for r in records if r.contestant == contestant}
    return [
        Record(r.case, r.contestant, r.operation, r.quantity, r.value / base[r.case, r.operation])
        for r in records
        if r.contestant != contestant and (r.case, r.operation) in base
    ]


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """Lines of cells, the first of them the heading, as a table that reads well unrendered too."""
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    text = lambda i, cell: cell.ljust(widths[i]) if i < 2 else cell.rjust(widths[i])
    rule = ["-" * w if i < 2 else "-" * (w - 1) + ":" for i, w in enumerate(widths)]
    padded = [[text(i, cell) for i, cell in enumerate(line)] for line in lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in [padded[0], rule, *padded[1:]])


def number(value: float) -> str:
    """Three digits, as a reader would write them."""
    if value != value:
        return "nan"
    if value == 0:
        return "0"
    if not 1e-3 <= abs(value) < 1e5:
        return f"{value:.1e}"
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2 if abs(value) >= 1 else 3
    return f"{value:.{digits}f}"
