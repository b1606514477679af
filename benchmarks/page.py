"""The page on performance, from figures of runs: `python -m benchmarks.page AVX2.json AVX512.json NO-LIBRARY.json`.

A run is what `python -m benchmarks ... --json RUN.json` writes. Runs on several kinds of processors stand side by side;
a run with `--no-library` becomes a column of the last of them, and one on a GPU has a place of its own. The page and
README mark the places of what is made here, `<!-- points --> ... <!-- /points -->`. The figures are kept beside the
page, so that every number can be looked up, and its picture shows the first of them.
"""

import argparse
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

sys.path.append(str(Path(__file__).parents[1] / "docs"))

from drawings.performance import Bar, comparison

from benchmarks.__main__ import TABLES
from benchmarks.harness import OURS, WITHOUT_LIBRARY, Figure, digits, joined, times

ROOT = Path(__file__).parents[1]
PAGE, README = ROOT / "docs" / "performance.md", ROOT / "README.md"
FIGURES, PICTURE = PAGE.with_suffix(".json"), ROOT / "docs" / "images" / "performance.svg"
_PLACE = re.compile(r"(<!-- (\w[\w, ]*) -->\n).*?(<!-- /\2 -->)", re.S)
_IMAGE, _IMAGES = "Brown-Conrady, 1 of 3x480x640 uint8, 1 thread", "Brown-Conrady, 8 of 3x480x640 float32, to images"
FIRST = {
    "project 1M points": ("points", "Brown-Conrady project"),
    "project 1M, backward": ("points", "Brown-Conrady project and backward"),
    "unproject 1M points": ("points", "Brown-Conrady unproject"),
    "warp 480x640, kept map": ("kept maps", _IMAGE),
    "warp 480x640, new camera": ("new cameras", _IMAGE),
    "train 8 images": ("training", f"{_IMAGES}, 1 thread"),
    "train 8 images, cameras": ("training", f"{_IMAGES} and cameras, 1 thread"),
    "driver's sample 256x256": ("samples", "RandomMount of a driver, 256x256x3"),
    "driver's sample 480x640": ("samples", "RandomMount of a driver, 480x640x3"),
    "RandomCamera 480x640": ("samples", "RandomCamera, Brown-Conrady to pinhole, 480x640x3"),
    "RandomCamera, batch of 8": ("augment", "Brown-Conrady to pinhole, uint8"),
    "calibrate, 50 views": ("calibration", "Brown-Conrady, calibrate, V = 50"),
}
"""The rows that the page begins with: of the lens that every library knows."""

Run = Mapping[str, Any]
_SECONDS = 0.2  # for a row, below which a run is a trial
_KINDS = {"avx2": "AVX2", "avx512": "AVX-512"}


def filled(page: str, runs: Sequence[Run]) -> str:
    """Return a page whose places show the runs.

    Raises:
        ValueError: If the runs have no figures for a place.
    """
    here, there = _by_device(runs)
    special = {"machine": _machine, "first": _first, "losses": _losses, "without its library": _sentence}
    texts = {name: partial(make, here) for name, make in special.items()} | {"gpu": partial(_gpu, there)}
    texts |= {name: partial(_table, name, here) for name in _names(here)}
    if unknown := {found[2] for found in _PLACE.finditer(page)} - set(texts):
        raise ValueError(f"the page's places must be those of the runs, {sorted(texts)}; got {sorted(unknown)}")
    return _PLACE.sub(lambda place: f"{place[1]}{texts[place[2]]()}\n{place[3]}", page)


def picture(runs: Sequence[Run], path: Path) -> None:
    """Draw how the first rows compare with the next best, with the library and without it."""
    here, bars = _by_device(runs)[0], []
    for title, (name, row) in FIRST.items():
        first, *_, last = [rows.get(row, {}) for rows in _figures(name, here)] * 2
        ours, without = TABLES[name].rival(first), TABLES[name].rival(last, WITHOUT_LIBRARY)
        bars += [Bar(title, ours[0].replace("`", ""), ours[1], without and without[1])] if ours else []
    facts = here[0]["machine"]
    drawing = comparison(bars, _kinds(here[:1]), f"{facts['cpu'].partition(' (')[0]}, camtorch {facts['camtorch']}")
    drawing.save(path, "Times of the next best library over camtorch's")


def _by_device(runs: Sequence[Run]) -> tuple[list[Run], list[Run]]:
    """Return the runs on a CPU, those with the library first, and the others."""
    ordered = sorted(runs, key=lambda run: run["arguments"]["no_library"])
    is_here = lambda run: run["arguments"]["device"] == "cpu"
    return [run for run in ordered if is_here(run)], [run for run in ordered if not is_here(run)]


def _figures(name: str, runs: Sequence[Run]) -> list[dict[str, dict[str, Figure]]]:
    """Return the rows of a table in each run with the library; those of other runs join the last of them."""
    found: list[dict[str, dict[str, Figure]]] = []
    for run in runs:
        if not run["arguments"]["no_library"]:
            found.append({})
        for row, figures in run["results"].get(name, {}).items():
            found[-1].setdefault(row, {}).update({who: Figure(*figure) for who, figure in figures.items()})
    return found


