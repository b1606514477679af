"""What is required of the figures, and whether they meet it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from benchmarks.tables import Record, markdown, number


@dataclass(frozen=True)
class Requirement:
    """A bound on ratios, or on seconds, one for each row that it is asked of.

    Args:
        text: what is required, with its bound.
        bound: the least that every ratio has to be; or the most.
        ratios: by row.
        at_most: whether the bound is the most.
        unit: of the numbers.
    """

    text: str
    bound: float
    ratios: Mapping[str, float]
    at_most: bool = False
    unit: str = "x"

    @property
    def worst(self) -> tuple[str, float]:
        """The row that is farthest on the wrong side, and its ratio; one that is no number is worst of all."""
        sign = -1 if self.at_most else 1
        return min(self.ratios.items(), key=lambda item: -math.inf if math.isnan(item[1]) else sign * item[1])

    def holds(self, ratio: float) -> bool:
        """Whether a ratio is within the bound."""
        return ratio <= self.bound if self.at_most else ratio >= self.bound


def verdict(requirements: Iterable[Requirement]) -> str:
    """The requirements as a table: the worst row of each, and how many fail. Those without any row are left out."""
    lines = [["requirement", "worst row", "measured", "rows", "verdict"]]
    for one in requirements:
        if not one.ratios:
            continue
        row, ratio = one.worst
        failed = sum(not one.holds(value) for value in one.ratios.values())
        judgement = "ok" if not failed else f"NOT in {failed}"
        lines.append([one.text, row, f"{number(ratio)}{one.unit}", str(len(one.ratios)), judgement])
    return f"\n### What is required\n\n{markdown(lines)}\n" if len(lines) > 1 else ""


def figures(records: Iterable[Record], quantity: str) -> dict[tuple[str, str], dict[str, float]]:
    """(case, operation) -> contestant -> value."""
    found: dict[tuple[str, str], dict[str, float]] = {}
    for record in records:
        if record.quantity == quantity:
            found.setdefault((record.case, record.operation), {})[record.contestant] = record.value
    return found


def times_faster(
    rows: Mapping[tuple[str, str], Mapping[str, float]], who: str, others: Iterable[str]
) -> dict[str, float]:
    """By row, the time of the fastest of the others over that of `who`, where both were measured."""
    others = tuple(others)
    ratios = {}
    for (case, operation), times in rows.items():
        found = [times[other] for other in others if other in times]
        if found and who in times:
            ratios[f"{case}, {operation}"] = min(found) / times[who]
    return ratios
