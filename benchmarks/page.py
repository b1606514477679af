"""The tables of the page on performance, from figures of runs: `python -m benchmarks.page AVX2.json AVX512.json`.

A run is what `python -m benchmarks ... --json RUN.json` writes. Runs on several kinds of processors stand side by side;
a run with `--no-library` becomes a column of the last of them. The page marks the place of each table that it shows,
`<!-- points --> ... <!-- /points -->`; the figures are kept beside it, so that every number can be looked up.
"""

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.__main__ import TABLES
from benchmarks.harness import OURS, WITHOUT_LIBRARY, Figure
from benchmarks.samples import NOTHING

PAGE = Path(__file__).parent.parent / "docs" / "performance.md"
FIGURES = PAGE.with_suffix(".json")
_PLACE = re.compile(r"(<!-- (\w[\w, ]*) -->\n).*?(<!-- /\2 -->)", re.S)

Run = Mapping[str, Any]
_TRIAL = "These figures are from a short trial: do not quote them."
_SECONDS = 0.2  # for a row, below which a run is a trial
_KINDS = {"avx2": "AVX2", "avx512": "AVX-512"}


def filled(page: str, runs: Sequence[Run]) -> str:
    """Return a page whose tables are those of the runs.

    Raises:
        ValueError: If the page has no place for a table of the runs, or the runs have no figures for a place.
    """
    places = [found[2] for found in _PLACE.finditer(page)]
    wanted = ["machine", "losses", *{name: None for run in runs for name in run["results"]}]
    if sorted(places) != sorted(wanted):
        raise ValueError(f"the page's places must be those of the runs, {sorted(wanted)}; got {sorted(places)}")
    special = {"machine": _machine, "losses": _losses}
    texts = {name: special[name](runs) if name in special else _table(name, runs) for name in wanted}
    return _PLACE.sub(lambda match: f"{match[1]}{texts[match[2]]}\n{match[3]}", page)


def _with_library(runs: Sequence[Run]) -> list[Run]:
    return [run for run in runs if not run["arguments"]["no_library"]]


def _figures(name: str, runs: Sequence[Run]) -> list[dict[str, dict[str, Figure]]]:
    """Return the rows of a table in each run with the library; those of other runs join the last of them."""
    found: list[dict[str, dict[str, Figure]]] = []
    for run in sorted(runs, key=lambda run: run["arguments"]["no_library"]):
        rows = run["results"].get(name, {})
        rows = {row: {who: Figure(*figure) for who, figure in figures.items()} for row, figures in rows.items()}
        if run["arguments"]["no_library"]:
            for row, figures in found[-1].items():
                figures.update(rows.get(row, {}))
        else:
            found.append(rows)
    return found


def _kind(run: Run) -> str:
    return _KINDS.get(run["machine"]["library"], run["machine"]["library"])


def _table(name: str, runs: Sequence[Run]) -> str:
    kinds = " / ".join(map(_kind, _with_library(runs)))
    return replace(TABLES[name], title=f"{TABLES[name].title}: {kinds}").markdown(_figures(name, runs))


def _machine(runs: Sequence[Run]) -> str:
    """Return what has to be known to compare the figures with others."""
    facts = dict(_with_library(runs)[-1]["machine"])
    cpu, cores, threads, _ = (facts.pop(name) for name in ("cpu", "cores", "threads", "library"))
    text = f"On {threads} threads of {cpu} with {cores} cores; {', '.join(f'{k} {v}' for k, v in facts.items())}."
    return f"{text} **{_TRIAL}**" if any(run["arguments"]["seconds"] < _SECONDS for run in runs) else text


def _losses(runs: Sequence[Run]) -> str:
    """Return a list of the rows in which somebody else is the fastest."""
    found: dict[str, list[str]] = {}
    for name in {name: None for run in runs for name in run["results"]}:
        for run, rows in zip(_with_library(runs), _figures(name, runs), strict=True):
            for row, figures in rows.items():
                if (who := TABLES[name].fastest(figures)).startswith("**"):
                    found.setdefault(f"* {name}, {row}: ", []).append(f"{who} ({_kind(run)})")
    last = [figures for name in TABLES if name in runs[0]["results"] for figures in _figures(name, runs)[-1].values()]
    ahead = [
        min(others) < figures[WITHOUT_LIBRARY].median
        for figures in last
        if (others := [f.median for who, f in figures.items() if who not in (OURS, WITHOUT_LIBRARY, NOTHING)])
        and WITHOUT_LIBRARY in figures
    ]
    found[f"* camtorch without its library: others are faster in {sum(ahead)} of {len(ahead)} rows"] = []
    return "\n".join(row + ", ".join(whose) for row, whose in found.items())


def main(arguments: list[str] | None = None) -> None:
    """Fill the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.page", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="what `python -m benchmarks ... --json` wrote")
    short = lambda text: float(f"{float(text):.4g}")
    runs = [json.loads(path.read_text(), parse_float=short) for path in parser.parse_args(arguments).runs]
    page = PAGE.read_text()
    for run in runs:
        run["results"] = {name: rows for name, rows in run["results"].items() if f"<!-- {name} -->" in page}
        run["arguments"].pop("json", None)  # where it was written
    PAGE.write_text(filled(page, runs))
    FIGURES.write_text(json.dumps(runs) + "\n")


if __name__ == "__main__":
    main()