def _names(runs: Sequence[Run]) -> list[str]:
    return list({name: None for run in runs for name in run["results"]})


def _kinds(runs: Sequence[Run]) -> str:
    kinds = [run["machine"]["library"] for run in runs if not run["arguments"]["no_library"]]
    return " / ".join(_KINDS.get(kind, kind) for kind in kinds)


def _table(name: str, runs: Sequence[Run]) -> str:
    return replace(TABLES[name], title=f"{TABLES[name].title}: {_kinds(runs)}").markdown(_figures(name, runs))


def _first(runs: Sequence[Run]) -> str:
    """Return the table of the first rows."""
    lines = [f"| ms: {_kinds(runs)} | camtorch | next best | fastest | {WITHOUT_LIBRARY} | fastest |"]
    lines.append("|---|" + "---:|" * 5)
    for title, (name, row) in FIRST.items():
        table, each = TABLES[name], [rows.get(row, {}) for rows in _figures(name, runs)]
        ours = joined(digits(1e3 * figures[OURS].median) if OURS in figures else "" for figures in each)
        rivals = [(found[0], found[1] * figures[OURS].median) for figures in each if (found := table.rival(figures))]
        others = joined(f"{who} {digits(1e3 * seconds)}" for who, seconds in rivals)
        without = [digits(1e3 * each[-1][who].median) for who in (WITHOUT_LIBRARY,) if who in each[-1]] or ["-"]
        cells = [title, ours, others, joined(map(table.fastest, each)), *without]
        lines.append(f"| {' | '.join(cells)} | {table.fastest(each[-1], WITHOUT_LIBRARY) or '-'} |")
    return "\n".join(lines)


def _machine(runs: Sequence[Run]) -> str:
    """Return what has to be known to compare the figures with others."""
    facts = dict(runs[-1]["machine"])
    cpu, cores, threads, _ = (facts.pop(name) for name in ("cpu", "cores", "threads", "library"))
    text = f"On {threads} threads of {cpu} with {cores} cores; {', '.join(f'{k} {v}' for k, v in facts.items())}."
    trial = any(run["arguments"]["seconds"] < _SECONDS for run in runs)
    return f"{text} **These figures are from a short trial: do not quote them.**" if trial else text


def _without(name: str, runs: Sequence[Run]) -> Iterator[tuple[float, str]]:
    """Yield, for each row with a rival, how many times the rival's time camtorch takes without its library."""
    for row, figures in _figures(name, runs)[-1].items():
        if found := TABLES[name].rival(figures, WITHOUT_LIBRARY):
            yield 1 / found[1], f"{row}: **{found[0]} {times(1 / found[1])}**"


def _losses(runs: Sequence[Run]) -> str:
    """Return a list of the rows in which somebody else is the fastest."""
    found: dict[str, list[str]] = {}
    for name in _names(runs):
        for kind, rows in zip(_kinds(runs).split(" / "), _figures(name, runs), strict=True):
            for row, figures in rows.items():
                if (who := TABLES[name].fastest(figures)).startswith("**"):
                    found.setdefault(f"* {name}, {row}: ", []).append(f"{who} ({kind})")
    for name in _names(runs):
        every = list(_without(name, runs))
        if lost := [pair for pair in every if pair[0] > 1]:
            text = f"{len(lost)} of {len(every)} rows, by {times(median(ratio for ratio, _ in lost))} in the median"
            found[f"* without its library, {name}: {text}; at the worst {max(lost)[1]}"] = []
    return "\n".join(row + ", ".join(whose) for row, whose in found.items())


def _sentence(runs: Sequence[Run]) -> str:
    """Return what a reader of README has to know before an installation without a compiler."""
    every = [ratio for name in _names(runs) for ratio, _ in _without(name, runs)]
    lost = [ratio for ratio in every if ratio > 1]
    page = "[the page on performance](docs/performance.md#where-others-are-faster)"
    by = f"{times(median(lost))} in the median, {times(max(lost))} at the worst"
    return f"Without it, other libraries are faster in {len(lost)} of {len(every)} rows of {page}: {by}."


def _gpu(runs: Sequence[Run]) -> str:
    if not runs:
        return "No GPU was measured, so this page states no times there."
    return "\n\n".join([_machine(runs), *(_table(name, runs) for name in _names(runs))])


def main(arguments: list[str] | None = None) -> None:
    """Fill the page and README, and draw the picture."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.page", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="what `python -m benchmarks ... --json` wrote")
    short = lambda text: float(f"{float(text):.4g}")
    runs = [json.loads(path.read_text(), parse_float=short) for path in parser.parse_args(arguments).runs]
    for run in runs:
        run["results"] = {name: rows for name, rows in run["results"].items() if f"<!-- {name} -->" in PAGE.read_text()}
        run["arguments"].pop("json", None)  # where it was written
    for path in (PAGE, README):
        path.write_text(filled(path.read_text(), runs))
    picture(runs, PICTURE)
    FIGURES.write_text(json.dumps(runs) + "\n")


if __name__ == "__main__":
    main()
